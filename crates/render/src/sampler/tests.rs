//! The sampler held to what makes it even, and to what keeps it fair.

use super::*;

fn set_of(pixel: u32, sample: u32, set: u32) -> [f32; 4] {
    let mut sampler = Sampler::new(pixel, 3, sample, 17);
    sampler.start_set(set);
    std::array::from_fn(|_| sampler.next_1d())
}

/// How many standard deviations the chi-square statistic of `counts`, expected equal, lies above its mean.
fn chi_square_excess(counts: &[u32]) -> f64 {
    let expected = counts.iter().map(|&c| f64::from(c)).sum::<f64>() / counts.len() as f64;
    let chi_square: f64 = counts.iter().map(|&c| (f64::from(c) - expected).powi(2) / expected).sum();
    let freedom = counts.len() as f64 - 1.0;
    (chi_square - freedom) / (2.0 * freedom).sqrt()
}

/// Whether the points fall equally into all boxes of `2^-boxes` of the square whose sides are powers of ½.
fn is_even(points: &[[f32; 2]], boxes: u32) -> bool {
    (0..=boxes).all(|across| {
        let (columns, rows) = (1usize << across, 1usize << (boxes - across));
        let mut counts = vec![0usize; columns * rows];
        for p in points {
            counts[(p[1] * rows as f32) as usize * columns + (p[0] * columns as f32) as usize] += 1;
        }
        counts.iter().all(|&count| count << boxes == points.len())
    })
}

#[test]
fn coordinates_are_sobols() {
    // The first points by hand, from the numbers 1; 1, 3, 5, 15; 1, 3, 3, 9; 1, 3, 1, 5.
    let point = |index| sobol(index).map(|bits| f64::from(bits.reverse_bits()) / 4_294_967_296.0 * 16.0);
    assert_eq!(point(0), [0.0; 4]);
    assert_eq!(point(1), [8.0; 4]);
    assert_eq!(point(2), [4.0, 12.0, 12.0, 12.0]);
    assert_eq!(point(4), [2.0, 10.0, 6.0, 2.0]);
    assert_eq!(point(8), [1.0, 15.0, 9.0, 5.0]);
    assert_eq!(point(12), [3.0, 5.0, 15.0, 7.0]);
}

#[test]
fn first_pairs_hit_every_elementary_box_once() {
    for (pixel, set) in [(0, 0), (1, 0), (77, 1), (500, EVEN_SETS - 1)] {
        for m in 0..=10 {
            // Any aligned block of samples, not only the first.
            for block in [0, 5, 256] {
                let samples = (block << m)..(block + 1) << m;
                let points: Vec<_> = samples.map(|i| set_of(pixel, i, set)).map(|v| [v[0], v[1]]).collect();
                assert!(is_even(&points, m), "pixel {pixel}, set {set}, block {block} of 2^{m}");
            }
        }
    }
}

#[test]
fn all_pairs_fill_boxes_of_eight_evenly() {
    for (pixel, set) in [(4, 0), (77, 2)] {
        for m in 3..=11 {
            let points: Vec<_> = (0..1 << m).map(|i| set_of(pixel, i, set)).collect();
            for (a, b) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
                let pair: Vec<_> = points.iter().map(|p| [p[a], p[b]]).collect();
                assert!(is_even(&pair, m - 3), "coordinates {a} and {b} of 2^{m}");
            }
            for d in 0..4 {
                let line: Vec<_> = points.iter().map(|p| [p[d], 0.0]).collect();
                let mut counts = vec![0; 1 << m];
                line.iter().for_each(|p| counts[(p[0] * (1 << m) as f32) as usize] += 1);
                assert!(counts.iter().all(|&n| n == 1), "coordinate {d} of 2^{m}");
            }
        }
    }
}

