// The walk of a ray through a tree: nuage_render::traverse.

// A ray in the world, which here begins at the volume's origin.
struct Ray { origin: vec3<f32>, direction: vec3<f32> }

// A ray in the positions of a field, and one over its direction.
struct LocalRay { origin: vec3<f32>, direction: vec3<f32>, inverse: vec3<f32> }

fn local_ray(origin: vec3<f32>, direction: vec3<f32>) -> LocalRay {
    let is_still = direction == vec3<f32>(0.0);
    let inverse = select(1.0 / select(direction, vec3<f32>(1.0), is_still), vec3<f32>(0.0), is_still);
    return LocalRay(origin, direction, inverse);
}

fn ray_at(ray: LocalRay, t: f32) -> vec3<f32> {
    return ray.origin + ray.direction * t;
}

fn directions(field: u32, direction: vec3<f32>) -> vec3<f32> {
    return fields[field].x_axis.xyz * direction.x + fields[field].y_axis.xyz * direction.y
        + fields[field].z_axis.xyz * direction.z;
}

fn position_of(field: u32, p_world: vec3<f32>) -> vec3<f32> {
    return directions(field, p_world) + fields[field].origin.xyz;
}

// Where a ray is inside of a box, from 0 on; empty if it misses.
fn interval_in(ray: LocalRay, low: vec3<f32>, high: vec3<f32>) -> vec2<f32> {
    let a = (low - ray.origin) * ray.inverse;
    let b = (high - ray.origin) * ray.inverse;
    let is_still = ray.direction == vec3<f32>(0.0);
    let is_outside = is_still & ((ray.origin < low) | (ray.origin > high));
    let near = select(min(a, b), vec3<f32>(0.0), is_still);
    let far = select(max(a, b), vec3<f32>(MAX_F32), is_still);
    if (any(is_outside)) {
        return vec2<f32>(0.0, 0.0);
    }
    return vec2<f32>(max(max_component(near), 0.0), min_component(far));
}

// Where a ray enters and leaves a field; empty if it misses. A shift moves the field's bounds, in voxels.
fn field_interval(field: u32, ray: LocalRay, shift: f32) -> vec2<f32> {
    if (fields[field].box_first.w == 0) {
        return vec2<f32>(0.0, 0.0);
    }
    return interval_in(ray, fields[field].bounds_min.xyz - shift - REACH, fields[field].bounds_max.xyz - shift + REACH);
}

// Where a ray that starts inside leaves the field.
fn field_exit(field: u32, ray: LocalRay) -> f32 {
    let far = select(fields[field].bounds_min.xyz - REACH, fields[field].bounds_max.xyz + REACH, ray.direction >= vec3<f32>(0.0));
    let t = (far - ray.origin) * ray.inverse;
    return min_component(select(t, vec3<f32>(MAX_F32), ray.direction == vec3<f32>(0.0)));
}

// A stretch of a ray: of one value, or to be sampled.
struct Run { t0: f32, t1: f32, is_varying: bool, value: f32 }

struct Runs {
    field: u32,
    ray: LocalRay,
    // The brick to look at next, in the tree, and where the ray enters it.
    brick: vec3<i32>,
    t: f32,
    t_end: f32,
    root_leaps_left: u32,
    leaps_left: u32,
}

// The position of a brick's first voxel.
fn corner_of(field: u32, brick: vec3<i32>) -> vec3<f32> {
    return vec3<f32>(brick - fields[field].base_brick.xyz) * BRICK_SIDE;
}

fn brick_of_position(field: u32, position: vec3<f32>) -> vec3<i32> {
    return vec3<i32>(floor(position / BRICK_SIDE)) + fields[field].base_brick.xyz;
}

// The runs of a ray between two distances inside the field.
fn runs_between(field: u32, ray: LocalRay, t0: f32, t1: f32) -> Runs {
    count_ray();
    var runs: Runs;
    runs.field = field;
    runs.ray = ray;
    runs.brick = clamp(
        brick_of_position(field, ray_at(ray, t0)), fields[field].box_first.xyz, fields[field].box_last.xyz,
    );
    runs.t = t0;
    runs.t_end = t1;
    runs.root_leaps_left = MAX_ROOT_LEAPS;
    runs.leaps_left = MAX_LEAPS;
    return runs;
}

