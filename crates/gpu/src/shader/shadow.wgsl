// The volume's shadow on a scene: the share of the sun's light that gets to the host's surfaces, or to points.

// In single precision a ray that begins far away sees the volume tremble: it begins where it enters.
fn sun_transmittance(p_world: vec3<f32>) -> f32 {
    let field = field_of(SHADOW_CHANNEL);
    let direction = params.sun_direction.xyz;
    let span = field_interval(field, in_field(field, Ray(p_world, direction)), 0.0);
    if (span.x >= span.y) {
        return 1.0;
    }
    let ray = moved(field, Ray(p_world, direction), span.x);
    var passage: Passage;
    if (HAS_EXACT_SHADOWS) {
        return exact_transmittance(field, ray, &passage);
    }
    let step = params.march.y / length(ray.direction);
    let lattice = Lattice(step, 0.5, params.march.z / step);
    let scale = params.media[0].extinction.x;
    let depth = optical_depth(field, ray, span.y - span.x, lattice, scale, params.march_rays.z, &passage);
    return exp_(-depth);
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn shadow(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    var p_world = params.camera.xyz + picture[id.y * params.size.x + id.x].xyz;
    var is_there = true;
    if (HAS_DEPTH) {
        let ray = camera_ray(vec2<f32>(id.xy) + 0.5);
        let end = end_of(id.xy, ray);
        is_there = end < MAX_F32;
        p_world = ray.origin + ray.direction * end;
    }
    var passes = 1.0;
    if (is_there && any(params.sun_direction.xyz != vec3<f32>(0.0))) {
        passes = sun_transmittance(p_world);
    }
    store(id.xy, vec4<f32>(passes, passes, passes, 1.0));
}
