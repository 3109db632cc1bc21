//! Lights: the sun, points, spots, spheres and the sky. What arrives of them at a point in clear air, and directions
//! towards them.
//!
//! Units: radiance is light per area and solid angle, irradiance per area that faces the light, intensity per solid
//! angle; all are scene-linear Rec.709 and differ by lengths of the world only. Lights cast no shadows on each other, and no
//! light is seen by the camera but that of the sky.
//!
//! What does not live here: what a medium takes away on the way ([`crate::path`]).

use std::f32::consts::PI;
use std::sync::Arc;

use glam::{DVec2, DVec3, Vec3};

use crate::camera::Camera;
use crate::envmap::EnvironmentMap;
use crate::math::sin_cos_turns;
use crate::phase::tangent_frame;

/// A light with a place or a direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Light {
    /// A disc infinitely far away.
    Sun(Sun),
    /// A point that shines alike in all directions.
    Point {
        /// Where it is.
        position: DVec3,
        /// Intensity; the power is 4π times as much.
        intensity: [f32; 3],
    },
    /// A point that shines into a cone.
    Spot(Spot),
    /// The outside of a sphere, every point of which shines alike in all directions.
    Sphere {
        /// Its centre.
        centre: DVec3,
        /// Its radius.
        radius: f64,
        /// Radiance; the power is 4π² × radius² times as much.
        radiance: [f32; 3],
    },
}

/// A disc of even radiance infinitely far away.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sun {
    /// The direction towards its centre, of length 1.
    pub direction_to: Vec3,
    /// Irradiance on a surface that faces its centre.
    pub irradiance: [f32; 3],
    /// Its angular diameter in degrees, less than 180; 0 is a point.
    pub angle_degrees: f32,
}

impl Sun {
    /// A sun without extent.
    pub fn point(direction_to: Vec3, irradiance: [f32; 3]) -> Self {
        Sun { direction_to, irradiance, angle_degrees: 0.0 }
    }
}

/// A point that shines into a cone: all of its intensity up to the inner angle, none from the outer angle on, and a cubic
/// without kinks in the cosine between.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// Where it is.
    pub position: DVec3,
    /// Where it shines, of length 1.
    pub direction: Vec3,
    /// Intensity along the axis.
    pub intensity: [f32; 3],
    /// Half the angle of full intensity, in degrees.
    pub inner_degrees: f32,
    /// Half the angle of the cone, in degrees.
    pub outer_degrees: f32,
}

/// What arrives of a light at a point in clear air.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Arriving {
    /// Nothing.
    Nothing,
    /// Light from one direction.
    Ray {
        /// The direction towards the light, of length 1.
        direction: DVec3,
        /// How far the light is away; infinite for a sun.
        distance: f64,
        /// Irradiance on a surface that faces the light.
        irradiance: Vec3,
    },
    /// Light from all directions of a cone.
    Cone {
        /// The cone.
        cone: Cone,
        /// Radiance, the same from each direction.
        radiance: Vec3,
    },
}

/// Directions around an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cone {
    /// The axis, of length 1.
    pub axis: Vec3,
    /// 1 − the cosine of half its angle: exact for narrow cones too.
    pub spread: f32,
}

impl Cone {
    /// Its solid angle.
    pub fn solid_angle(self) -> f32 {
        2.0 * PI * self.spread
    }

    /// Whether a direction of length 1 lies inside.
    pub fn contains(self, direction: Vec3) -> bool {
        // |a − b|² = 2 (1 − cos): nothing cancels.
        (direction - self.axis).length_squared() <= 2.0 * self.spread
    }

    /// A direction inside, all alike, from two uniform numbers.
    pub fn sample(self, u: [f32; 2]) -> Vec3 {
        let from_axis = u[0] * self.spread;
        let sin = (from_axis * (2.0 - from_axis)).max(0.0).sqrt();
        let (sin_phi, cos_phi) = sin_cos_turns(u[1]);
        let (tangent, bitangent) = tangent_frame(self.axis);
        let across = tangent * (sin * cos_phi) + bitangent * (sin * sin_phi);
        (self.axis * (1.0 - from_axis) + across).normalize()
    }
}

