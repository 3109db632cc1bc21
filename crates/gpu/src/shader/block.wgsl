// One voxel of a brick of texture blocks: nuage_volume::codec::block.

// Entry of the palette of a BC4 block, which stands in two words: nuage_volume::codec::block::bc4.
fn bc4_texel(at: u32, texel: u32) -> f32 {
    let a = byte_at(at, 0u);
    let b = byte_at(at, 1u);
    let index = bits_at(at, 16u + 3u * texel, 3u);
    let last = select(5u, 7u, a > b);
    if (index < 2u) {
        return f32(select(b, a, index == 0u) * last) / f32(255u * last);
    }
    if (a <= b && index >= 6u) {
        return f32(index - 6u);
    }
    let to_b = index - 1u;
    return f32(a * (last - to_b) + b * to_b) / f32(255u * last);
}

fn bc3_texel(at: u32, texel: u32, channel: u32) -> f32 {
    if (channel == 3u) {
        return bc4_texel(at, texel);
    }
    let both = brick_word(at + 2u);
    let first_bit = select(select(0u, 5u, channel == 1u), 11u, channel == 0u);
    let bits = select(5u, 6u, channel == 1u);
    let mask = (1u << bits) - 1u;
    let stored = vec2<u32>((both >> first_bit) & mask, (both >> (16u + first_bit)) & mask);
    let ends = (stored << vec2<u32>(8u - bits)) | (stored >> vec2<u32>(2u * bits - 8u));
    let index = (brick_word(at + 3u) >> (2u * texel)) & 3u;
    let of_b = select(select(index - 1u, 0u, index == 0u), 3u, index == 1u);
    return f32((3u - of_b) * ends.x + of_b * ends.y) / f32(255u * 3u);
}

// Some bits of a block of four words; none are no bits.
fn block_bits(at: u32, bit: u32, count: u32) -> u32 {
    if (count == 0u) {
        return 0u;
    }
    return bits_at(at, bit, count);
}

struct Bc7Mode {
    subsets: u32, partition_bits: u32, rotation: u32, selection: u32, colour: u32, alpha: u32,
    endpoint_low: u32, shared_low: u32, index: u32, second_index: u32,
}

fn bc7_mode(number: u32) -> Bc7Mode {
    let at = BC7_MODES + 10u * number;
    return Bc7Mode(
        tables[at], tables[at + 1u], tables[at + 2u], tables[at + 3u], tables[at + 4u], tables[at + 5u],
        tables[at + 6u], tables[at + 7u], tables[at + 8u], tables[at + 9u],
    );
}

fn bc7_weight(at: u32, first_bit: u32, bits: u32, anchors: u32, texel: u32) -> u32 {
    let shorter_before = bits_below(anchors, texel);
    let length = bits - ((anchors >> texel) & 1u);
    let index = block_bits(at, first_bit + bits * texel - shorter_before, length);
    return tables[BC7_WEIGHTS + (1u << bits) + index];
}

