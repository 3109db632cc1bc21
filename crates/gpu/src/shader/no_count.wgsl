// Nothing is counted.

fn count_ray() {}
fn count_region() {}
fn count_value() {}

fn shown(value: vec4<f32>) -> vec4<f32> {
    return value;
}