/// 1 − cos of an angle whose sine is given in square.
fn spread(sin_squared: f64) -> f64 {
    sin_squared / (1.0 + (1.0 - sin_squared).max(0.0).sqrt())
}

impl Light {
    /// What arrives of it at a point.
    #[inline]
    pub fn arriving(&self, at: DVec3) -> Arriving {
        let from_point = |position: DVec3, intensity: Vec3| {
            let offset = position - at;
            let squared = offset.length_squared();
            let (direction, irradiance) = (offset / squared.sqrt(), intensity / squared as f32);
            match direction.is_finite() && irradiance.is_finite() {
                true => Arriving::Ray { direction, distance: squared.sqrt(), irradiance },
                false => Arriving::Nothing,
            }
        };
        match self {
            Light::Sun(sun) if sun.angle_degrees <= 0.0 => Arriving::Ray {
                direction: sun.direction_to.as_dvec3(),
                distance: f64::INFINITY,
                irradiance: Vec3::from_array(sun.irradiance),
            },
            Light::Sun(sun) => {
                let half = f64::from(sun.angle_degrees).min(180.0).to_radians() / 2.0;
                let sin_squared = half.sin().powi(2);
                let cone = Cone { axis: sun.direction_to, spread: spread(sin_squared) as f32 };
                // What an even disc sends to a surface that faces it.
                let area = PI * sin_squared as f32;
                Arriving::Cone { cone, radiance: Vec3::from_array(sun.irradiance) / area }
            }
            Light::Point { position, intensity } => from_point(*position, Vec3::from_array(*intensity)),
            Light::Spot(spot) => {
                let towards = (at - spot.position).normalize_or_zero().as_vec3();
                let part = spot.part(towards.dot(spot.direction));
                match part > 0.0 {
                    true => from_point(spot.position, Vec3::from_array(spot.intensity) * part),
                    false => Arriving::Nothing,
                }
            }
            Light::Sphere { centre, radius, radiance } => {
                let offset = *centre - at;
                let sin_squared = radius * radius / offset.length_squared();
                // Its inside is dark.
                if sin_squared.is_nan() || sin_squared >= 1.0 || sin_squared <= 0.0 {
                    return Arriving::Nothing;
                }
                let cone = Cone { axis: offset.normalize().as_vec3(), spread: spread(sin_squared) as f32 };
                Arriving::Cone { cone, radiance: Vec3::from_array(*radiance) }
            }
        }
    }

    /// How far a ray from a point goes until it meets the light, for directions of the cone.
    pub fn distance(&self, at: DVec3, direction: DVec3) -> f64 {
        match self {
            Light::Sun(_) => f64::INFINITY,
            Light::Point { position, .. } => position.distance(at),
            Light::Spot(spot) => spot.position.distance(at),
            Light::Sphere { centre, radius, .. } => {
                let offset = *centre - at;
                let along = offset.dot(direction);
                let across = (offset - direction * along).length_squared();
                along - (radius * radius - across).max(0.0).sqrt()
            }
        }
    }
}

impl Spot {
    /// The part of the intensity at the cosine of an angle from the axis.
    fn part(&self, cos: f32) -> f32 {
        let [inner, outer] =
            [self.inner_degrees, self.outer_degrees].map(|degrees| degrees.to_radians().cos());
        match cos {
            cos if cos >= inner => 1.0,
            cos if cos <= outer => 0.0,
            cos => {
                let x = (cos - outer) / (inner - outer);
                x * x * (3.0 - 2.0 * x)
            }
        }
    }
}

