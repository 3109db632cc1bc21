// The value of one voxel of an encoded brick: nuage_volume::codec, whose formulas these are.

// A half float, also a subnormal one, exactly.
fn half_value(bits: u32) -> f32 {
    let exponent = (bits >> 10u) & 31u;
    let normal = bitcast<f32>(((bits & 0x7fffu) << 13u) + (112u << 23u));
    let magnitude = select(normal, f32(bits & 0x3ffu) * HALF_SUBNORMAL_STEP, exponent == 0u);
    return select(magnitude, -magnitude, (bits & 0x8000u) != 0u);
}

struct Line { low: f32, step: f32 }

fn line_of(word: u32, unit: f32) -> Line {
    return Line(half_value(word & 0xffffu) * unit, half_value(word >> 16u) * unit);
}

fn line_at(line: Line, code: u32) -> f32 {
    return line.low + line.step * f32(code);
}

fn mix_(a: f32, b: f32, t: f32) -> f32 {
    return a + (b - a) * t;
}

// Some bits of the words from one on.
fn bits_at(first_word: u32, bit: u32, count: u32) -> u32 {
    let at = first_word + (bit >> 5u);
    let shift = bit & 31u;
    var bits = brick_word(at) >> shift;
    if (shift + count > 32u) {
        bits |= brick_word(at + 1u) << (32u - shift);
    }
    return bits & ((1u << count) - 1u);
}

fn byte_at(first_word: u32, i: u32) -> u32 {
    return (brick_word(first_word + (i >> 2u)) >> ((i & 3u) * 8u)) & 0xffu;
}

// What a code adds to what is predicted of a voxel: its line stands in a word, and all codes behind. Without bits there is none.
fn rest_value(at: u32, unit: f32, bits: u32, voxel: u32) -> f32 {
    if (bits == 0u) {
        return 0.0;
    }
    return line_at(line_of(brick_word(at), unit), bits_at(at + 1u, voxel * bits, bits));
}

// The interpolation of corners, whose line and codes stand in three words.
fn corners_value(at: u32, unit: f32, p: vec3<u32>) -> f32 {
    let line = line_of(brick_word(at), unit);
    let t = vec3<f32>(p) / 7.0;
    var edge: array<f32, 4>;
    for (var i = 0u; i < 4u; i++) {
        edge[i] = mix_(line_at(line, byte_at(at + 1u, i)), line_at(line, byte_at(at + 1u, 4u + i)), t.x);
    }
    return mix_(mix_(edge[0], edge[2], t.y), mix_(edge[1], edge[3], t.y), t.z);
}

// The interpolation of a lattice, whose line and codes stand in seventeen words.
fn lattice_value(at: u32, unit: f32, p: vec3<u32>) -> f32 {
    let line = line_of(brick_word(at), unit);
    let cell = min(vec3<u32>(2u), p * 3u / 7u);
    let t = vec3<f32>(p * 3u - cell * 7u) / 7.0;
    let first = 16u * cell.x + 4u * cell.y + cell.z;
    var across: array<f32, 4>;
    for (var i = 0u; i < 4u; i++) {
        let point = first + 4u * (i >> 1u) + (i & 1u);
        across[i] = mix_(line_at(line, byte_at(at + 1u, point)), line_at(line, byte_at(at + 1u, point + 16u)), t.x);
    }
    return mix_(mix_(across[0], across[2], t.y), mix_(across[1], across[3], t.y), t.z);
}

fn split_value(at: u32, unit: f32, bits: u32, voxel: u32) -> f32 {
    let line = line_of(brick_word(at), unit);
    let octant = ((voxel >> 6u) & 4u) | ((voxel >> 4u) & 2u) | ((voxel >> 2u) & 1u);
    let both = brick_word(at + 1u + (octant >> 1u)) >> ((octant & 1u) * 16u);
    let low = line_at(line, both & 0xffu);
    let high = line_at(line, (both >> 8u) & 0xffu);
    let step = (high - low) / f32((1u << bits) - 1u);
    return low + step * f32(bits_at(at + 5u, voxel * bits, bits));
}

