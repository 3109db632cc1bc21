// The voxels of one brick, with all that they share read once.

// What the stored values of a field mean: the unit of half floats, the smallest value, and scale, bias and the largest.
struct Values { unit: f32, smallest: f32, meaning: vec3<f32> }

fn values_of(field: u32) -> Values {
    return Values(fields[field].origin.w, fields[field].bounds_max.w, fields[field].value.xyz);
}

struct Brick { tag: u32, at: u32, is_f32: bool, line: Line }

fn brick_of(values: Values, entry: Entry) -> Brick {
    var line = Line(0.0, 0.0);
    if (HAS_UNIFORM && tag_of(entry) <= LAST_UNIFORM_TAG) {
        line = line_of(brick_word(entry.payload), values.unit);
    }
    return Brick(tag_of(entry), entry.payload, tag_of(entry) == F32_TAG, line);
}

// The value of the voxel of a number, as the field means it. Not only bricks have values, but parts of a tile too.
fn brick_value(field: u32, values: Values, brick: Brick, voxel: u32) -> f32 {
    count_value();
    let at = brick.at;
    var stored = bitcast<f32>(at);
    if (HAS_F32) {
        // Read in any case, which is less than a branch: beyond the bricks there is some word as well.
        stored = select(stored, bitcast<f32>(brick_word(at + voxel)), brick.is_f32);
    }
    if (HAS_F16 && brick.tag == F16_TAG) {
        stored = half_value((brick_word(at + (voxel >> 1u)) >> ((voxel & 1u) * 16u)) & 0xffffu) * values.unit;
    } else if (HAS_UNIFORM && brick.tag <= LAST_UNIFORM_TAG && brick.tag != CONSTANT_TAG) {
        let bit = voxel * brick.tag;
        let word = at + 1u + (bit >> 5u);
        var bits = brick_word(word) >> (bit & 31u);
        if (HAS_UNEVEN && (bit & 31u) + brick.tag > 32u) {
            bits |= brick_word(word + 1u) << (32u - (bit & 31u));
        }
        stored = line_at(brick.line, bits & ((1u << brick.tag) - 1u));
    } else if (HAS_OTHER_CODECS && brick.tag != CONSTANT_TAG && brick.tag < NODE4_TILE_TAG) {
        stored = stored_value(field, Entry(at, brick.tag), vec3<u32>(voxel >> 6u, (voxel >> 3u) & 7u, voxel & 7u));
    }
    if (ARE_DENSITIES && ARE_FLOATS) {
        return stored;
    }
    if (ARE_DENSITIES) {
        return max(stored, values.smallest);
    }
    return clamp(values.meaning.y + values.meaning.x * max(stored, values.smallest), 0.0, values.meaning.z);
}
