//! Reading a tree: first its topology, then its values.
//!
//! A tree is written depth first, all nodes before all leaf values. The topology is read in one pass and the value
//! blocks of the leaves are located in a second one; from there, leaves decode independently and in parallel (feature
//! `parallel`), and those outside of a box that is asked for are passed over.
//!
//! What older files do otherwise stands at the places where they do it: before version 214 inner nodes interleave
//! values and children, before 222 they store the values of tiles alone and leaves repeat their origin.

use std::sync::{Mutex, PoisonError};

use crate::block::{self, BlockFormat, DecodeScratch};
use crate::error::{Error, Result};
use crate::limits::Budget;
use crate::mask::Mask;
use crate::source::{Reader, Source};
use crate::stats::IndexBox;
use crate::tree::{InternalNode, Leaves, RootTile, Shape, Tiles, Tree};
use crate::value::{LeafValues, Value};

/// From this version on the values of inner nodes stand in one block.
const NODE_BLOCKS_SINCE: u32 = 214;
/// From this version on the values of bool leaves are bits.
const BOOL_BITS_SINCE: u32 = 217;
/// How many leaves a thread decodes at a time.
const LEAVES_PER_TASK: usize = 64;
/// A task whose leaves span no more than this reads them at once.
const MAX_TASK_SPAN_BYTES: u64 = 4 << 20;

/// Where the value block of a leaf stands in the file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span {
    begin: u64,
    len: u32,
}

/// Reads the nodes of a tree, with the values of its tiles and the masks of its leaves, but none of their values. The
/// reader stands at the first byte of the topology, and afterwards past its last.
pub(crate) fn topology<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    shape: Shape,
    budget: &mut Budget,
) -> Result<Tree<V>> {
    let buffers = reader.u32("the number of buffers")?;
    if buffers != 1 {
        return Err(Error::unsupported(format!("trees with {buffers} buffers")));
    }
    let background = V::from_bytes(reader.take(V::SIZE_BYTES, "the background value")?);
    let tile_count = reader.u32("the number of root tiles")?;
    let child_count = reader.u32("the number of root children")?;
    let mut tree = Tree::empty(background, shape);
    for _ in 0..tile_count {
        let origin = root_origin(reader, shape)?;
        let value = V::from_bytes(reader.take(V::SIZE_BYTES, "a root tile")?);
        let active = reader.u8("a root tile's state")? != 0;
        // Twice for the growth of the vector.
        budget.take(2, size_of::<RootTile<V>>(), "root tiles")?;
        tree.root_tiles.push(RootTile { origin, value, active });
    }
    let mut walk = Walk { reader, format, budget, tree: &mut tree, scratch: DecodeScratch::default() };
    for _ in 0..child_count {
        let origin = root_origin(walk.reader, shape)?;
        walk.child(0, origin)?;
    }
    tree.root_tiles.sort_by_key(|tile| tile.origin);
    sort_root_children(&mut tree);
    let is_child = |origin: &[i32; 3]| match tree.levels.first() {
        Some(nodes) => nodes.binary_search_by_key(origin, |node| node.origin).is_ok(),
        None => tree.leaves.origins.binary_search(origin).is_ok(),
    };
    let nodes_twice = match tree.levels.first() {
        Some(nodes) => nodes.windows(2).any(|pair| pair[0].origin == pair[1].origin),
        // Without inner nodes, leaves are the children, and are looked up where they stand.
        None => !tree.leaves.origins.is_sorted_by(|a, b| a < b),
    };
    let same_origin = nodes_twice
        || tree.root_tiles.windows(2).any(|pair| pair[0].origin == pair[1].origin)
        || tree.root_tiles.iter().any(|tile| is_child(&tile.origin));
    match same_origin {
        true => Err(reader.malformed("two entries of the root stand at the same place")),
        false => Ok(tree),
    }
}

/// OpenVDB writes the children of the root in order, and so does everyone who wants to be read by it. Where they are
/// not, the vectors of the other levels stay as they are: nodes know where their children begin.
fn sort_root_children<V: Value>(tree: &mut Tree<V>) {
    if let Some(nodes) = tree.levels.first_mut() {
        nodes.sort_by_key(|node| node.origin);
    }
}