/// Light from all directions, infinitely far away.
#[derive(Debug, Clone)]
pub enum Sky {
    /// The same radiance from everywhere.
    Constant([f32; 3]),
    /// Radiance that changes with the height above the horizon: with s the sine of the elevation, the horizon has the
    /// weight (1 − s²)⁴, and the zenith or the ground the rest.
    Gradient {
        /// Towards the zenith, of length 1.
        up: Vec3,
        /// Radiance straight above.
        zenith: [f32; 3],
        /// Radiance at the horizon.
        horizon: [f32; 3],
        /// Radiance straight below.
        ground: [f32; 3],
    },
    /// A picture of the surroundings.
    Map(Arc<EnvironmentMap>),
}

impl Sky {
    /// The radiance that comes from a direction; `direction` leads towards the sky and has length 1.
    #[inline]
    pub fn radiance(&self, direction: Vec3) -> Vec3 {
        match self {
            Sky::Constant(radiance) => Vec3::from_array(*radiance),
            Sky::Map(map) => map.radiance(direction),
            Sky::Gradient { up, zenith, horizon, ground } => {
                let height = up.dot(direction).clamp(-1.0, 1.0);
                let pole = Vec3::from_array(if height < 0.0 { *ground } else { *zenith });
                let level = (1.0 - height * height).max(0.0);
                pole.lerp(Vec3::from_array(*horizon), level * level * level * level)
            }
        }
    }

    /// Whether no light comes from anywhere.
    pub fn is_black(&self) -> bool {
        let black = [0.0; 3];
        match self {
            Sky::Constant(radiance) => *radiance == black,
            Sky::Map(map) => map.is_black(),
            Sky::Gradient { zenith, horizon, ground, .. } => {
                [zenith, horizon, ground].iter().all(|l| **l == black)
            }
        }
    }

    /// The radiance that a pixel of a camera sees with nothing before it: the mean over an even grid of rays.
    pub fn behind(&self, camera: &Camera, [x, y]: [u32; 2], [width, height]: [u32; 2]) -> [f32; 3] {
        const RAYS: u32 = 4;
        if let Sky::Constant(radiance) = self {
            return *radiance;
        }
        let offset = |i: u32| (f64::from(i) + 0.5) / f64::from(RAYS);
        let ray = |i: u32| {
            let pixel = DVec2::new(f64::from(x) + offset(i % RAYS), f64::from(y) + offset(i / RAYS));
            self.radiance(camera.ray(pixel, width, height).direction.as_vec3())
        };
        ((0..RAYS * RAYS).map(ray).sum::<Vec3>() / (RAYS * RAYS) as f32).to_array()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_pixel, unit_f32};

    fn draw(i: u32) -> [f32; 2] {
        [unit_f32(hash_pixel(5, 6, i, 0)), unit_f32(hash_pixel(5, 6, i, 1))]
    }

    #[test]
    fn directions_of_a_cone_lie_in_it_and_are_even() {
        for spread in [1e-6_f32, 1e-3, 0.3, 1.0, 1.9] {
            let cone = Cone { axis: Vec3::new(0.6, -0.64, 0.48), spread };
            let wide = Cone { spread: cone.spread * 1.0001 + 1e-12, ..cone };
            let (mut sum, mut in_half) = (0.0_f64, 0);
            let count = 20_000;
            for i in 0..count {
                let direction = cone.sample(draw(i));
                assert!(spread < 1e-5 || wide.contains(direction), "{spread}");
                let from_axis = (direction - cone.axis).length_squared() / 2.0;
                sum += f64::from(from_axis);
                in_half += u32::from(direction.dot(tangent_frame(cone.axis).0) > 0.0);
            }
            // Evenly over the solid angle is evenly over 1 − cos.
            let mean = sum / f64::from(count) / f64::from(spread);
            assert!((mean - 0.5).abs() < 0.01, "{spread}: {mean}");
            assert!((f64::from(in_half) / f64::from(count) - 0.5).abs() < 0.015);
        }
    }

