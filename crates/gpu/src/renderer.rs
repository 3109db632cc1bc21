//! Recording passes: pipelines made when they are first needed, one picture of sums, and its way to a target.
//!
//! A [`Renderer`] works in the encoder of whoever owns the device. Which frame is shown is one number in the parameters;
//! changing it allocates nothing.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use glam::DMat4;
use nuage_render::envmap::EnvironmentMap;
use nuage_render::filter::Lookup;
use nuage_render::light::Sky;
use nuage_render::path::PathSettings;
use nuage_render::views::View;

use crate::device::Gpu;
use crate::error::GpuError;
use crate::light_volume;
use crate::look::{Look, Medium, MediumPlace, Pass, SHORT_STEP_VOXELS, world_from_clip};
use crate::params::Params;
use crate::real_time::Stages;
use crate::rounds::{BAND_PIXELS, Band, Share, Standing};
use crate::shader::{Features, Source, UNSOUND, WORKGROUP_SIDE};
use crate::sky::{sky_group, sky_layout};
use crate::upload::{Volume, bind, buffer_entry, storage_entry};

const PIXEL_BYTES: u64 = size_of::<[f32; 4]>() as u64;
const LEFT_LOOPS: &str =
    "its driver leaves loops that take long; take longer steps, fewer rays or a simpler filter";

/// A host's depth buffer, in front of which the volume ends.
#[derive(Debug, Clone, Copy)]
pub struct Depth<'a> {
    /// The depth buffer, of one sample, of any size.
    pub view: &'a wgpu::TextureView,
    /// What took the host's world to its clip space, ordinary, reversed or without a far end.
    pub clip_from_world: DMat4,
}

/// What all rays of a picture look up in a volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Counts {
    /// Walks through the volume, of camera rays, shadow rays and stretches of paths.
    pub rays: u64,
    /// Look-ups of what stands at a brick.
    pub regions: u64,
    /// Voxels of which the value was taken; a trilinear sample takes eight.
    pub values: u64,
}

/// Renders one volume at a time into a picture on the device.
#[derive(Debug)]
pub struct Renderer {
    gpu: Gpu,
    size: [u32; 2],
    params: wgpu::Buffer,
    /// Its pixels, and one more that is not 0 where some are to be finished.
    picture: wgpu::Buffer,
    /// What pictures go on with, once one had to.
    band: Option<Band>,
    share: Share,
    /// For compute passes, and for those that show the picture.
    groups: [(wgpu::BindGroupLayout, wgpu::BindGroup); 2],
    depth_layout: wgpu::BindGroupLayout,
    depth: Option<wgpu::BindGroup>,
    sky_layout: wgpu::BindGroupLayout,
    /// The picture of the sky, if there was one.
    sky: Option<(Arc<EnvironmentMap>, wgpu::BindGroup)>,
    pipelines: HashMap<(Source, Features), wgpu::ComputePipeline>,
    targets: HashMap<wgpu::TextureFormat, wgpu::RenderPipeline>,
    /// What the next [`Renderer::record`] runs.
    prepared: Option<Prepared>,
    current: Params,
    /// What of that is on the device.
    written: Option<Params>,
    /// What pictures that follow each other need, once there is one.
    stages: Option<Stages>,
}

/// What is to be run.
#[derive(Debug, Clone)]
struct Prepared {
    key: (Source, Features),
    /// Whether the picture begins anew.
    is_first: bool,
    /// The look that other frames are to be shown by, of pictures that follow each other.
    look: Option<Look>,
}

