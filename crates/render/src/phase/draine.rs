//! Draine's lobe: its value, and how it is sampled. The Henyey–Greenstein factor in it is the parent
//! module's.

use super::{Angle, MAX_ASYMMETRY, hg_at, sample_hg_angle};

/// The largest weight of cos² in [`Phase::Draine`](super::Phase::Draine); what lies beyond counts as this. By
/// then the lobe hardly differs from that of an infinite weight.
pub const MAX_ALPHA: f32 = 1000.0;

/// A distribution is inverted to this share of the whole, a few steps of a number in 0..=1.
pub const TOLERANCE: f32 = 4e-7;

/// Only a limit: three or four steps are usual.
pub const MAX_STEPS: u32 = 40;

#[inline]
fn limited(g: f32, alpha: f32) -> (f32, f32) {
    (g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY), alpha.clamp(0.0, MAX_ALPHA))
}

/// The mean of 1 + α cos² over the Henyey–Greenstein lobe.
#[inline]
fn norm(g: f32, alpha: f32) -> f32 {
    1.0 + alpha * (1.0 + 2.0 * g * g) / 3.0
}

#[inline]
pub(super) fn at(angle: Angle, g: f32, alpha: f32) -> f32 {
    let (g, alpha) = limited(g, alpha);
    let cosine = angle.cosine();
    hg_at(angle, g) * (1.0 + alpha * cosine * cosine) / norm(g, alpha)
}

pub(super) fn mean_cosine(g: f32, alpha: f32) -> f32 {
    let (g, alpha) = limited(g, alpha);
    g * (1.0 + alpha * (3.0 + 2.0 * g * g) / 5.0) / norm(g, alpha)
}

/// The angle that a share `u` of the light lies behind.
///
/// Over `t`, the share of a Henyey–Greenstein lobe that lies behind, the density is proportional to 1 + α
/// cos². Its integral has a closed form, which Newton's method inverts; the bracket around the root catches
/// the steps that overshoot where cos² is near 0.
#[inline]
pub(super) fn sample(g: f32, alpha: f32, u: f32) -> Angle {
    let (g, alpha) = limited(g, alpha);
    // cos² is the same both ways, so that a backward lobe is the forward lobe of the opposite direction.
    let a = g.abs();
    let u = if g < 0.0 { 1.0 - u } else { u };
    let whole = norm(a, alpha);
    let (mut low, mut high, mut t) = (0.0f32, 1.0f32, u);
    for _ in 0..MAX_STEPS {
        let (integral, cosine) = squared_cosine(a, t);
        let excess = t + alpha * integral - u * whole;
        if excess.abs() <= TOLERANCE * whole {
            break;
        }
        *(if excess > 0.0 { &mut high } else { &mut low }) = t;
        let step = t - excess / (1.0 + alpha * cosine * cosine);
        t = if step > low && step < high { step } else { (low + high) / 2.0 };
    }
    sample_hg_angle(g, if g < 0.0 { 1.0 - t } else { t })
}

/// The integral of cos² from 0 to `t`, and the cosine at `t`.
///
/// With q = 1 - a + 2at and e = 1 + a², the cosine is (2ae t² + 2e(1-a) t - (1-a)²) / q². The integral of its
/// square is t / q³ times a cubic polynomial. No division by `a`, and nothing cancels but for a factor of
/// six.
#[inline]
fn squared_cosine(a: f32, t: f32) -> (f32, f32) {
    let e = 1.0 + a * a;
    let f = e - a;
    let q = 1.0 - a + 2.0 * a * t;
    let (d, s) = ((1.0 - a) / q, t / q);
    let cosine = 2.0 * e * s * (a * s + d) - d * d;
    let cubic = d * (d * (d - 2.0 * f * s) + 4.0 / 3.0 * f * f * s * s) + 2.0 * a * e * e * s * s * s;
    (t * cubic, cosine)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The chance of a cosine below `cos`, by summing the density in double precision.
    fn cumulative(cos: f64, g: f64, alpha: f64) -> f64 {
        let steps = 4000;
        // Over s = √(1 + g² - 2g cos) the density is smooth even for narrow lobes.
        let s = |cos: f64| (1.0 + g * g - 2.0 * g * cos).sqrt();
        let (from, to) = (s(-1.0), s(cos));
        let density = |s: f64| {
            let cos = (1.0 + g * g - s * s) / (2.0 * g);
            (1.0 - g * g) / (2.0 * g * s * s) * (1.0 + alpha * cos * cos)
                / (1.0 + alpha * (1.0 + 2.0 * g * g) / 3.0)
        };
        let ratio = (to / from).powf(1.0 / f64::from(steps));
        // Steps in equal ratios, by Simpson's rule.
        let part = |i: i32| {
            let (low, high) = (from * ratio.powi(i), from * ratio.powi(i + 1));
            (low - high) / 6.0 * (density(low) + 4.0 * density((low + high) / 2.0) + density(high))
        };
        (0..steps).map(part).sum()
    }

    #[test]
    fn samples_invert_the_cumulative_distribution() {
        for g in [-0.95f32, -0.3, 0.001, 0.2, 0.5, 0.65, 0.9, 0.99] {
            for alpha in [0.0f32, 0.5, 1.0, 8.0, 30.0, 250.0, MAX_ALPHA] {
                for i in 0..=40 {
                    let u = i as f32 / 40.0;
                    let angle = sample(g, alpha, u);
                    let cos = 1.0 - f64::from(angle.ahead);
                    let back = cumulative(cos, f64::from(g), f64::from(alpha));
                    // A rounded cosine moves the cumulative distribution by its density.
                    let tolerance =
                        1e-6 + 2.0 * std::f64::consts::PI * f64::from(at(angle, g, alpha)) * 1.5e-7;
                    let error = (back - f64::from(u)).abs();
                    assert!(error < tolerance, "g = {g}, α = {alpha}: {u} gives {cos}, back to {back}");
                }
            }
        }
    }

    #[test]
    fn few_steps_are_enough() {
        // As in `sample`, counted.
        let (mut steps, mut count) = (0u32, 0u32);
        for g in [0.0f32, 0.3, 0.45, 0.6, 0.9] {
            for alpha in [0.0f32, 1.0, 10.0, 30.0, 250.0] {
                for i in 0..=2000 {
                    let u = i as f32 / 2000.0;
                    let whole = norm(g, alpha);
                    let (mut low, mut high, mut t) = (0.0f32, 1.0f32, u);
                    let mut own = 0;
                    loop {
                        let (integral, cosine) = squared_cosine(g, t);
                        let excess = t + alpha * integral - u * whole;
                        if excess.abs() <= TOLERANCE * whole {
                            break;
                        }
                        *(if excess > 0.0 { &mut high } else { &mut low }) = t;
                        let step = t - excess / (1.0 + alpha * cosine * cosine);
                        t = if step > low && step < high { step } else { (low + high) / 2.0 };
                        own += 1;
                        assert!(own < 15, "g = {g}, α = {alpha}, u = {u}");
                    }
                    steps += own;
                    count += 1;
                }
            }
        }
        assert!(steps < 4 * count, "{}", f64::from(steps) / f64::from(count));
    }
}
