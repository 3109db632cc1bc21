//! From a VDB grid to a channel: what each kind of grid means as a medium.
//!
//! - A value is a density: negative values and NaN count as 0, +∞ as the largest finite number; how many there
//!   were is reported.
//! - The medium ends at the box of active voxels. Inside it values count whether active or not, the background
//!   included; outside it everything is 0.
//! - A level set becomes a fog: 0 outside, rising to 1 at the depth of its band and beyond.
//! - A grid without active voxels is an empty channel.
//!
//! Leaves that turn out constant become tiles, and those that are zero vanish.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DAffine3, DMat3, DVec3, IVec3};
use half::f16;
use half::slice::HalfFloatSliceExt;
use nuage_vdb::{Grid, LEVEL4, LEVEL5, Shape, Transform, Tree};
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{BuildError, TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::BRICK_VOXELS;

/// The most root cells (4096³ voxels each) that a background other than zero may fill.
const MAX_BACKGROUND_CELLS: i64 = 4096;

/// The most regions of 128³ voxels of one value that the active box may cut: each becomes up to 4096 tiles. That
/// takes up to about half a gigabyte; a box of 2000³ voxels full of background takes 1500.
const MAX_CUT_REGIONS: u64 = 1 << 12;
/// A region of 4096³ counts for as many: it becomes up to 32768 tiles, each of which takes longer.
const CUT_REGIONS_PER_NODE5: u64 = 64;

/// Why a grid cannot become a channel.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ImportError {
    /// The values are no single numbers.
    #[error("unsupported: grid '{grid}' holds values of type '{value_type}'; a medium is made of numbers")]
    ValueType {
        /// The grid.
        grid: String,
        /// The type of its values.
        value_type: String,
    },
    /// The tree has nodes of other sizes than OpenVDB's standard ones.
    #[error(
        "unsupported: grid '{grid}' has a tree of type '{grid_type}'; only trees of 5_4_3 can be rendered"
    )]
    Shape {
        /// The grid.
        grid: String,
        /// The type of the tree.
        grid_type: String,
    },
    /// The transform is one that straight rays cannot be taken through.
    #[error("unsupported: grid '{grid}' has a {transform}; only linear transforms can be rendered")]
    NonlinearTransform {
        /// The grid.
        grid: String,
        /// The type of its map.
        transform: String,
    },
    /// The transform flattens space or holds numbers that are none.
    #[error("grid '{grid}' has a transform that cannot be inverted")]
    SingularTransform {
        /// The grid.
        grid: String,
    },
    /// The background is not zero and its region is too large.
    #[error(
        "grid '{grid}' fills {cells} cells of 4096³ voxels with its background, over the limit of {limit}"
    )]
    Background {
        /// The grid.
        grid: String,
        /// How many cells.
        cells: i64,
        /// How many there may be.
        limit: i64,
    },
    /// The tree became too large, or the grid's regions overlap.
    #[error("grid '{grid}': {source}")]
    Build {
        /// The grid.
        grid: String,
        /// What went wrong.
        source: BuildError,
    },
}

/// What was changed on the way from grid to medium: values inside the active box that mean something else there.
/// Each voxel of a leaf counts, each tile once however large it is, and the background once.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Report {
    /// Values that were not a number and count as 0.
    pub nan_values: u64,
    /// Values below zero that count as 0; in a level set none.
    pub negative_values: u64,
    /// Values of +∞ that count as the largest finite number.
    pub infinite_values: u64,
    /// The depth in world units at which a level set's fog reaches 1, if the grid was one.
    pub level_set_band: Option<f32>,
}

/// How values become densities.
#[derive(Debug, Clone, Copy)]
enum Meaning {
    Density,
    /// Signed distance; the fog reaches 1 at this depth.
    LevelSet {
        band: f32,
    },
    /// Signed distance, kept as such: from 0 outside of the band over `band` at the surface to twice that inside.
    Surface {
        band: f32,
    },
}