impl Renderer {
    /// A renderer of pictures of a size.
    ///
    /// # Errors
    /// If there are no pixels or too many, or the device fails.
    pub fn new(gpu: &Gpu, size: [u32; 2]) -> Result<Renderer, GpuError> {
        let [width, height] = size.map(u64::from);
        let bytes = PIXEL_BYTES * (width * height + 1);
        let limits = gpu.device().limits();
        let limit_bytes = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        if width * height == 0 {
            return Err(GpuError::Misuse("a picture without pixels".to_owned()));
        }
        if bytes > limit_bytes {
            return Err(GpuError::Limit { what: "a picture", size_bytes: bytes, limit_bytes });
        }
        let usage = wgpu::BufferUsages::COPY_DST;
        let params_bytes = size_of::<Params>() as u64;
        let params =
            gpu.empty_buffer("nuage parameters", params_bytes, usage | wgpu::BufferUsages::UNIFORM)?;
        let usage = usage | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::STORAGE;
        let picture = gpu.empty_buffer("nuage picture", bytes, usage)?;
        let group = |stage, is_read| {
            let uniform = buffer_entry(0, stage, wgpu::BufferBindingType::Uniform);
            let entries = [uniform, storage_entry(1, is_read, stage)];
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("nuage pass"), entries: &entries };
            let layout = gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))?;
            let bind_group = bind(gpu, "nuage pass", &layout, &[&params, &picture])?;
            Ok::<_, GpuError>((layout, bind_group))
        };
        let groups = [group(wgpu::ShaderStages::COMPUTE, false)?, group(wgpu::ShaderStages::FRAGMENT, true)?];
        let depth_entry = wgpu::BindGroupLayoutEntry {
            binding: 0,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Depth,
                view_dimension: wgpu::TextureViewDimension::D2,
                multisampled: false,
            },
            count: None,
        };
        let descriptor =
            wgpu::BindGroupLayoutDescriptor { label: Some("nuage depth"), entries: &[depth_entry] };
        let depth_layout = gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))?;
        Ok(Renderer {
            gpu: gpu.clone(),
            size,
            params,
            picture,
            band: None,
            share: Share::of(size[0].saturating_mul(size[1])),
            groups,
            depth_layout,
            depth: None,
            sky_layout: sky_layout(gpu)?,
            sky: None,
            pipelines: HashMap::new(),
            targets: HashMap::new(),
            prepared: None,
            current: Params::default(),
            written: None,
            stages: None,
        })
    }

    /// The size of the picture, in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Settles what the next [`Renderer::record`] does. Makes a pipeline if there is none of the kind yet.
    ///
    /// # Errors
    /// If the pass cannot show the look, there is no such frame, or the device fails.
    pub fn prepare(
        &mut self,
        volume: &Volume,
        look: &Look,
        pass: &Pass,
        frame: usize,
        depth: Option<&Depth<'_>>,
    ) -> Result<(), GpuError> {
        check_frame(volume, frame)?;
        self.prepare_shader(volume, look, pass, frame, depth, source_of(pass), false)
    }

    /// What the rays of a picture look up: runs the pass once more, with shaders that count. The picture is gone then.
    ///
    /// # Errors
    /// As [`Renderer::prepare`] and [`Renderer::run`], and for pictures that follow each other: of theirs, what is looked up
    /// hangs on those before.
    pub fn count(
        &mut self,
        volume: &Volume,
        look: &Look,
        pass: &Pass,
        frame: usize,
    ) -> Result<Counts, GpuError> {
        check_frame(volume, frame)?;
        if matches!(pass, Pass::RealTime { .. }) {
            return Err(GpuError::Misuse("pictures that follow each other are not counted".to_owned()));
        }
        self.prepare_shader(volume, look, pass, frame, None, source_of(pass), true)?;
        self.run(volume)?;
        let counted = self.read_pixels()?;
        let sum = |i: usize| counted.iter().map(|pixel| pixel[i] as u64).sum();
        Ok(Counts { rays: sum(0), regions: sum(1), values: sum(2) })
    }

    #[allow(clippy::too_many_arguments, reason = "what is shown, how, and by what")]
    fn prepare_shader(
        &mut self,
        volume: &Volume,
        look: &Look,
        pass: &Pass,
        frame: usize,
        depth: Option<&Depth<'_>>,
        source: Source,
        counts: bool,
    ) -> Result<(), GpuError> {
        let mut pass = *pass;
        let mut light_step_voxels = 0.0;
        let is_real_time = matches!(pass, Pass::RealTime { .. });
        if let Pass::RealTime { quality, measures } = &mut pass {
            let gpu = self.gpu.clone();
            light_step_voxels = light_volume::step_voxels(quality.shadow_step_voxels);
            *quality = self.stages()?.ask(&gpu, *quality, *measures)?;
        }
        let mut params = look.params(volume, &pass, self.size, frame)?;
        let mut has_light_volume = false;
        match self.stages.as_mut() {
            Some(stages) if is_real_time => {
                // Coarser steps of a picture leave the light volume as it is.
                params.march_rays[3] = light_step_voxels;
                has_light_volume = stages.settle(&mut params, volume, look, frame);
            }
            Some(stages) => stages.forget(),
            None => {}
        }
        let features = Features {
            counts,
            has_light_volume,
            ..features(volume, look, &pass, source, depth.is_some(), params.counts[2])
        };
        if let Some(depth) = depth {
            [params.clip_x, params.clip_y, params.clip_z, params.clip_w] =
                world_from_clip(&depth.clip_from_world, volume.origin());
            let entry =
                wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(depth.view) };
            let descriptor = wgpu::BindGroupDescriptor {
                label: Some("nuage depth"),
                layout: &self.depth_layout,
                entries: &[entry],
            };
            self.depth = Some(self.gpu.guarded(|| self.gpu.device().create_bind_group(&descriptor))?);
        }
        let key = (source, features);
        let light_volume = has_light_volume.then_some(Source::LightVolume);
        // Both, though a budget may never ask for the first: no picture is to wait for it then.
        let following = [Source::Upsample, Source::Accumulate].into_iter().filter(|_| is_real_time);
        for source in [source].into_iter().chain(light_volume).chain(following) {
            let key = (source, features.of(source));
            if !self.pipelines.contains_key(&key) {
                let pipeline = self.pipeline(volume, source, &key.1)?;
                self.pipelines.insert(key, pipeline);
            }
        }
        self.bind_sky(look)?;
        let goes_on = matches!(pass, Pass::Path { sample: 1.., .. } | Pass::RealTime { .. });
        let is_of_points = matches!(pass, Pass::Shadow(_)) && depth.is_none();
        let look = is_real_time.then(|| look.clone());
        self.prepared = Some(Prepared { key, is_first: !goes_on && !is_of_points, look });
        self.current = params;
        self.write_params()
    }

    /// What pictures that follow each other need.
    fn stages(&mut self) -> Result<&mut Stages, GpuError> {
        let stages = match self.stages.take() {
            Some(stages) => stages,
            None => {
                let [(pass_layout, _), _] = &self.groups;
                Stages::new(&self.gpu, self.size, pass_layout, &self.params, &self.picture)?
            }
        };
        Ok(self.stages.insert(stages))
    }

    /// Sets the points whose light [`Pass::Shadow`] asks for: as many as there are pixels, counted from the place of the look's
    /// camera, so that they are precise wherever that is.
    ///
    /// # Errors
    /// If there are too many, or the device fails.
    pub fn set_points(&self, points: &[[f32; 3]]) -> Result<(), GpuError> {
        let [width, height] = self.size;
        if points.len() as u64 > u64::from(width) * u64::from(height) {
            return Err(GpuError::Misuse(format!("{} points in {width} x {height} pixels", points.len())));
        }
        let wide: Vec<[f32; 4]> = points.iter().map(|[x, y, z]| [*x, *y, *z, 0.0]).collect();
        let bytes = bytemuck::cast_slice(&wide);
        self.gpu.guarded(|| self.gpu.queue().write_buffer(&self.picture, 0, bytes))
    }

    /// The picture on the device, row by row, as four floats for each pixel, and four that are none: to be read by a host's
    /// shaders. Pixels of a still picture that is not finished ([`Renderer::finish`]) have an opacity below 0.
    pub fn picture(&self) -> &wgpu::Buffer {
        &self.picture
    }

    /// Says how long the last picture took, on a device without timestamps: what a budget goes by.
    pub fn took(&mut self, milliseconds: f32) {
        if let Some(stages) = self.stages.as_mut() {
            stages.told(milliseconds);
        }
    }

    /// The milliseconds that the last picture took of those with a budget whose time is known.
    pub fn took_ms(&self) -> Option<f32> {
        self.stages.as_ref().and_then(Stages::took_ms)
    }

    /// As [`Renderer::prepare`], for a shader of tests, which goes on from what the picture holds.
    #[cfg(test)]
    pub(crate) fn prepare_source(
        &mut self,
        volume: &Volume,
        look: &Look,
        pass: &Pass,
        source: Source,
    ) -> Result<(), GpuError> {
        self.prepare_shader(volume, look, pass, 0, None, source, false)?;
        self.prepared = self.prepared.take().map(|prepared| Prepared { is_first: false, ..prepared });
        Ok(())
    }

    /// Sets how much a dispatch of a still picture does.
    #[cfg(test)]
    pub(crate) fn set_share(&mut self, share: Share) {
        self.share = share;
    }

    /// Sets the picture.
    #[cfg(test)]
    pub(crate) fn write_pixels(&self, pixels: &[[f32; 4]]) -> Result<(), GpuError> {
        let bytes = bytemuck::cast_slice(pixels);
        self.gpu.guarded(|| self.gpu.queue().write_buffer(&self.picture, 0, bytes))
    }

    /// Shows another frame from the next [`Renderer::record`] on: writes one number. Distances of the depth view stay those
    /// of the frame that was prepared.
    ///
    /// # Errors
    /// If there is no such frame, or the device fails.
    pub fn set_frame(&mut self, volume: &Volume, frame: usize) -> Result<(), GpuError> {
        check_frame(volume, frame)?;
        self.current.size[2] = frame as u32;
        let look = self.prepared.as_ref().and_then(|prepared| prepared.look.as_ref());
        if let (Some(look), Some(stages)) = (look, self.stages.as_ref()) {
            // A light volume lies elsewhere around another frame.
            stages.settle(&mut self.current, volume, look, frame);
        }
        self.write_params()
    }

    /// Writes of the parameters what is not on the device yet: all from the first change to the last.
    fn write_params(&mut self) -> Result<(), GpuError> {
        let bytes = bytemuck::bytes_of(&self.current);
        let range = match &self.written {
            Some(written) => changed(bytes, bytemuck::bytes_of(written)),
            None => 0..bytes.len(),
        };
        if range.is_empty() {
            return Ok(());
        }
        let at = range.start as u64;
        self.gpu.guarded(|| self.gpu.queue().write_buffer(&self.params, at, &bytes[range]))?;
        self.written = Some(self.current);
        Ok(())
    }

    /// Takes the picture of a look's sky to the device, if it is another one.
    fn bind_sky(&mut self, look: &Look) -> Result<(), GpuError> {
        let Sky::Map(map) = &look.sky else { return Ok(()) };
        if self.sky.as_ref().is_none_or(|(bound, _)| !Arc::ptr_eq(bound, map)) {
            self.sky = Some((map.clone(), sky_group(&self.gpu, &self.sky_layout, map)?));
        }
        Ok(())
    }

    fn pipeline(
        &self,
        volume: &Volume,
        source: Source,
        features: &Features,
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        let device = self.gpu.device();
        let text = source.text(features);
        self.gpu.guarded(|| {
            let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(source.entry_point()),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            });
            let [(pass_layout, _), _] = &self.groups;
            let has_volume = !matches!(source, Source::Upsample | Source::Accumulate);
            let has_depth = features.has_depth && source != Source::LightVolume;
            let own = self.stages.as_ref().filter(|_| features.is_real_time);
            let sky = features.sky_map[0].then_some(&self.sky_layout);
            let layouts = [
                has_volume.then_some(volume.layout()),
                Some(pass_layout),
                has_depth.then_some(&self.depth_layout),
                own.and_then(|stages| stages.layout(source)).or(sky),
            ];
            let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(source.entry_point()),
                bind_group_layouts: &layouts,
                immediate_size: 0,
            });
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(source.entry_point()),
                layout: Some(&layout),
                module: &module,
                entry_point: Some(source.entry_point()),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                cache: None,
            })
        })
    }

    /// The WGSL of what was prepared, for programs that say what a device would make of it.
    pub fn shader(&self) -> Option<String> {
        self.prepared.as_ref().map(|Prepared { key: (source, features), .. }| source.text(features))
    }

    /// Records what was prepared into an encoder: the picture is there once that is submitted and done.
    ///
    /// # Errors
    /// If nothing was prepared.
    pub fn record(&mut self, encoder: &mut wgpu::CommandEncoder, volume: &Volume) -> Result<(), GpuError> {
        self.record_share(encoder, volume, u32::MAX)
    }

    /// Records what was prepared, of which a pixel is left unfinished behind so many shadow rays or scatterings.
    fn record_share(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        volume: &Volume,
        rays: u32,
    ) -> Result<(), GpuError> {
        let nothing = || GpuError::Misuse("nothing was prepared to be recorded".to_owned());
        let Prepared { key: (source, features), is_first, .. } =
            *self.prepared.as_ref().ok_or_else(nothing)?;
        if is_first && source == Source::Path {
            // All others write each pixel.
            encoder.clear_buffer(&self.picture, 0, None);
        } else if goes_on(source, &features) {
            encoder.clear_buffer(&self.picture, self.pixel_bytes(), None);
        }
        self.current.rounds = [0, 0, 0, rays];
        let sources = match self.stages.as_mut().filter(|_| features.is_real_time) {
            Some(stages) => stages.advance(&mut self.current, volume, &features),
            None => vec![source],
        };
        self.write_params()?;
        let [(_, to_picture), _] = &self.groups;
        let stages = self.stages.as_ref().filter(|_| features.is_real_time);
        let timer = stages.and_then(Stages::timer);
        for (i, source) in sources.iter().enumerate() {
            let pipeline = self.pipelines.get(&(*source, features.of(*source))).ok_or_else(nothing)?;
            let timestamp_writes = timer.map(|timer| timer.writes(i == 0, i + 1 == sources.len()));
            let descriptor = wgpu::ComputePassDescriptor {
                label: Some(source.entry_point()),
                timestamp_writes: timestamp_writes.filter(|_| i == 0 || i + 1 == sources.len()),
            };
            if let Some(stages) = stages.filter(|_| *source == Source::Accumulate) {
                stages.keep(encoder, &self.picture);
            }
            let mut pass = encoder.begin_compute_pass(&descriptor);
            pass.set_pipeline(pipeline);
            if !matches!(source, Source::Upsample | Source::Accumulate) {
                pass.set_bind_group(0, volume.bind_group(), &[]);
            }
            // What is not yet the picture goes to the next stage.
            let target = match (stages, source) {
                (Some(stages), Source::March) if sources.last() != Some(source) => &stages.marched,
                (Some(stages), Source::Upsample) if sources.last() != Some(source) => &stages.upsampled,
                _ => to_picture,
            };
            pass.set_bind_group(1, target, &[]);
            if *source != Source::LightVolume {
                self.bind_scene(&mut pass, &features);
            }
            if let Some(stages) = stages {
                pass.set_bind_group(3, stages.group(*source), &[]);
            }
            let size = match source {
                Source::LightVolume => [light_volume::NODES; 2],
                Source::March if features.is_real_time => [self.current.marched[0], self.current.marched[1]],
                _ => self.size,
            };
            let [x, y] = size.map(|side| side.div_ceil(WORKGROUP_SIDE));
            pass.dispatch_workgroups(x, y, 1);
        }
        if let Some(stages) = self.stages.as_mut().filter(|_| features.is_real_time) {
            if sources.contains(&Source::LightVolume) {
                stages.await_fill(encoder);
            }
            stages.send_times_back(encoder);
        }
        Ok(())
    }

    /// Records the way of the picture to a target: its light times `exposure`, over what the target shows already. Light
    /// above 1 is cut off where the target cannot hold it.
    ///
    /// # Errors
    /// If the device fails.
    pub fn composite(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        target: &wgpu::TextureView,
        exposure: f32,
    ) -> Result<(), GpuError> {
        let texture = target.texture();
        let (format, size) = (texture.format(), texture.size());
        if !self.targets.contains_key(&format) {
            let pipeline = self.target(format)?;
            self.targets.insert(format, pipeline);
        }
        self.current.tone[0] = exposure;
        self.current.tone[2] = self.size[0] as f32 / size.width as f32;
        self.current.tone[3] = self.size[1] as f32 / size.height as f32;
        self.write_params()?;
        let attachment = wgpu::RenderPassColorAttachment {
            view: target,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations { load: wgpu::LoadOp::Load, store: wgpu::StoreOp::Store },
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("nuage composite"),
            color_attachments: &[Some(attachment)],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_pipeline(&self.targets[&format]);
        let [_, (_, group)] = &self.groups;
        pass.set_bind_group(1, group, &[]);
        pass.draw(0..3, 0..1);
        Ok(())
    }

    fn target(&self, format: wgpu::TextureFormat) -> Result<wgpu::RenderPipeline, GpuError> {
        let device = self.gpu.device();
        // Eight bits hold encoded colours; formats that say so encode by themselves, and those of floats hold light.
        let is_unorm = matches!(format, wgpu::TextureFormat::Rgba8Unorm | wgpu::TextureFormat::Bgra8Unorm);
        let features = Features { encodes_srgb: is_unorm, ..Features::BARE };
        let text = Source::Tone.text(&features);
        self.gpu.guarded(|| {
            let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some("nuage tone"),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            });
            let [_, (pass_layout, _)] = &self.groups;
            let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some("nuage tone"),
                bind_group_layouts: &[None, Some(pass_layout)],
                immediate_size: 0,
            });
            let over = wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING;
            device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some("nuage tone"),
                layout: Some(&layout),
                vertex: wgpu::VertexState {
                    module: &module,
                    entry_point: Some("whole_screen"),
                    compilation_options: wgpu::PipelineCompilationOptions::default(),
                    buffers: &[],
                },
                primitive: wgpu::PrimitiveState::default(),
                depth_stencil: None,
                multisample: wgpu::MultisampleState::default(),
                fragment: Some(wgpu::FragmentState {
                    module: &module,
                    entry_point: Some(Source::Tone.entry_point()),
                    compilation_options: wgpu::PipelineCompilationOptions::default(),
                    targets: &[Some(wgpu::ColorTargetState {
                        format,
                        blend: Some(over),
                        write_mask: wgpu::ColorWrites::ALL,
                    })],
                }),
                multiview_mask: None,
                cache: None,
            })
        })
    }

    /// Finishes a picture that was recorded and is done, in as many dispatches as that takes: where pixels of the ray marcher or of
    /// the path tracer take longer than drivers let a dispatch last, it is not whole before. Others are. Of paths, each sample is
    /// to be finished before the next. Gives whether there was anything to finish.
    ///
    /// # Errors
    /// If the driver leaves loops even where a dispatch does next to nothing, or the device fails.
    pub fn finish(&mut self, volume: &Volume) -> Result<bool, GpuError> {
        let Some(Prepared { key: (source, features), .. }) = self.prepared else { return Ok(false) };
        if !goes_on(source, &features) {
            return Ok(false);
        }
        let key = (if source == Source::Path { Source::PathOn } else { Source::MarchOn }, features);
        let end = self.pixel_bytes();
        let said = self.gpu.read_range(&self.picture, end..end + PIXEL_BYTES)?;
        if said.iter().all(|byte| *byte == 0) {
            return Ok(false);
        }
        if !self.pipelines.contains_key(&key) {
            let pipeline = self.pipeline(volume, key.0, &key.1)?;
            self.pipelines.insert(key, pipeline);
        }
        let band = match self.band.take() {
            Some(band) => band,
            None => {
                let [(pass_layout, _), _] = &self.groups;
                Band::new(&self.gpu, pass_layout, &self.params)?
            }
        };
        let pixels = self.size[0] * self.size[1];
        let mut look_ups = self.share.look_ups;
        for first in (0..pixels).step_by(BAND_PIXELS as usize) {
            let count = BAND_PIXELS.min(pixels - first);
            let mut encoder = self.encoder();
            band.begin(&mut encoder, &self.picture, first, count);
            loop {
                self.current.rounds = [first, count, look_ups, 0];
                self.write_params()?;
                band.record(&mut encoder, count.div_ceil(WORKGROUP_SIDE * WORKGROUP_SIDE), |pass| {
                    pass.set_pipeline(&self.pipelines[&key]);
                    pass.set_bind_group(0, volume.bind_group(), &[]);
                    self.bind_scene(pass, &key.1);
                });
                let begun = std::mem::replace(&mut encoder, self.encoder());
                self.gpu.guarded(|| self.gpu.queue().submit([begun.finish()]))?;
                let Standing { is_unfinished, is_unsound } = band.standing(&self.gpu)?;
                if !is_unfinished {
                    break;
                }
                if is_unsound && look_ups <= 1 {
                    return Err(GpuError::Device(LEFT_LOOPS.to_owned()));
                }
                look_ups >>= u32::from(is_unsound);
            }
            band.end(&mut encoder, &self.picture, first, count);
            self.gpu.guarded(|| self.gpu.queue().submit([encoder.finish()]))?;
        }
        self.band = Some(band);
        self.gpu.wait()?;
        Ok(true)
    }

    /// Binds what a pass reads of a scene beside the volume.
    fn bind_scene(&self, pass: &mut wgpu::ComputePass<'_>, features: &Features) {
        if let Some(depth) = self.depth.as_ref().filter(|_| features.has_depth) {
            pass.set_bind_group(2, depth, &[]);
        }
        if let Some((_, sky)) = self.sky.as_ref().filter(|_| features.sky_map[0]) {
            pass.set_bind_group(3, sky, &[]);
        }
    }

    fn encoder(&self) -> wgpu::CommandEncoder {
        self.gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
    }

    /// The bytes of the picture's pixels.
    fn pixel_bytes(&self) -> u64 {
        self.picture.size() - PIXEL_BYTES
    }

    fn read_pixels(&self) -> Result<Vec<[f32; 4]>, GpuError> {
        Ok(bytemuck::pod_collect_to_vec(&self.gpu.read_range(&self.picture, 0..self.pixel_bytes())?))
    }

    /// Runs what was prepared, and waits for it.
    ///
    /// # Errors
    /// If nothing was prepared, or as [`Renderer::finish`].
    pub fn run(&mut self, volume: &Volume) -> Result<(), GpuError> {
        let mut encoder = self.encoder();
        let rays = match &self.prepared {
            Some(Prepared { key: (source, features), .. }) if goes_on(*source, features) => self.share.rays,
            _ => u32::MAX,
        };
        self.record_share(&mut encoder, volume, rays)?;
        let start = Instant::now();
        self.gpu.guarded(|| self.gpu.queue().submit([encoder.finish()]))?;
        self.gpu.wait()?;
        if self.prepared.as_ref().is_some_and(|prepared| prepared.key.1.is_real_time) {
            self.took(start.elapsed().as_secs_f32() * 1e3);
        }
        self.finish(volume).map(drop)
    }

    /// The picture, row by row: colour times opacity, and opacity; of paths their mean.
    ///
    /// # Errors
    /// If the device fails, or a still picture was recorded and is not finished. Lavapipe, which leaves loops after some 65,000
    /// turns in all, is found out where a ray of a view or a shadow takes more; of pictures that follow each other it is not.
    pub fn pixels(&self) -> Result<Vec<[f32; 4]>, GpuError> {
        let floats = self.read_pixels()?;
        if floats.iter().any(|pixel| pixel[3] <= UNSOUND) {
            return Err(match &self.prepared {
                Some(Prepared { key: (source, features), .. }) if goes_on(*source, features) => {
                    GpuError::Misuse("the picture takes more than was recorded: finish it".to_owned())
                }
                _ => GpuError::Device(LEFT_LOOPS.to_owned()),
            });
        }
        let share = self.current.tone[1];
        Ok(floats.into_iter().map(|pixel| pixel.map(|value| value * share)).collect())
    }
}

