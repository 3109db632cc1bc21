//! Going through two trees of one shape at once.
//!
//! Regions that are one tile, or nothing, on both sides are settled as a whole. Everything else is taken apart down to
//! the leaves; where only one side goes on, the other is that tile all the way. The children of the lowest inner nodes
//! are compared in parallel (feature `parallel`), and the outcome is put together in the order of the tree: it does
//! not depend on the number of threads.

use super::{Options, VoxelDifference, component_error};
use crate::tree::{InternalNode, Tree};
use crate::value::Value;

/// How many nodes wait to be compared together.
const TASKS_AT_ONCE: usize = 1 << 14;

/// What a tree has in some region.
#[derive(Clone, Copy)]
enum Part<V> {
    /// A node or a leaf, by its position in the vector of its level.
    Child(usize),
    /// One value and state.
    Tile(V, bool),
}

/// A region that is to be compared: its level (0 below the root), origin and what the trees have there.
struct Task<V> {
    level: usize,
    origin: [i32; 3],
    a: Part<V>,
    b: Part<V>,
}

struct Walk<'a, V: Value> {
    a: &'a Tree<V>,
    b: &'a Tree<V>,
    options: &'a Options,
    tasks: Vec<Task<V>>,
    total: VoxelDifference,
}

/// Compares two trees of the same shape.
pub(super) fn compare<V: Value>(a: &Tree<V>, b: &Tree<V>, options: &Options) -> VoxelDifference {
    let mut walk = Walk { a, b, options, tasks: Vec::new(), total: VoxelDifference::default() };
    let mut origins = [a, b].map(root_origins).concat();
    origins.sort_unstable();
    origins.dedup();
    for origin in origins {
        let [part_a, part_b] = [a, b].map(|tree| root_part(tree, origin));
        walk.plan(Task { level: 0, origin, a: part_a, b: part_b });
    }
    walk.run();
    for (i, errors) in walk.total.components.iter_mut().enumerate().take(V::COMPONENTS) {
        let background = a.background.component(i).abs();
        errors.peak = errors.peak.max(if background.is_finite() { background } else { 0.0 });
    }
    walk.total
}

fn root_origins<V: Value>(tree: &Tree<V>) -> Vec<[i32; 3]> {
    let tiles = tree.root_tiles.iter().map(|tile| tile.origin);
    match tree.levels.first() {
        Some(nodes) => tiles.chain(nodes.iter().map(|node| node.origin)).collect(),
        None => tiles.chain(tree.leaves.origins.iter().copied()).collect(),
    }
}

fn root_part<V: Value>(tree: &Tree<V>, origin: [i32; 3]) -> Part<V> {
    if let Ok(i) = tree.root_tiles.binary_search_by_key(&origin, |tile| tile.origin) {
        return Part::Tile(tree.root_tiles[i].value, tree.root_tiles[i].active);
    }
    let found = match tree.levels.first() {
        Some(nodes) => nodes.binary_search_by_key(&origin, |node| node.origin),
        None => tree.leaves.origins.binary_search(&origin),
    };
    found.map_or(Part::Tile(tree.background, false), Part::Child)
}

/// What a tree has in a slot of a region of which it has `part`.
fn slot_part<V: Value>(nodes: &[InternalNode<V>], part: Part<V>, slot: usize) -> Part<V> {
    let Part::Child(i) = part else { return part };
    let node = &nodes[i];
    match node.child_mask.contains(slot) {
        true => Part::Child(node.first_child + node.child_mask.rank(slot)),
        false => Part::Tile(node.tiles.value(slot), node.value_mask.contains(slot)),
    }
}

impl<V: Value> Walk<'_, V> {
    /// Takes a region apart into tasks: leaves and nodes right above them.
    fn plan(&mut self, task: Task<V>) {
        let inner = self.a.shape.inner_levels();
        let is_settled = matches!((task.a, task.b), (Part::Tile(..), Part::Tile(..)));
        if is_settled || task.level + 1 >= inner {
            self.tasks.push(task);
            if self.tasks.len() >= TASKS_AT_ONCE {
                self.run();
            }
            return;
        }
        count_nodes(&task, &mut self.total);
        let background = self.a.background;
        self.children(&task, &mut |walk, child| {
            // Most slots of most nodes are the same on both sides.
            if !is_background(&child, background) {
                walk.plan(child);
            }
        });
    }

    /// Compares what has been planned.
    fn run(&mut self) {
        let tasks = std::mem::take(&mut self.tasks);
        let (a, b, options) = (self.a, self.b, self.options);
        let one = |task: &Task<V>| {
            let mut found = VoxelDifference::default();
            compare_region(a, b, options, task, &mut found);
            found
        };
        #[cfg(feature = "parallel")]
        let all: Vec<VoxelDifference> = {
            use rayon::prelude::*;
            tasks.par_iter().map(one).collect()
        };
        #[cfg(not(feature = "parallel"))]
        let all = tasks.iter().map(one);
        for found in all {
            self.total.merge(found, self.options.listed);
        }
    }

    fn children(&mut self, task: &Task<V>, each: &mut dyn FnMut(&mut Self, Task<V>)) {
        let (a, b) = (self.a, self.b);
        for_children(a, b, task, &mut |child| each(self, child));
    }
}

