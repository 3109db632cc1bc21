// Elementary functions as polynomials: nuage_render::math, operation by operation.

// e^x as 2^n (1 + q): q, and n in the low nine bits of the second value.
struct Reduced { q: f32, n: u32 }

fn reduce(x: f32) -> Reduced {
    // Rounded by name: drivers take adding and subtracting a large number for nothing.
    let n = round(x * LOG2_E);
    let r = (x - n * LN_2_HIGH) - n * LN_2_LOW;
    let rr = r * r;
    let high = (EXP_SERIES_2 + EXP_SERIES_3 * r) + rr * EXP_SERIES_4;
    let p = (EXP_SERIES_0 + EXP_SERIES_1 * r) + rr * high;
    return Reduced(r + rr * p, u32(i32(n)));
}

// What is beyond the largest float is the largest float here: WGSL promises no infinities.
fn exp_(x: f32) -> f32 {
    let reduced = reduce(clamp(x, EXP_LOWEST, EXP_HIGHEST));
    let scaled = bitcast<f32>(bitcast<u32>(1.0 + reduced.q) + (reduced.n << 23u));
    return select(select(scaled, MAX_F32, x > EXP_HIGHEST), 0.0, x < EXP_LOWEST);
}

fn one_minus_exp_neg(tau: f32) -> f32 {
    let reduced = reduce(-clamp(tau, 0.0, OPAQUE_DEPTH));
    let scale = bitcast<f32>(bitcast<u32>(1.0) + (reduced.n << 23u));
    let value = (1.0 - scale) - scale * reduced.q;
    return select(select(value, 1.0, tau > OPAQUE_DEPTH), 0.0, tau <= 0.0);
}

fn ln(x: f32) -> f32 {
    let bits = bitcast<i32>(x) - ROOT_HALF;
    let exponent = f32(bits >> 23u);
    let mantissa = bitcast<f32>((bits & 0x007fffff) + ROOT_HALF);
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let s2 = s * s;
    let series = s2 * (LN_SERIES_0 + s2 * (LN_SERIES_1 + s2 * (LN_SERIES_2 + s2 * LN_SERIES_3)));
    return exponent * LN_2_HIGH + (2.0 * s + (2.0 * s * series + exponent * LN_2_LOW));
}

// Sine and cosine of an angle in turns.
fn sin_cos_turns(turns: f32) -> vec2<f32> {
    let quarters = round(turns * 4.0);
    let quarter = u32(i32(quarters));
    let x = turns - quarters * 0.25;
    let y = x * x;
    var s = SIN_SERIES_0;
    s = s * y + SIN_SERIES_1;
    s = s * y + SIN_SERIES_2;
    let sine = x * (s * y + TAU);
    var c = COS_SERIES_0;
    c = c * y + COS_SERIES_1;
    c = c * y + COS_SERIES_2;
    c = c * y + COS_SERIES_3;
    let cosine = c * y + 1.0;
    let turned = select(vec2<f32>(cosine, -sine), vec2<f32>(sine, cosine), (quarter & 1u) == 0u);
    return select(-turned, turned, (quarter & 2u) == 0u);
}

// The angle from the x axis to a point, in turns.
fn atan2_turns(y: f32, x: f32) -> f32 {
    let across = abs(y);
    let along = abs(x);
    let least = min(across, along);
    let most = max(across, along);
    if (most == 0.0) {
        return 0.0;
    }
    // Of the tangent's two forms the one whose quotient is small; neither divides by 0.
    let is_beyond = least > TAN_SIXTEENTH * most;
    let z = select(least / most, (least - most) / (least + most), is_beyond);
    let y2 = z * z;
    var p = y2 * ATAN_SERIES_0 + ATAN_SERIES_1;
    p = p * y2 + ATAN_SERIES_2;
    p = p * y2 + ATAN_SERIES_3;
    let octant = select(0.0, 0.125, is_beyond) + z * (p * y2 + ATAN_SERIES_4);
    let quadrant = select(octant, 0.25 - octant, across > along);
    let half = select(quadrant, 0.5 - quadrant, x < 0.0);
    return select(half, -half, y < 0.0);
}

fn max_component(v: vec3<f32>) -> f32 {
    return max(v.x, max(v.y, v.z));
}

fn min_component(v: vec3<f32>) -> f32 {
    return min(v.x, min(v.y, v.z));
}
