//! A simulation that stays on the device: each frame a kernel writes densities into a buffer, a tree is built of them, and the
//! volume is drawn, all in one submission. Nothing comes to the processor but the picture.
//!
//! Takes the side of the field in voxels, 64 if not said. Prints how long the parts take, and what the same takes when the values
//! come to the processor, which builds the tree and sends it back.

#![allow(clippy::print_stdout, reason = "an example says what it did")]

use std::error::Error;
use std::time::Instant;

use glam::{DAffine3, DVec3, IVec3, Vec3};
use nuage_gpu::arrays::{Arrays, Meaning};
use nuage_gpu::build::{Builder, Grid, Values};
use nuage_gpu::device::{Gpu, Wanted};
use nuage_gpu::look::{Look, Medium, MediumPlace, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume;
use nuage_render::camera::Camera;
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::scene::Phase;
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::TreeBuilder;
use nuage_volume::channel::{Channel, IndexBox};

/// What stands for a simulation: a puff that rises and comes apart.
const SIMULATION: &str = "
struct Told { side: u32, frame: u32 }
@group(0) @binding(0) var<uniform> told: Told;
@group(0) @binding(1) var<storage, read_write> density: array<f32>;

@compute @workgroup_size(8, 8)
fn simulate(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id >= vec3<u32>(told.side))) {
        return;
    }
    let time = 0.1 * f32(told.frame);
    let p = vec3<f32>(id) / f32(told.side);
    let bent = p + 0.03 * sin(20.0 * p.yzx + vec3<f32>(time, 2.0 * time, 3.0 * time));
    let puff = 0.3 - length(bent - vec3<f32>(0.5, 0.35 + 0.05 * time, 0.5));
    density[(id.x * told.side + id.y) * told.side + id.z] = max(8.0 * puff, 0.0);
}";

const FRAMES: u32 = 5;

fn main() -> Result<(), Box<dyn Error>> {
    let side: u32 = std::env::args().nth(1).map_or(Ok(64), |side| side.parse())?;
    let gpu = Gpu::open(&Wanted::Best)?;
    let simulation = Simulation::new(&gpu, side);

    // Made once: memory for the largest tree, and what draws it.
    let grid = Grid {
        values: Values::Dense { values: simulation.density.clone(), strides: [side * side, side, 1] },
        size: [side; 3],
        meaning: Meaning::Density,
        world_from_index: DAffine3::from_scale(DVec3::splat(1.0 / f64::from(side))),
        max_bricks: None,
    };
    let mut builder = Builder::new(&gpu, &[grid])?;
    let mut renderer = Renderer::new(&gpu, [160, 90])?;
    let look = look()?;
    let pass = Pass::March(Quality { step_voxels: 2.0, sky_rays: 0, ..Quality::default() });
    for frame in 0..FRAMES {
        simulation.tell(&gpu, frame);
        renderer.prepare(builder.volume(), &look, &pass, 0, None)?;
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        simulation.record(&mut encoder);
        builder.record(&mut encoder);
        renderer.record(&mut encoder, builder.volume())?;
        let start = Instant::now();
        gpu.queue().submit([encoder.finish()]);
        gpu.wait()?;
        let [found] = builder.check()?[..] else { return Err("one channel".into()) };
        let seen = renderer.pixels()?.iter().filter(|pixel| pixel[3] > 0.5).count();
        println!(
            "frame {frame}: {} bricks, {seen} pixels, {:.1} ms",
            found.bricks,
            1e3 * start.elapsed().as_secs_f64()
        );
    }

    // The same values, by either way, the fastest of some runs.
    let mut best = [f64::INFINITY; 4];
    let mut least = |i: usize, start: Instant| best[i] = best[i].min(1e3 * start.elapsed().as_secs_f64());
    for _ in 0..FRAMES {
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        builder.record(&mut encoder);
        let start = Instant::now();
        gpu.queue().submit([encoder.finish()]);
        gpu.wait()?;
        least(0, start);
        let start = Instant::now();
        let values: Vec<f32> = bytemuck::pod_collect_to_vec(&gpu.read(&simulation.density)?);
        least(1, start);
        let start = Instant::now();
        let arrays = Arrays::of_channels(&[&on_the_processor(&values, side)?])?;
        least(2, start);
        let start = Instant::now();
        Volume::new(&gpu, &arrays)?;
        gpu.wait()?;
        least(3, start);
    }
    let [build, read, processor, upload] = best;
    println!(
        "{}, {side}³: a build on the device {build:.1} ms; by the processor {processor:.1} ms, with reading back {read:.1} \
         and upload {upload:.1}",
        gpu.name()
    );
    Ok(())
}

