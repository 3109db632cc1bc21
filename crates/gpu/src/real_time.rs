//! Pictures that follow each other, at the cost that real time allows: what may be asked for, and the stages that such a
//! picture goes through on the device.
//!
//! The ray marcher draws them as it draws others, with steps that begin where blue noise says. Each measure stands for
//! itself: a volume of the sun's light in place of shadow rays, a quarter of the pixels in place of all, the mean of pictures
//! in place of one, and coarser steps while pictures take longer than they may.
//!
//! A quarter of the pixels is brought to all of them in space, not over pictures: the first picture, and each that shows
//! another frame of the volume, is whole at once. Where pictures are accumulated the quarter changes in turn, so that
//! nothing is lost where the camera rests.
//!
//! What does not live here: pipelines and the order of passes ([`crate::renderer`]).

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::DVec3;
use nuage_render::filter::Lookup;
use nuage_render::march::Quality;
use nuage_render::views;

use crate::blue_noise;
use crate::budget::{Budget, Effort};
use crate::device::Gpu;
use crate::error::GpuError;
use crate::light_volume;
use crate::look::Look;
use crate::params::{Params, Place};
use crate::shader::{Features, Source};
use crate::timer::Timer;
use crate::upload::{Content, Volume, bind, storage_entry};

/// How a picture that follows others is made cheap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RealTime {
    /// The sun's light is taken from a lattice of 96³ nodes, which is filled when the light or the frame changes, in place of a
    /// shadow ray each time. What is finer than a cell of it is lost: measured for a rough cloud of 36 voxels across, light is off
    /// by 1 % in the mean, of what there is in the mean.
    pub light_volume: bool,
    /// A quarter of the pixels is marched, and the others lie between them.
    pub half_resolution: bool,
    /// A picture is the mean of those before it, found again where the camera moved. Then few rays per picture do.
    pub accumulate: bool,
    /// The milliseconds that a picture may take on the device, or `None` for no such bound: while pictures take longer, steps
    /// are made longer and shadow rays fewer, and then a quarter of the pixels is marched. By timestamps of the device; where
    /// it has none or is one in software, [`crate::renderer::Renderer::run`] looks at the clock, and a host that records says
    /// what pictures took ([`crate::renderer::Renderer::took`]).
    pub budget_ms: Option<f32>,
}

impl Default for RealTime {
    fn default() -> Self {
        RealTime { light_volume: true, half_resolution: false, accumulate: true, budget_ms: None }
    }
}

/// What a pixel of the four around counts at least, where a quarter of the pixels is brought to all.
pub(crate) const LEAST_WEIGHT: f32 = 1e-4;
/// How far apart, in parts of a ray's length, the ends of two rays make a pixel count half.
pub(crate) const UPSAMPLE_TOLERANCE: f32 = 0.02;
/// How far, in parts of its length, the end of a ray may move before what was seen along it is no longer kept.
pub(crate) const KEPT_TOLERANCE: f32 = 0.01;

/// How many pictures a mean counts as where all stands still, …
const COUNT_STILL: f32 = 1024.0;
/// … where the camera moved, …
const COUNT_MOVED: f32 = 16.0;
/// … and where the medium or its light is another.
const COUNT_CHANGED: f32 = 2.0;

/// What a light volume was filled from.
#[derive(Debug, PartialEq)]
struct Filled {
    volume: Content,
    frame: u32,
    /// The channel that shadow rays read, and how.
    channel: u32,
    lookup: Lookup,
    /// Where it lies, and what makes depths of densities.
    lattice: [[f32; 4]; 6],
}

/// Says that a light volume was not filled when it is dropped before the encoder that fills it is done.
struct Awaited(Option<Arc<AtomicBool>>);

impl Drop for Awaited {
    fn drop(&mut self) {
        if let Some(is_missing) = self.0.take() {
            is_missing.store(true, Ordering::Relaxed);
        }
    }
}

