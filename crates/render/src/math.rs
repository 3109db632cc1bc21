//! Elementary functions written once, from additions, multiplications and bit operations on `f32` alone, so
//! that they give the same bits on every platform and can be ported line by line to a shader. The standard
//! library's versions differ between platforms by a last bit, which is enough to send a random path another
//! way.
//!
//! Random numbers live in [`hash`](crate::hash), colour curves in [`color`](crate::color). A port must keep
//! the order of operations and must not fuse a multiplication with an addition if it is to give the same
//! bits.

/// Adding this to a float of magnitude below 2^22 rounds it to the nearest integer (ties to even) and leaves
/// that integer in the low mantissa bits: a rounding without a call or a conversion. It is 1.5 · 2^23.
const ROUND: f32 = 12_582_912.0;

/// Of the logarithm: ½ ln((1 + s) / (1 − s)) is s and the sum of these times s³, s⁵ and so on.
pub const LN_SERIES: [f32; 4] = [1.0 / 3.0, 1.0 / 5.0, 1.0 / 7.0, 1.0 / 9.0];

/// ln 2 in two parts. The first has few enough bits that its product with any exponent is exact.
pub const LN_2_HIGH: f32 = 0.693_359_4;
/// What the first part lacks.
pub const LN_2_LOW: f32 = -2.121_944_4e-4;
/// The polynomial of [`exp`]: (e^r − 1 − r) / r² by powers of r.
pub const EXP_SERIES: [f32; 5] = [0.5, 0.166_665_76, 4.166_655_2e-2, 8.363_233e-3, 1.392_625e-3];
/// Below this [`exp`] is 0.
pub const EXP_LOWEST: f32 = -87.33;
/// Above this [`exp`] is infinite.
pub const EXP_HIGHEST: f32 = 88.722_83;
/// Beyond this optical depth [`one_minus_exp_neg`] rounds to 1.
pub const OPAQUE_DEPTH: f32 = 17.5;
/// The bits of √½: mantissas of [`ln`] lie between it and √2.
pub const ROOT_HALF: i32 = 0x3f35_04f3;
/// The polynomials of [`sin_cos_turns`], from the highest power down; the last terms are τ and 1.
pub const SIN_SERIES: [f32; 3] = [-75.399_025, 81.592_49, -41.341_663];
/// As [`SIN_SERIES`].
pub const COS_SERIES: [f32; 4] = [59.422_474, -85.448_79, 64.939_37, -19.739_208];
/// tan of a sixteenth of a turn.
pub const TAN_SIXTEENTH: f32 = 0.414_213_57;
/// The polynomial of [`atan2_turns`] in the square of the tangent, from the highest power down.
pub const ATAN_SERIES: [f32; 5] =
    [1.271_049_5e-2, -2.204_604_6e-2, 3.179_033_5e-2, -5.305_079_7e-2, 1.591_549_4e-1];

/// e^x as 2^n · (1 + q) with |ln(1 + q)| <= ln(2) / 2: returns `q`, and n in the low nine bits of the second
/// value.
///
/// q is an approximation of (e^r - 1) by r + r² · p(r), p interpolating at Chebyshev nodes; its error before
/// rounding is below 1e-8.
#[inline(always)]
fn reduce(x: f32) -> (f32, u32) {
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * LN_2_HIGH) - n * LN_2_LOW;
    // In pairs rather than term by term: half the wait for one result after another.
    let rr = r * r;
    let [a, b, c, d, e] = EXP_SERIES;
    let high = (c + d * r) + rr * e;
    let p = (a + b * r) + rr * high;
    (r + rr * p, shifted.to_bits())
}

/// e^x with a relative error below 1.2e-7 (under 2 units in the last place).
///
/// 1 exactly at 0; 0 below -87.33, where the result would soon be subnormal; infinite where it exceeds the
/// largest float; NaN for NaN.
#[inline]
pub fn exp(x: f32) -> f32 {
    let (q, n) = reduce(x);
    // Added to the exponent field rather than multiplied: 2^128 is no float, yet e^88.5 is.
    let scaled = f32::from_bits((1.0 + q).to_bits().wrapping_add(n << 23));
    if x < EXP_LOWEST {
        0.0
    } else if x > EXP_HIGHEST {
        f32::INFINITY
    } else if x.is_nan() {
        x
    } else {
        scaled
    }
}

/// 1 - e^(-tau): the share of light that a path of optical depth `tau` takes away. Relative error below 3e-7
/// for every `tau` >= 0, however small, where the plain subtraction would lose all digits.
///
/// The result lies in 0..=1. A negative `tau` counts as 0; NaN stays NaN.
#[inline]
pub fn one_minus_exp_neg(tau: f32) -> f32 {
    let (q, n) = reduce(-tau);
    let scale = f32::from_bits(1.0f32.to_bits().wrapping_add(n << 23));
    let value = (1.0 - scale) - scale * q;
    if tau <= 0.0 {
        0.0
    } else if tau > OPAQUE_DEPTH {
        1.0
    } else if tau.is_nan() {
        tau
    } else {
        value
    }
}

