// The path tracer: the estimator of nuage_render::path for one grid, without the control variates that only quieten it.

// What a path is worth: what light is multiplied by, and the share of each colour in its chance, times three.
struct Carried { weight: vec3<f32>, colours: vec3<f32> }

// Takes one of two turns, `part` for a colour being its chance there.
fn turns(carried: ptr<function, Carried>, part: vec3<f32>, random: ptr<function, Random>) -> bool {
    let taken = (*carried).colours * part;
    let chance = (taken.x + taken.y + taken.z) / 3.0;
    let is_taken = random_unit(random) < chance;
    let left = select((*carried).colours - taken, taken, is_taken);
    let own_chance = select(1.0 - chance, chance, is_taken);
    if (own_chance > 0.0) {
        (*carried).colours = max(left, vec3<f32>(0.0)) / own_chance;
    }
    return is_taken;
}

// What the medium emits along a stretch of a ray, one sample for each brick.
fn emitted_between(ray: Ray, begin: f32, end: f32, random: ptr<function, Random>) -> vec3<f32> {
    let field = field_of(GLOW_CHANNEL);
    let span = field_interval(field, in_field(field, ray), 0.0);
    let start = max(span.x, begin);
    let length = min(span.y, end) - start;
    var light = vec3<f32>(0.0);
    if (length <= 0.0) {
        return light;
    }
    let local = moved(field, ray, start);
    var accessor = new_accessor();
    var runs = runs_between(field, local, 0.0, length);
    loop {
        let segment = next_segment(&runs, &accessor);
        if (!segment.is_there) {
            break;
        }
        let length = segment.t1 - segment.t0;
        let t = segment.t0 + random_unit(random) * length;
        light += spectrum_radiance(trilinear(field, &accessor, ray_at(local, t))) * length;
    }
    return light;
}

// Where a ray collides, by delta tracking; negative if it leaves the medium before `limit`. What is emitted on the way is
// added to `emitted`.
fn fly(
    ray: Ray, limit: f32, carried: ptr<function, Carried>, emitted: ptr<function, vec3<f32>>,
    random: ptr<function, Random>,
) -> f32 {
    let field = field_of(DENSITY_CHANNEL);
    let shares = params.extinction.xyz / params.extinction.w;
    let span = field_interval(field, in_field(field, ray), 0.0);
    let length = min(span.y, limit) - span.x;
    var told = 0.0;
    var collision = -1.0;
    if (length > 0.0) {
        let local = moved(field, ray, span.x);
        var accessor = new_accessor();
        var runs = runs_between(field, local, 0.0, length);
        var depth = random_depth(random);
        loop {
            let segment = next_segment(&runs, &accessor);
            if (!segment.is_there || collision >= 0.0) {
                break;
            }
            let majorant = segment.max * params.extinction.w;
            var t = segment.t0;
            loop {
                let left = (segment.t1 - t) * majorant;
                if (depth >= left) {
                    depth -= left;
                    break;
                }
                t += depth / majorant;
                var part = 1.0;
                if (segment.min != segment.max) {
                    part = min(trilinear(field, &accessor, ray_at(local, t)) / segment.max, 1.0);
                }
                var is_real: bool;
                if (IS_GREY) {
                    is_real = random_unit(random) < part;
                } else {
                    if (HAS_EMISSION) {
                        let worth = (*carried).weight * (*carried).colours;
                        *emitted += worth * emitted_between(ray, told, span.x + t, random);
                        told = span.x + t;
                    }
                    is_real = turns(carried, shares * part, random);
                }
                if (is_real) {
                    collision = span.x + t;
                    break;
                }
                depth = random_depth(random);
            }
        }
    }
    if (HAS_EMISSION) {
        let end = select(limit, collision, collision >= 0.0);
        *emitted += (*carried).weight * (*carried).colours * emitted_between(ray, told, end, random);
    }
    return collision;
}

// A vector whose mean is the share of light that passes along a ray up to a distance, by residual ratio tracking.
fn transmittance(ray: Ray, limit: f32, random: ptr<function, Random>) -> vec3<f32> {
    let field = field_of(DENSITY_CHANNEL);
    let scale = params.extinction.w;
    let shares = params.extinction.xyz / scale;
    let span = field_interval(field, in_field(field, ray), 0.0);
    var ratio = vec3<f32>(1.0);
    let end = min(span.y, limit);
    if (span.x >= end) {
        return ratio;
    }
    let local = moved(field, ray, span.x);
    var accessor = new_accessor();
    var runs = runs_between(field, local, 0.0, end - span.x);
    var known = 0.0;
    var depth = random_depth(random);
    loop {
        let segment = next_segment(&runs, &accessor);
        if (!segment.is_there) {
            break;
        }
        let residual = segment.max - segment.min;
        if (residual * scale > OPAQUE) {
            return vec3<f32>(0.0);
        }
        known += segment.min * scale * (segment.t1 - segment.t0);
        var t = segment.t0;
        loop {
            let left = (segment.t1 - t) * residual * scale;
            if (depth >= left) {
                depth -= left;
                break;
            }
            t += depth / (residual * scale);
            let part = (trilinear(field, &accessor, ray_at(local, t)) - segment.min) / residual;
            ratio *= max(1.0 - part * shares, vec3<f32>(0.0));
            depth = random_depth(random);
        }
        let now = ratio * passing(known, shares);
        let most = max_component(now);
        if (most < ROULETTE_TRANSMITTANCE) {
            if (random_unit(random) * ROULETTE_TRANSMITTANCE >= most) {
                return vec3<f32>(0.0);
            }
            ratio = select(vec3<f32>(ROULETTE_TRANSMITTANCE), now * (ROULETTE_TRANSMITTANCE / most), now < vec3<f32>(most));
            known = 0.0;
        }
    }
    return ratio * passing(known, shares);
}

