//! The phase function: how light that scatters at a point spreads over directions. Values and samples only;
//! how much scatters is the medium's, and where along a ray is the integrator's.
//!
//! Angles are between the direction of travel before and the direction of travel after: cos = 1 goes straight
//! on.

use crate::math::sin_cos_turns;
use glam::Vec3;
use std::f32::consts::PI;

/// The largest magnitude of the asymmetry g; what lies beyond counts as this. At 1 the lobe would be a single
/// ray.
pub const MAX_ASYMMETRY: f32 = 0.999;

/// The Henyey–Greenstein phase function [1/sr] at the cosine of the scattering angle, -1..=1.
///
/// `g` is the mean cosine: positive scatters forward, negative backward, 0 evenly. It is limited to
/// ±[`MAX_ASYMMETRY`]. Integrates to 1 over the sphere. NaN for NaN.
///
/// Source: Henyey and Greenstein, "Diffuse radiation in the Galaxy", Astrophysical Journal 93 (1941).
#[inline]
pub fn hg(cos_theta: f32, g: f32) -> f32 {
    let a = g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY).abs();
    let from_peak = 1.0 - if g < 0.0 { -cos_theta } else { cos_theta };
    // 1 + g² - 2 g cos, arranged so that nothing cancels at the peak of a narrow lobe.
    let squared = (1.0 - a) * (1.0 - a) + 2.0 * a * from_peak;
    (1.0 - a) * (1.0 + a) / (4.0 * PI * squared * squared.sqrt())
}

/// A direction of travel after scattering, distributed exactly as [`hg`] around `direction`, the unit
/// direction of travel before; a unit vector. `u` are two uniform numbers in 0..=1: for the angle (0 back, 1
/// straight on, where g > 0), and for the turn around `direction`.
///
/// The angle inverts the cumulative distribution. The usual formula divides by g and subtracts nearly equal
/// numbers; this one is the same distribution solved for 1 - cos, with positive terms only, so it holds for g
/// = 0 and for narrow lobes without cases.
#[inline]
pub fn sample_hg(direction: Vec3, g: f32, u: [f32; 2]) -> Vec3 {
    let a = g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY).abs();
    // A backward lobe is the forward lobe of the opposite direction.
    let (axis, u0) = if g < 0.0 { (-direction, 1.0 - u[0]) } else { (direction, u[0]) };
    let ratio = (1.0 - a) / (1.0 - a + 2.0 * a * u0);
    let from_peak = 2.0 * ratio * ratio * (1.0 - u0) * (1.0 + a * u0);
    let sin_theta = (from_peak * (2.0 - from_peak)).max(0.0).sqrt();
    let (sin_phi, cos_phi) = sin_cos_turns(u[1]);
    let (tangent, bitangent) = tangent_frame(axis);
    let across = tangent * (sin_theta * cos_phi) + bitangent * (sin_theta * sin_phi);
    // Paths scatter thousands of times: without this, rounding would let the length drift.
    (axis * (1.0 - from_peak) + across).normalize()
}

