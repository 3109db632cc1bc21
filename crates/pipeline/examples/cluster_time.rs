//! Times clustering and says what it costs in error:
//! `cargo run --release -p nuage-pipeline --example cluster_time -- [OPTIONS] [FILE...]`.
//!
//! The bricks are those of the density in the files, repeated with small variations up to `--bricks`; without
//! files they are made up, like smoke. Plain k-means, fast k-means and shared shapes run over the same
//! bricks, the latter with the bound on the error at which it leaves no more bytes than k-means does. Plain
//! k-means runs over every tenth brick unless `--plain` is given. Other options: `--clusters`,
//! `--iterations`, `--threshold`, `--rule 4.5` or `5.3`, `--seed`, and `--peak`, how many times the root of
//! the mean squared error the largest error of a shared brick may be, each with a number.

#![allow(clippy::print_stdout, reason = "the lines printed are what the program is for")]

use std::error::Error;
use std::time::Instant;

use nuage_pipeline::cluster::thesis::{self, Clusters, KMeans, Rejection};
use nuage_pipeline::cluster::{Brick, shapes};
use nuage_pipeline::import::import;
use nuage_vdb::File;
use nuage_volume::brick::Bricks;

/// Own scale and bias of a brick. The index of its shape or centre takes no more room than that of a kept
/// brick.
const OWN_BYTES: usize = 8;
const BRICK_BYTES: usize = size_of::<Brick>();
/// How many bricks the bound on the error is searched with.
const SEARCH_BRICKS: usize = 50_000;

struct Options {
    bricks: Option<usize>,
    whole_plain: bool,
    clusters: usize,
    iterations: u32,
    threshold: f32,
    rejection: Rejection,
    seed: u64,
    /// The bound on the largest error over that on the root of the mean squared error.
    peak: f32,
    files: Vec<String>,
}

fn options() -> Result<Options, Box<dyn Error>> {
    let mut options = Options {
        bricks: None,
        whole_plain: false,
        clusters: 100,
        iterations: 5,
        threshold: 0.01,
        rejection: Rejection::VarianceOverMean,
        seed: 1,
        peak: 1.0,
        files: Vec::new(),
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut next = || arguments.next().ok_or(format!("{argument} lacks a value"));
        match argument.as_str() {
            "--plain" => options.whole_plain = true,
            "--bricks" => options.bricks = Some(next()?.parse()?),
            "--clusters" => options.clusters = next()?.parse()?,
            "--iterations" => options.iterations = next()?.parse()?,
            "--threshold" => options.threshold = next()?.parse()?,
            "--seed" => options.seed = next()?.parse()?,
            "--peak" => options.peak = next()?.parse()?,
            "--rule" => {
                options.rejection = match next()?.as_str() {
                    "4.5" => Rejection::NormalizedVariance,
                    "5.3" => Rejection::VarianceOverMean,
                    other => return Err(format!("no rule '{other}'; there are 4.5 and 5.3").into()),
                }
            }
            other if other.starts_with("--") => return Err(format!("no option '{other}'").into()),
            _ => options.files.push(argument),
        }
    }
    Ok(options)
}

