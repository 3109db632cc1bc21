// Line integrals: nuage_render::depth.

// The integral of the interpolated field along a ray from 0 to `end`. Exact but for rounding: in a cell it is a cubic along the ray, which
// Gauss' rule of two points integrates exactly.
fn line_integral(field: u32, local: LocalRay, end: f32) -> f32 {
    var sum = 0.0;
    var accessor = new_accessor();
    var runs = runs_between(field, local, 0.0, end);
    loop {
        let found = next_run(&runs, &accessor);
        if (!found.is_there) {
            break;
        }
        if (!found.run.is_varying) {
            sum += found.run.value * (found.run.t1 - found.run.t0);
            continue;
        }
        // From brick to brick by whole numbers, so that rounding never holds the ray up at a face.
        var t = found.run.t0;
        var brick = floor(ray_at(local, t) / BRICK_SIDE);
        while (t < found.run.t1) {
            let corner = brick * BRICK_SIDE;
            let far = select(corner, corner + BRICK_SIDE, local.direction >= vec3<f32>(0.0));
            let is_still = local.direction == vec3<f32>(0.0);
            let faces = select((far - local.origin) * local.inverse, vec3<f32>(MAX_F32), is_still);
            let leaves = min_component(faces);
            let end = clamp(leaves, t, found.run.t1);
            var cells = cells_between(local, t, end, corner);
            while (cells.t < cells.end) {
                let cell = next_cell(&cells);
                let half = 0.5 * (cell.t1 - cell.t0);
                if (half <= 0.0) {
                    continue;
                }
                let first = corner + vec3<f32>(local_of(cell.packed));
                let c = corners_of(field, &accessor, vec3<i32>(first) + base_voxel(field));
                let middle = ray_at(local, 0.5 * (cell.t0 + cell.t1)) - first;
                let apart = local.direction * (half * GAUSS_NODE);
                sum += half * (lerp8(c, middle - apart) + lerp8(c, middle + apart));
            }
            t = end;
            let is_x = faces.x <= leaves;
            let is_y = !is_x && faces.y <= leaves;
            brick += select(vec3<f32>(0.0), sign(local.direction), vec3<bool>(is_x, is_y, !(is_x || is_y)));
        }
    }
    return sum;
}

// Where a ray is in the boxes around the active voxels, whose places it takes half a voxel further on.
fn voxels_interval(field: u32, ray: LocalRay) -> vec2<f32> {
    if (fields[field].box_first.w == 0) {
        return vec2<f32>(0.0, 0.0);
    }
    return interval_in(ray, fields[field].bounds_min.xyz + 1.0, fields[field].bounds_max.xyz);
}

// A ray in the positions of a field, half a voxel further on.
fn in_voxels(ray: LocalRay) -> LocalRay {
    return LocalRay(ray.origin + 0.5, ray.direction, ray.inverse);
}

// The same of the nearest voxels, each a box around its place.
fn voxel_integral(field: u32, local: LocalRay) -> f32 {
    let ray = in_voxels(local);
    let span = voxels_interval(field, ray);
    var sum = 0.0;
    if (span.x < span.y) {
        add_voxels(field, ray, span.x, span.y, &sum);
    }
    return sum;
}
