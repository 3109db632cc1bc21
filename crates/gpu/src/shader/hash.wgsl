// Random numbers without state: nuage_render::hash, and the numbers of a path of nuage_render::path.

fn hash_u32(x: u32) -> u32 {
    let y = (x ^ (x >> 16u)) * HASH_FIRST;
    let z = (y ^ (y >> 15u)) * HASH_SECOND;
    return z ^ (z >> 15u);
}

fn rotate_left(x: u32, bits: u32) -> u32 {
    return (x << bits) | (x >> (32u - bits));
}

fn hash_pixel(x: u32, y: u32, sample_index: u32, dimension: u32) -> u32 {
    let pixel = hash_u32((x ^ rotate_left(y, 16u)) + GOLDEN);
    let path = hash_u32(pixel + sample_index);
    return hash_u32(path + dimension);
}

fn unit_f32(bits: u32) -> f32 {
    return f32(bits >> 8u) * UNIT_STEP;
}

struct Random { path: u32, count: u32 }

fn random_unit(random: ptr<function, Random>) -> f32 {
    (*random).count += 1u;
    let path = (*random).path;
    return unit_f32(hash_u32(hash_u32(path + (*random).count) ^ rotate_left(path, 16u)));
}

// Three numbers for one voxel that is chosen, where one is.
fn random_3d(random: ptr<function, Random>) -> vec3<f32> {
    if (LOOKUP == MEAN_LOOKUP) {
        return vec3<f32>(0.0);
    }
    return vec3<f32>(random_unit(random), random_unit(random), random_unit(random));
}

// The same by a seed.
fn three(seed: u32) -> vec3<f32> {
    let hashed = hash_u32(seed);
    return vec3<f32>(
        unit_f32(hash_u32(hashed + 1u)), unit_f32(hash_u32(hashed + 2u)), unit_f32(hash_u32(hashed + 3u)),
    );
}

// Whether a path has to end, whatever is to be found: devices are lost that do not come to an end.
fn has_drawn_enough(random: ptr<function, Random>) -> bool {
    return (*random).count >= MAX_DRAWS;
}

// An optical depth at which a ray collides.
fn random_depth(random: ptr<function, Random>) -> f32 {
    return -ln(1.0 - random_unit(random));
}
