// The light volume: the share of the sun's light that gets to each node of a lattice along the sun's rays, as
// nuage_render::shade has it. One walk through the medium lights a whole column.

@group(3) @binding(0) var light_nodes: texture_storage_3d<rgba16float, write>;

fn store_node(column: vec2<u32>, node: u32, depth: f32) {
    textureStore(light_nodes, vec3<u32>(column, node), vec4<f32>(exp_(-depth)));
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn light_volume(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= vec2<u32>(LIGHT_NODES))) {
        return;
    }
    let field = field_of(SHADOW_CHANNEL);
    // A ray away from the sun, whose t counts nodes.
    let first = params.light_first.xyz + f32(id.x) * params.light_x.xyz + f32(id.y) * params.light_y.xyz;
    let ray = local_ray(first, params.light_z.xyz);
    let scale = params.media[0].extinction.x * params.light_z.w;
    let step = params.march_rays.w / length(ray.direction);
    let span = field_interval(field, ray, 0.0);
    var node = 0u;
    var depth = 0.0;
    var accessor = new_accessor();
    var runs = runs_between(field, ray, span.x, max(span.x, span.y));
    // What lies deeper is dark.
    while (depth <= params.march_rays.z && node < LIGHT_NODES) {
        let found = next_run(&runs, &accessor);
        if (!found.is_there) {
            break;
        }
        let run = found.run;
        let pieces = select(1.0, clamp(ceil((run.t1 - run.t0) / step), 1.0, MOST_PIECES), run.is_varying);
        let length = (run.t1 - run.t0) / pieces;
        for (var piece = 0.0; piece < pieces && depth <= params.march_rays.z; piece += 1.0) {
            let t = run.t0 + piece * length;
            var value = run.value;
            if (run.is_varying) {
                value = look_up(MEAN_LOOKUP, field, &accessor, ray_at(ray, t + 0.5 * length), vec3<f32>(0.0));
            }
            while (node < LIGHT_NODES && f32(node) < t + length) {
                store_node(id.xy, node, depth + value * scale * max(f32(node) - t, 0.0));
                node += 1u;
            }
            depth += value * scale * length;
        }
    }
    while (node < LIGHT_NODES) {
        store_node(id.xy, node, depth);
        node += 1u;
    }
}
