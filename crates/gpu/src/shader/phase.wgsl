// Phase functions: nuage_render::phase. A `Phase` is two lobes: a Henyey–Greenstein one, and Draine's with a weight.

struct Phase { spike_g: f32, body_g: f32, body_alpha: f32, body_weight: f32 }

// 1 - cos and 1 + cos of a scattering angle.
struct Angle { ahead: f32, behind: f32 }

fn angle_between(before: vec3<f32>, after: vec3<f32>) -> Angle {
    let apart = after - before;
    let together = after + before;
    return Angle(dot(apart, apart) / 2.0, dot(together, together) / 2.0);
}

fn hg_at(angle: Angle, g: f32) -> f32 {
    let a = abs(clamp(g, -MAX_ASYMMETRY, MAX_ASYMMETRY));
    let from_peak = select(angle.ahead, angle.behind, g < 0.0);
    let squared = (1.0 - a) * (1.0 - a) + 2.0 * a * from_peak;
    return (1.0 - a) * (1.0 + a) / (4.0 * PI * squared * sqrt(squared));
}

fn hg_from_peak(a: f32, u: f32) -> f32 {
    let ratio = (1.0 - a) / (1.0 - a + 2.0 * a * u);
    return 2.0 * ratio * ratio * (1.0 - u) * (1.0 + a * u);
}

fn sample_hg_angle(g: f32, u: f32) -> Angle {
    let a = abs(clamp(g, -MAX_ASYMMETRY, MAX_ASYMMETRY));
    if (g < 0.0) {
        let behind = hg_from_peak(a, 1.0 - u);
        return Angle(2.0 - behind, behind);
    }
    let ahead = hg_from_peak(a, u);
    return Angle(ahead, 2.0 - ahead);
}

// The mean of 1 + alpha cos² over the Henyey–Greenstein lobe.
fn draine_norm(g: f32, alpha: f32) -> f32 {
    return 1.0 + alpha * (1.0 + 2.0 * g * g) / 3.0;
}

fn draine_at(angle: Angle, g_unlimited: f32, alpha_unlimited: f32) -> f32 {
    let g = clamp(g_unlimited, -MAX_ASYMMETRY, MAX_ASYMMETRY);
    let alpha = clamp(alpha_unlimited, 0.0, MAX_ALPHA);
    let cosine = (angle.behind - angle.ahead) / 2.0;
    return hg_at(angle, g) * (1.0 + alpha * cosine * cosine) / draine_norm(g, alpha);
}

// The integral of cos² from 0 to t, and the cosine at t.
fn squared_cosine(a: f32, t: f32) -> vec2<f32> {
    let e = 1.0 + a * a;
    let f = e - a;
    let q = 1.0 - a + 2.0 * a * t;
    let d = (1.0 - a) / q;
    let s = t / q;
    let cosine = 2.0 * e * s * (a * s + d) - d * d;
    let cubic = d * (d * (d - 2.0 * f * s) + 4.0 / 3.0 * f * f * s * s) + 2.0 * a * e * e * s * s * s;
    return vec2<f32>(t * cubic, cosine);
}

fn draine_sample(g_unlimited: f32, alpha_unlimited: f32, u_forward: f32) -> Angle {
    let g = clamp(g_unlimited, -MAX_ASYMMETRY, MAX_ASYMMETRY);
    let alpha = clamp(alpha_unlimited, 0.0, MAX_ALPHA);
    let a = abs(g);
    let u = select(u_forward, 1.0 - u_forward, g < 0.0);
    let whole = draine_norm(a, alpha);
    var low = 0.0;
    var high = 1.0;
    var t = u;
    for (var i = 0u; i < DRAINE_MAX_STEPS; i++) {
        let at = squared_cosine(a, t);
        let excess = t + alpha * at.x - u * whole;
        if (abs(excess) <= DRAINE_TOLERANCE * whole) {
            break;
        }
        if (excess > 0.0) { high = t; } else { low = t; }
        let next = t - excess / (1.0 + alpha * at.y * at.y);
        t = select((low + high) / 2.0, next, next > low && next < high);
    }
    return sample_hg_angle(g, select(t, 1.0 - t, g < 0.0));
}

fn phase_at(phase: Phase, angle: Angle) -> f32 {
    var value = 0.0;
    if (phase.body_weight < 1.0) {
        value = (1.0 - phase.body_weight) * hg_at(angle, phase.spike_g);
    }
    if (phase.body_weight > 0.0) {
        value += phase.body_weight * draine_at(angle, phase.body_g, phase.body_alpha);
    }
    return value;
}

fn phase_between(phase: Phase, before: vec3<f32>, after: vec3<f32>) -> f32 {
    return phase_at(phase, angle_between(before, after));
}

// Two unit vectors that form a frame with `axis`: across it and across both.
struct Frame { tangent: vec3<f32>, bitangent: vec3<f32> }

fn tangent_frame(axis: vec3<f32>) -> Frame {
    let s = select(1.0, -1.0, axis.z < 0.0);
    let k = -1.0 / (s + axis.z);
    let xy = axis.x * axis.y * k;
    let tangent = vec3<f32>(1.0 + s * axis.x * axis.x * k, s * xy, -s * axis.x);
    return Frame(tangent, vec3<f32>(xy, s + axis.y * axis.y * k, -axis.y));
}

// The direction at an angle from another, `turns` around it.
fn around(direction: vec3<f32>, angle: Angle, turns: f32) -> vec3<f32> {
    let sin_theta = sqrt(max(angle.ahead * angle.behind, 0.0));
    let turn = sin_cos_turns(turns);
    let frame = tangent_frame(direction);
    let across = frame.tangent * (sin_theta * turn.y) + frame.bitangent * (sin_theta * turn.x);
    return normalize(direction * (1.0 - angle.ahead) + across);
}

fn sample_phase(phase: Phase, before: vec3<f32>, u: vec2<f32>) -> vec3<f32> {
    var angle: Angle;
    if (u.x < phase.body_weight) {
        angle = draine_sample(phase.body_g, phase.body_alpha, u.x / phase.body_weight);
    } else {
        angle = sample_hg_angle(phase.spike_g, (u.x - phase.body_weight) / (1.0 - phase.body_weight));
    }
    return around(before, angle, u.y);
}