fn look() -> Result<Look, Box<dyn Error>> {
    let centre = DVec3::splat(0.5);
    Ok(Look {
        camera: Camera::look_at(centre + DVec3::new(0.3, 0.2, 2.0), centre, DVec3::Y, 40.0)
            .ok_or("no view")?,
        media: vec![Medium {
            place: MediumPlace::Channel(0),
            coarse: None,
            extinction: [20.0; 3],
            albedo: [0.9; 3],
            phase: Phase::HenyeyGreenstein { g: 0.3 },
            glow: None,
        }],
        lights: vec![Light::Sun(Sun::point(Vec3::new(0.6, 0.8, 0.0), [3.0; 3]))],
        sky: Sky::Constant([0.2, 0.3, 0.4]),
    })
}

/// The tree of a field as the processor builds it.
fn on_the_processor(values: &[f32], side: u32) -> Result<Channel, Box<dyn Error>> {
    let side = side as i32;
    let mut builder = TreeBuilder::new();
    let mut all = Vec::new();
    let bricks = (side + 7) / 8;
    for i in 0..bricks * bricks * bricks {
        let brick = IVec3::new(i / bricks / bricks, i / bricks % bricks, i % bricks);
        let mut own = [0.0; 512];
        for (row, own) in own.chunks_mut(8).enumerate() {
            let (x, y, z) = (brick.x * 8 + row as i32 / 8, brick.y * 8 + row as i32 % 8, brick.z * 8);
            if x < side && y < side {
                let at = ((x * side + y) * side + z) as usize;
                let len = own.len().min((side - z) as usize);
                own[..len].copy_from_slice(&values[at..at + len]);
            }
        }
        if own.iter().any(|value| *value != 0.0) {
            builder.brick(brick, BrickSummary::of(&own))?;
            all.extend(own);
        }
    }
    Ok(Channel {
        tree: builder.finish(Bricks::F32(all))?,
        world_from_index: DAffine3::from_scale(DVec3::splat(1.0 / f64::from(side))),
        active_box: Some(IndexBox { min: IVec3::ZERO, max: IVec3::splat(side - 1) }),
    })
}

/// The simulation's own buffers and kernel.
struct Simulation {
    side: u32,
    density: wgpu::Buffer,
    told: wgpu::Buffer,
    pipeline: wgpu::ComputePipeline,
    group: wgpu::BindGroup,
}

impl Simulation {
    fn new(gpu: &Gpu, side: u32) -> Simulation {
        let device = gpu.device();
        let buffer = |size, usage| {
            let descriptor = wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false };
            device.create_buffer(&descriptor)
        };
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
        let density = buffer(4 * u64::from(side).pow(3), usage);
        let told = buffer(8, wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST);
        let source = wgpu::ShaderSource::Wgsl(SIMULATION.into());
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor { label: None, source });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: None,
            layout: None,
            module: &module,
            entry_point: Some("simulate"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &pipeline.get_bind_group_layout(0),
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: told.as_entire_binding() },
                wgpu::BindGroupEntry { binding: 1, resource: density.as_entire_binding() },
            ],
        });
        Simulation { side, density, told, pipeline, group }
    }

    fn tell(&self, gpu: &Gpu, frame: u32) {
        gpu.queue().write_buffer(&self.told, 0, bytemuck::cast_slice(&[self.side, frame]));
    }

    fn record(&self, encoder: &mut wgpu::CommandEncoder) {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.group, &[]);
        pass.dispatch_workgroups(self.side.div_ceil(8), self.side.div_ceil(8), self.side);
    }
}
