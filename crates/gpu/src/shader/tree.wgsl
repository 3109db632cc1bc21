// The trees of nuage_volume::packed in one array of words: looking up what stands at a brick.

// Where the arrays begin in `tree`; words of brick shapes follow those of the bricks.
fn word_at(array_number: u32, index: u32) -> u32 {
    return tree[tree[array_number] + index];
}

struct Entry { payload: u32, kind: u32 }

fn entry_at(index: u32) -> Entry {
    return Entry(word_at(ENTRIES, 2u * index), word_at(ENTRIES, 2u * index + 1u));
}

fn tag_of(entry: Entry) -> u32 {
    return entry.kind & 0xffu;
}

// What stands at a brick: the entry of the aligned cube of `1 << log2_bricks` bricks per axis around it, and how many bricks beyond
// that hold nothing either.
struct Region { log2_bricks: u32, margin: i32, entry: Entry }

fn half_word(words_at: u32, i: u32) -> u32 {
    return (tree[words_at + (i >> 1u)] >> ((i & 1u) * 16u)) & 0xffffu;
}

fn bits_below(bits: u32, bit: u32) -> u32 {
    return countOneBits(bits & ((1u << bit) - 1u));
}

// How many entries of a node stand before that of a slot, or NONE if the slot has none: nuage_volume::packed::mask.
fn rank(mask: u32, summary_words: u32, slot: u32) -> u32 {
    let begin = tree[MASKS] + mask;
    let word = slot >> 5u;
    let bit = slot & 31u;
    let summary = tree[begin + (word >> 5u)];
    if (((summary >> (word & 31u)) & 1u) == 0u) {
        return NONE;
    }
    let kept = half_word(begin + summary_words, word >> 5u) + bits_below(summary, word & 31u);
    let first_kept = begin + summary_words + ((summary_words + 1u) >> 1u);
    let bits = tree[first_kept + kept];
    if (((bits >> bit) & 1u) == 0u) {
        return NONE;
    }
    var kept_count = 0u;
    for (var i = 0u; i < summary_words; i++) {
        kept_count += countOneBits(tree[begin + i]);
    }
    return half_word(first_kept + kept_count, kept) + bits_below(bits, bit);
}

// A reader that remembers the last node of bricks, by the coordinates it was found at. What is above is looked up again: that is
// seldom, and its path would take registers.
struct Accessor { key4: vec3<i32>, node4: u32 }

fn new_accessor() -> Accessor {
    return Accessor(vec3<i32>(0), NONE);
}

fn is_before(a: vec3<i32>, b: vec3<i32>) -> bool {
    if (a.x != b.x) { return a.x < b.x; }
    if (a.y != b.y) { return a.y < b.y; }
    return a.z < b.z;
}

fn cell_at(index: u32) -> vec3<i32> {
    let at = tree[CELLS] + CELL_WORDS * index;
    return vec3<i32>(bitcast<i32>(tree[at]), bitcast<i32>(tree[at + 1u]), bitcast<i32>(tree[at + 2u]));
}

// The entry of a cell among the root cells of a field's tree.
fn root_entry(field: u32, cell: vec3<i32>) -> Entry {
    let first = fields[field].base_brick.w;
    var low = 0;
    var high = fields[field].box_first.w;
    while (low < high) {
        let middle = (low + high) / 2;
        if (is_before(cell_at(u32(first + middle)), cell)) { low = middle + 1; } else { high = middle; }
    }
    if (low >= fields[field].box_first.w || any(cell_at(u32(first + low)) != cell)) {
        return Entry(0u, ABSENT_TAG);
    }
    let at = tree[CELLS] + CELL_WORDS * u32(first + low);
    return Entry(tree[at + 3u], tree[at + 4u]);
}

fn node_entry(nodes: u32, node: u32, summary_words: u32, slot: u32) -> Entry {
    let at = rank(word_at(nodes, 2u * node), summary_words, slot);
    if (at == NONE) {
        return Entry(0u, ABSENT_TAG);
    }
    return entry_at(word_at(nodes, 2u * node + 1u) + at);
}

fn node4_slot(brick: vec3<i32>) -> u32 {
    let local = vec3<u32>(brick & vec3<i32>(15));
    return (local.x << 8u) | (local.y << 4u) | local.z;
}

