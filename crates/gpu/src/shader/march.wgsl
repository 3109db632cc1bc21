// The ray marcher: nuage_render::march, step by step.

// Where steps end: at w((k + shift) × step), where w(u) = u + ½ curvature × u².
struct Lattice { step: f32, shift: f32, curvature: f32 }

// The steps of a lattice between two distances.
struct Steps { lattice: Lattice, length: f32, k: f32, t0: f32, end: f32 }

fn steps_between(lattice: Lattice, start: f32, end: f32) -> Steps {
    let length = max(lattice.step, end * 1e-6);
    var uniform_start = start;
    if (lattice.curvature > 0.0) {
        uniform_start = (sqrt(1.0 + 2.0 * lattice.curvature * start) - 1.0) / lattice.curvature;
    }
    return Steps(lattice, length, floor(uniform_start / length - lattice.shift), start, end);
}

// The next step, its beginning and its end; empty when there is none.
fn next_step(steps: ptr<function, Steps>) -> vec2<f32> {
    let t0 = (*steps).t0;
    while (t0 < (*steps).end) {
        (*steps).k += 1.0;
        let u = ((*steps).k + (*steps).lattice.shift) * (*steps).length;
        let t1 = min(u + 0.5 * (*steps).lattice.curvature * u * u, (*steps).end);
        if (t1 > t0) {
            (*steps).t0 = t1;
            return vec2<f32>(t0, t1);
        }
    }
    return vec2<f32>(0.0);
}

// Steps that are lit together: what they scatter of the camera's light, the same times t, and where they begin.
struct Group { share: f32, moment: f32, start: f32 }

// Steps that are lit together by one ray to the sky: what they scatter of the camera's light, where the ray begins, and the
// random number that decides whether it begins in the next step instead.
struct SkyGroup { share: f32, t: f32, random: f32 }

// Takes a step into a group, from a place of which the ray begins with the probability of its part of the share: so that a group
// of any size is worth what it scatters, where as many rays as are due would be none in most of what is thin.
fn with_step(group: SkyGroup, step: vec2<f32>, share: f32) -> SkyGroup {
    let sum = group.share + share;
    if (share <= 0.0) {
        return group;
    }
    let part = share / sum;
    if (group.random < part) {
        let within = group.random / part;
        return SkyGroup(sum, step.x + within * (step.y - step.x), within);
    }
    return SkyGroup(sum, group.t, (group.random - part) / (1.0 - part));
}

// How far a camera ray has got: what is kept while a shadow ray is followed. All else is made anew from the pixel, so that
// registers are free for the shadow ray.
struct Progress {
    has_begun: bool,
    // Where the walks through the densities and through what glows stand, and what is left of the runs that they found.
    walk: Walk,
    head: FoundRun,
    glow_walk: Walk,
    glow_head: FoundRun,
    // How many pieces there are still in a stretch of one value.
    pieces_left: f32,
    // The step that is being lit, the share of the camera's light that it takes, and up to where it is lit by the sun.
    step: vec2<f32>,
    share: f32,
    lit: f32,
    group: Group,
    // The share that all steps before took, and that at which the next ray goes to the sky.
    taken: f32,
    next_sky: f32,
    sky_index: u32,
    sky: SkyGroup,
    transmittance: f32,
    // Sums over all rays of the pixel: light, and the distances of steps, each times the share that it took.
    scattered: vec3<f32>,
    depth_moment: f32,
}

// A ray to a light, and what the light that passes along it is worth; without its colour.
struct ShadowRay { is_there: bool, is_to_sky: bool, worth: f32, ray: LocalRay, shift: f32 }

