// Rays through pixels: nuage_render::camera.

fn camera_ray(pixel: vec2<f32>) -> Ray {
    let size = vec2<f32>(params.size.xy);
    let x = (2.0 * pixel.x - size.x) / size.x;
    let y = (size.y - 2.0 * pixel.y) / size.x;
    let direction = params.forward.xyz + x * params.right.xyz + y * params.up.xyz;
    return Ray(params.camera.xyz, normalize(direction));
}

// A ray in a field's positions, beginning where it begins in the world.
fn in_field(field: u32, ray: Ray) -> LocalRay {
    return local_ray(position_of(field, ray.origin), directions(field, ray.direction));
}

// The same ray with t = 0 moved to a distance.
fn moved(field: u32, ray: Ray, start: f32) -> LocalRay {
    return local_ray(position_of(field, ray.origin + ray.direction * start), directions(field, ray.direction));
}

// The field of a channel in the frame that is shown.
fn field_of(channel: u32) -> u32 {
    return params.size.z * tree[FIELDS_PER_FRAME] + channel;
}

// The pixel of the picture that a pixel of those that are marched stands for.
fn pixel_of_marched(marched: vec2<u32>) -> vec2<u32> {
    return min(marched * params.marched.z + marched_offset(), params.size.xy - 1u);
}

// Which of the pixels that it stands for a marched pixel shows: in turn all of them.
fn marched_offset() -> vec2<u32> {
    let number = params.marched.w;
    return vec2<u32>((number ^ (number >> 1u)) & 1u, number & 1u) & vec2<u32>(params.marched.z - 1u);
}

// Whether the driver has begun to leave loops before their end. Lavapipe does once all loops of an invocation have taken some
// 65,000 turns together: each is then left after its first turn, without a word.
fn leaves_loops() -> bool {
    var turns = 0u;
    while (turns < params.map_size.z) {
        turns += 1u;
    }
    return turns < params.map_size.z;
}

// What a pixel showed before something that cannot be known yet, with an opacity that no light has; and that back again.
fn marked(before: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(before.xyz, (before.w + 1.0) * UNSOUND);
}

fn unmarked(value: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(value.xyz, value.w / UNSOUND - 1.0);
}

fn is_marked(value: vec4<f32>) -> bool {
    return value.w <= UNSOUND;
}

fn store(pixel: vec2<u32>, value: vec4<f32>) {
    let is_sound = !(CHECKS_LOOPS && leaves_loops());
    picture[pixel.y * params.size.x + pixel.x] = select(marked(vec4<f32>(0.0)), shown(value), is_sound);
}

// As `store`, of a pixel of so many that others can go on with: behind the last is said whether there is one.
fn store_or_mark(number: u32, before: vec4<f32>, value: vec4<f32>, is_finished: bool) {
    if (CHECKS_LOOPS && (!is_finished || leaves_loops())) {
        picture[number] = marked(before);
        picture[arrayLength(&picture) - 1u] = vec4<f32>(1.0);
        return;
    }
    picture[number] = shown(value);
}
