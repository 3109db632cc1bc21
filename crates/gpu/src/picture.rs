//! From a scene to a picture in one go: uploads the channels of a scene, renders, and reads back.
//!
//! For programs that make files. Whoever shows pictures keeps a [`Volume`] and a [`Renderer`].

use nuage_render::film::Image;
use nuage_render::march::Quality;
use nuage_render::path::PathSettings;
use nuage_render::scene::Scene;
use nuage_render::views::View;

use crate::arrays::Arrays;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::look::{Look, Pass, channels_of};
use crate::renderer::Renderer;
use crate::upload::Volume;

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Asked {
    /// A debug view.
    View(View),
    /// Single scattering.
    March(Quality),
    /// Multiple scattering.
    Path {
        /// How paths are made.
        settings: PathSettings,
        /// Paths per pixel.
        samples: u32,
    },
}

/// Renders a scene; all but paths show one of a single grid. The picture's alpha is 1 − transmittance; nothing stands behind the medium yet.
///
/// `progress` is called with passes done and passes in all.
///
/// # Errors
/// If the scene has what this renderer cannot draw, exceeds what the device takes, or the device fails.
pub fn render(
    gpu: &Gpu,
    scene: &Scene<'_>,
    asked: &Asked,
    size: [u32; 2],
    progress: &dyn Fn(u32, u32),
) -> Result<Image, GpuError> {
    let look = Look::of_scene(scene)?;
    let volume = Volume::new(gpu, &Arrays::of_channels(&channels_of(scene))?)?;
    let mut renderer = Renderer::new(gpu, size)?;
    let passes = match asked {
        Asked::Path { samples, .. } => (*samples).max(1),
        Asked::View(_) | Asked::March(_) => 1,
    };
    for sample in 0..passes {
        let pass = match *asked {
            Asked::View(view) => Pass::View(view),
            Asked::March(quality) => Pass::March(quality),
            Asked::Path { settings, .. } => Pass::Path { settings, sample },
        };
        renderer.prepare(&volume, &look, &pass, 0, None)?;
        renderer.run(&volume)?;
        progress(sample + 1, passes);
    }
    let [width, height] = size;
    let mut image = Image::new(width, height).map_err(|error| GpuError::Misuse(error.to_string()))?;
    image.pixels = renderer.pixels()?;
    Ok(image)
}
