//! Both sides of `bench/gpu_vs_pnanovdb.sh`: one kernel over all pixels of a picture, ours and NanoVDB's in turns on one device.
//!
//! `cargo run -p nuage-gpu --example rays -- FILE FILE.nvdb KERNEL SHADER.spv REPEATS [SIZE
//! [OURS.wgsl]]` prints one line, and keeps our shader if it is told where. FILE is a .vdb
//! file, whose bricks stand on the device as floats, or a .nuage file, whose bricks do as they are stored. KERNEL is `surface`,
//! `nearest` or `trilinear`; the shader is `bench/peers/pnanovdb.comp` made for it, which says what they are. Or it is `march`, the
//! ray marcher as it is by default, beneath a sun and an even sky: that has no twin there, and neither FILE.nvdb nor the shader is read. Reading and
//! uploading are not timed, and a picture is made before the first that is. Times are of all threads' processors, and wall
//! clock around submission and waiting.

#![allow(clippy::print_stdout, reason = "the line printed is what the program is for")]
#![allow(unsafe_code, reason = "the peer's shader is given to the driver as it is, which nobody checks")]

use std::error::Error;
use std::time::Instant;

use glam::{DAffine3, DVec3, IVec3, Vec3};
use nuage_gpu::arrays::{Arrays, Bricks, Meaning, Wanted};
use nuage_gpu::device::Gpu;
use nuage_gpu::look::{Look, Medium, MediumPlace, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume;
use nuage_pipeline::import::{import, import_surface};
use nuage_render::camera::Camera;
use nuage_render::filter::Filter;
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::scene::Phase;
use nuage_testkit::clock::processor_ms;
use nuage_volume::accessor::Accessor;
use nuage_volume::channel::Channel;
use nuage_volume::format::Asset;

/// Per voxel at density 1.
const EXTINCTION_PER_VOXEL: f64 = 0.1;
const STEP_VOXELS: f32 = 0.5;
/// Depths that differ by more are settled by a third walk.
const DEPTH_TOLERANCE_VOXELS: f64 = 0.1;
/// How far single precision moves a ray some hundreds of voxels away.
const ROUNDING_VOXELS: f64 = 1e-4;

type Failure = Box<dyn Error>;

/// Our volume on the device, with what is needed to look at it.
struct Ours {
    volume: Volume,
    world_from_index: DAffine3,
    /// The first and the last active voxel.
    active: [IVec3; 2],
    /// The value at the surface.
    level: f32,
    /// What was uploaded, of a .vdb file.
    channel: Option<Channel>,
}

fn of_vdb(gpu: &Gpu, bytes: &[u8], is_surface: bool) -> Result<Ours, Failure> {
    let grid = nuage_vdb::File::open(bytes)?.read_all()?.into_iter().next().ok_or("the file has no grid")?;
    let (channel, level) = match is_surface {
        true => import_surface(grid)?,
        false => (import(grid)?.0, 0.0),
    };
    let active = channel.active_box.ok_or("the grid is empty")?;
    Ok(Ours {
        volume: Volume::new(gpu, &Arrays::of_channels(&[&channel])?)?,
        world_from_index: channel.world_from_index,
        active: [active.min, active.max],
        level,
        channel: Some(channel),
    })
}

fn of_nuage(gpu: &Gpu, bytes: Vec<u8>, is_surface: bool) -> Result<Ours, Failure> {
    let mut asset = Asset::open(bytes)?;
    asset.load_all()?;
    let contents = asset.contents();
    let info = contents.channels.first().ok_or("the file has no grid")?;
    let grid = contents.frames.first().and_then(|frame| frame.grids.first()).ok_or("the file has no grid")?;
    let columns = grid.world_from_index.ok_or("the transform is not linear")?;
    let [min, max] = grid.active_box.ok_or("the grid is empty")?;
    let band = info.peak;
    let meaning = if is_surface { Meaning::Surface { band } } else { Meaning::Density };
    let wanted = [Wanted { name: info.name.clone(), meaning }];
    Ok(Ours {
        volume: Volume::new(gpu, &Arrays::of_asset(&asset, &wanted, 0..1, Bricks::AsStored)?)?,
        world_from_index: DAffine3::from_cols_array(&columns),
        active: [IVec3::from_array(min), IVec3::from_array(max)],
        level: band,
        channel: None,
    })
}

/// Where a ray in index space, in which voxels begin at their place, enters the first voxel of a value above a level: in double
/// precision, through each voxel of the box.
fn first_entered(
    channel: &Channel,
    [low, high]: [DVec3; 2],
    origin: DVec3,
    direction: DVec3,
    level: f32,
) -> f64 {
    let (a, b) = ((low - origin) / direction, (high + 1.0 - origin) / direction);
    let (mut t, end) = (a.min(b).max_element(), a.max(b).min_element());
    let mut voxel = (origin + direction * t).floor().clamp(low, high);
    let mut accessor = Accessor::new(&channel.tree);
    while t < end {
        if accessor.voxel(voxel.as_ivec3()) > level {
            return t;
        }
        let faces = (voxel + DVec3::select(direction.cmpge(DVec3::ZERO), DVec3::ONE, DVec3::ZERO) - origin)
            / direction;
        t = faces.min_element();
        let axis = faces.to_array().iter().position(|face| *face == t).unwrap_or(0);
        voxel[axis] += direction[axis].signum();
    }
    -1.0
}

/// The peer's kernel, ready to run.
struct Peer {
    pipeline: wgpu::ComputePipeline,
    group: wgpu::BindGroup,
    picture: wgpu::Buffer,
    bytes: u64,
}

impl Peer {
    fn new(gpu: &Gpu, file: &[u8], shader: &[u8], size: u32, view: [f32; 8]) -> Result<Peer, Failure> {
        let device = gpu.device();
        let grid = grid_of(file)?;
        let buffer = |bytes: &[u8], usage| {
            let size = bytes.len() as u64;
            let usage = usage | wgpu::BufferUsages::COPY_DST;
            let descriptor = wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false };
            let buffer = device.create_buffer(&descriptor);
            gpu.queue().write_buffer(&buffer, 0, bytes);
            buffer
        };
        let grid = buffer(grid, wgpu::BufferUsages::STORAGE);
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
        let picture = buffer(&vec![0; 16 * (size * size) as usize], usage);
        let view: Vec<u8> = view.iter().flat_map(|value| value.to_le_bytes()).collect();
        let view = buffer(&view, wgpu::BufferUsages::UNIFORM);
        let storage = |read_only| wgpu::BufferBindingType::Storage { read_only };
        let kinds = [storage(true), storage(false), wgpu::BufferBindingType::Uniform];
        let entries = [0, 1, 2].map(|binding| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: kinds[binding as usize],
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        });
        let descriptor = wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries };
        let group_layout = device.create_bind_group_layout(&descriptor);
        let bound = [&grid, &picture, &view];
        let entries = [0, 1, 2].map(|binding| wgpu::BindGroupEntry {
            binding,
            resource: bound[binding as usize].as_entire_binding(),
        });
        let descriptor = wgpu::BindGroupDescriptor { label: None, layout: &group_layout, entries: &entries };
        let group = device.create_bind_group(&descriptor);
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(&group_layout)],
            immediate_size: 0,
        });
        let words: Vec<u32> = shader.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)).collect();
        let entry_point =
            wgpu::PassthroughShaderEntryPoint { name: "main".into(), workgroup_size: (8, 8, 1) };
        let descriptor = wgpu::ShaderModuleDescriptorPassthrough {
            entry_points: vec![entry_point].into(),
            spirv: Some(words.into()),
            ..Default::default()
        };
        // SAFETY: it was compiled from bench/peers/pnanovdb.comp, whose bindings are those above; within the device's buffers
        // it reads what the grid says.
        let module = unsafe { device.create_shader_module_passthrough(descriptor) };
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: None,
            layout: Some(&layout),
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        Ok(Peer { pipeline, group, picture, bytes: grid.size() })
    }

    fn run(&self, gpu: &Gpu, size: u32) -> Result<(), Failure> {
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.group, &[]);
        pass.dispatch_workgroups(size.div_ceil(8), size.div_ceil(8), 1);
        drop(pass);
        gpu.queue().submit([encoder.finish()]);
        gpu.wait()?;
        Ok(())
    }

    /// The first number of each pixel.
    fn values(&self, gpu: &Gpu) -> Result<Vec<f32>, Failure> {
        let size = self.picture.size();
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let descriptor = wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false };
        let staging = gpu.device().create_buffer(&descriptor);
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&self.picture, 0, &staging, 0, size);
        gpu.queue().submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| ());
        gpu.wait()?;
        let bytes = staging.get_mapped_range(..)?.to_vec();
        Ok(bytes
            .as_chunks::<16>()
            .0
            .iter()
            .map(|[a, b, c, d, ..]| f32::from_le_bytes([*a, *b, *c, *d]))
            .collect())
    }
}

