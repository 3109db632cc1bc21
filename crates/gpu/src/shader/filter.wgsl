// What the voxels of a field say of the points between them: nuage_render::filter and `Field::sample`.
//
// Positions count voxels from the first voxel of the field's base brick.

fn in_region(field: u32, region: Region, index: vec3<i32>) -> f32 {
    count_value();
    let tag = tag_of(region.entry);
    if (tag == ABSENT_TAG) {
        return 0.0;
    }
    if (tag == CONSTANT_TAG) {
        return meant(field, bitcast<f32>(region.entry.payload));
    }
    return meant(field, stored_value(field, region.entry, vec3<u32>(index & vec3<i32>(7))));
}

fn is_active(field: u32, index: vec3<i32>) -> bool {
    return all(index >= fields[field].active_min.xyz) && all(index <= fields[field].active_max.xyz);
}

// The value of a voxel, 0 outside of the active box.
fn voxel_value(field: u32, accessor: ptr<function, Accessor>, index: vec3<i32>) -> f32 {
    if (!is_active(field, index)) {
        return 0.0;
    }
    return in_region(field, region_at(field, accessor, index >> vec3<u32>(LOG2_BRICK)), index);
}

// Axes as bits, in the order of the corners of a cell.
fn axes_of(axes: vec3<bool>) -> u32 {
    return select(0u, 4u, axes.x) | select(0u, 2u, axes.y) | select(0u, 1u, axes.z);
}

fn base_voxel(field: u32) -> vec3<i32> {
    return fields[field].base_brick.xyz << vec3<u32>(LOG2_BRICK);
}

fn lerp8(c: array<f32, 8>, f: vec3<f32>) -> f32 {
    let low = mix_(mix_(c[0], c[1], f.z), mix_(c[2], c[3], f.z), f.y);
    let high = mix_(mix_(c[4], c[5], f.z), mix_(c[6], c[7], f.z), f.y);
    return mix_(low, high, f.x);
}

// The eight values of the cell whose lower corner is a voxel, a bit of whose numbers each: corner 4 is the next along x. What a
// brick's voxels share is read once for each brick that the cell reaches.
fn corners_of(field: u32, accessor: ptr<function, Accessor>, cell: vec3<i32>) -> array<f32, 8> {
    var corners: array<f32, 8>;
    let values = values_of(field);
    let brick = cell >> vec3<u32>(LOG2_BRICK);
    // The offsets in a brick of both voxels along each axis.
    let low = vec3<u32>(cell & vec3<i32>(7)) << vec3<u32>(2u * LOG2_BRICK, LOG2_BRICK, 0u);
    let high = vec3<u32>((cell + 1) & vec3<i32>(7)) << vec3<u32>(2u * LOG2_BRICK, LOG2_BRICK, 0u);
    let reaching = axes_of(high < low);
    let is_low = (cell >= fields[field].active_min.xyz) & (cell <= fields[field].active_max.xyz);
    let is_high = (cell + 1 >= fields[field].active_min.xyz) & (cell + 1 <= fields[field].active_max.xyz);
    // Of the axes along which the cell reaches on, all choices in turn.
    var beyond = 0u;
    loop {
        let place = brick + vec3<i32>((vec3<u32>(beyond) >> vec3<u32>(2u, 1u, 0u)) & vec3<u32>(1u));
        let entry = region_at(field, accessor, place).entry;
        let is_there = tag_of(entry) != ABSENT_TAG;
        let words = brick_of(values, entry);
        for (var i = 0u; i < 8u; i++) {
            if ((i & reaching) == beyond) {
                let bits = vec3<bool>((i & 4u) != 0u, (i & 2u) != 0u, (i & 1u) != 0u);
                let offset = select(low, high, bits);
                let value = brick_value(field, values, words, offset.x | offset.y | offset.z);
                corners[i] = select(0.0, value, is_there && all(select(is_low, is_high, bits)));
            }
        }
        beyond = (beyond - reaching) & reaching;
        if (beyond == 0u) {
            break;
        }
    }
    return corners;
}