/// Whether further dispatches go on with pictures that take long.
fn goes_on(source: Source, features: &Features) -> bool {
    matches!(source, Source::March | Source::Path) && !features.is_real_time && !features.counts
}

/// What the shader of a pass must be able to do.
fn features(
    volume: &Volume,
    look: &Look,
    pass: &Pass,
    source: Source,
    has_depth: bool,
    view: u32,
) -> Features {
    let (chunks, log2_chunk_words) = volume.chunks();
    let is_lit = matches!(source, Source::March | Source::Path | Source::Shadow);
    let (lookup, sky_rays, shadow_step_voxels) = match *pass {
        Pass::March(quality) | Pass::RealTime { quality, .. } | Pass::Shadow(quality) => {
            (quality.lookup, false, quality.shadow_step_voxels)
        }
        Pass::Path { settings: PathSettings { lookup, sky_rays, .. }, .. } => (lookup, sky_rays, 1.0),
        _ => (Lookup::Trilinear, false, 1.0),
    };
    let is_solid = |medium: &Medium| !matches!(medium.place, MediumPlace::Channel(_));
    let has_sky_map = matches!(&look.sky, Sky::Map(map) if !map.is_black());
    Features {
        codecs: volume.codecs(),
        textures: volume.textures(),
        chunks,
        log2_chunk_words,
        // Where nothing is, there is one medium of nothing.
        media: look.media.len().max(1) as u32,
        has_solids: look.media.iter().any(is_solid),
        density_channels: [look.density_channel() as u32, look.shadow_channel() as u32],
        glow_channel: look.media.iter().find_map(Medium::glow_channel).filter(|_| is_lit),
        is_grey: look.is_grey() || !is_lit,
        lookup,
        has_exact_shadows: shadow_step_voxels <= 0.0,
        sky_map: [has_sky_map && source == Source::Path, has_sky_map && sky_rays],
        has_depth: has_depth && is_lit,
        has_maps: volume.has_maps(),
        are_densities: volume.are_densities(),
        view: if is_lit { 0 } else { view },
        has_short_steps: matches!(pass, Pass::Opacity { step_voxels, .. } if *step_voxels < SHORT_STEP_VOXELS),
        is_real_time: matches!(pass, Pass::RealTime { .. }),
        has_light_volume: false,
        encodes_srgb: false,
        counts: false,
    }
}

