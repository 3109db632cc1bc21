//! `nuage texture`: the bricks of a packed file as a 3D texture with a JSON sidecar, for engines of others.
//!
//! The options and the closing line live here; the texture, its files and the sidecar are the pipeline's.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;

use nuage_pipeline::output::write_both;
use nuage_pipeline::sequence::FrameRange;
use nuage_pipeline::texture::build::{Options, build, find_channel};
use nuage_pipeline::texture::layout::TextureFormat;
use nuage_pipeline::texture::{Container, sidecar};
use nuage_volume::format::Limits;

use crate::convert::check_absent;
use crate::error::Failure;
use crate::frames;
use crate::text::{one_line, thousands};

/// Write the bricks of a packed file as a 3D texture, and beside it a JSON file that says what they are
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The packed file, .nuage
    input: PathBuf,

    /// The texture, .dds or .ktx2; the JSON is this name with .json added
    output: PathBuf,

    /// The kind of texel: r8, r16f, bc4 (one voxel each), bc3, bc7 (four voxels each)
    #[arg(long, value_name = "FORMAT", default_value = "bc7", value_parser = format)]
    format: TextureFormat,

    /// The channel; of a vector with its component, as in vel.x [default: the only one, or the first density]
    #[arg(long, value_name = "NAME")]
    channel: Option<String>,

    /// The frames, as in 1-100, 1-100x2 or 5,10-20; negative numbers too [default: all]
    #[arg(long, value_name = "RANGE", allow_hyphen_values = true)]
    frames: Option<FrameRange>,

    /// One scale for all bricks, for engines that know of none per brick; less exact
    #[arg(long)]
    global: bool,

    /// Replace outputs that are there
    #[arg(long)]
    force: bool,
}

fn format(text: &str) -> Result<TextureFormat, String> {
    let found = TextureFormat::ALL.into_iter().find(|format| format.name() == text);
    found.ok_or_else(|| format!("there are {}", TextureFormat::ALL.map(TextureFormat::name).join(", ")))
}

/// Runs the subcommand.
///
/// # Errors
/// If the input cannot be read, has no such channel or frames, or the outputs cannot be written.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let extension = args.output.extension().and_then(|extension| extension.to_str());
    let container = extension
        .and_then(Container::of_extension)
        .ok_or_else(|| Failure::Usage("the output is a .dds or a .ktx2 file".into()))?;
    let mut json_path = OsString::from(&args.output);
    json_path.push(".json");
    let json_path = PathBuf::from(json_path);
    check_absent(&args.output, args.force)?;
    check_absent(&json_path, args.force)?;
    let failed = |what: String| Failure::file(&args.input, what);
    let mut asset = frames::open(&args.input)?;
    let channel =
        find_channel(asset.contents(), args.channel.as_deref()).map_err(|error| failed(error.to_string()))?;
    let is_wanted =
        |number: i64| args.frames.as_ref().is_none_or(|range: &FrameRange| range.contains(number));
    let count = asset.contents().frames.len();
    let wanted: Vec<usize> = (0..count).filter(|frame| is_wanted(frames::number(&asset, *frame))).collect();
    if wanted.is_empty() {
        return Err(failed("there is none of these frames".into()));
    }
    for frame in &wanted {
        frames::load_frame(&mut asset, *frame).map_err(|error| failed(error.to_string()))?;
    }
    let options = Options {
        format: args.format,
        channel,
        frames: wanted,
        common_scale: args.global,
        max_bytes: Limits::default().max_memory_bytes,
    };
    let texture = build(&asset, &options).map_err(|error| failed(error.to_string()))?;
    drop(asset);
    let name = args.output.file_name().unwrap_or_default().to_string_lossy();
    let json = sidecar::to_json(&texture, &name).map_err(|error| failed(error.to_string()))?;
    let ([x, y, z], bricks) = (texture.layout.size(), texture.bricks.len());
    let file = container.file(texture);
    let outputs = [(args.output.as_path(), file.as_slice()), (json_path.as_path(), json.as_slice())];
    write_both(outputs, args.force).map_err(|error| Failure::file(&args.output, error.to_string()))?;
    writeln!(
        io::stdout(),
        "{}: {x} × {y} × {z} texels of {}, {} bricks in {} frames, {} bytes; JSON {} bytes",
        one_line(&args.output.display().to_string()),
        args.format.name(),
        thousands(bricks as u64),
        thousands(options.frames.len() as u64),
        thousands(file.len() as u64),
        thousands(json.len() as u64)
    )?;
    Ok(())
}
