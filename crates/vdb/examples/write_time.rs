//! Times writing every grid of a file:
//! `cargo run --release -p nuage-vdb --example write_time -- FILE COMPRESSION WIDTH REPEATS [OUTPUT]`,
//! COMPRESSION being `blosc`, `zip` or `none`, and WIDTH `full` or `half` for how floats are saved.
//!
//! Prints one line, `median_ms=... min_ms=... grids=... active_voxels=... bytes=...`. The bytes go to memory
//! that is there already; reading is not timed. With OUTPUT, writes that file at the end.
//! `bench/write_vs_openvdb.sh` sets it beside OpenVDB's own writer.

#![allow(clippy::print_stdout, reason = "the line printed is what the program is for")]

use std::error::Error;
use std::time::Instant;

use nuage_vdb::{Compression, File, WriteOptions};

fn median(sorted: &[f64]) -> Option<f64> {
    let upper = sorted.get(sorted.len() / 2)?;
    let lower = sorted.get((sorted.len() - 1) / 2)?;
    Some((lower + upper) / 2.0)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [path, compression, width, repeats, output @ ..] = arguments.as_slice() else {
        return Err("usage: write_time FILE blosc|zip|none full|half REPEATS [OUTPUT]".into());
    };
    let compression = match compression.as_str() {
        "blosc" => Compression::BLOSC,
        "zip" => Compression::ZIP,
        "none" => Compression::NONE,
        other => return Err(format!("no such compression: {other}").into()),
    };
    let file = File::open(std::fs::read(path)?)?;
    let mut grids = file.read_all()?;
    grids.iter_mut().for_each(|grid| grid.save_float_as_half = width == "half");
    let options = WriteOptions { compression };
    let mut times_ms = Vec::new();
    let mut bytes = Vec::new();
    for _ in 0..repeats.parse::<u32>()? {
        bytes.clear();
        let begin = Instant::now();
        nuage_vdb::write(&grids, &file.metadata, &options, &mut bytes)?;
        times_ms.push(begin.elapsed().as_secs_f64() * 1e3);
    }
    times_ms.sort_by(f64::total_cmp);
    let (Some(median), Some(min)) = (median(&times_ms), times_ms.first()) else {
        return Err("REPEATS must be at least 1".into());
    };
    let active_voxels: u64 = grids.iter().map(|grid| grid.tree.active_voxel_count()).sum();
    println!(
        "median_ms={median:.3} min_ms={min:.3} grids={} active_voxels={active_voxels} bytes={}",
        grids.len(),
        bytes.len()
    );
    if let [output, ..] = output {
        std::fs::write(output, bytes)?;
    }
    Ok(())
}
