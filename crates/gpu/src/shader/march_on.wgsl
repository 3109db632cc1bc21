// The ray marcher again, a share of the work at a time: of pixels that take longer than a driver lets one dispatch last.

// A run that may not be there: `FoundRun`, in numbers.
struct KeptRun { t0: f32, t1: f32, value: f32, is_there: u32, is_varying: u32 }

// All that is known of a pixel between two dispatches: the sample that it is at, the sum of opacities of those before, and
// `Progress`, `ShadowRay` and `Passage`.
struct Kept {
    sample: u32,
    opacity: f32,
    has_begun: u32,
    walk: Walk,
    head: KeptRun,
    glow_walk: Walk,
    glow_head: KeptRun,
    pieces_left: f32,
    step: vec2<f32>,
    share: f32,
    lit: f32,
    group: Group,
    taken: f32,
    next_sky: f32,
    sky_index: u32,
    sky: SkyGroup,
    transmittance: f32,
    scattered: vec3<f32>,
    depth_moment: f32,
    is_to_sky: u32,
    worth: f32,
    origin: vec3<f32>,
    direction: vec3<f32>,
    shift: f32,
    is_passing: u32,
    passage_walk: Walk,
    passage_left: KeptRun,
    brick: vec3<f32>,
    sum: f32,
}

fn kept_run(found: FoundRun) -> KeptRun {
    return KeptRun(found.run.t0, found.run.t1, found.run.value, u32(found.is_there), u32(found.run.is_varying));
}

fn found_run(kept: KeptRun) -> FoundRun {
    return FoundRun(kept.is_there != 0u, Run(kept.t0, kept.t1, kept.is_varying != 0u, kept.value));
}

@compute @workgroup_size(WORKGROUP_SIDE * WORKGROUP_SIDE)
fn march_on(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = id.x;
    if (!is_unfinished(at)) {
        return;
    }
    let pixel = pixel_of_band(at);
    let samples = max(params.counts.x, 1u);
    let kept = band.kept[at];
    var progress = Progress(
        kept.has_begun != 0u, kept.walk, found_run(kept.head), kept.glow_walk, found_run(kept.glow_head), kept.pieces_left,
        kept.step, kept.share, kept.lit, kept.group, kept.taken, kept.next_sky, kept.sky_index, kept.sky,
        kept.transmittance, kept.scattered, kept.depth_moment,
    );
    let local = local_ray(kept.origin, kept.direction);
    var shadow = ShadowRay(kept.is_passing != 0u, kept.is_to_sky != 0u, kept.worth, local, kept.shift);
    var passage = Passage(kept.is_passing != 0u, kept.passage_walk, found_run(kept.passage_left), kept.brick, kept.sum);
    var opacity = kept.opacity;
    var i = kept.sample;
    while (i < samples) {
        let ray = camera_ray(vec2<f32>(pixel) + pixel_offset(pixel, i, samples));
        let random = hash_pixel(pixel.x, pixel.y, i, 2u);
        loop {
            if (!passage.is_there) {
                shadow = next_shadow_ray(&progress, ray, end_of(pixel, ray), random, step_shift(pixel, random));
            }
            if (!shadow.is_there) {
                break;
            }
            let light = light_through(shadow, &passage);
            if (passage.is_there) {
                break;
            }
            progress.scattered += light;
        }
        if (is_spent()) {
            break;
        }
        opacity += 1.0 - progress.transmittance;
        progress.has_begun = false;
        i += 1u;
    }
    if (is_left_over(i < samples)) {
        return;
    }
    if (i == samples) {
        // Never marked, whatever the volume holds.
        band.pixels[at] = vec4<f32>(progress.scattered, max(opacity, 0.0)) / f32(samples);
        return;
    }
    band.kept[at] = Kept(
        i, opacity, u32(progress.has_begun), progress.walk, kept_run(progress.head), progress.glow_walk,
        kept_run(progress.glow_head), progress.pieces_left, progress.step, progress.share, progress.lit, progress.group,
        progress.taken, progress.next_sky, progress.sky_index, progress.sky, progress.transmittance, progress.scattered,
        progress.depth_moment, u32(shadow.is_to_sky), shadow.worth, shadow.ray.origin, shadow.ray.direction, shadow.shift,
        u32(passage.is_there), passage.walk, kept_run(passage.left), passage.brick, passage.sum,
    );
}
