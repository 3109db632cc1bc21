//! Light scattered by water droplets, as a narrow lobe and a broad one. What their diameter means for the
//! lobes lives here; the lobes themselves live in the parent module.

use super::{Angle, draine, hg_at, sample_hg_angle};
use crate::math::{exp, ln, sin_cos_turns};

/// The scattering of water droplets of one mean diameter, made ready: a Henyey–Greenstein lobe for the spike
/// ahead, and Draine's for the rest.
///
/// Source: Jendersie and d'Eon, "An Approximate Mie Scattering Function for Fog and Cloud Rendering", ACM
/// SIGGRAPH 2023 Talks, equations 4 to 7; below 5 µm the fits of its supplement. They are fits to Mie's
/// solution, averaged over visible light and over a spread of diameters, without its bows and glories.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mie {
    diameter_um: f32,
    spike_g: f32,
    body_g: f32,
    body_alpha: f32,
    body_weight: f32,
}

impl Mie {
    /// The largest diameter in µm that the fits are made for: drizzle. What lies beyond counts as this.
    pub const MAX_DIAMETER_UM: f32 = 50.0;

    /// Droplets of a mean diameter in micrometres, limited to 0..=[`MAX_DIAMETER_UM`](Self::MAX_DIAMETER_UM),
    /// NaN as 10. Clouds and fog have 5 to 50, haze less; towards 0 it becomes Rayleigh's scattering.
    ///
    /// The fits meet at 0.1, 1.5 and 5 µm up to a step, of which that at 1.5 µm shows.
    pub fn new(diameter_um: f32) -> Self {
        let d = if diameter_um.is_nan() { 10.0 } else { diameter_um.clamp(0.0, Self::MAX_DIAMETER_UM) };
        let [spike_g, body_g, body_alpha, body_weight] = if d >= 5.0 {
            cloud(d)
        } else if d >= 1.5 {
            mist(ln(d))
        } else if d > 0.1 {
            haze(ln(d))
        } else {
            molecules(d)
        };
        Mie { diameter_um: d, spike_g, body_g, body_alpha, body_weight }
    }

    /// The mean diameter in micrometres.
    pub fn diameter_um(&self) -> f32 {
        self.diameter_um
    }

    pub(super) fn lobes(&self) -> [f32; 4] {
        [self.spike_g, self.body_g, self.body_alpha, self.body_weight]
    }

    #[inline]
    pub(super) fn at(&self, angle: Angle) -> f32 {
        let body = draine::at(angle, self.body_g, self.body_alpha);
        (1.0 - self.body_weight) * hg_at(angle, self.spike_g) + self.body_weight * body
    }

    /// One number chooses a lobe, and what is left of it an angle in that.
    #[inline]
    pub(super) fn sample(&self, u: f32) -> Angle {
        if u < self.body_weight {
            draine::sample(self.body_g, self.body_alpha, u / self.body_weight)
        } else {
            sample_hg_angle(self.spike_g, (u - self.body_weight) / (1.0 - self.body_weight))
        }
    }

    pub(super) fn mean_cosine(&self) -> f32 {
        let body = draine::mean_cosine(self.body_g, self.body_alpha);
        (1.0 - self.body_weight) * self.spike_g + self.body_weight * body
    }
}

/// From 5 µm on. Each fit gives the asymmetry of the spike, that of the body, its weight of cos², and the
/// body's share.
fn cloud(d: f32) -> [f32; 4] {
    [
        exp(-0.099_056_7 / (d - 1.671_54)),
        exp(-2.206_79 / (d + 3.910_29) - 0.428_934),
        exp(3.624_89 - 8.292_88 / (d + 5.528_25)),
        exp(-0.599_085 / (d - 0.641_583) - 0.665_888),
    ]
}

/// From 1.5 to 5 µm, of the logarithm of the diameter in µm.
fn mist(log: f32) -> [f32; 4] {
    let log_log = ln(log);
    let (sin, cos) = sin_cos(log);
    // 1 / (tan + rest), which passes through 0 where the tangent has its pole.
    let inverse = cos / (sin + (1.275_51 - 2.0 * log) * cos);
    let swing = sin_cos(5.689_47 * (log_log - 0.029_214_9)).1;
    [
        0.060_493_1 * log_log + 0.940_256,
        0.500_411 - 0.081_287 * inverse,
        7.303_54 * log + 6.316_75,
        0.026_914 * (log - swing) + 0.376_475,
    ]
}

