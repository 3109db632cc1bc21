// Light by direction from a picture of all surroundings: nuage_render::envmap. Where its texels stand is told in `crate::sky`.

@group(3) @binding(0) var sky_map: texture_2d<f32>;

fn sky_texel(x: u32, y: u32) -> vec4<f32> {
    return textureLoad(sky_map, vec2<u32>(x, y), 0);
}

// Where a row's share of the whole ends, and the solid angle of its texels.
fn sky_row(y: u32) -> vec2<f32> {
    let width = params.map_size.x;
    return sky_texel(y % width, params.map_size.y + y / width).xy;
}

// Where a direction of the map lies, in texels from the top left corner.
fn map_position(d: vec3<f32>) -> vec2<f32> {
    let longitude = atan2_turns(d.x, d.z);
    let from_top = atan2_turns(sqrt(d.x * d.x + d.z * d.z), d.y);
    return vec2<f32>(0.5 - longitude, 2.0 * from_top) * vec2<f32>(params.map_size.xy);
}

// Radiance at a position in texels from the top left corner.
fn map_bilinear(position: vec2<f32>) -> vec3<f32> {
    let size = params.map_size.xy;
    // From the centres of texels. Left of the first lies the last.
    let x = position.x - 0.5 + select(0.0, f32(size.x), position.x < 0.5);
    let y = max(position.y - 0.5, 0.0);
    let left = min(u32(x), size.x - 1u);
    let top = min(u32(y), size.y - 1u);
    let right = select(left + 1u, 0u, left + 1u >= size.x);
    let bottom = min(top + 1u, size.y - 1u);
    let above = mix(sky_texel(left, top).xyz, sky_texel(right, top).xyz, fract(x));
    let below = mix(sky_texel(left, bottom).xyz, sky_texel(right, bottom).xyz, fract(x));
    return mix(above, below, fract(y));
}

fn map_from_world(direction: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        dot(params.map_x.xyz, direction), dot(params.map_y.xyz, direction), dot(params.map_z.xyz, direction),
    );
}

fn sky_radiance(direction: vec3<f32>) -> vec3<f32> {
    return map_bilinear(map_position(map_from_world(direction)));
}

// The share of a row, or of a column of one, in parts of the whole.
fn row_parts(y: u32) -> f32 {
    return sky_row(y).x - select(0.0, sky_row(max(y, 1u) - 1u).x, y > 0u);
}

fn column_parts(x: u32, y: u32) -> f32 {
    return sky_texel(x, y).w - select(0.0, sky_texel(max(x, 1u) - 1u, y).w, x > 0u);
}

// The density with which `sample_map` chooses a direction, per solid angle.
fn map_pdf(direction: vec3<f32>) -> f32 {
    let position = max(map_position(map_from_world(direction)), vec2<f32>(0.0));
    let at = min(vec2<u32>(position), params.map_size.xy - 1u);
    return (row_parts(at.y) / ENVIRONMENT_PARTS) * (column_parts(at.x, at.y) / ENVIRONMENT_PARTS) / sky_row(at.y).y;
}

// A direction chosen by where the light is, by two uniform numbers for longitude and latitude. Some texel has light.
fn sample_map(u: vec2<f32>) -> vec3<f32> {
    let size = params.map_size.xy;
    let part = min(floor(u * ENVIRONMENT_PARTS), vec2<f32>(ENVIRONMENT_PARTS - 1.0));
    // The first row, and in it the first column, that ends behind the part.
    var low = 0u;
    var high = size.y - 1u;
    while (low < high) {
        let middle = (low + high) / 2u;
        if (sky_row(middle).x <= part.y) { low = middle + 1u; } else { high = middle; }
    }
    let y = low;
    low = 0u;
    high = size.x - 1u;
    while (low < high) {
        let middle = (low + high) / 2u;
        if (sky_texel(middle, y).w <= part.x) { low = middle + 1u; } else { high = middle; }
    }
    let x = low;
    let rows = row_parts(y);
    let columns = column_parts(x, y);
    let inside = vec2<f32>(
        (part.x - (sky_texel(x, y).w - columns) + 0.5) / max(columns, 1.0),
        (part.y - (sky_row(y).x - rows) + 0.5) / max(rows, 1.0),
    );
    let d = direction_in_texel(x, y, inside);
    return normalize(params.map_x.xyz * d.x + params.map_y.xyz * d.y + params.map_z.xyz * d.z);
}

// The direction of the map at a place in a texel, where equal steps are equal solid angles.
fn direction_in_texel(x: u32, y: u32, inside: vec2<f32>) -> vec3<f32> {
    let size = params.map_size.xy;
    // Rows of the lower half are measured from below: near a pole, its own distance is what has digits.
    let is_lower = y >= (size.y + 1u) / 2u;
    let row = select(y, size.y - 1u - y, is_lower);
    let v = select(inside.y, 1.0 - inside.y, is_lower);
    let turns_per_row = 0.5 / f32(size.y);
    let half = sin_cos_turns(f32(row) * turns_per_row / 2.0).x;
    let thickness = sky_row(row).y * f32(size.x) / TAU;
    let from_pole = min(2.0 * half * half + v * thickness, 2.0);
    let across = sqrt(from_pole * (2.0 - from_pole));
    let up = select(1.0 - from_pole, from_pole - 1.0, is_lower);
    let turned = sin_cos_turns(0.5 - (f32(x) + inside.x) / f32(size.x));
    return vec3<f32>(across * turned.x, up, across * turned.y);
}

// The light of a picture of the surroundings that a point scatters along `before`, over the share of light that it scatters at
// all: from a direction that the picture or the phase function chose.
fn mapped(phase: Phase, at: vec3<f32>, before: vec3<f32>, random: ptr<function, Random>) -> vec3<f32> {
    let takes_map = random_unit(random) < 0.5;
    let u = vec2<f32>(random_unit(random), random_unit(random));
    var direction: vec3<f32>;
    if (takes_map) {
        direction = sample_map(u);
    } else {
        direction = sample_phase(phase, before, u);
    }
    let scatters = phase_between(phase, before, direction);
    let density = 0.5 * (scatters + map_pdf(direction));
    if (density <= 0.0) {
        return vec3<f32>(0.0);
    }
    return sky_radiance(direction) * (scatters / density) * transmittance(Ray(at, direction), MAX_F32, random);
}