fn for_children<V: Value>(a: &Tree<V>, b: &Tree<V>, task: &Task<V>, each: &mut dyn FnMut(Task<V>)) {
    let branching = a.shape.branching(task.level);
    for slot in 0..branching.slots() {
        each(Task {
            level: task.level + 1,
            origin: branching.child_origin(task.origin, slot),
            a: slot_part(&a.levels[task.level], task.a, slot),
            b: slot_part(&b.levels[task.level], task.b, slot),
        });
    }
}

/// Whether there is nothing to say of a region: inactive, and the background of the first side on both.
fn is_background<V: Value>(task: &Task<V>, background: V) -> bool {
    match (task.a, task.b) {
        (Part::Tile(a, false), Part::Tile(b, false)) => a.same_bits(b) && a.same_bits(background),
        _ => false,
    }
}

fn count_nodes<V>(task: &Task<V>, found: &mut VoxelDifference) {
    match (&task.a, &task.b) {
        (Part::Child(_), Part::Tile(..)) => found.nodes_only_in_a += 1,
        (Part::Tile(..), Part::Child(_)) => found.nodes_only_in_b += 1,
        _ => {}
    }
}

fn compare_region<V: Value>(
    a: &Tree<V>,
    b: &Tree<V>,
    options: &Options,
    task: &Task<V>,
    found: &mut VoxelDifference,
) {
    let shape = a.shape;
    if let (Part::Tile(x, x_on), Part::Tile(y, y_on)) = (task.a, task.b) {
        let log2: u32 = shape.log2_root_to_leaf()[task.level..].iter().map(|log2| u32::from(*log2)).sum();
        let voxels = 1 << (3 * log2).min(63);
        return compare_values([x, y], [x_on, y_on], a.background, voxels, task.origin, options, found);
    }
    count_nodes(task, found);
    if task.level < shape.inner_levels() {
        for_children(a, b, task, &mut |child| {
            if !is_background(&child, a.background) {
                compare_region(a, b, options, &child, found);
            }
        });
        return;
    }
    let log2 = shape.leaf_log2();
    let edge_mask = (1 << log2) - 1;
    let voxel = |tree: &Tree<V>, part: Part<V>, offset: usize| match part {
        Part::Child(leaf) => (tree.leaves.value(leaf, offset), tree.leaves.is_active(leaf, offset)),
        Part::Tile(value, active) => (value, active),
    };
    for offset in 0..shape.leaf_voxels() {
        let (x, x_on) = voxel(a, task.a, offset);
        let (y, y_on) = voxel(b, task.b, offset);
        let local = [2, 1, 0].map(|axis| (offset >> (log2 * axis)) as i32 & edge_mask);
        let ijk = std::array::from_fn(|axis| task.origin[axis].wrapping_add(local[axis]));
        compare_values([x, y], [x_on, y_on], a.background, 1, ijk, options, found);
    }
}

/// Compares two values that fill `voxels` voxels from `ijk` on.
fn compare_values<V: Value>(
    [x, y]: [V; 2],
    [x_on, y_on]: [bool; 2],
    x_background: V,
    voxels: u64,
    ijk: [i32; 3],
    options: &Options,
    found: &mut VoxelDifference,
) {
    let active = x_on || y_on;
    let is_stored = !x.same_bits(x_background);
    if !active && (options.active_only || (x.same_bits(y) && !is_stored)) {
        return;
    }
    let add_to = |count: &mut u64| *count = count.saturating_add(voxels);
    let errors: [f64; 3] =
        std::array::from_fn(|i| if i < V::COMPONENTS { component_error(x, y, i) } else { 0.0 });
    let largest = errors.into_iter().fold(0.0, f64::max);
    if largest > options.tolerance {
        add_to(if active { &mut found.differing_values } else { &mut found.differing_inactive_values });
    }
    if x_on != y_on {
        add_to(&mut found.differing_states);
    }
    if (largest > options.tolerance || x_on != y_on) && found.first.len() < options.listed {
        found.first.push(ijk);
    }
    if active {
        add_to(&mut found.active);
    }
    if !largest.is_finite() {
        add_to(&mut found.not_finite);
    }
    for (i, total) in found.components.iter_mut().enumerate().take(V::COMPONENTS) {
        let (x, y, error) = (x.component(i), y.component(i), errors[i]);
        if (x < 0.0) != (y < 0.0) {
            add_to(&mut total.sign_changes);
        }
        if error > total.max && error.is_finite() {
            (total.max, total.max_at, total.max_values) = (error, Some(ijk), [x, y]);
        }
        if !is_stored {
            if error > total.fog && error.is_finite() {
                (total.fog, total.fog_at) = (error, Some(ijk));
            }
            if largest.is_finite() {
                total.background_squares += error * error * voxels as f64;
            }
            continue;
        }
        if largest.is_finite() {
            add_to(&mut total.compared);
            total.sum += error * voxels as f64;
            total.squares += error * error * voxels as f64;
        }
        total.peak = total.peak.max(if x.is_finite() { x.abs() } else { 0.0 });
    }
}
