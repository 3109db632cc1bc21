//! Reading a tree: first its topology, then its values.
//!
//! A tree is written depth first, all nodes before all leaf values. The topology is read in one pass and the
//! value blocks of the leaves are located in a second one; with that, leaves decode independently and in
//! parallel (feature `parallel`).

use crate::block::{self, Compression, DecodeScratch, ValueLayout};
use crate::error::{Error, Result};
use crate::limits::{Budget, Limits};
use crate::mask::Mask;
use crate::source::Cursor;
use crate::tree::{InternalNode, LEAF_VOXELS, LEVEL4, LEVEL5, Leaves, Level, RootTile, Tiles, Tree};

/// The shape of a tree, with where its values stand in the file.
struct Topology<'a> {
    background: &'a [u8],
    root_tiles: Vec<([i32; 3], &'a [u8], bool)>,
    nodes5: Vec<NodeShape<'a>>,
    nodes4: Vec<NodeShape<'a>>,
    leaf_origins: Vec<[i32; 3]>,
    leaf_masks: Vec<[u64; 8]>,
    /// A cursor at the value block of each leaf.
    leaf_blocks: Vec<Cursor<'a>>,
}

struct NodeShape<'a> {
    origin: [i32; 3],
    child_mask: Mask,
    value_mask: Mask,
    first_child: usize,
    /// A cursor at the block of the tile values.
    tiles: Cursor<'a>,
}

/// Reads a float tree from its first byte to its last.
pub(crate) fn read_float_tree(
    cursor: &mut Cursor<'_>,
    compression: Compression,
    layout: ValueLayout,
    budget: &mut Budget,
) -> Result<Tree> {
    let topology = read_topology(cursor, compression, layout, budget)?;
    let float = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().expect("a float has four bytes"));
    let background = float(topology.background);

    let mut scratch = DecodeScratch::default();
    let mut tiles = vec![0.0; LEVEL5.slots()];
    let mut decode_nodes = |shapes: Vec<NodeShape<'_>>, level: Level| -> Result<Vec<InternalNode>> {
        let mut nodes = Vec::with_capacity(shapes.len());
        for mut shape in shapes {
            let slots = level.slots();
            let active = shape.value_mask.count();
            let values = &mut tiles[..slots];
            block::parse(&mut shape.tiles, compression, layout, slots, active)?.decode_f32(
                layout,
                background,
                shape.value_mask.words(),
                values,
                &mut scratch,
            )?;
            let tiles = pack_tiles(values, &shape.child_mask, background);
            if let Tiles::PerSlot(values) = &tiles {
                budget.take(values.len(), 4, "tile values")?;
            }
            let NodeShape { origin, child_mask, value_mask, first_child, .. } = shape;
            nodes.push(InternalNode { origin, child_mask, value_mask, tiles, first_child });
        }
        Ok(nodes)
    };
    let mut nodes5 = decode_nodes(topology.nodes5, LEVEL5)?;
    let nodes4 = decode_nodes(topology.nodes4, LEVEL4)?;
    nodes5.sort_by_key(|node| node.origin);

    let mut root_tiles: Vec<RootTile> = topology
        .root_tiles
        .iter()
        .map(|(origin, value, active)| RootTile { origin: *origin, value: float(value), active: *active })
        .collect();
    root_tiles.sort_by_key(|tile| tile.origin);
    let same_origin = root_tiles.windows(2).any(|pair| pair[0].origin == pair[1].origin)
        || nodes5.windows(2).any(|pair| pair[0].origin == pair[1].origin)
        || root_tiles.iter().any(|t| nodes5.binary_search_by_key(&t.origin, |n| n.origin).is_ok());
    if same_origin {
        return Err(cursor.malformed("two entries of the root stand at the same place"));
    }

    budget.take(topology.leaf_origins.len(), LEAF_VOXELS * 4, "the values of all leaves")?;
    let values = decode_leaves(&topology.leaf_blocks, &topology.leaf_masks, |block, mask, out, scratch| {
        let active = mask.iter().map(|word| word.count_ones() as usize).sum();
        block::parse(&mut block.clone(), compression, layout, LEAF_VOXELS, active)?
            .decode_f32(layout, background, mask, out, scratch)
    })?;
    let leaves = Leaves { origins: topology.leaf_origins, masks: topology.leaf_masks, values };
    Ok(Tree { background, root_tiles, nodes5, nodes4, leaves })
}

/// Moves the cursor past a tree of any value type with a fixed layout.
pub(crate) fn skip_tree(
    cursor: &mut Cursor<'_>,
    compression: Compression,
    layout: ValueLayout,
    limits: &Limits,
) -> Result<()> {
    read_topology(cursor, compression, layout, &mut Budget::new(limits)).map(|_| ())
}

