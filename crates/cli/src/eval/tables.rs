//! The rows of the tables: each channel is stored in every way, and every way is measured.

use std::collections::HashSet;

use glam::{DVec2, IVec3};
use nuage_pipeline::cluster::shapes::{self, Shapes};
use nuage_pipeline::cluster::thesis::{self, Rejection};
use nuage_pipeline::cluster::{Brick, shapes::share};
use nuage_pipeline::eval::scheme::{self, Format, bricks, fog, stored, with_bricks};
use nuage_pipeline::eval::topology::{Masks, Topology, Visits};
use nuage_pipeline::import::linear_transform;
use nuage_pipeline::pack::frame::{ENTRY_BITS_PER_VOXEL, Options};
use nuage_render::camera::Camera;
use nuage_vdb::diff::VoxelDifference;
use nuage_vdb::{AnyTree, Grid, Tree, diff};
use nuage_volume::codec::block::BlockFormat;
use nuage_volume::packed::{Entry, Node, RootCell, Trees, mask};
use nuage_volume::space::{BRICK_VOXELS, NODE4_SLOTS, NODE5_SLOTS};
use rayon::prelude::*;

use crate::eval::Wanted;
use crate::eval::model::{Model, Packed};
use crate::eval::picture::{Difference, Studio, look};
use crate::eval::table::{Cell, Table};
use crate::text::number;

const BC7: Format = Format::Block(BlockFormat::Bc7);

/// The thesis' parameters of clustering: centres, iterations, and the largest variance of bricks that take part.
const CLUSTERINGS: [(usize, u32, f32); 5] =
    [(1000, 5, 0.1), (100, 10, 0.1), (100, 5, 0.01), (100, 5, 0.1), (100, 5, 0.99)];
/// Our own sharing: the largest error of a voxel as a part of the peak, and the least ratio of peak to error in decibels.
const SHARINGS: [(f32, f64); 2] = [(0.03, 45.0), (0.01, 50.0)];
const SHARING_SHAPES: usize = 1000;
const SHARING_ITERATIONS: u32 = 5;

/// The widths of trees that are compared, from the root's children to bricks, and what they are.
const WIDTHS: [(&[u32], &str); 7] = [
    (&[5, 4, 3], "5-4-3"),
    (&[4, 5, 3], "4-5-3"),
    (&[3, 3, 3, 3], "3-3-3-3"),
    (&[4, 4, 3], "4-4-3"),
    (&[4, 4, 4], "4-4-4"),
    (&[5, 3, 4], "5-3-4"),
    (&[1, 1, 1, 1, 1, 1, 1, 1, 1, 3], "octree"),
];

/// The tables as far as they are made.
pub(crate) struct Tables<'w> {
    size: u32,
    is_wanted: &'w dyn Fn(Wanted) -> bool,
    trees: Table,
    formats: Table,
    clusters: Table,
    topology: Table,
}

impl<'w> Tables<'w> {
    /// Tables without rows, for pictures of `size` pixels on a side.
    pub(crate) fn new(size: u32, is_wanted: &'w dyn Fn(Wanted) -> bool) -> Self {
        let table = |wanted: Wanted, title, note: &str, columns: &[[&'static str; 2]]| {
            let first = [["Model", "model"], ["Channel", "channel"]];
            let note = note.replace("SIZE", &format!("{size} × {size}"));
            let columns = first.iter().chain(columns).copied().collect();
            Table { name: wanted.name(), title, note, columns, rows: Vec::new() }
        };
        Tables {
            size,
            is_wanted,
            trees: table(Wanted::Trees, "Trees (thesis, table 3)", TREES_NOTE, TREES_COLUMNS),
            formats: table(
                Wanted::Formats,
                "Formats of bricks (thesis, table 18g)",
                FORMATS_NOTE,
                FORMATS_COLUMNS,
            ),
            clusters: table(
                Wanted::Clusters,
                "Bricks that share their values (thesis, table 19e)",
                CLUSTERS_NOTE,
                CLUSTERS_COLUMNS,
            ),
            topology: table(
                Wanted::Topology,
                "Node sizes (thesis, section 7.2)",
                TOPOLOGY_NOTE,
                TOPOLOGY_COLUMNS,
            ),
        }
    }

    /// The tables that were asked for.
    pub(crate) fn finish(self) -> Vec<Table> {
        let tables = [
            (Wanted::Trees, self.trees),
            (Wanted::Formats, self.formats),
            (Wanted::Clusters, self.clusters),
            (Wanted::Topology, self.topology),
        ];
        tables.into_iter().filter(|(wanted, _)| (self.is_wanted)(*wanted)).map(|(_, table)| table).collect()
    }

    /// Adds the rows of a channel.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub(crate) fn add(&mut self, model: &Model) -> Result<(), String> {
        let is_wanted = |table| (self.is_wanted)(table);
        let row = |cells: Vec<Cell>| {
            [model.name.as_str().into(), model.channel.as_str().into()].into_iter().chain(cells).collect()
        };
        let topology = topology(model.tree(), &[5, 4, 3])?;
        if is_wanted(Wanted::Trees) {
            let packed = Packed::new(model, &Options::default())?;
            self.trees.rows.extend(tree_rows(model, &topology, packed.asset.trees()).into_iter().map(row));
        }
        let is_seen = [Wanted::Formats, Wanted::Clusters, Wanted::Topology].into_iter().any(is_wanted);
        if !is_seen {
            return Ok(());
        }
        let look = look(&model.channel, model.role, self.size)?;
        let mut studio = Studio::new(&look, &model.grid)?;
        if is_wanted(Wanted::Formats) {
            self.formats.rows.extend(format_rows(model, &topology, &mut studio)?.into_iter().map(row));
        }
        if is_wanted(Wanted::Clusters) {
            self.clusters.rows.extend(cluster_rows(model, &mut studio)?.into_iter().map(row));
        }
        if is_wanted(Wanted::Topology) {
            let rows = topology_rows(model, &studio.camera(), self.size)?;
            self.topology.rows.extend(rows.into_iter().map(row));
        }
        Ok(())
    }
}

