// Colour: nuage_render::color and the hues of nuage_render::views.

fn linear_to_srgb(linear: f32) -> f32 {
    if (linear <= SRGB_LINEAR_END) {
        return SRGB_SLOPE * linear;
    }
    return SRGB_SCALE * pow(linear, 1.0 / SRGB_GAMMA) - SRGB_OFFSET;
}

// The full colour of a hue: 0 and 1 are red, a third green, two thirds blue.
fn hue(turns: f32) -> vec3<f32> {
    let sixth = fract(turns) * 6.0 - vec3<f32>(0.0, 2.0, 4.0);
    let around = sixth - 6.0 * floor(sixth / 6.0);
    return clamp(2.0 - min(around, 6.0 - around), vec3<f32>(0.0), vec3<f32>(1.0));
}
