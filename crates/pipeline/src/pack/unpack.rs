//! From a packed frame back to grids, as the source held them but for what encoding lost.
//!
//! Voxels are active where they differ from the background, inside of the box in which the source's were.

use std::sync::Arc;

use glam::IVec3;
use nuage_vdb::{AnyTree, Grid, Metadata, Shape, Tree, TreeBuilder, Value};
use nuage_volume::codec::DecodeError;
use nuage_volume::format::{Asset, FrameGrid};
use nuage_volume::packed::{Content, Entry, TreeRef, mask};
use nuage_volume::space::{
    BRICK_VOXELS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS, node4_slot_brick, node5_slot_brick,
};

/// Why a frame cannot be unpacked.
#[derive(Debug, thiserror::Error)]
pub enum UnpackError {
    /// There is no such frame.
    #[error("there is no frame {0}")]
    NoFrame(usize),
    /// A brick is damaged.
    #[error(transparent)]
    Brick(#[from] DecodeError),
    /// What was kept of the source is damaged, or the tree is.
    #[error(transparent)]
    Grid(#[from] nuage_vdb::Error),
}

/// The grids of a frame and the metadata of its file. The frame's bricks have been loaded.
///
/// # Errors
/// If there is no such frame, or something in it is damaged.
pub fn unpack_frame(asset: &Asset, frame: usize) -> Result<(Vec<Grid>, Metadata), UnpackError> {
    let contents = asset.contents();
    let grids = &contents.frames.get(frame).ok_or(UnpackError::NoFrame(frame))?.grids;
    let mut file_metadata = Metadata::default();
    let mut unpacked: Vec<Grid> = Vec::new();
    let mut i = 0;
    while let Some(grid) = grids.get(i) {
        let channel = |grid: &FrameGrid| contents.channels.get(grid.channel as usize);
        // The numbers of a vector stand one after the other.
        let count = match channel(grid).and_then(|channel| channel.component) {
            Some(0) if grids.len() >= i + 3 => 3,
            _ => 1,
        };
        let trees =
            grids[i..i + count].iter().map(|grid| float_tree(asset, grid)).collect::<Result<Vec<_>, _>>()?;
        let (header, metadata) = read_header(grid, channel(grid).map_or("", |channel| &channel.name))?;
        file_metadata = metadata;
        unpacked.push(with_values(header, trees, grid.active_box)?);
        i += count;
    }
    Ok((unpacked, file_metadata))
}

/// The grid without its voxels, and the metadata of its file.
fn read_header(grid: &FrameGrid, name: &str) -> Result<(Grid, Metadata), UnpackError> {
    if grid.source_header.is_empty() {
        let transform = match grid.world_from_index {
            Some(m) => nuage_vdb::Transform::affine([
                [m[0], m[1], m[2], 0.0],
                [m[3], m[4], m[5], 0.0],
                [m[6], m[7], m[8], 0.0],
                [m[9], m[10], m[11], 1.0],
            ]),
            None => nuage_vdb::Transform::identity(),
        };
        let tree = Tree::empty(0.0_f32, Shape::STANDARD);
        return Ok((Grid::new(name, transform, tree), Metadata::default()));
    }
    let file = nuage_vdb::File::open(grid.source_header.as_slice())?;
    let mut grid = file.read_grid(0)?;
    // What its writer noted is true of a grid without voxels.
    for noted in ["file_bbox_min", "file_bbox_max", "file_voxel_count", "file_mem_bytes", "file_compression"]
    {
        grid.metadata.remove(noted);
    }
    Ok((grid, file.metadata.clone()))
}

/// A grid like the one given, with these numbers.
fn with_values(grid: Grid, trees: Vec<Tree<f32>>, active_box: ActiveBox) -> Result<Grid, UnpackError> {
    let tree: AnyTree = match (&*grid.tree, <[Tree<f32>; 3]>::try_from(trees)) {
        (AnyTree::Vec3d(like), Ok(trees)) => {
            let (tree, exact) = (zip(&trees, active_box)?, like.background);
            let narrow = tree.background;
            let wide = |value: [f32; 3]| std::array::from_fn(|c| widened(value[c], narrow[c], exact[c]));
            tree.map(wide).into()
        }
        (_, Ok(trees)) => zip(&trees, active_box)?.into(),
        (like, Err(trees)) => {
            let tree = trees.into_iter().next().unwrap_or_else(|| Tree::empty(0.0, Shape::STANDARD));
            match like {
                AnyTree::Double(like) => {
                    let narrow = tree.background;
                    tree.map(|value| widened(value, narrow, like.background)).into()
                }
                AnyTree::Half(_) => tree.map(half::f16::from_f32).into(),
                _ => tree.into(),
            }
        }
    };
    Ok(Grid { tree: Arc::new(tree), ..grid })
}

/// A number of a grid of doubles. The background is the source's to the last bit, if it is what was rounded.
fn widened(value: f32, background: f32, exact: f64) -> f64 {
    if value == background && exact as f32 == background { exact } else { f64::from(value) }
}

/// A tree of vectors from those of their numbers: leaves and tiles wherever one of them has some.
fn zip(trees: &[Tree<f32>; 3], active_box: ActiveBox) -> Result<Tree<[f32; 3]>, UnpackError> {
    let background = [0, 1, 2].map(|c| trees[c].background);
    let at = |origin: [i32; 3]| [0, 1, 2].map(|c| trees[c].voxel(origin).value);
    let mut builder = TreeBuilder::new(background, Shape::STANDARD);
    let mut leaves: Vec<[i32; 3]> =
        trees.iter().flat_map(|tree| tree.leaves.origins.iter().copied()).collect();
    leaves.sort_unstable();
    leaves.dedup();
    for origin in &leaves {
        let values: Vec<[f32; 3]> = (0..BRICK_VOXELS as i32)
            .map(|i| at([origin[0] + (i >> 6), origin[1] + (i >> 3 & 7), origin[2] + (i & 7)]))
            .collect();
        builder.leaf(*origin, &active_mask(&values, background, *origin, active_box), &values);
    }
    let mut tiles: Vec<(usize, [i32; 3])> = Vec::new();
    for tree in trees {
        tiles.extend(tree.root_tiles.iter().map(|tile| (0, tile.origin)));
        for (depth, (branching, node)) in
            tree.inner_nodes().map(|(b, n)| (if b.log2_children == 5 { 1 } else { 2 }, (b, n)))
        {
            let slots = node.tile_slots().filter(|(_, value, _)| *value != tree.background);
            tiles.extend(slots.map(|(slot, _, _)| (depth, branching.child_origin(node.origin, slot))));
        }
    }
    tiles.sort_unstable();
    tiles.dedup();
    for (depth, origin) in tiles {
        // Where another number has something finer, its leaves and tiles cover what differs from the background.
        let is_tile = |tree: &Tree<f32>| tree.voxel(origin).depth <= depth as i32;
        if trees.iter().all(is_tile) {
            put_tile(&mut builder, depth, origin, at(origin), background, active_box);
        }
    }
    Ok(builder.build()?)
}

/// The first and the last active voxel of a source along each axis, if it had any.
type ActiveBox = Option<[[i32; 3]; 2]>;

fn active_mask<V: PartialEq>(
    values: &[V],
    background: V,
    origin: [i32; 3],
    active_box: ActiveBox,
) -> Vec<u64> {
    let word = |values: &[V]| {
        values.iter().enumerate().fold(0, |word, (i, value)| word | u64::from(*value != background) << i)
    };
    let is_whole = is_inside(origin, TILE_SIDES[2], active_box);
    // A word of the mask is a layer of voxels of the same x, a byte of it a row of the same y.
    let inside = |x: i32| {
        let is_in =
            |i: i32| is_inside([origin[0] + x, origin[1] + (i >> 3), origin[2] + (i & 7)], 1, active_box);
        (0..64).filter(|i| is_whole || is_in(*i)).fold(0, |word, i| word | 1_u64 << i)
    };
    values.chunks(64).zip(0..).map(|(values, x)| word(values) & inside(x)).collect()
}

/// The voxels along a side of tiles, and of bricks, by how many levels stand above them.
const TILE_SIDES: [i32; 3] = [4096, 128, 8];

/// Adds a tile, which is active if all of it may be. A brick of one value of which only a part is active is a leaf.
fn put_tile<V: Value<Stored = V>>(
    builder: &mut TreeBuilder<V>,
    depth: usize,
    origin: [i32; 3],
    value: V,
    background: V,
    active_box: ActiveBox,
) {
    let is_active = is_inside(origin, TILE_SIDES[depth], active_box);
    if depth == 2 && !is_active {
        let values = [value; BRICK_VOXELS];
        let active = active_mask(&values, background, origin, active_box);
        if active.iter().any(|word| *word != 0) {
            return builder.leaf(origin, &active, &values);
        }
    }
    builder.tile(depth, origin, value, is_active);
}

/// Whether all voxels of a cube lie inside of a box.
fn is_inside(origin: [i32; 3], side: i32, active_box: ActiveBox) -> bool {
    let Some([min, max]) = active_box else { return false };
    (0..3).all(|axis| origin[axis] >= min[axis] && origin[axis] <= max[axis].saturating_sub(side - 1))
}

/// The numbers of a channel of a frame, in the finest level.
fn float_tree(asset: &Asset, grid: &FrameGrid) -> Result<Tree<f32>, UnpackError> {
    let none = TreeRef { first_cell: 0, cell_count: 0, background: 0.0 };
    let tree = grid.levels.first().copied().unwrap_or(none);
    let channel = asset.contents().channels.get(grid.channel as usize);
    let (unit, floor) = channel.map_or((1.0, f32::MIN), |channel| (channel.unit, channel.floor));
    let mut walk = Walk {
        asset,
        builder: TreeBuilder::new(tree.background, Shape::STANDARD),
        background: tree.background,
        active_box: grid.active_box,
        offset: IVec3::from_array(grid.index_offset),
        unit,
        floor,
    };
    for cell in asset.trees().cells_of(tree) {
        walk.cell(IVec3::from_array(cell.cell) << LOG2_NODE5_BRICKS, cell.entry)?;
    }
    Ok(walk.builder.build()?)
}

struct Walk<'a> {
    asset: &'a Asset,
    builder: TreeBuilder<f32>,
    background: f32,
    active_box: ActiveBox,
    offset: IVec3,
    unit: f32,
    floor: f32,
}

impl Walk<'_> {
    /// The first voxel of a brick in the source's index space.
    fn origin(&self, brick: IVec3) -> [i32; 3] {
        let first: IVec3 = brick << 3;
        first.wrapping_add(self.offset).to_array()
    }

