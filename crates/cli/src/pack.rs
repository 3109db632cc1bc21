//! `nuage convert … out.nuage`: a file or a sequence to one packed file.
//!
//! The options and the closing report live here; packing itself is the pipeline's.

use std::collections::HashSet;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::Instant;

use nuage_pipeline::output::{OutputError, write_whole_with};
use nuage_pipeline::pack::assemble::Report;
use nuage_pipeline::pack::frame::{Bound, Options};
use nuage_pipeline::pack::sequence::{FrameName, PackError, pack};
use nuage_pipeline::sequence::{FrameFile, FrameRange};
use nuage_volume::codec::Codec;

use crate::convert;
use crate::error::Failure;
use crate::progress;
use crate::source::DiskFile;
use crate::text::{number, one_line, thousands};

/// What is asked of a packed file.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct PackArgs {
    /// The least signal-to-noise ratio of .nuage files in dB, in every frame [default: 45, unless another is asked for]
    #[arg(long, value_name = "DB")]
    psnr: Option<f64>,

    /// The most bits per voxel of bricks that are not constant, in .nuage files
    #[arg(long, value_name = "BITS")]
    bits_per_voxel: Option<f64>,

    /// How many coarser levels of detail .nuage files get at most
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=12))]
    levels: u32,

    /// How many shapes the bricks of .nuage files may share at most: smaller where errors may be large, but slower
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=4096))]
    shapes: u32,

    /// Frames per second, kept in .nuage files
    #[arg(long, value_name = "RATE")]
    fps: Option<f64>,

    /// Frames of a sequence to convert, as in 1-100, 1-100x2 or 5,10-20; negative numbers too
    #[arg(long, value_name = "RANGE", allow_hyphen_values = true)]
    pub(crate) frames: Option<FrameRange>,
}

