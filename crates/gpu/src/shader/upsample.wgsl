// From a picture of a quarter of the pixels to all of them: between its four pixels around, of which those count less whose
// ray ends elsewhere, so that the medium in front of a wall does not shine over what stands before it.

@group(3) @binding(0) var<storage, read> marched: array<vec4<f32>>;

// Where the ray of a pixel ends, or where the medium does.
fn end_in_medium(pixel: vec2<u32>) -> f32 {
    return min(end_of(pixel, camera_ray(vec2<f32>(pixel) + 0.5)), params.view.y);
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn upsample(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let place = (vec2<f32>(id.xy) - vec2<f32>(marched_offset())) / f32(params.marched.z);
    let first = floor(place);
    let between = place - first;
    let end = end_in_medium(id.xy);
    var sum = vec4<f32>(0.0);
    var weights = 0.0;
    for (var i = 0; i < 4; i++) {
        let corner = vec2<i32>(i & 1, i >> 1u);
        let at = vec2<u32>(clamp(vec2<i32>(first) + corner, vec2<i32>(0), vec2<i32>(params.marched.xy) - 1));
        let part = select(1.0 - between, between, corner == vec2<i32>(1));
        let apart = abs(end_in_medium(pixel_of_marched(at)) - end) / max(end, MIN_F32);
        // Never nothing: where no ray ends nearby, any of them is better than none.
        let weight = (part.x * part.y + LEAST_WEIGHT) / (1.0 + apart / UPSAMPLE_TOLERANCE);
        sum += weight * marched[at.y * params.marched.x + at.x];
        weights += weight;
    }
    store(id.xy, sum / weights);
}
