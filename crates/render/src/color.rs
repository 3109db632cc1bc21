//! The one place that knows about colour: the sRGB transfer curve, luminance, and the colour of heat.
//! Everything else computes in scene-linear Rec.709 (the primaries and white of sRGB) and never converts by
//! itself.
//!
//! There is no tone mapping here: a picture is clamped, not compressed, when it is written to eight bits.

use crate::math::exp;
use std::sync::LazyLock;

/// Relative luminance (CIE Y) of a linear Rec.709 colour (ITU-R BT.709-6, part 3).
#[inline]
pub fn luminance(rgb: [f32; 3]) -> f32 {
    0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]
}

/// Up to here the curve of sRGB is straight.
pub const SRGB_LINEAR_END: f32 = 0.003_130_8;

/// The slope of that part; beyond it the curve is `SRGB_SCALE × linear ^ (1 / SRGB_GAMMA) − SRGB_OFFSET`.
pub const SRGB_SLOPE: f32 = 12.92;
/// See [`SRGB_SLOPE`].
pub const SRGB_SCALE: f32 = 1.055;
/// See [`SRGB_SLOPE`].
pub const SRGB_OFFSET: f32 = 0.055;
/// See [`SRGB_SLOPE`].
pub const SRGB_GAMMA: f32 = 2.4;

/// The sRGB encoding of a linear component (IEC 61966-2-1). Does not clamp: negative values continue the
/// straight part at the foot, values above 1 the curve.
#[inline]
pub fn linear_to_srgb(linear: f32) -> f32 {
    match linear <= SRGB_LINEAR_END {
        true => SRGB_SLOPE * linear,
        false => SRGB_SCALE * linear.powf(1.0 / SRGB_GAMMA) - SRGB_OFFSET,
    }
}

/// The linear component of an sRGB encoded one (IEC 61966-2-1): undoes [`linear_to_srgb`].
#[inline]
pub fn srgb_to_linear(encoded: f32) -> f32 {
    match encoded <= 0.040_45 {
        true => encoded / SRGB_SLOPE,
        false => ((encoded + SRGB_OFFSET) / SRGB_SCALE).powf(SRGB_GAMMA),
    }
}

/// The nearest eight-bit sRGB code of a linear component; clamps to 0..=255. NaN gives 0.
///
/// Found by comparison with the linear values halfway between codes, not by computing a power per value, so
/// that a platform's `powf` hardly has a say in what is written to a file.
#[inline]
pub fn linear_to_srgb8(linear: f32) -> u8 {
    static HALFWAY: LazyLock<[f32; 255]> = LazyLock::new(|| {
        std::array::from_fn(|code| {
            let encoded = (code as f64 + 0.5) / 255.0;
            let linear =
                if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) };
            linear as f32
        })
    });
    // At most 255 thresholds, so the count fits.
    HALFWAY.partition_point(|&halfway| halfway <= linear) as u8
}

/// Spectral radiance of a black body [W / (m² sr m)] by Planck's law, with the exact constants of the SI
/// (2019).
///
/// `wavelength_m` in metres, `kelvin` the temperature. 0 unless both are positive.
pub fn planck(wavelength_m: f64, kelvin: f64) -> f64 {
    const PLANCK: f64 = 6.626_070_15e-34;
    const LIGHT_SPEED: f64 = 299_792_458.0;
    const BOLTZMANN: f64 = 1.380_649e-23;
    if !(wavelength_m > 0.0 && kelvin > 0.0) {
        return 0.0;
    }
    let quanta = PLANCK * LIGHT_SPEED / (wavelength_m * BOLTZMANN * kelvin);
    2.0 * PLANCK * LIGHT_SPEED * LIGHT_SPEED / (wavelength_m.powi(5) * quanta.exp_m1())
}

