//! What differs between two grids: what their headers say, and their voxels as a look-up sees them.
//!
//! Grids of a file are paired by name ([`pair_names`]), their metadata, transforms and types are held against each
//! other, and then value and active state of every voxel. What a difference is worth is said along with it: what
//! only says how a grid is stored, or what every writer notes anew, does not make grids differ. How the two trees are
//! walked lives in the module `walk`; reading files and showing differences is the caller's.

mod walk;

use std::collections::BTreeSet;

use crate::any::{AnyTree, Grid};
use crate::metadata::{MetaValue, Metadata, format_g};
use crate::transform::{Map, Transform};
use crate::tree::Tree;
use crate::value::Value;
use crate::with_tree;

/// What counts as a difference.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Values that are no further apart are equal.
    pub tolerance: f64,
    /// The same for the numbers of transforms.
    pub transform_tolerance: f64,
    /// Whether voxels that are inactive on both sides, and the background, may have any value.
    pub active_only: bool,
    /// How many differing voxels are listed by coordinate.
    pub listed: usize,
}

impl Default for Options {
    /// Everything counts, exactly; ten voxels are listed.
    fn default() -> Self {
        Options { tolerance: 0.0, transform_tolerance: 0.0, active_only: false, listed: 10 }
    }
}

/// Something besides voxels that the two sides say differently.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Disagreement {
    /// What it is about.
    pub what: String,
    /// What the first side says; `None` if nothing.
    pub a: Option<String>,
    /// What the second side says; `None` if nothing.
    pub b: Option<String>,
    /// Whether the grids differ by it. If not, it is about how they are stored.
    pub counts: bool,
}

/// How two grids differ.
#[derive(Debug, Clone, PartialEq)]
pub struct GridDifference {
    /// Types, transforms and metadata.
    pub disagreements: Vec<Disagreement>,
    /// The voxels; `None` if the types or the shapes of the trees do not let them be compared.
    pub voxels: Option<VoxelDifference>,
}

/// How the voxels of two grids differ, over all regions that at least one of them stores.
///
/// Of each count, tiles make up as many voxels as they fill.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VoxelDifference {
    /// Voxels that are active on at least one side.
    pub active: u64,
    /// Those of them whose values are further apart than the tolerance.
    pub differing_values: u64,
    /// Voxels that are inactive on both sides and whose values are further apart than the tolerance.
    pub differing_inactive_values: u64,
    /// Voxels that are active on one side only.
    pub differing_states: u64,
    /// Voxels of which one value is NaN or infinite and the other is not the same. They are in no mean.
    pub not_finite: u64,
    /// The errors of each component; of values that are no vectors, of the first.
    pub components: [Errors; 3],
    /// Nodes and leaves of the first side where the other has a tile or nothing.
    pub nodes_only_in_a: u64,
    /// The reverse.
    pub nodes_only_in_b: u64,
    /// Coordinates of the first differing voxels; of a tile, its smallest one.
    pub first: Vec<[i32; 3]>,
}

/// How far numbers are from those of the first side, the source, over some regions.
///
/// Means are taken over the voxels of the source that differ from its background; with [`Options::active_only`], of
/// those over the voxels that are active on a side. The largest error is that of all voxels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Errors {
    /// The largest finite distance between two numbers.
    pub max: f64,
    /// Where it is met first; of a tile, its smallest coordinate. `None` if all numbers are equal.
    pub max_at: Option<[i32; 3]>,
    /// The two numbers there.
    pub max_values: [f64; 2],
    /// The sum of all finite distances over the voxels that means are taken of.
    pub sum: f64,
    /// The sum of their squares.
    pub squares: f64,
    /// How many distances these are sums of.
    pub compared: u64,
    /// The sum of squared finite distances over all other voxels, where the source has its background.
    pub background_squares: f64,
    /// The largest finite distance over these: fog where there was none.
    pub fog: f64,
    /// Where it is met first.
    pub fog_at: Option<[i32; 3]>,
    /// Voxels whose number is negative on one side alone.
    pub sign_changes: u64,
    /// The largest finite absolute value of the source, its background included.
    pub peak: f64,
}

impl Errors {
    /// The mean distance.
    pub fn mean(&self) -> f64 {
        self.sum / self.compared.max(1) as f64
    }

    /// The root of the mean squared distance.
    pub fn rms(&self) -> f64 {
        (self.squares / self.compared.max(1) as f64).sqrt()
    }

    /// The peak signal-to-noise ratio in decibels, `10·log10(peak² / MSE)`; infinite for equal values.
    pub fn psnr(&self) -> f64 {
        match self.rms() {
            0.0 => f64::INFINITY,
            rms => 20.0 * (self.peak / rms).log10(),
        }
    }

