//! `nuage demo`: renders the sample sequence that comes with the program.
//!
//! The volumes are in [`sample`](crate::sample), the means in [`shot`]; here stand the choices of
//! taste.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Parser;
use nuage_pipeline::output::write_whole;
use nuage_render::film::{Image, contact_sheet};
use nuage_render::output::png::{encode_apng, encode_png_compact};

use crate::error::Failure;
use crate::look::Look;
use crate::progress;
use crate::sample::BLAST;
use crate::shot::{self, Shot};

/// The options of `nuage render` that the sample looks best with.
const LOOK: &str = "--size 300x412 --up z --camera -4.981,5.94,1.342 --look-at 1.93,1.95,1.92 --fov 19 \
    --sun 15,40 --sun-irradiance 13,9.6,6.4 --sky 0.035,0.06,0.11 --background 0.008,0.009,0.0115 \
    --density 12 --albedo 0.53,0.49,0.46 --phase 0.35 --temperature temperature --kelvin 940 --emission 0.03 \
    --step 0.5 --samples 4";

/// Every how many frames one is on the sheet, which ends with the last.
const SHEET_STEP: usize = 2;
const SHEET_COLUMNS: u32 = 4;
const SHEET_GAP_PIXELS: u32 = 3;
const SHEET_GAP_COLOUR: [f32; 3] = [0.003; 3];

const FRAMES_PER_SECOND: f64 = 12.0;

const SHEET: &str = "nuage-demo.png";
const ANIMATION: &str = "nuage-demo-animated.png";

/// Render the sample sequence that comes with the program, a ball of fire that turns to smoke.
///
/// Writes nuage-demo.png, a sheet of frames, and nuage-demo-animated.png, an animation (APNG) that every browser
/// plays; pictures of those names are replaced.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The folder to write to
    #[arg(short, long, value_name = "FOLDER", default_value = ".")]
    output: PathBuf,
}

/// Renders.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let start = Instant::now();
    check_output(args)?;
    let images = render(&look()?)?;
    write(args, &images, start, &mut io::stdout().lock())
}

/// Finds out before the work what would prevent its end.
fn check_output(args: &Args) -> Result<(), Failure> {
    if !fs::metadata(&args.output).is_ok_and(|data| data.is_dir()) {
        return Err(Failure::file(&args.output, "there is no such folder; make it first"));
    }
    Ok(())
}

/// The look of the sample, read as if it stood on the command line.
fn look() -> Result<Look, Failure> {
    #[derive(Parser)]
    #[command(no_binary_name = true)]
    struct Options {
        #[command(flatten)]
        look: Look,
    }
    let options = Options::try_parse_from(LOOK.split_whitespace());
    options.map(|options| options.look).map_err(|e| Failure::Usage(e.to_string()))
}

/// Renders all frames.
fn render(look: &Look) -> Result<Vec<Image>, Failure> {
    // The look leaves nothing open that would have to be settled from the volumes.
    let shot = Shot::new(look, None, &[]).map_err(Failure::Usage)?;
    let bar = progress::bar(BLAST.len());
    let image = |(i, bytes)| {
        let path = PathBuf::from(format!("sample frame {}", i + 1));
        bar.set_message(path.display().to_string());
        let file = nuage_vdb::File::open(bytes).map_err(|e| Failure::vdb(&path, &e))?;
        let volume = shot::load(&file, None, look, &mut |_| {}).map_err(|e| Failure::file(&path, e))?;
        let show = |done, total| progress::show(&bar, i, done, total);
        shot.render(&volume, &show).map_err(|e| Failure::Usage(e.to_string()))
    };
    let images = BLAST.into_iter().enumerate().map(image).collect();
    bar.finish_and_clear();
    images
}

/// Writes the sheet and the animation, and says so.
fn write(args: &Args, images: &[Image], start: Instant, out: &mut dyn Write) -> Result<(), Failure> {
    let refused = |name: &str, what: &dyn std::fmt::Display| Failure::file(Path::new(name), what.to_string());
    let chosen: Vec<Image> = images.iter().skip(SHEET_STEP - 1).step_by(SHEET_STEP).cloned().collect();
    let sheet = contact_sheet(&chosen, SHEET_COLUMNS, SHEET_GAP_PIXELS, SHEET_GAP_COLOUR);
    let sheet =
        encode_png_compact(&sheet.map_err(|e| refused(SHEET, &e))?).map_err(|e| refused(SHEET, &e))?;
    let animation = encode_apng(images, FRAMES_PER_SECOND).map_err(|e| refused(ANIMATION, &e))?;
    for (name, count, bytes) in [(SHEET, chosen.len(), sheet), (ANIMATION, images.len(), animation)] {
        let path = args.output.join(name);
        // What has these names is an earlier demo's.
        write_whole(&path, &bytes, true).map_err(|e| Failure::file(&path, e.to_string()))?;
        let (kilobytes, seconds) = (bytes.len() / 1000, start.elapsed().as_secs_f64());
        writeln!(out, "{}: {count} frames, {kilobytes} kB, after {seconds:.1} s", path.display())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;
    use crate::values::Size;

    #[test]
    fn the_demo_shows_fire_that_turns_to_smoke_and_can_be_repeated() {
        let mut look = look().unwrap();
        look.size = Size { width: 20, height: 27 };
        look.samples = Some(1);
        assert!(
            !Plan::of_look(&look, "", None).needs_volumes()
                && look.camera.is_some()
                && look.look_at.is_some()
        );
        let images = render(&look).unwrap();
        let redness = |image: &Image| {
            let [red, _, blue, _] = image.mean();
            red / blue
        };
        let (first, last) = (redness(&images[0]), redness(&images[15]));
        assert!(first > 3.0 && last < 2.0 && last > 0.8, "red to blue {first}, then {last}");

        let folder = tempfile::tempdir().unwrap();
        let mut args = Args { output: folder.path().to_owned() };
        check_output(&args).unwrap();
        let mut out = Vec::new();
        write(&args, &images, Instant::now(), &mut out).unwrap();
        assert_eq!(String::from_utf8(out).unwrap().lines().count(), 2);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);

        write(&args, &images, Instant::now(), &mut Vec::new()).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
        args.output = folder.path().join("nowhere");
        assert!(check_output(&args).is_err());
    }
}
