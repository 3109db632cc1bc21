//! Times reading every grid of a file: `cargo run --release -p nuage-vdb --example read_time -- FILE REPEATS`.
//!
//! Prints one line, `median_ms=... min_ms=... grids=... active_voxels=...`. Getting the bytes from the file system
//! is timed, freeing the grids is not. `bench/read_vs_openvdb.sh` sets it beside OpenVDB's own reader.

#![allow(clippy::print_stdout, reason = "the line printed is what the program is for")]

use std::borrow::Cow;
use std::error::Error;
use std::io;
use std::time::Instant;

use nuage_vdb::{File, Grid, Source};

/// A file on disk, of which the reader asks for as much as it decodes at a time.
struct Disk(std::fs::File);

impl Source for Disk {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.0.metadata()?.len())
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        let mut bytes = vec![0; len];
        read_exact_at(&self.0, &mut bytes, offset)?;
        Ok(Cow::Owned(bytes))
    }
}

#[cfg(unix)]
fn read_exact_at(file: &std::fs::File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

#[cfg(not(unix))]
fn read_exact_at(mut file: &std::fs::File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    use std::io::{Read, Seek};
    // Two threads must not move the place of one another.
    static TURN: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _turn = TURN.lock().map_err(|_| io::Error::other("another reader failed"))?;
    file.seek(io::SeekFrom::Start(offset))?;
    file.read_exact(bytes)
}

fn read_all_grids(path: &str) -> Result<Vec<Grid>, Box<dyn Error>> {
    Ok(File::open(Disk(std::fs::File::open(path)?))?.read_all()?)
}

fn median(sorted: &[f64]) -> Option<f64> {
    let upper = sorted.get(sorted.len() / 2)?;
    let lower = sorted.get((sorted.len() - 1) / 2)?;
    Some((lower + upper) / 2.0)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [path, repeats] = arguments.as_slice() else {
        return Err("usage: read_time FILE REPEATS".into());
    };
    let mut times_ms = Vec::new();
    let mut counts = (0, 0);
    for _ in 0..repeats.parse::<u32>()? {
        let begin = Instant::now();
        let grids = read_all_grids(path)?;
        times_ms.push(begin.elapsed().as_secs_f64() * 1e3);
        if times_ms.len() == 1 {
            counts = (grids.len(), grids.iter().map(|grid| grid.tree.active_voxel_count()).sum::<u64>());
        }
    }
    times_ms.sort_by(f64::total_cmp);
    let (Some(median), Some(min)) = (median(&times_ms), times_ms.first()) else {
        return Err("REPEATS must be at least 1".into());
    };
    println!("median_ms={median:.3} min_ms={min:.3} grids={} active_voxels={}", counts.0, counts.1);
    Ok(())
}
