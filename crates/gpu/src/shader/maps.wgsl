// The map of bricks of a tree that is built: nuage_gpu::maps. Entries write their cells themselves; here absent ones come to know
// how far the nearest that is not absent is, as a king goes on a chessboard: along z, then along y, then along x, since the
// greatest of three differences is the greatest of the third and of the greatest of two.

// Writes the cell of a brick of the tree, which begins where the map does, behind a layer of absent ones.
fn write_cell(brick: vec3<u32>, payload: u32, kind: u32) {
    if (!HAS_MAPS || any(brick + 2u >= build.map.xyz)) {
        return;
    }
    let cell = brick + 1u;
    let at = build.map.w + MAP_CELL_WORDS * ((cell.x * build.map.y + cell.y) * build.map.z + cell.z);
    tree[at] = kind;
    tree[at + 1u] = payload;
}

// Where in `scratch` it stands how far a cell is from the nearest along z, or along z and y.
fn distance_of(axes: u32, cell: u32) -> u32 {
    let cells = build.map.x * build.map.y * build.map.z;
    return summary_of(vec3<u32>(build.bricks.x, 0u, 0u)) + (axes - 1u) * cells + cell;
}

// How far a cell is from the nearest along so many axes.
fn distance_along(axes: u32, cell: u32) -> u32 {
    if (axes == 0u) {
        return select(0u, FURTHEST, (tree[build.map.w + MAP_CELL_WORDS * cell] & 0xffu) == ABSENT_TAG);
    }
    return scratch[distance_of(axes, cell)];
}

// The same along one axis more, on which neighbours are so many cells apart. A cell of a layer a lane.
fn distance_along_next(axes: u32, cell: u32, place: u32, count: u32, apart: u32) -> u32 {
    var nearest = distance_along(axes, cell);
    let furthest = max(place, count - 1u - place);
    for (var away = 1u; away < nearest && away <= furthest; away++) {
        if (away <= place) {
            nearest = min(nearest, max(away, distance_along(axes, cell - away * apart)));
        }
        if (place + away < count) {
            nearest = min(nearest, max(away, distance_along(axes, cell + away * apart)));
        }
    }
    return nearest;
}

@compute @workgroup_size(LANES)
fn map_z(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x < build.map.y * build.map.z) {
        let cell = id.y * build.map.y * build.map.z + id.x;
        scratch[distance_of(1u, cell)] = distance_along_next(0u, cell, id.x % build.map.z, build.map.z, 1u);
    }
}

@compute @workgroup_size(LANES)
fn map_y(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x < build.map.y * build.map.z) {
        let cell = id.y * build.map.y * build.map.z + id.x;
        scratch[distance_of(2u, cell)] = distance_along_next(1u, cell, id.x / build.map.z, build.map.y, build.map.z);
    }
}

@compute @workgroup_size(LANES)
fn map_x(@builtin(global_invocation_id) id: vec3<u32>) {
    let place = vec3<u32>(id.y, id.x / build.map.z, id.x % build.map.z);
    // The layer of absent cells all around tells of nothing.
    if (any(place == vec3<u32>(0u)) || any(place + 1u >= build.map.xyz)) {
        return;
    }
    let cell = id.y * build.map.y * build.map.z + id.x;
    let nearest = distance_along_next(2u, cell, place.x, build.map.x, build.map.y * build.map.z);
    if (nearest != 0u) {
        tree[build.map.w + MAP_CELL_WORDS * cell] = ABSENT_TAG | (nearest << 8u);
    }
}
