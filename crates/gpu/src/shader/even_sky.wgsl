// The light of skies that are no pictures: nuage_render::light::Sky.

fn sky_radiance(direction: vec3<f32>) -> vec3<f32> {
    let height = clamp(dot(params.sky_up.xyz, direction), -1.0, 1.0);
    let pole = select(params.sky_zenith.xyz, params.sky_ground.xyz, height < 0.0);
    let level = max(1.0 - height * height, 0.0);
    return pole + (params.sky_horizon.xyz - pole) * (level * level * level * level);
}

// No collision looks for such a sky.
fn mapped(phase: Phase, at: vec3<f32>, before: vec3<f32>, random: ptr<function, Random>) -> vec3<f32> {
    return vec3<f32>(0.0);
}