/// Buffers and textures of the stages, and what goes from one picture to the next.
#[derive(Debug)]
pub(crate) struct Stages {
    layouts: [wgpu::BindGroupLayout; 4],
    /// For the light volume, the marcher, upsampling, and accumulating what was marched and what was upsampled.
    groups: [wgpu::BindGroup; 5],
    /// What passes write to, in place of the picture: what is marched, and all pixels of that.
    pub(crate) marched: wgpu::BindGroup,
    pub(crate) upsampled: wgpu::BindGroup,
    before: wgpu::Buffer,
    kept: [wgpu::Texture; 2],
    filled: Option<Filled>,
    /// Whether an encoder that was to fill it was dropped.
    is_missing: Arc<AtomicBool>,
    /// What the picture before was told, of which volume it was, and where its world began.
    last: Option<(Params, Content, DVec3)>,
    number: u32,
    budget: Budget,
    effort: Effort,
    timer: Option<Timer>,
    took_ms: Option<f32>,
    measures: RealTime,
}

impl Stages {
    /// The stages of pictures of a size, which write to `picture` in the end. `pass_layout` binds parameters and a picture.
    pub(crate) fn new(
        gpu: &Gpu,
        size: [u32; 2],
        pass_layout: &wgpu::BindGroupLayout,
        params: &wgpu::Buffer,
        picture: &wgpu::Buffer,
    ) -> Result<Stages, GpuError> {
        let buffer = |label| {
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
            gpu.empty_buffer(label, picture.size(), usage)
        };
        let (marched, upsampled, before) =
            (buffer("nuage marched")?, buffer("nuage upsampled")?, buffer("nuage before")?);
        let both = wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::TEXTURE_BINDING;
        let flat =
            |format, usage| texture(gpu, [size[0], size[1], 1], wgpu::TextureDimension::D2, format, usage);
        let depth = flat(wgpu::TextureFormat::R32Float, both)?;
        let kept_format = wgpu::TextureFormat::Rg32Float;
        let kept_before =
            flat(kept_format, wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING)?;
        let kept = flat(kept_format, both | wgpu::TextureUsages::COPY_SRC)?;
        let nodes = light_volume::NODES;
        // The smallest format of more than eight bits that every device writes to and filters.
        let light_format = wgpu::TextureFormat::Rgba16Float;
        let light = texture(gpu, [nodes; 3], wgpu::TextureDimension::D3, light_format, both)?;
        let noise = noise(gpu)?;
        let sampler = gpu.guarded(|| {
            gpu.device().create_sampler(&wgpu::SamplerDescriptor {
                label: Some("nuage light volume"),
                mag_filter: wgpu::FilterMode::Linear,
                min_filter: wgpu::FilterMode::Linear,
                ..wgpu::SamplerDescriptor::default()
            })
        })?;

        let compute = wgpu::ShaderStages::COMPUTE;
        let entry =
            |binding, ty| wgpu::BindGroupLayoutEntry { binding, visibility: compute, ty, count: None };
        let sampled = |binding, filterable, view_dimension| {
            let sample_type = wgpu::TextureSampleType::Float { filterable };
            entry(binding, wgpu::BindingType::Texture { sample_type, view_dimension, multisampled: false })
        };
        let written = |binding, format, view_dimension| {
            let access = wgpu::StorageTextureAccess::WriteOnly;
            entry(binding, wgpu::BindingType::StorageTexture { access, format, view_dimension })
        };
        let (d2, d3) = (wgpu::TextureViewDimension::D2, wgpu::TextureViewDimension::D3);
        let sampler_entry = entry(1, wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering));
        let of_light = [written(0, light_format, d3)];
        let of_march = [
            sampled(0, true, d3),
            sampler_entry,
            sampled(2, false, d2),
            written(3, wgpu::TextureFormat::R32Float, d2),
        ];
        let of_upsample = [storage_entry(0, true, compute)];
        let of_accumulate = [
            storage_entry(0, true, compute),
            sampled(1, false, d2),
            storage_entry(2, true, compute),
            sampled(3, false, d2),
            written(4, kept_format, d2),
        ];
        let layout = |entries: &[wgpu::BindGroupLayoutEntry]| {
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("nuage stage"), entries };
            gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))
        };
        let layouts =
            [layout(&of_light)?, layout(&of_march)?, layout(&of_upsample)?, layout(&of_accumulate)?];

        let view = |texture: &wgpu::Texture| texture.create_view(&wgpu::TextureViewDescriptor::default());
        let (light, depth, noise) = (view(&light), view(&depth), view(&noise));
        let (kept_view, kept_before_view) = (view(&kept), view(&kept_before));
        let seen = wgpu::BindingResource::TextureView;
        let group = |layout: &wgpu::BindGroupLayout, resources: Vec<wgpu::BindingResource<'_>>| {
            let entries: Vec<_> = (0..)
                .zip(resources)
                .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource })
                .collect();
            let descriptor =
                wgpu::BindGroupDescriptor { label: Some("nuage stage"), layout, entries: &entries };
            gpu.guarded(|| gpu.device().create_bind_group(&descriptor))
        };
        let accumulate = |current: &wgpu::Buffer| {
            let resources = vec![
                current.as_entire_binding(),
                seen(&depth),
                before.as_entire_binding(),
                seen(&kept_before_view),
                seen(&kept_view),
            ];
            group(&layouts[3], resources)
        };
        let of_march =
            vec![seen(&light), wgpu::BindingResource::Sampler(&sampler), seen(&noise), seen(&depth)];
        Ok(Stages {
            groups: [
                group(&layouts[0], vec![seen(&light)])?,
                group(&layouts[1], of_march)?,
                group(&layouts[2], vec![marched.as_entire_binding()])?,
                accumulate(&marched)?,
                accumulate(&upsampled)?,
            ],
            layouts,
            marched: bind(gpu, "nuage marched", pass_layout, &[params, &marched])?,
            upsampled: bind(gpu, "nuage upsampled", pass_layout, &[params, &upsampled])?,
            before,
            kept: [kept_before, kept],
            filled: None,
            is_missing: Arc::default(),
            last: None,
            number: 0,
            budget: Budget::default(),
            effort: Budget::default().effort(),
            timer: None,
            took_ms: None,
            measures: RealTime::default(),
        })
    }

    /// The layout of what a stage has for itself.
    pub(crate) fn layout(&self, source: Source) -> Option<&wgpu::BindGroupLayout> {
        let number = match source {
            Source::LightVolume => 0,
            Source::March => 1,
            Source::Upsample => 2,
            Source::Accumulate => 3,
            _ => return None,
        };
        Some(&self.layouts[number])
    }

    /// What a stage has for itself.
    pub(crate) fn group(&self, source: Source) -> &wgpu::BindGroup {
        match source {
            Source::LightVolume => &self.groups[0],
            Source::Upsample => &self.groups[2],
            Source::Accumulate => &self.groups[3 + usize::from(self.is_half())],
            _ => &self.groups[1],
        }
    }

    /// Learns what is asked of the next picture, and how long earlier ones took: the quality that there is time for.
    pub(crate) fn ask(
        &mut self,
        gpu: &Gpu,
        quality: Quality,
        measures: RealTime,
    ) -> Result<Quality, GpuError> {
        self.measures = measures;
        if measures.budget_ms.is_none() {
            self.budget = Budget::default();
        } else if self.timer.is_none() {
            self.timer = Timer::new(gpu)?;
        }
        while let Some((effort, took_ms)) = self.timer.as_mut().and_then(|timer| timer.next(gpu)) {
            self.took(effort, took_ms);
        }
        self.effort = self.budget.effort();
        let coarser = self.effort.coarseness;
        let fewer = |rays: u32| if rays == 0 { 0 } else { ((rays as f32 / coarser) as u32).max(1) };
        Ok(Quality {
            step_voxels: quality.step_voxels * coarser,
            shadow_step_voxels: quality.shadow_step_voxels * coarser,
            sun_rays: fewer(quality.sun_rays),
            sky_rays: fewer(quality.sky_rays),
            ..quality
        })
    }

    fn took(&mut self, effort: Effort, took_ms: f32) {
        self.took_ms = Some(took_ms);
        if let Some(budget_ms) = self.measures.budget_ms {
            self.budget.learn(effort, took_ms, budget_ms);
        }
    }

    /// What a host measured of the last picture, for a device without timestamps.
    pub(crate) fn told(&mut self, took_ms: f32) {
        if self.timer.is_none() && self.measures.budget_ms.is_some() {
            self.took(self.effort, took_ms);
        }
    }

    /// What the last picture took of which that is known.
    pub(crate) fn took_ms(&self) -> Option<f32> {
        self.took_ms
    }

    fn is_half(&self) -> bool {
        self.measures.half_resolution || self.effort.is_half
    }

    /// Tells passes where the light volume lies, what is marched, and how far the volume reaches.
    ///
    /// Returns whether there is a light volume: some places it cannot be laid around.
    pub(crate) fn settle(&self, params: &mut Params, volume: &Volume, look: &Look, frame: usize) -> bool {
        let pixels = 1 + u32::from(self.is_half());
        let [width, height, ..] = params.size;
        params.marched = [
            width.div_ceil(pixels),
            height.div_ceil(pixels),
            pixels,
            if self.measures.accumulate { self.number } else { 0 },
        ];
        let corners =
            volume.place(frame, look.density_channel()).map_or([DVec3::ZERO; 8], Place::world_corners);
        let [nearest, furthest] = views::distances(&corners, &look.camera);
        params.view = [nearest as f32, furthest as f32, 0.0, 0.0];
        let is_wanted = self.measures.light_volume && !look.lights.is_empty();
        let place = volume.place(frame, look.shadow_channel()).filter(|_| is_wanted);
        place.is_some_and(|place| light_volume::lay(params, place).is_some())
    }

    /// Ends what pictures have in common: the next one is as the first.
    pub(crate) fn forget(&mut self) {
        self.last = None;
        self.number = 0;
    }

    /// What the next picture is told of the one before, and the stages that it goes through.
    pub(crate) fn advance(
        &mut self,
        params: &mut Params,
        volume: &Volume,
        features: &Features,
    ) -> Vec<Source> {
        let mut stages = Vec::with_capacity(4);
        if features.has_light_volume {
            let Params { light_first, light_x, light_y, light_z, march_rays, .. } = *params;
            let lattice = [
                light_first,
                light_x,
                light_y,
                light_z,
                params.media[0].extinction,
                [march_rays[2], march_rays[3], 0.0, 0.0],
            ];
            let filled = Filled {
                volume: volume.content(),
                frame: params.size[2],
                channel: features.density_channels[1],
                lookup: features.lookup,
                lattice,
            };
            let is_missing = self.is_missing.swap(false, Ordering::Relaxed);
            if is_missing || self.filled.as_ref() != Some(&filled) {
                stages.push(Source::LightVolume);
                self.filled = Some(filled);
            }
        }
        stages.push(Source::March);
        if self.is_half() {
            stages.push(Source::Upsample);
        }
        if self.measures.accumulate {
            stages.push(Source::Accumulate);
            self.number = self.number.wrapping_add(1);
            params.marched[3] = self.number;
            let camera = |params: &Params| [params.camera, params.forward, params.right, params.up];
            // Nothing is found again in another world.
            let last = self.last.take().filter(|(_, _, origin)| *origin == volume.origin());
            params.history = match &last {
                None => [0.0; 4],
                Some((last, of_volume, _)) => {
                    let has_moved = camera(last) != camera(params);
                    let has_changed = content(last) != content(params) || *of_volume != volume.content();
                    let count = match (has_changed, has_moved) {
                        (true, _) => COUNT_CHANGED,
                        (false, true) => COUNT_MOVED,
                        (false, false) => COUNT_STILL,
                    };
                    let is_clamped = has_moved || has_changed;
                    [count, f32::from(u8::from(is_clamped)), f32::from(u8::from(has_moved)), 0.0]
                }
            };
            let before = camera(last.as_ref().map_or(params, |(last, ..)| last));
            [params.before_camera, params.before_forward, params.before_right, params.before_up] = before;
            self.last = Some((*params, volume.content(), volume.origin()));
        }
        stages
    }

    /// Keeps the picture as the one before.
    pub(crate) fn keep(&self, encoder: &mut wgpu::CommandEncoder, picture: &wgpu::Buffer) {
        encoder.copy_buffer_to_buffer(picture, 0, &self.before, 0, picture.size());
        let [kept_before, kept] = &self.kept;
        encoder.copy_texture_to_texture(kept.as_image_copy(), kept_before.as_image_copy(), kept.size());
    }

    /// What writes the times of a picture's passes, if that is wanted and can be done.
    pub(crate) fn timer(&self) -> Option<&Timer> {
        self.timer.as_ref().filter(|_| self.measures.budget_ms.is_some())
    }

    /// Notices whether an encoder that fills the light volume is dropped.
    pub(crate) fn await_fill(&self, encoder: &wgpu::CommandEncoder) {
        let mut awaited = Awaited(Some(self.is_missing.clone()));
        encoder.on_submitted_work_done(move || drop(awaited.0.take()));
    }

    /// Records the way back of times.
    pub(crate) fn send_times_back(&mut self, encoder: &mut wgpu::CommandEncoder) {
        let is_wanted = self.measures.budget_ms.is_some();
        if let Some(timer) = self.timer.as_mut().filter(|_| is_wanted) {
            timer.send_back(encoder, self.effort);
        }
    }
}

