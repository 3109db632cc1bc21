//! Holding noisy pictures against each other: their means, and the means of blocks of 8 × 8 pixels in standard errors.

/// Pixels per side of a block.
const BLOCK: usize = 8;

/// What is known of a pixel: its estimate and the variance of that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The estimate.
    pub mean: f64,
    /// Its variance: the square of its standard error.
    pub variance: f64,
}

/// Holds one colour of a picture, row by row and `width` pixels wide, to that of a reference: means within 0.5 %, and within three
/// standard errors and 0.1 %; of the blocks 99 % within three standard errors, and none further off than five. Prints what it finds.
///
/// # Panics
/// If they differ by more, or the pictures are not of one size.
pub fn hold(name: &str, width: usize, ours: &[Estimate], theirs: &[Estimate]) {
    assert_eq!(ours.len(), theirs.len(), "{name}");
    let all: Vec<usize> = (0..ours.len()).collect();
    let [found, expected] = [ours, theirs].map(|picture| over(picture, &all));
    let error = (found.variance + expected.variance).sqrt();
    let off = (found.mean - expected.mean).abs();
    let percent = 100.0 * (found.mean / expected.mean - 1.0);
    println!("{name}: {:.5} of {:.5}, {percent:+.3} %", found.mean, expected.mean);
    let limit = (0.005 * expected.mean).min(3.0 * error + 0.001 * expected.mean);
    assert!(off <= limit, "{name}: means are {off} apart, with a standard error of {error}");

    let columns = width / BLOCK;
    let deviation = |block: usize| {
        let first = block / columns * BLOCK * width + block % columns * BLOCK;
        let pixels: Vec<usize> = (0..BLOCK * BLOCK).map(|i| first + i / BLOCK * width + i % BLOCK).collect();
        let [found, expected] = [ours, theirs].map(|picture| over(picture, &pixels));
        let floor = 1e-6 * expected.mean.powi(2);
        match (found.mean - expected.mean).abs() {
            // Where nothing is, both are 0.
            0.0 => 0.0,
            difference => difference / (found.variance + expected.variance + floor).sqrt(),
        }
    };
    let deviations: Vec<f64> = (0..columns * (ours.len() / width / BLOCK)).map(deviation).collect();
    let good = deviations.iter().filter(|z| **z < 3.0).count();
    let worst = deviations.iter().copied().fold(0.0, f64::max);
    let blocks = deviations.len();
    println!("{name}: {good} of {blocks} blocks within 3 standard errors, the worst {worst:.2}");
    assert!(good as f64 >= 0.99 * blocks as f64 && worst < 5.0, "{name}: {good} of {blocks}, {worst}");
}

/// The mean over some pixels.
fn over(picture: &[Estimate], pixels: &[usize]) -> Estimate {
    let sum = |of: &dyn Fn(&Estimate) -> f64| pixels.iter().map(|i| of(&picture[*i])).sum::<f64>();
    let count = pixels.len() as f64;
    Estimate {
        mean: sum(&|pixel| pixel.mean) / count,
        variance: sum(&|pixel| pixel.variance) / count.powi(2),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::catch_unwind;

    const WIDTH: usize = 128;

    /// A square picture, each pixel off by as much as its standard error says.
    fn picture(seed: u64, bias: impl Fn(usize) -> f64) -> Vec<Estimate> {
        let noise = |i: usize| {
            // SplitMix64.
            let x = (seed << 32 | i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
            (x >> 40) as f64 / (1_u64 << 24) as f64 - 0.5
        };
        (0..WIDTH * WIDTH)
            .map(|i| Estimate { mean: 1.0 + 0.1 * noise(i) + bias(i), variance: 0.01 / 12.0 })
            .collect()
    }

    #[test]
    fn noise_passes_and_bias_does_not() {
        let reference = picture(1, |_| 0.0);
        hold("noise", WIDTH, &picture(2, |_| 0.0), &reference);
        let fails = |bias: fn(usize) -> f64| {
            let picture = picture(3, bias);
            catch_unwind(|| hold("bias", WIDTH, &picture, &reference)).is_err()
        };
        assert!(fails(|_| 0.006), "all is brighter");
        assert!(fails(|i| if i % WIDTH < 8 && i < 8 * WIDTH { 0.05 } else { 0.0 }), "a block is");
    }
}