    /// Adds the errors of other numbers: another region, component or frame.
    pub fn merge(&mut self, other: &Errors) {
        if other.max > self.max {
            (self.max, self.max_at, self.max_values) = (other.max, other.max_at, other.max_values);
        }
        if other.fog > self.fog {
            (self.fog, self.fog_at) = (other.fog, other.fog_at);
        }
        self.sum += other.sum;
        self.squares += other.squares;
        self.compared = self.compared.saturating_add(other.compared);
        self.background_squares += other.background_squares;
        self.sign_changes = self.sign_changes.saturating_add(other.sign_changes);
        self.peak = self.peak.max(other.peak);
    }
}

impl VoxelDifference {
    /// Whether all voxels have the same values, up to the tolerance, and the same states.
    pub fn is_equal(&self) -> bool {
        self.differing_values == 0
            && self.differing_inactive_values == 0
            && self.differing_states == 0
            && self.not_finite == 0
    }

    /// The errors of all components together.
    pub fn errors(&self) -> Errors {
        let mut all = Errors::default();
        self.components.iter().for_each(|component| all.merge(component));
        all
    }

    /// Adds what was found in another region, or another frame. Of the differing voxels no more than `listed` stay.
    pub fn merge(&mut self, other: VoxelDifference, listed: usize) {
        let plus = |count: &mut u64, more: u64| *count = count.saturating_add(more);
        plus(&mut self.active, other.active);
        plus(&mut self.differing_values, other.differing_values);
        plus(&mut self.differing_inactive_values, other.differing_inactive_values);
        plus(&mut self.differing_states, other.differing_states);
        plus(&mut self.not_finite, other.not_finite);
        plus(&mut self.nodes_only_in_a, other.nodes_only_in_a);
        plus(&mut self.nodes_only_in_b, other.nodes_only_in_b);
        self.components.iter_mut().zip(&other.components).for_each(|(errors, other)| errors.merge(other));
        self.first.extend(other.first);
        self.first.truncate(listed);
    }
}

impl GridDifference {
    /// Whether the grids are the same: nothing that counts differs.
    pub fn is_equal(&self) -> bool {
        self.has_equal_voxels() && !self.disagreements.iter().any(|d| d.counts)
    }

    /// Whether the voxels are the same, whatever the rest.
    pub fn has_equal_voxels(&self) -> bool {
        self.voxels.as_ref().is_some_and(VoxelDifference::is_equal)
    }
}

/// The grids of two files by their positions.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Pairs {
    /// Those of one name.
    pub both: Vec<[usize; 2]>,
    /// Those of the first file that the second lacks.
    pub only_a: Vec<usize>,
    /// The reverse.
    pub only_b: Vec<usize>,
}

/// Pairs grids of the same unique name. Where a file has a name twice, the first ones are paired first.
pub fn pair_names(a: &[&str], b: &[&str]) -> Pairs {
    let mut pairs = Pairs { only_b: (0..b.len()).collect(), ..Pairs::default() };
    for (i, name) in a.iter().enumerate() {
        match pairs.only_b.iter().position(|j| b[*j] == *name) {
            Some(at) => pairs.both.push([i, pairs.only_b.remove(at)]),
            None => pairs.only_a.push(i),
        }
    }
    pairs
}

/// Compares two grids.
///
/// Values of different types are compared as numbers if both have as many components: `int32` and `int64` exactly,
/// others as doubles, for which both trees are copied. Trees of different shapes are not compared.
pub fn grids(a: &Grid, b: &Grid, options: &Options) -> GridDifference {
    let mut found = Vec::new();
    let mut say = |what: &str, a: String, b: String, counts: bool| {
        if a != b {
            found.push(Disagreement { what: what.into(), a: Some(a), b: Some(b), counts });
        }
    };
    say("name", a.name.clone(), b.name.clone(), true);
    say("type", a.grid_type(), b.grid_type(), true);
    say("class", a.grid_class().into(), b.grid_class().into(), true);
    let half = |grid: &Grid| if grid.save_float_as_half { "half floats" } else { "full width" }.to_owned();
    say("saved as", half(a), half(b), false);
    let is_same_background = with_tree!(&*a.tree, x => match cast(x, &b.tree) {
        Some(y) => is_close(x.background, y.background, options.tolerance),
        None => {
            let (x, y) = (a.tree.background(), b.tree.background());
            x.len() == y.len() && x.iter().zip(&y).all(|(x, y)| is_close(*x, *y, options.tolerance))
        }
    });
    if !is_same_background {
        let spelled = |tree: &AnyTree| match tree {
            // Not every one is a double.
            AnyTree::Int64(tree) => tree.background.to_string(),
            other => spelled(&other.background()),
        };
        say("background", spelled(&a.tree), spelled(&b.tree), !options.active_only);
    }
    found.extend(transforms(&a.transform, &b.transform, options.transform_tolerance));
    // What has been said above in other words.
    let is_said = |d: &Disagreement| ["metadata 'class'", "metadata 'name'"].contains(&d.what.as_str());
    found.extend(metadata(&a.metadata, &b.metadata).into_iter().filter(|d| !is_said(d)));
    if let (AnyTree::Points(x), AnyTree::Points(y)) = (&*a.tree, &*b.tree)
        && x.offsets == y.offsets
        && x != y
    {
        found.push(Disagreement { what: "attributes of points".into(), a: None, b: None, counts: true });
    }
    GridDifference { disagreements: found, voxels: trees(&a.tree, &b.tree, options) }
}