fn node5_slot(brick: vec3<i32>) -> u32 {
    let local = vec3<u32>((brick >> vec3<u32>(LOG2_NODE4_BRICKS)) & vec3<i32>(31));
    return (local.x << 10u) | (local.y << 5u) | local.z;
}

// The region around a brick by the field's map: nuage_gpu::maps.
fn mapped_region(field: u32, brick: vec3<i32>) -> Region {
    let box_first = fields[field].box_first.xyz;
    let local = vec3<u32>(brick - box_first + 1);
    let size = vec3<u32>(fields[field].box_last.xyz - box_first + 3);
    if (any(local >= size)) {
        return Region(0u, 0, Entry(0u, ABSENT_TAG));
    }
    let at = u32(fields[field].box_last.w) + MAP_CELL_WORDS * ((local.x * size.y + local.y) * size.z + local.z);
    let kind = tree[at];
    let tag = kind & 0xffu;
    if (tag == ABSENT_TAG) {
        return Region(0u, max(i32(kind >> 8u), 1) - 1, Entry(0u, ABSENT_TAG));
    }
    let is_node4 = tag == NODE4_TILE_TAG;
    let is_node5 = tag == NODE5_TILE_TAG;
    let log2_bricks = select(select(0u, LOG2_NODE5_BRICKS, is_node5), LOG2_NODE4_BRICKS, is_node4);
    let shown = select(kind, (kind & ~0xffu) | CONSTANT_TAG, is_node4 || is_node5);
    return Region(log2_bricks, 0, Entry(tree[at + 1u], shown));
}

// The region around a brick.
fn region_at(field: u32, accessor: ptr<function, Accessor>, brick: vec3<i32>) -> Region {
    count_region();
    if (HAS_MAPS) {
        return mapped_region(field, brick);
    }
    let key4 = brick >> vec3<u32>(LOG2_NODE4_BRICKS);
    if ((*accessor).node4 == NONE || any((*accessor).key4 != key4)) {
        let root = root_entry(field, brick >> vec3<u32>(LOG2_NODE5_BRICKS));
        if (tag_of(root) != NODE_TAG) {
            return Region(LOG2_NODE5_BRICKS, 0, root);
        }
        let entry = node_entry(NODE5S, root.payload, NODE5_SUMMARY_WORDS, node5_slot(brick));
        if (tag_of(entry) != NODE_TAG) {
            return Region(LOG2_NODE4_BRICKS, 0, entry);
        }
        (*accessor).key4 = key4;
        (*accessor).node4 = entry.payload;
    }
    return Region(0u, 0, node_entry(NODE4S, (*accessor).node4, NODE4_SUMMARY_WORDS, node4_slot(brick)));
}

// A value as it is stored, as the field means it.
fn meant(field: u32, stored: f32) -> f32 {
    let value = fields[field].value;
    return clamp(value.y + value.x * stored, 0.0, value.z);
}

fn bound(code: u32) -> f32 {
    let magnitude = code & (BOUND_SIGN - 1u);
    let value = select(bitcast<f32>((magnitude + BOUND_EXPONENT_OFFSET) << BOUND_DROPPED_BITS), 0.0, magnitude == 0u);
    return select(value, -value, (code & BOUND_SIGN) != 0u);
}

// Bounds of trilinear samples whose lower corner lies in a region around a brick, smallest and largest.
fn footprint(field: u32, brick: vec3<i32>, region: Region) -> vec2<f32> {
    if (tag_of(region.entry) == ABSENT_TAG) {
        return vec2<f32>(0.0);
    }
    let code = region.entry.kind >> 8u;
    let unit = fields[field].bounds_min.w;
    let a = meant(field, bound(code & 0xfffu) * unit);
    let b = meant(field, bound(code >> 12u) * unit);
    // What is outside of the active box is 0, whatever is stored.
    let first = (brick & vec3<i32>(-1 << region.log2_bricks)) << vec3<u32>(LOG2_BRICK);
    let last = first + (1 << (region.log2_bricks + LOG2_BRICK));
    let is_inside = all(first >= fields[field].active_min.xyz) && all(last <= fields[field].active_max.xyz);
    return vec2<f32>(select(0.0, min(a, b), is_inside), max(a, b));
}
