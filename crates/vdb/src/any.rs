//! A tree of any of the types of values, and a grid that holds one.
//!
//! Code that knows its type works on [`Tree`]; code that takes what a file holds works on [`AnyTree`] and comes to
//! the tree inside by [`with_tree!`](crate::with_tree) or by a cast.

use std::sync::Arc;

use half::f16;

use crate::error::{Error, Result};
use crate::metadata::Metadata;
use crate::points::PointTree;
use crate::stats::{Histogram, IndexBox, Statistics};
use crate::transform::Transform;
use crate::tree::{Shape, Tree};
use crate::value::{Value, ValueMask};

/// A tree of values of some type.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the variants are named as their types")]
pub enum AnyTree {
    Float(Tree<f32>),
    Double(Tree<f64>),
    Half(Tree<f16>),
    Int32(Tree<i32>),
    Int64(Tree<i64>),
    Bool(Tree<bool>),
    Mask(Tree<ValueMask>),
    Vec3s(Tree<[f32; 3]>),
    Vec3d(Tree<[f64; 3]>),
    Vec3i(Tree<[i32; 3]>),
    Points(PointTree),
}

/// Runs an expression on the tree inside an [`AnyTree`], whatever the type of its values:
/// `with_tree!(any, tree => tree.leaves.len())`. Of points, on the tree of their offsets.
#[macro_export]
macro_rules! with_tree {
    ($any:expr, $tree:ident => $body:expr) => {
        match $any {
            $crate::AnyTree::Float($tree) => $body,
            $crate::AnyTree::Double($tree) => $body,
            $crate::AnyTree::Half($tree) => $body,
            $crate::AnyTree::Int32($tree) => $body,
            $crate::AnyTree::Int64($tree) => $body,
            $crate::AnyTree::Bool($tree) => $body,
            $crate::AnyTree::Mask($tree) => $body,
            $crate::AnyTree::Vec3s($tree) => $body,
            $crate::AnyTree::Vec3d($tree) => $body,
            $crate::AnyTree::Vec3i($tree) => $body,
            $crate::AnyTree::Points(points) => {
                let $tree = &points.offsets;
                $body
            }
        }
    };
}

/// What a tree of any type says of one index coordinate.
#[derive(Debug, Clone, PartialEq)]
pub struct AnyVoxel {
    /// The value's numbers: one, or three for vectors. Exact for all types but `int64` beyond 2⁵³.
    pub components: Vec<f64>,
    /// The active state.
    pub active: bool,
    /// Where the value is stored, as in [`crate::Voxel`].
    pub depth: i32,
}

/// A grid: a named tree with a transform.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// The name. The grids of a file may share one.
    pub name: String,
    /// The metadata: class, vector type and whatever else was attached.
    pub metadata: Metadata,
    /// World space from index space.
    pub transform: Transform,
    /// Whether floating-point values are saved as half floats. In memory they have full width.
    pub save_float_as_half: bool,
    /// The voxels. Grids that share a tree are written once.
    pub tree: Arc<AnyTree>,
}

impl Grid {
    /// A grid without metadata.
    pub fn new(name: &str, transform: Transform, tree: impl Into<AnyTree>) -> Self {
        Grid {
            name: name.to_owned(),
            metadata: Metadata::default(),
            transform,
            save_float_as_half: false,
            tree: Arc::new(tree.into()),
        }
    }

    /// `"fog volume"`, `"level set"`, `"staggered"` or `"unknown"`.
    pub fn grid_class(&self) -> &str {
        self.metadata.grid_class()
    }

    /// The type of the tree as files name it: `Tree_float_5_4_3`.
    pub fn grid_type(&self) -> String {
        self.tree.grid_type()
    }
}

