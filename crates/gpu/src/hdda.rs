//! The walk of a ray (HDDA) with a body that is put in when a shader is made: what a callback would do, without a call.
//!
//! A [`Body`] says at which [`Layer`] the walk stops going down by itself, what it does at each step there, and what in empty
//! space; [`Body::text`] puts that into the text of the walk: `shader/hdda_map.wgsl` where bricks are looked up in a map,
//! `shader/hdda.wgsl` by the tree. The function that comes of it is
//! `fn name(field: u32, ray: LocalRay, begin: f32, end: f32, state: ptr<function, State>)`, whose `ray` is inside of the
//! field's bricks from `begin` to `end`. `return;` in a step ends the walk.
//!
//! | seen by | name | what it is |
//! |---|---|---|
//! | both | `field`, `ray`, `state` | what the function was given |
//! | both | `t0`, `t1` | where the ray enters and leaves what is visited |
//! | steps | `brick` | the brick, counted as the tree does |
//! | steps | `corner` | the position of its first voxel |
//! | steps | `values`, `words` | what `brick_value` reads its voxels by |
//! | steps | `cell` | the cell at `t0`: `offset_of` and `local_of` say which |
//! | steps of voxels | `value` | the voxel's value, as the field means it |
//!
//! | body | layer | step | in empty space |
//! |---|---|---|---|
//! | [`MEET_VOXEL`] | voxels | ends at the first above a value | |
//! | [`ADD_VOXELS`] | voxels | adds values times lengths | |
//! | [`PASS_VOXELS`] | bricks | takes the light of samples, those of a voxel at once | skips samples |
//! | [`PASS_SAMPLES`] | bricks | takes the light of interpolated samples | |
//!
//! By the tree, what is of one value is one step, however many bricks and voxels it has; by the map it is as any brick. Empty space
//! comes as regions of the tree, or as cubes of the map: only their lengths are for bodies to count on.
//!
//! What does not live here: walks that keep more than a brick from one step to the next, or stop within bricks by their bounds
//! (`next_run` and `next_segment` of `shader/walk.wgsl`, `first_hit` of `shader/surface.wgsl`).

/// Down to which layer a walk goes by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Layer {
    /// A step for each voxel of a brick.
    Voxel,
    /// A step for each brick.
    Brick,
}

/// What a walk does, in WGSL.
pub(crate) struct Body {
    /// The name of the function.
    pub(crate) name: &'static str,
    /// The type that `state` points to.
    pub(crate) state: &'static str,
    /// Where the walk stops.
    pub(crate) layer: Layer,
    /// At each step.
    pub(crate) step: &'static str,
    /// In each empty region.
    pub(crate) empty: &'static str,
}

impl Body {
    /// The walk with this body in it.
    pub(crate) fn text(&self, has_maps: bool) -> String {
        let layer = match self.layer {
            Layer::Voxel => "VOXEL_LAYER",
            Layer::Brick => "BRICK_LAYER",
        };
        let walk =
            if has_maps { include_str!("shader/hdda_map.wgsl") } else { include_str!("shader/hdda.wgsl") };
        walk.replace("$NAME", self.name)
            .replace("$STATE", self.state)
            .replace("$LAYER", layer)
            .replace("$STEP", self.step)
            .replace("$EMPTY", self.empty)
    }
}

/// Finds the first voxel above a value (`shader/views.wgsl`).
pub(crate) const MEET_VOXEL: Body = Body {
    name: "meet_voxel",
    state: "VoxelHit",
    layer: Layer::Voxel,
    // By rounding a ray may begin beside the active voxels, where anything is stored.
    step: "if (value > (*state).above && t0 < t1
                    && is_active(field, (brick << vec3<u32>(LOG2_BRICK)) + local_of(cell))) {
                *state = VoxelHit(true, (*state).above, t0, brick, cell, value);
                return;
            }",
    empty: "",
};

/// Adds what voxels hold along the ray (`shader/depth.wgsl`).
pub(crate) const ADD_VOXELS: Body = Body {
    name: "add_voxels",
    state: "f32",
    layer: Layer::Voxel,
    step: "*state += value * max(t1 - t0, 0.0);",
    empty: "",
};