/// What of the parameters changes what there is to see, whoever looks and however finely.
fn content(params: &Params) -> Params {
    let Params { media, blackbody, sun_direction, sun_irradiance, size: [.., frame, _], .. } = *params;
    // Of skies there are even ones alone, of lights the sun.
    let sky_zenith = params.sky_zenith;
    let size = [0, 0, frame, 0];
    Params { media, blackbody, sun_direction, sun_irradiance, sky_zenith, size, ..Params::default() }
}

fn texture(
    gpu: &Gpu,
    [width, height, depth_or_array_layers]: [u32; 3],
    dimension: wgpu::TextureDimension,
    format: wgpu::TextureFormat,
    usage: wgpu::TextureUsages,
) -> Result<wgpu::Texture, GpuError> {
    let descriptor = wgpu::TextureDescriptor {
        label: Some("nuage stage"),
        size: wgpu::Extent3d { width, height, depth_or_array_layers },
        mip_level_count: 1,
        sample_count: 1,
        dimension,
        format,
        usage,
        view_formats: &[],
    };
    gpu.guarded(|| gpu.device().create_texture(&descriptor))
}

/// The tile of blue noise.
fn noise(gpu: &Gpu) -> Result<wgpu::Texture, GpuError> {
    let side = blue_noise::SIDE;
    let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
    let format = wgpu::TextureFormat::R32Float;
    let noise = texture(gpu, [side, side, 1], wgpu::TextureDimension::D2, format, usage)?;
    let tile = blue_noise::tile();
    let layout =
        wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * side), rows_per_image: None };
    let bytes = bytemuck::cast_slice(&tile);
    gpu.guarded(|| gpu.queue().write_texture(noise.as_image_copy(), bytes, layout, noise.size()))?;
    Ok(noise)
}
