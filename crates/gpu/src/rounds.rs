//! Shares of a still picture's work: what goes on in further dispatches where one would take longer than a driver lets it.
//!
//! Lavapipe leaves all loops of an invocation after 65,535 turns, and drivers of graphics cards take a dispatch of seconds for a
//! device that hangs. So each dispatch looks up so much and no more, and keeps what it knows of its pixels for the next. A
//! dispatch that the driver cut short keeps nothing, and is done again in smaller shares. The smallest share
//! is a walk to what a ray meets next and a look-up there, a whole exact shadow ray through nearest voxels, or what a path looks up
//! from one scattering to the next.
//!
//! What does not live here: what is kept (`shader/march_on.wgsl`, `shader/path_on.wgsl`), and who records the dispatches ([`crate::renderer`]).

use crate::device::Gpu;
use crate::error::GpuError;
use crate::upload::{bind, most_bytes};

/// The pixels that are finished together: enough to keep a graphics card busy, and few enough for what is kept of each.
pub(crate) const BAND_PIXELS: u32 = 1 << 16;
/// The bytes of what is kept of a pixel.
pub(crate) const KEPT_BYTES: u64 = 352;
/// The dispatches that are submitted at once.
const ROUNDS: usize = 8;
/// Where pixels begin in a band, behind the words that say how it went.
const HEAD_BYTES: u64 = 16;
const PIXEL_BYTES: u64 = size_of::<[f32; 4]>() as u64;

/// How much is done at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Share {
    /// The shadow rays, of paths the scatterings, of a pixel in a picture's first dispatch. Where there are more, others go on.
    pub(crate) rays: u32,
    /// The look-ups of a pixel in each of those.
    pub(crate) look_ups: u32,
}

/// The look-ups of a pixel in a dispatch that goes on. Eight pixels that share their loops, as in lavapipe, may take no turn together.
const LOOK_UPS: u32 = 4096;
/// The shadow rays of a picture's first dispatch, if all pixels take as many.
const FIRST_RAYS: u32 = 1 << 28;
/// The fewest of a pixel: most pictures are to be done at once, however many pixels they have.
const FEWEST_RAYS: u32 = 128;

impl Share {
    /// What is done at once of a picture of so many pixels.
    pub(crate) fn of(pixels: u32) -> Self {
        Share { rays: (FIRST_RAYS / pixels.max(1)).max(FEWEST_RAYS), look_ups: LOOK_UPS }
    }
}

/// What is kept of the pixels of a band.
#[derive(Debug)]
pub(crate) struct Band {
    buffer: wgpu::Buffer,
    group: wgpu::BindGroup,
}

/// How far a band has got.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Standing {
    pub(crate) is_unfinished: bool,
    /// Whether the driver left loops before their end.
    pub(crate) is_unsound: bool,
}

impl Band {
    /// `pass_layout` binds parameters and what a pass writes.
    pub(crate) fn new(
        gpu: &Gpu,
        pass_layout: &wgpu::BindGroupLayout,
        params: &wgpu::Buffer,
    ) -> Result<Band, GpuError> {
        let size_bytes = HEAD_BYTES + u64::from(BAND_PIXELS) * (PIXEL_BYTES + KEPT_BYTES);
        let limit_bytes = most_bytes(gpu);
        if size_bytes > limit_bytes {
            return Err(GpuError::Limit { what: "what is kept of a picture", size_bytes, limit_bytes });
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let buffer = gpu.empty_buffer("nuage band", size_bytes, usage)?;
        let group = bind(gpu, "nuage band", pass_layout, &[params, &buffer])?;
        Ok(Band { buffer, group })
    }

    /// Records the way of a picture's pixels to the band, of which nothing is known yet.
    pub(crate) fn begin(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        picture: &wgpu::Buffer,
        first: u32,
        count: u32,
    ) {
        let at = u64::from(first) * PIXEL_BYTES;
        encoder.copy_buffer_to_buffer(picture, at, &self.buffer, HEAD_BYTES, u64::from(count) * PIXEL_BYTES);
        encoder.clear_buffer(&self.buffer, HEAD_BYTES + u64::from(BAND_PIXELS) * PIXEL_BYTES, None);
    }

    /// Records some dispatches of a pass with its groups bound by `set`.
    pub(crate) fn record(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        groups: u32,
        set: impl Fn(&mut wgpu::ComputePass<'_>),
    ) {
        encoder.clear_buffer(&self.buffer, 0, Some(HEAD_BYTES));
        for _ in 0..ROUNDS {
            // Only the last one says whether something is left.
            encoder.clear_buffer(&self.buffer, 0, Some(wgpu::COPY_BUFFER_ALIGNMENT));
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some("nuage band"),
                timestamp_writes: None,
            });
            set(&mut pass);
            pass.set_bind_group(1, &self.group, &[]);
            pass.dispatch_workgroups(groups, 1, 1);
        }
    }

