//! From a description to the bytes of a file: header, descriptors, transforms, trees and blocks of all
//! versions. Nothing here decides what a file holds.

use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use half::f16;

use super::{ACTIVE_MASK, Matrix4, SyntheticFile, SyntheticGrid, SyntheticLeaf, SyntheticMetadata};
use super::{SyntheticTransform, Value, ZIP};

const MAGIC: u64 = 0x5644_4220;
const UUID: [u8; 16] = *b"nuage\0synthetic\0";

/// The versions in which something of the layout changed, after OpenVDB's `version.h`.
const INNER_NODE_BLOCKS: u32 = 214;
const INSTANCES: u32 = 216;
const BOOL_LEAF_MASKS: u32 = 217;
const UUID_TEXT: u32 = 218;
const MAPS: u32 = 219;
const COMPRESSION_PER_FILE: u32 = 220;
const FLOAT_FRUSTUM_BOX: u32 = 221;
const COMPRESSION_PER_GRID: u32 = 222;

impl SyntheticFile {
    /// The file. The same description gives the same bytes.
    ///
    /// # Panics
    /// If the description contradicts itself: a type that is unknown, a leaf with too few values.
    pub fn bytes(&self) -> Vec<u8> {
        let mut out = MAGIC.to_le_bytes().to_vec();
        for number in [self.version, self.library[0], self.library[1]] {
            put_u32(&mut out, number);
        }
        out.push(u8::from(self.has_offsets));
        if (COMPRESSION_PER_FILE..COMPRESSION_PER_GRID).contains(&self.version) {
            out.push(u8::from(self.compression & ZIP != 0));
        }
        if self.version >= UUID_TEXT {
            let digits: String = UUID.iter().map(|byte| format!("{byte:02x}")).collect();
            let parts = [&digits[..8], &digits[8..12], &digits[12..16], &digits[16..20], &digits[20..]];
            out.extend(parts.join("-").bytes());
        } else {
            out.extend(UUID);
        }
        put_metadata(&mut out, self.metadata.iter());
        put_u32(&mut out, self.grids.len() as u32);
        for grid in &self.grids {
            self.put_grid(&mut out, grid);
        }
        out
    }

    /// The flags that hold for the blocks of this file.
    pub(crate) fn flags(&self) -> u32 {
        match self.version {
            ..COMPRESSION_PER_FILE => ZIP,
            COMPRESSION_PER_FILE..COMPRESSION_PER_GRID => self.compression & ZIP,
            _ => self.compression,
        }
    }

    fn put_grid(&self, out: &mut Vec<u8>, grid: &SyntheticGrid) {
        put_text(out, &grid.name);
        put_text(out, &format!("{}{}", grid.type_name(), if grid.half { "_HalfFloat" } else { "" }));
        if self.version >= INSTANCES {
            put_text(out, grid.instance_of.as_deref().unwrap_or_default());
        }
        let positions_at = out.len();
        out.extend([0; 24]);
        let grid_at = out.len();
        if self.version >= COMPRESSION_PER_GRID {
            put_u32(out, self.flags());
        }
        let plain_name = grid.name.split('\x1e').next().unwrap_or_default();
        let name = (self.version >= MAPS).then(|| SyntheticMetadata::text("name", plain_name));
        // OpenVDB goes by this, not by the suffix of the type.
        let half = grid.half.then(|| SyntheticMetadata {
            name: "is_saved_as_half_float".into(),
            type_name: "bool".into(),
            bytes: vec![1],
        });
        put_metadata(out, grid.metadata.iter().chain(&name).chain(&half));
        let mut blocks_at = 0;
        if grid.instance_of.is_some() {
            self.put_transform(out, &grid.transform);
        } else {
            let tree = TreeWriter { file: self, grid: &grid.as_stored() };
            if self.version >= INSTANCES {
                self.put_transform(out, &grid.transform);
                tree.put_topology(out);
            } else {
                tree.put_topology(out);
                self.put_transform(out, &grid.transform);
            }
            blocks_at = out.len();
            tree.put_leaves(out);
        }
        if self.has_offsets {
            let positions = [grid_at, blocks_at, out.len()].map(|at| (at as u64).to_le_bytes());
            out[positions_at..grid_at].copy_from_slice(&positions.concat());
        }
    }