/// The natural logarithm of a normal number above 0, with a relative error below 3e-7. No sense for anything else.
///
/// With `x = 2^e m` and `m` about 1, `ln m` is twice the area tangent of `(m - 1) / (m + 1)`, of which five terms are enough.
#[inline]
pub fn ln(x: f32) -> f32 {
    let bits = x.to_bits() as i32 - ROOT_HALF;
    let exponent = (bits >> 23) as f32;
    let mantissa = f32::from_bits(((bits & 0x007f_ffff) + ROOT_HALF) as u32);
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let s2 = s * s;
    let [a, b, c, d] = LN_SERIES;
    let series = s2 * (a + s2 * (b + s2 * (c + s2 * d)));
    // ln 2 in two parts, of which the first times an exponent is exact.
    exponent * LN_2_HIGH + (2.0 * s + (2.0 * s * series + exponent * LN_2_LOW))
}

/// Sine and cosine, in this order, of an angle given in `turns` (1 is a full circle). Absolute error below
/// 1.5e-7 for |turns| <= 1000; no sense beyond 1e6; NaN for NaN or infinity.
#[inline]
pub fn sin_cos_turns(turns: f32) -> (f32, f32) {
    let shifted = turns * 4.0 + ROUND;
    let quarter = shifted.to_bits();
    // Within an eighth of a turn, and exact: both operands are multiples of the last bit of `turns`.
    let x = turns - (shifted - ROUND) * 0.25;
    let y = x * x;
    let [s, s1, s2] = SIN_SERIES;
    let s = (s * y + s1) * y + s2;
    let sin = x * (s * y + std::f32::consts::TAU);
    let [c, c1, c2, c3] = COS_SERIES;
    let c = ((c * y + c1) * y + c2) * y + c3;
    let cos = c * y + 1.0;
    let (sin, cos) = if quarter & 1 == 0 { (sin, cos) } else { (cos, -sin) };
    if quarter & 2 == 0 { (sin, cos) } else { (-sin, -cos) }
}

