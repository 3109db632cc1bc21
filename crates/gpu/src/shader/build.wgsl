// A tree from a dense array of values, in five steps that each need the one before: nuage_volume::build and
// nuage_volume::packed::build, all places at once. Order comes from sums of what stands before, never from who was first,
// so that the same values give the same words.
//
// Values are kept as the bits of floats that are not negative, whose order is that of the floats. No device rounds those.

// As `crate::build::Params`.
struct Build {
    // Voxels along each axis, and what values mean.
    size: vec4<u32>,
    // How many values apart neighbours stand, and the most bricks.
    strides: vec4<u32>,
    // Bricks along each axis, and the first brick of this channel.
    bricks: vec4<u32>,
    // Nodes along each axis, and the number of the channel.
    nodes: vec4<u32>,
    // The first node, the first entry and the first word of masks of this channel, and a level set's band.
    first: vec4<u32>,
    // Cells of the map along each axis, and its first word.
    map: vec4<u32>,
}

@group(0) @binding(0) var<uniform> build: Build;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> scratch: array<u32>;
@group(0) @binding(3) var<storage, read_write> tree: array<u32>;
@group(0) @binding(4) var<storage, read_write> fields: array<u32>;

// What stands in `scratch`: counts, then what is known of nodes, the brick numbers, the bounds of bricks, and distances in the map.

// Entries, bricks, footprint, largest value, whether there is a value above 0; then the first entry and the first brick; then
// a word for each row of slots, which of them have an entry below and which of these are bricks above.
fn node_info(node: u32) -> u32 {
    return COUNT_WORDS + node * NODE_INFO_WORDS;
}

fn node_count() -> u32 {
    return build.nodes.x * build.nodes.y * build.nodes.z;
}

fn brick_index(brick: vec3<u32>) -> u32 {
    return (brick.x * build.bricks.y + brick.y) * build.bricks.z + brick.z;
}

fn number_of(brick: vec3<u32>) -> u32 {
    return node_info(node_count()) + brick_index(brick);
}

fn summary_of(brick: vec3<u32>) -> u32 {
    return node_info(node_count()) + build.bricks.x * build.bricks.y * build.bricks.z + 16u * brick_index(brick);
}

// The bits of the value of a voxel, 0 outside of the array.
fn value_at(voxel: vec3<u32>) -> u32 {
    if (any(voxel >= build.size.xyz)) {
        return 0u;
    }
    let at = voxel * build.strides.xyz;
    return density(values[at.x + at.y + at.z], build.size.w, build.first.w);
}

fn hull(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    return vec2<u32>(min(a.x, b.x), max(a.y, b.y));
}

// Of each lane of `summarise`, the bounds of its voxels: all, those at the low end of z, of x, and of both.
var<workgroup> layers: array<array<vec2<u32>, 4>, 8u * GROUP_BRICKS>;

// The brick of a lane of a workgroup that takes some along z: eight lanes a brick, each the layer of a y.
fn brick_of_lane(group: vec3<u32>, lane: vec3<u32>) -> vec3<u32> {
    return vec3<u32>(group.xy, GROUP_BRICKS * group.z + lane.y);
}

// The bounds of each brick, and of its voxels at the low end of some axes.
@compute @workgroup_size(8, GROUP_BRICKS)
fn summarise(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) lane: vec3<u32>) {
    let brick = brick_of_lane(group, lane);
    let corner = 8u * brick + vec3<u32>(0u, lane.x, 0u);
    var all = vec2<u32>(NONE, 0u);
    var low_z = all;
    for (var x = 0u; x < 8u; x++) {
        let first = value_at(corner + vec3<u32>(x, 0u, 0u));
        var row = vec2<u32>(first);
        for (var z = 1u; z < 8u; z++) {
            row = hull(row, vec2<u32>(value_at(corner + vec3<u32>(x, 0u, z))));
        }
        all = hull(all, row);
        low_z = hull(low_z, vec2<u32>(first));
        if (x == 0u) {
            layers[8u * lane.y + lane.x][2] = row;
            layers[8u * lane.y + lane.x][3] = vec2<u32>(first);
        }
    }
    layers[8u * lane.y + lane.x][0] = all;
    layers[8u * lane.y + lane.x][1] = low_z;
    workgroupBarrier();
    // Now a lane for each set of axes.
    let axes = lane.x;
    let which = ((axes >> 1u) & 2u) | (axes & 1u);
    let end = select(8u, 1u, (axes & 2u) != 0u);
    var found = vec2<u32>(NONE, 0u);
    for (var y = 0u; y < end; y++) {
        found = hull(found, layers[8u * lane.y + y][which]);
    }
    if (brick.z < build.bricks.z) {
        let at = summary_of(brick) + 2u * axes;
        scratch[at] = found.x;
        scratch[at + 1u] = found.y;
    }
}

