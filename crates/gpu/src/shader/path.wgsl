// The path tracer: the estimator of nuage_render::path, without the control variates that only quieten it.

// The light of a light that a point scatters along `before`, over the share of light that it scatters at all.
fn light_at(
    light: Light, phase: Phase, at: vec3<f32>, before: vec3<f32>, random: ptr<function, Random>,
) -> vec3<f32> {
    let arrives = arriving(light, at);
    if (all(arrives.light <= vec3<f32>(0.0))) {
        return vec3<f32>(0.0);
    }
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

// A path as far as it is known: where it goes on, what it is worth there, the light that it found, how often it was scattered,
// and whether it met the medium.
struct Path {
    is_over: bool,
    ray: Ray,
    carried: Carried,
    light: vec3<f32>,
    scatterings: u32,
    met: f32,
    random: Random,
}

fn new_path(ray: Ray, seed: u32) -> Path {
    let carried = Carried(vec3<f32>(1.0), vec3<f32>(1.0));
    return Path(false, ray, carried, vec3<f32>(0.0), 0u, 0.0, Random(seed, 0u));
}

// Follows a path to its end, or until a dispatch has done its share. The camera sees as far as `limit`.
fn follow(path: ptr<function, Path>, limit: f32) {
    var random = (*path).random;
    var carried = (*path).carried;
    var light = (*path).light;
    var ray = (*path).ray;
    var scatterings = (*path).scatterings;
    var met = (*path).met;
    var is_over = false;
    while (!is_spent() && (GOES_ON || scatterings < params.rounds.w)) {
        let is_far = scatterings > 0u;
        let collision = fly(ray, select(limit, MAX_F32, is_far), is_far, &carried, &light, &random);
        let distance = collision.distance;
        if (distance < 0.0) {
            // What each collision looks for is not found a second time.
            if (is_far && !HAS_SKY_RAYS) {
                light += carried.weight * carried.colours * sky_radiance(ray.direction);
            }
            is_over = true;
            break;
        }
        met = 1.0;
        if (scatterings >= params.counts.y || has_drawn_enough(&random)) {
            is_over = true;
            break;
        }
        let phase = params.media[collision.medium].phase;
        carried.weight *= params.media[collision.medium].albedo.xyz;
        scatterings += 1u;
        let chance = max_component(carried.weight * carried.colours) / ROULETTE_WEIGHT;
        if (chance < 1.0) {
            if (random_unit(&random) >= chance) {
                is_over = true;
                break;
            }
            carried.weight /= chance;
        }
        let at = ray.origin + ray.direction * distance;
        let worth = carried.weight * carried.colours;
        for (var i = 0u; i < params.counts.w; i++) {
            light += worth * light_at(params.lights[i], phase, at, ray.direction, &random);
        }
        if (HAS_SKY_RAYS) {
            light += worth * mapped(phase, at, ray.direction, &random);
        }
        let u = vec2<f32>(random_unit(&random), random_unit(&random));
        ray = Ray(at, sample_phase(phase, ray.direction, u));
    }
    *path = Path(is_over, ray, carried, light, scatterings, met, random);
}

// Where the camera ray of a path, the number of which is `params.size.w`, goes through a pixel.
fn path_ray(pixel: vec2<u32>) -> Ray {
    let number = params.size.w;
    let offset = vec2<f32>(
        unit_f32(hash_pixel(pixel.x, pixel.y, number, 0u)), unit_f32(hash_pixel(pixel.x, pixel.y, number, 1u)),
    );
    return camera_ray(vec2<f32>(pixel) + offset);
}

fn path_seed(pixel: vec2<u32>) -> u32 {
    return hash_pixel(pixel.x, pixel.y, params.size.w, 2u);
}

// Adds a path to the sums of the picture.
@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn path(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let ray = path_ray(id.xy);
    var path = new_path(ray, path_seed(id.xy));
    follow(&path, end_of(id.xy, ray));
    let number = id.y * params.size.x + id.x;
    let before = picture[number];
    store_or_mark(number, before, before + vec4<f32>(path.light, path.met), path.is_over);
}