/// Reads the values of all leaves of a tree whose topology has been read: `values` of [`Leaves`] is filled. The
/// reader stands at the first byte behind the topology.
pub(crate) fn leaf_values<V: Value>(
    source: &dyn Source,
    reader: &mut Reader<'_>,
    format: BlockFormat,
    tree: &mut Tree<V>,
    budget: &mut Budget,
) -> Result<()> {
    tree.leaves.values = decode_leaves(source, reader, format, tree, None, budget)?;
    Ok(())
}

/// Reads the values of the leaves that touch a box. Gives those leaves by number and their values in that order.
pub(crate) fn leaf_values_in_box<V: Value>(
    source: &dyn Source,
    reader: &mut Reader<'_>,
    format: BlockFormat,
    tree: &Tree<V>,
    bbox: IndexBox,
    budget: &mut Budget,
) -> Result<(Vec<u32>, Vec<V::Stored>)> {
    let last = (1 << tree.shape.leaf_log2()) - 1;
    let touches = |origin: &[i32; 3]| {
        (0..3).all(|i| origin[i] <= bbox[1][i] && bbox[0][i] <= origin[i].saturating_add(last))
    };
    let count = tree.leaves.origins.iter().filter(|origin| touches(origin)).count();
    budget.take(count, 4, "leaves")?;
    let origins = tree.leaves.origins.iter().enumerate();
    let wanted: Vec<u32> = origins.filter(|(_, o)| touches(o)).map(|(i, _)| i as u32).collect();
    let values = decode_leaves(source, reader, format, tree, Some(&wanted), budget)?;
    Ok((wanted, values))
}

/// Moves past the values of all leaves.
pub(crate) fn skip_leaf_values<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    leaves: &Leaves<V>,
) -> Result<()> {
    (0..leaves.len()).try_for_each(|i| skip_leaf(reader, format, leaves, i).map(|_| ()))
}

/// Moves past the values of all leaves. Gives position and origin of the first leaf whose mask does not stand before
/// its values as it stands in the topology.
pub(crate) fn first_contrary_mask<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    leaves: &Leaves<V>,
) -> Result<Option<(u64, [i32; 3])>> {
    let mut found = None;
    let mut words = Vec::new();
    for (i, origin) in leaves.origins.iter().enumerate() {
        let at = reader.offset();
        words.clear();
        reader.mask_words(leaves.leaf_voxels, &mut words, "a leaf's mask")?;
        if found.is_none() && words != leaves.mask(i) {
            found = Some((at, *origin));
        }
        reader.seek(at);
        skip_leaf(reader, format, leaves, i)?;
    }
    Ok(found)
}

/// The state of reading a topology.
struct Walk<'r, 'a, V: Value> {
    reader: &'r mut Reader<'a>,
    format: BlockFormat,
    budget: &'r mut Budget,
    tree: &'r mut Tree<V>,
    scratch: DecodeScratch<V>,
}

impl<V: Value> Walk<'_, '_, V> {
    /// Reads a child of the given depth, 0 for a child of the root, and what is below it.
    fn child(&mut self, depth: usize, origin: [i32; 3]) -> Result<()> {
        if depth == self.tree.shape.inner_levels() { self.leaf(origin) } else { self.node(depth, origin) }
    }

    fn leaf(&mut self, origin: [i32; 3]) -> Result<()> {
        let leaves = &mut self.tree.leaves;
        grow(&mut leaves.origins, 1, self.budget)?;
        grow(&mut leaves.masks, leaves.leaf_voxels.div_ceil(64), self.budget)?;
        self.reader.mask_words(leaves.leaf_voxels, &mut leaves.masks, "a leaf's mask")?;
        leaves.origins.push(origin);
        Ok(())
    }

