// What pictures that stand alone do in place of `real_time.wgsl`.

fn step_shift(marched: vec2<u32>, random: u32) -> f32 {
    return unit_f32(hash_u32(random));
}

fn cached_transmittance(position: vec3<f32>) -> f32 {
    return 1.0;
}

fn keep_depth(marched: vec2<u32>, depth: f32) {
}