/// Where bytes differ from others of the same count, from the first change to the last, in whole vectors of four floats.
fn changed(new: &[u8], old: &[u8]) -> Range<usize> {
    const UNIT: usize = size_of::<[f32; 4]>();
    let is_changed = |i: &usize| new.chunks(UNIT).nth(*i) != old.chunks(UNIT).nth(*i);
    let units = 0..new.len().div_ceil(UNIT);
    match (units.clone().find(is_changed), units.rev().find(is_changed)) {
        (Some(first), Some(last)) => first * UNIT..new.len().min((last + 1) * UNIT),
        _ => 0..0,
    }
}

/// The shader of a pass.
fn source_of(pass: &Pass) -> Source {
    match pass {
        Pass::View(View::Surface { .. }) | Pass::SurfaceHits { .. } => Source::Surface,
        Pass::View(_) | Pass::Hits { .. } | Pass::Opacity { .. } => Source::Views,
        Pass::March(_) | Pass::RealTime { .. } => Source::March,
        Pass::Shadow(_) => Source::Shadow,
        Pass::Path { .. } => Source::Path,
    }
}

fn check_frame(volume: &Volume, frame: usize) -> Result<(), GpuError> {
    match frame < volume.frames() {
        true => Ok(()),
        false => Err(GpuError::Misuse(format!("frame {frame} of {}", volume.frames()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arrays::Arrays;
    use crate::real_time::RealTime;
    use glam::Vec3;
    use nuage_render::light::Light;
    use nuage_render::march::Quality;

    /// Filled when the light, the medium's extinction, the frame or what the volume holds is another, and else not: whoever
    /// looks, however finely, and whatever colour it has.
    #[test]
    fn light_volumes_are_filled_when_light_changes() {
        let Some(gpu) = crate::twins::gpu() else { return };
        let channel = crate::hostile::block(2);
        let arrays = Arrays::of_channels(&[&channel]).expect("arrays");
        let mut volume = Volume::new(&gpu, &arrays).expect("a volume");
        let mut look = crate::hostile::look();
        let mut renderer = Renderer::new(&gpu, [16, 9]).expect("a renderer");
        let quality = Quality::default();
        let mut fills = |volume: &Volume, look: &Look, quality: Quality, frame: usize, has_depth: bool| {
            let pass = Pass::RealTime { quality, measures: RealTime::default() };
            let mut params = look.params(volume, &pass, [16, 9], frame).expect("parameters");
            let stages = renderer.stages().expect("stages");
            stages.ask(&gpu, quality, RealTime::default()).expect("a quality");
            assert!(stages.settle(&mut params, volume, look, frame), "no light volume");
            let features = features(volume, look, &pass, Source::March, has_depth, 0);
            let features = Features { has_light_volume: true, ..features };
            stages.advance(&mut params, volume, &features).contains(&Source::LightVolume)
        };
        assert!(fills(&volume, &look, quality, 0, false), "the first");
        assert!(!fills(&volume, &look, quality, 0, false), "the same");
        look.camera.origin.x += 1.0;
        look.media[0].albedo = [0.5; 3];
        look.sky = Sky::Constant([0.0; 3]);
        let finer = Quality { step_voxels: 0.5, sky_rays: 3, ..quality };
        assert!(!fills(&volume, &look, finer, 0, true), "another view, colour, sky and step");
        if let Some(Light::Sun(sun)) = look.lights.first_mut() {
            sun.irradiance = [7.0; 3];
        }
        assert!(!fills(&volume, &look, quality, 0, false), "a brighter sun");
        if let Some(Light::Sun(sun)) = look.lights.first_mut() {
            sun.direction_to = Vec3::X;
        }
        assert!(fills(&volume, &look, quality, 0, false), "another sun");
        look.media[0].extinction = [4.0; 3];
        assert!(fills(&volume, &look, quality, 0, false), "another extinction");
        assert!(!fills(&volume, &look, quality, 0, false), "the same again");
        volume.fill(&gpu, &arrays).expect("as much room");
        assert!(fills(&volume, &look, quality, 0, false), "a volume that was filled anew");
        let other = Volume::new(&gpu, &arrays).expect("a volume");
        assert!(fills(&other, &look, quality, 0, false), "another volume");
    }

    /// An encoder that is dropped fills no light volume: the next one does.
    #[test]
    fn light_volumes_are_filled_though_an_encoder_is_dropped() {
        let Some(gpu) = crate::twins::gpu() else { return };
        let channel = crate::hostile::block(2);
        let volume = Volume::new(&gpu, &Arrays::of_channels(&[&channel]).expect("arrays")).expect("a volume");
        let look = crate::hostile::look();
        let measures = RealTime { accumulate: false, ..RealTime::default() };
        let pass = Pass::RealTime { quality: Quality { sky_rays: 0, ..Quality::default() }, measures };
        let shown = |dropped: usize| {
            let mut renderer = Renderer::new(&gpu, [32, 18]).expect("a renderer");
            renderer.prepare(&volume, &look, &pass, 0, None).expect("a pass");
            for _ in 0..dropped {
                let mut encoder =
                    gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
                renderer.record(&mut encoder, &volume).expect("a record");
            }
            renderer.run(&volume).expect("a run");
            renderer.pixels().expect("pixels")
        };
        let expected = shown(0);
        assert!(expected.iter().any(|pixel| pixel[0] > 0.0), "the sun is seen");
        assert_eq!(shown(1), expected);
    }

    #[test]
    fn what_changes_is_found() {
        let old = [7; 80];
        let with = |places: &[usize]| {
            let mut new = old;
            places.iter().for_each(|place| new[*place] = 8);
            changed(&new, &old)
        };
        assert_eq!(with(&[]), 0..0);
        assert_eq!(with(&[0]), 0..16);
        assert_eq!(with(&[17, 50]), 16..64);
        assert_eq!(with(&[79]), 64..80);
    }
}
