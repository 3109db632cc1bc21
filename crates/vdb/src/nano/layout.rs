//! What stands where in a NanoVDB grid: the structures' fields as byte offsets.
//!
//! A grid begins with its own fixed structure and that of the tree. The root, the two kinds of inner nodes
//! and the leaves are found by offsets relative to the structure that names them; the places of their fields
//! depend on the type of the values, as a C++ compiler lays them out. Nothing here reads or writes bytes.

use crate::tree::{LEAF_VOXELS, LEVEL4, LEVEL5};

/// `NanoVDB0`: files and grids up to version 32.6.
pub(super) const MAGIC_OLD: u64 = u64::from_le_bytes(*b"NanoVDB0");
/// `NanoVDB1`: grids since then.
pub(super) const MAGIC_GRID: u64 = u64::from_le_bytes(*b"NanoVDB1");
/// `NanoVDB2`: files since then.
pub(super) const MAGIC_FILE: u64 = u64::from_le_bytes(*b"NanoVDB2");

/// All structures are multiples of this and begin at multiples of it.
pub(super) const ALIGNMENT: usize = 32;

/// The header of a segment: magic, version, number of grids (u16), codec (u16).
pub(super) const SEGMENT_BYTES: usize = 16;
/// What a segment says of each grid, before its name.
pub(super) const META_BYTES: usize = 176;

// The fields of the grid itself.
pub(super) const GRID_CHECKSUM: usize = 8;
pub(super) const GRID_VERSION: usize = 16;
pub(super) const GRID_FLAGS: usize = 20;
pub(super) const GRID_COUNT: usize = 28;
pub(super) const GRID_SIZE: usize = 32;
pub(super) const GRID_NAME: usize = 40;
/// With the zero at the end.
pub(super) const SHORT_NAME_BYTES: usize = 256;
/// The map in single precision: 3×3 matrix, its inverse, translation, taper.
pub(super) const GRID_MAP_F32: usize = 296;
/// The same in double precision.
pub(super) const GRID_MAP_F64: usize = 296 + 88;
/// Where the translation stands in a map, counted in numbers.
pub(super) const MAP_TRANSLATION: usize = 18;
pub(super) const GRID_WORLD_BOX: usize = 560;
pub(super) const GRID_VOXEL_SIZE: usize = 608;
pub(super) const GRID_CLASS: usize = 632;
pub(super) const GRID_TYPE: usize = 636;
/// Offset and number of the descriptions of blind data, relative to the grid.
pub(super) const GRID_BLIND: usize = 640;
pub(super) const GRID_BYTES: usize = 672;

/// The tree follows the grid: offsets of the first leaf, lower, upper node and of the root, relative to the
/// tree …
pub(super) const TREE: usize = GRID_BYTES;
/// … then the numbers of leaves, lower and upper nodes, of active tiles in lower nodes, upper nodes and the
/// root …
pub(super) const TREE_NODE_COUNTS: usize = TREE + 32;
/// … and of active voxels.
pub(super) const TREE_VOXEL_COUNT: usize = TREE + 56;
pub(super) const TREE_BYTES: usize = 64;

// What describes a piece of blind data: where it stands relative to the description, what it is.
pub(super) const BLIND_BYTES: usize = 288;
pub(super) const BLIND_CLASS: usize = 24;
/// The class of blind data that are the grid's name.
pub(super) const BLIND_CLASS_NAME: u32 = 3;

// The flags of a grid.
pub(super) const HAS_LONG_NAME: u32 = 1;
pub(super) const HAS_BBOX: u32 = 2;
pub(super) const HAS_MIN_MAX: u32 = 4;
pub(super) const HAS_AVERAGE: u32 = 8;
pub(super) const HAS_DEVIATION: u32 = 16;
pub(super) const IS_BREADTH_FIRST: u32 = 32;

// The flags of a node.
pub(super) const NOT_TO_BE_RENDERED: u8 = 1;
pub(super) const HAS_ACTIVE_VALUES: u8 = 2;

