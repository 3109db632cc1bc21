//! The picture of a difference: A, B, and what differs between their pictures, multiplied.
//!
//! Both are rendered as `nuage render` would, with the view and the scales that A gets. Which frame is shown is decided
//! by the caller.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use nuage_pipeline::output::write_whole;
use nuage_render::film::{Image, contact_sheet};
use nuage_render::output::png::encode_png;
use serde_json::{Value, json};

use super::{Args, Pair};
use crate::error::Failure;
use crate::look::Look;
use crate::shot::{self, Shot, Volume};
use crate::source::DiskFile;
use crate::text::{number, one_line};
use crate::values::Auto;

/// The space between two of the three pictures in pixels, and its linear grey.
const GAP: (u32, f32) = (4, 0.2);

/// A picture that was written.
pub(super) struct Picture {
    path: PathBuf,
    frame: Option<i64>,
    /// By what the difference is multiplied.
    factor: f32,
    /// The largest difference of a pixel's light before that.
    largest: f32,
}

/// Refuses a name that says another format.
pub(super) fn check_name(path: &Path) -> Result<(), Failure> {
    match path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
        true => Ok(()),
        false => Err(Failure::Usage(format!("'{}': the picture is written as .png", path.display()))),
    }
}

/// Renders a pair of frames and writes the picture.
///
/// # Errors
/// If one cannot be rendered, or the picture not be written.
pub(super) fn write(path: &Path, pair: &Pair, args: &Args) -> Result<Picture, Failure> {
    let [a, b] = [load(&pair.files[0], args)?, load(&pair.files[1], args)?];
    let shot = Shot::new(&args.look, a.world_box(), std::slice::from_ref(&a)).map_err(Failure::Usage)?;
    let render = |volume: &Volume| shot.render(volume, &|_, _| ()).map_err(|e| Failure::Usage(e.to_string()));
    let [a, b] = [render(&a)?, render(&b)?];
    let largest = a
        .pixels
        .iter()
        .zip(&b.pixels)
        .fold(0.0, |largest: f32, (a, b)| (0..3).map(|i| (a[i] - b[i]).abs()).fold(largest, f32::max));
    let factor = match args.amplify {
        Auto::Value(factor) => factor,
        Auto::Auto => round_factor(largest),
    };
    let difference = difference(&a, &b, factor);
    let sheet = contact_sheet(&[a, b, difference], 3, GAP.0, [GAP.1; 3]);
    let sheet = sheet.map_err(|error| Failure::Usage(error.to_string()))?;
    let bytes = encode_png(&sheet).map_err(|error| Failure::file(path, error.to_string()))?;
    write_whole(path, &bytes, args.force).map_err(|error| Failure::file(path, error.to_string()))?;
    Ok(Picture { path: path.to_owned(), frame: pair.number, factor, largest })
}

fn load(path: &Path, args: &Args) -> Result<Volume, Failure> {
    let disk = DiskFile::open(path)?;
    let file = disk.vdb()?;
    let look: &Look = &args.look;
    // What is changed on the way to a medium is no difference.
    shot::load(&file, args.grid.as_deref(), look, &mut |_| ()).map_err(|e| Failure::file(path, e))
}

/// The largest of 1, 2, 5, 10, 20, ... by which the largest difference is multiplied without exceeding 1; 1 if there
/// is none.
fn round_factor(largest: f32) -> f32 {
    let factors = (0..8).flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10.0_f32.powi(power)));
    match largest > 0.0 {
        true => factors.take_while(|factor| factor * largest <= 1.0).last().unwrap_or(1.0),
        false => 1.0,
    }
}

/// The distance of the light of each pixel, times a factor, opaque.
fn difference(a: &Image, b: &Image, factor: f32) -> Image {
    let pixel = |(a, b): (&[f32; 4], &[f32; 4])| {
        let [red, green, blue] = [0, 1, 2].map(|i| factor * (a[i] - b[i]).abs());
        [red, green, blue, 1.0]
    };
    Image { pixels: a.pixels.iter().zip(&b.pixels).map(pixel).collect(), ..*a }
}

impl Picture {
    /// Says what the picture shows.
    pub(super) fn print(&self, out: &mut impl Write) -> io::Result<()> {
        let frame = self.frame.map_or(String::new(), |frame| format!(" of frame {frame}"));
        let [factor, largest] = [self.factor, self.largest].map(|x| number(f64::from(x)));
        let path = one_line(&self.path.display().to_string());
        writeln!(
            out,
            "{path}: A, B and their difference times {factor}{frame}; no pixel differs by more than {largest}"
        )
    }

    /// The same as an object.
    pub(super) fn json(&self) -> Value {
        json!({
            "path": self.path.display().to_string(),
            "frame": self.frame,
            "factor": self.factor,
            "largest_difference": self.largest,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_makes_the_difference_seen_and_clips_nothing() {
        for (largest, factor) in
            [(0.0, 1.0), (3.0, 1.0), (0.6, 1.0), (0.5, 2.0), (0.04, 20.0), (0.001, 1000.0)]
        {
            assert_eq!(round_factor(largest), factor, "{largest}");
        }
    }

    #[test]
    fn a_difference_is_a_distance_and_opaque() {
        let image = |value: f32| Image { width: 1, height: 1, pixels: vec![[value, 0.5, 0.0, 0.25]] };
        assert_eq!(difference(&image(0.25), &image(0.5), 2.0).pixels, [[0.5, 0.0, 0.0, 1.0]]);
    }
}
