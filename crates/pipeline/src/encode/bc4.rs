//! BC4 blocks from sixteen values, also the alpha half of BC3: our own encoder, as libraries take bytes and
//! the format resolves a seventh of a byte's step.
//!
//! Both kinds of palette are tried. Endpoints start at the bounds of the values; then indices and endpoints
//! are fitted to each other in turn, endpoints by least squares.

use nuage_volume::codec::block::bc4::palette;

use super::block::Quality;

/// A block and how well it fits.
#[derive(Clone, Copy)]
struct Fit {
    endpoints: [u8; 2],
    indices: [u8; 16],
    /// The sum of squared differences.
    error: f32,
}

impl Fit {
    /// The nearest entry of the palette for each value.
    fn of(values: &[f32; 16], endpoints: [u8; 2]) -> Fit {
        let palette = palette(endpoints);
        let mut nearest = [(f32::INFINITY, 0); 16];
        for (index, entry) in palette.iter().enumerate() {
            for (nearest, value) in nearest.iter_mut().zip(values) {
                let error = (value - entry) * (value - entry);
                if error < nearest.0 {
                    *nearest = (error, index as u8);
                }
            }
        }
        let error = nearest.iter().map(|(error, _)| error).sum();
        Fit { endpoints, indices: nearest.map(|(_, index)| index), error }
    }

    /// The endpoints that suit the indices best. `None` if the indices leave them open.
    fn least_squares(&self, values: &[f32; 16]) -> Option<[f32; 2]> {
        // Steps from the first endpoint to the second; the last two entries of a short palette are fixed.
        let (steps, entries) = if self.endpoints[0] > self.endpoints[1] { (7.0, 8) } else { (5.0, 6) };
        let (mut aa, mut ab, mut bb, mut av, mut bv) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (value, index) in values.iter().zip(self.indices) {
            if index >= entries {
                continue;
            }
            let b = match index {
                0 => 0.0,
                1 => 1.0,
                _ => f32::from(index - 1) / steps,
            };
            let a = 1.0 - b;
            aa += a * a;
            ab += a * b;
            bb += b * b;
            av += a * value;
            bv += b * value;
        }
        let determinant = aa * bb - ab * ab;
        (determinant > 1e-3).then(|| [(av * bb - bv * ab) / determinant, (bv * aa - av * ab) / determinant])
    }

    fn bytes(&self) -> [u8; 8] {
        let indices = self.indices.iter().rev().fold(0, |bits, index| bits << 3 | u64::from(*index));
        let [a, b] = self.endpoints;
        (indices << 16 | u64::from(b) << 8 | u64::from(a)).to_le_bytes()
    }
}

/// Encodes sixteen values between 0 and 1.
pub(super) fn encode(values: &[f32; 16], quality: Quality) -> [u8; 8] {
    let bounds = |low: f32, high: f32| {
        let inner = values.iter().copied().filter(|value| (low..=high).contains(value));
        inner.fold([f32::INFINITY, f32::NEG_INFINITY], |[min, max], value| [min.min(value), max.max(value)])
    };
    let [min, max] = bounds(0.0, 1.0);
    let long = fit(values, [max, min], as_long, quality);
    // A short palette pays where many values are 0 or 1, or nearly.
    const NEAR: f32 = 1.0 / 64.0;
    if min >= NEAR && max <= 1.0 - NEAR || long.error == 0.0 {
        return long.bytes();
    }
    let [min, max] = bounds(NEAR, 1.0 - NEAR);
    let ends = if min <= max { [min, max] } else { [0.0, 1.0] };
    let short = fit(values, ends, as_short, quality);
    if short.error < long.error { short.bytes() } else { long.bytes() }
}

/// Refines endpoints, held to one kind of palette by `ordered`.
fn fit(values: &[f32; 16], mut ends: [f32; 2], ordered: fn([u8; 2]) -> [u8; 2], quality: Quality) -> Fit {
    let mut best = Fit::of(values, ordered(ends.map(byte)));
    let rounds = match quality {
        Quality::Fast => 1,
        Quality::Best => 4,
    };
    let mut last = best;
    for _ in 0..rounds {
        let Some(refined) = last.least_squares(values) else { break };
        if refined == ends {
            break;
        }
        ends = refined;
        last = Fit::of(values, ordered(ends.map(byte)));
        if last.error < best.error {
            best = last;
        }
    }
    if quality == Quality::Best {
        climb(values, &mut best, ordered);
    }
    best
}

/// Moves endpoints by single steps as long as that helps: rounding them to bytes has moved the optimum.
fn climb(values: &[f32; 16], best: &mut Fit, ordered: fn([u8; 2]) -> [u8; 2]) {
    const STEPS: [[i8; 2]; 8] = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]];
    for _ in 0..8 {
        let from = best.endpoints;
        for [a, b] in STEPS {
            let moved = [from[0].saturating_add_signed(a), from[1].saturating_add_signed(b)];
            let candidate = Fit::of(values, ordered(moved));
            if candidate.error < best.error {
                *best = candidate;
            }
        }
        if best.endpoints == from {
            break;
        }
    }
}

/// The nearest byte.
fn byte(value: f32) -> u8 {
    (value * 255.0).round() as u8
}

/// The first endpoint the larger: six values between the two.
fn as_long([a, b]: [u8; 2]) -> [u8; 2] {
    let [min, max] = [a.min(b), a.max(b)];
    if min < max { [max, min] } else { [max.saturating_add(1), if max == u8::MAX { min - 1 } else { min }] }
}

/// The first endpoint not the larger: four values between the two, and 0 and 1.
fn as_short([a, b]: [u8; 2]) -> [u8; 2] {
    [a.min(b), a.max(b)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_block_is_as_near_as_its_range_allows(
            noise in proptest::array::uniform16(0.0f32..=1.0),
            low in 0.0f32..=1.0,
            high in 0.0f32..=1.0,
        ) {
            let values = noise.map(|noise| low + (high - low) * noise);
            let max = values.iter().copied().fold(0.0, f32::max);
            let range = max - values.iter().copied().fold(1.0, f32::min);
            for quality in [Quality::Fast, Quality::Best] {
                let block = encode(&values, quality);
                let (palette, indices) = (palette([block[0], block[1]]), u64::from_le_bytes(block) >> 16);
                let decoded = |texel: usize| palette[(indices >> (3 * texel) & 7) as usize];
                let squares = (0..16).map(|i| (values[i] - decoded(i)) * (values[i] - decoded(i)));
                // Half a step of the palette, and what rounding the endpoints to bytes moves it.
                let error = (squares.sum::<f32>() / 16.0).sqrt();
                let bound = range / 14.0 + 0.5 / 255.0 + 1e-6;
                prop_assert!(error <= bound, "{quality:?}: {error}, range {range}");
            }
        }

        #[test]
        fn zeros_and_ones_cost_nothing(ones in any::<u16>(), a in 20u8..235, b in 20u8..235) {
            let mut values = std::array::from_fn(|i| f32::from(ones >> i & 1));
            values[3] = f32::from(a) / 255.0;
            values[9] = f32::from(b) / 255.0;
            let block = encode(&values, Quality::Fast);
            let (palette, indices) = (palette([block[0], block[1]]), u64::from_le_bytes(block) >> 16);
            for (i, value) in values.iter().enumerate() {
                prop_assert!((palette[(indices >> (3 * i) & 7) as usize] - value).abs() < 1e-6);
            }
        }
    }
}
