// From sums of light to what a screen shows, over what it shows already.

@vertex
fn whole_screen(@builtin(vertex_index) i: u32) -> @builtin(position) vec4<f32> {
    return vec4<f32>(f32(i & 1u) * 4.0 - 1.0, f32(i >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

// Colour times opacity, and opacity: to be blended over the target.
@fragment
fn tone(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let pixel = min(vec2<u32>(position.xy * params.tone.zw), params.size.xy - 1u);
    // Nothing where what a pixel shows cannot be known.
    let value = max(picture_read[pixel.y * params.size.x + pixel.x] * params.tone.y, vec4<f32>(0.0));
    let light = value.xyz * params.tone.x;
    if (ENCODES_SRGB) {
        let clamped = min(light, vec3<f32>(1.0));
        return vec4<f32>(linear_to_srgb(clamped.x), linear_to_srgb(clamped.y), linear_to_srgb(clamped.z), value.w);
    }
    return vec4<f32>(light, value.w);
}
