// What the rays of a pixel look up, in place of its colour.

var<private> counted: vec3<u32>;

fn count_ray() { counted.x += 1u; }
fn count_region() { counted.y += 1u; }
fn count_value() { counted.z += 1u; }

fn shown(value: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(vec3<f32>(counted), 0.0);
}

// Whether a dispatch has done its share and others go on: never.
const GOES_ON: bool = false;

fn is_spent() -> bool {
    return false;
}