/// The first grid of a NanoVDB file that is not compressed: behind the file's and the grid's header and the grid's name.
fn grid_of(file: &[u8]) -> Result<&[u8], Failure> {
    const FILE_HEADER: usize = 16;
    const GRID_HEADER: usize = 176;
    let word = |at: usize| -> Result<u64, Failure> {
        let bytes = file.get(at..).and_then(|rest| rest.first_chunk()).ok_or("the file is too short")?;
        Ok(u64::from_le_bytes(*bytes))
    };
    let codec = word(FILE_HEADER - 8)? >> 48;
    if codec != 0 {
        return Err("the NanoVDB file is compressed".into());
    }
    let grid_bytes = word(FILE_HEADER)? as usize;
    let name_bytes = (word(FILE_HEADER + 136)? & 0xffff_ffff) as usize;
    let begin = FILE_HEADER + GRID_HEADER + name_bytes;
    let grid = file.get(begin..begin + grid_bytes).ok_or("the file is too short")?;
    if !grid.starts_with(b"NanoVDB") {
        return Err("the NanoVDB file is of another version".into());
    }
    Ok(grid)
}

/// A device that takes shaders as they are.
fn device() -> Result<Gpu, Failure> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
    let adapter = adapters.into_iter().next().ok_or("no Vulkan device")?;
    let descriptor = wgpu::DeviceDescriptor {
        required_features: wgpu::Features::PASSTHROUGH_SHADERS,
        required_limits: wgpu::Limits {
            max_buffer_size: adapter.limits().max_buffer_size,
            max_storage_buffer_binding_size: adapter.limits().max_storage_buffer_binding_size,
            ..wgpu::Limits::default()
        },
        // SAFETY: what may break is the peer's shader, which is why it is here.
        experimental_features: unsafe { wgpu::ExperimentalFeatures::enabled() },
        ..Default::default()
    };
    let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))?;
    Ok(Gpu::from_host(device, queue, adapter.get_info().name))
}