fn bc7_texel(at: u32, texel: u32, channel_asked: u32) -> f32 {
    let number = countTrailingZeros(brick_word(at));
    if (number > 7u) {
        return 0.0;
    }
    let mode = bc7_mode(number);
    var bit = number + 1u;
    let partition_number = block_bits(at, bit, mode.partition_bits);
    bit += mode.partition_bits;
    let rotation = block_bits(at, bit, mode.rotation);
    bit += mode.rotation;
    let is_exchanged = block_bits(at, bit, mode.selection) == 1u;
    bit += mode.selection;

    var subset = 0u;
    var anchors = 1u;
    if (mode.subsets == 2u) {
        subset = (tables[BC7_TWO_SUBSETS + partition_number] >> texel) & 1u;
        anchors = 1u | (1u << tables[BC7_TWO_ANCHOR + partition_number]);
    } else if (mode.subsets == 3u) {
        subset = (tables[BC7_THREE_SUBSETS + partition_number] >> (2u * texel)) & 3u;
        anchors = 1u | (1u << tables[BC7_THREE_SECOND_ANCHOR + partition_number]) | (1u << tables[BC7_THREE_THIRD_ANCHOR + partition_number]);
    }
    subset = min(subset, 2u);
    // The channel that changes places with alpha.
    let swapped = select(rotation - 1u, 3u, rotation == 0u);
    var channel = channel_asked;
    if (channel == 3u) { channel = swapped; } else if (channel == swapped) { channel = 3u; }

    let ends_per_channel = 2u * mode.subsets;
    let alpha_at = bit + 3u * ends_per_channel * mode.colour;
    let low_at = alpha_at + ends_per_channel * mode.alpha;
    let indices_at = low_at + ends_per_channel * mode.endpoint_low + mode.subsets * mode.shared_low;
    let low_bits = mode.endpoint_low + mode.shared_low;
    var ends = array<u32, 2>(255u, 255u);
    if (channel < 3u || mode.alpha > 0u) {
        let count = select(mode.alpha, mode.colour, channel < 3u);
        let first = select(alpha_at, bit + channel * ends_per_channel * mode.colour, channel < 3u);
        for (var end = 0u; end < 2u; end++) {
            let stored = block_bits(at, first + (2u * subset + end) * count, count);
            let lowest = block_bits(at, low_at + subset * mode.shared_low, mode.shared_low)
                | block_bits(at, low_at + (2u * subset + end) * mode.endpoint_low, mode.endpoint_low);
            let value = (stored << low_bits) | lowest;
            let bits = count + low_bits;
            ends[end] = ((value << (8u - bits)) | (value >> (2u * bits - 8u))) & 0xffu;
        }
    }
    let is_second = mode.second_index > 0u && ((channel == 3u) != is_exchanged);
    var weight: u32;
    if (is_second) {
        weight = bc7_weight(at, indices_at + 16u * mode.index - 1u, mode.second_index, anchors, texel);
    } else {
        weight = bc7_weight(at, indices_at, mode.index, anchors, texel);
    }
    return f32((ends[0] * (64u - weight) + ends[1] * weight + 32u) >> 6u) / 255.0;
}

// A voxel as its place in slices and along the packing axis.
fn in_slices(kind: u32, p: vec3<u32>) -> vec3<u32> {
    switch (kind & 3u) {
        case 0u: { return p.yzx; }
        case 1u: { return p.xzy; }
        default: { return p; }
    }
}

// The value of a voxel of the brick of a number in the texture of its format: crate::blocks has where that lies.
fn texture_value(kind: u32, number: u32, p: vec3<u32>) -> f32 {
    let uvp = in_slices(kind, p);
    let format = kind >> 2u;
    let channels = select(4u, 1u, format == 0u);
    let log2_side = countTrailingZeros(blocks_width(format)) - LOG2_BRICK;
    let beside = (1u << log2_side) - 1u;
    let place = vec3<u32>(number & beside, (number >> log2_side) & beside, number >> (2u * log2_side));
    let first = (place << vec3<u32>(LOG2_BRICK)) / vec3<u32>(1u, 1u, channels);
    return block_texel(format, first + vec3<u32>(uvp.xy, uvp.z / channels))[uvp.z % channels];
}

// `kind` is the format times four, BC4, BC3 or BC7, plus the packing axis.
fn block_value(kind: u32, at: u32, p: vec3<u32>) -> f32 {
    let uvp = in_slices(kind, p);
    let format = kind >> 2u;
    let channels = select(4u, 1u, format == 0u);
    let block = ((uvp.z / channels) << 2u) | ((uvp.y >> 2u) << 1u) | (uvp.x >> 2u);
    let texel = ((uvp.y & 3u) << 2u) | (uvp.x & 3u);
    let channel = uvp.z % channels;
    switch (format) {
        case 0u: { return bc4_texel(at + 2u * block, texel); }
        case 1u: { return bc3_texel(at + 4u * block, texel, channel); }
        default: { return bc7_texel(at + 4u * block, texel, channel); }
    }
}