// Bounds of the voxels of a brick of the tree at the low end of some axes. The array begins one brick behind the tree's first,
// so that all that touches it is in the same `Node5`.
fn low_bounds(brick: vec3<u32>, axes: u32) -> vec2<u32> {
    if (any(brick == vec3<u32>(0u)) || any(brick > build.bricks.xyz)) {
        return vec2<u32>(0u);
    }
    let at = summary_of(brick - 1u) + 2u * axes;
    return vec2<u32>(scratch[at], scratch[at + 1u]);
}

// Bounds of the voxels of a brick, and of its trilinear footprint.
struct Leaf { own: vec2<u32>, footprint: vec2<u32> }

fn leaf_at(brick: vec3<u32>) -> Leaf {
    let own = low_bounds(brick, 0u);
    var footprint = own;
    for (var axes = 1u; axes < 8u; axes++) {
        let found = low_bounds(brick + vec3<u32>(axes >> 2u, (axes >> 1u) & 1u, axes & 1u), axes);
        footprint = vec2<u32>(min(footprint.x, found.x), max(footprint.y, found.y));
    }
    return Leaf(own, footprint);
}

// The slots of a mask, 32 to a word, and what its halves are gathered in.
var<workgroup> slots: array<atomic<u32>, NODE5_MASK_WORDS>;
var<workgroup> kept_before: array<u32, NODE5_SUMMARY_WORDS>;
var<workgroup> set_before: array<u32, NODE5_MASK_WORDS>;
var<workgroup> sums: array<vec4<u32>, LANES>;

// What the lanes before this one have in all. The last of `sums` is the sum of all lanes.
fn sums_before(lane: u32, own: vec4<u32>) -> vec4<u32> {
    workgroupBarrier();
    sums[lane] = own;
    for (var step = 1u; step < LANES; step <<= 1u) {
        workgroupBarrier();
        var further = vec4<u32>(0u);
        if (lane >= step) {
            further = sums[lane - step];
        }
        workgroupBarrier();
        sums[lane] += further;
    }
    workgroupBarrier();
    return sums[lane] - own;
}

fn clear_slots(lane: u32) {
    for (var word = lane; word < NODE5_MASK_WORDS; word += LANES) {
        atomicStore(&slots[word], 0u);
    }
    workgroupBarrier();
}

