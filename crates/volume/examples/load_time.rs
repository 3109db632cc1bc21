//! How long a packed file takes to load: `cargo run --release -p nuage-volume --example load_time -- FILE.nuage…`.
//!
//! Prints, for each file, the median over several rounds of opening it and of bringing all its pages into memory as
//! bricks, on one thread and on all, and the voxels of bricks per second of the latter.

#![allow(clippy::print_stdout, reason = "the lines printed are what the program is for")]

use std::error::Error;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use nuage_volume::format::{Asset, FormatError};
use nuage_volume::space::BRICK_VOXELS;

const ROUNDS: usize = 9;

/// Loads all pages, each thread taking the next one that is left.
fn load_on(threads: usize, asset: &mut Asset) -> Result<(), FormatError> {
    let (next, count) = (AtomicUsize::new(0), asset.store().pages().len());
    let shared = &*asset;
    let read = || -> Result<Vec<(usize, Vec<u32>)>, FormatError> {
        let pages =
            std::iter::from_fn(|| Some(next.fetch_add(1, Ordering::Relaxed)).filter(|page| *page < count));
        pages.map(|page| Ok((page, shared.read_page(page)?))).collect()
    };
    let all = std::thread::scope(|scope| {
        let running: Vec<_> = (0..threads).map(|_| scope.spawn(read)).collect();
        running
            .into_iter()
            .map(|thread| thread.join().expect("no page panics"))
            .collect::<Result<Vec<_>, _>>()
    })?;
    all.into_iter().flatten().try_for_each(|(page, words)| asset.set_page(page, words))
}

fn main() -> Result<(), Box<dyn Error>> {
    let threads = std::thread::available_parallelism()?.get();
    for path in std::env::args().skip(1) {
        let bytes = std::fs::read(&path)?;
        let (mut open, mut load, mut load_all, mut bricks) = (Vec::new(), Vec::new(), Vec::new(), 0);
        for _ in 0..ROUNDS {
            let start = Instant::now();
            let mut asset = Asset::open(bytes.clone())?;
            open.push(start.elapsed().as_secs_f64());
            let mut other = Asset::open(bytes.clone())?;
            let start = Instant::now();
            asset.load_all()?;
            load.push(start.elapsed().as_secs_f64());
            let start = Instant::now();
            load_on(threads, &mut other)?;
            load_all.push(start.elapsed().as_secs_f64());
            bricks = asset.store().codecs().len();
        }
        let median = |times: &mut Vec<f64>| {
            times.sort_by(f64::total_cmp);
            times[times.len() / 2]
        };
        let (open, load, load_all) = (median(&mut open), median(&mut load), median(&mut load_all));
        let rate = |seconds: f64| (bricks * BRICK_VOXELS) as f64 / seconds / 1e6;
        println!(
            "{path}: opened in {:.1} ms, {bricks} bricks loaded in {:.1} ms, {:.0} M voxels/s; on {threads} threads in {:.1} ms, {:.0} M voxels/s",
            open * 1e3,
            load * 1e3,
            rate(load),
            load_all * 1e3,
            rate(load_all)
        );
    }
    Ok(())
}