// Goes on along a camera ray to where the next shadow ray begins. Steps begin at a part `shift` of one.
fn next_shadow_ray(progress: ptr<function, Progress>, ray: Ray, max_distance: f32, random: u32, shift: f32) -> ShadowRay {
    var found = ShadowRay(false, false, 0.0, LocalRay(vec3<f32>(0.0), vec3<f32>(0.0), vec3<f32>(0.0)), 0.0);
    let density = field_of(DENSITY_CHANNEL);
    let glow = field_of(GLOW_CHANNEL);
    var density_span = field_interval(density, in_field(density, ray), 0.0);
    density_span.y = min(density_span.y, max_distance);
    let has_density = density_span.x < density_span.y;
    var glow_span = vec2<f32>(0.0);
    if (HAS_EMISSION) {
        glow_span = field_interval(glow, in_field(glow, ray), 0.0);
        glow_span.y = min(glow_span.y, max_distance);
    }
    let has_glow = glow_span.x < glow_span.y;
    if (!has_density && !has_glow) {
        (*progress).transmittance = 1.0;
        return found;
    }
    let start = min(select(MAX_F32, density_span.x, has_density), select(MAX_F32, glow_span.x, has_glow));
    let local = moved(density, ray, start);
    let glow_local = moved(glow, ray, start);
    let voxels_per_length = max(
        select(0.0, length(local.direction), has_density), select(0.0, length(glow_local.direction), has_glow),
    );
    let step_length = params.march.x / voxels_per_length;
    let lattice = Lattice(step_length, fract(shift - start / step_length), 0.0);
    let scatters = phase_between(params.media[0].phase, params.sun_direction.xyz, ray.direction);
    let has_sun = has_density && scatters > 0.0
        && any(params.sun_irradiance.xyz * params.media[0].albedo.xyz != vec3<f32>(0.0));
    let has_sky = has_density && params.march_rays.y > 0.0
        && any(params.sky_zenith.xyz * params.media[0].albedo.xyz != vec3<f32>(0.0));
    let scale = params.media[0].extinction.x;
    let shadow_field = field_of(SHADOW_CHANNEL);
    var shadow_local = local;
    if (SHADOW_CHANNEL != DENSITY_CHANNEL) {
        shadow_local = moved(shadow_field, ray, start);
    }
    let voxels_of_density = length(local.direction);

    if (!(*progress).has_begun) {
        let before = *progress;
        var begun: Progress;
        begun.has_begun = true;
        begun.scattered = before.scattered;
        begun.depth_moment = before.depth_moment;
        begun.transmittance = 1.0;
        begun.next_sky = sky_shift(random, shift) / max(params.march_rays.y, 1.0);
        begun.sky.random = sky_shift(random, shift);
        let span = density_span - start;
        begun.walk = walk_of(runs_between(density, local, span.x, select(span.x, span.y, has_density)));
        begun.head.is_there = true;
        if (HAS_EMISSION) {
            let span = glow_span - start;
            begun.glow_walk = walk_of(runs_between(glow, glow_local, span.x, select(span.x, span.y, has_glow)));
            begun.glow_head.is_there = true;
        }
        *progress = begun;
    }
    var now = *progress;
    var walker = new_accessor();
    var glow_walker = new_accessor();
    var runs = resumed(density, local, now.walk);
    var glow_runs = resumed(glow, glow_local, now.glow_walk);
    let full = 1.0 / params.march_rays.x;
    let full_sky = 1.0 / max(params.march_rays.y, 1.0);
    var t = 0.0;
    loop {
        if (is_spent()) {
            break;
        }
        var is_over = false;
        var is_sky_due = has_sky && now.taken + now.share > now.next_sky;
        if (GROUPS_SKY) {
            is_sky_due = now.sky.share >= full_sky;
        }
        if (now.lit >= now.step.y && !is_sky_due) {
            // The next step, of the runs of both channels, cut where either begins or ends.
            now.taken += now.share;
            now.share = 0.0;
            if (now.head.is_there && now.head.run.t0 >= now.head.run.t1) {
                now.head = next_run(&runs, &walker);
            }
            if (HAS_EMISSION && now.glow_head.is_there && now.glow_head.run.t0 >= now.glow_head.run.t1) {
                now.glow_head = next_run(&glow_runs, &glow_walker);
            }
            is_over = !(now.head.is_there || now.glow_head.is_there) || now.transmittance <= params.march.w;
            if (!is_over) {
                let head = now.head.run;
                let glow_head = now.glow_head.run;
                let t0 = min(select(MAX_F32, head.t0, now.head.is_there), select(MAX_F32, glow_head.t0, now.glow_head.is_there));
                let is_dense = now.head.is_there && head.t0 <= t0;
                let glows = now.glow_head.is_there && glow_head.t0 <= t0;
                let t1 = min(
                    select(MAX_F32, select(head.t0, head.t1, is_dense), now.head.is_there),
                    select(MAX_F32, select(glow_head.t0, glow_head.t1, glows), now.glow_head.is_there),
                );
                let density_varies = is_dense && head.is_varying;
                let glow_varies = glows && glow_head.is_varying;
                var value = select(0.0, head.value, is_dense);
                // Steps of the lattice where something varies, else pieces short enough to be lit.
                var end = t1;
                if (density_varies || glow_varies) {
                    var steps = steps_between(lattice, t0, t1);
                    end = next_step(&steps).y;
                } else {
                    if (now.pieces_left <= 0.0) {
                        let piece_depth = value * scale * (t1 - t0);
                        let wanted = max(piece_depth / LIT_PIECE_DEPTH, (t1 - t0) * voxels_per_length / LIT_PIECE_VOXELS);
                        let is_lit = (has_sun || has_sky) && piece_depth > 0.0;
                        now.pieces_left = select(1.0, clamp(ceil(wanted), 1.0, MOST_PIECES), is_lit);
                    }
                    end = select(t1, t0 + (t1 - t0) / now.pieces_left, now.pieces_left > 1.0);
                    now.pieces_left -= 1.0;
                }
                now.head.run.t0 = select(head.t0, end, is_dense);
                now.glow_head.run.t0 = select(glow_head.t0, end, glows);
                let middle = 0.5 * (t0 + end);
                if (density_varies) {
                    value = look_up(LOOKUP, density, &walker, ray_at(local, middle), three(random ^ bitcast<u32>(middle)));
                }
                let length = end - t0;
                let depth = min(value * scale * length, MAX_F32);
                let absorbed = one_minus_exp_neg(depth);
                if (HAS_EMISSION && glows) {
                    var glow_value = glow_head.value;
                    if (glow_varies) {
                        glow_value = look_up(MEAN_LOOKUP, glow, &glow_walker, ray_at(glow_local, middle), vec3<f32>(0.0));
                    }
                    let emitted = spectrum_radiance(params.media[0].emission, glow_value);
                    let seen = select(length * (absorbed / max(depth, MIN_F32)), length, depth <= 0.0);
                    now.scattered += now.transmittance * seen * emitted;
                }
                now.step = vec2<f32>(t0, end);
                now.share = now.transmittance * absorbed;
                now.lit = select(end, t0, has_sun && now.share > 0.0);
                if (GROUPS_SKY && has_sky) {
                    now.sky = with_step(now.sky, now.step, now.share);
                }
                now.depth_moment += now.share * (start + middle);
                now.transmittance *= 1.0 - absorbed;
            }
        }
        if (now.lit < now.step.y || is_over) {
            // Lit by the sun in groups. One is full in the midst of a step: what changes little is divided nearly the same.
            let begin = now.lit;
            var end = now.step.y;
            if (!is_over) {
                let missing = (full - now.group.share) / max(now.share, MIN_F32);
                let cut = now.step.x + missing * (now.step.y - now.step.x);
                let is_cut = begin == now.step.x && missing < 1.0 && now.share < full && cut > begin && cut < end;
                end = select(end, cut, is_cut);
                if (now.group.share == 0.0) {
                    now.group.start = begin;
                }
                let part = now.share * ((end - begin) / (now.step.y - now.step.x));
                now.group.share += part;
                now.group.moment += part * 0.5 * (begin + end);
            }
            now.lit = end;
            let longest = select(GROUP_VOXELS, FAINT_GROUP_VOXELS, now.group.share < FAINT_GROUP * full);
            let is_full = now.group.share >= full || end < now.step.y;
            let is_long = end - now.group.start >= longest / voxels_of_density;
            if ((is_full || is_long || is_over) && now.group.share > 0.0) {
                found.worth = now.group.share * scatters;
                t = now.group.moment / now.group.share;
                now.group = Group(0.0, 0.0, 0.0);
                if (!HAS_LIGHT_VOLUME) {
                    found.is_there = true;
                    break;
                }
                let sun = params.sun_irradiance.xyz * params.media[0].albedo.xyz;
                now.scattered += sun * (found.worth * cached_transmittance(ray_at(shadow_local, t)));
            }
            if (is_over && !(GROUPS_SKY && now.sky.share > 0.0)) {
                break;
            }
        }
        if (GROUPS_SKY) {
            if (now.sky.share > 0.0 && (is_over || (now.lit >= now.step.y && now.sky.share >= full_sky))) {
                t = now.sky.t;
                found.worth = now.sky.share;
                found.is_there = true;
                found.is_to_sky = true;
                now.sky.share = 0.0;
                now.sky_index += 1u;
                break;
            }
        } else if (now.lit >= now.step.y && has_sky && now.taken + now.share > now.next_sky) {
            let part = clamp((now.next_sky - now.taken) / now.share, 0.0, 1.0);
            t = now.step.x + part * (now.step.y - now.step.x);
            now.next_sky += 1.0 / params.march_rays.y;
            now.sky_index += 1u;
            found.worth = 1.0 / params.march_rays.y;
            found.is_there = true;
            found.is_to_sky = true;
            break;
        }
    }
    now.walk = walk_of(runs);
    now.glow_walk = walk_of(glow_runs);
    *progress = now;

    let voxel = u32(i32(floor((start + t) * voxels_of_density)));
    found.shift = unit_f32(hash_u32(random ^ hash_u32(voxel ^ (now.sky_index << 24u))));
    var direction = params.sun_direction.xyz;
    if (found.is_to_sky) {
        direction = sky_direction(ray.direction, random, now.sky_index - 1u);
    }
    found.ray = local_ray(ray_at(shadow_local, t), directions(shadow_field, direction));
    return found;
}

