// Where a ray first meets the surface of a level: nuage_render::surface.

fn surface_value(c: array<f32, 8>, origin: vec3<f32>, direction: vec3<f32>, t: f32, surface: f32) -> f32 {
    return lerp8(c, origin + direction * t) - surface;
}

// Where the interpolation in a cell reaches the surface, which it has done at the end.
fn meet_in_cell(c: array<f32, 8>, origin: vec3<f32>, direction: vec3<f32>, t0: f32, t1: f32, surface: f32) -> f32 {
    var a = t0;
    var b = t1;
    var value_a = surface_value(c, origin, direction, a, surface);
    var value_b = surface_value(c, origin, direction, b, surface);
    if (value_a >= 0.0) {
        return a;
    }
    if (value_b <= 0.0) {
        return b;
    }
    let tolerance = 1e-4 * (b - a);
    for (var turn = 0u; turn < MOST_REFINEMENTS; turn++) {
        let chord = a - value_a * (b - a) / (value_b - value_a);
        let t = select(chord, 0.5 * (a + b), turn % 3u == 2u || !(chord > a && chord < b));
        let value_t = surface_value(c, origin, direction, t, surface);
        if (abs(value_t) <= 1e-6 * (value_b - value_a)) {
            return t;
        }
        if (value_t >= 0.0) { b = t; value_b = value_t; } else { a = t; value_a = value_t; }
        if (b - a <= tolerance) {
            break;
        }
    }
    return b;
}

// The distance along the local ray of the surface; negative if it is not met.
fn first_hit(field: u32, ray: LocalRay, end: f32, surface: f32) -> f32 {
    var accessor = new_accessor();
    var runs = runs_between(field, ray, 0.0, end);
    while (runs.t < runs.t_end) {
        let brick = runs.brick;
        let region = region_at(field, &accessor, brick);
        let bounds = footprint(field, brick, region);
        let begin = runs.t;
        if (bounds.y < surface) {
            pass_region(&runs, region);
            if (!HAS_MAPS && bounds.y == 0.0 && region.log2_bricks == LOG2_NODE5_BRICKS) {
                leap_to_root_entry(&runs);
            }
            continue;
        }
        if (bounds.x >= surface) {
            return begin;
        }
        // Bricks of a large tile one by one: only those at its border matter.
        step_brick(&runs);
        let corner = corner_of(field, brick);
        var cells = cells_between(ray, begin, min(runs.t, runs.t_end), corner);
        while (cells.t < cells.end) {
            let cell = next_cell(&cells);
            if (cell.t0 >= cell.t1) {
                continue;
            }
            let first = corner + vec3<f32>(local_of(cell.packed));
            let c = corners_of(field, &accessor, vec3<i32>(first) + base_voxel(field));
            if (surface_value(c, ray.origin - first, ray.direction, cell.t1, surface) >= 0.0) {
                return meet_in_cell(c, ray.origin - first, ray.direction, cell.t0, cell.t1, surface);
            }
        }
    }
    return -1.0;
}

// The gradient of the interpolation, over a voxel to both sides along each axis.
fn slope(field: u32, position: vec3<f32>) -> vec3<f32> {
    var accessor = new_accessor();
    var result: vec3<f32>;
    for (var i = 0u; i < 3u; i++) {
        let axis = vec3<f32>(vec3<u32>(i) == vec3<u32>(0u, 1u, 2u));
        result[i] = trilinear(field, &accessor, position + axis)
            - trilinear(field, &accessor, max(position - axis, vec3<f32>(0.0)));
    }
    return result;
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn surface(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let field = field_of(DENSITY_CHANNEL);
    let ray = camera_ray(vec2<f32>(id.xy) + 0.5);
    let span = field_interval(field, in_field(field, ray), 0.0);
    var t = -1.0;
    let local = moved(field, ray, span.x);
    if (span.x < span.y) {
        t = first_hit(field, local, span.y - span.x, params.view.w);
    }
    if (VIEW == VIEW_HITS) {
        store(id.xy, vec4<f32>(select(-1.0, span.x + t, t >= 0.0), 0.0, 0.0, 0.0));
        return;
    }
    if (t < 0.0) {
        store(id.xy, vec4<f32>(0.0));
        return;
    }
    // A normal turns with the transposed inverse of what turns points.
    let down = -slope(field, ray_at(local, t));
    let turned = vec3<f32>(
        dot(fields[field].x_axis.xyz, down), dot(fields[field].y_axis.xyz, down), dot(fields[field].z_axis.xyz, down),
    );
    let is_flat = dot(turned, turned) <= 0.0;
    let normal = select(normalize(select(turned, vec3<f32>(1.0), is_flat)), -ray.direction, is_flat);
    let facing = clamp(-dot(normal, ray.direction), 0.0, 1.0);
    store(id.xy, vec4<f32>(vec3<f32>(facing), 1.0));
}