/// The topology of the bricks of a tree.
fn topology(tree: &Tree<f32>, widths: &[u32]) -> Result<Topology, String> {
    let bricks: Vec<IVec3> = tree.leaves.origins.iter().map(|at| IVec3::from_array(*at) >> 3).collect();
    let too_far = || "its voxels are too far apart for one tree".to_owned();
    Topology::new(&bricks, widths).ok_or_else(too_far)
}

/// How many different masks of voxels that are not background the bricks of a tree have.
fn brick_masks(tree: &Tree<f32>) -> u64 {
    let mask = |brick: &Brick| -> [u64; 8] {
        let word = |values: &[f32]| {
            values.iter().rev().fold(0, |word, value| word << 1 | u64::from(*value != tree.background))
        };
        std::array::from_fn(|i| word(&brick[i * 64..][..64]))
    };
    // That of a node without data counts with those that have none.
    let empty = [0; 8];
    bricks(tree).iter().map(mask).filter(|mask| *mask != empty).collect::<HashSet<_>>().len() as u64
}

const TREES_NOTE: &str = "The thesis' tree has, per frame, one node L1 of 32³ children, all its nodes L2 of 16³, and below \
    those that are not empty all nodes L3 of 8³ voxels; a node is a 32-bit index and a mask: 4100, 516 and 68 bytes. With \
    masks shared (section 6.2) it is two indices, and each mask is stored once. Ours are the arrays of the packed file as it \
    is in memory, bounds of bricks included: L1 is the root and `Node5`, L2 `Node4` and their entries, L3 the entries of \
    bricks; also of those around the volume that interpolation reaches.";

const TREES_COLUMNS: &[[&str; 2]] = &[
    ["Tree", "tree"],
    ["Bricks", "bricks"],
    ["L1 nodes", "l1_nodes"],
    ["L1 bytes", "l1_bytes"],
    ["L2 nodes", "l2_nodes"],
    ["L2 bytes", "l2_bytes"],
    ["L3 nodes", "l3_nodes"],
    ["L3 bytes", "l3_bytes"],
    ["All bytes", "bytes"],
    ["Bytes per brick", "bytes_per_brick"],
];

fn tree_rows(model: &Model, topology: &Topology, ours: &Trees) -> Vec<Vec<Cell>> {
    let count = model.tree().leaves.len();
    let unpacked = topology.unpacked(brick_masks(model.tree()));
    let row = |name: &str, levels: [(u64, u64); 3]| {
        let bytes: u64 = levels.iter().map(|(_, bytes)| bytes).sum();
        let levels = levels.into_iter().flat_map(|(nodes, bytes)| [Cell::Count(nodes), Cell::Count(bytes)]);
        let sums = [Cell::Count(bytes), Cell::Fixed(bytes as f64 / count as f64, 1)];
        [name.into(), count.into()].into_iter().chain(levels).chain(sums).collect()
    };
    let thesis = |masks| [0, 1, 2].map(|i| (unpacked[i].nodes, unpacked[i].bytes(masks)));
    vec![
        row("thesis", thesis(Masks::Own)),
        row("thesis with shared masks", thesis(Masks::Shared)),
        row("nuage", packed_levels(ours)),
    ]
}

