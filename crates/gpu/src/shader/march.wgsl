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

// The light on the medium along one camera ray.
struct Lighting {
    // What shadow rays meet, and the camera ray there.
    field: u32,
    view: vec3<f32>,
    ray: LocalRay,
    voxels_to_start: f32,
    voxels_per_length: f32,
    sun: vec3<f32>,
    sun_direction: vec3<f32>,
    has_sun: bool,
    group: Group,
    sky: vec3<f32>,
    has_sky: bool,
    next_sky: f32,
    scattered: f32,
    sky_index: u32,
    random: u32,
}

// What shadow rays remember.
var<private> shadow_accessor: Accessor;

fn new_lighting(ray: Ray, start: f32, local: LocalRay, random: u32) -> Lighting {
    let field = field_of(SHADOW_CHANNEL);
    var lighting: Lighting;
    lighting.field = field;
    lighting.view = ray.direction;
    lighting.ray = local;
    if (SHADOW_CHANNEL != DENSITY_CHANNEL) {
        lighting.ray = moved(field, ray, start);
    }
    lighting.voxels_per_length = length(local.direction);
    lighting.voxels_to_start = start * lighting.voxels_per_length;
    let phase = params.media[0].phase;
    let scatters = phase_between(phase, params.sun_direction.xyz, ray.direction);
    lighting.sun = params.sun_irradiance.xyz * params.media[0].albedo.xyz * scatters;
    lighting.has_sun = any(lighting.sun != vec3<f32>(0.0));
    lighting.sun_direction = directions(field, params.sun_direction.xyz);
    lighting.sky = params.sky_zenith.xyz * params.media[0].albedo.xyz;
    lighting.has_sky = any(lighting.sky != vec3<f32>(0.0)) && params.march_rays.y > 0.0;
    lighting.next_sky = unit_f32(hash_u32(random ^ SKY_SEED)) / max(params.march_rays.y, 1.0);
    lighting.random = random;
    return lighting;
}

// The optical depth of a ray up to `end`, given up once it passes `limit`.
fn optical_depth(field: u32, ray: LocalRay, end: f32, lattice: Lattice, scale: f32, limit: f32) -> f32 {
    var depth = 0.0;
    let seed = hash_u32(bitcast<u32>(lattice.shift));
    var accessor = shadow_accessor;
    var runs = runs_between(field, ray, 0.0, end);
    loop {
        let found = next_run(&runs, &accessor);
        if (!found.is_there) {
            break;
        }
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
                if (depth > limit) {
                    break;
                }
            }
        } else {
            depth += found.run.value * scale * (found.run.t1 - found.run.t0);
        }
        if (depth > limit) {
            break;
        }
    }
    shadow_accessor = accessor;
    return depth;
}

// The share of the light from the direction of a ray that gets to where it begins, without steps.
fn exact_transmittance(field: u32, ray: LocalRay) -> f32 {
    var depth: f32;
    if (MEAN_LOOKUP == LOOKUP_NEAREST) {
        depth = voxel_integral(field, ray);
    } else {
        depth = line_integral(field, ray, field_exit(field, ray));
    }
    return exp_(-params.media[0].extinction.x * depth);
}

// The share of the light from a direction that gets to a place on the camera ray.
fn march_transmittance(lighting: ptr<function, Lighting>, t: f32, direction: vec3<f32>) -> f32 {
    let ray = local_ray(ray_at((*lighting).ray, t), direction);
    if (HAS_EXACT_SHADOWS) {
        return exact_transmittance((*lighting).field, ray);
    }
    let voxel = u32(i32(floor((*lighting).voxels_to_start + t * (*lighting).voxels_per_length)));
    let shift = unit_f32(hash_u32((*lighting).random ^ hash_u32(voxel ^ ((*lighting).sky_index << 24u))));
    let step = params.march.y / length(direction);
    let lattice = Lattice(step, shift, params.march.z / step);
    let end = field_exit((*lighting).field, ray);
    let depth = optical_depth((*lighting).field, ray, end, lattice, params.media[0].extinction.x, params.march_rays.z);
    return exp_(-depth);
}

// The next direction towards the sky, in the field's positions, drawn from the phase function.
fn sky_direction(lighting: ptr<function, Lighting>) -> vec3<f32> {
    let start = hash_u32((*lighting).random ^ SKY_DIRECTION_SEED);
    let index = (*lighting).sky_index;
    let u = vec2<f32>(unit_f32(start + index * PLASTIC_X), unit_f32(hash_u32(start) + index * PLASTIC_Y));
    (*lighting).sky_index += 1u;
    return directions((*lighting).field, sample_phase(params.media[0].phase, (*lighting).view, u));
}

