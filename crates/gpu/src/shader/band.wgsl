// Pixels of a still picture that are finished together, a share of their work at a time.

struct Band {
    // Whether there is one that is not finished, and one for which the driver left loops before their end.
    is_unfinished: atomic<u32>,
    is_unsound: atomic<u32>,
    // As the picture has them, marked as long as they are not finished.
    pixels: array<vec4<f32>, BAND_PIXELS>,
    // What is known of each between two dispatches.
    kept: array<Kept, BAND_PIXELS>,
}

@group(1) @binding(1) var<storage, read_write> band: Band;

fn is_unfinished(at: u32) -> bool {
    return at < params.rounds.y && is_marked(band.pixels[at]);
}

fn pixel_of_band(at: u32) -> vec2<u32> {
    let number = params.rounds.x + at;
    return vec2<u32>(number % params.size.x, number / params.size.x);
}

// Says whether a pixel is finished. If the driver left loops, this dispatch is to be as if it had not been.
fn is_left_over(is_unfinished: bool) -> bool {
    let is_unsound = leaves_loops();
    if (is_unsound) {
        atomicStore(&band.is_unsound, 1u);
    }
    if (is_unsound || is_unfinished) {
        atomicStore(&band.is_unfinished, 1u);
    }
    return is_unsound;
}