/// Wall and processor milliseconds of each run of one side.
#[derive(Default)]
struct Times([Vec<f64>; 2]);

impl Times {
    fn add(&mut self, run: impl FnOnce() -> Result<(), Failure>) -> Result<(), Failure> {
        let (wall, cpu) = (Instant::now(), processor_ms());
        run()?;
        self.0[1].push(processor_ms() - cpu);
        self.0[0].push(wall.elapsed().as_secs_f64() * 1e3);
        Ok(())
    }

    /// Medians of all but the first.
    fn medians(&mut self) -> [f64; 2] {
        self.0.each_mut().map(|times| {
            let times = &mut times[1..];
            times.sort_by(f64::total_cmp);
            0.5 * (times[times.len() / 2] + times[(times.len() - 1) / 2])
        })
    }
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [path, peer_path, kernel, shader, repeats, rest @ ..] = arguments.as_slice() else {
        return Err("usage: rays FILE FILE.nvdb KERNEL SHADER.spv REPEATS [SIZE [OURS.wgsl]]".into());
    };
    let repeats: usize = repeats.parse()?;
    let size: u32 = rest.first().map_or(Ok(512), |size| size.parse())?;
    let is_surface = kernel == "surface";
    let gpu = device()?;
    let bytes = std::fs::read(path)?;
    let ours = match path.ends_with(".nuage") {
        true => of_nuage(&gpu, bytes, is_surface)?,
        false => of_vdb(&gpu, &bytes, is_surface)?,
    };
    // The view of `bench/peers/nanovdb_rays.cc`: voxels of NanoVDB's look-ups begin at their place, ours are centred on it.
    let [low, high] = ours.active.map(|corner| corner.as_dvec3());
    let extent = high - low + 1.0;
    let target = low + 0.5 * extent;
    let eye = target + DVec3::new(0.0, 0.0, 2.0 * extent.z);
    let shift = if kernel == "trilinear" { 0.0 } else { 0.5 };
    let world = |p: DVec3| ours.world_from_index.transform_point3(p - shift);
    let camera = Camera::look_at(world(eye), world(target), DVec3::Y, 45.0).ok_or("no view")?;
    let voxel_size = ours.world_from_index.matrix3.x_axis.length();
    let medium = Medium {
        place: MediumPlace::Channel(0),
        coarse: None,
        extinction: [(EXTINCTION_PER_VOXEL / voxel_size) as f32; 3],
        albedo: [0.9; 3],
        phase: Phase::HenyeyGreenstein { g: 0.0 },
        glow: None,
    };
    let direction_to = Vec3::new(0.6, 0.64, 0.48);
    let sun = Light::Sun(Sun { direction_to, irradiance: [3.0; 3], angle_degrees: 0.0 });
    let look = Look { camera, media: vec![medium], lights: vec![sun], sky: Sky::Constant([1.0; 3]) };
    let pass = match kernel.as_str() {
        "surface" => Pass::Hits { above: ours.level },
        "nearest" => Pass::Opacity { filter: Filter::Nearest, step_voxels: STEP_VOXELS },
        "trilinear" => Pass::Opacity { filter: Filter::Trilinear, step_voxels: STEP_VOXELS },
        "march" => Pass::March(Quality::default()),
        _ => return Err(format!("no kernel '{kernel}'").into()),
    };
    let mut renderer = Renderer::new(&gpu, [size; 2])?;
    renderer.prepare(&ours.volume, &look, &pass, 0, None)?;
    if let (Some(path), Some(text)) = (rest.get(1), renderer.shader()) {
        std::fs::write(path, text)?;
    }
    let [x, y, z] = eye.as_vec3().to_array();
    let view = [
        x,
        y,
        z,
        camera.half_width_tangent as f32,
        size as f32,
        STEP_VOXELS,
        EXTINCTION_PER_VOXEL as f32,
        0.0,
    ];
    if matches!(pass, Pass::March(_)) {
        let mut times = Times::default();
        for _ in 0..=repeats.max(1) {
            times.add(|| Ok(renderer.run(&ours.volume)?))?;
        }
        let [wall, cpu] = times.medians();
        println!("wall_ms={wall:.1} cpu_ms={cpu:.1}");
        return Ok(());
    }
    let peer = Peer::new(&gpu, &std::fs::read(peer_path)?, &std::fs::read(shader)?, size, view)?;

