// Rays through homogeneous boxes and balls: nuage_render::solid.

// Where a ray is inside of a solid, from 0 on; empty if it misses.
fn solid_interval(medium: u32, ray: Ray) -> vec2<f32> {
    let x = params.media[medium].unit_x;
    let y = params.media[medium].unit_y;
    let z = params.media[medium].unit_z;
    let origin = vec3<f32>(dot(x.xyz, ray.origin), dot(y.xyz, ray.origin), dot(z.xyz, ray.origin))
        + vec3<f32>(x.w, y.w, z.w);
    let direction = vec3<f32>(dot(x.xyz, ray.direction), dot(y.xyz, ray.direction), dot(z.xyz, ray.direction));
    if (params.media[medium].kind.x == SHAPE_BALL) {
        return ball_interval(origin, direction);
    }
    return interval_in(local_ray(origin, direction), vec3<f32>(0.0), vec3<f32>(1.0));
}

fn ball_interval(origin: vec3<f32>, direction: vec3<f32>) -> vec2<f32> {
    let squared = max(dot(direction, direction), MIN_F32);
    // From the point of the ray that is nearest to the centre: nothing cancels, however far the origin is.
    let middle = -dot(origin, direction) / squared;
    let across = origin + direction * middle;
    let left = (1.0 - dot(across, across)) / squared;
    if (left <= 0.0) {
        return vec2<f32>(0.0);
    }
    return vec2<f32>(max(middle - sqrt(left), 0.0), middle + sqrt(left));
}
