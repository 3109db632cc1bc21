//! Packing trees: from the flat arrays of one tree to the arrays that all trees share.
//!
//! What is equal is stored once: masks, nodes with all their entries, and so all that is below them.

use std::collections::{HashMap, HashSet};
use std::hash::Hash;

use super::{Content, Entry, Node, RootCell, TreeRef, Trees, mask};
use crate::brick::Bounds;
use crate::codec::Codec;
use crate::space::{NODE4_SLOTS, NODE5_SLOTS};
use crate::tree;

/// Packs trees one after the other.
#[derive(Debug, Clone, Default)]
pub struct Packer {
    trees: Trees,
    /// Where each mask stands.
    masks: HashMap<Vec<u32>, u32>,
    node5s: HashMap<NodeKey, u32>,
    node4s: HashMap<NodeKey, u32>,
}

/// A node by what it holds: its mask and a digest of its entries.
type NodeKey = (u32, u128);

/// A tree has too many of something for 32-bit indices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a packed volume of more than 2³² entries or mask words")]
pub struct TooLarge;

/// How the values of a channel are written in entries.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EntryScale {
    /// The unit of bounds: a power of two, not less than any magnitude.
    pub unit: f32,
    /// The value of what has no entry.
    pub background: f32,
}

impl Packer {
    /// Goes on behind trees that are there, which have been checked: what they hold is not stored again.
    pub fn onto(trees: Trees) -> Packer {
        let mut packer = Packer::default();
        let mut keys = [HashMap::new(), HashMap::new()];
        for ((nodes, slots), keys) in
            [(&trees.node5s, NODE5_SLOTS), (&trees.node4s, NODE4_SLOTS)].into_iter().zip(&mut keys)
        {
            for (index, node) in nodes.iter().enumerate() {
                let Some(bits) = mask::decode(&trees.masks, node.mask, slots) else { continue };
                let count = bits.iter().map(|word| word.count_ones() as usize).sum::<usize>();
                let first = node.first_entry as usize;
                let Some(entries) = trees.entries.get(first..first + count) else { continue };
                // Of equal masks the first counts, and keys are made of it.
                let mask = *packer.masks.entry(bits).or_insert(node.mask);
                keys.entry((mask, digest(entries))).or_insert(index as u32);
            }
        }
        [packer.node5s, packer.node4s] = keys;
        Packer { trees, ..packer }
    }

    /// Adds a tree. Its values are those of the source less the background; `bricks` says where each of its bricks
    /// stands in the brick store, and `constant` gives the exact value of a constant entry from the one in the tree.
    ///
    /// # Errors
    /// If there are more than 2³² of something.
    pub fn add(
        &mut self,
        tree: &tree::Tree,
        bricks: &[(Codec, u32)],
        scale: EntryScale,
        constant: impl Fn(f32) -> f32,
    ) -> Result<TreeRef, TooLarge> {
        let EntryScale { unit, background } = scale;
        let bounds = |footprint: Bounds| match background {
            0.0 => footprint,
            // The sum may be rounded inward, and so may the difference have been.
            shift => {
                let [min, max] = [footprint.min, footprint.max];
                let slack = |value: f32| f32::EPSILON * value.abs();
                Bounds {
                    min: (min - slack(min) + shift).next_down(),
                    max: (max + slack(max) + shift).next_up(),
                }
            }
        };
        let pack = |entry: &tree::Entry, footprint: Bounds, child: &dyn Fn(u32) -> Content| {
            let content = match entry.child {
                tree::Entry::CONSTANT => Content::Constant(constant(entry.mean)),
                index => child(index),
            };
            Entry::new(content, bounds(footprint), unit)
        };
        let brick = |index: u32| {
            let (codec, offset) = bricks[index as usize];
            Content::Brick { codec, offset }
        };
        let node4s =
            self.add_level(&tree.node4, NODE4_SLOTS, |entry, footprint| pack(entry, footprint, &brick))?;
        let node4s = unique_nodes(&mut self.trees.node4s, &mut self.node4s, node4s)?;
        let node5s = self.add_level(&tree.node5, NODE5_SLOTS, |entry, footprint| {
            pack(entry, footprint, &|index| Content::Node(node4s[index as usize]))
        })?;
        let node5s = unique_nodes(&mut self.trees.node5s, &mut self.node5s, node5s)?;
        let first_cell = to_index(self.trees.cells.len())?;
        for cell in &tree.root {
            let entry = pack(&cell.entry, cell.footprint, &|index| Content::Node(node5s[index as usize]));
            self.trees.cells.push(RootCell { cell: cell.cell.to_array(), entry });
        }
        Ok(TreeRef { first_cell, cell_count: tree.root.len() as u32, background })
    }