// A direction towards the sky, drawn from the phase function.
fn sky_direction(view: vec3<f32>, random: u32, index: u32) -> vec3<f32> {
    let start = hash_u32(random ^ SKY_DIRECTION_SEED);
    let u = vec2<f32>(unit_f32(start + index * PLASTIC_X), unit_f32(hash_u32(start) + index * PLASTIC_Y));
    return sample_phase(params.media[0].phase, view, u);
}

// The optical depth of a ray up to `end`, given up once it passes `limit`. It is not known yet where a passage is left.
fn optical_depth(
    field: u32, ray: LocalRay, end: f32, lattice: Lattice, scale: f32, limit: f32, passage: ptr<function, Passage>,
) -> f32 {
    var depth = 0.0;
    let seed = hash_u32(bitcast<u32>(lattice.shift));
    var accessor = new_accessor();
    var runs = runs_between(field, ray, 0.0, end);
    var left = FoundRun(false, Run(0.0, 0.0, true, 0.0));
    if (GOES_ON && (*passage).is_there) {
        runs = resumed(field, ray, (*passage).walk);
        left = (*passage).left;
        depth = (*passage).sum;
        (*passage).is_there = false;
    }
    loop {
        if (is_spent()) {
            *passage = Passage(true, walk_of(runs), left, vec3<f32>(0.0), depth);
            break;
        }
        var found = left;
        if (!GOES_ON || !left.is_there) {
            found = next_run(&runs, &accessor);
        }
        if (!found.is_there) {
            break;
        }
        left.is_there = false;
        if (found.run.is_varying) {
            var steps = steps_between(lattice, found.run.t0, found.run.t1);
            loop {
                let step = next_step(&steps);
                if (step.x >= step.y) {
                    break;
                }
                let t = 0.5 * (step.x + step.y);
                let value = look_up(LOOKUP, field, &accessor, ray_at(ray, t), three(seed ^ bitcast<u32>(t)));
                depth += value * scale * (step.y - step.x);
                if (depth > limit || is_spent()) {
                    break;
                }
            }
            if (GOES_ON) {
                left = FoundRun(steps.t0 < steps.end, Run(steps.t0, steps.end, true, 0.0));
            }
        } else {
            depth += found.run.value * scale * (found.run.t1 - found.run.t0);
        }
        if (depth > limit) {
            break;
        }
    }
    return depth;
}

