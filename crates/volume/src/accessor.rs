//! Random access that remembers its path: the fast way to read neighbouring points.
//!
//! An accessor keeps the `Node5`, the `Node4` and the brick it was in last; a look-up starts from the deepest
//! of them that still holds the point. One per thread; making one costs nothing.

use glam::{IVec3, Vec3};

use crate::brick::Bounds;
use crate::space::{
    LOG2_NODE4_BRICKS, NODE4_SLOTS, NODE5_SLOTS, brick_of, node4_slot, node5_slot, root_cell, voxel_offset,
};
use crate::tree::{Content, Entry, Region, Tree};

/// What the tree has at the place of a brick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrickPlace {
    /// The entry of this index, in the level of the `Node4`.
    Entry(usize),
    /// No entry in an existing `Node4`: samples are zero.
    Zero,
    /// No `Node4`: a larger region of one value, or nothing.
    Tile,
}

/// A reader of a [`Tree`] that remembers where it was.
#[derive(Debug, Clone)]
pub struct Accessor<'a> {
    tree: &'a Tree,
    /// Brick coordinate over 512 of the remembered `Node5`, and its index.
    node5: Option<(IVec3, u32)>,
    /// Brick coordinate over 16 of the remembered `Node4`, and its index.
    node4: Option<(IVec3, u32)>,
    /// The brick coordinate of the remembered content.
    brick: IVec3,
    content: Content,
}

impl<'a> Accessor<'a> {
    /// An accessor that has been nowhere yet.
    pub fn new(tree: &'a Tree) -> Self {
        let brick = IVec3::ZERO;
        let mut accessor =
            Accessor { tree, node5: None, node4: None, brick, content: Content::Constant(0.0) };
        accessor.content = accessor.region(brick).content;
        accessor
    }