    fn node(&mut self, depth: usize, origin: [i32; 3]) -> Result<()> {
        let branching = self.tree.shape.branching(depth);
        let slots = branching.slots();
        let words = slots.div_ceil(64);
        self.budget.take(2 * words, Mask::BYTES_PER_WORD, "nodes")?;
        let mut masks = [Vec::with_capacity(words), Vec::with_capacity(words)];
        for mask in &mut masks {
            self.reader.mask_words(slots, mask, "a node's mask")?;
        }
        let [child_mask, value_mask] = masks.map(|mask| Mask::new(mask.into(), slots));
        let first_child = match self.tree.levels.get(depth + 1) {
            Some(nodes) => nodes.len(),
            None => self.tree.leaves.len(),
        };
        let background = self.tree.background;
        let interleaved = self.format.file_version < NODE_BLOCKS_SINCE;
        let tiles = if interleaved {
            Tiles::Uniform(background)
        } else {
            self.tiles(&child_mask, &value_mask, slots)?
        };
        let children = child_mask.clone();
        let nodes = &mut self.tree.levels[depth];
        grow(nodes, 1, self.budget)?;
        let index = nodes.len();
        nodes.push(InternalNode { origin, child_mask, value_mask, tiles, first_child });
        if !interleaved {
            return children
                .iter()
                .try_for_each(|slot| self.child(depth + 1, branching.child_origin(origin, slot)));
        }
        let mut values = vec![background; slots];
        for (slot, value) in values.iter_mut().enumerate() {
            match children.contains(slot) {
                true => self.child(depth + 1, branching.child_origin(origin, slot))?,
                false => *value = V::from_bytes(self.reader.take(V::SIZE_BYTES, "a tile")?),
            }
        }
        self.tree.levels[depth][index].tiles = self.pack(&values, &children)?;
        Ok(())
    }

    /// Reads the block of a node's tiles.
    fn tiles(&mut self, child_mask: &Mask, value_mask: &Mask, slots: usize) -> Result<Tiles<V>> {
        let background = self.tree.background;
        let mut values = vec![background; slots];
        if self.format.has_inactive_values() {
            let block = block::parse::<V>(self.reader, self.format, slots, value_mask.count())?;
            let end = self.reader.offset();
            let mask = value_mask.words();
            block.decode(self.reader, self.format, background, mask, &mut values, &mut self.scratch)?;
            self.reader.seek(end);
        } else {
            // The values of the slots that are no children, and no others.
            let count = slots - child_mask.count();
            let block = block::parse::<V>(self.reader, self.format, count, count)?;
            let mut packed = vec![background; count];
            block.decode(self.reader, self.format, background, &[], &mut packed, &mut self.scratch)?;
            let tiles = values.iter_mut().enumerate().filter(|(slot, _)| !child_mask.contains(*slot));
            tiles.zip(packed).for_each(|((_, value), stored)| *value = stored);
        }
        self.pack(&values, child_mask)
    }

    fn pack(&mut self, values: &[V], child_mask: &Mask) -> Result<Tiles<V>> {
        let tiles = Tiles::pack(values, child_mask, self.tree.background);
        if let Tiles::PerSlot(values) = &tiles {
            self.budget.take(values.len(), size_of::<V>(), "tile values")?;
        }
        Ok(tiles)
    }
}

/// Makes room for more items, by an eighth of what is there and not twofold: for masks this is most of the memory.
fn grow<T>(items: &mut Vec<T>, more: usize, budget: &mut Budget) -> Result<()> {
    if items.capacity() - items.len() < more {
        let added = (items.len() / 8).max(more).max(16);
        budget.take(added, size_of::<T>(), "the nodes of a tree")?;
        items.reserve_exact(added);
    }
    Ok(())
}

fn root_origin(reader: &mut Reader<'_>, shape: Shape) -> Result<[i32; 3]> {
    let at = reader.offset();
    let origin = reader.coord("the origin of a root entry")?;
    match shape.root_origin(origin) == origin {
        true => Ok(origin),
        false => Err(Error::malformed(at, format!("{origin:?} is not the origin of a root entry"))),
    }
}

/// Finds the value blocks of leaves, task by task, in ascending order of their numbers.
struct Locator<'r, 'a, 't, V: Value> {
    reader: &'r mut Reader<'a>,
    format: BlockFormat,
    leaves: &'t Leaves<V>,
    /// The leaves to find, all of them if `None`.
    wanted: Option<&'t [u32]>,
    /// The leaf at which the reader stands.
    next_leaf: usize,
}