/// Two unit vectors that form a right-handed orthonormal frame with the unit vector `axis` as third.
///
/// Source: Duff et al., "Building an Orthonormal Basis, Revisited", Journal of Computer Graphics Techniques
/// 6(1), 2017. No branch, and no axis at which it loses precision.
#[inline]
pub fn tangent_frame(axis: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0f32.copysign(axis.z);
    let k = -1.0 / (sign + axis.z);
    let xy = axis.x * axis.y * k;
    let tangent = Vec3::new(1.0 + sign * axis.x * axis.x * k, sign * xy, -sign * axis.x);
    let bitangent = Vec3::new(xy, sign + axis.y * axis.y * k, -axis.y);
    (tangent, bitangent)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_pixel, unit_f32};

    const ASYMMETRIES: [f32; 11] = [-0.999, -0.95, -0.6, -0.1, -1e-4, 0.0, 1e-6, 0.3, 0.85, 0.99, 0.999];

    /// The integral of `f(cos)` over the sphere by trapezia, whose corners crowd towards both poles as far as
    /// cosines can still be told apart.
    fn over_sphere(f: impl Fn(f32) -> f64) -> f64 {
        let steps = 20_000;
        let away = |i: u32| (1e-8f64.ln() * f64::from(i) / f64::from(steps)).exp();
        let from_pole = (0..=steps).map(|i| (1.0 - away(i)) as f32);
        let cosines: Vec<f32> = from_pole.clone().rev().map(|cos| -cos).chain(from_pole).collect();
        let trapezium = |w: &[f32]| (f(w[0]) + f(w[1])) / 2.0 * (f64::from(w[1]) - f64::from(w[0]));
        2.0 * std::f64::consts::PI * cosines.windows(2).map(trapezium).sum::<f64>()
    }

    /// The chance of a cosine below `cos`, in double precision, from the antiderivative of the phase
    /// function.
    fn cumulative(cos: f64, g: f64) -> f64 {
        if g.abs() < 1e-3 {
            return (1.0 + cos) / 2.0 + 0.75 * g * (cos * cos - 1.0);
        }
        (1.0 - g * g) / (2.0 * g) * (1.0 / (1.0 + g * g - 2.0 * g * cos).sqrt() - 1.0 / (1.0 + g))
    }

    fn draw(i: u32) -> [f32; 2] {
        [unit_f32(hash_pixel(1, 2, i, 0)), unit_f32(hash_pixel(1, 2, i, 1))]
    }

    fn directions() -> impl Iterator<Item = Vec3> {
        let axes = [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
        let nearly_down =
            [Vec3::new(1e-4, -1e-5, -1.0), Vec3::new(1e-20, 0.0, -1.0), Vec3::new(1.0, 1.0, -0.0)];
        let random = (0..200).map(|i| sample_hg(Vec3::Z, 0.0, draw(i)));
        axes.into_iter().chain(nearly_down.map(Vec3::normalize)).chain(random)
    }

    #[test]
    fn integrates_to_one_with_mean_cosine_g() {
        for g in ASYMMETRIES {
            let total = over_sphere(|cos| f64::from(hg(cos, g)));
            let mean = over_sphere(|cos| f64::from(cos) * f64::from(hg(cos, g)));
            assert!((total - 1.0).abs() < 2e-3, "g = {g} integrates to {total}");
            assert!((mean - f64::from(g)).abs() < 2e-3, "g = {g} has mean cosine {mean}");
        }
    }

    #[test]
    fn zero_is_isotropic_and_the_limits_are_finite() {
        assert!((hg(0.3, 0.0) - 1.0 / (4.0 * PI)).abs() < 1e-8);
        assert_eq!(hg(1.0, 5.0), hg(1.0, MAX_ASYMMETRY));
        assert_eq!(hg(-1.0, -1.0), hg(1.0, 1.0));
        assert!(hg(1.0, 1.0).is_finite() && hg(-1.0, 1.0) > 0.0);
        assert!(hg(0.5, f32::NAN).is_nan());
    }

    #[test]
    fn samples_invert_the_cumulative_distribution() {
        for g in ASYMMETRIES {
            for i in 0..=1000 {
                let u = i as f32 / 1000.0;
                let cos = f64::from(sample_hg(Vec3::Z, g, [u, 0.37]).z);
                // A rounded cosine moves the cumulative distribution by its density.
                let tolerance = 2e-6 + 2.0 * std::f64::consts::PI * f64::from(hg(cos as f32, g)) * 1.5e-7;
                let back = cumulative(cos, f64::from(g));
                assert!((back - f64::from(u)).abs() < tolerance, "g = {g}: {u} gives {cos}, back to {back}");
            }
        }
    }

    #[test]
    fn samples_follow_the_density_over_angle_and_turn() {
        let (angles, turns, count) = (16usize, 8usize, 60_000u32);
        for (g, axis) in ASYMMETRIES.into_iter().zip(directions()) {
            if g.abs() > 0.95 {
                continue;
            }
            let (tangent, bitangent) = tangent_frame(axis);
            let mut counts = vec![0u32; angles * turns];
            for i in 0..count {
                let out = sample_hg(axis, g, draw(i));
                let angle = (out.dot(axis) + 1.0) / 2.0 * angles as f32;
                let turn =
                    (out.dot(bitangent).atan2(out.dot(tangent)) / (2.0 * PI) + 1.0).fract() * turns as f32;
                counts[(angle as usize).min(angles - 1) * turns + (turn as usize).min(turns - 1)] += 1;
            }
            let (mut chi_square, mut freedom) = (0.0f64, -1.0f64);
            for (bin, &n) in counts.iter().enumerate() {
                let edge = |k: usize| -1.0 + 2.0 * k as f64 / angles as f64;
                let chance = over_interval(edge(bin / turns), edge(bin / turns + 1), g) / turns as f64;
                let expected = chance * f64::from(count);
                chi_square += (f64::from(n) - expected).powi(2) / expected;
                freedom += 1.0;
            }
            let excess = (chi_square - freedom) / (2.0 * freedom).sqrt();
            assert!(excess < 4.0, "g = {g}: {excess} standard deviations");
        }
    }

    /// The chance of a cosine in an interval, by summing the density.
    fn over_interval(low: f64, high: f64, g: f32) -> f64 {
        let steps = 2000;
        let step = (high - low) / f64::from(steps);
        let density = |i| f64::from(hg((low + (f64::from(i) + 0.5) * step) as f32, g));
        (0..steps).map(density).sum::<f64>() * step * 2.0 * std::f64::consts::PI
    }

    #[test]
    fn mean_direction_is_g_times_the_axis() {
        for g in ASYMMETRIES {
            let axis = Vec3::new(0.3, -0.5, -0.8).normalize();
            let count = 40_000;
            let mean = (0..count).map(|i| sample_hg(axis, g, draw(i)).as_dvec3()).sum::<glam::DVec3>();
            let off = mean / f64::from(count) - axis.as_dvec3() * f64::from(g);
            assert!(off.length() < 4.0 / f64::from(count).sqrt(), "g = {g}: off by {off}");
        }
    }

    #[test]
    fn samples_are_unit_vectors_from_every_direction() {
        for axis in directions() {
            for g in ASYMMETRIES {
                for u in [[0.0, 0.0], [1.0, 1.0], [0.5, 0.25], [1.0 - f32::EPSILON / 2.0, 0.9], [1e-7, 0.1]] {
                    let out = sample_hg(axis, g, u);
                    assert!((out.length() - 1.0).abs() < 1e-6, "{axis} {g} {u:?} gives {out}");
                }
            }
        }
    }

    #[test]
    fn frames_are_orthonormal_and_right_handed() {
        for axis in directions() {
            let (t, b) = tangent_frame(axis);
            let worst = [t.dot(b), t.dot(axis), b.dot(axis), t.length() - 1.0, b.length() - 1.0];
            assert!(worst.iter().all(|e| e.abs() < 1e-6), "{axis}: {worst:?}");
            assert!(t.cross(b).dot(axis) > 0.999, "{axis}");
        }
    }
}