    fn put_transform(&self, out: &mut Vec<u8>, transform: &SyntheticTransform) {
        match (transform, self.version >= MAPS) {
            (SyntheticTransform::Frustum { .. }, false) => put_old_frustum(out, transform),
            (_, false) => {
                put_text(out, "LinearTransform");
                put_box(out, [[-1; 3], [1; 3]]);
                // The first and third matrix matter; the others, their inverses, are not read.
                let mut voxel_from_local = transform.linear();
                let mut local_from_world = SCALE_BY_TWO;
                voxel_from_local.iter_mut().flat_map(|row| row.iter_mut().take(3)).for_each(|x| *x *= 0.5);
                local_from_world[3] = [0.0, 0.0, 0.0, 1.0];
                for matrix in [local_from_world, NOISE, voxel_from_local, NOISE] {
                    put_matrix(out, &matrix);
                }
            }
            (SyntheticTransform::Scale { scale, translation }, true) => {
                put_text(out, "ScaleTranslateMap");
                let inverse = scale.map(|x| 1.0 / x);
                let squared = inverse.map(|x| x * x);
                let size = scale.map(f64::abs);
                put_f64s(
                    out,
                    [*translation, *scale, size, inverse, squared, inverse.map(|x| 0.5 * x)].concat(),
                );
            }
            (SyntheticTransform::Affine(matrix), true) => {
                put_text(out, "AffineMap");
                put_matrix(out, matrix);
            }
            (SyntheticTransform::Frustum { index_box, taper, depth, .. }, true) => {
                put_text(out, "NonlinearFrustumMap");
                if self.version < FLOAT_FRUSTUM_BOX {
                    put_box(out, *index_box);
                } else {
                    put_f64s(out, index_box.as_flattened().iter().map(|x| f64::from(*x)));
                }
                put_f64s(out, [*taper, *depth]);
                put_text(out, "AffineMap");
                put_matrix(out, &transform.linear());
            }
        }
    }
}