// The light scattered towards the camera by a step that accounts for `share` of the camera's light, or by a group of
// steps that ends with it. The last step accounts for nothing, and ends what is left of a group.
fn step_light(lighting: ptr<function, Lighting>, t0: f32, t1: f32, share: f32, is_last: bool) -> vec3<f32> {
    var light = vec3<f32>(0.0);
    let full = 1.0 / params.march_rays.x;
    let missing = (full - (*lighting).group.share) / max(share, MIN_F32);
    // A group is full in the midst of a step: what changes little is divided nearly the same.
    let cut = select(t1, t0 + missing * (t1 - t0), missing < 1.0 && share < full && !is_last);
    let before = (*lighting).scattered;
    (*lighting).scattered += share;
    // The parts of the step before and after the cut, then rays to the sky: one shadow ray at most in each turn.
    var part = select(2u, 0u, (*lighting).has_sun);
    loop {
        var radiance = vec3<f32>(0.0);
        var t = 0.0;
        var direction = (*lighting).sun_direction;
        if (part < 2u) {
            let begin = select(t0, cut, part == 1u);
            let end = select(cut, t1, part == 1u);
            part += 1u;
            if (begin >= end && !is_last) {
                continue;
            }
            if ((*lighting).group.share == 0.0) {
                (*lighting).group.start = begin;
            }
            if (!is_last) {
                let part_share = share * ((end - begin) / (t1 - t0));
                (*lighting).group.share += part_share;
                (*lighting).group.moment += part_share * 0.5 * (begin + end);
            }
            let group = (*lighting).group;
            let is_full = group.share >= full || (end == cut && cut < t1);
            let longest = select(GROUP_VOXELS, FAINT_GROUP_VOXELS, group.share < FAINT_GROUP * full);
            let is_long = end - group.start >= longest / (*lighting).voxels_per_length;
            if (!(is_full || is_long || is_last)) {
                continue;
            }
            (*lighting).group = Group(0.0, 0.0, 0.0);
            if (group.share <= 0.0) {
                continue;
            }
            radiance = (*lighting).sun * group.share;
            t = group.moment / group.share;
            if (HAS_LIGHT_VOLUME) {
                light += radiance * cached_transmittance(ray_at((*lighting).ray, t));
                continue;
            }
        } else {
            if (!(*lighting).has_sky || (*lighting).scattered <= (*lighting).next_sky) {
                break;
            }
            let rays = params.march_rays.y;
            t = t0 + clamp(((*lighting).next_sky - before) / share, 0.0, 1.0) * (t1 - t0);
            (*lighting).next_sky += 1.0 / rays;
            direction = sky_direction(lighting);
            radiance = (*lighting).sky / rays;
        }
        light += radiance * march_transmittance(lighting, t, direction);
    }
    return light;
}

// How far away the steps of the last ray were, each times the share of the camera's light that it took.
var<private> depth_moment: f32;