/// A number in 0..1 that looks random.
fn random(counter: u64) -> f32 {
    let mut bits = counter.wrapping_mul(0x2545_f491_4f6c_dd1d) ^ 0x6a09_e667_f3bc_c908;
    for _ in 0..2 {
        bits = (bits ^ bits >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    }
    (bits >> 40) as f32 / (1 << 24) as f32
}

/// A slope, a bend and fine detail, each of a size that varies over orders of magnitude.
fn smoke_brick(index: usize) -> Brick {
    let number = |i: u64| random(index as u64 * 1024 + i);
    let size = |i: u64, largest: f32| largest * 0.01f32.powf(number(i));
    let direction = |i: u64| [number(i) - 0.5, number(i + 1) - 0.5, number(i + 2) - 0.5];
    let (slope, bend, detail) = (size(0, 0.3), size(1, 0.1), size(2, 0.02));
    let (along, across) = (direction(3), direction(6));
    let density = number(9);
    std::array::from_fn(|voxel| {
        let p = [voxel >> 6, voxel >> 3 & 7, voxel & 7].map(|i| (i as f32 - 3.5) / 4.0);
        let dot = |d: [f32; 3]| d[0] * p[0] + d[1] * p[1] + d[2] * p[2];
        let fine = number(16 + voxel as u64) - 0.5;
        (density + slope * dot(along) + bend * dot(across).powi(2) + detail * fine).max(0.0)
    })
}

fn file_bricks(path: &str) -> Result<Vec<Brick>, Box<dyn Error>> {
    let bytes = std::fs::read(path)?;
    let grid = File::open(&bytes[..])?.read_all()?.into_iter().next().ok_or("no grid in the file")?;
    let (channel, _) = import(grid)?;
    let values = match &channel.tree.bricks {
        Bricks::F32(values) => values.clone(),
        Bricks::F16(bits) => bits.iter().map(|bits| half::f16::from_bits(*bits).to_f32()).collect(),
    };
    Ok(values.as_chunks().0.to_vec())
}

fn bricks(options: &Options) -> Result<Vec<Brick>, Box<dyn Error>> {
    if options.files.is_empty() {
        return Ok((0..options.bricks.unwrap_or(90_000)).map(smoke_brick).collect());
    }
    let mut bricks = Vec::new();
    for file in &options.files {
        bricks.extend(file_bricks(file)?);
    }
    let own = bricks.len();
    for i in own..options.bricks.unwrap_or(own) {
        let factor = 0.8 + 0.4 * random(i as u64);
        let noise = |voxel: usize| 0.99 + 0.02 * random((i * 512 + voxel) as u64);
        let brick = bricks[i % own];
        bricks.push(std::array::from_fn(|voxel| brick[voxel] * factor * noise(voxel)));
    }
    Ok(bricks)
}

/// The root of the mean squared and the largest error of all voxels, kept ones included.
fn error(bricks: &[Brick], again: impl Fn(usize) -> Option<Brick>) -> (f64, f32) {
    let (mut squares, mut largest) = (0.0, 0f32);
    for (i, brick) in bricks.iter().enumerate() {
        let Some(other) = again(i) else { continue };
        for (a, b) in brick.iter().zip(&other) {
            squares += f64::from(a - b).powi(2);
            largest = largest.max((a - b).abs());
        }
    }
    ((squares / (bricks.len() * 512).max(1) as f64).sqrt(), largest)
}

fn mean_distance(bricks: &[Brick], taking_part: &[usize], found: &KMeans) -> f64 {
    let each = taking_part.iter().zip(&found.nearest);
    let sum: f64 =
        each.map(|(i, c)| f64::from(thesis::distance(&bricks[*i], &found.centres[*c as usize]))).sum();
    sum / taking_part.len().max(1) as f64
}

/// How much is left: the bytes of kept and new bricks, and what belongs to each shared one.
fn bytes_left(kept: usize, new: usize, shared: usize, own_bytes: usize) -> usize {
    (kept + new) * BRICK_BYTES + shared * own_bytes
}

fn print_result(name: &str, bricks: &[Brick], new: usize, shared: usize, own: usize, error: (f64, f32)) {
    let kept = bricks.len() - shared;
    let bytes = bytes_left(kept, new, shared, own) as f64 / (bricks.len() * BRICK_BYTES) as f64;
    println!(
        "{name:14} before={} after={} ratio={:.4} bytes_ratio={bytes:.4} new={new} rmse={:.6} max_error={:.4}",
        bricks.len(),
        kept + new,
        (kept + new) as f64 / bricks.len() as f64,
        error.0,
        error.1
    );
}

fn shapes_bytes(found: &shapes::Shapes) -> usize {
    let shared = found.of_brick.iter().flatten().count();
    bytes_left(found.of_brick.len() - shared, found.shapes.len(), shared, OWN_BYTES)
}

/// The smallest bound on the error at which sharing leaves no more of the bricks than `share_left`.
fn search_bound(bricks: &[Brick], settings: impl Fn(f32) -> shapes::Settings, share_left: f64) -> f32 {
    let step = bricks.len().div_ceil(SEARCH_BRICKS);
    let few: Vec<Brick> = bricks.iter().step_by(step).copied().collect();
    let wanted = share_left * (few.len() * BRICK_BYTES) as f64;
    let (mut low, mut high) = (1e-6f32, 10f32);
    for _ in 0..16 {
        let middle = (low * high).sqrt();
        let found = shapes::share(&few, &settings(middle));
        if shapes_bytes(&found) as f64 <= wanted { high = middle } else { low = middle }
    }
    high
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = options()?;
    let bricks = bricks(&options)?;
    let Options { clusters, iterations, threshold, rejection, seed, .. } = options;
    println!(
        "bricks={} clusters={clusters} iterations={iterations} threshold={threshold} {rejection:?}",
        bricks.len()
    );

    let begin = Instant::now();
    let taking_part = thesis::low_variance_bricks(&bricks, rejection, threshold);
    let centres = thesis::first_centres(&bricks, &taking_part, clusters, seed);
    let reject_secs = begin.elapsed().as_secs_f64();
    let begin = Instant::now();
    let fast = thesis::k_means(&bricks, &taking_part, centres.clone(), iterations);
    let fast_secs = begin.elapsed().as_secs_f64();
    println!(
        "fast k-means   taking_part={} reject_secs={reject_secs:.3} secs={fast_secs:.3} mean_distance={:.6}",
        taking_part.len(),
        mean_distance(&bricks, &taking_part, &fast)
    );

    let factor = if options.whole_plain { 1 } else { 10 };
    let few: Vec<usize> = taking_part.iter().copied().step_by(factor).collect();
    let begin = Instant::now();
    let plain = thesis::plain_k_means(&bricks, &few, centres.clone(), iterations);
    let plain_secs = begin.elapsed().as_secs_f64();
    let begin = Instant::now();
    let fast_few = thesis::k_means(&bricks, &few, centres, iterations);
    let fast_few_secs = begin.elapsed().as_secs_f64();
    let same = plain.nearest.iter().zip(&fast_few.nearest).filter(|(a, b)| a == b).count();
    println!(
        "plain k-means  taking_part={} secs={plain_secs:.3} (times {factor}: {:.3}) fast_secs={fast_few_secs:.3} \
         times_faster={:.1} mean_distance plain={:.6} fast={:.6} same_centre={:.5}",
        few.len(),
        plain_secs * factor as f64,
        plain_secs / fast_few_secs,
        mean_distance(&bricks, &few, &plain),
        mean_distance(&bricks, &few, &fast_few),
        same as f64 / few.len().max(1) as f64
    );

    let mut clusters = Clusters { centres: fast.centres, of_brick: vec![None; bricks.len()] };
    for (brick, centre) in taking_part.iter().zip(&fast.nearest) {
        clusters.of_brick[*brick] = Some(*centre);
    }
    let centre_of = |i: usize| clusters.of_brick[i].map(|centre| clusters.centres[centre as usize]);
    print_result("thesis", &bricks, clusters.centres.len(), taking_part.len(), 0, error(&bricks, centre_of));

    let left = bytes_left(bricks.len() - taking_part.len(), clusters.centres.len(), 0, 0) as f64
        / (bricks.len() * BRICK_BYTES) as f64;
    let settings = |max_error: f32| {
        let max_mse = (max_error / options.peak).powi(2);
        shapes::Settings { shapes: options.clusters, iterations, max_error, max_mse, seed }
    };
    let max_error = search_bound(&bricks, settings, left);
    let begin = Instant::now();
    let found = shapes::share(&bricks, &settings(max_error));
    println!(
        "shapes         secs={:.3} bound={max_error:.5} (the bound was searched for)",
        begin.elapsed().as_secs_f64()
    );
    let values_of =
        |i: usize| found.of_brick[i].map(|shared| shared.values(&found.shapes[shared.shape as usize]));
    let shared = found.of_brick.iter().flatten().count();
    print_result("shapes", &bricks, found.shapes.len(), shared, OWN_BYTES, error(&bricks, values_of));
    Ok(())
}
