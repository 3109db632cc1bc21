//! Small .vdb files after the history of the format, made from plain descriptions: versions 213 to 226, other
//! tree configurations, shared trees, streams and value types that no real file at hand has.
//!
//! [`SyntheticFile::bytes`] writes a description, [`SyntheticGrid::at`] says what a reader must find at a
//! coordinate, [`corpus`] is a set of files that covers what changed between versions. The layouts are facts
//! taken from OpenVDB's readers of 1.1.1 and 10.0.1 (`io/Archive.cc`, `io/Compression.h`, `tree/*.h`,
//! `math/Transform.cc`); nothing is shared with the reader under test. Not here: Blosc, point data, and root
//! tables older than version 213.

mod corpus;
#[cfg(test)]
mod tests;
mod write;

pub use corpus::corpus;

use half::f16;

/// The flag of ZIP-compressed blocks.
pub const ZIP: u32 = 1;
/// The flag of blocks that hold active values only. From version 222 on.
pub const ACTIVE_MASK: u32 = 2;

/// A 4×4 matrix in row-vector convention: `m[row][column]`, translation in `m[3]`.
pub type Matrix4 = [[f64; 4]; 4];

/// The components of one value: one number, three for a vector, the bytes of a string.
pub type Value = Vec<f64>;

/// A file.
#[derive(Debug, Clone, PartialEq)]
pub struct SyntheticFile {
    /// The version of the format, 213 to 226.
    pub version: u32,
    /// Major and minor number of the library that seems to have written it.
    pub library: [u32; 2],
    /// Whether grids have positions; a stream has none.
    pub has_offsets: bool,
    /// [`ZIP`] and [`ACTIVE_MASK`]. Before version 220 everything is ZIP, whatever this says.
    pub compression: u32,
    /// Metadata of the file.
    pub metadata: Vec<SyntheticMetadata>,
    /// The grids, in the order of the file.
    pub grids: Vec<SyntheticGrid>,
}

/// A piece of metadata.
#[derive(Debug, Clone, PartialEq)]
pub struct SyntheticMetadata {
    /// Its name.
    pub name: String,
    /// The name of its type: `string`, `float`, …
    pub type_name: String,
    /// Its value as it stands in the file, without the size.
    pub bytes: Vec<u8>,
}

impl SyntheticMetadata {
    /// A piece of text.
    pub fn text(name: &str, text: &str) -> Self {
        SyntheticMetadata { name: name.into(), type_name: "string".into(), bytes: text.into() }
    }
}

/// A grid.
#[derive(Debug, Clone, PartialEq)]
pub struct SyntheticGrid {
    /// The name in the descriptor. From version 219 on the metadata `name` is written too.
    pub name: String,
    /// The grid whose tree this one shares. From version 216 on; nothing below the transform is written then.
    pub instance_of: Option<String>,
    /// `float`, `double`, `int32`, `int64`, `bool`, `mask`, `vec3s`, `vec3d`, `vec3i`, `half` or `string`.
    pub value_type: &'static str,
    /// Whether blocks of a floating-point type hold half floats.
    pub half: bool,
    /// log2 of the children per axis of each node below the root, then of the voxels of a leaf: `[5, 4, 3]`.
    pub log2_root_to_leaf: Vec<u8>,
    /// The value of everything that is not stored.
    pub background: Value,
    /// From index to world space.
    pub transform: SyntheticTransform,
    /// Metadata of the grid.
    pub metadata: Vec<SyntheticMetadata>,
    /// The tiles at all depths.
    pub tiles: Vec<SyntheticTile>,
    /// The leaves.
    pub leaves: Vec<SyntheticLeaf>,
    /// The number of buffers that leaves carry besides the voxels; readers skip them. Before version 222.
    pub extra_buffers: u8,
}

/// A region with one value.
#[derive(Debug, Clone, PartialEq)]
pub struct SyntheticTile {
    /// 0 for a tile of the root, 1 for one of the root's children, and so on.
    pub depth: usize,
    /// The smallest index coordinate of the region.
    pub origin: [i32; 3],
    /// The value.
    pub value: Value,
    /// Whether the region is active.
    pub active: bool,
}

/// A leaf.
#[derive(Debug, Clone, PartialEq)]
pub struct SyntheticLeaf {
    /// The smallest index coordinate.
    pub origin: [i32; 3],
    /// The active state of each voxel, x slowest.
    pub mask: Vec<bool>,
    /// The value of each voxel, x slowest. Leaves of type `mask` have their mask instead.
    pub values: Vec<Value>,
}