    /// The arrays.
    pub fn finish(self) -> Trees {
        self.trees
    }

    /// The arrays so far.
    pub fn trees(&self) -> &Trees {
        &self.trees
    }

    /// Adds masks and entries of the nodes of a level, as far as they are new. Gives the nodes and their keys.
    fn add_level(
        &mut self,
        nodes: &tree::Nodes,
        slots: usize,
        pack: impl Fn(&tree::Entry, Bounds) -> Entry,
    ) -> Result<Vec<(NodeKey, Node)>, TooLarge> {
        let known = if slots == NODE4_SLOTS { &self.node4s } else { &self.node5s };
        let (mut added, mut new_keys) = (Vec::new(), HashSet::new());
        for words in nodes.words.chunks(slots / 32) {
            let bits: Vec<u32> = words.iter().map(|word| word.bits).collect();
            let first = words[0].first_entry as usize;
            let count = bits.iter().map(|word| word.count_ones() as usize).sum::<usize>();
            let range = first..first + count;
            let entries: Vec<Entry> = nodes.entries[range.clone()]
                .iter()
                .zip(&nodes.footprints[range])
                .map(|(entry, footprint)| pack(entry, *footprint))
                .collect();
            let masks = &mut self.trees.masks;
            let mask = match self.masks.get(&bits) {
                Some(mask) => *mask,
                None => {
                    let begin = to_index(masks.len())?;
                    masks.extend(mask::encode(&bits));
                    self.masks.insert(bits, begin);
                    begin
                }
            };
            let key = (mask, digest(&entries));
            let first_entry = to_index(self.trees.entries.len())?;
            if !known.contains_key(&key) && new_keys.insert(key) {
                self.trees.entries.extend(entries);
            }
            added.push((key, Node { mask, first_entry }));
        }
        to_index(self.trees.entries.len())?;
        Ok(added)
    }
}

fn digest(entries: &[Entry]) -> u128 {
    xxhash_rust::xxh3::xxh3_128(bytemuck::cast_slice(entries))
}

/// Adds the nodes that are new. Gives the index of each.
fn unique_nodes<K: Copy + Eq + Hash>(
    nodes: &mut Vec<Node>,
    known: &mut HashMap<K, u32>,
    added: Vec<(K, Node)>,
) -> Result<Vec<u32>, TooLarge> {
    let index = |(key, node): (K, Node)| match known.get(&key) {
        Some(index) => Ok(*index),
        None => {
            let index = to_index(nodes.len())?;
            nodes.push(node);
            known.insert(key, index);
            Ok(index)
        }
    };
    added.into_iter().map(index).collect()
}