/// Nodes and bytes of the levels of packed trees: root and `Node5`; `Node4` and what refers to them; entries of bricks.
fn packed_levels(trees: &Trees) -> [(u64, u64); 3] {
    let masks = |nodes: &[Node], slots: usize| -> u64 {
        let unique: HashSet<u32> = nodes.iter().map(|node| node.mask).collect();
        let words = unique.into_iter().filter_map(|begin| mask::len(&trees.masks, begin, slots));
        words.map(|words| 4 * words as u64).sum()
    };
    let entries = |nodes: &[Node], slots: usize| -> u64 {
        let count = |node: &Node| mask::slots(trees, node.mask, slots).count() as u64;
        nodes.iter().map(count).sum()
    };
    let bytes = |count: u64, each: usize| count * each as u64;
    let (node5s, node4s) = (trees.node5s.len() as u64, trees.node4s.len() as u64);
    let brick_entries = entries(&trees.node4s, NODE4_SLOTS);
    let l1 = bytes(trees.cells.len() as u64, size_of::<RootCell>())
        + bytes(node5s, size_of::<Node>())
        + masks(&trees.node5s, NODE5_SLOTS);
    let l2 = bytes(entries(&trees.node5s, NODE5_SLOTS), size_of::<Entry>())
        + bytes(node4s, size_of::<Node>())
        + masks(&trees.node4s, NODE4_SLOTS);
    [(node5s, l1), (node4s, l2), (brick_entries, bytes(brick_entries, size_of::<Entry>()))]
}

const FORMATS_NOTE: &str = "The thesis stores values as f16, or as fractions of the range of the whole model: in a byte \
    (Unorm), or as texture blocks, those of BC3 and BC7 with four voxels along z in a texel. Ours are packed files by the \
    default (45 dB and 3 % of the peak) and by a budget for the bricks. Bits are per voxel of the source's bricks, \
    without and with the tree. PSNR and largest error are of the channel (`nuage diff`); *background* is by how much voxels \
    that are background in the source differ from it at most. RMSE is of pictures of SIZE pixels in linear radiance, by the \
    deterministic ray marcher with the sun alone, in the view that `nuage render` takes of the source; a flame and a \
    temperature glow on their own. *Of maximum* is RMSE over the largest radiance in the picture of the source. The thesis' \
    figures are of noisy path-traced pictures, and of other models.";

const FORMATS_COLUMNS: &[[&str; 2]] = &[
    ["Format", "format"],
    ["Bits, bricks", "bits_per_voxel_bricks"],
    ["Bits, all", "bits_per_voxel"],
    ["PSNR in dB", "psnr_db"],
    ["Largest error of peak", "max_error_of_peak"],
    ["Background of peak", "background_error_of_peak"],
    ["RMSE", "rmse"],
    ["Of maximum", "rmse_of_max"],
];