/// From index to world space.
#[derive(Debug, Clone, PartialEq)]
pub enum SyntheticTransform {
    /// A scale per axis, then a translation.
    Scale {
        /// The size of a voxel.
        scale: [f64; 3],
        /// Where index 0 lies.
        translation: [f64; 3],
    },
    /// Any linear map.
    Affine(Matrix4),
    /// A box of index space seen through a camera.
    Frustum {
        /// The box, `[min, max]`. Versions before 221 hold it in integers.
        index_box: [[i32; 3]; 2],
        /// Width of the near face over width of the far face.
        taper: f64,
        /// Depth over width of the near face.
        depth: f64,
        /// Width of the near face in the camera's units.
        near_width: f64,
        /// Distance from the camera to the near face.
        near_distance: f64,
        /// From camera to world; the camera looks along −z.
        camera: Matrix4,
    },
}

/// What a reader must find at a coordinate.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The value, rounded as the file rounds it.
    pub value: Value,
    /// The active state.
    pub active: bool,
    /// Where the value is stored: −1 background, 0 root tile, then tiles of the nodes below; the number of
    /// node levels below the root for a leaf.
    pub depth: i32,
}

impl SyntheticFile {
    /// The grid whose tree a grid shows: itself, or the one it shares with.
    ///
    /// # Panics
    /// If it names a grid that is not there.
    pub fn tree_of<'a>(&'a self, grid: &'a SyntheticGrid) -> &'a SyntheticGrid {
        match &grid.instance_of {
            Some(parent) => self.grids.iter().find(|g| g.name == *parent).expect("the shared tree"),
            None => grid,
        }
    }
}

impl SyntheticGrid {
    /// The name of the grid's type in the descriptor, without the suffix for half floats.
    pub fn type_name(&self) -> String {
        let logs: Vec<_> = self.log2_root_to_leaf.iter().map(u8::to_string).collect();
        format!("Tree_{}_{}", self.value_type, logs.join("_"))
    }

    /// The depth of the leaves: 3 below two levels of nodes, 1 right below the root.
    pub fn leaf_depth(&self) -> usize {
        self.log2_root_to_leaf.len()
    }

    /// log2 of the voxels per axis of a tile at this depth.
    pub fn log2_tile(&self, depth: usize) -> u32 {
        self.log2_root_to_leaf.iter().skip(depth).map(|log2| u32::from(*log2)).sum()
    }

    /// Whether blocks hold half floats: the flag has no effect on other types.
    pub fn stores_half(&self) -> bool {
        self.half && ["float", "double", "vec3s", "vec3d"].contains(&self.value_type)
    }

    /// A value as it is after having been stored.
    pub fn rounded(&self, value: &[f64]) -> Value {
        let component = |x: &f64| match self.value_type {
            _ if self.stores_half() => f64::from(f16::from_f32(*x as f32)),
            "float" | "vec3s" => f64::from(*x as f32),
            "half" => f64::from(f16::from_f32(*x as f32)),
            _ => *x,
        };
        value.iter().map(component).collect()
    }

    /// The grid with all values as they are after having been stored.
    pub fn as_stored(&self) -> SyntheticGrid {
        let mut stored = self.clone();
        let tiles = stored.tiles.iter_mut().map(|tile| &mut tile.value);
        let voxels = stored.leaves.iter_mut().flat_map(|leaf| &mut leaf.values);
        for value in tiles.chain(voxels).chain([&mut stored.background]) {
            *value = self.rounded(value);
        }
        stored
    }