/// Passes samples of the nearest voxels (`shader/views.wgsl`).
pub(crate) const PASS_VOXELS: Body = Body {
    name: "pass_voxels",
    state: "Passing",
    layer: Layer::Brick,
    step: "pass_brick(field, values, words, ray, corner, t1, state);",
    empty: "(*state).number = max((*state).number, ceil(t1));",
};

/// Passes samples between voxels (`shader/views.wgsl`).
pub(crate) const PASS_SAMPLES: Body = Body {
    name: "pass_samples",
    state: "Passing",
    layer: Layer::Brick,
    step: "var samples = (*state).accessor;
                let end = ceil(t1);
                for (var number = ceil(t0); number < end; number += 1.0) {
                    (*state).share *= 1.0 - (*state).loss * trilinear(field, &samples, ray_at(ray, number));
                }
                (*state).accessor = samples;",
    empty: "",
};

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use glam::{DVec3, IVec3};
    use nuage_render::camera::Camera;
    use nuage_render::hash::hash_pixel;
    use nuage_render::light::Sky;
    use nuage_render::path::PathSettings;
    use nuage_volume::accessor::Accessor;
    use nuage_volume::brick::{BrickSummary, Bricks};
    use nuage_volume::build::{TileSize, TreeBuilder};
    use nuage_volume::channel::{Channel, IndexBox};
    use nuage_volume::tree::Content;

    use crate::arrays::Arrays;
    use crate::look::{Look, Pass};
    use crate::maps;
    use crate::renderer::Renderer;
    use crate::shader::Source;
    use crate::twins::gpu;
    use crate::upload::Volume;

    const RAYS: usize = 1024;

    const VISIT: Body = Body {
        name: "visit_voxels",
        state: "Visits",
        layer: Layer::Voxel,
        step: "let at = vec3<u32>(brick);
            (*state).steps += 1u;
            (*state).trail = hash_pixel((*state).trail, at.x, at.y, 512u * at.z + offset_of(cell));
            (*state).length += t1 - t0;",
        empty: "(*state).empty += 1u;",
    };

    /// Bodies that count, at each layer.
    pub(crate) fn bodies(has_maps: bool) -> String {
        let bricks = Body { name: "visit_bricks", layer: Layer::Brick, ..VISIT };
        VISIT.text(has_maps) + &bricks.text(has_maps)
    }

    /// Some bricks with voxels of all values and with one, and tiles, over the border of two `Node5`s.
    fn channel() -> Channel {
        let mut builder = TreeBuilder::new();
        let mut values = Vec::new();
        let (first, last) = (IVec3::new(490, 3, 5), IVec3::new(530, 38, 36));
        builder.tile(IVec3::new(496, 0, 16), TileSize::Node4, 0.5).expect("a free place");
        for x in first.x..=last.x {
            for y in first.y..=last.y {
                for z in first.z..=last.z {
                    let place = IVec3::new(x, y, z);
                    let is_tile = place >> 4 == IVec3::new(31, 0, 1);
                    match hash_pixel(8, x as u32, y as u32, z as u32) % 64 {
                        0 if !is_tile => builder.tile(place, TileSize::Brick, 0.25).expect("a free place"),
                        1 if !is_tile => {
                            let voxel = |voxel| hash_pixel(9, values.len() as u32, voxel, 0) % 3;
                            let brick: [f32; 512] = std::array::from_fn(|i| voxel(i as u32) as f32);
                            builder.brick(place, BrickSummary::of(&brick)).expect("a free place");
                            values.extend(brick);
                        }
                        _ => {}
                    }
                }
            }
        }
        Channel {
            tree: builder.finish(Bricks::F32(values)).expect("a tree"),
            world_from_index: glam::DAffine3::IDENTITY,
            active_box: Some(IndexBox { min: first << 3, max: (last << 3) + 7 }),
        }
    }

    /// What stands in a region.
    #[derive(Clone, Copy, PartialEq)]
    enum Kind {
        Empty,
        /// A step at any layer.
        One,
        /// Its voxels are steps.
        Voxels,
    }

    /// A cube of bricks, and what is in it.
    type Region = ([IVec3; 2], Kind);

    /// What a ray visits, in numbers that need no rounding: each voxel that it crosses in turn.
    fn visits(
        [origin, direction]: [DVec3; 2],
        end: f64,
        [first, last]: [IVec3; 2],
        layer: Layer,
        region_of: &mut dyn FnMut(IVec3) -> Region,
    ) -> [f32; 4] {
        let (mut steps, mut empty, mut trail, mut length) = (0_u32, 0_u32, 0, 0.0);
        let mut region = ([IVec3::MAX, IVec3::MIN], Kind::Empty);
        let (mut t, mut voxel) = (0.0, origin.floor().as_ivec3());
        while t < end {
            let brick: IVec3 = (voxel >> 3) + first - 1;
            if brick.cmplt(first).any() || brick.cmpgt(last).any() {
                break;
            }
            let forward = direction.cmpgt(DVec3::ZERO);
            let faces = voxel.as_dvec3() + DVec3::select(forward, DVec3::ONE, DVec3::ZERO);
            let leaves =
                DVec3::select(direction.cmpeq(DVec3::ZERO), DVec3::INFINITY, (faces - origin) / direction);
            let t1 = leaves.min_element().min(end);
            let is_new = brick.cmplt(region.0[0]).any() || brick.cmpgt(region.0[1]).any();
            if is_new {
                region = region_of(brick);
            }
            let is_step = match (region.1, layer) {
                (Kind::Empty, _) => false,
                (Kind::Voxels, Layer::Voxel) => true,
                _ => is_new,
            };
            empty += u32::from(is_new && region.1 == Kind::Empty);
            if region.1 != Kind::Empty {
                length += t1 - t;
            }
            if is_step {
                steps += 1;
                let (at, local) = (brick.as_uvec3(), (voxel & 7).as_uvec3());
                trail = hash_pixel(trail, at.x, at.y, 512 * at.z + 64 * local.x + 8 * local.y + local.z);
            }
            let ahead = IVec3::select(forward, IVec3::ONE, IVec3::NEG_ONE);
            let crossed = leaves.cmple(DVec3::splat(leaves.min_element()));
            assert!(t1 == end || crossed.bitmask().count_ones() == 1, "a ray through an edge");
            voxel += IVec3::select(crossed, ahead, IVec3::ZERO);
            t = t1;
        }
        [steps as f32, empty as f32, (trail >> 8) as f32, length as f32]
    }

    /// Rays whose distances to all faces are exact in single precision, and differ.
    fn rays([first, last]: [IVec3; 2]) -> Vec<([DVec3; 2], f64)> {
        let size = (8 * (last - first + 1)).as_dvec3();
        let random = |i: usize, j: u32| hash_pixel(i as u32, 3, j, 1);
        let ray = |i: usize| {
            // In an order of the axes, halves and quarters of the fastest; some along one or two axes only.
            let mut direction = [1.0, 0.5, 0.25];
            if i % 8 > 5 {
                direction[i % 2 + 1] = 0.0;
            }
            direction.rotate_left(i % 3);
            let direction = DVec3::from_array(direction)
                * DVec3::from_array([0, 1, 2].map(|j| if random(i, j) & 1 == 0 { 1.0 } else { -1.0 }));
            // Of 512ths of a voxel along each axis: 1, 4 or 16 more than a multiple of 32 for each of t.
            let share = DVec3::from_array([3, 4, 5].map(|j| f64::from(random(i, j)) / f64::from(u32::MAX)));
            let whole = (share * (size - 1.0)).floor() + 8.0;
            let parts = DVec3::from_array([0, 1, 2].map(|j| {
                let step = direction[j].abs();
                [5.0 / 512.0, 9.0 / 512.0, 23.0 / 512.0]
                    [if step == 1.0 { 0 } else { 1 + usize::from(step == 0.25) }]
            }));
            // Within the bricks, which positions of 8 and more are in.
            let far = DVec3::select(direction.cmpgt(DVec3::ZERO), size + 8.0, DVec3::splat(8.0));
            let leaves =
                ((far - whole - parts) / direction).map(|t| if t.is_finite() { t } else { f64::MAX });
            let end = if i.is_multiple_of(4) { 37.0 + 3.0 / 512.0 } else { f64::MAX };
            ([whole + parts, direction], leaves.min_element().min(end))
        };
        (0..RAYS).map(ray).collect()
    }

    /// Each layer, by the map and by the tree: the same steps, in the same order, as the processor finds voxel by voxel.
    #[test]
    fn walks_visit_what_stands_in_the_tree() {
        let Some(gpu) = gpu() else { return };
        let channel = channel();
        let with_map = Arrays::of_channels(&[&channel]).expect("arrays");
        let bricks = with_map.places()[0].as_ref().expect("a place").bricks();
        let rays = rays(bricks);
        let mut rows: Vec<[f32; 4]> =
            rays.iter().map(|([origin, _], end)| origin.as_vec3().extend(*end as f32).to_array()).collect();
        rows.extend(rays.iter().map(|([_, direction], _)| direction.as_vec3().extend(0.0).to_array()));
        rows.resize(4 * RAYS, [-1.0; 4]);
        let camera = Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 40.0).expect("a view");
        let look = Look { camera, media: Vec::new(), lights: Vec::new(), sky: Sky::Constant([0.0; 3]) };
        let pass = Pass::Path { settings: PathSettings::default(), sample: 0 };

        let map_words = with_map.tree_words();
        let map = &map_words[with_map.fields()[0].box_last[3] as usize..];
        let size = bricks[1] - bricks[0] + 3;
        let by_map = |brick: IVec3| {
            let local = brick - bricks[0] + 1;
            let kind = map[maps::CELL_WORDS * ((local.x * size.y + local.y) * size.z + local.z) as usize];
            match kind & 0xff {
                maps::ABSENT_TAG => {
                    let margin = (kind >> 8) as i32 - 1;
                    ([brick - margin, brick + margin], Kind::Empty)
                }
                _ => ([brick; 2], Kind::Voxels),
            }
        };
        let mut accessor = Accessor::new(&channel.tree);
        let by_tree = |brick: IVec3| {
            let region = accessor.region(brick);
            let low = brick & !((1 << region.log2_bricks) - 1);
            let kind = match region.content {
                _ if region.footprint.max == 0.0 => Kind::Empty,
                Content::Constant(_) => Kind::One,
                Content::Brick(_) => Kind::Voxels,
            };
            ([low, low + ((1 << region.log2_bricks) - 1)], kind)
        };
        let regions: [&mut dyn FnMut(IVec3) -> Region; 2] = [&mut { by_map }, &mut { by_tree }];
        for (arrays, region_of) in [with_map.clone(), with_map.clone().without_maps()].iter().zip(regions) {
            let volume = Volume::new(&gpu, arrays).expect("a volume");
            let mut renderer = Renderer::new(&gpu, [RAYS as u32, 4]).expect("a renderer");
            renderer.prepare_source(&volume, &look, &pass, Source::Visits).expect("a pipeline");
            renderer.write_pixels(&rows).expect("pixels written");
            renderer.run(&volume).expect("a run");
            let found = renderer.pixels().expect("pixels read");
            let mut all = [0.0; 2];
            for (row, layer) in [(2, Layer::Brick), (3, Layer::Voxel)] {
                for (i, (ray, end)) in rays.iter().enumerate() {
                    let expected = visits(*ray, *end, bricks, layer, region_of);
                    let what = (arrays.has_maps(), layer, i, ray, end);
                    assert_eq!(found[row * RAYS + i], expected, "map, layer, ray: {what:?}");
                    all = [all[0] + expected[0], all[1] + expected[1]];
                }
            }
            assert!(all.iter().all(|count| *count > 5.0 * RAYS as f32), "{all:?}");
        }
    }
}
