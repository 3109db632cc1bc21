//! The perspective camera: rays through pixels.
//!
//! Right-handed, pinhole, looking along `forward`; image row 0 is at the top. The field of view is horizontal.

use fearless_simd::{Simd, dispatch};
use glam::{DVec2, DVec3};

use crate::simd::level;

/// A ray in world space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Where it starts.
    pub origin: DVec3,
    /// Where it goes, of length 1.
    pub direction: DVec3,
}

/// A pinhole camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// The pinhole, in world space.
    pub origin: DVec3,
    /// The viewing direction, of length 1.
    pub forward: DVec3,
    /// To the right in the picture, of length 1.
    pub right: DVec3,
    /// Up in the picture, of length 1.
    pub up: DVec3,
    /// The tangent of half the horizontal field of view.
    pub half_width_tangent: f64,
}

impl Camera {
    /// A camera at `origin` that looks at `target`, with `up` upwards in the picture and a horizontal field of
    /// view in degrees. `None` if the points coincide, `up` lies along the view, a number is not finite, or
    /// the field of view is not between 0° and 180°.
    pub fn look_at(origin: DVec3, target: DVec3, up: DVec3, fov_degrees: f64) -> Option<Self> {
        let forward = (target - origin).try_normalize()?;
        let right = forward.cross(up.try_normalize()?).try_normalize()?;
        let half_width_tangent = (fov_degrees.to_radians() / 2.0).tan();
        let valid = fov_degrees > 0.0 && fov_degrees < 180.0 && origin.is_finite();
        valid.then(|| Camera { origin, forward, right, up: right.cross(forward), half_width_tangent })
    }

    /// The ray through a position on the image plane, in pixels from the top left corner; the centre of the
    /// first pixel is (½, ½).
    pub fn ray(&self, pixel: DVec2, width: u32, height: u32) -> Ray {
        let (width, height) = (f64::from(width), f64::from(height));
        let x = (2.0 * pixel.x / width - 1.0) * self.half_width_tangent;
        let y = (height - 2.0 * pixel.y) / width * self.half_width_tangent;
        let direction = self.forward + x * self.right + y * self.up;
        Ray { origin: self.origin, direction: direction.normalize() }
    }

    /// The rays of [`ray`](Self::ray) through several positions, in less time.
    pub fn rays<const N: usize>(&self, pixels: &[DVec2; N], width: u32, height: u32) -> [Ray; N] {
        dispatch!(level(), simd => simd.vectorize(
            #[inline(always)]
            || self.rays_by_axis(pixels, f64::from(width), f64::from(height))
        ))
    }

    /// In loops that the compiler turns into vector instructions.
    #[inline(always)]
    fn rays_by_axis<const N: usize>(&self, pixels: &[DVec2; N], width: f64, height: f64) -> [Ray; N] {
        let (mut direction, mut length) = ([[0.0; N]; 3], [0.0; N]);
        for (axis, direction) in direction.iter_mut().enumerate() {
            let (forward, right, up) = (self.forward[axis], self.right[axis], self.up[axis]);
            for ((along, length), pixel) in direction.iter_mut().zip(&mut length).zip(pixels) {
                let x = (2.0 * pixel.x / width - 1.0) * self.half_width_tangent;
                let y = (height - 2.0 * pixel.y) / width * self.half_width_tangent;
                *along = forward + x * right + y * up;
                *length += *along * *along;
            }
        }
        for length in &mut length {
            *length = 1.0 / length.sqrt();
        }
        let mut rays = [Ray { origin: self.origin, direction: self.forward }; N];
        let [x, y, z] = &direction;
        for (i, ray) in rays.iter_mut().enumerate() {
            ray.direction = DVec3::new(x[i], y[i], z[i]) * length[i];
        }
        rays
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_together_are_those_one_by_one() {
        let camera = Camera::look_at(DVec3::new(3.0, 1.0, 7.0), DVec3::X, DVec3::Y, 70.0).unwrap();
        let pixels: [DVec2; 16] = std::array::from_fn(|i| DVec2::new(i as f64 * 3.7, 90.0 - i as f64));
        let together = camera.rays(&pixels, 64, 100);
        assert_eq!(together, pixels.map(|pixel| camera.ray(pixel, 64, 100)));
    }

    #[test]
    fn the_horizontal_field_of_view_spans_the_width() {
        let camera = Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 90.0).unwrap();
        let left = camera.ray(DVec2::new(0.0, 5.0), 20, 10).direction;
        assert!((left - DVec3::new(-1.0, 0.0, -1.0).normalize()).length() < 1e-12);
        // Square pixels: half as high, half the tangent.
        let top = camera.ray(DVec2::new(10.0, 0.0), 20, 10).direction;
        assert!((top - DVec3::new(0.0, 0.5, -1.0).normalize()).length() < 1e-12);
    }

    #[test]
    fn views_that_make_no_sense_are_none() {
        let look = |target, up, fov| Camera::look_at(DVec3::Z, target, up, fov);
        assert!(look(DVec3::Z, DVec3::Y, 40.0).is_none());
        assert!(look(DVec3::ZERO, DVec3::Z, 40.0).is_none());
        assert!(look(DVec3::ZERO, DVec3::Y, 180.0).is_none());
        assert!(look(DVec3::ZERO, DVec3::NAN, 40.0).is_none());
    }
}
