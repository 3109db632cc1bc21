// Rays that tell what their walks visit: nuage_gpu::hdda's tests. Two rows of the picture say where rays begin and end and where
// they go; what comes of the walk to each layer goes into the two rows after them.

// Steps, empty regions, a number that hangs on each brick and cell in turn, and the length of all steps.
struct Visits { steps: u32, empty: u32, trail: u32, length: f32 }

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn visits(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy) || id.y < 2u) {
        return;
    }
    let start = picture[id.x];
    let ray = local_ray(start.xyz, picture[params.size.x + id.x].xyz);
    var visits = Visits(0u, 0u, 0u, 0.0);
    if (id.y == 2u) {
        visit_bricks(0u, ray, 0.0, start.w, &visits);
    } else {
        visit_voxels(0u, ray, 0.0, start.w, &visits);
    }
    let numbers = vec3<f32>(vec3<u32>(visits.steps, visits.empty, visits.trail >> 8u));
    picture[id.y * params.size.x + id.x] = vec4<f32>(numbers, visits.length);
}
