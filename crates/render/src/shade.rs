//! How much of a sun's light gets where, roughly: transmittances on a lattice that lies along the sun's rays, made once for a
//! scene.
//!
//! It is no answer, but something to compare answers with: [`path`](crate::path) follows a shadow ray now and then only, and
//! takes what that finds beside what stands here for the rest (a control variate). However wrong the lattice is, the mean is
//! right. So its values may come from a few samples per cell, read without decoding a brick.
//!
//! What does not live here: shadow rays.

use glam::{DMat3, DVec3, Vec3};
use nuage_volume::accessor::Accessor;

use crate::camera::Ray;
use crate::math::exp;
use crate::phase::tangent_frame;
use crate::picture::each_tile;
use crate::solid::Solid;
use crate::traverse::Field;

/// The most nodes along an axis: four megabytes in all.
const MOST_NODES: f64 = 96.0;

/// Cells are at least so many voxels long.
const LEAST_VOXELS: f64 = 2.0;

/// What casts a shadow, and its extinction at value 1 per world length.
pub(crate) enum Caster<'c, 's> {
    /// The values of a field.
    Field(&'c Field<'s>, f32),
    /// A value of 1.
    Solid(&'c Solid, f32),
}

/// The share of a sun's light that gets to each node of a lattice.
pub(crate) struct Shade {
    /// The first node, and what takes offsets from there to counts of nodes.
    first: DVec3,
    lattice_from_world: DMat3,
    /// The last place along each axis that has a node behind it.
    last: Vec3,
    /// How far apart neighbours along each axis are; along the sun's rays they touch.
    strides: [usize; 3],
    passes: Box<[f32]>,
}

impl Shade {
    /// The shade of some media. `None` where they have no extent that numbers could hold, or there are none.
    pub(crate) fn new(casters: &[Caster<'_, '_>], direction_to: Vec3) -> Option<Self> {
        let along = direction_to.as_dvec3().try_normalize()?;
        let (tangent, bitangent) = tangent_frame(along.as_vec3());
        // Not quite at right angles, as single precision has it: nothing here needs that.
        let world_from_lattice = DMat3::from_cols(tangent.as_dvec3(), bitangent.as_dvec3(), along);
        let lattice_from_world = world_from_lattice.inverse();
        let (mut low, mut high, mut voxel) = (DVec3::INFINITY, DVec3::NEG_INFINITY, f64::INFINITY);
        for caster in casters {
            let corners = match caster {
                Caster::Field(field, _) => field.world_corners(),
                Caster::Solid(solid, _) => solid.world_corners(),
            };
            for corner in corners {
                let corner = lattice_from_world * corner;
                (low, high) = (low.min(corner), high.max(corner));
            }
            if let Caster::Field(field, _) = caster {
                let finest = field.directions().as_dmat3();
                let finest = finest.x_axis.length().max(finest.y_axis.length()).max(finest.z_axis.length());
                voxel = voxel.min(1.0 / finest);
            }
        }
        let extent = high - low;
        let longest = extent.max_element();
        let voxel = if voxel.is_finite() { voxel } else { 0.0 };
        let cell = (longest / (MOST_NODES - 1.0)).max(voxel * LEAST_VOXELS);
        if !(cell.is_finite() && cell > 0.0 && extent.min_element() >= 0.0) {
            return None;
        }
        let cells = (extent / cell).ceil().max(DVec3::ONE);
        let nodes = cells.to_array().map(|cells| cells as usize + 1);
        let strides = [nodes[1] * nodes[2], nodes[2], 1];
        let first = world_from_lattice * low;
        let world_from_lattice = world_from_lattice * cell;
        let mut slabs: Vec<Vec<f32>> = vec![Vec::new(); nodes[0]];
        let readers = || casters.iter().map(Caster::reader).collect::<Vec<_>>();
        each_tile(&mut slabs, readers, |readers, x, slab: &mut Vec<f32>| {
            slab.resize(strides[0], 0.0);
            for (y, column) in slab.chunks_exact_mut(nodes[2]).enumerate() {
                // In the middle between two nodes: what lies there dims all nodes before it.
                let mut depth = 0.0;
                for (z, node) in column.iter_mut().enumerate().rev() {
                    let place = DVec3::new(f64::from(x), y as f64, z as f64);
                    let extinction = |z: f64| -> f32 {
                        let p_world = first + world_from_lattice * (place + DVec3::Z * z);
                        let casters = casters.iter().zip(readers.iter_mut());
                        casters.map(|(caster, reader)| caster.extinction(reader, p_world)).sum()
                    };
                    depth += 0.5 * cell as f32 * [0.25, 0.75].map(extinction).iter().sum::<f32>();
                    *node = exp(-depth);
                }
            }
        });
        Some(Shade {
            first,
            lattice_from_world: lattice_from_world * (1.0 / cell),
            last: (cells - 1.0).as_vec3(),
            strides,
            passes: slabs.concat().into(),
        })
    }

