//! Small functions of the shaders held against their twins in Rust, on the device: integers exactly, floats within a
//! written bound. The buffer that they write to holds their input before, so that nothing goes unwritten unseen.

use glam::{DVec3, Vec3};
use nuage_render::camera::Camera;
use nuage_render::hash::{hash_pixel, hash_u32, unit_f32};
use nuage_render::light::Sky;
use nuage_render::path::PathSettings;
use nuage_render::phase::Phase;
use nuage_render::{color, math, views};
use nuage_volume::brick::f32_from_finite_f16;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};
use nuage_volume::codec::{BrickContext, Codec, sparse};

use crate::arrays::Arrays;
use crate::device::{Gpu, Wanted};
use crate::look::{Look, Pass};
use crate::shader::Source;
use crate::upload::Volume;

/// How many inputs each function has.
const COUNT: u32 = 4096;

/// A device, or `None` after saying that there is none.
pub(crate) fn gpu() -> Option<Gpu> {
    match Gpu::open(&Wanted::Best) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            nuage_testkit::left_out("gpu", &error.to_string());
            None
        }
    }
}

/// A random number for an input, in one of four dimensions.
fn random(row: u32, i: u32, dimension: u32) -> f32 {
    unit_f32(hash_pixel(row, 77, i, dimension))
}

/// What the functions of all rows give for rows of inputs.
fn run(gpu: &Gpu, volume: &Volume, rows: &[Vec<[f32; 4]>]) -> Vec<Vec<[f32; 4]>> {
    let size = [COUNT, rows.len() as u32];
    let mut renderer = crate::renderer::Renderer::new(gpu, size).expect("a renderer");
    let camera = Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 40.0).expect("a view");
    let look = Look { camera, media: Vec::new(), lights: Vec::new(), sky: Sky::Constant([0.0; 3]) };
    // Of all passes, paths ask the least of a look.
    let pass = Pass::Path { settings: PathSettings::default(), sample: 0 };
    renderer.prepare_source(volume, &look, &pass, Source::Twins).expect("a pipeline");
    renderer.write_pixels(&rows.concat()).expect("pixels written");
    renderer.run(volume).expect("a run");
    let pixels = renderer.pixels().expect("pixels read");
    pixels.chunks(COUNT as usize).map(<[_]>::to_vec).collect()
}

/// Where a value stands among others of its size: differences count in units of the last place of the larger one.
fn ulps(a: f32, b: f32) -> f32 {
    let unit = f32::EPSILON * a.abs().max(b.abs()).max(f32::MIN_POSITIVE);
    (a - b).abs() / unit
}