// Moves on to where the ray leaves the cube from one brick to another, and to the brick behind.
fn leap(runs: ptr<function, Runs>, first: vec3<i32>, last: vec3<i32>) {
    let ray = (*runs).ray;
    let forward = ray.direction >= vec3<f32>(0.0);
    let corner = corner_of((*runs).field, select(first, last + 1, forward));
    let faces = select((corner - ray.origin) * ray.inverse, vec3<f32>(MAX_F32), ray.direction == vec3<f32>(0.0));
    let leaves = min_component(faces);
    let is_x = faces.x <= leaves;
    let is_y = !is_x && faces.y <= leaves;
    let t = max((*runs).t, leaves);
    let box_first = fields[(*runs).field].box_first.xyz;
    let box_last = fields[(*runs).field].box_last.xyz;
    let within = clamp(
        brick_of_position((*runs).field, ray_at(ray, t)), max(first, box_first), min(last, box_last),
    );
    // The axis of the exit moves by the integers, so that the walk never stands still.
    let brick = select(within, select(first - 1, last + 1, forward), vec3<bool>(is_x, is_y, !(is_x || is_y)));
    if (any(brick < box_first) || any(brick > box_last)) {
        (*runs).t_end = min((*runs).t_end, t);
    }
    (*runs).t = t;
    (*runs).brick = brick;
}

// Moves on to the next brick.
fn step_brick(runs: ptr<function, Runs>) {
    leap(runs, (*runs).brick, (*runs).brick);
}

// Moves on to where the ray leaves a region around the brick it is in, and what is as empty around that.
fn pass_region(runs: ptr<function, Runs>, region: Region) {
    if (IS_WIDE) {
        step_brick(runs);
        return;
    }
    let side = (1 << region.log2_bricks) - 1;
    if (side > 0 && !HAS_MAPS) {
        (*runs).leaps_left -= 1u;
        if ((*runs).leaps_left == 0u) {
            (*runs).t_end = min((*runs).t_end, (*runs).t);
        }
    }
    let first = (*runs).brick & vec3<i32>(~side);
    leap(runs, first - region.margin, first + (side + region.margin));
}

// Moves on to the next cell of the root table, over all that have none.
fn leap_to_root_entry(runs: ptr<function, Runs>) {
    let field = (*runs).field;
    let count = fields[field].box_first.w;
    if (count > MAX_ROOT_LEAP || (*runs).root_leaps_left == 0u) {
        return;
    }
    (*runs).root_leaps_left -= 1u;
    var next = MAX_F32;
    var next_first = vec3<i32>(0);
    for (var i = 0; i < count; i++) {
        let first = cell_at(u32(fields[field].base_brick.w + i)) << vec3<u32>(LOG2_NODE5_BRICKS);
        let low = vec3<f32>(first - fields[field].base_brick.xyz) * BRICK_SIDE;
        let inside = interval_in((*runs).ray, low, low + NODE5_SIDE);
        let t0 = max(inside.x, (*runs).t);
        if (t0 < inside.y && t0 < next) {
            next = t0;
            next_first = first;
        }
    }
    if (next == MAX_F32) {
        (*runs).t_end = min((*runs).t_end, (*runs).t);
        return;
    }
    (*runs).t = next;
    let first = max(next_first, fields[field].box_first.xyz);
    let last = min(next_first + (NODE5_BRICKS - 1), fields[field].box_last.xyz);
    if (any(first > last)) {
        return;
    }
    (*runs).brick = clamp(brick_of_position(field, ray_at((*runs).ray, next)), first, last);
}

// Bounds of samples whose cell lies in a region around a brick; of those that reach one voxel further, in the brick.
fn sample_bounds(field: u32, brick: vec3<i32>, region: Region) -> vec2<f32> {
    var bounds = footprint(field, brick, region);
    if (IS_WIDE) {
        var accessor = new_accessor();
        for (var i = 0; i < 27; i++) {
            let beside = brick + vec3<i32>(i / 9, i / 3 % 3, i % 3) - 1;
            let other = footprint(field, beside, region_at(field, &accessor, beside));
            bounds = vec2<f32>(min(bounds.x, other.x), max(bounds.y, other.y));
        }
    }
    return bounds;
}

// A stretch of a ray through one region, with bounds of all that can be sampled there.
struct Segment { is_there: bool, t0: f32, t1: f32, min: f32, max: f32 }

