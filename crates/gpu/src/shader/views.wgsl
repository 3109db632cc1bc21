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

// Light that passes samples at whole multiples of a step, the first of which is at 0; and the number of the next of them.
struct Passing { share: f32, step: f32, per_step: f32, loss: f32, number: f32, accessor: Accessor }

// The power of up to seven samples in one voxel.
fn short_power(base: f32, exponent: f32) -> f32 {
    let count = u32(exponent);
    let square = base * base;
    return select(1.0, base, (count & 1u) != 0u) * select(1.0, square, (count & 2u) != 0u)
        * select(1.0, square * square, (count & 4u) != 0u);
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
    var passing = Passing(1.0, step, 1.0 / step, params.media[0].extinction.x * step, 0.0, new_accessor());
    if (is_nearest) {
        pass_voxels(field, in_voxels(local), 0.0, span.y - start, &passing);
    } else {
        pass_samples(field, local, 0.0, span.y - start, &passing);
    }
    return passing.share;
}

// The integral of the interpolated field along a ray in the world.
fn whole_integral(field: u32, ray: Ray) -> f32 {
    let span = field_interval(field, in_field(field, ray), 0.0);
    if (span.x >= span.y) {
        return 0.0;
    }
    return line_integral(field, moved(field, ray, span.x), span.y - span.x);
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
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let field = field_of(DENSITY_CHANNEL);
    let ray = camera_ray(vec2<f32>(id.xy) + 0.5);
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