/// Random numbers, elementary functions, colours and phase functions.
#[test]
fn small_functions_are_those_of_rust() {
    let Some(gpu) = gpu() else { return };
    let volume = Volume::new(&gpu, &Arrays::default()).expect("an empty volume");
    let row = |of: &dyn Fn(u32) -> [f32; 4]| (0..COUNT).map(of).collect::<Vec<_>>();
    // Bits that are normal numbers, which copies may not change.
    let bits = |i: u32, dimension: u32| hash_pixel(3, 5, i, dimension) & 0xbe7f_ffff | 0x0100_0000;
    let logarithmic = |x: f32| math::exp(40.0 * (x - 0.5));
    let phase_of = |i: u32| {
        let [a, b, c] = [0, 1, 2].map(|dimension| random(4, i, dimension));
        match i % 3 {
            0 => Phase::HenyeyGreenstein { g: 1.9 * a - 0.95 },
            1 => Phase::Draine { g: 1.6 * a - 0.8, alpha: 200.0 * b * b },
            _ => Phase::mie(0.05 + 40.0 * c),
        }
    };
    let rows = vec![
        row(&|i| [0, 1, 2, 3].map(|dimension| f32::from_bits(bits(i, dimension)))),
        row(&|i| {
            [180.0 * random(1, i, 0) - 95.0, logarithmic(random(1, i, 1)), logarithmic(random(1, i, 2)), 7.0]
        }),
        row(&|i| [20.0 * random(2, i, 0) - 10.0, 2.0 * random(2, i, 1), 7.0, 7.0]),
        row(&|i| [4.0 * random(3, i, 0) - 2.0, 7.0, 7.0, 7.0]),
        row(&|i| phase_of(i).lobes()),
    ];
    let found = run(&gpu, &volume, &rows);
    let largest = f32::MAX;
    let mut worst = [0.0_f32; 5];
    for i in 0..COUNT {
        let (given, got) = (rows[0][i as usize], found[0][i as usize]);
        let given = given.map(f32::to_bits);
        assert_eq!(got[0].to_bits(), hash_u32(given[0]) >> 2, "hash_u32");
        assert_eq!(got[1].to_bits(), hash_pixel(given[0], given[1], given[2], given[3]) >> 2, "hash_pixel");
        assert_eq!(got[2], unit_f32(given[0]), "unit_f32");

        let (given, got) = (rows[1][i as usize], found[1][i as usize]);
        worst[0] = worst[0].max(ulps(got[0], math::exp(given[0]).min(largest)));
        worst[1] = worst[1].max(ulps(got[1], math::one_minus_exp_neg(given[1])));
        worst[2] = worst[2].max(ulps(got[2], math::ln(given[2])));
        let (given, got) = (rows[2][i as usize], found[2][i as usize]);
        let (sin, cos) = math::sin_cos_turns(given[0]);
        worst[3] = worst[3].max((got[0] - sin).abs().max((got[1] - cos).abs()));
        worst[4] = worst[4].max((got[2] - color::linear_to_srgb(given[1])).abs());
        let (given, got) = (rows[3][i as usize], found[3][i as usize]);
        let hue = Vec3::from_array(views::hue(given[0]));
        assert!((Vec3::new(got[0], got[1], got[2]) - hue).abs().max_element() < 1e-5, "hue of {}", given[0]);

        let got = found[4][i as usize];
        let phase = phase_of(i);
        let before = Vec3::new(0.48, -0.64, 0.6);
        let u = [unit_f32(hash_u32(i)), unit_f32(hash_u32(i + 1_000_003))];
        let (after, _) = phase.sample(before, u);
        let got_after = Vec3::new(got[0], got[1], got[2]);
        assert!((got_after - after).length() < 2e-4, "{phase:?} {u:?}: {got_after} instead of {after}");
        let value = phase.between(before, got_after);
        assert!((got[3] / value - 1.0).abs() < 2e-3, "{phase:?}: {} instead of {value}", got[3]);
    }
    // Single operations may be fused on a device, which moves a last bit of each.
    assert!(worst[0] <= 4.0 && worst[1] <= 4.0 && worst[2] <= 8.0, "{worst:?}");
    assert!(worst[3] <= 1e-6 && worst[4] <= 1e-5, "{worst:?}");
}

/// The words of a brick of a codec, at random, but such that it can be decoded.
fn words_of(codec: Codec, seed: u32) -> Vec<u32> {
    let random = |i: u32| hash_pixel(seed, 11, i, 0);
    // Half floats below 2, as low and as step.
    let half = |bits: u32| bits & 0xbfff & !0x4000;
    let line = |i: u32| half(random(i)) | half(random(i + 500)) << 16;
    let mut words: Vec<u32> = (0..codec.word_count() as u32).map(random).collect();
    match codec {
        Codec::F32 => words.iter_mut().for_each(|word| *word &= 0xbf7f_ffff),
        Codec::F16 => (0..).zip(&mut words).for_each(|(i, word)| *word = line(i)),
        _ => words[0] = line(0),
    }
    match codec {
        Codec::Gradient { bits: 1.. } => words[3] = line(3),
        Codec::Lattice { bits: 1.. } => words[17] = line(17),
        Codec::Sparse { is_fitted, .. } => return sparse_words(codec, is_fitted, seed, words[0]),
        _ => {}
    }
    words
}

