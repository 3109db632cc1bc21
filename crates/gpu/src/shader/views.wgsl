// The debug views: nuage_render::views, with the first voxel and the line integral that they show.

// The first voxel of a value above another, whose box around its place the ray enters at a distance; the cell is its place in
// a brick.
struct VoxelHit { is_there: bool, above: f32, distance: f32, brick: vec3<i32>, cell: u32, value: f32 }

fn voxel_of(hit: VoxelHit) -> vec3<i32> {
    return (hit.brick << vec3<u32>(LOG2_BRICK)) + local_of(hit.cell);
}

fn first_voxel(field: u32, ray: Ray, above: f32) -> VoxelHit {
    var hit = VoxelHit(false, above, 0.0, vec3<i32>(0), 0u, 0.0);
    let span = voxels_interval(field, in_voxels(in_field(field, ray)));
    if (span.x >= span.y) {
        return hit;
    }
    meet_voxel(field, in_voxels(moved(field, ray, span.x)), 0.0, span.y - span.x, &hit);
    hit.distance += span.x;
    return hit;
}

// Light that passes samples at whole numbers of a ray: its share, what a sample of value 1 takes, the number of the next
// sample, and how far rounding moves faces.
struct Passing { share: f32, loss: f32, number: f32, blur: f32, accessor: Accessor }

// The share of light that passes some samples, each of which takes a part: the series of (1 - part)^count, which ends.
fn passing_all(part: f32, count: f32) -> f32 {
    var share = 1.0;
    if (HAS_SHORT_STEPS) {
        share = 1.0 - (count * (1.0 / 7.0) - 6.0 / 7.0) * part * share;
        share = 1.0 - (count * (1.0 / 6.0) - 5.0 / 6.0) * part * share;
        share = 1.0 - (count * (1.0 / 5.0) - 4.0 / 5.0) * part * share;
    }
    share = 1.0 - (count * (1.0 / 4.0) - 3.0 / 4.0) * part * share;
    share = 1.0 - (count * (1.0 / 3.0) - 2.0 / 3.0) * part * share;
    share = 1.0 - (count * (1.0 / 2.0) - 1.0 / 2.0) * part * share;
    return 1.0 - count * part * share;
}

// Samples of the nearest voxels of one brick, from the next up to `t1`, those of one voxel at once.
fn pass_brick(
    field: u32, values: Values, words: Brick, ray: LocalRay, corner: vec3<f32>, t1: f32, passing: ptr<function, Passing>,
) {
    let begin = (*passing).number;
    // A sample so near to the end that it may lie in the next brick is left to that: so no cell is outside of this one.
    let count = max(ceil(t1 - (*passing).blur - begin), 0.0);
    if (!HAS_MAPS && words.tag == CONSTANT_TAG) {
        // It may be a tile of many bricks.
        let passes = max(1.0 - (*passing).loss * brick_value(field, values, words, 0u), LEAST_SHARE);
        (*passing).share *= pow(passes, count);
        (*passing).number = begin + count;
        return;
    }
    let first = ray_at(ray, begin) - corner;
    let cell = clamp(floor(first), vec3<f32>(0.0), vec3<f32>(BRICK_SIDE - 1.0));
    let forward = ray.direction >= vec3<f32>(0.0);
    let is_still = ray.direction == vec3<f32>(0.0);
    let faces = (cell + select(vec3<f32>(0.0), vec3<f32>(1.0), forward) - first) * ray.inverse;
    var next = select(faces, vec3<f32>(MAX_F32), is_still | vec3<bool>(count == 0.0));
    let apart = abs(ray.inverse);
    let strides = vec3<i32>(1 << (2u * LOG2_BRICK), 1 << LOG2_BRICK, 1);
    let steps = vec3<u32>(select(-strides, strides, forward));
    var voxel = u32((cell.x * BRICK_SIDE + cell.y) * BRICK_SIDE + cell.z);
    var number = 0.0;
    loop {
        let leaves = min_component(next);
        let upto = min(ceil(leaves), count);
        let taken = (*passing).loss * brick_value(field, values, words, voxel);
        (*passing).share *= passing_all(taken, upto - number);
        number = upto;
        let is_x = next.x <= leaves;
        let is_y = !is_x && next.y <= leaves;
        voxel += select(select(steps.z, steps.y, is_y), steps.x, is_x);
        next += select(vec3<f32>(0.0), apart, vec3<bool>(is_x, is_y, !(is_x || is_y)));
        // As in the walk, not at the loop's head.
        if (!(number < count)) {
            break;
        }
    }
    (*passing).number = begin + count;
}

