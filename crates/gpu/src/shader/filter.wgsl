// What the voxels of a field say of the points between them: nuage_render::filter and `Field::sample`.
//
// Positions count voxels from the first voxel of the field's base brick.

fn in_region(field: u32, region: Region, index: vec3<i32>) -> f32 {
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

fn base_voxel(field: u32) -> vec3<i32> {
    return fields[field].base_brick.xyz << vec3<u32>(LOG2_BRICK);
}

fn lerp8(c: array<f32, 8>, f: vec3<f32>) -> f32 {
    let low = mix_(mix_(c[0], c[1], f.z), mix_(c[2], c[3], f.z), f.y);
    let high = mix_(mix_(c[4], c[5], f.z), mix_(c[6], c[7], f.z), f.y);
    return mix_(low, high, f.x);
}

// The eight values of the cell whose lower corner is a voxel.
fn corners_of(field: u32, accessor: ptr<function, Accessor>, cell: vec3<i32>) -> array<f32, 8> {
    var corners: array<f32, 8>;
    var brick = cell >> vec3<u32>(LOG2_BRICK);
    var region = region_at(field, accessor, brick);
    for (var i = 0; i < 8; i++) {
        let index = cell + vec3<i32>(i >> 2u, (i >> 1u) & 1, i & 1);
        if (any(index >> vec3<u32>(LOG2_BRICK) != brick)) {
            brick = index >> vec3<u32>(LOG2_BRICK);
            region = region_at(field, accessor, brick);
        }
        corners[i] = select(0.0, in_region(field, region, index), is_active(field, index));
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
fn stochastic(field: u32, accessor: ptr<function, Accessor>, position: vec3<f32>, random: vec3<f32>) -> f32 {
    let corner = floor(position);
    let chosen = vec3<i32>(random >= 1.0 - (position - corner));
    return voxel_value(field, accessor, vec3<i32>(corner) + chosen + base_voxel(field));
}