/// The fields that all leaves begin with: box, flags, active mask.
pub(super) const LEAF_BOX_SIZE: usize = 12;
pub(super) const LEAF_FLAGS: usize = 15;
pub(super) const LEAF_MASK: usize = 16;
/// What follows the mask: statistics, or the values of a `bool` leaf.
pub(super) const LEAF_AFTER_MASK: usize = LEAF_MASK + LEAF_VOXELS / 8;
/// Where the codes of a quantised leaf stand.
pub(super) const LEAF_CODES: usize = 96;

/// The box and the flags of an inner node stand before its masks.
pub(super) const NODE_FLAGS: usize = 24;
pub(super) const NODE_MASKS: usize = 32;

/// The types of values that are read and written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Float,
    Double,
    Int16,
    Int32,
    Int64,
    Vec3f,
    Vec3d,
    Mask,
    Bool,
    Fp4,
    Fp8,
    Fp16,
    FpN,
}

impl Kind {
    /// The number of the type in files.
    pub(super) const fn number(self) -> u32 {
        match self {
            Kind::Float => 1,
            Kind::Double => 2,
            Kind::Int16 => 3,
            Kind::Int32 => 4,
            Kind::Int64 => 5,
            Kind::Vec3f => 6,
            Kind::Vec3d => 7,
            Kind::Mask => 8,
            Kind::Bool => 11,
            Kind::Fp4 => 13,
            Kind::Fp8 => 14,
            Kind::Fp16 => 15,
            Kind::FpN => 16,
        }
    }

    /// The type of that number, if it is one of those that are read.
    pub(super) fn from_number(number: u32) -> Option<Kind> {
        use Kind::{Bool, Double, Float, Fp4, Fp8, Fp16, FpN, Int16, Int32, Int64, Mask, Vec3d, Vec3f};
        [Float, Double, Int16, Int32, Int64, Vec3f, Vec3d, Mask, Bool, Fp4, Fp8, Fp16, FpN]
            .into_iter()
            .find(|kind| kind.number() == number)
    }

    /// The bits of a voxel's code; `None` for types that are not quantised, and for `FpN`, whose leaves say
    /// it.
    pub(super) fn code_bits(self) -> Option<u32> {
        match self {
            Kind::Fp4 => Some(4),
            Kind::Fp8 => Some(8),
            Kind::Fp16 => Some(16),
            _ => None,
        }
    }

    /// The size of a value in tiles and statistics, its alignment, and the size of averages.
    const fn sizes(self) -> (usize, usize, usize) {
        match self {
            Kind::Float | Kind::Int32 | Kind::Fp4 | Kind::Fp8 | Kind::Fp16 | Kind::FpN => (4, 4, 4),
            Kind::Double | Kind::Int64 => (8, 8, 8),
            Kind::Int16 => (2, 2, 4),
            Kind::Vec3f => (12, 4, 4),
            Kind::Vec3d => (24, 8, 8),
            Kind::Mask | Kind::Bool => (1, 1, 1),
        }
    }
}

/// The name that NanoVDB gives the type of a number.
pub(super) fn type_name(number: u32) -> &'static str {
    const NAMES: [&str; 27] = [
        "unknown",
        "float",
        "double",
        "int16",
        "int32",
        "int64",
        "Vec3f",
        "Vec3d",
        "Mask",
        "Half",
        "uint32",
        "bool",
        "RGBA8",
        "Fp4",
        "Fp8",
        "Fp16",
        "FpN",
        "Vec4f",
        "Vec4d",
        "Index",
        "OnIndex",
        "IndexMask",
        "OnIndexMask",
        "PointIndex",
        "Vec3u8",
        "Vec3u16",
        "UInt8",
    ];
    usize::try_from(number).ok().and_then(|i| NAMES.get(i)).copied().unwrap_or("unknown")
}

/// The classes that `.vdb` files know too, and their numbers.
pub(super) const CLASSES: [(u32, &str); 3] = [(1, "level set"), (2, "fog volume"), (3, "staggered")];
/// The class of grids of active states.
pub(super) const CLASS_TOPOLOGY: u32 = 6;