impl Meaning {
    fn of(grid: &Grid, tree: &Tree<f32>) -> Self {
        if !is_level_set(grid) {
            return Meaning::Density;
        }
        Meaning::LevelSet { band: Meaning::band(grid, tree) }
    }

    fn band(grid: &Grid, tree: &Tree<f32>) -> f32 {
        let background = tree.background.abs();
        let usable = background.is_finite() && background > 0.0;
        // A level set's background is the width of its band: three voxels unless said otherwise.
        if usable { background } else { 3.0 * grid.transform.voxel_size()[0] as f32 }
    }

    /// A value that becomes 0.
    fn empty(self) -> f32 {
        match self {
            Meaning::Density | Meaning::LevelSet { .. } => 0.0,
            Meaning::Surface { band } => band,
        }
    }

    fn density(self, value: f32) -> f32 {
        match self {
            // The comparison is false for NaN.
            Meaning::Density if value > 0.0 => value.min(f32::MAX),
            Meaning::LevelSet { band } if value < 0.0 => (-value / band).min(1.0),
            Meaning::Surface { band } if value < band => (band - value).min(2.0 * band),
            _ => 0.0,
        }
    }
}

/// Turns a grid into a channel of density, temperature or anything else that is not negative.
///
/// # Errors
/// If the transform is not linear and invertible, or the tree becomes too large.
pub fn import(grid: Grid) -> Result<(Channel, Report), ImportError> {
    import_as(grid, Meaning::of)
}

/// Whether a grid says that it is a level set.
pub fn is_level_set(grid: &Grid) -> bool {
    grid.grid_class() == "level set"
}

/// Turns a level set into a channel that is to be drawn as a surface: the distance of the band's outer end, 0 there, twice the
/// width of the band beyond its inner end. The surface is where it reaches the width, which is returned too.
///
/// # Errors
/// If the transform is not linear and invertible, or the tree becomes too large.
pub fn import_surface(grid: Grid) -> Result<(Channel, f32), ImportError> {
    let mut level = 0.0;
    let (channel, _) = import_as(grid, |grid, tree| {
        level = Meaning::band(grid, tree);
        Meaning::Surface { band: level }
    })?;
    Ok((channel, level))
}

fn import_as(
    mut grid: Grid,
    meaning: impl FnOnce(&Grid, &Tree<f32>) -> Meaning,
) -> Result<(Channel, Report), ImportError> {
    let world_from_index = linear_transform(&grid.name, &grid.transform)?;
    let name = grid.name.clone();
    let tree = take_tree(&mut grid)?;
    let active_box = tree
        .active_bbox()
        .map(|[min, max]| IndexBox { min: IVec3::from_array(min), max: IVec3::from_array(max) });
    let build_error = |source| ImportError::Build { grid: name.clone(), source };
    let Some(clip) = active_box else {
        let tree = TreeBuilder::new().finish(Bricks::F32(Vec::new())).map_err(build_error)?;
        return Ok((Channel { tree, world_from_index, active_box }, Report::default()));
    };
    let meaning = meaning(&grid, &tree);
    let may_be_half = grid.save_float_as_half && matches!(meaning, Meaning::Density);
    let mut importer = Importer {
        meaning,
        clip,
        builder: TreeBuilder::new(),
        report: Report::default(),
        tile_bricks: Vec::new(),
        placed: HashMap::new(),
        cut_regions: 0,
    };
    importer.background(&tree, &name)?;
    importer.tiles(&tree).map_err(build_error)?;
    let bricks = importer.leaves(tree, may_be_half).map_err(build_error)?;
    let tree = importer.builder.finish(bricks).map_err(build_error)?;
    Ok((Channel { tree, world_from_index, active_box }, importer.report))
}