/// The CIE 1931 2° colour matching functions x̄, ȳ, z̄ at a wavelength in nanometres.
///
/// Sums of Gaussians with a different width on either side, within about 1 % of the tables. Source: Wyman,
/// Sloan and Shirley, "Simple Analytic Approximations to the CIE XYZ Color Matching Functions", Journal of
/// Computer Graphics Techniques 2(2), 2013, the multi-lobe fit.
fn matching_functions(nanometres: f64) -> [f64; 3] {
    let lobe = |height: f64, peak: f64, left: f64, right: f64| {
        let t = (nanometres - peak) / if nanometres < peak { left } else { right };
        height * (-0.5 * t * t).exp()
    };
    [
        lobe(1.056, 599.8, 37.9, 31.0) + lobe(0.362, 442.0, 16.0, 26.7) + lobe(-0.065, 501.1, 20.4, 26.2),
        lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1),
        lobe(1.217, 437.0, 11.8, 36.0) + lobe(0.681, 459.0, 26.0, 13.8),
    ]
}

/// CIE XYZ of a black body, up to a common factor: 5 nm steps over the visible range, where the integrand is
/// smooth and vanishes at both ends.
fn blackbody_xyz(kelvin: f64) -> [f64; 3] {
    let mut xyz = [0.0; 3];
    for step in 0..=94 {
        let nanometres = 360.0 + 5.0 * f64::from(step);
        let radiance = planck(nanometres * 1e-9, kelvin);
        for (sum, matching) in xyz.iter_mut().zip(matching_functions(nanometres)) {
            *sum += radiance * matching;
        }
    }
    xyz
}

/// Linear Rec.709 from CIE XYZ with the D65 white (IEC 61966-2-1).
fn rgb_from_xyz([x, y, z]: [f64; 3]) -> [f64; 3] {
    [
        3.240_969_9 * x - 1.537_383_2 * y - 0.498_610_8 * z,
        -0.969_243_6 * x + 1.875_967_5 * y + 0.041_555_1 * z,
        0.055_630_1 * x - 0.203_977_0 * y + 1.056_971_5 * z,
    ]
}

/// The colour and brightness of glowing matter over temperature, relative to a reference temperature whose
/// luminance is 1. A table, so that one look-up per sample along a ray is cheap.
#[derive(Clone, Debug, PartialEq)]
pub struct Blackbody {
    /// Colour of luminance 1, and the natural logarithm of the relative luminance, at equal steps of the
    /// reciprocal temperature from hot to cold. Over the reciprocal the logarithm is nearly straight (Wien's
    /// law), so that a linear interpolation of it is within 0.1 %.
    table: Vec<[f32; 4]>,
}

impl Blackbody {
    /// At and below this temperature, in kelvin, nothing glows: [`radiance`](Self::radiance) is 0.
    pub const COLDEST_KELVIN: f32 = 500.0;
    /// Above this temperature, in kelvin, the radiance stays what it is here.
    pub const HOTTEST_KELVIN: f32 = 50_000.0;
    /// The steps of the table.
    pub const STEPS: usize = 1024;

    /// The table in which `reference_kelvin` has luminance 1. A reference outside of
    /// [`COLDEST_KELVIN`](Self::COLDEST_KELVIN)..=[`HOTTEST_KELVIN`](Self::HOTTEST_KELVIN) counts as the
    /// nearer end, NaN as the hot one.
    pub fn new(reference_kelvin: f32) -> Self {
        let reference = if reference_kelvin.is_nan() { Self::HOTTEST_KELVIN } else { reference_kelvin };
        let reference = reference.clamp(Self::COLDEST_KELVIN, Self::HOTTEST_KELVIN);
        let reference_y = blackbody_xyz(f64::from(reference))[1];
        let hot = 1.0 / f64::from(Self::HOTTEST_KELVIN);
        let cold = 1.0 / f64::from(Self::COLDEST_KELVIN);
        let entry = |step: usize| {
            let xyz = blackbody_xyz(1.0 / (hot + (cold - hot) * step as f64 / Self::STEPS as f64));
            let rgb = rgb_from_xyz(xyz).map(|component| (component / xyz[1]).max(0.0) as f32);
            let clamped = luminance(rgb);
            let brightness = (xyz[1] / reference_y).ln() as f32;
            [rgb[0] / clamped, rgb[1] / clamped, rgb[2] / clamped, brightness]
        };
        Self { table: (0..=Self::STEPS).map(entry).collect() }
    }

    /// The table: colour of luminance 1, and the natural logarithm of the luminance, at equal steps of the reciprocal
    /// temperature from the hottest to the coldest.
    pub fn table(&self) -> &[[f32; 4]] {
        &self.table
    }