#[test]
fn four_coordinates_fill_boxes_together() {
    for m in [3u32, 6, 9] {
        let points: Vec<_> = (0..1 << m).map(|i| set_of(9, i, 1)).collect();
        // All ways to cut into 2^(m - 3) boxes; each then has eight points.
        let cuts = m - 3;
        for a in 0..=cuts {
            for b in 0..=cuts - a {
                for c in 0..=cuts - a - b {
                    let sides = [a, b, c, cuts - a - b - c];
                    let mut counts = vec![0u32; 1 << cuts];
                    for p in &points {
                        let index = (0..4)
                            .fold(0, |at, d| at << sides[d] | (p[d] * (1u32 << sides[d]) as f32) as usize);
                        counts[index] += 1;
                    }
                    assert!(counts.iter().all(|&n| n == 8), "2^{m} in {sides:?}");
                }
            }
        }
    }
}

#[test]
fn numbers_of_one_sample_are_uniform_over_pixels() {
    for (set, sample) in [(0, 0), (0, 1), (2, 0), (1, 1_500_000), (EVEN_SETS, 3)] {
        for (a, b) in [(0usize, 1usize), (2, 3), (0, 3), (1, 2)] {
            let mut counts = vec![0u32; 32 * 32];
            for pixel in 0..1 << 15 {
                let v = set_of(pixel, sample, set);
                counts[(v[a] * 32.0) as usize * 32 + (v[b] * 32.0) as usize] += 1;
            }
            let excess = chi_square_excess(&counts);
            assert!(excess.abs() < 4.0, "set {set}, sample {sample}, {a} and {b}: {excess}");
        }
    }
}

#[test]
fn pixels_sets_samples_and_seeds_are_independent() {
    let first = |x, y, sample, seed, set| {
        let mut sampler = Sampler::new(x, y, sample, seed);
        sampler.start_set(set);
        sampler.next_1d()
    };
    type Pair<'a> = &'a dyn Fn(u32, u32) -> [f32; 2];
    let pairs: [(&str, Pair); 6] = [
        ("x", &|i, j| [first(i, j, 5, 0, 0), first(i + 1, j, 5, 0, 0)]),
        ("y", &|i, j| [first(i, j, 5, 0, 0), first(i, j + 1, 5, 0, 0)]),
        ("seeds", &|i, j| [first(i, j, 5, 0, 0), first(i, j, 5, 1, 0)]),
        ("sets", &|i, j| [first(i, j, 5, 0, 0), first(i, j, 5, 0, 1)]),
        ("late sets", &|i, j| [first(i, j, 5, 0, EVEN_SETS - 1), first(i, j, 5, 0, EVEN_SETS)]),
        // Of one pixel over its samples: independent, though each for itself is even.
        ("sets over samples", &|i, j| [first(3, 3, i + 512 * j, 0, 1), first(3, 3, i + 512 * j, 0, 2)]),
    ];
    for (name, pair) in pairs {
        let mut counts = vec![0u32; 32 * 32];
        for i in 0..1 << 15 {
            let [a, b] = pair(i % 512, i / 512);
            counts[(a * 32.0) as usize * 32 + (b * 32.0) as usize] += 1;
        }
        let excess = chi_square_excess(&counts);
        // Even numbers may be more equal than chance, not less.
        assert!(excess < 4.0, "{name}: {excess} standard deviations");
    }
}

/// The mean over the first samples of a pixel, in four dimensions.
fn estimate(f: impl Fn([f32; 4]) -> f64, count: u32, numbers: impl Fn(u32) -> [f32; 4]) -> f64 {
    (0..count).map(|i| f(numbers(i))).sum::<f64>() / f64::from(count)
}