/// Takes the tree out of a grid, as single-precision numbers.
fn take_tree(grid: &mut Grid) -> Result<Tree<f32>, ImportError> {
    let shape = grid.tree.shape();
    if shape != Shape::STANDARD {
        return Err(ImportError::Shape { grid: grid.name.clone(), grid_type: grid.grid_type() });
    }
    let value_type = grid.tree.value_type();
    let taken = std::mem::replace(&mut grid.tree, Arc::new(Tree::empty(0.0_f32, shape).into()));
    // A tree that others share is copied.
    let tree = Arc::try_unwrap(taken).unwrap_or_else(|shared| (*shared).clone());
    tree.into_float()
        .ok_or_else(|| ImportError::ValueType { grid: grid.name.clone(), value_type: value_type.to_owned() })
}

/// The affine transform of the grid of that name.
///
/// # Errors
/// If it is not linear or cannot be inverted.
pub fn linear_transform(grid: &str, transform: &Transform) -> Result<DAffine3, ImportError> {
    let rows = transform.matrix().ok_or_else(|| ImportError::NonlinearTransform {
        grid: grid.to_owned(),
        transform: transform.type_name.clone(),
    })?;
    // The rows of a row-vector matrix are the images of the axes.
    let [x, y, z, translation] = rows.map(|row| DVec3::new(row[0], row[1], row[2]));
    let affine = DAffine3 { matrix3: DMat3::from_cols(x, y, z), translation };
    // The volume that the axes span, next to that of a box of their lengths. False for NaN.
    let spans_space = affine.matrix3.determinant().abs() > 1e-12 * x.length() * y.length() * z.length();
    match spans_space && affine.inverse().is_finite() {
        true => Ok(affine),
        false => Err(ImportError::SingularTransform { grid: grid.to_owned() }),
    }
}

struct Importer {
    meaning: Meaning,
    clip: IndexBox,
    builder: TreeBuilder,
    report: Report,
    /// Values of bricks that stem from tiles cut by the clip box. They come before those of the leaves.
    tile_bricks: Vec<f32>,
    /// Such bricks by the part that is filled and the bits of the value: many are alike.
    placed: HashMap<(IVec3, IVec3, u32), u32>,
    /// How many regions were cut so far, at most [`MAX_CUT_REGIONS`].
    cut_regions: u64,
}

impl Importer {
    /// Fills the clip box with the background wherever the root has no entry.
    fn background(&mut self, tree: &Tree<f32>, name: &str) -> Result<(), ImportError> {
        let (min, max): (IVec3, IVec3) = (self.clip.min >> 12, self.clip.max >> 12);
        // At most 2⁶⁰: coordinates have 32 bits.
        let cells = (max - min + 1).as_i64vec3().element_product();
        let nodes5 = &tree.levels[0];
        let origins = nodes5.iter().map(|node| node.origin);
        let stored = origins.chain(tree.root_tiles.iter().map(|tile| tile.origin)).filter(|origin| {
            let cell: IVec3 = IVec3::from_array(*origin) >> 12;
            cell.cmpge(min).all() && cell.cmple(max).all()
        });
        if cells == stored.count() as i64 {
            return Ok(());
        }
        self.note(tree.background);
        let value = self.meaning.density(tree.background);
        if value == 0.0 {
            return Ok(());
        }
        let name = || name.to_owned();
        if cells > MAX_BACKGROUND_CELLS {
            return Err(ImportError::Background { grid: name(), cells, limit: MAX_BACKGROUND_CELLS });
        }
        for x in min.x..=max.x {
            for y in min.y..=max.y {
                for z in min.z..=max.z {
                    let origin = [x << 12, y << 12, z << 12];
                    let stored = nodes5.binary_search_by_key(&origin, |n| n.origin).is_ok()
                        || tree.root_tiles.binary_search_by_key(&origin, |t| t.origin).is_ok();
                    if !stored {
                        self.constant(IVec3::from_array(origin) >> 3, TileSize::Node5, value)
                            .map_err(|source| ImportError::Build { grid: name(), source })?;
                    }
                }
            }
        }
        Ok(())
    }