    fn tile(&mut self, depth: usize, brick: IVec3, value: f32) {
        if value != self.background {
            let origin = self.origin(brick);
            put_tile(&mut self.builder, depth, origin, value, self.background, self.active_box);
        }
    }

    fn cell(&mut self, brick: IVec3, entry: Entry) -> Result<(), UnpackError> {
        let trees = self.asset.trees();
        let node = match entry.content() {
            Some(Content::Constant(value)) => {
                self.tile(0, brick, value);
                return Ok(());
            }
            Some(Content::Node(node)) => trees.node5s.get(node as usize),
            _ => None,
        };
        let Some(node) = node else { return Ok(()) };
        let entries = trees.entries.get(node.first_entry as usize..).unwrap_or_default();
        for (slot, entry) in mask::slots(trees, node.mask, NODE5_SLOTS).zip(entries) {
            let brick = node5_slot_brick(brick, slot);
            match entry.content() {
                Some(Content::Constant(value)) => self.tile(1, brick, value),
                Some(Content::Node(node)) => self.node4(brick, node)?,
                _ => {}
            }
        }
        Ok(())
    }

    fn node4(&mut self, first: IVec3, node: u32) -> Result<(), UnpackError> {
        let trees = self.asset.trees();
        let Some(node) = trees.node4s.get(node as usize) else { return Ok(()) };
        let entries = trees.entries.get(node.first_entry as usize..).unwrap_or_default();
        let mut values = [0.0; BRICK_VOXELS];
        for (slot, entry) in mask::slots(trees, node.mask, NODE4_SLOTS).zip(entries) {
            let brick = node4_slot_brick(first, slot);
            match entry.content() {
                Some(Content::Constant(value)) => self.tile(2, brick, value),
                Some(Content::Brick { codec, offset }) => {
                    self.asset.store().decode(codec, offset, self.unit, self.floor, &mut values)?;
                    let origin = self.origin(brick);
                    let active = active_mask(&values, self.background, origin, self.active_box);
                    self.builder.leaf(origin, &active, &values);
                }
                _ => {}
            }
        }
        Ok(())
    }
}
