//! Bounds of an entry in twelve bits each: small floats, rounded outward.
//!
//! A bound is a sign, five bits of exponent and six of mantissa, so that it is at most one part in 64 too wide however
//! small it is. Bounds count in the channel's unit: magnitudes are at most 1.

use crate::brick::Bounds;

/// The mantissa bits of a float that a bound does not keep.
pub const DROPPED_BITS: u32 = 23 - 6;
/// What the exponent of a float is more than that of a bound.
pub const EXPONENT_OFFSET: u32 = (127 - 31) << 6;
/// The bit of a bound's sign; magnitudes are less.
pub const SIGN: u32 = 1 << 11;

/// The magnitude of a bound, not less than the one given, or not more.
fn magnitude(value: f32, up: bool) -> u32 {
    let bits = value.abs().to_bits();
    let is_between = bits & ((1 << DROPPED_BITS) - 1) != 0;
    let kept = (bits >> DROPPED_BITS) + u32::from(up && is_between);
    // Below the smallest there is only zero.
    let smallest = u32::from(up && value != 0.0);
    kept.saturating_sub(EXPONENT_OFFSET).clamp(smallest, SIGN - 1)
}

fn encode(value: f32, up: bool) -> u32 {
    // A negative value is rounded up by taking a smaller magnitude.
    if value < 0.0 { SIGN | magnitude(value, !up) } else { magnitude(value, up) }
}

fn decode(code: u32) -> f32 {
    let magnitude = match code & (SIGN - 1) {
        0 => 0.0,
        kept => f32::from_bits((kept + EXPONENT_OFFSET) << DROPPED_BITS),
    };
    if code & SIGN == 0 { magnitude } else { -magnitude }
}

/// Both bounds in 24 bits, the smaller one low. They hold what the ones given hold, as long as no magnitude exceeds the
/// unit.
pub fn pack(bounds: Bounds, unit: f32) -> u32 {
    encode(bounds.min / unit, false) | encode(bounds.max / unit, true) << 12
}

/// The bounds in 24 bits.
pub fn unpack(bits: u32, unit: f32) -> Bounds {
    Bounds { min: decode(bits & 0xfff) * unit, max: decode(bits >> 12 & 0xfff) * unit }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn bounds_are_outside_and_close(a in -1.0_f32..=1.0, b in -1.0_f32..=1.0, scale in 0_i32..40, unit in -20_i32..20) {
            let unit = (unit as f32).exp2();
            let shrink = (-scale as f32).exp2();
            let (a, b) = (a * shrink * unit, b * shrink * unit);
            let bounds = Bounds { min: a.min(b), max: a.max(b) };
            let found = unpack(pack(bounds, unit), unit);
            prop_assert!(found.min <= bounds.min && found.max >= bounds.max);
            let smallest = unit * (2.0_f32).powi(-30);
            for (found, exact) in [(found.min, bounds.min), (found.max, bounds.max)] {
                prop_assert!((found - exact).abs() <= exact.abs() / 64.0 + smallest, "{found} {exact}");
            }
        }
    }

    #[test]
    fn zero_and_one_are_exact() {
        for value in [-1.0, 0.0, 1.0, 0.5, -0.25] {
            assert_eq!(unpack(pack(Bounds::of(value), 1.0), 1.0), Bounds::of(value));
        }
    }
}