    fn tiles(&mut self, tree: &Tree<f32>) -> Result<(), BuildError> {
        for tile in &tree.root_tiles {
            self.tile(tile.origin, TileSize::Node5, tile.value)?;
        }
        for (nodes, level, size) in
            [(&tree.levels[0], LEVEL5, TileSize::Node4), (&tree.levels[1], LEVEL4, TileSize::Brick)]
        {
            for node in nodes {
                for (slot, value, _) in node.tile_slots() {
                    self.tile(level.child_origin(node.origin, slot), size, value)?;
                }
            }
        }
        Ok(())
    }

    fn tile(&mut self, origin: [i32; 3], size: TileSize, value: f32) -> Result<(), BuildError> {
        let brick = IVec3::from_array(origin) >> 3;
        if value == self.meaning.empty() || self.inside(brick, size).is_none() {
            return Ok(());
        }
        self.note(value);
        self.constant(brick, size, self.meaning.density(value))
    }

    /// Reports a value that does not count as it is.
    fn note(&mut self, value: f32) {
        self.report.nan_values += u64::from(value.is_nan());
        if matches!(self.meaning, Meaning::Density) {
            self.report.negative_values += u64::from(value < 0.0);
            self.report.infinite_values += u64::from(value == f32::INFINITY);
        }
    }

    /// The part of a region that lies in the clip box, relative to the region: first and last voxel.
    fn inside(&self, brick: IVec3, size: TileSize) -> Option<(IVec3, IVec3)> {
        let first: IVec3 = brick << 3;
        let (min, max) = (self.clip.min.max(first), self.clip.max.min(first + (voxels(size) - 1)));
        // The differences are small where the two overlap, and may overflow elsewhere.
        min.cmple(max).all().then(|| (min - first, max - first))
    }

    /// Adds a region of one value, cut to the clip box.
    fn constant(&mut self, brick: IVec3, size: TileSize, value: f32) -> Result<(), BuildError> {
        let Some((min, max)) = self.inside(brick, size).filter(|_| value != 0.0) else { return Ok(()) };
        if min == IVec3::ZERO && max == IVec3::splat(voxels(size) - 1) {
            return self.builder.tile(brick, size, value);
        }
        let (child, regions) = match size {
            TileSize::Brick => return self.cut_brick(brick, min, max, value),
            TileSize::Node4 => (TileSize::Brick, 1),
            TileSize::Node5 => (TileSize::Node4, CUT_REGIONS_PER_NODE5),
        };
        self.cut_regions += regions;
        if self.cut_regions > MAX_CUT_REGIONS {
            let what = "regions of 128³ voxels of one value that the active box cuts";
            return Err(BuildError::Limit { what, limit: MAX_CUT_REGIONS });
        }
        let (first, last) = (min / voxels(child), max / voxels(child));
        for x in first.x..=last.x {
            for y in first.y..=last.y {
                for z in first.z..=last.z {
                    let step = IVec3::new(x, y, z) * (voxels(child) / 8);
                    self.constant(brick + step, child, value)?;
                }
            }
        }
        Ok(())
    }

    fn cut_brick(&mut self, brick: IVec3, min: IVec3, max: IVec3, value: f32) -> Result<(), BuildError> {
        let key = (min, max, value.to_bits());
        if let Some(index) = self.placed.get(&key) {
            return self.builder.brick_again(brick, *index);
        }
        let mut values = [value; BRICK_VOXELS];
        clear_outside(&mut values, min, max, 0.0);
        self.tile_bricks.extend_from_slice(&values);
        let index = self.builder.brick(brick, BrickSummary::of(&values))?;
        self.placed.insert(key, index);
        Ok(())
    }