/// The name of a class as `.vdb` files have it.
pub(super) fn class_name(number: u32) -> &'static str {
    CLASSES.iter().find(|(n, _)| *n == number).map_or("unknown", |(_, name)| name)
}

/// Where the statistics of a root or node stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct StatsLayout {
    pub(super) min: usize,
    pub(super) max: usize,
    pub(super) average: usize,
    pub(super) deviation: usize,
    /// The first byte behind them.
    end: usize,
}

/// The root. Its box stands at 0, the number of its tiles at 24, the tiles behind it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RootLayout {
    pub(super) background: usize,
    pub(super) stats: StatsLayout,
    pub(super) bytes: usize,
    /// Where the value stands in a tile, after key (u64), child (i64) and state (u32).
    pub(super) tile_value: usize,
    pub(super) tile_bytes: usize,
}

/// An inner node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct NodeLayout {
    pub(super) slots: usize,
    pub(super) value_mask: usize,
    pub(super) child_mask: usize,
    pub(super) stats: StatsLayout,
    /// A value or the offset of a child (i64) for each slot.
    pub(super) table: usize,
    pub(super) slot_bytes: usize,
    pub(super) bytes: usize,
}

/// The places that depend on the type of the values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) value_bytes: usize,
    pub(super) root: RootLayout,
    pub(super) upper: NodeLayout,
    pub(super) lower: NodeLayout,
    /// The statistics of leaves that have them as values.
    pub(super) leaf_stats: StatsLayout,
    /// Where the values of a leaf begin that are neither bits nor codes.
    pub(super) leaf_values: usize,
}

impl Layout {
    pub(super) const fn of(kind: Kind) -> Layout {
        let (value, align, _) = kind.sizes();
        let background = round_up(28, align);
        let root_stats = StatsLayout::at(background + value, kind);
        let tile_value = round_up(20, align);
        let leaf_stats = StatsLayout::at(LEAF_AFTER_MASK, kind);
        Layout {
            value_bytes: value,
            root: RootLayout {
                background,
                stats: root_stats,
                bytes: round_up(root_stats.end, ALIGNMENT),
                tile_value,
                tile_bytes: round_up(tile_value + value, ALIGNMENT),
            },
            upper: NodeLayout::of(kind, LEVEL5.slots()),
            lower: NodeLayout::of(kind, LEVEL4.slots()),
            leaf_stats,
            leaf_values: round_up(leaf_stats.end, ALIGNMENT),
        }
    }

    /// The size of a leaf; of an `FpN` leaf that of its fixed part.
    pub(super) const fn leaf_bytes(&self, kind: Kind) -> usize {
        match kind {
            // One and two masks, padded.
            Kind::Mask => 96,
            Kind::Bool => 160,
            Kind::Fp4 => LEAF_CODES + code_bytes(4),
            Kind::Fp8 => LEAF_CODES + code_bytes(8),
            Kind::Fp16 => LEAF_CODES + code_bytes(16),
            Kind::FpN => LEAF_CODES,
            _ => round_up(self.leaf_values + LEAF_VOXELS * self.value_bytes, ALIGNMENT),
        }
    }
}

/// The bytes of the codes of a leaf.
pub(super) const fn code_bytes(bits: u32) -> usize {
    LEAF_VOXELS / 8 * bits as usize
}

impl StatsLayout {
    const fn at(begin: usize, kind: Kind) -> StatsLayout {
        let (value, align, average_bytes) = kind.sizes();
        let min = round_up(begin, align);
        let max = min + value;
        let average = round_up(max + value, average_bytes);
        let deviation = average + average_bytes;
        StatsLayout { min, max, average, deviation, end: deviation + average_bytes }
    }
}

impl NodeLayout {
    const fn of(kind: Kind, slots: usize) -> NodeLayout {
        let (value, _, _) = kind.sizes();
        let child_mask = NODE_MASKS + slots / 8;
        let stats = StatsLayout::at(child_mask + slots / 8, kind);
        let table = round_up(stats.end, ALIGNMENT);
        // A slot is a union with an i64.
        let slot_bytes = if value > 8 { round_up(value, 8) } else { 8 };
        let bytes = round_up(table + slots * slot_bytes, ALIGNMENT);
        NodeLayout { slots, value_mask: NODE_MASKS, child_mask, stats, table, slot_bytes, bytes }
    }
}