    /// What this grid's own tree holds at a coordinate.
    pub fn at(&self, coordinate: [i32; 3]) -> Found {
        let within = |origin: [i32; 3], log2| (0..3).all(|i| coordinate[i] >> log2 == origin[i] >> log2);
        let found = |value: &[f64], active, depth| Found { value: self.rounded(value), active, depth };
        let leaf_depth = self.leaf_depth();
        let leaf_log2 = self.log2_tile(leaf_depth - 1);
        if let Some(leaf) = self.leaves.iter().find(|leaf| within(leaf.origin, leaf_log2)) {
            let local = coordinate.map(|c| (c & ((1 << leaf_log2) - 1)) as usize);
            let slot = local.iter().fold(0, |slot, c| slot << leaf_log2 | c);
            let active = leaf.mask[slot];
            let mask_value = [f64::from(u8::from(active))];
            let value = if self.value_type == "mask" { &mask_value[..] } else { &leaf.values[slot] };
            return found(value, active, leaf_depth as i32);
        }
        if let Some(tile) = self.tiles.iter().find(|tile| within(tile.origin, self.log2_tile(tile.depth))) {
            return found(&tile.value, tile.active, tile.depth as i32);
        }
        let has_node = |depth: &usize| {
            let log2 = self.log2_tile(depth - 1);
            let below = self.tiles.iter().filter(|tile| tile.depth >= *depth).map(|tile| tile.origin);
            below.chain(self.leaves.iter().map(|leaf| leaf.origin)).any(|origin| within(origin, log2))
        };
        let deepest = (1..leaf_depth).rev().find(has_node);
        found(&self.background, false, deepest.map_or(-1, |depth| depth as i32))
    }

    /// Coordinates worth a look: corners and insides of all leaves and tiles, their outer neighbours, and the
    /// ends of index space.
    pub fn coordinates(&self) -> Vec<[i32; 3]> {
        let leaf_log2 = self.log2_tile(self.leaf_depth() - 1);
        let tiles = self.tiles.iter().map(|tile| (tile.origin, self.log2_tile(tile.depth)));
        let boxes: Vec<_> = self.leaves.iter().map(|leaf| (leaf.origin, leaf_log2)).chain(tiles).collect();
        let mut coordinates = vec![[0; 3], [i32::MIN; 3], [i32::MAX; 3]];
        for (origin, log2) in boxes {
            let size = 1 << log2;
            for corner in [[-1; 3], [0; 3], [size - 1; 3], [size; 3], [size - 1, 0, size / 2], [0, size, 0]] {
                coordinates.push(std::array::from_fn(|i| origin[i].saturating_add(corner[i])));
            }
        }
        for leaf in &self.leaves {
            for slot in (0..1 << (3 * leaf_log2)).step_by(7) {
                let local = [2, 1, 0].map(|axis| slot >> (axis * leaf_log2) & ((1 << leaf_log2) - 1));
                coordinates.push(std::array::from_fn(|i| leaf.origin[i] + local[i]));
            }
        }
        coordinates
    }
}

impl SyntheticTransform {
    /// The world position of an index coordinate.
    pub fn world_from_index(&self, p_index: [f64; 3]) -> [f64; 3] {
        match self {
            SyntheticTransform::Frustum { index_box: [min, max], taper, depth, .. } => {
                // Everything in widths of the near face, which lies centred in the plane z = 0.
                let size = [0, 1, 2].map(|i| f64::from(max[i]) - f64::from(min[i]));
                let unit: [f64; 3] = std::array::from_fn(|i| (p_index[i] - f64::from(min[i])) / size[i]);
                let widening = 1.0 + (1.0 / taper - 1.0) * unit[2];
                let height = size[1] / size[0];
                let p_near =
                    [(unit[0] - 0.5) * widening, (unit[1] - 0.5) * widening * height, unit[2] * depth];
                apply(&self.linear(), p_near)
            }
            _ => apply(&self.linear(), p_index),
        }
    }

    /// The linear part: all of it, or what follows the frustum.
    pub fn linear(&self) -> Matrix4 {
        match self {
            SyntheticTransform::Scale { scale: [x, y, z], translation: [tx, ty, tz] } => {
                [[*x, 0.0, 0.0, 0.0], [0.0, *y, 0.0, 0.0], [0.0, 0.0, *z, 0.0], [*tx, *ty, *tz, 1.0]]
            }
            SyntheticTransform::Affine(matrix) => *matrix,
            SyntheticTransform::Frustum { near_width: w, near_distance, camera, .. } => {
                let to_camera = [
                    [*w, 0.0, 0.0, 0.0],
                    [0.0, *w, 0.0, 0.0],
                    [0.0, 0.0, -w, 0.0],
                    [0.0, 0.0, -near_distance, 1.0],
                ];
                product(&to_camera, camera)
            }
        }
    }
}

fn apply(m: &Matrix4, [x, y, z]: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| x * m[0][i] + y * m[1][i] + z * m[2][i] + m[3][i])
}

fn product(a: &Matrix4, b: &Matrix4) -> Matrix4 {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..4).map(|i| a[row][i] * b[i][column]).sum()))
}