    #[test]
    fn a_sun_of_any_size_sends_the_irradiance_it_says() {
        for angle_degrees in [0.01_f32, 0.53, 5.0, 60.0, 179.0] {
            let sun = Sun { angle_degrees, ..Sun::point(Vec3::Y, [2.0, 3.0, 4.0]) };
            let Arriving::Cone { cone, radiance } = Light::Sun(sun).arriving(DVec3::ONE) else {
                panic!("a disc")
            };
            // ∫ L cos over the cone.
            let cosines = (0..10_000).map(|i| f64::from(cone.sample(draw(i)).dot(Vec3::Y)));
            let mean = cosines.sum::<f64>() / 10_000.0;
            let irradiance = mean * f64::from(cone.solid_angle() * radiance.x);
            assert!((irradiance / 2.0 - 1.0).abs() < 0.01, "{angle_degrees}: {irradiance}");
        }
    }

    #[test]
    fn a_sphere_sends_as_much_as_a_point_of_its_power_through_any_sphere_around_it() {
        let (radius, radiance) = (0.5, 3.0);
        let power = 4.0 * std::f64::consts::PI.powi(2) * radius * radius * f64::from(radiance);
        let light = Light::Sphere { centre: DVec3::ZERO, radius, radiance: [radiance; 3] };
        for away in [0.6, 1.0, 4.0, 100.0] {
            let at = DVec3::new(away, 0.0, 0.0);
            let Arriving::Cone { cone, radiance } = light.arriving(at) else { panic!("a sphere") };
            // L π sin² on a surface that faces the centre, over the area of the sphere through it.
            let sin_squared = f64::from(cone.spread) * (2.0 - f64::from(cone.spread));
            let found = f64::from(radiance.x) * std::f64::consts::PI * sin_squared;
            let expected = power / (4.0 * std::f64::consts::PI * away * away);
            assert!((found / expected - 1.0).abs() < 1e-4, "{away}: {found} {expected}");
            let to = light.distance(at, DVec3::NEG_X);
            assert!((to - (away - radius)).abs() < 1e-9);
        }
        assert_eq!(light.arriving(DVec3::new(0.2, 0.0, 0.0)), Arriving::Nothing);
        assert_eq!(light.arriving(DVec3::ZERO), Arriving::Nothing);
    }

    #[test]
    fn a_spot_fades_between_its_angles_and_a_point_by_the_square() {
        let spot = Spot {
            position: DVec3::ZERO,
            direction: Vec3::Z,
            intensity: [8.0; 3],
            inner_degrees: 10.0,
            outer_degrees: 30.0,
        };
        let at = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            match Light::Spot(spot).arriving(DVec3::new(sin, 0.0, cos) * 2.0) {
                Arriving::Ray { irradiance, .. } => irradiance.x,
                _ => 0.0,
            }
        };
        assert!((at(0.0) - 2.0).abs() < 1e-6 && (at(9.9) - 2.0).abs() < 1e-6);
        assert!(at(15.0) > at(25.0) && at(25.0) > 0.0 && at(30.1) == 0.0 && at(170.0) == 0.0);
        let point = Light::Point { position: DVec3::Y, intensity: [1.0; 3] };
        assert_eq!(point.arriving(DVec3::Y), Arriving::Nothing, "there is no direction at the point itself");
    }

    #[test]
    fn a_gradient_has_its_colours_where_they_belong() {
        let [zenith, horizon, ground] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let sky = Sky::Gradient { up: Vec3::Z, zenith, horizon, ground };
        assert_eq!(sky.radiance(Vec3::Z).to_array(), zenith);
        assert_eq!(sky.radiance(Vec3::X).to_array(), horizon);
        assert_eq!(sky.radiance(Vec3::NEG_Z).to_array(), ground);
        assert!(!sky.is_black() && Sky::Constant([0.0; 3]).is_black());
        let camera = Camera::look_at(DVec3::ZERO, DVec3::X, DVec3::Z, 60.0).expect("a view");
        let [top, bottom] = [0, 9].map(|y| sky.behind(&camera, [5, y], [10, 10]));
        assert!(top[0] > 0.3 && top[2] == 0.0 && bottom[2] > 0.3 && bottom[0] == 0.0);
    }
}
