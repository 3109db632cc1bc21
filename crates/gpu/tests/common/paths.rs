//! The path tracer of the GPU held to that of the CPU: both are estimates, so blocks of pixels are compared in standard
//! errors.

use nuage_gpu::device::Gpu;
use nuage_gpu::look::{Look, Pass, channels_of};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume as GpuVolume;
use nuage_render::film::Film;
use nuage_render::path::PathSettings;
use nuage_render::progressive::{Plan, Watch, trace};
use nuage_render::scene::Scene;
use nuage_testkit::blocks::Estimate;

const WIDTH: u32 = 48;
const HEIGHT: u32 = 32;
/// Paths for each pixel on the GPU come in so many batches, whose spread tells their standard error.
const BATCHES: u32 = 8;

/// Red, green, blue and opacity of all pixels on the GPU.
fn of_gpu(
    gpu: &Gpu,
    volume: &GpuVolume,
    look: &Look,
    settings: PathSettings,
    samples: u32,
) -> [Vec<Estimate>; 4] {
    let mut renderer = Renderer::new(gpu, [WIDTH, HEIGHT]).expect("a renderer");
    let mut batches: Vec<Vec<[f32; 4]>> = Vec::new();
    let mut before = vec![[0.0_f32; 4]; (WIDTH * HEIGHT) as usize];
    for batch in 0..BATCHES {
        for sample in batch * samples..(batch + 1) * samples {
            renderer.prepare(volume, look, &Pass::Path { settings, sample }, 0, None).expect("a pass");
            renderer.run(volume).expect("a run");
        }
        let count = ((batch + 1) * samples) as f32;
        let sums: Vec<[f32; 4]> =
            renderer.pixels().expect("pixels").iter().map(|p| p.map(|v| v * count)).collect();
        let mean = |(now, before): (&[f32; 4], &[f32; 4])| {
            std::array::from_fn(|i| (now[i] - before[i]) / samples as f32)
        };
        batches.push(sums.iter().zip(&before).map(mean).collect());
        before = sums;
    }
    let count = f64::from(BATCHES);
    std::array::from_fn(|channel| {
        let estimate = |pixel: usize| {
            let values = || batches.iter().map(|batch| f64::from(batch[pixel][channel]));
            let mean = values().sum::<f64>() / count;
            let variance = values().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0) / count;
            Estimate { mean, variance }
        };
        (0..(WIDTH * HEIGHT) as usize).map(estimate).collect()
    })
}

fn of_cpu(scene: &Scene<'_>, settings: PathSettings, samples: u32) -> [Vec<Estimate>; 4] {
    let mut film = Film::new(WIDTH, HEIGHT).expect("a film");
    let plan = Plan { settings, samples, pass_samples: samples, seed: 5, ..Plan::default() };
    trace(scene, &plan, &mut film, &mut Watch::default());
    let all = film.map(|tally| {
        let [red, green, blue] = tally.light();
        ([red, green, blue, tally.alpha()], tally.standard_error())
    });
    std::array::from_fn(|channel| {
        let estimate = |(mean, error): &([f32; 4], [f32; 4])| Estimate {
            mean: mean[channel].into(),
            variance: f64::from(error[channel]).powi(2),
        };
        all.iter().map(estimate).collect()
    })
}

/// Holds a scene's picture of paths to that of the CPU.
pub fn compare(name: &str, gpu: &Gpu, scene: &Scene<'_>, settings: PathSettings) {
    compare_on(name, gpu, &super::uploaded(gpu, &channels_of(scene)), scene, settings);
}

/// The same for a volume that is on the device, in whatever form.
pub fn compare_on(name: &str, gpu: &Gpu, volume: &GpuVolume, scene: &Scene<'_>, settings: PathSettings) {
    let look = Look::of_scene(scene).expect("a look");
    let ours = of_gpu(gpu, volume, &look, settings, 8);
    let theirs = of_cpu(scene, settings, 64);
    for (channel, (ours, theirs)) in ["red", "green", "blue", "opacity"].iter().zip(ours.iter().zip(&theirs))
    {
        hold(&format!("{name}, {channel}"), ours, theirs);
    }
}

/// Holds the mean to three standard errors, and of blocks of 8 × 8 pixels 99 %, or all but one, to three and all to five. What is known of a
/// block counts as no better than a thousandth of the brightest pixel.
fn hold(name: &str, ours: &[Estimate], theirs: &[Estimate]) {
    const BLOCK: usize = 8;
    let width = WIDTH as usize;
    let brightest = theirs.iter().map(|pixel| pixel.mean).fold(0.0, f64::max);
    let over = |pixels: &[usize], floor: f64| {
        let sum = |of: &dyn Fn(&Estimate) -> f64, picture: &[Estimate]| -> f64 {
            pixels.iter().map(|i| of(&picture[*i])).sum()
        };
        let count = pixels.len() as f64;
        let means = [ours, theirs].map(|picture| sum(&|pixel| pixel.mean, picture) / count);
        let variance: f64 =
            [ours, theirs].map(|p| sum(&|pixel| pixel.variance, p)).iter().sum::<f64>() / count.powi(2);
        // Where there is no light, both are 0.
        let error = (variance + floor.powi(2)).sqrt().max(f64::MIN_POSITIVE);
        (means, (means[0] - means[1]).abs() / error)
    };
    let all: Vec<usize> = (0..ours.len()).collect();
    let ([found, expected], off) = over(&all, 1e-3 * expected_floor(theirs));
    println!("{name}: {found:.5} of {expected:.5}, {off:.2} standard errors");
    let columns = width / BLOCK;
    let deviations: Vec<f64> = (0..ours.len() / BLOCK / BLOCK)
        .map(|block| {
            let first = block / columns * BLOCK * width + block % columns * BLOCK;
            let pixels: Vec<usize> =
                (0..BLOCK * BLOCK).map(|i| first + i / BLOCK * width + i % BLOCK).collect();
            over(&pixels, 1e-3 * brightest).1
        })
        .collect();
    let good = deviations.iter().filter(|z| **z < 3.0).count();
    let worst = deviations.iter().copied().fold(0.0, f64::max);
    println!("{name}: {good} of {} blocks within 3 standard errors, the worst {worst:.2}", deviations.len());
    assert!(off < 3.0, "{name}: {found} instead of {expected}, {off} standard errors");
    // Of a hundred blocks one may be off by chance; a picture this small has fewer, and one of them may be that one.
    let chance = deviations.len().div_ceil(100);
    assert!(good + chance >= deviations.len() && worst < 5.0, "{name}: {good}, {worst}");
}

/// The mean of a picture.
fn expected_floor(picture: &[Estimate]) -> f64 {
    picture.iter().map(|pixel| pixel.mean).sum::<f64>() / picture.len() as f64
}