// Writes the mask of `slots`: nuage_volume::packed::mask::encode.
fn encode(lane: u32, begin: u32, mask_words: u32) {
    let each = (mask_words + LANES - 1u) / LANES;
    let own_first = min(lane * each, mask_words);
    let own_end = min(own_first + each, mask_words);
    var own = vec4<u32>(0u);
    for (var word = own_first; word < own_end; word++) {
        let bits = atomicLoad(&slots[word]);
        own += vec4<u32>(u32(bits != 0u), countOneBits(bits), 0u, 0u);
    }
    var before = sums_before(lane, own);
    let kept = sums[LANES - 1u].x;
    let summary_words = mask_words >> 5u;
    let first_kept = begin + summary_words + ((summary_words + 1u) >> 1u);
    for (var word = own_first; word < own_end; word++) {
        if ((word & 31u) == 0u) {
            kept_before[word >> 5u] = before.x;
        }
        let bits = atomicLoad(&slots[word]);
        if (bits != 0u) {
            tree[first_kept + before.x] = bits;
            set_before[before.x] = before.y;
            before += vec4<u32>(1u, countOneBits(bits), 0u, 0u);
        }
    }
    workgroupBarrier();
    for (var i = lane; i < summary_words; i += LANES) {
        var summary = 0u;
        for (var bit = 0u; bit < 32u; bit++) {
            summary |= u32(atomicLoad(&slots[32u * i + bit]) != 0u) << bit;
        }
        tree[begin + i] = summary;
        if ((i & 1u) == 0u) {
            tree[begin + summary_words + (i >> 1u)] = kept_before[i] | (kept_before[i + 1u] << 16u);
        }
    }
    for (var i = 2u * lane; i < kept; i += 2u * LANES) {
        let second = select(0u, set_before[min(i + 1u, kept - 1u)], i + 1u < kept);
        tree[first_kept + kept + (i >> 1u)] = set_before[i] | (second << 16u);
    }
}

fn node4_mask(node: u32) -> u32 {
    return build.first.z + node * NODE4_MOST_WORDS;
}

// The first brick of a lane's row of slots in a `Node4`; along z they follow.
fn row_brick(node: vec3<u32>, lane: u32) -> vec3<u32> {
    return (node << vec3<u32>(LOG2_NODE4_BRICKS)) + vec3<u32>(lane >> 4u, lane & 15u, 0u);
}

var<workgroup> least: atomic<u32>;
var<workgroup> most: array<atomic<u32>, 2>;
var<workgroup> node_sums: array<atomic<u32>, 2>;

// What stands in each `Node4`: a workgroup a node, a lane for sixteen slots.
@compute @workgroup_size(LANES)
fn nodes(@builtin(workgroup_id) node: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let index = (node.x * build.nodes.y + node.y) * build.nodes.z + node.z;
    let info = node_info(index);
    if (lane == 0u) {
        atomicStore(&least, NONE);
        atomicStore(&most[0], 0u);
        atomicStore(&most[1], 0u);
        atomicStore(&node_sums[0], 0u);
        atomicStore(&node_sums[1], 0u);
    }
    clear_slots(lane);
    let brick = row_brick(node, lane);
    var present = 0u;
    var is_brick = 0u;
    for (var z = 0u; z < 16u; z++) {
        let leaf = leaf_at(brick + vec3<u32>(0u, 0u, z));
        // Also what is zero itself but touches something else has an entry.
        present |= u32(leaf.footprint.y != 0u) << z;
        is_brick |= u32(leaf.own.x != leaf.own.y) << z;
        atomicMin(&least, leaf.footprint.x);
        atomicMax(&most[0], leaf.footprint.y);
        atomicMax(&most[1], leaf.own.y);
    }
    atomicAdd(&node_sums[0], countOneBits(present));
    atomicAdd(&node_sums[1], countOneBits(is_brick));
    atomicOr(&slots[lane >> 1u], present << (16u * (lane & 1u)));
    scratch[info + NODE_INFO_ROWS + lane] = present | (is_brick << 16u);
    workgroupBarrier();
    encode(lane, tree[MASKS] + node4_mask(index), NODE4_MASK_WORDS);
    if (lane == 0u) {
        scratch[info] = atomicLoad(&node_sums[0]);
        scratch[info + 1u] = atomicLoad(&node_sums[1]);
        scratch[info + 2u] = atomicLoad(&least);
        scratch[info + 3u] = atomicLoad(&most[0]);
        scratch[info + 4u] = atomicLoad(&most[1]);
    }
}