// The share of the light from the direction of a ray that gets to where it begins, without steps.
fn exact_transmittance(field: u32, ray: LocalRay, passage: ptr<function, Passage>) -> f32 {
    var depth: f32;
    if (MEAN_LOOKUP == LOOKUP_NEAREST) {
        depth = voxel_integral(field, ray);
    } else {
        depth = line_integral(field, ray, field_exit(field, ray), passage);
    }
    return exp_(-params.media[0].extinction.x * depth);
}

// The light from the end of a shadow ray that gets to where it begins, and from there to the camera. It is not known yet where a
// passage is left.
fn light_through(shadow: ShadowRay, passage: ptr<function, Passage>) -> vec3<f32> {
    let field = field_of(SHADOW_CHANNEL);
    var passes: f32;
    if (HAS_EXACT_SHADOWS) {
        passes = exact_transmittance(field, shadow.ray, passage);
    } else {
        let step = params.march.y / length(shadow.ray.direction);
        let lattice = Lattice(step, shadow.shift, params.march.z / step);
        let end = field_exit(field, shadow.ray);
        let scale = params.media[0].extinction.x;
        passes = exp_(-optical_depth(field, shadow.ray, end, lattice, scale, params.march_rays.z, passage));
    }
    let colour = select(params.sun_irradiance.xyz, params.sky_zenith.xyz, shadow.is_to_sky);
    return colour * params.media[0].albedo.xyz * (shadow.worth * passes);
}

