// What pictures that stand alone do in place of `real_time.wgsl`.

// Whether steps are lit by the sky in groups, of any size: less noise, of one ray each at least.
const GROUPS_SKY: bool = false;

fn step_shift(marched: vec2<u32>, random: u32) -> f32 {
    return unit_f32(hash_u32(random));
}

// What part of the first ray's share is gone where it goes to the sky.
fn sky_shift(random: u32, step_shift: f32) -> f32 {
    return unit_f32(hash_u32(random ^ SKY_SEED));
}

fn cached_transmittance(position: vec3<f32>) -> f32 {
    return 1.0;
}

fn keep_depth(marched: vec2<u32>, depth: f32) {
}