// The share of light that passes samples: nuage_render::depth::stepped_transmittance.
fn stepped_transmittance(field: u32, ray: Ray) -> f32 {
    let is_nearest = VIEW == VIEW_NEAREST;
    let whole = in_field(field, ray);
    var span = field_interval(field, whole, 0.0);
    if (is_nearest) {
        span = voxels_interval(field, in_voxels(whole));
    }
    if (span.x >= span.y) {
        return 1.0;
    }
    let step = params.march.x / length(whole.direction);
    let start = ceil(span.x / step) * step;
    let local = moved(field, ray, start);
    // A ray whose t counts samples.
    let samples = LocalRay(local.origin, local.direction * step, local.inverse / step);
    let end = (span.y - start) / step;
    var passing = Passing(1.0, params.media[0].extinction.x * step, 0.0, 0.0, new_accessor());
    if (is_nearest) {
        passing.blur = (end + BRICK_SIDE) * FACE_BLUR;
        pass_voxels(field, in_voxels(samples), 0.0, end, &passing);
        return passing.share;
    }
    pass_samples(field, samples, 0.0, end, &passing);
    return passing.share;
}

// The integral of the interpolated field along a ray in the world.
fn whole_integral(field: u32, ray: Ray) -> f32 {
    let span = field_interval(field, in_field(field, ray), 0.0);
    if (span.x >= span.y) {
        return 0.0;
    }
    var passage: Passage;
    return line_integral(field, moved(field, ray, span.x), span.y - span.x, &passage);
}

fn view_colour(hit: VoxelHit, field: u32) -> vec3<f32> {
    switch (VIEW) {
        case VIEW_DEPTH: {
            let share = (hit.distance - params.view.x) / (params.view.y - params.view.x);
            return vec3<f32>(clamp(1.0 - share, 0.0, 1.0));
        }
        case VIEW_INDEX: {
            let first = fields[field].active_min.xyz;
            let size = fields[field].active_max.xyz - first + 1;
            let local = max(voxel_of(hit) - first, vec3<i32>(0));
            let side = f32(max(size.x, max(size.y, size.z)));
            // Nested, so that single precision suffices.
            let turns = (f32(local.z) + (f32(local.y) + f32(local.x) / side) / side) / side;
            return hue(turns);
        }
        default: {
            return hue(hit.value / params.view.z * (5.0 / 6.0));
        }
    }
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn views(@builtin(global_invocation_id) id: vec3<u32>) {
    let field = field_of(DENSITY_CHANNEL);
    let ray = camera_ray(vec2<f32>(id.xy) + 0.5);
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    if (VIEW == VIEW_DENSITY) {
        store(id.xy, vec4<f32>(one_minus_exp_neg(params.media[0].extinction.x * whole_integral(field, ray))));
        return;
    }
    if (VIEW == VIEW_NEAREST || VIEW == VIEW_TRILINEAR) {
        store(id.xy, vec4<f32>(1.0 - stepped_transmittance(field, ray)));
        return;
    }
    let hit = first_voxel(field, ray, params.view.w);
    if (VIEW == VIEW_HITS) {
        let distance = select(-1.0, hit.distance, hit.is_there);
        store(id.xy, vec4<f32>(distance, vec3<f32>(voxel_of(hit) + fields[field].index_offset.xyz)));
        return;
    }
    var picture_value = vec4<f32>(0.0);
    if (hit.is_there) {
        picture_value = vec4<f32>(view_colour(hit, field), 1.0);
    }
    store(id.xy, picture_value);
}