// A bound's magnitude in a unit that is a power of two: nuage_volume::codec::bounds.
fn magnitude(bits: u32, unit: u32, up: bool) -> u32 {
    let smallest = u32(up && bits != 0u);
    let scaled = i32(bits) - ((i32(unit >> 23u) - 127) << 23u);
    // What would be subnormal is less than the smallest bound.
    if (scaled < (1 << 23u)) {
        return smallest;
    }
    let is_between = (u32(scaled) & ((1u << BOUND_DROPPED_BITS) - 1u)) != 0u;
    let kept = (u32(scaled) >> BOUND_DROPPED_BITS) + u32(up && is_between);
    return clamp(max(kept, BOUND_EXPONENT_OFFSET) - BOUND_EXPONENT_OFFSET, smallest, BOUND_SIGN - 1u);
}

fn pack(bounds: vec2<u32>, unit: u32) -> u32 {
    return magnitude(bounds.x, unit, false) | (magnitude(bounds.y, unit, true) << 12u);
}

// The smallest power of two that is not less than a value; 1 for 0: crate::arrays.
fn power_of_two_above(bits: u32) -> u32 {
    if (bits == 0u) {
        return ONE;
    }
    let is_exact = (bits & 0x7fffffu) == 0u;
    return min((bits >> 23u) + u32(!is_exact), 254u) << 23u;
}

// The tag and the bounds of an entry.
fn kind_of(tag: u32, footprint: vec2<u32>, unit: u32) -> u32 {
    return tag | (pack(footprint, unit) << 8u);
}

fn write_entry(index: u32, payload: u32, kind: u32) {
    let at = tree[ENTRIES] + 2u * index;
    tree[at] = payload;
    tree[at + 1u] = kind;
}

// The `Node5` with its entries, and where what is below each `Node4` begins: one workgroup, whose lanes each take as many
// nodes as need be, in order.
@compute @workgroup_size(LANES)
fn root(@builtin(local_invocation_index) lane: u32) {
    if (lane == 0u) {
        atomicStore(&most[0], 0u);
        atomicStore(&most[1], 0u);
    }
    clear_slots(lane);
    let each = (node_count() + LANES - 1u) / LANES;
    let own_first = min(lane * each, node_count());
    let own_end = min(own_first + each, node_count());
    // Entries of nodes, bricks, nodes, entries of the `Node5`.
    var own = vec4<u32>(0u);
    for (var node = own_first; node < own_end; node++) {
        let info = node_info(node);
        let is_there = scratch[info + 4u] != 0u;
        own += vec4<u32>(
            select(0u, scratch[info], is_there), scratch[info + 1u], u32(is_there), u32(scratch[info + 3u] != 0u),
        );
        atomicMax(&most[0], scratch[info + 3u]);
        atomicMax(&most[1], scratch[info + 4u]);
    }
    var before = sums_before(lane, own);
    let total = sums[LANES - 1u];
    let unit = power_of_two_above(atomicLoad(&most[1]));
    let first_entry = build.first.y + total.x;
    for (var node = own_first; node < own_end; node++) {
        let info = node_info(node);
        if (scratch[info + 3u] == 0u) {
            continue;
        }
        let footprint = vec2<u32>(scratch[info + 2u], scratch[info + 3u]);
        let is_there = scratch[info + 4u] != 0u;
        let index = build.first.x + before.z;
        // A place without a value that touches some is a tile of zeros.
        let tag = select(CONSTANT_TAG, NODE_TAG, is_there);
        write_entry(first_entry + before.w, select(0u, index, is_there), kind_of(tag, footprint, unit));
        let place = vec3<u32>(
            node / (build.nodes.y * build.nodes.z), node / build.nodes.z % build.nodes.y, node % build.nodes.z,
        );
        let slot = (place.x << 10u) | (place.y << 5u) | place.z;
        atomicOr(&slots[slot >> 5u], 1u << (slot & 31u));
        if (is_there) {
            let at = tree[NODE4S] + 2u * index;
            tree[at] = node4_mask(node);
            tree[at + 1u] = build.first.y + before.x;
            scratch[info + 5u] = build.first.y + before.x;
            scratch[info + 6u] = build.bricks.w + before.y;
            before += vec4<u32>(scratch[info], scratch[info + 1u], 1u, 0u);
        }
        before.w += 1u;
    }
    workgroupBarrier();
    let mask = node4_mask(node_count());
    encode(lane, tree[MASKS] + mask, NODE5_MASK_WORDS);
    if (lane != 0u) {
        return;
    }
    let channel = build.nodes.w;
    let node5 = tree[NODE5S] + 2u * channel;
    tree[node5] = mask;
    tree[node5 + 1u] = first_entry;
    // The cell at the origin. Its first bricks are never filled, so that 0 is among its values.
    let cell = tree[CELLS] + CELL_WORDS * channel;
    tree[cell] = 0u;
    tree[cell + 1u] = 0u;
    tree[cell + 2u] = 0u;
    tree[cell + 3u] = channel;
    tree[cell + 4u] = kind_of(NODE_TAG, vec2<u32>(0u, atomicLoad(&most[0])), unit);
    // What does not fit is not there at all.
    let is_shown = total.z != 0u && total.y <= build.strides.w;
    fields[channel * FIELD_WORDS + FIELD_BOUNDS_UNIT] = unit;
    fields[channel * FIELD_WORDS + FIELD_CELL_COUNT] = u32(is_shown);
    scratch[0] = total.y;
    scratch[1] = atomicLoad(&most[1]);
}