    /// Radiance at a temperature as linear Rec.709, relative to the reference: Planck's law seen through the
    /// CIE 1931 observer.
    ///
    /// Below about 1900 K the true colour lies outside of Rec.709. Its negative components are set to 0 and
    /// the rest scaled so that the luminance is kept. Luminance rises with temperature throughout. 0 at and
    /// below [`COLDEST_KELVIN`](Self::COLDEST_KELVIN) and for NaN; constant above
    /// [`HOTTEST_KELVIN`](Self::HOTTEST_KELVIN).
    #[inline]
    pub fn radiance(&self, kelvin: f32) -> [f32; 3] {
        const HOT: f32 = 1.0 / Blackbody::HOTTEST_KELVIN;
        const COLD: f32 = 1.0 / Blackbody::COLDEST_KELVIN;
        if kelvin.is_nan() || kelvin <= Self::COLDEST_KELVIN {
            return [0.0; 3];
        }
        let position = (1.0 / kelvin - HOT).max(0.0) * (Self::STEPS as f32 / (COLD - HOT));
        let index = (position as usize).min(Self::STEPS - 1);
        let t = position - index as f32;
        let Some([a, b]) = self.table.get(index..index + 2).and_then(|pair| <&[_; 2]>::try_from(pair).ok())
        else {
            return [0.0; 3];
        };
        let lerp = |i: usize| a[i] + (b[i] - a[i]) * t;
        let brightness = exp(lerp(3));
        [lerp(0) * brightness, lerp(1) * brightness, lerp(2) * brightness]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transfer_curves_undo_each_other() {
        for i in 0..=10_000 {
            let x = i as f32 / 10_000.0;
            assert!((srgb_to_linear(linear_to_srgb(x)) - x).abs() < 1e-6, "{x}");
            assert!((linear_to_srgb(srgb_to_linear(x)) - x).abs() < 1e-5, "{x}");
        }
        assert!((linear_to_srgb(0.214_041_14) - 0.5).abs() < 1e-6);
        assert!((linear_to_srgb(1.0) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn eight_bit_codes_are_the_rounded_curve() {
        for i in 0..=100_000 {
            let linear = i as f32 / 100_000.0;
            let exact = f64::from(linear_to_srgb(linear)) * 255.0;
            assert!((f64::from(linear_to_srgb8(linear)) - exact).abs() < 0.5 + 1e-4, "{linear}");
        }
        for code in 0..=255u8 {
            assert_eq!(linear_to_srgb8(srgb_to_linear(f32::from(code) / 255.0)), code);
        }
        let edges = [f32::NEG_INFINITY, -1.0, f32::NAN, 1.0, 7.0, f32::INFINITY];
        assert_eq!(edges.map(linear_to_srgb8), [0, 0, 0, 255, 255, 255]);
    }

    #[test]
    fn planck_matches_the_laws_it_implies() {
        // Stefan-Boltzmann: the integral over all wavelengths is sigma T^4 / pi.
        let kelvin = 3000.0f64;
        let (low, high, steps) = (1e-7f64.ln(), 1e-2f64.ln(), 20_000);
        let step = (high - low) / f64::from(steps);
        let total: f64 = (0..steps)
            .map(|i| (low + (f64::from(i) + 0.5) * step).exp())
            .map(|wavelength| planck(wavelength, kelvin) * wavelength * step)
            .sum();
        let expected = 5.670_374_419e-8 * kelvin.powi(4) / std::f64::consts::PI;
        assert!((total / expected - 1.0).abs() < 1e-5);
        // Wien: the peak lies at 2.897771955e-3 m K / T.
        let peak = 2.897_771_955e-3 / kelvin;
        assert!(planck(peak, kelvin) > planck(peak * 1.001, kelvin));
        assert!(planck(peak, kelvin) > planck(peak * 0.999, kelvin));
        for (wavelength, kelvin) in [(0.0, 1000.0), (5e-7, 0.0), (5e-7, f64::NAN), (-1.0, 5.0)] {
            assert_eq!(planck(wavelength, kelvin), 0.0);
        }
    }

    /// Chromaticity of the Planckian locus from CIE 15:2004, table T.1 and illuminant A.
    #[test]
    fn chromaticity_follows_the_planckian_locus() {
        let published = [
            (2000.0, 0.5267, 0.4133),
            (2856.0, 0.4476, 0.4074),
            (5000.0, 0.3451, 0.3516),
            (6504.0, 0.3135, 0.3237),
        ];
        for (kelvin, x, y) in published {
            let xyz = blackbody_xyz(kelvin);
            let sum: f64 = xyz.iter().sum();
            let (got_x, got_y) = (xyz[0] / sum, xyz[1] / sum);
            assert!((got_x - x).abs() < 0.005 && (got_y - y).abs() < 0.005, "{kelvin} K: {got_x}, {got_y}");
            // The same through the table and back from linear Rec.709.
            let [r, g, b] = Blackbody::new(3000.0).radiance(kelvin as f32).map(f64::from);
            let back = [
                0.412_390_8 * r + 0.357_584_3 * g + 0.180_480_8 * b,
                0.212_639_0 * r + 0.715_168_7 * g + 0.072_192_3 * b,
                0.019_330_8 * r + 0.119_194_8 * g + 0.950_532_2 * b,
            ];
            let sum: f64 = back.iter().sum();
            assert!(
                (back[0] / sum - x).abs() < 0.01 && (back[1] / sum - y).abs() < 0.01,
                "{kelvin} K: {back:?}"
            );
        }
    }

    #[test]
    fn rgb_conversion_keeps_white_and_luminance() {
        let white = rgb_from_xyz([0.950_456, 1.0, 1.089_058]);
        assert!(white.iter().all(|c| (c - 1.0).abs() < 2e-4), "{white:?}");
        let rgb = rgb_from_xyz([0.2, 0.3, 0.25]).map(|c| c as f32);
        assert!((luminance(rgb) - 0.3).abs() < 1e-4);
    }

    #[test]
    fn luminance_is_one_at_the_reference() {
        for reference in [600.0f32, 1000.0, 1500.0, 2856.0, 6504.0, 20_000.0, 50_000.0] {
            let y = luminance(Blackbody::new(reference).radiance(reference));
            assert!((y - 1.0).abs() < 1e-3, "{reference} K: {y}");
        }
    }

    #[test]
    fn luminance_ratios_match_direct_integration() {
        let direct = |kelvin: f64| -> f64 {
            let at = |i: i32| 380.0 + 0.25 * f64::from(i);
            (0..1600).map(|i| planck(at(i) * 1e-9, kelvin) * matching_functions(at(i))[1]).sum()
        };
        let table = Blackbody::new(1500.0);
        for (a, b) in
            [(800.0f32, 1000.0f32), (1000.0, 1500.0), (1234.5, 3210.0), (2000.0, 8000.0), (9e3, 3e4)]
        {
            let got = f64::from(luminance(table.radiance(b)) / luminance(table.radiance(a)));
            let expected = direct(f64::from(b)) / direct(f64::from(a));
            assert!((got / expected - 1.0).abs() < 2e-3, "{a} K to {b} K: {got} instead of {expected}");
        }
    }

    #[test]
    fn radiance_is_finite_never_negative_and_rises() {
        for reference in [500.0, 1500.0, 50_000.0, f32::NAN, f32::INFINITY, -3.0] {
            let table = Blackbody::new(reference);
            let mut last = 0.0;
            for i in 0..5200 {
                let kelvin = 10.0 * i as f32 + 0.5;
                let rgb = table.radiance(kelvin);
                assert!(rgb.iter().all(|c| c.is_finite() && *c >= 0.0), "{kelvin} K: {rgb:?}");
                let y = luminance(rgb);
                assert!(y > last || !(500.0..50_000.0).contains(&kelvin), "{kelvin} K: {y} after {last}");
                last = y;
            }
            assert_eq!(table.radiance(f32::INFINITY), table.radiance(50_000.0));
            for dark in [500.0, 0.0, -1.0, f32::NEG_INFINITY, f32::NAN] {
                assert_eq!(table.radiance(dark), [0.0; 3]);
            }
        }
    }

    #[test]
    fn embers_are_red_and_hot_stars_blue() {
        let table = Blackbody::new(1500.0);
        let [r, g, b] = table.radiance(1000.0);
        assert!(r > 3.0 * g && g > b && b == 0.0);
        let [r, g, b] = table.radiance(20_000.0);
        assert!(b > g && g > r);
    }
}