// The next region that is not empty. To be used instead of `next_run`.
fn next_segment(runs: ptr<function, Runs>, accessor: ptr<function, Accessor>) -> Segment {
    while ((*runs).t < (*runs).t_end) {
        let brick = (*runs).brick;
        let region = region_at((*runs).field, accessor, brick);
        let bounds = sample_bounds((*runs).field, brick, region);
        let t0 = (*runs).t;
        pass_region(runs, region);
        let t1 = min((*runs).t, (*runs).t_end);
        if (bounds.y > 0.0 && t0 < t1) {
            return Segment(true, t0, t1, bounds.x, bounds.y);
        }
        if (bounds.y <= 0.0 && region.log2_bricks == LOG2_NODE5_BRICKS && !HAS_MAPS && !IS_WIDE) {
            leap_to_root_entry(runs);
        }
    }
    return Segment(false, 0.0, 0.0, 0.0, 0.0);
}

// Where a ray is in the part of a large tile of which all samples have the tile's value; else it is at `t1`.
fn core_of_tile(runs: ptr<function, Runs>, brick: vec3<i32>, region: Region, t0: f32, t1: f32) -> vec2<f32> {
    let low = corner_of((*runs).field, brick & vec3<i32>(-1 << region.log2_bricks));
    let side = f32(1u << (region.log2_bricks + LOG2_BRICK));
    let inside = interval_in((*runs).ray, low, low + (side - 1.0));
    return select(vec2<f32>(t1), clamp(inside, vec2<f32>(t0), vec2<f32>(t1)), inside.x < inside.y);
}

// A run that may not be there.
struct FoundRun { is_there: bool, run: Run }

// The next run. Varying bricks that touch come as one. What ends them, and what is left of a tile, is looked up again by the next
// call: less than to carry it along.
fn next_run(runs: ptr<function, Runs>, accessor: ptr<function, Accessor>) -> FoundRun {
    var found = FoundRun(false, Run(0.0, 0.0, true, 0.0));
    while ((*runs).t < (*runs).t_end) {
        let brick = (*runs).brick;
        let t0 = (*runs).t;
        let t_end = (*runs).t_end;
        let region = region_at((*runs).field, accessor, brick);
        let bounds = sample_bounds((*runs).field, brick, region);
        pass_region(runs, region);
        let t1 = min((*runs).t, (*runs).t_end);
        if (t0 >= t1) {
            continue;
        }
        let is_varying = bounds.x != bounds.y;
        if (is_varying && (region.log2_bricks == 0u || IS_WIDE)) {
            found = FoundRun(true, Run(select(t0, found.run.t0, found.is_there), t1, true, 0.0));
            continue;
        }
        if (found.is_there) {
            // On from here the next time.
            (*runs).brick = brick;
            (*runs).t = t0;
            (*runs).t_end = t_end;
            break;
        }
        if (!is_varying) {
            if (bounds.y != 0.0) {
                return FoundRun(true, Run(t0, t1, false, bounds.y));
            }
            if (region.log2_bricks == LOG2_NODE5_BRICKS && !HAS_MAPS && !IS_WIDE) {
                leap_to_root_entry(runs);
            }
            continue;
        }
        // Only bricks are not of one value, and they are no tiles: a tile varies at its ends.
        let core = core_of_tile(runs, brick, region, t0, t1);
        let is_core = t0 >= core.x && t0 < core.y;
        let ends = select(select(t1, core.y, is_core), core.x, t0 < core.x);
        if (ends < t1) {
            (*runs).brick = brick;
            (*runs).t = ends;
            (*runs).t_end = t_end;
        }
        let value = select(0.0, meant((*runs).field, bitcast<f32>(region.entry.payload)), is_core);
        if (!is_core || value != 0.0) {
            return FoundRun(true, Run(t0, ends, !is_core, value));
        }
    }
    return found;
}

// Where a walk stands.
struct Walk { brick: vec3<i32>, t: f32, t_end: f32 }

fn walk_of(runs: Runs) -> Walk {
    return Walk(runs.brick, runs.t, runs.t_end);
}

// Goes on with a walk; its leaps are counted from here on.
fn resumed(field: u32, ray: LocalRay, walk: Walk) -> Runs {
    return Runs(field, ray, walk.brick, walk.t, walk.t_end, MAX_ROOT_LEAPS, MAX_LEAPS);
}

// How far a sum along a ray has got where a dispatch had done its share: its walk, what is left of the run it is in, the brick of
// that where it takes bricks one by one, and the sum so far.
struct Passage { is_there: bool, walk: Walk, left: FoundRun, brick: vec3<f32>, sum: f32 }
