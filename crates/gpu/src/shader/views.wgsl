// The debug views: nuage_render::views, with the first voxel and the line integral that they show.

// The first voxel of a value above 0, whose box around its place the ray enters at a distance.
struct VoxelHit { is_there: bool, distance: f32, voxel: vec3<i32>, value: f32 }

fn first_voxel(field: u32, ray: Ray) -> VoxelHit {
    var hit = VoxelHit(false, 0.0, vec3<i32>(0), 0.0);
    // Voxels are boxes around their places.
    let whole = in_field(field, ray);
    let span = field_interval(field, local_ray(whole.origin + 0.5, whole.direction), 0.0);
    if (span.x >= span.y) {
        return hit;
    }
    let near = moved(field, ray, span.x);
    meet_voxel(field, local_ray(near.origin + 0.5, near.direction), 0.0, span.y - span.x, &hit);
    hit.distance += span.x;
    return hit;
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
    switch (params.counts.z) {
        case VIEW_DEPTH: {
            let share = (hit.distance - params.view.x) / (params.view.y - params.view.x);
            return vec3<f32>(clamp(1.0 - share, 0.0, 1.0));
        }
        case VIEW_INDEX: {
            let first = fields[field].active_min.xyz;
            let size = fields[field].active_max.xyz - first + 1;
            let local = max(hit.voxel - first, vec3<i32>(0));
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
    if (params.counts.z == VIEW_DENSITY) {
        store(id.xy, vec4<f32>(one_minus_exp_neg(params.media[0].extinction.x * whole_integral(field, ray))));
        return;
    }
    let hit = first_voxel(field, ray);
    if (params.counts.z == VIEW_HITS) {
        let distance = select(-1.0, hit.distance, hit.is_there);
        store(id.xy, vec4<f32>(distance, vec3<f32>(hit.voxel + fields[field].index_offset.xyz)));
        return;
    }
    var picture_value = vec4<f32>(0.0);
    if (hit.is_there) {
        picture_value = vec4<f32>(view_colour(hit, field), 1.0);
    }
    store(id.xy, picture_value);
}