fn passing(depth: f32, shares: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(exp_(-depth * shares.x), exp_(-depth * shares.y), exp_(-depth * shares.z));
}

// The light of a light that a point scatters along `before`, over the share of light that it scatters at all.
fn light_at(light: Light, at: vec3<f32>, before: vec3<f32>, random: ptr<function, Random>) -> vec3<f32> {
    let arrives = arriving(light, at);
    if (all(arrives.light <= vec3<f32>(0.0))) {
        return vec3<f32>(0.0);
    }
    let phase = params.phase;
    var direction = arrives.direction;
    var limit = arrives.distance;
    var inverse_density = 1.0;
    if (arrives.spread > 0.0) {
        // Where the phase function has a peak narrower than the light, that is looked for as well.
        let solid_angle = TAU * arrives.spread;
        let peak = max(phase_at(phase, Angle(0.0, 2.0)), phase_at(phase, Angle(2.0, 0.0)));
        let is_narrower = peak * solid_angle > 1.0;
        var takes_phase = false;
        if (is_narrower) {
            takes_phase = random_unit(random) < 0.5;
        }
        let u = vec2<f32>(random_unit(random), random_unit(random));
        if (takes_phase) {
            direction = sample_phase(phase, before, u);
            let apart = direction - arrives.direction;
            if (dot(apart, apart) > 2.0 * arrives.spread) {
                return vec3<f32>(0.0);
            }
        } else {
            direction = sample_cone(arrives.direction, arrives.spread, u);
        }
        let even = 1.0 / solid_angle;
        let density = select(even, 0.5 * (phase_between(phase, before, direction) + even), is_narrower);
        inverse_density = 1.0 / density;
        if (u32(light.place.w) == LIGHT_SPHERE) {
            limit = distance_to_sphere(light, at, direction);
        }
    }
    let scatters = phase_between(phase, before, direction) * inverse_density;
    return arrives.light * scatters * transmittance(Ray(at, direction), limit, random);
}

// The light that one path finds along a ray, and whether it met the medium.
fn path_light(first: Ray, limit: f32, seed: u32) -> vec4<f32> {
    var random = Random(seed, 0u);
    var carried = Carried(vec3<f32>(1.0), vec3<f32>(1.0));
    var light = vec3<f32>(0.0);
    var ray = first;
    var scatterings = 0u;
    var met = 0.0;
    loop {
        let distance = fly(ray, select(MAX_F32, limit, scatterings == 0u), &carried, &light, &random);
        if (distance < 0.0) {
            if (scatterings > 0u) {
                light += carried.weight * carried.colours * sky_radiance(ray.direction);
            }
            break;
        }
        met = 1.0;
        if (scatterings >= params.counts.y) {
            break;
        }
        carried.weight *= params.albedo.xyz;
        scatterings += 1u;
        let chance = max_component(carried.weight * carried.colours) / ROULETTE_WEIGHT;
        if (chance < 1.0) {
            if (random_unit(&random) >= chance) {
                break;
            }
            carried.weight /= chance;
        }
        let at = ray.origin + ray.direction * distance;
        let worth = carried.weight * carried.colours;
        for (var i = 0u; i < params.counts.w; i++) {
            light += worth * light_at(params.lights[i], at, ray.direction, &random);
        }
        let u = vec2<f32>(random_unit(&random), random_unit(&random));
        ray = Ray(at, sample_phase(params.phase, ray.direction, u));
    }
    return vec4<f32>(light, met);
}

// Adds a path, the number of which is `params.size.w`, to the sums of the picture.
@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn path(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let number = params.size.w;
    let offset = vec2<f32>(
        unit_f32(hash_pixel(id.x, id.y, number, 0u)), unit_f32(hash_pixel(id.x, id.y, number, 1u)),
    );
    let ray = camera_ray(vec2<f32>(id.xy) + offset);
    let light = path_light(ray, end_of(id.xy, ray), hash_pixel(id.x, id.y, number, 2u));
    store(id.xy, picture[id.y * params.size.x + id.x] + light);
}