fn read_topology<'a>(
    cursor: &mut Cursor<'a>,
    compression: Compression,
    layout: ValueLayout,
    budget: &mut Budget,
) -> Result<Topology<'a>> {
    let buffers = cursor.u32("the number of buffers")?;
    if buffers != 1 {
        return Err(Error::unsupported(format!("trees with {buffers} buffers")));
    }
    let background = cursor.take(layout.value_bytes, "the background value")?;
    let tile_count = cursor.u32("the number of root tiles")?;
    let child_count = cursor.u32("the number of root children")?;
    let mut topology = Topology {
        background,
        root_tiles: Vec::new(),
        nodes5: Vec::new(),
        nodes4: Vec::new(),
        leaf_origins: Vec::new(),
        leaf_masks: Vec::new(),
        leaf_blocks: Vec::new(),
    };
    for _ in 0..tile_count {
        let origin = read_root_origin(cursor)?;
        let value = cursor.take(layout.value_bytes, "a root tile")?;
        let active = cursor.u8("a root tile's state")? != 0;
        budget.take(1, 128, "root tiles")?;
        topology.root_tiles.push((origin, value, active));
    }
    for _ in 0..child_count {
        let origin = read_root_origin(cursor)?;
        let first_child = topology.nodes4.len();
        let node5 = read_node(cursor, compression, layout, LEVEL5, origin, first_child, budget)?;
        for slot in node5.child_mask.iter() {
            let origin = LEVEL5.child_origin(node5.origin, slot);
            let first_child = topology.leaf_origins.len();
            let node4 = read_node(cursor, compression, layout, LEVEL4, origin, first_child, budget)?;
            budget.take(node4.child_mask.count(), 2 * (12 + 64 + size_of::<Cursor<'_>>()), "leaves")?;
            for slot in node4.child_mask.iter() {
                let mut mask = [0; 8];
                cursor.mask_words(&mut mask, "a leaf's mask")?;
                topology.leaf_origins.push(LEVEL4.child_origin(node4.origin, slot));
                topology.leaf_masks.push(mask);
            }
            topology.nodes4.push(node4);
        }
        topology.nodes5.push(node5);
    }
    topology.leaf_blocks.reserve_exact(topology.leaf_masks.len());
    for mask in &topology.leaf_masks {
        // Each leaf repeats its mask before its values; the topology's counts.
        cursor.take(64, "a leaf's mask")?;
        topology.leaf_blocks.push(cursor.clone());
        let active = mask.iter().map(|word| word.count_ones() as usize).sum();
        block::parse(cursor, compression, layout, LEAF_VOXELS, active)?;
    }
    Ok(topology)
}

fn read_root_origin(cursor: &mut Cursor<'_>) -> Result<[i32; 3]> {
    let origin = cursor.coord("the origin of a root entry")?;
    match origin.iter().all(|c| c & 4095 == 0) {
        true => Ok(origin),
        false => Err(cursor.malformed(format!("{origin:?} is not the origin of a root entry"))),
    }
}

fn read_node<'a>(
    cursor: &mut Cursor<'a>,
    compression: Compression,
    layout: ValueLayout,
    level: Level,
    origin: [i32; 3],
    first_child: usize,
    budget: &mut Budget,
) -> Result<NodeShape<'a>> {
    let words = level.slots() / 64;
    // Twice for the growth of the vector of nodes.
    budget.take(2 * words, Mask::BYTES_PER_WORD, "nodes")?;
    budget.take(2, size_of::<NodeShape<'_>>() + size_of::<InternalNode>(), "nodes")?;
    let mut masks = [vec![0; words], vec![0; words]];
    for mask in &mut masks {
        cursor.mask_words(mask, "a node's mask")?;
    }
    let [child_mask, value_mask] = masks.map(|mask| Mask::new(mask.into()));
    let tiles = cursor.clone();
    block::parse(cursor, compression, layout, level.slots(), value_mask.count())?;
    Ok(NodeShape { origin, child_mask, value_mask, first_child, tiles })
}

/// One value if all tiles agree on it to the bit, else all of them.
fn pack_tiles(values: &[f32], child_mask: &Mask, background: f32) -> Tiles {
    let mut tiles = (0..values.len()).filter(|slot| !child_mask.contains(*slot)).map(|slot| values[slot]);
    let Some(first) = tiles.next() else { return Tiles::Uniform(background) };
    match tiles.all(|value| value.to_bits() == first.to_bits()) {
        true => Tiles::Uniform(first),
        false => Tiles::PerSlot(values.into()),
    }
}

/// Decodes the blocks of all leaves, 512 values each.
fn decode_leaves<'a>(
    blocks: &[Cursor<'a>],
    masks: &[[u64; 8]],
    decode: impl Fn(&Cursor<'a>, &[u64; 8], &mut [f32], &mut DecodeScratch) -> Result<()> + Sync,
) -> Result<Vec<f32>> {
    let mut values = vec![0.0; blocks.len() * LEAF_VOXELS];
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        values
            .par_chunks_mut(LEAF_VOXELS)
            .zip(blocks)
            .zip(masks)
            .with_min_len(64)
            .try_for_each_init(DecodeScratch::default, |scratch, ((out, block), mask)| {
                decode(block, mask, out, scratch)
            })?;
    }
    #[cfg(not(feature = "parallel"))]
    {
        let mut scratch = DecodeScratch::default();
        for ((out, block), mask) in values.chunks_mut(LEAF_VOXELS).zip(blocks).zip(masks) {
            decode(block, mask, out, &mut scratch)?;
        }
    }
    Ok(values)
}
