// The path tracer again, a share of the work at a time: of pixels whose path takes longer than a driver lets one dispatch last.

// All that is known of a path between two dispatches: `Path`.
struct Kept {
    has_begun: u32,
    draws: u32,
    scatterings: u32,
    met: f32,
    ray: Ray,
    carried: Carried,
    light: vec3<f32>,
}

@compute @workgroup_size(WORKGROUP_SIDE * WORKGROUP_SIDE)
fn path_on(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = id.x;
    if (!is_unfinished(at)) {
        return;
    }
    let pixel = pixel_of_band(at);
    let first = path_ray(pixel);
    var path = new_path(first, path_seed(pixel));
    let kept = band.kept[at];
    if (kept.has_begun != 0u) {
        let random = Random(path.random.path, kept.draws);
        path = Path(false, kept.ray, kept.carried, kept.light, kept.scatterings, kept.met, random);
    }
    follow(&path, end_of(pixel, first));
    if (is_left_over(!path.is_over)) {
        return;
    }
    if (path.is_over) {
        band.pixels[at] = unmarked(band.pixels[at]) + vec4<f32>(path.light, path.met);
        return;
    }
    band.kept[at] = Kept(1u, path.random.count, path.scatterings, path.met, path.ray, path.carried, path.light);
}