// The light from the medium along a ray, and the share of the light behind it that passes. Steps begin at a part `shift` of
// one.
fn march_radiance(ray: Ray, max_distance: f32, random: u32, shift: f32) -> vec4<f32> {
    depth_moment = 0.0;
    var scattered = vec3<f32>(0.0);
    var transmittance = 1.0;
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
        return vec4<f32>(scattered, transmittance);
    }
    let start = min(select(MAX_F32, density_span.x, has_density), select(MAX_F32, glow_span.x, has_glow));
    density_span = density_span - start;
    glow_span = glow_span - start;
    let local = moved(density, ray, start);
    let glow_local = moved(glow, ray, start);
    let voxels_per_length = max(
        select(0.0, length(local.direction), has_density), select(0.0, length(glow_local.direction), has_glow),
    );
    let step_length = params.march.x / voxels_per_length;
    let lattice = Lattice(step_length, fract(shift - start / step_length), 0.0);
    var lighting = new_lighting(ray, start, local, random);
    lighting.has_sun = lighting.has_sun && has_density;
    lighting.has_sky = lighting.has_sky && has_density;
    let is_lit = lighting.has_sun || lighting.has_sky;
    let scale = params.media[0].extinction.x;

    var walker = new_accessor();
    var glow_walker = new_accessor();
    shadow_accessor = new_accessor();
    var runs = runs_between(density, local, density_span.x, select(density_span.x, density_span.y, has_density));
    var glow_runs = runs_between(glow, glow_local, glow_span.x, select(glow_span.x, glow_span.y, has_glow));
    // The runs of both channels, cut where either begins or ends, and a last turn that ends what is lit together.
    var head = FoundRun(true, Run(0.0, 0.0, false, 0.0));
    var glow_head = FoundRun(HAS_EMISSION, Run(0.0, 0.0, false, 0.0));
    var is_last = false;
    while (!is_last) {
        if (head.is_there && head.run.t0 >= head.run.t1) {
            head = next_run(&runs, &walker);
        }
        if (HAS_EMISSION && glow_head.is_there && glow_head.run.t0 >= glow_head.run.t1) {
            glow_head = next_run(&glow_runs, &glow_walker);
        }
        is_last = !(head.is_there || glow_head.is_there) || transmittance <= params.march.w;
        // The next piece: it ends where a run that covers its start ends, or where another begins.
        let t0 = min(select(MAX_F32, head.run.t0, head.is_there), select(MAX_F32, glow_head.run.t0, glow_head.is_there));
        let is_dense = !is_last && head.is_there && head.run.t0 <= t0;
        let glows = !is_last && glow_head.is_there && glow_head.run.t0 <= t0;
        var t1 = MAX_F32;
        if (head.is_there) {
            t1 = select(head.run.t0, head.run.t1, is_dense);
        }
        if (glow_head.is_there) {
            t1 = min(t1, select(glow_head.run.t0, glow_head.run.t1, glows));
        }
        let density_varies = is_dense && head.run.is_varying;
        let glow_varies = glows && glow_head.run.is_varying;
        let constant_density = select(0.0, head.run.value, is_dense);
        let constant_glow = select(0.0, glow_head.run.value, glows);

        // Steps of the lattice where something varies, else pieces short enough to be lit.
        let is_varying = density_varies || glow_varies;
        var steps = steps_between(lattice, t0, t1);
        var pieces = 1.0;
        let piece_depth = constant_density * scale * (t1 - t0);
        if (!is_varying && is_lit && piece_depth > 0.0) {
            let wanted = max(piece_depth / LIT_PIECE_DEPTH, (t1 - t0) * voxels_per_length / LIT_PIECE_VOXELS);
            pieces = clamp(ceil(wanted), 1.0, MOST_PIECES);
        }
        var piece = 0.0;
        loop {
            var step: vec2<f32>;
            if (is_varying) {
                step = next_step(&steps);
                if (step.x >= step.y) {
                    break;
                }
            } else {
                if (piece >= pieces) {
                    break;
                }
                let length = t1 - t0;
                step = vec2<f32>(
                    select(t1, t0 + length * (piece / pieces), piece < pieces),
                    select(t1, t0 + length * ((piece + 1.0) / pieces), piece + 1.0 < pieces),
                );
                piece += 1.0;
            }
            let t = 0.5 * (step.x + step.y);
            var value = constant_density;
            if (density_varies) {
                value = look_up(LOOKUP, density, &walker, ray_at(local, t), three(random ^ bitcast<u32>(t)));
            }
            var emitted = vec3<f32>(0.0);
            if (HAS_EMISSION && glows) {
                var glow_value = constant_glow;
                if (glow_varies) {
                    glow_value = look_up(MEAN_LOOKUP, glow, &glow_walker, ray_at(glow_local, t), vec3<f32>(0.0));
                }
                emitted = spectrum_radiance(params.media[0].emission, glow_value);
            }
            let length = step.y - step.x;
            let depth = min(value * scale * length, MAX_F32);
            if (depth <= 0.0 && !is_last) {
                scattered += transmittance * length * emitted;
                continue;
            }
            let absorbed = one_minus_exp_neg(depth);
            let share = transmittance * absorbed;
            depth_moment += share * (start + t);
            if (is_lit) {
                scattered += step_light(&lighting, step.x, step.y, share, is_last);
            }
            if (is_last) {
                break;
            }
            scattered += transmittance * (length * (absorbed / depth)) * emitted;
            transmittance *= 1.0 - absorbed;
            if (transmittance <= params.march.w) {
                break;
            }
        }

        head.run.t0 = select(head.run.t0, t1, is_dense);
        glow_head.run.t0 = select(glow_head.run.t0, t1, glows);
    }
    return vec4<f32>(scattered, transmittance);
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
    let pixel = pixel_of_marched(id.xy);
    let samples = max(params.counts.x, 1u);
    var sum = vec4<f32>(0.0);
    var depth = 0.0;
    for (var i = 0u; i < samples; i++) {
        let ray = camera_ray(vec2<f32>(pixel) + pixel_offset(pixel, i, samples));
        let random = hash_pixel(pixel.x, pixel.y, i + samples * params.marched.w, 2u);
        let light = march_radiance(ray, end_of(pixel, ray), random, step_shift(id.xy, random));
        sum += vec4<f32>(light.xyz, 1.0 - light.w);
        depth += depth_moment;
    }
    keep_depth(id.xy, depth / max(sum.w, MIN_F32));
    picture[id.y * params.marched.x + id.x] = sum / f32(samples);
}