// The entries of each `Node4`, and the cells of the map that they stand in: a workgroup a node, a lane for sixteen slots.
@compute @workgroup_size(LANES)
fn entries(@builtin(workgroup_id) node: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let info = node_info((node.x * build.nodes.y + node.y) * build.nodes.z + node.z);
    let own_field = build.nodes.w * FIELD_WORDS;
    let is_shown = fields[own_field + FIELD_CELL_COUNT] != 0u;
    let unit = fields[own_field + FIELD_BOUNDS_UNIT];
    let is_there = is_shown && scratch[info + 4u] != 0u;
    let row = select(0u, scratch[info + NODE_INFO_ROWS + lane], is_there);
    let present = row & 0xffffu;
    let is_brick = row >> 16u;
    let before = sums_before(lane, vec4<u32>(countOneBits(present), countOneBits(is_brick), 0u, 0u));
    var entry = scratch[info + 5u] + before.x;
    var number = scratch[info + 6u] + before.y;
    // What is in the map where a slot has no entry: nothing, or the tile around it.
    var around = ABSENT_TAG | (FURTHEST << 8u);
    if (is_shown && !is_there && scratch[info + 3u] != 0u) {
        around = kind_of(NODE4_TILE_TAG, vec2<u32>(scratch[info + 2u], scratch[info + 3u]), unit);
    }
    for (var z = 0u; z < 16u; z++) {
        let brick = row_brick(node, lane) + vec3<u32>(0u, 0u, z);
        if (((present >> z) & 1u) == 0u) {
            write_cell(brick, 0u, around);
            continue;
        }
        let leaf = leaf_at(brick);
        var payload = leaf.own.x;
        var tag = CONSTANT_TAG;
        if (((is_brick >> z) & 1u) != 0u) {
            payload = number * BRICK_VOXELS;
            tag = F32_TAG;
            scratch[number_of(brick - 1u)] = number;
            number++;
        }
        let kind = kind_of(tag, leaf.footprint, unit);
        write_entry(entry, payload, kind);
        write_cell(brick, payload, kind);
        entry++;
    }
}

// The values of each brick.
@compute @workgroup_size(8, GROUP_BRICKS)
fn bricks(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) lane: vec3<u32>) {
    let brick = brick_of_lane(group, lane);
    let own = low_bounds(brick + 1u, 0u);
    if (brick.z >= build.bricks.z || own.x == own.y) {
        return;
    }
    let number = scratch[number_of(brick)];
    if (number - build.bricks.w >= build.strides.w) {
        return;
    }
    let at = number * BRICK_VOXELS + (lane.x << 3u);
    for (var x = 0u; x < 8u; x++) {
        for (var z = 0u; z < 8u; z++) {
            set_brick_word(at + (x << 6u) + z, value_at(8u * brick + vec3<u32>(x, lane.x, z)));
        }
    }
}
