// What the ray marcher does in pictures of a kind that follow each other: steps that begin where blue noise says, light from
// the light volume, and depths to find the medium again in the next picture.

@group(3) @binding(0) var light_volume_read: texture_3d<f32>;
@group(3) @binding(1) var light_sampler: sampler;
@group(3) @binding(2) var blue_noise: texture_2d<f32>;
@group(3) @binding(3) var depth_of_marched: texture_storage_2d<r32float, write>;

// Whether steps are lit by the sky in groups, of any size: less noise, of one ray each at least.
const GROUPS_SKY: bool = true;

// Where the steps of a pixel begin: neighbours differ as much as they can, and so do pictures that follow each other.
fn step_shift(marched: vec2<u32>, random: u32) -> f32 {
    let noise = textureLoad(blue_noise, marched % NOISE_SIDE, 0).x;
    return fract(noise + unit_f32(params.marched.w * GOLDEN));
}

// What part of the first ray's share is gone where it goes to the sky: as evenly spread as where steps begin, which it does
// not depend on otherwise.
fn sky_shift(random: u32, step_shift: f32) -> f32 {
    return step_shift;
}

// The share of the sun's light that gets to a position of the field that shadow rays meet.
fn cached_transmittance(position: vec3<f32>) -> f32 {
    let p = vec4<f32>(position, 1.0);
    let at = vec3<f32>(dot(params.light_u, p), dot(params.light_v, p), dot(params.light_w, p));
    return textureSampleLevel(light_volume_read, light_sampler, at, 0.0).x;
}

// How far away the medium is that a pixel shows: 0 where there is none.
fn keep_depth(marched: vec2<u32>, depth: f32) {
    textureStore(depth_of_marched, marched, vec4<f32>(depth));
}
