//! The phase function: how light that scatters at a point spreads over directions. Values and samples only;
//! how much scatters is the medium's, and where along a ray is the integrator's.
//!
//! Angles are between the direction of travel before and the direction of travel after: cos = 1 goes straight
//! on. Inside, an angle is held as its distances in cosine from both poles (`Angle`), since the lobes of
//! droplets are so narrow that a rounded cosine no longer tells where in them it lies.

mod draine;
mod mie;

pub use draine::{MAX_ALPHA, MAX_STEPS, TOLERANCE};
pub use mie::Mie;

use crate::math::sin_cos_turns;
use glam::Vec3;
use std::f32::consts::PI;

/// The largest magnitude of the asymmetry g; what lies beyond counts as this. At 1 the lobe would be a single
/// ray.
pub const MAX_ASYMMETRY: f32 = 0.999;

/// A phase function with its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Phase {
    /// The Henyey–Greenstein lobe, see [`hg`].
    HenyeyGreenstein {
        /// The mean cosine, limited to ±[`MAX_ASYMMETRY`].
        g: f32,
    },
    /// Draine's lobe: Henyey–Greenstein times 1 + α cos². With g = 0 and α = 1 it is Rayleigh's, with α = 1
    /// that of Cornette and Shanks. Source: Draine, "Scattering by Interstellar Dust Grains. I.",
    /// Astrophysical Journal 598 (2003).
    Draine {
        /// The asymmetry of the Henyey–Greenstein factor, limited to ±[`MAX_ASYMMETRY`]. Not the mean cosine.
        g: f32,
        /// The weight of cos², limited to 0..=[`MAX_ALPHA`].
        alpha: f32,
    },
    /// Water droplets of fog and clouds.
    Mie(Mie),
}

impl Phase {
    /// Water droplets of a diameter in micrometres, see [`Mie::new`].
    pub fn mie(diameter_um: f32) -> Self {
        Phase::Mie(Mie::new(diameter_um))
    }

    /// The value [1/sr] at the cosine of the scattering angle, -1..=1. Integrates to 1 over the sphere. NaN
    /// for NaN.
    #[inline]
    pub fn value(&self, cosine: f32) -> f32 {
        self.at(Angle { ahead: 1.0 - cosine, behind: 1.0 + cosine })
    }

    /// The value [1/sr] between two directions of travel, both of length 1. Where the lobe is narrow this is
    /// more precise than [`value`](Self::value) at their scalar product.
    #[inline]
    pub fn between(&self, before: Vec3, after: Vec3) -> f32 {
        self.at(Angle::between(before, after))
    }

    /// A direction of travel after scattering, of length 1, and the value [1/sr] there, which is also the
    /// density of such directions: samples are distributed exactly as the phase function, so the weight of
    /// each is 1.
    ///
    /// `before` is the direction of travel before, of length 1. `u` are two uniform numbers in 0..=1: for the
    /// angle (for droplets also for the choice of a lobe), and for the turn around `before`.
    #[inline]
    pub fn sample(&self, before: Vec3, u: [f32; 2]) -> (Vec3, f32) {
        let angle = match *self {
            Phase::HenyeyGreenstein { g } => sample_hg_angle(g, u[0]),
            Phase::Draine { g, alpha } => draine::sample(g, alpha, u[0]),
            Phase::Mie(mie) => mie.sample(u[0]),
        };
        (around(before, angle, u[1]), self.at(angle))
    }

    /// The mean cosine of the scattering angle.
    pub fn mean_cosine(&self) -> f32 {
        match *self {
            Phase::HenyeyGreenstein { g } => g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY),
            Phase::Draine { g, alpha } => draine::mean_cosine(g, alpha),
            Phase::Mie(mie) => mie.mean_cosine(),
        }
    }

    /// The same as a Henyey–Greenstein lobe and one of Draine's: the first one's asymmetry, the second one's, its weight
    /// of cos², and its share.
    pub fn lobes(&self) -> [f32; 4] {
        match *self {
            Phase::HenyeyGreenstein { g } => [g, 0.0, 0.0, 0.0],
            Phase::Draine { g, alpha } => [0.0, g, alpha, 1.0],
            Phase::Mie(mie) => mie.lobes(),
        }
    }

    #[inline]
    fn at(&self, angle: Angle) -> f32 {
        match *self {
            Phase::HenyeyGreenstein { g } => hg_at(angle, g),
            Phase::Draine { g, alpha } => draine::at(angle, g, alpha),
            Phase::Mie(mie) => mie.at(angle),
        }
    }
}

