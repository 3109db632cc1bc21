// Rays that end at the host's scene, as its depth buffer has it.

@group(2) @binding(0) var depth_buffer: texture_depth_2d;

fn end_of(pixel: vec2<u32>, ray: Ray) -> f32 {
    let size = textureDimensions(depth_buffer);
    let place = (vec2<f32>(pixel) + 0.5) / vec2<f32>(params.size.xy);
    let depth = textureLoad(depth_buffer, vec2<i32>(place * vec2<f32>(size)), 0);
    let clip = vec4<f32>(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, depth, 1.0);
    let at = mat4x4<f32>(params.clip_x, params.clip_y, params.clip_z, params.clip_w) * clip;
    // An infinite far plane has no place.
    if (abs(at.w) <= 1e-7 * max_component(abs(at.xyz))) {
        return MAX_F32;
    }
    return dot(at.xyz / at.w - ray.origin, ray.direction);
}
