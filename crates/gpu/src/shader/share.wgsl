// The share of a picture's work that one dispatch does, where others go on: counted in look-ups, each of which takes a turn of a
// loop, or a few.

const GOES_ON: bool = true;

var<private> spent: u32;

fn count_ray() {}
fn count_region() { spent += 1u; }
fn count_value() { spent += 1u; }

// Whether a dispatch has done its share.
fn is_spent() -> bool {
    return spent >= params.rounds.z;
}

fn shown(value: vec4<f32>) -> vec4<f32> {
    return value;
}