/// A scattering angle.
#[derive(Debug, Clone, Copy)]
struct Angle {
    /// 1 - cos.
    ahead: f32,
    /// 1 + cos.
    behind: f32,
}

impl Angle {
    /// The angle between two directions of length 1. An error of their lengths enters with its square only.
    #[inline]
    fn between(before: Vec3, after: Vec3) -> Self {
        Angle {
            ahead: (after - before).length_squared() / 2.0,
            behind: (after + before).length_squared() / 2.0,
        }
    }

    #[inline]
    fn cosine(self) -> f32 {
        (self.behind - self.ahead) / 2.0
    }
}

/// The Henyey–Greenstein phase function [1/sr] at the cosine of the scattering angle, -1..=1.
///
/// `g` is the mean cosine: positive scatters forward, negative backward, 0 evenly. It is limited to
/// ±[`MAX_ASYMMETRY`]. Integrates to 1 over the sphere. NaN for NaN.
///
/// Source: Henyey and Greenstein, "Diffuse radiation in the Galaxy", Astrophysical Journal 93 (1941).
#[inline]
pub fn hg(cos_theta: f32, g: f32) -> f32 {
    hg_at(Angle { ahead: 1.0 - cos_theta, behind: 1.0 + cos_theta }, g)
}

#[inline]
fn hg_at(angle: Angle, g: f32) -> f32 {
    let a = g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY).abs();
    let from_peak = if g < 0.0 { angle.behind } else { angle.ahead };
    // 1 + g² - 2 g cos, arranged so that nothing cancels at the peak of a narrow lobe.
    let squared = (1.0 - a) * (1.0 - a) + 2.0 * a * from_peak;
    (1.0 - a) * (1.0 + a) / (4.0 * PI * squared * squared.sqrt())
}

/// A direction of travel after scattering, distributed exactly as [`hg`] around `direction`, the unit
/// direction of travel before; a unit vector. `u` are two uniform numbers in 0..=1: for the angle (0 back, 1
/// straight on), and for the turn around `direction`.
#[inline]
pub fn sample_hg(direction: Vec3, g: f32, u: [f32; 2]) -> Vec3 {
    around(direction, sample_hg_angle(g, u[0]), u[1])
}

#[inline]
fn sample_hg_angle(g: f32, u: f32) -> Angle {
    // A backward lobe is the forward lobe of the opposite direction.
    let a = g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY).abs();
    if g < 0.0 {
        let behind = hg_from_peak(a, 1.0 - u);
        Angle { ahead: 2.0 - behind, behind }
    } else {
        let ahead = hg_from_peak(a, u);
        Angle { ahead, behind: 2.0 - ahead }
    }
}

/// How far in cosine from the peak of a lobe of asymmetry `a` >= 0 a share `u` of the light lies beyond.
///
/// The usual formula divides by g and subtracts nearly equal numbers; this one is the same distribution
/// solved for 1 - cos, with positive terms only, so it holds for g = 0 and for narrow lobes without cases.
#[inline]
fn hg_from_peak(a: f32, u: f32) -> f32 {
    let ratio = (1.0 - a) / (1.0 - a + 2.0 * a * u);
    2.0 * ratio * ratio * (1.0 - u) * (1.0 + a * u)
}