    /// What gets to a place in the world, as the lattice has it, and how much that differs around the place. What lies beyond
    /// the lattice has what its faces have.
    pub(crate) fn at(&self, p_world: DVec3) -> Shaded {
        let place = (self.lattice_from_world * (p_world - self.first)).as_vec3();
        let cell = place.floor().clamp(Vec3::ZERO, self.last);
        let [x, y, z] = (place - cell).clamp(Vec3::ZERO, Vec3::ONE).to_array();
        let [i, j, k] = cell.to_array().map(|i| i as usize);
        let [dx, dy, _] = self.strides;
        let first = i * dx + j * dy + k;
        let (mut least, mut most) = (1.0_f32, 0.0_f32);
        let mut row = |offset: usize| {
            let pair = self.passes.get(first + offset..first + offset + 2);
            let [a, b] = pair.map_or([0.0; 2], |pair| [pair[0], pair[1]]);
            // Along the sun's rays it grows.
            (least, most) = (least.min(a), most.max(b));
            a + (b - a) * z
        };
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let [low, high] = [mix(row(0), row(dy), y), mix(row(dx), row(dx + dy), y)];
        Shaded { passes: mix(low, high, x), varies: most - least }
    }
}

/// What a [`Shade`] says of a place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shaded {
    /// The share of the sun's light that gets there.
    pub(crate) passes: f32,
    /// The difference of the most and the least of the nodes around it.
    pub(crate) varies: f32,
}

impl<'s> Caster<'_, 's> {
    fn reader(&self) -> Option<Accessor<'s>> {
        match self {
            Caster::Field(field, _) => Some(Accessor::new(field.tree())),
            Caster::Solid(..) => None,
        }
    }

    /// The extinction at a place in the world, per world length.
    fn extinction(&self, reader: &mut Option<Accessor<'s>>, p_world: DVec3) -> f32 {
        match (self, reader) {
            (Caster::Field(field, scale), Some(reader)) => scale * field.value_at(reader, p_world),
            (Caster::Field(..), None) => 0.0,
            (Caster::Solid(solid, scale), _) => {
                let inside = solid
                    .interval(&Ray { origin: p_world, direction: DVec3::Z })
                    .is_some_and(|[t, _]| t <= 0.0);
                if inside { *scale } else { 0.0 }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::exp;
    use crate::scene::Shape;
    use glam::DAffine3;

    /// A block of extinction 2, four high, lit from above: the shade falls off as it should, and is the same on the way in.
    #[test]
    fn a_block_dims_the_light_as_it_should() {
        let world_from_unit = DAffine3::from_scale(DVec3::new(3.0, 4.0, 5.0));
        let block = Solid::new(Shape::Box { world_from_unit }).expect("a block");
        let shade = Shade::new(&[Caster::Solid(&block, 2.0)], Vec3::Y).expect("a lattice");
        for depth in [0.1, 0.5, 1.0, 2.5, 3.9] {
            let shaded = shade.at(DVec3::new(1.3, 4.0 - depth, 2.2));
            let expected = exp(-2.0 * depth as f32);
            assert!((shaded.passes - expected).abs() < 0.003, "{depth}: {} of {expected}", shaded.passes);
            assert!(
                shaded.varies < 0.12 && (depth > 1.0 || shaded.varies > 0.01),
                "{depth}: {}",
                shaded.varies
            );
        }
        assert!(shade.at(DVec3::new(1.0, 9.0, 1.0)).passes > 0.99);
    }

    #[test]
    fn what_has_no_extent_has_no_shade() {
        assert!(Shade::new(&[], Vec3::Y).is_none());
        let world_from_unit = DAffine3::from_scale(DVec3::splat(f64::MAX));
        let huge = Solid::new(Shape::Ball { world_from_unit });
        assert!(huge.is_none_or(|huge| Shade::new(&[Caster::Solid(&huge, 1.0)], Vec3::Y).is_none()));
    }
}