fn to_index(len: usize) -> Result<u32, TooLarge> {
    u32::try_from(len).map_err(|_| TooLarge)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::{BrickSummary, Bricks};
    use crate::build::{TileSize, TreeBuilder};
    use glam::IVec3;
    use proptest::prelude::*;

    /// Bricks of one value each that is their index, for the tree's sake not constant.
    fn tree(places: &[(IVec3, bool)]) -> (tree::Tree, Vec<(Codec, u32)>) {
        let mut builder = TreeBuilder::new();
        let (mut values, mut bricks) = (Vec::new(), Vec::new());
        for (place, is_tile) in places {
            let sum = 1.0 + (place.x * 3 + place.y * 7 + place.z).rem_euclid(13) as f32;
            if *is_tile {
                builder.tile(*place, TileSize::Brick, sum).unwrap();
                continue;
            }
            let mut brick = [sum; 512];
            brick[511] = 0.5;
            builder.brick(*place, BrickSummary::of(&brick)).unwrap();
            bricks.push((Codec::F32, bricks.len() as u32 * 512));
            values.extend(brick);
        }
        (builder.finish(Bricks::F32(values)).unwrap(), bricks)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        #[test]
        fn packed_trees_hold_what_the_tree_holds(
            places in proptest::collection::btree_map((-40_i32..40, -3_i32..600, 0_i32..20), any::<bool>(), 0..60),
            background in prop::sample::select(vec![0.0_f32, -0.3]),
        ) {
            let places: Vec<(IVec3, bool)> = places.into_iter().map(|((x, y, z), t)| (IVec3::new(x, y, z), t)).collect();
            let (tree, bricks) = tree(&places);
            let scale = EntryScale { unit: 16.0, background };
            let mut packer = Packer::default();
            let packed = packer.add(&tree, &bricks, scale, |value| value + background).unwrap();
            let size = packer.trees().size_bytes();
            let again = packer.add(&tree, &bricks, scale, |value| value + background).unwrap();
            prop_assert_eq!(packer.trees().size_bytes(), size + 20 * tree.root.len(), "a frame that repeats costs its root");
            let mut further = Packer::onto(packer.trees().clone());
            further.add(&tree, &bricks, scale, |value| value + background).unwrap();
            let grown = packer.trees().size_bytes() + 20 * tree.root.len();
            prop_assert_eq!(further.trees().size_bytes(), grown, "so it does behind trees that were there before");
            let trees = packer.finish();
            let in_store = |codec: Codec, offset: u32| codec == Codec::F32 && (offset as usize) < 512 * bricks.len();
            prop_assert_eq!(trees.check(in_store), Ok(()));
            for packed in [packed, again] {
                for (place, _) in &places {
                    for step in -1..2 {
                        let brick = *place + step;
                        let region = tree.region(brick);
                        let (content, log2) = trees.find(packed, brick);
                        let expected = match region.content {
                            tree::Content::Constant(value) => Content::Constant(value + background),
                            tree::Content::Brick(i) => Content::Brick { codec: Codec::F32, offset: i * 512 },
                        };
                        prop_assert_eq!((content, log2), (expected, region.log2_bricks));
                    }
                }
            }
            // Where nodes are shared, entries stand in another order.
            let is_in_order = trees.node4s.len() == tree.node4.words.len() / (NODE4_SLOTS / 32);
            for (entry, footprint) in trees.entries.iter().zip(&tree.node4.footprints).filter(|_| is_in_order) {
                let found = entry.footprint(16.0);
                prop_assert!(found.min <= footprint.min + background && found.max >= footprint.max + background);
            }
        }
    }

    #[test]
    fn damaged_arrays_are_noticed() {
        let (tree, bricks) = tree(&[(IVec3::ZERO, false), (IVec3::new(3, 0, 0), true)]);
        let mut packer = Packer::default();
        packer.add(&tree, &bricks, EntryScale { unit: 16.0, background: 0.0 }, |value| value).unwrap();
        let trees = packer.finish();
        let is_brick = |_: Codec, offset: u32| offset == 0;
        assert_eq!(trees.check(is_brick), Ok(()));
        assert!(trees.check(|_, _| false).is_err());
        let damage: [fn(&mut Trees); 7] = [
            |trees| trees.masks[4] += 1,
            |trees| trees.node4s[0].mask = u32::MAX,
            |trees| trees.node4s[0].first_entry += 1,
            |trees| trees.node5s.clear(),
            |trees| trees.entries[0].kind |= 0x7f,
            |trees| {
                trees
                    .entries
                    .iter_mut()
                    .for_each(|entry| *entry = Entry { payload: f32::NAN.to_bits(), kind: 0 })
            },
            |trees| _ = trees.masks.pop(),
        ];
        for (i, damage) in damage.iter().enumerate() {
            let mut damaged = trees.clone();
            damage(&mut damaged);
            assert!(damaged.check(is_brick).is_err(), "damage {i}");
        }
    }
}
