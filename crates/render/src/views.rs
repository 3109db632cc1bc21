//! Simple views of a field, for whoever looks for a mistake: accumulated density, depth of the first voxel, its index and
//! its density, and the surface of a level set. They need no light and no settings, and what they show is exact.

use glam::{DVec2, DVec3};

use crate::camera::{Camera, Ray};
use crate::film::{Image, ImageSizeError};
use crate::filter::Filter;
use crate::math::one_minus_exp_neg;
use crate::packet::{RAYS, Surface, first_voxels, optical_depths};
use crate::picture::each_packet;
use crate::surface::VoxelHit;
use crate::traverse::{Field, Reader};

/// What a view shows of the voxels along a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    /// White as opaque as the density along the ray makes it, `extinction` being that of density 1 per world length.
    Density {
        /// Per world length.
        extinction: f32,
    },
    /// How far away the first voxel of a density above 0 is: white at the near end of the field's distances from the camera,
    /// black at the far end.
    Depth,
    /// Where that voxel is, as a hue: its index `x + y n + z n²` in the field's box of n voxels along its longest axis.
    Index,
    /// The density of that voxel, as a hue from red at 0 to magenta at the largest.
    FirstDensity,
    /// Where values reach a level: white where it faces the camera, black where it is seen from the side.
    Surface {
        /// The value at the surface.
        level: f32,
    },
}

/// What a view makes of rays through a field.
pub struct Viewer<'f, 'a> {
    field: &'f Field<'a>,
    view: View,
    /// The nearest and furthest distance of a voxel from the camera.
    distances: [f64; 2],
    largest: f32,
    /// What a view of a surface shows.
    surface: Option<Surface<'f, 'a>>,
}

impl<'f, 'a> Viewer<'f, 'a> {
    /// Makes a view ready.
    pub fn new(field: &'f Field<'a>, view: View, camera: &Camera) -> Self {
        let surface = match view {
            View::Surface { level } => Some(Surface::new(field, level)),
            _ => None,
        };
        let distances = distances(&field.world_corners(), camera);
        Viewer { field, view, distances, largest: field.tree().bounds().max, surface }
    }

    /// Colours and opacities, linear light, colours times opacity.
    pub fn pixels(&self, reader: &mut Reader<'a>, rays: &[Ray; RAYS]) -> [[f32; 4]; RAYS] {
        if let View::Density { extinction } = self.view {
            let depths = optical_depths(self.field, reader, rays, Filter::Trilinear);
            return depths.map(|depth| [one_minus_exp_neg(extinction * depth); 4]);
        }
        if let Some(surface) = &self.surface {
            let hits = surface.first_hits(reader, rays);
            return std::array::from_fn(|i| {
                hits[i].map_or([0.0; 4], |hit| {
                    let facing = (-hit.normal.dot(rays[i].direction.as_vec3())).clamp(0.0, 1.0);
                    [facing, facing, facing, 1.0]
                })
            });
        }
        first_voxels(self.field, reader, rays, 0.0).map(|hit| {
            hit.map_or([0.0; 4], |hit| {
                let [r, g, b] = self.colour(&hit);
                [r, g, b, 1.0]
            })
        })
    }

    fn colour(&self, hit: &VoxelHit) -> [f32; 3] {
        match self.view {
            View::Density { .. } | View::Depth | View::Surface { .. } => {
                let [nearest, furthest] = self.distances;
                let share = (hit.distance - nearest) / (furthest - nearest);
                [(1.0 - share).clamp(0.0, 1.0) as f32; 3]
            }
            View::Index => {
                let [first, size] = self.field.voxel_box();
                // In doubles: 4096³ is beyond what single precision counts.
                let local = (hit.voxel.as_dvec3() - first).max(DVec3::ZERO);
                let side = size.max_element();
                let index = local.x + side * (local.y + side * local.z);
                hue((index / (side * side * side)) as f32)
            }
            // Up to magenta: a full circle would end at the red with which it began.
            View::FirstDensity => hue(hit.value / self.largest * (5.0 / 6.0)),
        }
    }
}

/// The nearest and the furthest distance from a camera that something between these corners can have.
pub fn distances(corners: &[DVec3; 8], camera: &Camera) -> [f64; 2] {
    let furthest_from = |p: DVec3| corners.iter().map(|corner| (*corner - p).length()).fold(0.0, f64::max);
    let centre = corners.iter().sum::<DVec3>() / 8.0;
    let nearest = ((centre - camera.origin).length() - furthest_from(centre)).max(0.0);
    [nearest, furthest_from(camera.origin)]
}

/// The full colour of a hue, where 0 and 1 are red, a third green and two thirds blue.
pub fn hue(turns: f32) -> [f32; 3] {
    let turns = turns - turns.floor();
    [0.0, 2.0, 4.0].map(|shift| {
        let sixth = (turns * 6.0 - shift).rem_euclid(6.0);
        (2.0 - (sixth.min(6.0 - sixth))).clamp(0.0, 1.0)
    })
}

/// The picture of a view, through the centres of pixels.
///
/// `progress` is called with tiles done and tiles in all, from any thread.
///
/// # Errors
/// If the picture has no pixels or too many.
pub fn render_view<'a>(
    field: &Field<'a>,
    view: View,
    camera: &Camera,
    [width, height]: [u32; 2],
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Result<Image, ImageSizeError> {
    let mut image = Image::new(width, height)?;
    let viewer = Viewer::new(field, view, camera);
    let packet = |reader: &mut Reader<'a>, pixels: &[[u32; 2]; RAYS]| {
        let centres = pixels.map(|[x, y]| DVec2::new(x.into(), y.into()) + 0.5);
        viewer.pixels(reader, &camera.rays(&centres, width, height))
    };
    image.pixels = each_packet([width, height], || field.reader(), packet, progress);
    Ok(image)
}