/// A sparse brick of some of its voxels.
fn sparse_words(codec: Codec, is_fitted: bool, seed: u32, line: u32) -> Vec<u32> {
    let random = |i: u32| hash_pixel(seed, 13, i, 0);
    let most_bits = 1 + (random(0) % 7) as u8;
    let bits = std::array::from_fn(|i| most_bits - (random(1 + i as u32) % u32::from(most_bits)) as u8);
    let ends =
        std::array::from_fn(|i| [(random(20 + i as u32) % 16) as u8, (random(40 + i as u32) % 16) as u8]);
    let coding = sparse::Coding {
        most_bits,
        bits: if seed.is_multiple_of(3) { [most_bits; 8] } else { bits },
        is_bent: seed.is_multiple_of(2),
        ends: (!is_fitted && seed % 4 < 2).then_some(ends),
    };
    let plane = random(60) % 20;
    let symbols: sparse::Symbols = std::array::from_fn(|voxel| {
        let [x, y, z] = [voxel as u32 >> 6, voxel as u32 >> 3 & 7, voxel as u32 & 7];
        let bits = u32::from(coding.bits[nuage_volume::codec::octant_of(voxel)]);
        let is_there = x + y + z + (random(voxel as u32 + 100) & 1) < plane;
        if is_there { (random(voxel as u32 + 700) % (1 << bits)) as u8 + 1 } else { 0 }
    });
    let mut words = vec![line];
    coding.write(&mut words);
    if is_fitted {
        words.extend([line, random(90), random(91)]);
    }
    sparse::pack(&coding, &symbols, &mut words);
    words.resize(codec.word_count().max(words.len()), 0);
    words
}

/// Every codec, each voxel of bricks at random, against its decoder.
#[test]
fn bricks_decode_as_in_rust() {
    let Some(gpu) = gpu() else { return };
    let worst = off_by(&gpu, false);
    assert_eq!(worst, [0.0; 3], "decoded by shaders");
}

/// Bricks that the device's texture unit decodes: those of BC7 exactly, others as precisely as the formats ask for.
#[test]
#[allow(clippy::print_stdout, reason = "the measured errors are worth reading")]
fn textures_give_the_values_of_blocks() {
    let Some(gpu) = gpu() else { return };
    if gpu.smallest_bricks() != Ok(crate::arrays::Bricks::Textures) {
        nuage_testkit::left_out("gpu", "it does not read textures of blocks");
        return;
    }
    let [bc4, bc3, bc7] = off_by(&gpu, true);
    println!("BC4 {:.2}, BC3 {:.2}, BC7 {bc7:e} 255ths of a brick's scale", 255.0 * bc4, 255.0 * bc3);
    assert!(bc4 <= 2.0 / 255.0 && bc3 <= 2.0 / 255.0 && bc7 == 0.0);
}