const SCALE_BY_TWO: Matrix4 =
    [[2.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// Stands where nobody should look.
const NOISE: Matrix4 = [[7.0; 4]; 4];

/// The frustum transform of versions before 219. It maps the unit cube to the frustum by two projective
/// matrices and a linear one; they are chosen so that all of them have a part in the result.
fn put_old_frustum(out: &mut Vec<u8>, transform: &SyntheticTransform) {
    let SyntheticTransform::Frustum { index_box, taper, depth, near_width, near_distance, camera } =
        transform
    else {
        return;
    };
    put_text(out, "FrustumTransform");
    put_box(out, *index_box);
    for matrix in [&NOISE, camera, &NOISE, &NOISE, &NOISE, &SCALE_BY_TWO] {
        put_matrix(out, matrix);
    }
    let far_distance = near_distance + depth * near_width;
    put_f64s(out, [-1.0, 1.0, -1.0, 1.0, *near_distance, far_distance]);
    put_f64s(out, [7.0]);
    // z doubles first, and x is divided by 1 at the near face and by the taper at the far one.
    let half_width = 0.5 * near_width;
    let local_from_unit_xy = [
        [half_width, 0.0, 0.0, 0.0],
        [0.0, half_width, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.5 * (taper - 1.0)],
        [0.0, 0.0, 0.0, 1.0],
    ];
    for matrix in [&NOISE, &local_from_unit_xy, &NOISE, &SCALE_BY_TWO, &NOISE] {
        put_matrix(out, matrix);
    }
}

/// What the functions on a tree need to know; the values of the grid are rounded already.
struct TreeWriter<'a> {
    file: &'a SyntheticFile,
    grid: &'a SyntheticGrid,
}

impl TreeWriter<'_> {
    fn put_topology(&self, out: &mut Vec<u8>) {
        put_u32(out, 1);
        self.put_raw(out, &self.grid.background);
        let tiles: Vec<_> = self.grid.tiles.iter().filter(|tile| tile.depth == 0).collect();
        let children = self.children([i32::MIN; 3], 32, 0);
        put_u32(out, tiles.len() as u32);
        put_u32(out, children.len() as u32);
        for tile in tiles {
            put_i32s(out, tile.origin);
            self.put_raw(out, &tile.value);
            out.push(u8::from(tile.active));
        }
        for child in children {
            put_i32s(out, child);
            self.put_node(out, child, 1);
        }
    }

    /// The origins of the nodes that stand where tiles of this depth could be, of those within a region, in
    /// the order of the file.
    fn children(&self, origin: [i32; 3], log2: u32, depth: usize) -> Vec<[i32; 3]> {
        let log2_child = self.grid.log2_tile(depth);
        let within = |at: &[i32; 3]| log2 >= 32 || (0..3).all(|i| at[i] >> log2 == origin[i] >> log2);
        let tiles = self.grid.tiles.iter().filter(|tile| tile.depth > depth).map(|tile| tile.origin);
        let leaves = self.grid.leaves.iter().map(|leaf| leaf.origin);
        let mut children: Vec<_> =
            tiles.chain(leaves).filter(within).map(|at| at.map(|c| c >> log2_child << log2_child)).collect();
        children.sort_unstable();
        children.dedup();
        children
    }

    /// A node below the root; `depth` is that of its tiles.
    fn put_node(&self, out: &mut Vec<u8>, origin: [i32; 3], depth: usize) {
        if depth == self.grid.leaf_depth() {
            return put_mask(out, &self.leaf(origin).mask);
        }
        let log2_slots = u32::from(self.grid.log2_root_to_leaf[depth - 1]);
        let (log2, log2_slot) = (self.grid.log2_tile(depth - 1), self.grid.log2_tile(depth));
        let slot_of = |at: [i32; 3]| {
            let local = at.map(|c| (c >> log2_slot & ((1 << log2_slots) - 1)) as usize);
            local.iter().fold(0, |slot, c| slot << log2_slots | c)
        };
        let children = self.children(origin, log2, depth);
        let slots = 1 << (3 * log2_slots);
        let mut is_child = vec![false; slots];
        let mut is_active = vec![false; slots];
        let mut values = vec![&self.grid.background; slots];
        for child in &children {
            is_child[slot_of(*child)] = true;
        }
        let here = |at: [i32; 3]| (0..3).all(|i| at[i] >> log2 == origin[i] >> log2);
        for tile in self.grid.tiles.iter().filter(|tile| tile.depth == depth && here(tile.origin)) {
            is_active[slot_of(tile.origin)] = tile.active;
            values[slot_of(tile.origin)] = &tile.value;
        }
        put_mask(out, &is_child);
        put_mask(out, &is_active);
        if self.file.version < INNER_NODE_BLOCKS {
            let mut children = children.iter();
            for slot in 0..slots {
                match children.as_slice().first() {
                    Some(child) if is_child[slot] => {
                        self.put_node(out, *child, depth + 1);
                        children.next();
                    }
                    _ => self.put_raw(out, values[slot]),
                }
            }
            return;
        }
        if self.file.version < COMPRESSION_PER_GRID {
            let tiles: Vec<_> = (0..slots).filter(|slot| !is_child[*slot]).map(|slot| values[slot]).collect();
            self.put_block(out, &tiles);
        } else {
            self.put_masked_block(out, &values, &is_active, &is_child);
        }
        for child in children {
            self.put_node(out, child, depth + 1);
        }
    }

    fn leaf(&self, origin: [i32; 3]) -> &SyntheticLeaf {
        self.grid.leaves.iter().find(|leaf| leaf.origin == origin).expect("a leaf where its tree has one")
    }

    fn put_leaves(&self, out: &mut Vec<u8>) {
        // Slots are ordered as their origins are, at every depth; the nodes above compare first.
        let mut leaves: Vec<_> = self.grid.leaves.iter().collect();
        let path = |leaf: &&SyntheticLeaf| -> Vec<[i32; 3]> {
            (0..self.grid.leaf_depth())
                .map(|depth| leaf.origin.map(|c| c >> self.grid.log2_tile(depth)))
                .collect()
        };
        leaves.sort_by_key(path);
        for leaf in leaves {
            self.put_leaf(out, leaf);
        }
    }

    fn put_leaf(&self, out: &mut Vec<u8>, leaf: &SyntheticLeaf) {
        let grid = self.grid;
        put_mask(out, &leaf.mask);
        let buffers = 1 + grid.extra_buffers;
        // Extra buffers are unlike the voxels, so that nobody takes one for the other.
        let extra = vec![&grid.background; leaf.mask.len()];
        let values: Vec<_> = leaf.values.iter().collect();
        match grid.value_type {
            "mask" => put_i32s(out, leaf.origin),
            "bool" => {
                put_i32s(out, leaf.origin);
                if self.file.version >= BOOL_LEAF_MASKS {
                    put_mask(out, &leaf.values.iter().map(|value| value[0] != 0.0).collect::<Vec<_>>());
                    return;
                }
                out.push(buffers);
                self.put_block(out, &values);
                (1..buffers).for_each(|_| self.put_block(out, &extra));
            }
            _ => {
                if self.file.version >= COMPRESSION_PER_GRID {
                    self.put_masked_block(out, &values, &leaf.mask, &vec![false; values.len()]);
                    return;
                }
                put_i32s(out, leaf.origin);
                out.push(buffers);
                self.put_block(out, &values);
                (1..buffers).for_each(|_| self.put_block(out, &extra));
            }
        }
    }

    /// A block that opens with a byte on its inactive values.
    fn put_masked_block(&self, out: &mut Vec<u8>, values: &[&Value], active: &[bool], is_child: &[bool]) {
        if self.file.flags() & ACTIVE_MASK == 0 {
            // The byte says nothing then. Libraries before 2.2 wrote 0, later ones 6.
            out.push(if self.file.library < [2, 2] { 0 } else { 6 });
            return self.put_block(out, values);
        }
        let mut inactive: Vec<&Value> = Vec::new();
        for ((value, active), is_child) in values.iter().zip(active).zip(is_child) {
            if !active && !is_child && !inactive.contains(value) {
                inactive.push(value);
            }
        }
        let (plus, minus) = (&self.grid.background, &self.negative(&self.grid.background));
        // The byte, the values that follow it, and the value of the bits that are on in the mask after those.
        let (byte, stored, on): (u8, Vec<&Value>, Option<&Value>) = match inactive[..] {
            [] => (0, vec![], None),
            [a] if a == plus => (0, vec![], None),
            [a] if a == minus => (1, vec![], None),
            [a] => (2, vec![a], None),
            [a, b] if (a == plus && b == minus) || (a == minus && b == plus) => (3, vec![], Some(plus)),
            [a, b] if b == plus => (4, vec![a], Some(plus)),
            [a, b] if a == plus => (4, vec![b], Some(plus)),
            [a, b] => (5, vec![a, b], Some(b)),
            _ => (6, vec![], None),
        };
        out.push(byte);
        for value in stored {
            self.put_raw(out, value);
        }
        if let Some(on) = on {
            let selects = |(value, active): (&&Value, &bool)| !active && *value == on;
            put_mask(out, &values.iter().zip(active).map(selects).collect::<Vec<_>>());
        }
        let stored = values.iter().zip(active).filter(|(_, active)| byte == 6 || **active);
        self.put_block(out, &stored.map(|(value, _)| *value).collect::<Vec<_>>());
    }

    fn negative(&self, value: &Value) -> Value {
        match self.grid.value_type {
            "bool" | "mask" => vec![1.0 - value[0]],
            "string" => value.clone(),
            _ => value.iter().map(|x| -x).collect(),
        }
    }

    /// Values behind each other, compressed if the file says so.
    fn put_block(&self, out: &mut Vec<u8>, values: &[&Value]) {
        let mut bytes = Vec::new();
        if self.grid.value_type == "string" {
            for value in values {
                out.extend(value.len().to_string().bytes());
                out.extend(value.iter().map(|byte| *byte as u8));
                out.push(0);
            }
            return;
        }
        if self.grid.stores_half() {
            // An empty block of half floats is nothing at all, while one of other values has a size.
            if values.is_empty() {
                return;
            }
            for x in values.iter().flat_map(|value| value.iter()) {
                bytes.extend(f16::from_f64(*x).to_le_bytes());
            }
        } else {
            values.iter().for_each(|value| self.put_raw(&mut bytes, value));
        }
        if self.file.flags() & ZIP == 0 {
            out.extend(bytes);
            return;
        }
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(&bytes).expect("writing to memory");
        let packed = encoder.finish().expect("writing to memory");
        if packed.len() < bytes.len() {
            out.extend((packed.len() as i64).to_le_bytes());
            out.extend(packed);
        } else {
            out.extend((-(bytes.len() as i64)).to_le_bytes());
            out.extend(bytes);
        }
    }

    /// One value in the full precision of its type.
    fn put_raw(&self, out: &mut Vec<u8>, value: &Value) {
        for x in value {
            match self.grid.value_type {
                "float" | "vec3s" => out.extend((*x as f32).to_le_bytes()),
                "double" | "vec3d" => out.extend(x.to_le_bytes()),
                "int32" | "vec3i" => out.extend((*x as i32).to_le_bytes()),
                "int64" => out.extend((*x as i64).to_le_bytes()),
                "half" => out.extend(f16::from_f64(*x).to_le_bytes()),
                "bool" | "mask" => out.push(u8::from(*x != 0.0)),
                "string" => {}
                other => panic!("{other} is no type of values"),
            }
        }
        if self.grid.value_type == "string" {
            // What stands in files is the memory of a C++ string, of no use to anybody else.
            out.extend([0; 32]);
        }
    }
}

