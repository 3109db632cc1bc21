//! Pictures of a channel as it is and as it was stored, taken alike, and how they differ.
//!
//! View and scales are settled once, from the source, as `nuage render` settles them. There is no light of which a
//! picture sees but samples: no sky, and the sun has a ray from every step. A density is lit by the sun; a flame and a
//! temperature glow in the dark, without the smoke that would hide what is wrong with them.

use std::sync::Arc;

use clap::Parser;
use nuage_pipeline::import;
use nuage_render::camera::Camera;
use nuage_render::film::Image;
use nuage_render::framing::WorldBox;
use nuage_vdb::{Grid, Tree};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::format::Role;

use crate::look::Look;
use crate::shot::{Shot, Volume};

/// What is the same in all pictures of a channel.
pub(crate) struct Studio {
    shot: Shot,
    is_glowing: bool,
    /// The box of the source's active voxels.
    source_box: Option<IndexBox>,
    /// What is seen next; the channel in question is replaced for each picture.
    volume: Volume,
    reference: Image,
}

/// How a picture differs from that of the source, in linear radiance over all pixels and colours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Difference {
    /// The root of the mean squared difference.
    pub(crate) rmse: f64,
    /// The same as a part of the largest radiance in the picture of the source.
    pub(crate) of_max: f64,
}

/// The options of `nuage render` that make pictures of a channel comparable, read as if they stood on the command line.
///
/// # Errors
/// What is wrong, in words.
pub(crate) fn look(name: &str, role: Role, size: u32) -> Result<Look, String> {
    #[derive(Parser)]
    #[command(no_binary_name = true)]
    struct Options {
        #[command(flatten)]
        look: Look,
    }
    let size = format!("{size}x{size}");
    let mut options = vec!["--size", &size, "--sky", "0", "--background", "none", "--sun-rays", "1000000"];
    match role {
        Role::Flame => options.extend(["--sun", "none", "--flame", name]),
        Role::Temperature => options.extend(["--sun", "none", "--temperature", name]),
        _ => {}
    }
    Ok(Options::try_parse_from(options).map_err(|error| error.to_string())?.look)
}

impl Studio {
    /// Settles view and scales from a channel, and takes its picture.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub(crate) fn new(look: &Look, source: &Grid) -> Result<Self, String> {
        let channel = channel(source.clone())?;
        let (world_box, source_box) = (WorldBox::of(&channel), channel.active_box);
        let is_glowing = look.flame.is_some() || look.temperature.is_some();
        let volume = match is_glowing {
            true => {
                let nothing = Tree::empty(0.0_f32, nuage_vdb::Shape::STANDARD);
                let smoke = Grid { tree: Arc::new(nothing.into()), ..source.clone() };
                Volume {
                    density: self::channel(smoke)?,
                    coarse: None,
                    emission: Some(channel),
                    surface: None,
                }
            }
            false => Volume { density: channel, coarse: None, emission: None, surface: None },
        };
        let volumes = [volume];
        let shot = Shot::new(look, world_box, &volumes)?;
        let [volume] = volumes;
        let reference = shot.render(&volume, &|_, _| {}).map_err(|error| error.to_string())?;
        Ok(Studio { shot, is_glowing, source_box, volume, reference })
    }

    /// Takes the picture of the channel as it was stored, and holds it against that of the source.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub(crate) fn compare(&mut self, stored: Grid) -> Result<Difference, String> {
        let mut channel = channel(stored)?;
        // Steps begin at the box: from another one, the picture of the same values would be another.
        channel.active_box = union(channel.active_box, self.source_box);
        match self.is_glowing {
            true => self.volume.emission = Some(channel),
            false => self.volume.density = channel,
        }
        let image = self.shot.render(&self.volume, &|_, _| {}).map_err(|error| error.to_string())?;
        Ok(difference(&self.reference, &image))
    }

    /// The camera.
    pub(crate) fn camera(&self) -> Camera {
        self.shot.camera()
    }
}

/// A grid as a channel.
pub(crate) fn channel(grid: Grid) -> Result<Channel, String> {
    Ok(import::import(grid).map_err(|error| error.to_string())?.0)
}

fn union(a: Option<IndexBox>, b: Option<IndexBox>) -> Option<IndexBox> {
    match (a, b) {
        (Some(a), Some(b)) => Some(IndexBox { min: a.min.min(b.min), max: a.max.max(b.max) }),
        (a, b) => a.or(b),
    }
}

/// How an image differs from another of its size.
pub(crate) fn difference(reference: &Image, image: &Image) -> Difference {
    let (mut squares, mut largest) = (0.0_f64, 0.0_f32);
    for (a, b) in reference.pixels.iter().zip(&image.pixels) {
        for (a, b) in a[..3].iter().zip(&b[..3]) {
            squares += f64::from(a - b).powi(2);
            largest = largest.max(*a);
        }
    }
    let rmse = (squares / (3 * reference.pixels.len().max(1)) as f64).sqrt();
    let of_max = if largest > 0.0 { rmse / f64::from(largest) } else { rmse };
    Difference { rmse, of_max }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_over_all_pixels_and_colours_and_alpha_is_none() {
        let mut a = Image::new(2, 1).unwrap();
        a.pixels[0] = [4.0, 1.0, 0.0, 1.0];
        let mut b = a.clone();
        b.pixels[1] = [0.0, 3.0, 0.0, 0.5];
        let found = difference(&a, &b);
        assert_eq!(found, Difference { rmse: 1.5_f64.sqrt(), of_max: 1.5_f64.sqrt() / 4.0 });
        assert_eq!(difference(&a, &a), Difference { rmse: 0.0, of_max: 0.0 });
    }
}
