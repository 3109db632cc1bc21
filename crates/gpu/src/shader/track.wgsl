// What paths know of one medium along a ray: nuage_render::path.

// What a path is worth: what light is multiplied by, and the share of each colour in its chance, times three.
struct Carried { weight: vec3<f32>, colours: vec3<f32> }

// Where a path collides, and with which medium; a negative distance if it leaves them all.
struct Collision { distance: f32, medium: u32 }

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

// The extinction of each colour as a share of the strongest.
fn shares_of(medium: u32) -> vec3<f32> {
    let extinction = params.media[medium].extinction;
    return extinction.xyz / extinction.w;
}

// The field of a medium that rays from the camera meet, or those of scattered light.
fn field_of_medium(medium: u32, is_far: bool) -> u32 {
    let kind = params.media[medium].kind;
    return field_of(select(kind.y, kind.z, is_far));
}

// What a field emits along a stretch of a ray, one sample for each brick.
fn emitted_in_field(
    field: u32, emission: vec4<f32>, ray: Ray, begin: f32, end: f32, random: ptr<function, Random>,
) -> vec3<f32> {
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
        // What glows is not linear in what is looked up, so that a voxel at random would not do.
        let value = look_up(MEAN_LOOKUP, field, &accessor, ray_at(local, t), vec3<f32>(0.0));
        light += spectrum_radiance(emission, value) * length;
    }
    return light;
}

// What the media emit along a stretch of a ray.
fn emitted(ray: Ray, begin: f32, end: f32, random: ptr<function, Random>) -> vec3<f32> {
    var light = vec3<f32>(0.0);
    for (var i = 0u; i < MEDIA; i++) {
        let glow = params.media[i].kind.w;
        let emission = params.media[i].emission;
        if (glow == NONE) {
            continue;
        }
        if (HAS_SOLIDS && glow == SOLID_CHANNEL) {
            let span = solid_interval(i, ray);
            light += spectrum_radiance(emission, 1.0) * max(min(span.y, end) - max(span.x, begin), 0.0);
        } else {
            light += emitted_in_field(field_of(glow), emission, ray, begin, end, random);
        }
    }
    return light;
}

// A vector whose mean is the share of light that passes along a ray through a field up to a distance, by residual ratio
// tracking.
fn pass_field(field: u32, medium: u32, ray: Ray, limit: f32, random: ptr<function, Random>) -> vec3<f32> {
    let scale = params.media[medium].extinction.w;
    let shares = shares_of(medium);
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
            if (has_drawn_enough(random)) {
                return vec3<f32>(0.0);
            }
            if (depth >= left) {
                depth -= left;
                break;
            }
            t += depth / (residual * scale);
            let value = look_up(LOOKUP, field, &accessor, ray_at(local, t), random_3d(random));
            let part = (value - segment.min) / residual;
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
