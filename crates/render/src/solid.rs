//! Rays through homogeneous boxes and balls: where they enter and leave.

use glam::{DAffine3, DVec3};

use crate::camera::Ray;
use crate::scene::Shape;

/// A homogeneous shape made ready for rays.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Solid {
    unit_from_world: DAffine3,
    is_ball: bool,
}

impl Solid {
    /// `None` if the shape is a grid, or has no volume.
    pub(crate) fn new(shape: Shape<'_>) -> Option<Self> {
        let (world_from_unit, is_ball) = match shape {
            Shape::Grid(_) => return None,
            Shape::Box { world_from_unit } => (world_from_unit, false),
            Shape::Ball { world_from_unit } => (world_from_unit, true),
        };
        let unit_from_world = world_from_unit.inverse();
        (world_from_unit.is_finite() && unit_from_world.is_finite())
            .then_some(Solid { unit_from_world, is_ball })
    }

    /// The corners, in the world, of a box around it.
    pub(crate) fn world_corners(&self) -> [DVec3; 8] {
        let world_from_unit = self.unit_from_world.inverse();
        let low = if self.is_ball { -1.0 } else { 0.0 };
        std::array::from_fn(|i| {
            let corner = [i >> 2, i >> 1 & 1, i & 1].map(|high| if high == 1 { 1.0 } else { low });
            world_from_unit.transform_point3(DVec3::from_array(corner))
        })
    }

    /// Where a ray enters and leaves, as distances from its origin.
    pub(crate) fn interval(&self, ray: &Ray) -> Option<[f64; 2]> {
        let origin = self.unit_from_world.transform_point3(ray.origin);
        let direction = self.unit_from_world.transform_vector3(ray.direction);
        let [t0, t1] = match self.is_ball {
            true => ball(origin, direction)?,
            false => cube(origin, direction)?,
        };
        let t0 = t0.max(0.0);
        (t0 < t1).then_some([t0, t1])
    }
}

fn ball(origin: DVec3, direction: DVec3) -> Option<[f64; 2]> {
    let squared = direction.length_squared();
    // From the point of the ray that is nearest to the centre: nothing cancels, however far the origin is.
    let middle = -origin.dot(direction) / squared;
    let across = (origin + direction * middle).length_squared();
    let half = ((1.0 - across) / squared).sqrt();
    (half > 0.0).then_some([middle - half, middle + half])
}

fn cube(origin: DVec3, direction: DVec3) -> Option<[f64; 2]> {
    let [mut t0, mut t1] = [f64::NEG_INFINITY, f64::INFINITY];
    for (origin, direction) in origin.to_array().into_iter().zip(direction.to_array()) {
        if direction == 0.0 {
            if !(0.0..=1.0).contains(&origin) {
                return None;
            }
            continue;
        }
        let (a, b) = (-origin / direction, (1.0 - origin) / direction);
        (t0, t1) = (t0.max(a.min(b)), t1.min(a.max(b)));
    }
    (t0 < t1).then_some([t0, t1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn ray(origin: [f64; 3], direction: [f64; 3]) -> Ray {
        Ray { origin: DVec3::from_array(origin), direction: DVec3::from_array(direction).normalize() }
    }

    #[test]
    fn a_ray_enters_and_leaves_where_it_must() {
        let moved = DAffine3::from_scale_rotation_translation(
            DVec3::splat(2.0),
            DQuat::from_rotation_z(0.7),
            DVec3::new(5.0, 0.0, 0.0),
        );
        let ball = Solid::new(Shape::Ball { world_from_unit: moved }).unwrap();
        let [t0, t1] = ball.interval(&ray([0.0, 1.0, 0.0], [1.0, 0.0, 0.0])).unwrap();
        let half = 3.0_f64.sqrt();
        assert!((t0 - 5.0 + half).abs() < 1e-12 && (t1 - 5.0 - half).abs() < 1e-12);
        assert!(ball.interval(&ray([0.0, 2.1, 0.0], [1.0, 0.0, 0.0])).is_none());
        assert!(ball.interval(&ray([0.0, 1.0, 0.0], [-1.0, 0.0, 0.0])).is_none(), "it lies behind");
        assert_eq!(ball.interval(&ray([5.0, 0.0, 0.0], [0.0, 0.0, 1.0])).map(|[t0, _]| t0), Some(0.0));
        let cube =
            Solid::new(Shape::Box { world_from_unit: DAffine3::from_scale(DVec3::new(1.0, 2.0, 4.0)) });
        let [t0, t1] = cube.unwrap().interval(&ray([0.5, 1.0, 9.0], [0.0, 0.0, -1.0])).unwrap();
        assert!((t0 - 5.0).abs() < 1e-12 && (t1 - 9.0).abs() < 1e-12);
        assert!(cube.unwrap().interval(&ray([1.5, 1.0, 9.0], [0.0, 0.0, -1.0])).is_none());
        let flat = DAffine3::from_scale(DVec3::new(1.0, 0.0, 1.0));
        assert!(Solid::new(Shape::Box { world_from_unit: flat }).is_none());
    }
}