/// What is asked of our own formats, and their names.
fn ours() -> [(&'static str, Options); 3] {
    let bits = |bits| {
        // Of the bricks, as the thesis counts.
        let bits_per_voxel = Some(bits + ENTRY_BITS_PER_VOXEL);
        Options { max_error: None, psnr: None, bits_per_voxel, ..Options::default() }
    };
    [("nuage default", Options::default()), ("nuage 4 bits", bits(4.0)), ("nuage 2 bits", bits(2.0))]
}

fn format_rows(model: &Model, topology: &Topology, studio: &mut Studio) -> Result<Vec<Vec<Cell>>, String> {
    let source = bricks(model.tree());
    let range = scheme::range(source);
    let voxels = (source.len() * BRICK_VOXELS) as f64;
    let bits = |bytes: u64| 8.0 * bytes as f64 / voxels;
    let tree_bytes: u64 = topology.unpacked(0).iter().map(|level| level.bytes(Masks::Own)).sum();
    let mut rows = Vec::new();
    let mut add = |name: &str, brick_bytes: u64, tree_bytes: u64, grid: Grid| -> Result<(), String> {
        let [decibels, largest, background] = voxel_cells(model, &grid)?;
        let [rmse, of_max] = picture_cells(studio.compare(grid)?);
        let sizes = [bits(brick_bytes), bits(brick_bytes + tree_bytes)].map(|bits| Cell::Fixed(bits, 2));
        let [alone, all] = sizes;
        rows.push(vec![name.into(), alone, all, decibels, largest, background, rmse, of_max]);
        Ok(())
    };
    for format in Format::ALL {
        let tree = with_bricks(model.tree(), stored(source, format, range));
        let brick_bytes = (source.len() * format.brick_bytes()) as u64;
        add(format.name(), brick_bytes, tree_bytes, model.with_tree(tree))?;
    }
    for (name, options) in ours() {
        let packed = Packed::new(model, &options)?;
        add(name, packed.report.brick_bytes, packed.report.tree_bytes, packed.grid()?)?;
    }
    Ok(rows)
}

/// PSNR, the largest error and what became of the background.
fn voxel_cells(model: &Model, grid: &Grid) -> Result<[Cell; 3], String> {
    let found = voxel_difference(model, grid)?.errors();
    let (decibels, max_error, peak) = (found.psnr(), found.max, found.peak);
    let of_peak = |error: f64| Cell::Digits(if peak > 0.0 { error / peak } else { error }, 3);
    let AnyTree::Float(decoded) = &*grid.tree else { return Err("the values changed their type".to_owned()) };
    let fog = fog(model.tree(), decoded);
    let background = if fog.voxels == 0 { Cell::None } else { of_peak(fog.largest.into()) };
    Ok([Cell::Fixed(decibels, 1), of_peak(max_error), background])
}

fn voxel_difference(model: &Model, grid: &Grid) -> Result<VoxelDifference, String> {
    let options = diff::Options { listed: 0, ..diff::Options::default() };
    diff::grids(&model.grid, grid, &options).voxels.ok_or_else(|| "the tree changed its shape".to_owned())
}

fn picture_cells(difference: Difference) -> [Cell; 2] {
    [Cell::Digits(difference.rmse, 3), Cell::Digits(difference.of_max, 3)]
}

const CLUSTERS_NOTE: &str = "Bricks that vary no more than a threshold are replaced by the nearest of k centres (k-means \
    under the Manhattan distance); others are kept. How much a brick varies, the thesis says in two ways: as the variance of \
    its values once scaled to 0 … 1 (section 4.5), and as their variance over their mean (section 5.3). *Shapes* are ours: a \
    brick is a scale and a bias (8 bytes more) of one of the shapes that many share, where that keeps its error within the \
    threshold, a part of the peak, and the ratio of peak to error. All that is stored is BC7 of the model's range, as in the \
    thesis, and of -1 … 1 for shapes. *Before* and *after* count bricks. RMSE is against the source; the row without \
    clustering is what BC7 alone loses.";

const CLUSTERS_COLUMNS: &[[&str; 2]] = &[
    ["Variance", "variance"],
    ["k", "k"],
    ["Iterations", "iterations"],
    ["Threshold", "threshold"],
    ["Before", "before"],
    ["After", "after"],
    ["Ratio", "ratio"],
    ["Bits, bricks", "bits_per_voxel_bricks"],
    ["PSNR in dB", "psnr_db"],
    ["RMSE", "rmse"],
    ["Of maximum", "rmse_of_max"],
];

fn cluster_rows(model: &Model, studio: &mut Studio) -> Result<Vec<Vec<Cell>>, String> {
    let source = bricks(model.tree());
    let range = scheme::range(source);
    // Each brick is encoded once, whatever it is replaced by.
    let kept = stored(source, BC7, range);
    let mut rows = Vec::new();
    let mut add =
        |first: [Cell; 4], after: usize, extra_bytes: usize, read: Vec<Brick>| -> Result<(), String> {
            let grid = model.with_tree(with_bricks(model.tree(), read));
            let before = source.len();
            let bytes = after * BC7.brick_bytes() + extra_bytes;
            let bits = 8.0 * bytes as f64 / (before * BRICK_VOXELS) as f64;
            let decibels = voxel_difference(model, &grid)?.errors().psnr();
            let [rmse, of_max] = picture_cells(studio.compare(grid)?);
            let ratio = Cell::Fixed(after as f64 / before as f64, 5);
            let rest = [
                before.into(),
                after.into(),
                ratio,
                Cell::Fixed(bits, 3),
                Cell::Fixed(decibels, 1),
                rmse,
                of_max,
            ];
            rows.push(first.into_iter().chain(rest).collect());
            Ok(())
        };
    add(["none".into(), Cell::None, Cell::None, Cell::None], source.len(), 0, kept.clone())?;
    for (name, rejection) in
        [("normalised", Rejection::NormalizedVariance), ("over mean", Rejection::VarianceOverMean)]
    {
        for (clusters, iterations, threshold) in CLUSTERINGS {
            let settings = thesis::Settings { clusters, iterations, rejection, threshold, seed: 1 };
            let mut found = thesis::cluster(source, &settings);
            found.centres = stored(&found.centres, BC7, range);
            let after = found.centres.len() + found.of_brick.iter().filter(|of| of.is_none()).count();
            let first = [
                name.into(),
                clusters.into(),
                (iterations as usize).into(),
                Cell::Text(number(threshold.into())),
            ];
            add(first, after, 0, scheme::clustered(&kept, &found))?;
        }
    }
    let peak = source.iter().flatten().fold(0.0_f32, |peak, value| peak.max(value.abs()));
    for (part, decibels) in SHARINGS {
        let settings = shapes::Settings {
            shapes: SHARING_SHAPES,
            iterations: SHARING_ITERATIONS,
            max_error: part * peak,
            max_mse: peak.powi(2) / 10_f32.powf(decibels as f32 / 10.0),
            seed: 1,
        };
        let found = share(source, &settings);
        let Shapes { shapes, of_brick } = &found;
        let sharing = of_brick.iter().flatten().count();
        let after = shapes.len() + of_brick.len() - sharing;
        let threshold = format!("{part} {decibels} dB");
        let first = [
            "shapes".into(),
            shapes.len().into(),
            (SHARING_ITERATIONS as usize).into(),
            Cell::Text(threshold),
        ];
        let store = |shapes: &[Brick]| stored(shapes, BC7, [-1.0, 1.0]);
        add(first, after, 8 * sharing, scheme::shared(&kept, &found, store))?;
    }
    Ok(rows)
}

const TOPOLOGY_NOTE: &str = "Trees over the same bricks, those of the source, by the log2 widths of their levels from the \
    root's children to bricks; 5-4-3 is ours and the thesis', 4-4-4 and 5-3-4 have bricks of 16³, the octree nine levels \
    above bricks of 8³. *Packed* is as our trees are laid out: only what is there. *Unpacked* is as the thesis', all \
    children of a node that is not empty, each an index and a mask, bricks' masks of voxels included. *Shared* stores equal \
    masks once. Steps are the cells of all levels that a ray visits, in the mean over the pixels of the view above, through \
    the whole volume; bricks are those of them that hold voxels.";

const TOPOLOGY_COLUMNS: &[[&str; 2]] = &[
    ["Widths", "widths"],
    ["Nodes by level", "nodes"],
    ["Bricks", "bricks"],
    ["Voxels", "voxels"],
    ["Packed", "packed_bytes"],
    ["Packed, shared", "packed_shared_bytes"],
    ["Unpacked", "unpacked_bytes"],
    ["Unpacked, shared", "unpacked_shared_bytes"],
    ["Steps per ray", "steps_per_ray"],
    ["Bricks per ray", "bricks_per_ray"],
];

fn topology_rows(model: &Model, camera: &Camera, size: u32) -> Result<Vec<Vec<Cell>>, String> {
    let tree = model.tree();
    let world_from_index =
        linear_transform(&model.channel, &model.grid.transform).map_err(|error| error.to_string())?;
    let index_from_world = world_from_index.inverse();
    let masks_of_8 = brick_masks(tree);
    let mut rows = Vec::new();
    for (widths, name) in WIDTHS {
        let topology = topology(tree, widths)?;
        let visits = (0..size * size)
            .into_par_iter()
            .map(|i| {
                let pixel = DVec2::new(f64::from(i % size) + 0.5, f64::from(i / size) + 0.5);
                let ray = camera.ray(pixel, size, size);
                let origin = index_from_world.transform_point3(ray.origin);
                topology.visits(origin, index_from_world.transform_vector3(ray.direction))
            })
            .reduce(Visits::default, |a, b| Visits { cells: a.cells + b.cells, bricks: a.bricks + b.bricks });
        let rays = f64::from(size) * f64::from(size);
        let nodes: Vec<String> = topology.nodes().iter().map(usize::to_string).collect();
        // Those of larger bricks were not looked at: each could be another.
        let brick_masks = if widths.ends_with(&[3]) { masks_of_8 } else { topology.bricks() as u64 };
        let unpacked = topology.unpacked(brick_masks);
        let sum = |masks| Cell::Count(unpacked.iter().map(|level| level.bytes(masks)).sum());
        rows.push(vec![
            name.into(),
            Cell::Text(nodes.join(" ")),
            topology.bricks().into(),
            Cell::Count(topology.voxels()),
            topology.packed_bytes(Masks::Own).into(),
            topology.packed_bytes(Masks::Shared).into(),
            sum(Masks::Own),
            sum(Masks::Shared),
            Cell::Fixed(visits.cells as f64 / rays, 2),
            Cell::Fixed(visits.bricks as f64 / rays, 2),
        ]);
    }
    Ok(rows)
}