fn put_u32(out: &mut Vec<u8>, number: u32) {
    out.extend(number.to_le_bytes());
}

fn put_i32s(out: &mut Vec<u8>, numbers: [i32; 3]) {
    out.extend(numbers.map(i32::to_le_bytes).as_flattened());
}

fn put_f64s(out: &mut Vec<u8>, numbers: impl IntoIterator<Item = f64>) {
    numbers.into_iter().for_each(|number| out.extend(number.to_le_bytes()));
}

fn put_box(out: &mut Vec<u8>, corners: [[i32; 3]; 2]) {
    corners.into_iter().for_each(|corner| put_i32s(out, corner));
}

fn put_matrix(out: &mut Vec<u8>, matrix: &Matrix4) {
    put_f64s(out, matrix.as_flattened().iter().copied());
}

fn put_text(out: &mut Vec<u8>, text: &str) {
    put_u32(out, text.len() as u32);
    out.extend(text.bytes());
}

fn put_mask(out: &mut Vec<u8>, bits: &[bool]) {
    out.extend(bits.chunks(8).map(|byte| byte.iter().rev().fold(0, |byte, bit| byte << 1 | u8::from(*bit))));
}

fn put_metadata<'a>(out: &mut Vec<u8>, items: impl Iterator<Item = &'a SyntheticMetadata> + Clone) {
    put_u32(out, items.clone().count() as u32);
    for SyntheticMetadata { name, type_name, bytes } in items {
        put_text(out, name);
        put_text(out, type_name);
        put_u32(out, bytes.len() as u32);
        out.extend(bytes);
    }
}