/// The angle from the x axis to the point (`x`, `y`) in turns, from -½ to ½. Absolute error below 1e-7, and
/// relative error below 4e-7 for small angles. 0 for the origin; no sense for infinities.
///
/// The arguments stand as in the standard library's `atan2`: y first. The reduced angle is at most a
/// sixteenth of a turn; its odd polynomial is fitted for the least relative error, 2e-8 before rounding.
#[inline]
pub fn atan2_turns(y: f32, x: f32) -> f32 {
    let (across, along) = (y.abs(), x.abs());
    let (least, most) = (across.min(along), across.max(along));
    if most == 0.0 {
        return 0.0;
    }
    // Of the tangent's two forms the one whose quotient is small; neither divides by 0.
    let (offset, z) = if least > TAN_SIXTEENTH * most {
        (0.125, (least - most) / (least + most))
    } else {
        (0.0, least / most)
    };
    let y2 = z * z;
    let p = y2 * ATAN_SERIES[0] + ATAN_SERIES[1];
    let p = p * y2 + ATAN_SERIES[2];
    let p = p * y2 + ATAN_SERIES[3];
    let octant = offset + z * (p * y2 + ATAN_SERIES[4]);
    let quadrant = if across > along { 0.25 - octant } else { octant };
    let half = if x < 0.0 { 0.5 - quadrant } else { quadrant };
    if y < 0.0 { -half } else { half }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(low: f64, high: f64, count: u32) -> impl Iterator<Item = f32> {
        (0..=count).map(move |i| (low + (high - low) * f64::from(i) / f64::from(count)) as f32)
    }

    #[test]
    fn exp_is_within_two_units_in_the_last_place() {
        let near_zero = sweep(-1.0, 1.0, 200_000);
        let tiny = (0..2000).map(|i| f32::from_bits(0x2000_0000 + i * 100_003));
        for x in sweep(-87.33, 88.722, 400_000).chain(near_zero).chain(tiny) {
            let expected = f64::from(x).exp();
            let error = (f64::from(exp(x)) - expected).abs() / expected;
            assert!(error < 1.2e-7, "exp({x}) is {} instead of {expected}: {error:e}", exp(x));
        }
    }

    #[test]
    fn exp_holds_at_its_edges() {
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(exp(-0.0), 1.0);
        assert!(exp(f32::NAN).is_nan() && exp(-f32::NAN).is_nan());
        for x in [-87.34, -88.0, -104.0, -1e9, f32::MIN, f32::NEG_INFINITY] {
            assert_eq!(exp(x), 0.0, "{x}");
        }
        for x in [88.723, 89.0, 1e9, f32::MAX, f32::INFINITY] {
            assert_eq!(exp(x), f32::INFINITY, "{x}");
        }
        // Float by float across both thresholds: a normal number, zero or infinity, never anything between.
        for edge in [87.33f32, 88.722_83] {
            for bits in edge.to_bits() - 3000..edge.to_bits() + 3000 {
                let (low, high) = (exp(-f32::from_bits(bits)), exp(f32::from_bits(bits)));
                assert!(low == 0.0 || low.is_normal(), "exp({}) = {low:e}", -f32::from_bits(bits));
                assert!(high > 8e37, "exp({}) = {high:e}", f32::from_bits(bits));
            }
        }
    }

    #[test]
    fn exp_rises_up_to_a_last_bit() {
        let mut last = 0.0f32;
        for x in sweep(-87.0, 88.0, 300_000) {
            assert!(exp(x) >= last * (1.0 - 1.2e-7), "{x}");
            last = exp(x);
        }
    }

    #[test]
    fn one_minus_exp_neg_keeps_relative_precision() {
        let every_scale = (1..254).flat_map(|e| (0..64).map(move |m| f32::from_bits(e << 23 | m << 17)));
        for tau in every_scale.chain(sweep(1e-6, 20.0, 400_000)) {
            let expected = -f64::exp_m1(-f64::from(tau));
            let value = one_minus_exp_neg(tau);
            let error = (f64::from(value) - expected).abs() / expected;
            assert!(error < 3e-7, "1 - exp(-{tau:e}) is {value} instead of {expected}: {error:e}");
            assert!(value <= 1.0);
        }
        assert_eq!(one_minus_exp_neg(0.0), 0.0);
        assert_eq!(one_minus_exp_neg(-3.0), 0.0);
        assert_eq!(one_minus_exp_neg(f32::INFINITY), 1.0);
        assert!(one_minus_exp_neg(f32::NAN).is_nan());
    }

    #[test]
    fn ln_keeps_relative_precision() {
        let every_scale = (1..254).flat_map(|e| (0..64).map(move |m| f32::from_bits(e << 23 | m << 17)));
        let near_one = (1..20_000).flat_map(|i| [0x3f80_0000 - i, 0x3f80_0000 + i]).map(f32::from_bits);
        for x in every_scale.chain(near_one).chain(sweep(1e-7, 3.0, 400_000)).filter(|x| *x != 1.0) {
            let expected = f64::from(x).ln();
            let error = ((f64::from(ln(x)) - expected) / expected).abs();
            assert!(error < 3e-7, "ln({x:e}) is {} instead of {expected}: {error:e}", ln(x));
        }
        assert_eq!(ln(1.0), 0.0);
    }

    #[test]
    fn sin_cos_turns_follows_the_circle() {
        for turns in sweep(-2.0, 2.0, 300_000).chain(sweep(990.0, 1000.0, 10_000)) {
            let (sin, cos) = sin_cos_turns(turns);
            let (s, c) = (f64::from(turns) * std::f64::consts::TAU).sin_cos();
            let error = (f64::from(sin) - s).abs().max((f64::from(cos) - c).abs());
            assert!(error < 1.5e-7, "at {turns} turns: {sin}, {cos} instead of {s}, {c}");
        }
        assert_eq!(sin_cos_turns(0.25), (1.0, -0.0));
        assert_eq!(sin_cos_turns(0.5), (-0.0, -1.0));
        assert!(sin_cos_turns(f32::INFINITY).0.is_nan());
    }

    #[test]
    fn atan2_turns_undoes_the_circle() {
        for angle in sweep(-0.5, 0.5, 300_000) {
            for radius in [1e-30f64, 0.3, 1.0, 1e30] {
                let (sin, cos) = (f64::from(angle) * std::f64::consts::TAU).sin_cos();
                let (y, x) = ((sin * radius) as f32, (cos * radius) as f32);
                let expected = f64::from(y).atan2(f64::from(x)) / std::f64::consts::TAU;
                // A y that rounds to 0 no longer tells -½ from ½.
                let off = f64::from(atan2_turns(y, x)) - expected;
                let error = (off - off.round()).abs();
                assert!(error < 1e-7, "({x}, {y}) lies at {} instead of {expected}", atan2_turns(y, x));
            }
        }
        for exponent in 1..100 {
            let y = 2.0f32.powi(-exponent);
            let expected = f64::from(y).atan2(1.0) / std::f64::consts::TAU;
            let error = (f64::from(atan2_turns(y, 1.0)) / expected - 1.0).abs();
            assert!(error < 4e-7, "{y:e} gives {}: {error:e}", atan2_turns(y, 1.0));
        }
        assert_eq!(atan2_turns(0.0, 0.0), 0.0);
        assert_eq!(
            [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)].map(|(y, x)| atan2_turns(y, x)),
            [0.0, 0.25, 0.5, -0.25]
        );
    }
}