// Where in its pixel a sample lies.
fn pixel_offset(pixel: vec2<u32>, sample_index: u32, samples: u32) -> vec2<f32> {
    if (samples <= 1u) {
        return vec2<f32>(0.5);
    }
    return vec2<f32>(
        unit_f32(hash_pixel(pixel.x, pixel.y, 0u, 0u) + sample_index * PLASTIC_X),
        unit_f32(hash_pixel(pixel.x, pixel.y, 0u, 1u) + sample_index * PLASTIC_Y),
    );
}

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn march(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.marched.xy)) {
        return;
    }
    let samples = max(params.counts.x, 1u);
    var progress: Progress;
    var opacity = 0.0;
    var rays_left = params.rounds.w;
    for (var i = 0u; i < samples && rays_left > 0u; i++) {
        progress.has_begun = false;
        loop {
            let pixel = pixel_of_marched(id.xy);
            let ray = camera_ray(vec2<f32>(pixel) + pixel_offset(pixel, i, samples));
            let random = hash_pixel(pixel.x, pixel.y, i + samples * params.marched.w, 2u);
            let shadow = next_shadow_ray(&progress, ray, end_of(pixel, ray), random, step_shift(id.xy, random));
            if (!shadow.is_there || rays_left == 0u) {
                break;
            }
            var passage: Passage;
            progress.scattered += light_through(shadow, &passage);
            rays_left -= 1u;
        }
        opacity += 1.0 - progress.transmittance;
    }
    keep_depth(id.xy, progress.depth_moment / max(opacity, MIN_F32));
    let mean = vec4<f32>(progress.scattered, opacity) / f32(samples);
    store_or_mark(id.y * params.marched.x + id.x, vec4<f32>(0.0), mean, rays_left > 0u);
}