    let (mut our_times, mut peer_times) = (Times::default(), Times::default());
    for _ in 0..=repeats.max(1) {
        our_times.add(|| Ok(renderer.run(&ours.volume)?))?;
        peer_times.add(|| peer.run(&gpu, size))?;
    }
    let peer_values = peer.values(&gpu)?;
    let our_values = renderer.pixels()?;
    let to_voxels = if is_surface { (1.0 / voxel_size) as f32 } else { 1.0 };
    let (mut squares, mut peak, mut largest, mut within, mut both) = (0.0_f64, 0.0_f64, 0.0_f64, 0, 0);
    let (mut one_sided, mut right, mut peer_right) = (0, 0, 0);
    for (i, ([value, ..], expected)) in our_values.iter().zip(&peer_values).enumerate() {
        if is_surface && (*value < 0.0 || *expected < 0.0) {
            one_sided += u32::from((*value < 0.0) != (*expected < 0.0));
            continue;
        }
        let difference = f64::from((value * to_voxels - expected).abs());
        both += 1;
        within += u32::from(difference <= DEPTH_TOLERANCE_VOXELS);
        if let Some(channel) =
            ours.channel.as_ref().filter(|_| is_surface && difference > DEPTH_TOLERANCE_VOXELS)
        {
            let [column, row] = [i % size as usize, i / size as usize];
            let [x, y] = [column, row].map(|at| 2.0 * (at as f64 + 0.5) / f64::from(size) - 1.0);
            let tangent = camera.half_width_tangent;
            let direction = DVec3::new(x * tangent, -y * tangent, -1.0).normalize();
            // Rays through an edge of voxels enter the one or the other by rounding.
            let truths = [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)].map(|(x, y)| {
                let origin = eye + ROUNDING_VOXELS * DVec3::new(x, y, 0.0);
                first_entered(channel, [low, high], origin, direction, ours.level)
            });
            let is_near =
                |depth: f32, truth: &f64| (f64::from(depth) - truth).abs() <= DEPTH_TOLERANCE_VOXELS;
            let is_right = |depth: f32| u32::from(truths.iter().any(|truth| is_near(depth, truth)));
            right += is_right(value * to_voxels);
            peer_right += is_right(*expected);
        }
        squares += difference * difference;
        largest = largest.max(difference);
        peak = peak.max(f64::from(expected.abs()));
    }
    let psnr = 10.0 * (peak * peak * f64::from(both) / squares.max(1e-30)).log10();
    let bytes = ours.volume.size_bytes();
    let our_bytes = bytes.trees + bytes.bricks + bytes.tables;
    let ([wall, cpu], [peer_wall, peer_cpu]) = (our_times.medians(), peer_times.medians());
    println!(
        "wall_ms={wall:.1} cpu_ms={cpu:.1} peer_wall_ms={peer_wall:.1} peer_cpu_ms={peer_cpu:.1} bytes={our_bytes} \
         peer_bytes={} psnr={psnr:.1} largest={largest:.4} within={within} both={both} one_sided={one_sided} right={right} peer_right={peer_right}",
        peer.bytes
    );
    Ok(())
}