impl<V: Value> Locator<'_, '_, '_, V> {
    /// The blocks of a task. Past the last leaf that is wanted nothing is looked at.
    fn task(&mut self, task: usize) -> Result<Vec<Span>> {
        let count = self.wanted.map_or(self.leaves.len(), <[u32]>::len);
        let numbers = task * LEAVES_PER_TASK..count.min((task + 1) * LEAVES_PER_TASK);
        let mut spans = Vec::with_capacity(numbers.len());
        for number in numbers {
            let leaf = self.wanted.map_or(number, |wanted| wanted[number] as usize);
            while self.next_leaf < leaf {
                self.skip_leaf()?;
            }
            spans.push(self.skip_leaf()?);
        }
        Ok(spans)
    }

    fn skip_leaf(&mut self) -> Result<Span> {
        self.next_leaf += 1;
        skip_leaf(self.reader, self.format, self.leaves, self.next_leaf - 1)
    }
}

/// Moves past what a file holds of a leaf and says where its values are.
pub(crate) fn skip_leaf<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    leaves: &Leaves<V>,
    i: usize,
) -> Result<Span> {
    let voxels = leaves.leaf_voxels;
    // Each leaf repeats its mask before its values; the topology's counts.
    reader.skip((voxels / 8) as u64, "a leaf's mask")?;
    let bits = !matches!(V::leaf(&[]), LeafValues::Plain(_));
    let old = !format.has_inactive_values();
    let mut buffers = 1;
    if bits || old {
        reader.skip(12, "a leaf's origin")?;
        if old && (!bits || format.file_version < BOOL_BITS_SINCE) {
            // Signed in the file; less than one counts as one.
            buffers = i32::from(reader.u8("a leaf's number of buffers")? as i8);
        }
    }
    let begin = reader.offset();
    let mut len = 0;
    match V::leaf(&[]) {
        LeafValues::Mask => {}
        LeafValues::Bits(_) if format.file_version >= BOOL_BITS_SINCE => {
            reader.skip((voxels / 8) as u64, "the values of a leaf")?;
            len = reader.offset() - begin;
        }
        _ => {
            let active = leaves.mask(i).iter().map(|word| word.count_ones() as usize).sum();
            let format = leaf_format::<V>(format);
            block::parse::<V>(reader, format, voxels, active)?;
            len = reader.offset() - begin;
            for _ in 1..buffers {
                block::parse::<V>(reader, format, voxels, voxels)?;
            }
        }
    }
    // A block is at most a few times the size of its values.
    Ok(Span { begin, len: u32::try_from(len).map_err(|_| reader.malformed("a leaf of over 4 GiB"))? })
}

/// How the blocks of leaves are written. Those of bool leaves, while there were any, were always zipped.
fn leaf_format<V: Value>(format: BlockFormat) -> BlockFormat {
    match V::leaf(&[]) {
        LeafValues::Bits(_) => BlockFormat { compression: block::Compression::ZIP, ..format },
        _ => format,
    }
}

/// Reads the values of all leaves, or of those of `wanted` numbers. The reader stands at the first byte behind the
/// topology.
///
/// Where a block stands is known only once those before it were passed. One thread finds them and hands them out,
/// while the others decode already.
fn decode_leaves<V: Value>(
    source: &dyn Source,
    reader: &mut Reader<'_>,
    format: BlockFormat,
    tree: &Tree<V>,
    wanted: Option<&[u32]>,
    budget: &mut Budget,
) -> Result<Vec<V::Stored>> {
    let count = wanted.map_or(tree.leaves.len(), <[u32]>::len);
    let per_leaf = V::stored_per_leaf(tree.leaves.leaf_voxels);
    budget.take(count, size_of::<Span>(), "leaves")?;
    budget.take(count, per_leaf * size_of::<V::Stored>(), "the values of all leaves")?;
    let mut values = vec![V::Stored::default(); count * per_leaf];
    if per_leaf == 0 {
        skip_leaf_values(reader, format, &tree.leaves)?;
        return Ok(values);
    }
    let mut locator = Locator { reader, format, leaves: &tree.leaves, wanted, next_leaf: 0 };
    let decoder =
        LeafDecoder { source, format, tree, wanted, idle: Mutex::default(), failure: Mutex::default() };
    let tasks = values.chunks_mut(LEAVES_PER_TASK * per_leaf).enumerate();
    #[cfg(feature = "parallel")]
    rayon::scope(|scope| -> Result<()> {
        for (task, out) in tasks {
            let spans = locator.task(task)?;
            let decoder = &decoder;
            scope.spawn(move |_| decoder.run(task, &spans, out));
        }
        Ok(())
    })?;
    #[cfg(not(feature = "parallel"))]
    for (task, out) in tasks {
        decoder.run(task, &locator.task(task)?, out);
    }
    match decoder.failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some((_, error)) => Err(error),
        None => Ok(values),
    }
}