impl AnyTree {
    /// The name of the type of the values: `float`, `vec3s`, `ptdataidx32`, …
    pub fn value_type(&self) -> &'static str {
        fn name<V: Value>(_: &Tree<V>) -> &'static str {
            V::NAME
        }
        with_tree!(self, tree => name(tree))
    }

    /// The widths of the nodes.
    pub fn shape(&self) -> Shape {
        with_tree!(self, tree => tree.shape)
    }

    /// The type of the tree as files name it: `Tree_float_5_4_3`.
    pub fn grid_type(&self) -> String {
        let shape = self.shape();
        let widths: Vec<String> = shape.log2_root_to_leaf().iter().map(u8::to_string).collect();
        format!("Tree_{}_{}", self.value_type(), widths.join("_"))
    }

    /// The numbers of the background value.
    pub fn background(&self) -> Vec<f64> {
        with_tree!(self, tree => components(tree.background))
    }

    /// The value, state and depth at an index coordinate.
    pub fn voxel(&self, ijk: [i32; 3]) -> AnyVoxel {
        with_tree!(self, tree => {
            let voxel = tree.voxel(ijk);
            AnyVoxel { components: components(voxel.value), active: voxel.active, depth: voxel.depth }
        })
    }

    /// Counts, boxes and extremes of the tree.
    pub fn statistics(&self) -> Statistics {
        with_tree!(self, tree => tree.statistics())
    }

    /// How one component of the active values is distributed between two bounds.
    pub fn histogram(&self, component: usize, range: [f64; 2], intervals: usize) -> Histogram {
        with_tree!(self, tree => tree.histogram(component, range, intervals))
    }

    /// The number of active voxels, those of tiles included.
    pub fn active_voxel_count(&self) -> u64 {
        with_tree!(self, tree => tree.active_voxel_count())
    }

    /// The box of all active voxels and tiles.
    pub fn active_bbox(&self) -> Option<IndexBox> {
        with_tree!(self, tree => tree.active_bbox())
    }

    /// The memory that the tree's vectors hold, in bytes.
    pub fn memory_bytes(&self) -> u64 {
        match self {
            AnyTree::Points(points) => points.memory_bytes(),
            other => with_tree!(other, tree => tree.memory_bytes()),
        }
    }

    /// As [`Tree::clip`].
    ///
    /// # Errors
    /// As [`Tree::clip`], and [`Error::Unsupported`] for points.
    pub fn clip(&self, bbox: IndexBox, max_memory_bytes: u64) -> Result<AnyTree> {
        Ok(match self {
            AnyTree::Float(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Double(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Half(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Int32(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Int64(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Bool(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Mask(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Vec3s(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Vec3d(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Vec3i(tree) => tree.clip(bbox, max_memory_bytes)?.into(),
            AnyTree::Points(_) => return Err(Error::unsupported("cutting grids of points in memory")),
        })
    }

    /// As [`Tree::topology_hash`].
    pub fn topology_hash(&self) -> u64 {
        with_tree!(self, tree => tree.topology_hash())
    }

    /// As [`Tree::leaf_value_hash`].
    pub fn leaf_value_hash(&self) -> u64 {
        with_tree!(self, tree => tree.leaf_value_hash())
    }

    /// The tree of a float grid.
    pub fn as_float(&self) -> Option<&Tree<f32>> {
        match self {
            AnyTree::Float(tree) => Some(tree),
            _ => None,
        }
    }

    /// The tree with its numbers as single-precision floats: of `float` grids as it is, of `double`, `half`,
    /// `int32` and `int64` grids converted, and rounded where a float is too narrow. `None` for other types.
    pub fn into_float(self) -> Option<Tree<f32>> {
        match self {
            AnyTree::Float(tree) => Some(tree),
            AnyTree::Double(tree) => Some(tree.map(|x| x as f32)),
            AnyTree::Half(tree) => Some(tree.map(f32::from)),
            AnyTree::Int32(tree) => Some(tree.map(|x| x as f32)),
            AnyTree::Int64(tree) => Some(tree.map(|x| x as f32)),
            _ => None,
        }
    }
}

fn components<V: Value>(value: V) -> Vec<f64> {
    (0..V::COMPONENTS).map(|i| value.component(i)).collect()
}

macro_rules! from_tree {
    ($($type:ty => $variant:ident),*) => {
        $(impl From<Tree<$type>> for AnyTree {
            fn from(tree: Tree<$type>) -> Self {
                AnyTree::$variant(tree)
            }
        })*
    };
}

from_tree!(
    f32 => Float, f64 => Double, f16 => Half, i32 => Int32, i64 => Int64, bool => Bool, ValueMask => Mask,
    [f32; 3] => Vec3s, [f64; 3] => Vec3d, [i32; 3] => Vec3i
);

impl From<PointTree> for AnyTree {
    fn from(points: PointTree) -> Self {
        AnyTree::Points(points)
    }
}