/// The direction of length 1 at an angle from `direction`, `turns` around it.
#[inline]
fn around(direction: Vec3, angle: Angle, turns: f32) -> Vec3 {
    let sin_theta = (angle.ahead * angle.behind).max(0.0).sqrt();
    let (sin_phi, cos_phi) = sin_cos_turns(turns);
    let (tangent, bitangent) = tangent_frame(direction);
    let across = tangent * (sin_theta * cos_phi) + bitangent * (sin_theta * sin_phi);
    // Paths scatter thousands of times: without this, rounding would let the length drift.
    (direction * (1.0 - angle.ahead) + across).normalize()
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

    fn phases() -> Vec<Phase> {
        let lobes = [0.0f32, 0.6, -0.7, 0.95].map(|g| Phase::HenyeyGreenstein { g });
        let draine = [(0.0f32, 1.0f32), (0.5, 1.0), (0.6, 20.0), (-0.4, 250.0), (0.9, 5.0), (1e-6, 1e9)];
        let draine = draine.map(|(g, alpha)| Phase::Draine { g, alpha });
        let droplets = [0.0f32, 0.05, 0.12, 0.4, 1.0, 2.0, 4.81, 5.0, 10.0, 25.0, 50.0].map(Phase::mie);
        lobes.into_iter().chain(draine).chain(droplets).collect()
    }

    #[test]
    fn every_phase_integrates_to_one_with_its_mean_cosine() {
        for phase in phases() {
            let total = over_sphere(|cos| f64::from(phase.value(cos)));
            let mean = over_sphere(|cos| f64::from(cos) * f64::from(phase.value(cos)));
            assert!((total - 1.0).abs() < 2e-3, "{phase:?} integrates to {total}");
            let expected = f64::from(phase.mean_cosine());
            assert!((mean - expected).abs() < 2e-3, "{phase:?} has mean cosine {mean}, not {expected}");
        }
        let rayleigh = Phase::Draine { g: 0.0, alpha: 1.0 };
        assert!((rayleigh.value(0.5) / (3.0 / (16.0 * PI) * 1.25) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn samples_of_every_phase_follow_it() {
        // Intervals of the angle that shrink towards both poles, where droplets send most of their light.
        let (angles, turns, count) = (24usize, 4usize, 60_000u32);
        let edge = |i: usize| {
            let x = 2.0 * i as f64 / angles as f64 - 1.0;
            (x.signum() * (1.0 - (1.0 - x.abs()).powi(4))).clamp(-1.0, 1.0)
        };
        for (phase, before) in phases().into_iter().zip(directions().skip(2)) {
            let (tangent, bitangent) = tangent_frame(before);
            let mut counts = vec![0u32; angles * turns];
            for i in 0..count {
                let (after, pdf) = phase.sample(before, draw(i));
                assert!((after.length() - 1.0).abs() < 1e-6);
                let again = phase.between(before, after);
                assert!((again / pdf - 1.0).abs() < 5e-3, "{phase:?}: {pdf} and {again}");
                let cos = f64::from(after.dot(before));
                let angle = (1..angles).filter(|&i| cos >= edge(i)).count();
                let turn = (after.dot(bitangent).atan2(after.dot(tangent)) / (2.0 * PI) + 1.0).fract();
                counts[angle * turns + ((turn * turns as f32) as usize).min(turns - 1)] += 1;
            }
            let (mut chi_square, mut freedom) = (0.0f64, -1.0f64);
            for (bin, &n) in counts.iter().enumerate() {
                let (low, high) = (edge(bin / turns), edge(bin / turns + 1));
                let steps = 400;
                let step = (high - low) / f64::from(steps);
                let value = |i| f64::from(phase.value((low + (f64::from(i) + 0.5) * step) as f32));
                let chance = (0..steps).map(value).sum::<f64>() * step * 2.0 * std::f64::consts::PI;
                let expected = chance / turns as f64 * f64::from(count);
                // The narrowest intervals are no wider than steps of a rounded cosine.
                if expected > 5.0 && high - low > 1e-4 {
                    chi_square += (f64::from(n) - expected).powi(2) / expected;
                    freedom += 1.0;
                }
            }
            let excess = (chi_square - freedom) / (2.0 * freedom).sqrt();
            assert!(excess < 4.0, "{phase:?}: {excess} standard deviations");
        }
    }

    #[test]
    fn odd_parameters_and_numbers_stay_finite() {
        let odd = [f32::INFINITY, f32::NEG_INFINITY, -5.0, 5.0, 1e-30];
        for g in odd {
            for alpha in odd {
                for phase in [Phase::HenyeyGreenstein { g }, Phase::Draine { g, alpha }, Phase::mie(alpha)] {
                    for u in
                        [[0.0, 0.0], [1.0, 1.0], [0.5, 0.3], [1.0 - f32::EPSILON / 2.0, 0.9], [1e-7, 0.1]]
                    {
                        let (after, pdf) = phase.sample(Vec3::new(0.6, 0.0, 0.8), u);
                        assert!((after.length() - 1.0).abs() < 1e-6, "{phase:?} {u:?} gives {after}");
                        assert!(pdf.is_finite() && pdf > 0.0, "{phase:?} {u:?}: {pdf}");
                    }
                }
            }
        }
        // What is not a number gives none, and comes to an end.
        let (_, pdf) = Phase::Draine { g: f32::NAN, alpha: f32::NAN }.sample(Vec3::X, [f32::NAN; 2]);
        assert!(pdf.is_nan());
    }
}