    /// The tree that is read.
    pub fn tree(&self) -> &'a Tree {
        self.tree
    }

    /// The region around a brick.
    #[inline]
    pub fn region(&mut self, brick: IVec3) -> Region {
        if let Some((key, node4)) = self.node4
            && key == brick >> LOG2_NODE4_BRICKS
        {
            return self.tree.region_in_node4(node4, brick);
        }
        self.region_from_node5(brick)
    }

    /// Where a brick stands among the entries of all `Node4`: [`BrickPlace::Entry`] gives the index.
    #[inline]
    pub fn place(&mut self, brick: IVec3) -> BrickPlace {
        let key = brick >> LOG2_NODE4_BRICKS;
        if self.node4.is_none_or(|(known, _)| known != key) {
            self.region_from_node5(brick);
        }
        match self.node4 {
            Some((known, node4)) if known == key => {
                let entry = self.tree.node4.entry_index(node4, NODE4_SLOTS, node4_slot(brick));
                entry.map_or(BrickPlace::Zero, BrickPlace::Entry)
            }
            _ => BrickPlace::Tile,
        }
    }

    /// The extent of the region around a brick (as [`Region::log2_bricks`]) and its footprint: all that a walk
    /// through empty space needs.
    #[inline]
    pub fn footprint(&mut self, brick: IVec3) -> (u32, Bounds) {
        if let Some((key, node4)) = self.node4
            && key == brick >> LOG2_NODE4_BRICKS
        {
            let nodes = &self.tree.node4;
            let entry = nodes.entry_index(node4, NODE4_SLOTS, node4_slot(brick));
            return (0, entry.map_or(Bounds::of(0.0), |entry| nodes.footprints[entry]));
        }
        let region = self.region_from_node5(brick);
        (region.log2_bricks, region.footprint)
    }

    #[inline(never)]
    fn region_from_node5(&mut self, brick: IVec3) -> Region {
        let cell = root_cell(brick);
        if self.node5.is_none_or(|(key, _)| key != cell) {
            match self.tree.root_entry(cell) {
                Some(root) if root.entry.child != Entry::CONSTANT => {
                    self.node5 = Some((cell, root.entry.child));
                }
                _ => return self.tree.region(brick),
            }
        }
        let Some((_, node5)) = self.node5 else { return self.tree.region(brick) };
        let nodes = &self.tree.node5;
        match nodes.entry_index(node5, NODE5_SLOTS, node5_slot(brick)) {
            Some(i) if nodes.entries[i].child != Entry::CONSTANT => {
                let node4 = nodes.entries[i].child;
                self.node4 = Some((brick >> LOG2_NODE4_BRICKS, node4));
                self.tree.region_in_node4(node4, brick)
            }
            Some(i) => Region {
                log2_bricks: LOG2_NODE4_BRICKS,
                content: Content::Constant(nodes.entries[i].mean),
                footprint: nodes.footprints[i],
            },
            None => Region {
                log2_bricks: LOG2_NODE4_BRICKS,
                content: Content::Constant(0.0),
                footprint: Bounds::of(0.0),
            },
        }
    }

    /// The content at a brick, remembered for the next call.
    #[inline]
    fn content(&mut self, brick: IVec3) -> Content {
        if brick != self.brick {
            self.content = self.region(brick).content;
            self.brick = brick;
        }
        self.content
    }

    /// The value of a voxel.
    #[inline]
    pub fn voxel(&mut self, index: IVec3) -> f32 {
        match self.content(brick_of(index)) {
            Content::Constant(value) => value,
            Content::Brick(brick) => self.tree.bricks.value(brick, voxel_offset(index)),
        }
    }

    /// The value of the voxel nearest to a point in index space: a voxel's value sits at its integer
    /// coordinate, so this reads `floor(p + ½)`.
    pub fn nearest(&mut self, p_index: Vec3) -> f32 {
        self.voxel((p_index + 0.5).floor().as_ivec3())
    }

    /// The trilinear interpolation at a point in index space: reads `floor(p)` and the seven voxels beyond.
    pub fn trilinear(&mut self, p_index: Vec3) -> f32 {
        let corner = p_index.floor();
        self.trilinear_in_cell(corner.as_ivec3(), p_index - corner)
    }

    /// The trilinear interpolation inside the cell whose lower corner is the voxel `cell`, at `fraction` in
    /// `[0, 1]` along each axis.
    #[inline]
    pub fn trilinear_in_cell(&mut self, cell: IVec3, fraction: Vec3) -> f32 {
        let local = cell & 7;
        let inside = (local.x != 7) & (local.y != 7) & (local.z != 7);
        if !inside {
            return self.trilinear_across_bricks(cell, fraction);
        }
        match self.content(brick_of(cell)) {
            Content::Constant(value) => value,
            Content::Brick(brick) => lerp(self.tree.bricks.corners(brick, voxel_offset(cell)), fraction),
        }
    }

    /// The same where the cell reaches into other bricks.
    fn trilinear_across_bricks(&mut self, cell: IVec3, fraction: Vec3) -> f32 {
        let local = cell & 7;
        let offset = voxel_offset(cell);
        let [fx, fy, fz] = fraction.to_array();
        match (local.x == 7, local.y == 7, local.z == 7) {
            (true, false, false) => self.across_face(cell, offset, IVec3::X, 64, (8, 1), (fx, fy, fz)),
            (false, true, false) => self.across_face(cell, offset, IVec3::Y, 8, (64, 1), (fy, fx, fz)),
            (false, false, true) => self.across_face(cell, offset, IVec3::Z, 1, (64, 8), (fz, fx, fy)),
            _ => self.across_edge(cell, fraction),
        }
    }

    /// Two bricks: bilinear in each, then linear along the axis between them. Most cells at a border are
    /// of this kind. `across` is the offset's step along that axis, `steps` and `f` those of the other two.
    #[inline]
    fn across_face(
        &mut self,
        cell: IVec3,
        offset: usize,
        axis: IVec3,
        across: usize,
        steps: (usize, usize),
        (f, fa, fb): (f32, f32, f32),
    ) -> f32 {
        let brick = brick_of(cell);
        let here = self.content(brick);
        let next = self.region(brick.wrapping_add(axis)).content;
        let bricks = &self.tree.bricks;
        let bilinear = |content: Content, offset: usize| match content {
            Content::Constant(value) => value,
            Content::Brick(brick) => {
                let [v00, v01, v10, v11] = bricks.quad(brick, offset, steps.0, steps.1);
                mix(mix(v00, v01, fb), mix(v10, v11, fb), fa)
            }
        };
        mix(bilinear(here, offset), bilinear(next, offset - 7 * across), f)
    }

    /// Four or eight bricks.
    #[inline(never)]
    fn across_edge(&mut self, cell: IVec3, fraction: Vec3) -> f32 {
        let corner = |i: i32| cell.wrapping_add(IVec3::new(i >> 2, i >> 1 & 1, i & 1));
        lerp([0, 1, 2, 3, 4, 5, 6, 7].map(|i| self.voxel(corner(i))), fraction)
    }
}

/// The trilinear interpolation of eight corners, corner `i` at `dx << 2 | dy << 1 | dz`.
#[inline]
fn lerp(c: [f32; 8], f: Vec3) -> f32 {
    let z = [mix(c[0], c[1], f.z), mix(c[2], c[3], f.z), mix(c[4], c[5], f.z), mix(c[6], c[7], f.z)];
    mix(mix(z[0], z[1], f.y), mix(z[2], z[3], f.y), f.x)
}

#[inline]
fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}
