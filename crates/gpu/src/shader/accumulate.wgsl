// The mean of pictures that follow each other: what a pixel shows is looked for where it was in the picture before, and
// counts as much as pictures have gone into it. Where the camera moved or the medium is another, it is held within what the
// neighbours show now, so that nothing stays that is gone.

@group(3) @binding(0) var<storage, read> current: array<vec4<f32>>;
@group(3) @binding(1) var depth_of_marched: texture_2d<f32>;
@group(3) @binding(2) var<storage, read> before: array<vec4<f32>>;
// Of each pixel how many pictures it is the mean of, and where its ray ended.
@group(3) @binding(3) var kept_before: texture_2d<f32>;
@group(3) @binding(4) var kept: texture_storage_2d<rg32float, write>;

fn current_at(pixel: vec2<i32>) -> vec4<f32> {
    let at = vec2<u32>(clamp(pixel, vec2<i32>(0), vec2<i32>(params.size.xy) - 1));
    return current[at.y * params.size.x + at.x];
}

fn before_at(pixel: vec2<i32>) -> vec4<f32> {
    let at = vec2<u32>(clamp(pixel, vec2<i32>(0), vec2<i32>(params.size.xy) - 1));
    return before[at.y * params.size.x + at.x];
}

// Where a place was in the picture before, in pixels; beyond the picture if it was behind the camera.
fn pixel_before(p_world: vec3<f32>) -> vec2<f32> {
    let offset = p_world - params.before_camera.xyz;
    let away = dot(offset, params.before_forward.xyz);
    if (away <= 0.0) {
        return vec2<f32>(-1.0);
    }
    let right = params.before_right.xyz;
    let up = params.before_up.xyz;
    let x = dot(offset, right) / (dot(right, right) * away);
    let y = dot(offset, up) / (dot(up, up) * away);
    let size = vec2<f32>(params.size.xy);
    return 0.5 * vec2<f32>(size.x + x * size.x, size.y - y * size.x);
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn accumulate(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let pixel = vec2<i32>(id.xy);
    let now = current_at(pixel);
    let ray = camera_ray(vec2<f32>(id.xy) + 0.5);
    let end = min(end_of(id.xy, ray), params.view.y);
    var count = 0.0;
    var mean = vec4<f32>(0.0);
    if (params.history.z > 0.0) {
        let marched = min(id.xy / params.marched.z, params.marched.xy - 1u);
        let depth = textureLoad(depth_of_marched, marched, 0).x;
        let at = pixel_before(ray.origin + ray.direction * select(end, depth, depth > 0.0));
        let size = vec2<f32>(params.size.xy);
        if (all(at >= vec2<f32>(0.0)) && all(at < size)) {
            let first = floor(at - 0.5);
            let f = at - 0.5 - first;
            let corner = vec2<i32>(first);
            let low = mix(before_at(corner), before_at(corner + vec2<i32>(1, 0)), f.x);
            let high = mix(before_at(corner + vec2<i32>(0, 1)), before_at(corner + vec2<i32>(1, 1)), f.x);
            mean = mix(low, high, f.y);
            count = textureLoad(kept_before, vec2<u32>(at), 0).x;
        }
    } else {
        let kept_here = textureLoad(kept_before, id.xy, 0);
        mean = before_at(pixel);
        // What stands in the scene may have moved.
        count = select(0.0, kept_here.x, abs(kept_here.y - end) <= KEPT_TOLERANCE * end);
    }
    count = min(count, params.history.x);
    if (params.history.y > 0.0) {
        let apart = i32(params.marched.z);
        var least = now;
        var most = now;
        for (var i = 0; i < 9; i++) {
            let neighbour = current_at(pixel + apart * vec2<i32>(i % 3 - 1, i / 3 - 1));
            least = min(least, neighbour);
            most = max(most, neighbour);
        }
        mean = clamp(mean, least, most);
    }
    store(id.xy, mean + (now - mean) / (count + 1.0));
    textureStore(kept, id.xy, vec4<f32>(count + 1.0, end, 0.0, 0.0));
}