impl PackArgs {
    /// The names of the options that were given, which are for packed files alone.
    pub(crate) fn given(&self) -> [(&'static str, bool); 5] {
        [
            ("--psnr", self.psnr.is_some()),
            ("--bits-per-voxel", self.bits_per_voxel.is_some()),
            ("--levels", self.levels > 0),
            ("--shapes", self.shapes > 0),
            ("--fps", self.fps.is_some()),
        ]
    }

    /// What the options ask for.
    ///
    /// # Errors
    /// If they make no sense, in words.
    pub(crate) fn options(&self, max_error: Option<Bound>, codec: Option<Codec>) -> Result<Options, Failure> {
        let is_amount = |value: Option<f64>| value.is_none_or(|value| value.is_finite() && value > 0.0);
        for (name, value) in
            [("--psnr", self.psnr), ("--bits-per-voxel", self.bits_per_voxel), ("--fps", self.fps)]
        {
            if !is_amount(value) {
                return Err(Failure::Usage(format!("{name} must be a number above 0")));
            }
        }
        let nothing_asked =
            self.psnr.is_none() && self.bits_per_voxel.is_none() && max_error.is_none() && codec.is_none();
        let default = Options::default();
        Ok(Options {
            max_error: if nothing_asked { default.max_error } else { max_error },
            psnr: if nothing_asked { default.psnr } else { self.psnr },
            bits_per_voxel: self.bits_per_voxel,
            codec,
            coarser_levels: self.levels,
            shapes: self.shapes,
        })
    }
}

/// A bound as it is written: `0.01`, or `3%` of the channel's peak.
pub(crate) fn bound(text: &str) -> Result<Bound, String> {
    let (digits, is_part) = match text.strip_suffix('%') {
        Some(digits) => (digits, true),
        None => (text, false),
    };
    let value: f32 =
        digits.trim().parse().map_err(|_| "write a number, or one with % for a part of the peak")?;
    match value.is_finite() && value >= 0.0 {
        true if is_part => Ok(Bound::OfPeak(value / 100.0)),
        true => Ok(Bound::Absolute(value)),
        false => Err("an error is 0 or above".into()),
    }
}

/// Packs frames into the file `output`.
///
/// # Errors
/// If one cannot be read, or the file not be written.
pub(crate) fn run(
    args: &convert::Args,
    frames: &[FrameFile],
    options: &Options,
    output: &Path,
) -> Result<(), Failure> {
    let start = Instant::now();
    let name = |frame: &FrameFile| {
        let name = frame.path.file_name().unwrap_or(frame.path.as_os_str());
        FrameName { number: frame.frame, name: name.to_string_lossy().into_owned() }
    };
    let names: Vec<FrameName> = frames.iter().map(name).collect();
    let mut numbers = HashSet::new();
    // A frame is asked for by its number, or by its place if it has none.
    let number = |(place, name): (usize, &FrameName)| name.number.unwrap_or(place as i64 + 1);
    if let Some(twice) = names.iter().enumerate().map(number).find(|number| !numbers.insert(*number)) {
        return Err(Failure::Usage(format!(
            "two frames would have the number {twice}; a .nuage file takes one sequence: put grids of several \
             files together in .vdb files first"
        )));
    }
    let bar = progress::bar(1);
    bar.set_message(one_line(&output.display().to_string()));
    let load = |frame: usize| convert::load(args, &frames[frame].path);
    let written = write_whole_with(output, args.force, |file| {
        let mut done = |part: f64| bar.set_position((part * 1000.0) as u64);
        pack(&names, load, BufWriter::new(file), options, args.pack.fps, &mut done).map_err(PackFailure::Pack)
    });
    bar.finish_and_clear();
    let (report, plan) = written.map_err(|failure| match failure {
        PackFailure::Output(error) => Failure::file(output, error.to_string()),
        PackFailure::Pack(PackError::Load(failure)) => failure,
        PackFailure::Pack(other) => Failure::file(output, other.to_string()),
    })?;
    for what in &plan.left_out {
        let _ = writeln!(io::stderr(), "nuage: left out: {}", one_line(what));
    }
    if plan.channels.is_empty() {
        let _ = writeln!(io::stderr(), "nuage: there was no grid to pack");
    }
    let input_bytes =
        frames.iter().map(|frame| DiskFile::open(&frame.path).map_or(0, |file| file.size())).sum();
    print(&report, output, input_bytes, start.elapsed().as_secs_f64())?;
    Ok(())
}

/// Why a packed file was not written.
enum PackFailure {
    Output(OutputError),
    Pack(PackError<Failure>),
}

impl From<OutputError> for PackFailure {
    fn from(error: OutputError) -> Self {
        PackFailure::Output(error)
    }
}

/// Says what became of the frames.
fn print(report: &Report, output: &Path, input_bytes: u64, seconds: f64) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let rounded =
        |value: f64, digits: i32| number((value * 10.0_f64.powi(digits)).round() / 10.0_f64.powi(digits));
    let disk = report.summary.file_bytes;
    let ratio = rounded(disk as f64 / input_bytes.max(1) as f64 * 100.0, 1);
    let frames = match report.contents.frames.len() {
        1 => "1 frame".to_owned(),
        count => format!("{count} frames"),
    };
    let path = one_line(&output.display().to_string());
    writeln!(
        out,
        "{path}: {frames}, {} bytes to {} ({ratio} %), {seconds:.2} s",
        thousands(input_bytes),
        thousands(disk)
    )?;
    let memory = report.tree_bytes + report.brick_bytes + report.shape_bytes;
    let voxels = report.source_bricks * 512;
    let per_voxel = |bytes: u64| rounded(bytes as f64 * 8.0 / voxels.max(1) as f64, 2);
    writeln!(
        out,
        "  in memory {} bytes: tree {}, bricks {}, shapes {}; {} bits per voxel of {} bricks; {} are stored",
        thousands(memory),
        thousands(report.tree_bytes),
        thousands(report.brick_bytes),
        thousands(report.shape_bytes),
        per_voxel(memory),
        thousands(report.source_bricks),
        thousands(report.bricks_stored),
    )?;
    writeln!(
        out,
        "  tree: {} entries, {} bytes each with nodes and masks",
        thousands(report.entries),
        rounded(report.tree_bytes as f64 / report.entries.max(1) as f64, 2)
    )?;
    for channel in &report.contents.channels {
        let component = channel
            .component
            .map_or(String::new(), |c| format!(".{}", ["x", "y", "z"][usize::from(c.min(2))]));
        let quality = channel.quality;
        let error = number(f64::from(quality.max_error));
        let psnr = match quality.squared_error > 0.0 {
            true => {
                let mean = quality.squared_error / quality.voxels.max(1) as f64;
                format!("{} dB", rounded(10.0 * (f64::from(channel.peak).powi(2) / mean).log10(), 2))
            }
            false => "exact".to_owned(),
        };
        writeln!(
            out,
            "  {}{component}: {psnr}, largest error {error} of a peak of {}",
            one_line(&channel.name),
            number(f64::from(channel.peak))
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bound_is_a_number_or_a_part_of_the_peak() {
        assert_eq!(bound("0.25"), Ok(Bound::Absolute(0.25)));
        assert_eq!(bound("3%"), Ok(Bound::OfPeak(0.03)));
        assert!(bound("-1").is_err() && bound("x%").is_err() && bound("inf").is_err());
    }
}
