// Lights: nuage_render::light.

// What arrives of a light at a point in clear air: from one direction, or evenly from a cone if `spread` is above 0.
struct Arriving { light: vec3<f32>, direction: vec3<f32>, distance: f32, spread: f32 }

// 1 - cos of an angle whose sine is given in square.
fn spread_of(sin_squared: f32) -> f32 {
    return sin_squared / (1.0 + sqrt(max(1.0 - sin_squared, 0.0)));
}

fn arriving(light: Light, at: vec3<f32>) -> Arriving {
    let nothing = Arriving(vec3<f32>(0.0), vec3<f32>(0.0, 0.0, 1.0), 0.0, 0.0);
    let kind = u32(light.place.w);
    if (kind == LIGHT_SUN) {
        return Arriving(light.colour.xyz, light.place.xyz, MAX_F32, light.colour.w);
    }
    let offset = light.place.xyz - at;
    let squared = dot(offset, offset);
    if (squared <= MIN_F32) {
        return nothing;
    }
    let direction = offset / sqrt(squared);
    if (kind == LIGHT_SPHERE) {
        let sin_squared = light.colour.w * light.colour.w / squared;
        if (sin_squared >= 1.0) {
            return nothing;
        }
        return Arriving(light.colour.xyz, direction, MAX_F32, spread_of(sin_squared));
    }
    var part = 1.0;
    if (kind == LIGHT_SPOT) {
        let x = clamp((dot(-direction, light.aim.xyz) - light.aim.w) / (light.colour.w - light.aim.w), 0.0, 1.0);
        part = x * x * (3.0 - 2.0 * x);
    }
    return Arriving(light.colour.xyz * part / squared, direction, sqrt(squared), 0.0);
}

// How far a ray from a point goes until it meets a sphere that shines.
fn distance_to_sphere(light: Light, at: vec3<f32>, direction: vec3<f32>) -> f32 {
    let offset = light.place.xyz - at;
    let along = dot(offset, direction);
    let away = offset - direction * along;
    return along - sqrt(max(light.colour.w * light.colour.w - dot(away, away), 0.0));
}

// A direction inside of a cone, all alike.
fn sample_cone(axis: vec3<f32>, spread: f32, u: vec2<f32>) -> vec3<f32> {
    let from_axis = u.x * spread;
    let across_length = sqrt(max(from_axis * (2.0 - from_axis), 0.0));
    let turn = sin_cos_turns(u.y);
    let frame = tangent_frame(axis);
    let across = frame.tangent * (across_length * turn.y) + frame.bitangent * (across_length * turn.x);
    return normalize(axis * (1.0 - from_axis) + across);
}
