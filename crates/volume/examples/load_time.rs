//! How long a packed file takes to load: `cargo run --release -p nuage-volume --example load_time -- FILE.nuage…`.
//!
//! Prints, for each file, the median over several rounds of opening it and of bringing all its pages into memory as
//! bricks, on one thread, and the voxels of bricks per second of the latter.

#![allow(clippy::print_stdout, reason = "the lines printed are what the program is for")]

use std::error::Error;
use std::time::Instant;

use nuage_volume::format::Asset;
use nuage_volume::space::BRICK_VOXELS;

const ROUNDS: usize = 9;

fn main() -> Result<(), Box<dyn Error>> {
    for path in std::env::args().skip(1) {
        let bytes = std::fs::read(&path)?;
        let (mut open, mut load, mut bricks) = (Vec::new(), Vec::new(), 0);
        for _ in 0..ROUNDS {
            let start = Instant::now();
            let mut asset = Asset::open(bytes.clone())?;
            open.push(start.elapsed().as_secs_f64());
            let start = Instant::now();
            asset.load_all()?;
            load.push(start.elapsed().as_secs_f64());
            bricks = asset.store().codecs().len();
        }
        let median = |times: &mut Vec<f64>| {
            times.sort_by(f64::total_cmp);
            times[times.len() / 2]
        };
        let (open, load) = (median(&mut open), median(&mut load));
        let rate = (bricks * BRICK_VOXELS) as f64 / load / 1e6;
        println!(
            "{path}: opened in {:.1} ms, {bricks} bricks loaded in {:.1} ms, {rate:.0} M voxels/s",
            open * 1e3,
            load * 1e3
        );
    }
    Ok(())
}