/// From 0.1 to 1.5 µm, of the logarithm of the diameter in µm.
fn haze(log: f32) -> [f32; 4] {
    let swing = sin_cos((log - 0.238_604) * (log + 1.006_67) / (0.507_522 - 0.156_77 * log)).1;
    [
        0.862 - 0.143 * log * log,
        0.379_685 * sin_cos(1.196_92 * swing + 1.379_32 * log + 0.062_583_5).1 + 0.344_213,
        250.0,
        0.146_209 * sin_cos(3.387_07 * log + 2.111_93).1 + 0.316_072 + 0.077_891_7 * log,
    ]
}

/// Up to 0.1 µm.
fn molecules(d: f32) -> [f32; 4] {
    // Below this the powers are as good as 0, and the logarithm still has sense.
    let power = exp(4.3 * ln(d.max(1e-6)));
    [13.8 * d * d, 1.1456 * d * sin_cos(9.290_44 * d).0, 250.0, 0.252_977 - 312.983 * power]
}

/// Sine and cosine of an angle in radians.
fn sin_cos(radians: f32) -> (f32, f32) {
    sin_cos_turns(radians / std::f32::consts::TAU)
}

#[cfg(test)]
mod tests {
    use super::super::Phase;
    use super::*;

    #[test]
    fn parameters_are_those_of_the_paper() {
        let mie = Mie::new(10.0);
        // Computed in double precision from the published formulas.
        let expected = [
            (-0.0990567f64 / (10.0 - 1.67154)).exp(),
            (-2.20679f64 / (10.0 + 3.91029) - 0.428934).exp(),
            (3.62489f64 - 8.29288 / (10.0 + 5.52825)).exp(),
            (-0.599085f64 / (10.0 - 0.641583) - 0.665888).exp(),
        ];
        let ours = [mie.spike_g, mie.body_g, mie.body_alpha, mie.body_weight];
        for (ours, expected) in ours.into_iter().zip(expected) {
            assert!((f64::from(ours) / expected - 1.0).abs() < 1e-6, "{ours} {expected}");
        }
    }

    #[test]
    fn parameters_are_lobes_for_every_diameter() {
        for i in 0..=50_000 {
            let mie = Mie::new(i as f32 * 1e-3);
            let d = mie.diameter_um;
            assert!(mie.body_weight > 0.04 && mie.body_weight < 0.6, "{d} µm: {mie:?}");
            assert!(mie.spike_g >= 0.0 && mie.spike_g < 0.9981, "{d} µm: {mie:?}");
            assert!(mie.body_g > -0.05 && mie.body_g < 0.75, "{d} µm: {mie:?}");
            assert!(mie.body_alpha > 0.0 && mie.body_alpha <= 250.0, "{d} µm: {mie:?}");
        }
        for odd in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -3.0, 1e30, 1e-40] {
            let mie = Mie::new(odd);
            assert!([mie.spike_g, mie.body_g, mie.body_alpha, mie.body_weight].iter().all(|p| p.is_finite()));
        }
    }

    #[test]
    fn fits_nearly_meet() {
        for (edge, tolerance) in [(0.1f32, 0.03), (1.5, 0.04), (5.0, 0.01)] {
            let [below, above] = [edge * 0.9999, edge * 1.0001].map(|d| Phase::mie(d).mean_cosine());
            assert!((below - above).abs() < tolerance, "{edge} µm: {below} {above}");
        }
    }

    #[test]
    fn clouds_scatter_forward_and_molecules_as_rayleigh_found() {
        // Mie's solution for clouds has mean cosines of 0.84 to 0.88.
        for d in [6.0f32, 10.0, 20.0, 40.0] {
            let g = Phase::mie(d).mean_cosine();
            assert!((0.82..0.92).contains(&g), "{d} µm: {g}");
        }
        for cosine in [-1.0f32, -0.5, 0.0, 0.3, 1.0] {
            let rayleigh = 3.0 / (16.0 * std::f32::consts::PI) * (1.0 + cosine * cosine);
            assert!((Phase::mie(0.0).value(cosine) / rayleigh - 1.0).abs() < 0.01, "{cosine}");
        }
    }
}