fn trilinear(field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>) -> f32 {
    let corner = floor(position);
    return lerp8(corners_of(field, accessor, vec3<i32>(corner) + base_voxel(field)), position - corner);
}

fn nearest(field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>) -> f32 {
    return voxel_value(field, accessor, vec3<i32>(floor(position + 0.5)) + base_voxel(field));
}

// One voxel, chosen so that the mean over many reads is `trilinear`.
fn trilinear_voxel(field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>, random: vec3<f32>) -> f32 {
    let corner = floor(position);
    let chosen = vec3<i32>(random >= 1.0 - (position - corner));
    return voxel_value(field, accessor, vec3<i32>(corner) + chosen + base_voxel(field));
}

// The weights of the uniform cubic B-spline, for the voxels from one before the cell to one behind it; `x` in the cell.
fn cubic_weights(x: f32) -> vec4<f32> {
    let y = 1.0 - x;
    let inner = 2.0 / 3.0 - vec2<f32>(x * x * (1.0 - 0.5 * x), y * y * (1.0 - 0.5 * y));
    return vec4<f32>(y * y * y / 6.0, inner, x * x * x / 6.0);
}

// The cubic B-spline, by eight interpolations between two voxels along each axis.
fn tricubic(field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>) -> f32 {
    let cell = floor(position);
    let inside = position - cell;
    let x = cubic_weights(inside.x);
    let y = cubic_weights(inside.y);
    let z = cubic_weights(inside.z);
    let low = vec3<f32>(x.x + x.y, y.x + y.y, z.x + z.y);
    let high = vec3<f32>(x.z + x.w, y.z + y.w, z.z + z.w);
    let low_place = vec3<f32>(x.y, y.y, z.y) / low;
    let high_place = vec3<f32>(x.w, y.w, z.w) / high;
    let first = vec3<i32>(cell) + base_voxel(field);
    var sum = 0.0;
    for (var i = 0; i < 8; i++) {
        let is_high = vec3<bool>((i & 4) != 0, (i & 2) != 0, (i & 1) != 0);
        let weight = select(low, high, is_high);
        let corners = corners_of(field, accessor, first + select(vec3<i32>(-1), vec3<i32>(1), is_high));
        sum += weight.x * weight.y * weight.z * lerp8(corners, select(low_place, high_place, is_high));
    }
    return sum;
}

// How many weights a number passes.
fn chosen_of(weights: vec4<f32>, random: f32) -> i32 {
    let ends = vec3<f32>(weights.x, weights.x + weights.y, weights.x + weights.y + weights.z);
    let passed = vec3<i32>(vec3<f32>(random) >= ends);
    return passed.x + passed.y + passed.z;
}

// One voxel, chosen so that the mean over many reads is `tricubic`.
fn tricubic_voxel(field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>, random: vec3<f32>) -> f32 {
    let cell = floor(position);
    let inside = position - cell;
    let chosen = vec3<i32>(
        chosen_of(cubic_weights(inside.x), random.x), chosen_of(cubic_weights(inside.y), random.y),
        chosen_of(cubic_weights(inside.z), random.z),
    );
    return voxel_value(field, accessor, vec3<i32>(cell) - 1 + chosen + base_voxel(field));
}

// The value at a position, by a filter that is known when the shader is made.
fn look_up(
    lookup: u32, field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>, random: vec3<f32>,
) -> f32 {
    if (lookup == LOOKUP_NEAREST) {
        return nearest(field, accessor, position);
    }
    if (lookup == LOOKUP_TRICUBIC) {
        return tricubic(field, accessor, position);
    }
    if (lookup == LOOKUP_STOCHASTIC_TRILINEAR) {
        return trilinear_voxel(field, accessor, position, random);
    }
    if (lookup == LOOKUP_STOCHASTIC_TRICUBIC) {
        return tricubic_voxel(field, accessor, position, random);
    }
    return trilinear(field, accessor, position);
}
