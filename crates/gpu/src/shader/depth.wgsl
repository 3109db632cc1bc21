// Line integrals: nuage_render::depth.

// The integral of the interpolated field along a ray from 0 to `end`. Exact but for rounding: in a cell it is a cubic along the ray, which
// Gauss' rule of two points integrates exactly. It is not known yet where a passage is left.
fn line_integral(field: u32, local: LocalRay, end: f32, passage: ptr<function, Passage>) -> f32 {
    var sum = 0.0;
    var accessor = new_accessor();
    var runs = runs_between(field, local, 0.0, end);
    var left = FoundRun(false, Run(0.0, 0.0, true, 0.0));
    var brick = vec3<f32>(0.0);
    if (GOES_ON && (*passage).is_there) {
        runs = resumed(field, local, (*passage).walk);
        left = (*passage).left;
        brick = (*passage).brick;
        sum = (*passage).sum;
        (*passage).is_there = false;
    }
    loop {
        if (is_spent()) {
            *passage = Passage(true, walk_of(runs), left, brick, sum);
            break;
        }
        var found = left;
        if (!GOES_ON || !left.is_there) {
            found = next_run(&runs, &accessor);
            // From brick to brick by whole numbers, so that rounding never holds the ray up at a face.
            brick = floor(ray_at(local, found.run.t0) / BRICK_SIDE);
        }
        if (!found.is_there) {
            break;
        }
        left.is_there = false;
        if (!found.run.is_varying) {
            sum += found.run.value * (found.run.t1 - found.run.t0);
            continue;
        }
        var t = found.run.t0;
        while (t < found.run.t1 && !is_spent()) {
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
        if (GOES_ON) {
            left = FoundRun(t < found.run.t1, Run(t, found.run.t1, true, 0.0));
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
