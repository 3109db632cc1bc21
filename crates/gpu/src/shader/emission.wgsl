// How a value of a channel that glows becomes radiance: nuage_render::scene::Spectrum and color::Blackbody.

fn spectrum_radiance(emission: vec4<f32>, value: f32) -> vec3<f32> {
    if (emission.w < 0.0) {
        return emission.xyz * value;
    }
    let kelvin = value * emission.w;
    if (kelvin <= COLDEST_KELVIN) {
        return vec3<f32>(0.0);
    }
    let hot = 1.0 / HOTTEST_KELVIN;
    let cold = 1.0 / COLDEST_KELVIN;
    let position = max(1.0 / kelvin - hot, 0.0) * (BLACKBODY_STEPS / (cold - hot));
    let index = min(floor(position), BLACKBODY_STEPS - 1.0);
    let a = params.blackbody[u32(index)];
    let b = params.blackbody[u32(index) + 1u];
    let row = a + (b - a) * (position - index);
    return row.xyz * exp_(row.w) * emission.x;
}