#[test]
fn smooth_functions_have_far_less_noise_and_no_bias() {
    let smooth = |v: [f32; 4]| {
        let [a, b, c, d] = v.map(f64::from);
        (1.0 + a * b) * (c + 0.5) * (1.5 - d * d)
    };
    let exact = 1.25 * 1.0 * (1.5 - 1.0 / 3.0);
    for (count, gain) in [(16u32, 3.0), (64, 8.0), (256, 20.0), (1000, 30.0)] {
        let pixels = 300;
        let mut errors = [0.0f64; 2];
        let (mut sum, mut products, mut last) = (0.0, 0.0, 0.0);
        for pixel in 0..pixels {
            let even = estimate(smooth, count, |i| set_of(pixel, i, 0)) - exact;
            let random = |i| {
                let mut sampler = Sampler::new(pixel, 3, i, 17);
                std::array::from_fn(|_| sampler.random())
            };
            errors[0] += even * even;
            errors[1] += (estimate(smooth, count, random) - exact).powi(2);
            sum += even;
            products += even * last;
            last = even;
        }
        assert!(errors[0] * gain < errors[1], "{count} samples: {} times less", errors[1] / errors[0]);
        // The mean of the errors, and the product of neighbours' errors, against their own standard errors.
        let spread = (errors[0] / f64::from(pixels)).sqrt();
        assert!(sum.abs() < 4.0 * spread * f64::from(pixels).sqrt(), "{count} samples: biased");
        let correlation = products / errors[0];
        assert!(correlation.abs() < 4.0 / f64::from(pixels).sqrt(), "{count} samples: {correlation}");
    }
}

#[test]
fn single_samples_are_fair() {
    // The mean over many pixels of estimates by few samples, however many.
    for count in [1u32, 3, 7] {
        let mut mean = 0.0;
        for pixel in 0..20_000 {
            mean += estimate(|v| f64::from(v[0] * v[1] * v[2] * v[3]), count, |i| set_of(pixel, i, 2));
        }
        mean /= 20_000.0;
        // The product's variance is 1/81 - 1/256.
        let allowed = 4.0 * ((1.0f64 / 81.0 - 1.0 / 256.0) / 20_000.0).sqrt();
        assert!((mean - 1.0 / 16.0).abs() < allowed, "{count} samples: {mean}");
    }
}

#[test]
fn random_numbers_are_uniform_and_independent() {
    let mut counts = vec![0u32; 32 * 32];
    let mut neighbours = vec![0u32; 32 * 32];
    let mut sampler = Sampler::new(8, 9, 10, 11);
    let bin = |value: f32| (value * 32.0) as usize;
    for i in 0..1 << 15 {
        let [a, b] = sampler.random_2d();
        counts[bin(a) * 32 + bin(b)] += 1;
        let [a, b] = [i, i + 1].map(|sample| Sampler::new(8, 9, sample, 11).random());
        neighbours[bin(a) * 32 + bin(b)] += 1;
    }
    assert!(chi_square_excess(&counts).abs() < 4.0);
    assert!(chi_square_excess(&neighbours).abs() < 4.0);
}

#[test]
fn numbers_keep_their_places() {
    let all = |sampler: &mut Sampler| -> Vec<f32> { (0..12).map(|_| sampler.next_1d()).collect() };
    let plain = all(&mut Sampler::new(1, 2, 3, 4));
    // Pairs are whole pairs of a set, and random numbers between do not move the even ones.
    let mut sampler = Sampler::new(1, 2, 3, 4);
    assert_eq!(sampler.next_1d(), plain[0]);
    let random = sampler.random();
    assert_eq!(sampler.next_2d(), [plain[2], plain[3]]);
    assert_ne!(sampler.random(), random);
    // After the last of a set numbers are random, and a set begins with its own wherever one comes from.
    assert_ne!(sampler.next_1d(), plain[4]);
    sampler.start_set(1);
    let first = sampler.next_1d();
    sampler.start_set(0);
    assert_eq!(sampler.next_1d(), plain[0]);
    sampler.start_set(1);
    assert_eq!(sampler.next_1d(), first);
    for set in [EVEN_SETS - 1, u32::MAX] {
        sampler.start_set(set);
        assert!(all(&mut sampler).iter().all(|v| (0.0..1.0).contains(v)));
    }
    for sample in [0, 1 << 20, u32::MAX] {
        assert!(all(&mut Sampler::new(u32::MAX, 0, sample, u32::MAX)).iter().all(|v| (0.0..1.0).contains(v)));
    }
    assert_eq!(plain, all(&mut Sampler::new(1, 2, 3, 4)));
}