/// Compares the voxels of two trees. `None` if their shapes or the components of their values do not match.
pub fn trees(a: &AnyTree, b: &AnyTree, options: &Options) -> Option<VoxelDifference> {
    if a.shape() != b.shape() || a.background().len() != b.background().len() {
        return None;
    }
    if let Some(difference) = with_tree!(a, x => cast(x, b).map(|y| walk::compare(x, y, options))) {
        return Some(difference);
    }
    let integers = |tree: &AnyTree| match tree {
        AnyTree::Int32(tree) => Some(tree.map(i64::from)),
        AnyTree::Int64(tree) => Some(tree.clone()),
        _ => None,
    };
    if let (Some(a), Some(b)) = (integers(a), integers(b)) {
        return Some(walk::compare(&a, &b, options));
    }
    Some(match a.background().len() {
        1 => {
            let numbers = |any: &AnyTree| with_tree!(any, tree => tree.map(|v| v.component(0)));
            walk::compare(&numbers(a), &numbers(b), options)
        }
        _ => {
            let vectors = |any: &AnyTree| -> Tree<[f64; 3]> {
                with_tree!(any, tree => tree.map(|v| [0, 1, 2].map(|i| v.component(i))))
            };
            walk::compare(&vectors(a), &vectors(b), options)
        }
    })
}

/// The tree inside `any` if its values have the type of those of `like`.
fn cast<'a, V: Value>(_like: &Tree<V>, any: &'a AnyTree) -> Option<&'a Tree<V>> {
    with_tree!(any, tree => (tree as &dyn std::any::Any).downcast_ref())
}

/// Compares transforms. Maps of another kind that do the same do not count.
pub fn transforms(a: &Transform, b: &Transform, tolerance: f64) -> Vec<Disagreement> {
    let numbers = |transform: &Transform| match &transform.map {
        Map::Linear(matrix) => matrix.as_flattened().to_vec(),
        Map::Frustum { index_box, taper, depth, linear } => {
            let sizes = [*taper, *depth];
            [index_box.as_flattened(), &sizes, linear.as_flattened()].concat()
        }
    };
    let mut found = Vec::new();
    if a.type_name != b.type_name {
        let [x, y] = [a, b].map(|transform| Some(transform.type_name.clone()));
        let counts = a.matrix().is_some() != b.matrix().is_some();
        found.push(Disagreement { what: "type of the transform".into(), a: x, b: y, counts });
    }
    let (x, y) = (numbers(a), numbers(b));
    let is_same = x.len() == y.len() && x.iter().zip(&y).all(|(x, y)| is_close(*x, *y, tolerance));
    if !is_same {
        let [x, y] = [x, y].map(|numbers| Some(spelled(&numbers)));
        found.push(Disagreement { what: "transform".into(), a: x, b: y, counts: true });
    }
    found
}

/// Compares metadata by name, type and bytes. What writers note anew, names that begin with `file_` and
/// `is_saved_as_half_float`, does not count.
pub fn metadata(a: &Metadata, b: &Metadata) -> Vec<Disagreement> {
    let names: BTreeSet<&str> = a.iter().chain(b.iter()).map(|(name, _)| name).collect();
    let spelled = |value: &MetaValue| format!("{value} ({})", value.type_name);
    let differing = names.into_iter().filter(|name| a.get(name) != b.get(name));
    differing
        .map(|name| Disagreement {
            what: format!("metadata '{name}'"),
            a: a.get(name).map(spelled),
            b: b.get(name).map(spelled),
            counts: !name.starts_with("file_") && name != "is_saved_as_half_float",
        })
        .collect()
}

/// Whether two values are equal up to a tolerance in each component, NaN equal to itself.
fn is_close<V: Value>(a: V, b: V, tolerance: f64) -> bool {
    (0..V::COMPONENTS).all(|i| component_error(a, b, i) <= tolerance)
}

/// The distance of one component: 0 between NaN and NaN and between equal infinities, ∞ between one of these and
/// anything else.
fn component_error<V: Value>(a: V, b: V, i: usize) -> f64 {
    let distance = a.distance(b, i);
    if !distance.is_nan() {
        return distance;
    }
    let (x, y) = (a.component(i), b.component(i));
    if x == y || (x.is_nan() && y.is_nan()) { 0.0 } else { f64::INFINITY }
}

fn spelled(numbers: &[f64]) -> String {
    let texts: Vec<String> = numbers.iter().map(|x| format_g(*x, 17)).collect();
    match texts.as_slice() {
        [one] => one.clone(),
        more => format!("[{}]", more.join(", ")),
    }
}

#[cfg(test)]
mod tests;