    /// Adds all leaves; gives the values of all bricks.
    fn leaves(&mut self, tree: Tree<f32>, may_be_half: bool) -> Result<Bricks, BuildError> {
        let Importer { meaning, clip, .. } = *self;
        let leaves = tree.leaves;
        let origins = leaves.origins;
        let mut values = leaves.values;
        let found: Vec<Leaf> = map_leaves(&mut values, &origins, |origin, values| {
            convert_leaf(origin, values, meaning, clip, may_be_half)
        });

        if let Meaning::LevelSet { band } = meaning {
            self.report.level_set_band = Some(band);
        }
        let mut kept = Vec::with_capacity(found.len());
        let mut exact_in_half = may_be_half && self.tile_bricks.iter().all(|v| is_exact_in_half(*v));
        for (i, leaf) in found.iter().enumerate() {
            self.report.nan_values += u64::from(leaf.nan);
            self.report.negative_values += u64::from(leaf.negative);
            self.report.infinite_values += u64::from(leaf.infinite);
            let brick = IVec3::from_array(origins[i]) >> 3;
            let bounds = leaf.summary.low_bounds[0];
            if !bounds.is_constant() {
                self.builder.brick(brick, leaf.summary)?;
                kept.push(i);
                exact_in_half &= leaf.exact_in_half;
            } else if bounds.max != 0.0 {
                self.builder.tile(brick, TileSize::Brick, bounds.max)?;
            }
        }
        drop(found);
        let tile_bricks = std::mem::take(&mut self.tile_bricks);
        Ok(if exact_in_half {
            let mut packed = vec![0u16; tile_bricks.len() + kept.len() * BRICK_VOXELS];
            let (first, rest) = packed.split_at_mut(tile_bricks.len());
            to_half_bits(&tile_bricks, first);
            copy_kept(&values, &kept, rest, to_half_bits);
            Bricks::F16(packed)
        } else if tile_bricks.is_empty() && kept.len() == origins.len() {
            Bricks::F32(values)
        } else {
            let mut packed = vec![0f32; tile_bricks.len() + kept.len() * BRICK_VOXELS];
            let (first, rest) = packed.split_at_mut(tile_bricks.len());
            first.copy_from_slice(&tile_bricks);
            copy_kept(&values, &kept, rest, |from, to| to.copy_from_slice(from));
            Bricks::F32(packed)
        })
    }
}

/// The voxels per axis of a tile.
fn voxels(size: TileSize) -> i32 {
    match size {
        TileSize::Brick => 8,
        TileSize::Node4 => 128,
        TileSize::Node5 => 4096,
    }
}

/// What becomes of a leaf.
struct Leaf {
    summary: BrickSummary,
    nan: u16,
    negative: u16,
    infinite: u16,
    exact_in_half: bool,
}

/// Turns the values of a leaf into densities, in place.
fn convert_leaf(
    origin: [i32; 3],
    values: &mut [f32; BRICK_VOXELS],
    meaning: Meaning,
    clip: IndexBox,
    may_be_half: bool,
) -> Leaf {
    let origin = IVec3::from_array(origin);
    let inside_min = (clip.min.saturating_sub(origin)).max(IVec3::ZERO);
    let inside_max = (clip.max.saturating_sub(origin)).min(IVec3::splat(7));
    if inside_min != IVec3::ZERO || inside_max != IVec3::splat(7) {
        clear_outside(values, inside_min, inside_max, meaning.empty());
    }
    let (mut nan, mut negative, mut infinite) = (0, 0, 0);
    // The bits of NaN, negative values and infinities are larger than those of densities; few leaves hold any.
    let largest = values.iter().fold(0, |largest, v| v.to_bits().max(largest));
    if largest > f32::MAX.to_bits() || !matches!(meaning, Meaning::Density) {
        let count = |test: fn(&f32) -> bool| values.iter().filter(|v| test(v)).count() as u16;
        nan = count(|v| v.is_nan());
        if matches!(meaning, Meaning::Density) {
            (negative, infinite) = (count(|v| *v < 0.0), count(|v| *v == f32::INFINITY));
        }
        for value in values.iter_mut() {
            *value = meaning.density(*value);
        }
    }
    // Without a branch in the loop, so that it becomes vector instructions.
    let all_exact = || values.iter().fold(true, |all, value| all & is_exact_in_half(*value));
    let exact_in_half = may_be_half && all_exact();
    Leaf { summary: BrickSummary::of(values), nan, negative, infinite, exact_in_half }
}

