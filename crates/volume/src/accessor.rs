//! Random access that remembers its path: the fast way to read neighbouring points.
//!
//! An accessor keeps the `Node5`, the `Node4` and the brick it was in last; a look-up starts from the deepest
//! of them that still holds the point. One per thread; making one costs nothing.

use glam::{IVec3, Vec3};

use crate::space::{LOG2_NODE4_BRICKS, NODE5_SLOTS, brick_of, node5_slot, root_cell, voxel_offset};
use crate::tree::{Content, Entry, Region, Tree};

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
                footprint: crate::brick::Bounds::of(0.0),
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

    /// The same where the cell's corners lie in two, four or eight bricks.
    #[inline(never)]
    fn trilinear_across_bricks(&mut self, cell: IVec3, fraction: Vec3) -> f32 {
        let local = cell & 7;
        let last = |c: i32| usize::from(c == 7);
        // Which axes reach into the next brick; corner and brick number their bits `x << 2 | y << 1 | z`.
        let across = last(local.x) << 2 | last(local.y) << 1 | last(local.z);
        let brick = brick_of(cell);
        let mut contents = [self.content(brick); 8];
        for (i, content) in contents.iter_mut().enumerate().skip(1) {
            if i & !across == 0 {
                let step = IVec3::new((i >> 2) as i32, (i >> 1 & 1) as i32, (i & 1) as i32);
                *content = self.region(brick.wrapping_add(step)).content;
            }
        }
        let next = (local + 1) & 7;
        let offset = |i: usize| {
            let x = if i & 4 == 0 { local.x } else { next.x };
            let y = if i & 2 == 0 { local.y } else { next.y };
            let z = if i & 1 == 0 { local.z } else { next.z };
            (x << 6 | y << 3 | z) as usize
        };
        let mut corners = [0.0; 8];
        for (i, corner) in corners.iter_mut().enumerate() {
            *corner = match contents[i & across] {
                Content::Constant(value) => value,
                Content::Brick(brick) => self.tree.bricks.value(brick, offset(i)),
            };
        }
        lerp(corners, fraction)
    }
}

/// The trilinear interpolation of eight corners, corner `i` at `dx << 2 | dy << 1 | dz`.
#[inline]
fn lerp(c: [f32; 8], f: Vec3) -> f32 {
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let z = [mix(c[0], c[1], f.z), mix(c[2], c[3], f.z), mix(c[4], c[5], f.z), mix(c[6], c[7], f.z)];
    mix(mix(z[0], z[1], f.y), mix(z[2], z[3], f.y), f.x)
}