    /// How far it has got.
    pub(crate) fn standing(&self, gpu: &Gpu) -> Result<Standing, GpuError> {
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&gpu.read_range(&self.buffer, 0..HEAD_BYTES)?);
        Ok(Standing { is_unfinished: words[0] != 0, is_unsound: words[1] != 0 })
    }

    /// Records the way of the band's pixels back to the picture.
    pub(crate) fn end(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        picture: &wgpu::Buffer,
        first: u32,
        count: u32,
    ) {
        let at = u64::from(first) * PIXEL_BYTES;
        encoder.copy_buffer_to_buffer(&self.buffer, HEAD_BYTES, picture, at, u64::from(count) * PIXEL_BYTES);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arrays::Arrays;
    use crate::look::{Look, Pass};
    use crate::renderer::Renderer;
    use crate::shader::{Features, Source};
    use crate::upload::Volume;
    use glam::DVec3;
    use nuage_render::camera::Camera;
    use nuage_render::march::Quality;
    use nuage_render::path::PathSettings;
    use nuage_render::scene::Spectrum;

    #[test]
    fn there_is_room_for_what_is_kept() {
        for (source, kept_bytes) in [(Source::MarchOn, KEPT_BYTES), (Source::PathOn, 96)] {
            let text = source.text(&Features::ALL);
            let module = naga::front::wgsl::parse_str(&text).expect("a valid shader");
            let found = module.types.iter().find(|(_, kind)| kind.name.as_deref() == Some("Band"));
            let Some((_, naga::Type { inner: naga::TypeInner::Struct { members, span }, .. })) = found else {
                panic!("no band")
            };
            let places: Vec<u64> = members.iter().map(|member| u64::from(member.offset)).collect();
            let pixels = u64::from(BAND_PIXELS);
            assert_eq!(places, [0, 4, HEAD_BYTES, HEAD_BYTES + pixels * PIXEL_BYTES], "{source:?}");
            assert_eq!(u64::from(*span), HEAD_BYTES + pixels * (PIXEL_BYTES + kept_bytes), "{source:?}");
        }
    }

    /// A picture by shares of so many rays and look-ups.
    fn shown(renderer: &mut Renderer, volume: &Volume, rays: u32, look_ups: u32) -> Vec<[f32; 4]> {
        renderer.set_share(Share { rays, look_ups });
        renderer.run(volume).expect("a run");
        renderer.pixels().expect("pixels")
    }

    /// However little is done at once, and though the first dispatch gives up at once, the picture has the same bits.
    #[test]
    fn pictures_are_the_same_in_any_shares() {
        let Some(gpu) = crate::twins::gpu() else { return };
        let channel = crate::hostile::block(3);
        let volume = Volume::new(&gpu, &Arrays::of_channels(&[&channel]).expect("arrays")).expect("a volume");
        let eye = DVec3::new(5.0, 4.0, 6.0);
        let camera = Camera::look_at(eye, DVec3::splat(0.6), DVec3::Y, 12.0).expect("a view");
        let mut look = Look { camera, ..crate::hostile::look() };
        look.media[0].glow = Some((Some(0), Spectrum::Linear { rgb: [0.1, 0.2, 0.3] }));
        let mut renderer = Renderer::new(&gpu, [24, 16]).expect("a renderer");
        let quality = Quality { samples: 2, sky_rays: 2, sun_rays: 4, ..Quality::default() };
        renderer.prepare(&volume, &look, &Pass::March(quality), 0, None).expect("a pass");
        let expected = shown(&mut renderer, &volume, u32::MAX, 0);
        assert!(expected.iter().filter(|pixel| pixel[0] > 0.0).count() > 100, "little is seen");
        for (rays, look_ups) in [(0, u32::MAX), (2, 100)] {
            let found = shown(&mut renderer, &volume, rays, look_ups);
            assert!(found == expected, "{rays} rays, {look_ups} look-ups");
        }
    }

    /// Paths that are scattered without end in what is thick and white: lavapipe leaves loops, and the mean of two paths is the
    /// same however little of one is done at once.
    #[test]
    fn paths_are_the_same_in_any_shares() {
        let Some(gpu) = crate::twins::gpu() else { return };
        let channel = crate::hostile::block(3);
        let volume = Volume::new(&gpu, &Arrays::of_channels(&[&channel]).expect("arrays")).expect("a volume");
        let eye = DVec3::new(5.0, 4.0, 6.0);
        let camera = Camera::look_at(eye, DVec3::splat(0.6), DVec3::Y, 12.0).expect("a view");
        let mut look = Look { camera, ..crate::hostile::look() };
        (look.media[0].extinction, look.media[0].albedo) = ([150.0; 3], [1.0; 3]);
        let mut renderer = Renderer::new(&gpu, [12, 8]).expect("a renderer");
        let mut mean = |rays, look_ups| {
            let mut pixels = Vec::new();
            for sample in 0..2 {
                let pass = Pass::Path { settings: PathSettings::default(), sample };
                renderer.prepare(&volume, &look, &pass, 0, None).expect("a pass");
                pixels = shown(&mut renderer, &volume, rays, look_ups);
            }
            pixels
        };
        let expected = mean(u32::MAX, LOOK_UPS);
        assert!(expected.iter().filter(|pixel| pixel[0] > 0.0).count() > 20, "little is seen");
        assert!(mean(3, 2000) == expected, "shares show");
        if gpu.name().contains("llvmpipe") {
            let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            renderer.record(&mut encoder, &volume).expect("a record");
            gpu.queue().submit([encoder.finish()]);
            assert!(matches!(renderer.pixels(), Err(GpuError::Misuse(_))), "one dispatch is enough");
        }
    }
}