/// Sets the voxels of a brick outside the local box `[min, max]` to what is empty.
fn clear_outside(values: &mut [f32; BRICK_VOXELS], min: IVec3, max: IVec3, empty: f32) {
    for (offset, value) in values.iter_mut().enumerate() {
        let offset = offset as i32;
        let local = IVec3::new(offset >> 6, offset >> 3 & 7, offset & 7);
        if local.cmplt(min).any() || local.cmpgt(max).any() {
            *value = empty;
        }
    }
}

/// Whether a half float holds a density exactly: a multiple of the smallest one, 2⁻²⁴, with at most eleven
/// significant bits, below 65536.
fn is_exact_in_half(density: f32) -> bool {
    // Numbers from ½ to 1 are the multiples of 2⁻²⁴ there, so the sum is rounded to one.
    let is_multiple = (density + 0.5) - 0.5 == density;
    let is_short = density.to_bits() & 0x1fff == 0;
    is_multiple & is_short & (density < 65536.0)
}

fn to_half_bits(from: &[f32], to: &mut [u16]) {
    use half::slice::HalfBitsSliceExt;
    to.reinterpret_cast_mut::<f16>().convert_from_f32_slice(from);
}

/// Runs `convert` on every leaf, in parallel where the feature is on.
fn map_leaves<T: Send>(
    values: &mut [f32],
    origins: &[[i32; 3]],
    convert: impl Fn([i32; 3], &mut [f32; BRICK_VOXELS]) -> T + Sync,
) -> Vec<T> {
    let convert = |(values, origin): (&mut [f32], &[i32; 3])| {
        convert(*origin, values.try_into().expect("512 values per leaf"))
    };
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        values.par_chunks_exact_mut(BRICK_VOXELS).zip(origins).with_min_len(64).map(convert).collect()
    }
    #[cfg(not(feature = "parallel"))]
    values.chunks_exact_mut(BRICK_VOXELS).zip(origins).map(convert).collect()
}

/// Copies the values of some leaves side by side.
fn copy_kept<T: Send>(values: &[f32], kept: &[usize], to: &mut [T], copy: impl Fn(&[f32], &mut [T]) + Sync) {
    let copy = |(to, leaf): (&mut [T], &usize)| {
        copy(&values[leaf * BRICK_VOXELS..(leaf + 1) * BRICK_VOXELS], to);
    };
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        to.par_chunks_exact_mut(BRICK_VOXELS).zip(kept).with_min_len(64).for_each(copy);
    }
    #[cfg(not(feature = "parallel"))]
    to.chunks_exact_mut(BRICK_VOXELS).zip(kept).for_each(copy);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exactly_what_a_half_float_holds_is_exact_in_half() {
        for bits in 0..=f16::MAX.to_bits() {
            let value = f16::from_bits(bits).to_f32();
            assert!(is_exact_in_half(value), "{value}");
            // Values around it: the next floats, and those with each of the bits that a half float lacks.
            let near =
                (0..14).flat_map(|i| [value.to_bits() + (1 << i), value.to_bits().saturating_sub(1 << i)]);
            for near in near.map(f32::from_bits) {
                assert_eq!(is_exact_in_half(near), f16::from_f32(near).to_f32() == near, "{near}");
            }
        }
        for large in [65520.0, 65536.0, 131072.0, f32::MAX] {
            assert!(!is_exact_in_half(large), "{large}");
        }
    }
}