/// Holds all codecs to their decoders. By how much the formats of blocks are off by more than rounding explains, as a share of
/// the brick's scale.
fn off_by(gpu: &Gpu, in_textures: bool) -> [f32; 3] {
    let (unit, floor) = (4.0, -3.0);
    let formats = [BlockFormat::Bc4, BlockFormat::Bc3, BlockFormat::Bc7];
    let axes = [PackingAxis::X, PackingAxis::Y, PackingAxis::Z];
    let blocks = formats.into_iter().flat_map(|format| axes.map(|axis| Codec::Block { format, axis }));
    let codecs: Vec<Codec> = [Codec::F32, Codec::F16, Codec::Shared]
        .into_iter()
        .chain((1..=8).map(|bits| Codec::Uniform { bits }))
        .chain((0..=8).map(|bits| Codec::Gradient { bits }))
        .chain((0..=5).map(|bits| Codec::Lattice { bits }))
        .chain((1..=8).map(|bits| Codec::Split { bits }))
        .chain(blocks)
        .collect();
    // Shapes of two kinds, for the shared bricks.
    let shape_codecs =
        [Codec::Uniform { bits: 5 }, Codec::Block { format: BlockFormat::Bc7, axis: PackingAxis::Y }];
    let shapes = shape_codecs.map(|codec| words_of(codec, 99)).concat();
    let shape_at = [0, shape_codecs[0].word_count() as u32];

    let (mut words, mut bricks): (Vec<u32>, Vec<(Codec, u32)>) = Default::default();
    for (seed, codec) in (0..).zip(codecs.iter().flat_map(|codec| [*codec; 6])) {
        let mut brick = words_of(codec, seed);
        if codec == Codec::Shared {
            let shape = seed as usize % 2;
            brick[1..].copy_from_slice(&[shape_at[shape], u32::from(shape_codecs[shape].tag())]);
        }
        bricks.push((codec, words.len() as u32));
        words.extend(brick);
    }
    // All modes of BC7 and their partitions are met.
    for seed in 0..256 {
        let codec = Codec::Block { format: BlockFormat::Bc7, axis: axes[seed as usize % 3] };
        let mut brick = words_of(codec, 10_000 + seed);
        for (i, word) in brick.iter_mut().enumerate().skip(1).step_by(4) {
            let mode = (i as u32 / 4 + seed) % 9;
            *word = (*word | 1) << mode;
        }
        bricks.push((codec, words.len() as u32));
        words.extend(brick);
    }
    // Sparse bricks are as long as they have to be.
    for seed in 0..200 {
        let is_fitted = seed % 5 < 2;
        let brick = words_of(Codec::Sparse { is_fitted, pairs: 3 }, seed);
        let pairs = brick.len().div_ceil(2);
        let Some(codec @ Codec::Sparse { .. }) = u8::try_from(pairs)
            .ok()
            .filter(|pairs| *pairs < 70)
            .map(|pairs| Codec::Sparse { is_fitted, pairs })
        else {
            continue;
        };
        bricks.push((codec, words.len() as u32));
        words.extend(brick);
        words.resize(bricks[bricks.len() - 1].1 as usize + 2 * pairs, 0);
    }

    let mut arrays = Arrays::of_words(words.clone(), shapes.clone(), unit, floor);
    if in_textures {
        arrays.move_to_textures(&bricks, &[0, 1].map(|shape| (shape_codecs[shape], shape_at[shape])));
    }
    let volume = Volume::new(gpu, &arrays).expect("a volume");
    let mut worst = [0.0_f32; 3];
    let context = BrickContext { words: &words, shapes: &shapes, unit, floor };
    let mut expected = Vec::new();
    let mut given = Vec::new();
    for (codec, offset) in &bricks {
        let mut values = [0.0; 512];
        context.decode(*codec, *offset, &mut values).unwrap_or_else(|error| panic!("{codec:?}: {error}"));
        for i in 0..16 {
            let voxel = hash_pixel(*offset, i, 3, 0) % 512;
            given.push([*offset, u32::from(codec.tag()), voxel, 7].map(|input| input as f32));
            let step = f32_from_finite_f16((words[*offset as usize] >> 16) as u16) * unit;
            expected.push((*codec, voxel, values[voxel as usize], step.abs()));
        }
    }
    for (given, expected) in given.chunks(COUNT as usize).zip(expected.chunks(COUNT as usize)) {
        let mut row = given.to_vec();
        row.resize(COUNT as usize, given[0]);
        // The function of a brick's voxel is that of the sixth row.
        let mut rows = vec![vec![[0.5; 4]; COUNT as usize]; 5];
        rows.push(row);
        let found = run(gpu, &volume, &rows).pop().expect("six rows");
        for ((codec, voxel, value, step), found) in expected.iter().zip(found) {
            // Codes and half floats are exact; two operations on values of the unit's size follow, which may be fused.
            let bound = 4.0 * f32::EPSILON * (unit * 600.0).min(value.abs() + 64.0 * unit);
            // A device may take subnormal numbers for 0.
            let bound = if matches!(codec, Codec::F32 | Codec::F16) { f32::MIN_POSITIVE } else { bound };
            if let Codec::Block { format, .. } = codec {
                let worst = &mut worst[crate::blocks::number_of(*format)];
                *worst = worst.max(((found[0] - value).abs() - bound).max(0.0) / step.max(f32::MIN_POSITIVE));
                continue;
            }
            assert!(
                (found[0] - value).abs() <= bound,
                "{codec:?} at {voxel}: {} instead of {value}",
                found[0]
            );
        }
    }
    worst
}

#[test]
fn half_floats_are_exact() {
    let Some(gpu) = gpu() else { return };
    // Every finite half, two to a word, as a brick of half floats.
    let words: Vec<u32> = (0..1 << 15).map(|i| (2 * i) | (2 * i + 1) << 16).collect();
    let volume = Volume::new(&gpu, &Arrays::of_words(words, Vec::new(), 1.0, f32::MIN)).expect("a volume");
    for first in (0..1 << 16).step_by(COUNT as usize) {
        let input = |i: u32| [(first + i) / 512 * 256, u32::from(Codec::F16.tag()), (first + i) % 512, 1];
        let mut rows = vec![vec![[0.5; 4]; COUNT as usize]; 5];
        rows.push((0..COUNT).map(|i| input(i).map(|input| input as f32)).collect());
        let found = run(&gpu, &volume, &rows).pop().expect("six rows");
        for (bits, found) in (first..).zip(found).filter(|(bits, _)| bits & 0x7c00 != 0x7c00) {
            assert_eq!(found[0], f32_from_finite_f16(bits as u16), "{bits:#x}");
        }
    }
}