/// What the tasks of decoding leaves share.
struct LeafDecoder<'t, V: Value> {
    source: &'t dyn Source,
    format: BlockFormat,
    tree: &'t Tree<V>,
    wanted: Option<&'t [u32]>,
    /// Buffers that no task uses now.
    idle: Mutex<Vec<DecodeScratch<V>>>,
    /// The first task that failed, by number and not by time, so that the same file gives the same error.
    failure: Mutex<Option<(usize, Error)>>,
}

impl<V: Value> LeafDecoder<'_, V> {
    /// Decodes the leaves of a task into `out`, unless an earlier one has failed.
    fn run(&self, task: usize, spans: &[Span], out: &mut [V::Stored]) {
        let failure = || self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        let idle = || self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        if failure().as_ref().is_some_and(|(failed, _)| *failed < task) {
            return;
        }
        let mut scratch = idle().pop().unwrap_or_default();
        let result = self.decode(task * LEAVES_PER_TASK, spans, out, &mut scratch);
        idle().push(scratch);
        if let Err(error) = result {
            let mut failure = failure();
            if failure.as_ref().is_none_or(|(failed, _)| task < *failed) {
                *failure = Some((task, error));
            }
        }
    }

    /// Decodes leaves, of which the first is the `first` of those that are wanted.
    fn decode(
        &self,
        first: usize,
        spans: &[Span],
        out: &mut [V::Stored],
        scratch: &mut DecodeScratch<V>,
    ) -> Result<()> {
        let (Some(head), Some(tail)) = (spans.first(), spans.last()) else { return Ok(()) };
        let end = tail.begin + u64::from(tail.len);
        let whole = match end - head.begin {
            span if span <= MAX_TASK_SPAN_BYTES => Some(self.source.range(head.begin, span as usize)?),
            _ => None,
        };
        let mut reader = match &whole {
            Some(bytes) => Reader::over(bytes, head.begin),
            None => Reader::new(self.source, head.begin, end)?,
        };
        let per_leaf = V::stored_per_leaf(self.tree.leaves.leaf_voxels);
        for (i, (out, span)) in out.chunks_mut(per_leaf).zip(spans).enumerate() {
            let leaf = self.wanted.map_or(first + i, |wanted| wanted[first + i] as usize);
            reader.seek(span.begin);
            decode_leaf(&mut reader, self.format, self.tree, leaf, out, scratch)?;
        }
        Ok(())
    }
}

/// Decodes the values of a leaf from where the reader stands.
fn decode_leaf<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    tree: &Tree<V>,
    leaf: usize,
    out: &mut [V::Stored],
    scratch: &mut DecodeScratch<V>,
) -> Result<()> {
    let voxels = tree.leaves.leaf_voxels;
    let mask = tree.leaves.mask(leaf);
    match V::leaf_mut(out) {
        LeafValues::Mask => Ok(()),
        LeafValues::Plain(out) => {
            let active = mask.iter().map(|word| word.count_ones() as usize).sum();
            let block = block::parse::<V>(reader, format, voxels, active)?;
            block.decode(reader, format, tree.background, mask, out, scratch)
        }
        LeafValues::Bits(out) if format.file_version >= BOOL_BITS_SINCE => {
            for (word, bytes) in
                out.iter_mut().zip(reader.take(voxels / 8, "the values of a leaf")?.chunks(8))
            {
                *word = bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte));
            }
            Ok(())
        }
        LeafValues::Bits(out) => {
            let format = leaf_format::<V>(format);
            let block = block::parse::<V>(reader, format, voxels, voxels)?;
            let mut values = vec![V::default(); voxels];
            block.decode(reader, format, tree.background, mask, &mut values, scratch)?;
            for (offset, value) in values.iter().enumerate() {
                out[offset / 64] |= u64::from(value.component(0) != 0.0) << (offset % 64);
            }
            Ok(())
        }
    }
}