// What the code of a voxel of a sparse brick begins with, and where: nuage_volume::codec::sparse.
fn sparse_value(brick_at: u32, unit: f32, is_fitted: bool, p: vec3<u32>) -> f32 {
    let line = line_of(brick_word(brick_at), unit);
    let coding = brick_word(brick_at + 1u);
    let has_ends = (coding & SPARSE_HAS_ENDS) != 0u;
    let is_bent = (coding & SPARSE_BENT) != 0u;
    let most_bits = coding & 7u;
    let ends_at = brick_at + 2u;
    let corners_at = ends_at + select(0u, 2u, has_ends);
    let sets_at = corners_at + select(0u, 3u, is_fitted);
    let some = vec2<u32>(brick_word(sets_at), brick_word(sets_at + 1u));
    let all_ = vec2<u32>(brick_word(sets_at + 2u), brick_word(sets_at + 3u));
    let mixed = some & ~all_;
    let masks_at = sets_at + 4u;
    let mixed_count = countOneBits(mixed.x) + countOneBits(mixed.y);
    let codes_at = masks_at + ((mixed_count + 3u) >> 2u);

    let octant = ((p.x >> 2u) << 2u) | ((p.y >> 2u) << 1u) | (p.z >> 2u);
    let of_octant = (((p.x >> 1u) & 1u) << 2u) | (((p.y >> 1u) & 1u) << 1u) | ((p.z >> 1u) & 1u);
    let voxel = ((p.x & 1u) << 2u) | ((p.y & 1u) << 1u) | (p.z & 1u);
    // The bits of all codes before those of the voxel's block, and the masks.
    var bit = 0u;
    var mask_number = 0u;
    var own_bits = most_bits;
    for (var o = 0u; o <= octant; o++) {
        let shift = (o & 3u) * 8u;
        let blocks = select(0xffu, (1u << of_octant) - 1u, o == octant);
        let full = (select(all_.x, all_.y, o > 3u) >> shift) & blocks;
        let partly = countOneBits((select(mixed.x, mixed.y, o > 3u) >> shift) & blocks);
        var voxels = 8u * countOneBits(full);
        for (var i = 0u; i < partly; i++) {
            voxels += countOneBits(byte_at(masks_at, mask_number + i));
        }
        own_bits = most_bits - ((coding >> (8u + 3u * o)) & 7u);
        bit += voxels * own_bits;
        mask_number += partly;
    }
    let block_bit = ((octant & 3u) << 3u) | of_octant;
    var mask = 0u;
    if (((select(all_.x, all_.y, octant > 3u) >> block_bit) & 1u) != 0u) {
        mask = 0xffu;
    } else if (((select(some.x, some.y, octant > 3u) >> block_bit) & 1u) != 0u) {
        mask = byte_at(masks_at, mask_number);
    }
    if (((mask >> voxel) & 1u) == 0u) {
        return 0.0;
    }
    let code = bits_at(codes_at, bit + own_bits * bits_below(mask, voxel), own_bits);
    var predicted = 0.0;
    if (is_fitted) {
        predicted = corners_value(corners_at, unit, p);
    }
    let is_even = (coding >> 8u) == 0u && !has_ends;
    if (is_even && !is_bent) {
        return predicted + line_at(line, code);
    }
    let part = f32(code) / f32((1u << own_bits) - 1u);
    let bent = select(part, part * (SPARSE_BENT_START + SPARSE_BENT_GROWTH * part), is_bent);
    var ends = vec2<f32>(0.0, 1.0);
    if (has_ends) {
        let both = byte_at(ends_at, octant);
        ends = vec2<f32>(f32(both & 15u), f32(both >> 4u)) / SPARSE_LAST_END;
    }
    let place = (ends.x + (ends.y - ends.x) * bent) * f32((1u << most_bits) - 1u);
    return predicted + (line.low + line.step * place);
}

// The value of a voxel of the brick of a tag at an offset, but for a brick that shares a shape.
fn plain_value(tag: u32, at: u32, unit: f32, p: vec3<u32>) -> f32 {
    let voxel = (p.x << 6u) | (p.y << 3u) | p.z;
    if (HAS_F32 && tag == F32_TAG) {
        return bitcast<f32>(brick_word(at + voxel));
    }
    if (HAS_F16 && tag == F16_TAG) {
        return half_value((brick_word(at + (voxel >> 1u)) >> ((voxel & 1u) * 16u)) & 0xffffu) * unit;
    }
    if (HAS_UNIFORM && tag <= LAST_UNIFORM_TAG) {
        return line_at(line_of(brick_word(at), unit), bits_at(at + 1u, voxel * tag, tag));
    }
    if (HAS_SPARSE && tag >= FIRST_SPARSE_TAG) {
        return sparse_value(at, unit, tag >= FIRST_FITTED_TAG, p);
    }
    if (HAS_SPLIT && tag >= FIRST_SPLIT_TAG) {
        return split_value(at, unit, tag + 1u - FIRST_SPLIT_TAG, voxel);
    }
    if (HAS_BLOCK && tag >= FIRST_BLOCK_TAG) {
        let line = line_of(brick_word(at), unit);
        let kind = tag - FIRST_BLOCK_TAG;
        if (HAS_TEXTURES) {
            return line.low + line.step * texture_value(kind, brick_word(at + 1u), p);
        }
        return line.low + line.step * block_value(kind, at + 1u, p);
    }
    if (HAS_LATTICE && tag >= FIRST_LATTICE_TAG) {
        return lattice_value(at, unit, p) + rest_value(at + 17u, unit, tag - FIRST_LATTICE_TAG, voxel);
    }
    if (HAS_GRADIENT && tag >= FIRST_GRADIENT_TAG) {
        return corners_value(at, unit, p) + rest_value(at + 3u, unit, tag - FIRST_GRADIENT_TAG, voxel);
    }
    return 0.0;
}

// The value of voxel `p` of a brick as it is stored.
fn stored_value(field: u32, entry: Entry, p: vec3<u32>) -> f32 {
    let unit = fields[field].origin.w;
    let tag = tag_of(entry);
    var value: f32;
    if (HAS_SHARED && tag == SHARED_TAG) {
        let line = line_of(brick_word(entry.payload), unit);
        let shape_at = tree[SHAPES] + brick_word(entry.payload + 1u);
        value = line.low + line.step * plain_value(brick_word(entry.payload + 2u), shape_at, 1.0, p);
    } else {
        value = plain_value(tag, entry.payload, unit, p);
    }
    return max(value, fields[field].bounds_max.w);
}
