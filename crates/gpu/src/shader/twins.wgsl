// Small functions over many inputs, to be held against their twins in Rust: what is computed of four numbers goes into
// the picture of one row per function.

@compute @workgroup_size(WORKGROUP_SIDE, WORKGROUP_SIDE)
fn twins(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= params.size.xy)) {
        return;
    }
    let at = id.y * params.size.x + id.x;
    let given = picture[at];
    let bits = bitcast<vec4<u32>>(given);
    var result = vec4<f32>(0.0);
    switch (id.y) {
        case 0u: {
            let hashed = hash_pixel(bits.x, bits.y, bits.z, bits.w);
            result = bitcast<vec4<f32>>(vec4<u32>(hash_u32(bits.x) >> 2u, hashed >> 2u, 0u, 0u));
            result.z = unit_f32(bits.x);
        }
        case 1u: { result = vec4<f32>(exp_(given.x), one_minus_exp_neg(given.y), ln(given.z), 0.0); }
        case 2u: { result = vec4<f32>(sin_cos_turns(given.x), linear_to_srgb(given.y), 0.0); }
        case 3u: { result = vec4<f32>(hue(given.x), 0.0); }
        case 4u: {
            let phase = Phase(given.x, given.y, given.z, given.w);
            let before = vec3<f32>(0.48, -0.64, 0.6);
            let u = vec2<f32>(unit_f32(hash_u32(id.x)), unit_f32(hash_u32(id.x + 1000003u)));
            let after = sample_phase(phase, before, u);
            result = vec4<f32>(after, phase_between(phase, before, after));
        }
        default: {
            // A voxel of a brick whose tag and offset are given, in units of the first field.
            let voxel = u32(given.z);
            let p = vec3<u32>(voxel >> 6u, (voxel >> 3u) & 7u, voxel & 7u);
            result.x = stored_value(0u, Entry(u32(given.x), u32(given.y)), p);
        }
    }
    picture[at] = result;
}