pub(super) const fn round_up(bytes: usize, to: usize) -> usize {
    bytes.div_ceil(to) * to
}

/// A version as files have it: 11, 11 and 10 bits.
pub(super) const fn pack_version([major, minor, patch]: [u32; 3]) -> u32 {
    major << 21 | minor << 10 | patch
}

pub(super) const fn unpack_version(version: u32) -> [u32; 3] {
    [version >> 21, version >> 10 & 0x7ff, version & 0x3ff]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn structures_are_laid_out_as_a_compiler_lays_them_out() {
        // Root, its background, deviation, tile and tile's value; upper node, its table and average; lower
        // node, its table and deviation; leaf: from `sizeof` and `offsetof` of the headers of version 32.4 on
        // x86-64.
        let wanted: [(Kind, [usize; 12]); 13] = [
            (Kind::Float, [64, 28, 44, 32, 20, 270400, 8256, 8232, 33856, 1088, 1068, 2144]),
            (Kind::Double, [96, 32, 64, 32, 24, 270400, 8256, 8240, 33856, 1088, 1080, 4224]),
            (Kind::Int16, [64, 28, 40, 32, 20, 270400, 8256, 8228, 33856, 1088, 1064, 1120]),
            (Kind::Int32, [64, 28, 44, 32, 20, 270400, 8256, 8232, 33856, 1088, 1068, 2144]),
            (Kind::Int64, [96, 32, 64, 32, 24, 270400, 8256, 8240, 33856, 1088, 1080, 4224]),
            (Kind::Vec3f, [96, 28, 68, 32, 20, 532544, 8256, 8248, 66624, 1088, 1084, 6272]),
            (Kind::Vec3d, [128, 32, 112, 64, 24, 794720, 8288, 8272, 99424, 1120, 1112, 12448]),
            (Kind::Mask, [64, 28, 32, 32, 20, 270400, 8256, 8226, 33856, 1088, 1059, 96]),
            (Kind::Bool, [64, 28, 32, 32, 20, 270400, 8256, 8226, 33856, 1088, 1059, 160]),
            (Kind::Fp4, [64, 28, 44, 32, 20, 270400, 8256, 8232, 33856, 1088, 1068, 352]),
            (Kind::Fp8, [64, 28, 44, 32, 20, 270400, 8256, 8232, 33856, 1088, 1068, 608]),
            (Kind::Fp16, [64, 28, 44, 32, 20, 270400, 8256, 8232, 33856, 1088, 1068, 1120]),
            (Kind::FpN, [64, 28, 44, 32, 20, 270400, 8256, 8232, 33856, 1088, 1068, 96]),
        ];
        for (kind, wanted) in wanted {
            let layout = Layout::of(kind);
            let Layout { root, upper, lower, .. } = layout;
            let got = [
                root.bytes,
                root.background,
                root.stats.deviation,
                root.tile_bytes,
                root.tile_value,
                upper.bytes,
                upper.table,
                upper.stats.average,
                lower.bytes,
                lower.table,
                lower.stats.deviation,
                layout.leaf_bytes(kind),
            ];
            assert_eq!(got, wanted, "{kind:?}");
            assert_eq!(Kind::from_number(kind.number()), Some(kind));
        }
        let values = [Kind::Vec3d, Kind::Vec3f, Kind::Int16].map(|kind| Layout::of(kind).leaf_values);
        assert_eq!(values, [160, 128, 96]);
    }

    #[test]
    fn types_and_versions_have_their_numbers() {
        assert_eq!(
            [1, 11, 16, 20, 26, 27, u32::MAX].map(type_name),
            ["float", "bool", "FpN", "OnIndex", "UInt8", "unknown", "unknown"]
        );
        assert_eq!(unpack_version(pack_version([32, 4, 2])), [32, 4, 2]);
        assert_eq!(pack_version([32, 4, 2]), 0x0400_1002);
    }
}
