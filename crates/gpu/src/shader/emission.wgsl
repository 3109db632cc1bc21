// How a value of a channel that glows becomes radiance: nuage_render::scene::Spectrum and color::Blackbody.

fn spectrum_radiance(value: f32) -> vec3<f32> {
    if (params.emission.w < 0.0) {
        return params.emission.xyz * value;
    }
    let kelvin = value * params.emission.w;
    if (kelvin <= COLDEST_KELVIN) {
        return vec3<f32>(0.0);
    }
    let hot = 1.0 / HOTTEST_KELVIN;
    let cold = 1.0 / COLDEST_KELVIN;
    let position = max(1.0 / kelvin - hot, 0.0) * (BLACKBODY_STEPS / (cold - hot));
    let index = min(floor(position), BLACKBODY_STEPS - 1.0);
    let a = blackbody_row(u32(index));
    let b = blackbody_row(u32(index) + 1u);
    let row = a + (b - a) * (position - index);
    return row.xyz * exp_(row.w) * params.emission.x;
}

fn blackbody_row(row: u32) -> vec4<f32> {
    let at = BLACKBODY + 4u * row;
    return bitcast<vec4<f32>>(vec4<u32>(tables[at], tables[at + 1u], tables[at + 2u], tables[at + 3u]));
}
