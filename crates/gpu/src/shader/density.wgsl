// What a value means, as bits in and out, since devices may take it that there is no NaN: nuage_pipeline::import. Numbers that
// are subnormal count as 0: devices may take them for that as well.
fn density(bits: u32, meaning: u32, band_bits: u32) -> u32 {
    let size = bits & 0x7fffffffu;
    let is_negative = size != bits;
    let infinite = 0x7f800000u;
    if (size > infinite) {
        return 0u;
    }
    let value = bitcast<f32>(select(min(size, infinite - 1u), 0u, size < MIN_F32_BITS));
    let band = bitcast<f32>(band_bits);
    var found = 0.0;
    switch (meaning) {
        case MEANS_FOG: {
            found = select(0.0, min(value, band) / band, is_negative);
        }
        case MEANS_SURFACE: {
            found = clamp(select(band - value, band + min(value, band), is_negative), 0.0, 2.0 * band);
        }
        default: {
            found = select(value, 0.0, is_negative);
        }
    }
    return bitcast<u32>(found);
}
