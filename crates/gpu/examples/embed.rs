//! An engine that owns a device and an encoder, and has nuage draw a cloud over its frame.
//!
//! The ten lines that matter are those of `draw_cloud`: everything before is what an engine has already, and what is made
//! once for each volume.

#![allow(clippy::print_stdout, reason = "an example says what it did")]

use std::error::Error;

use glam::{DAffine3, DMat3, DMat4, DVec3, DVec4, IVec3, Vec3};
use nuage_gpu::arrays::Arrays;
use nuage_gpu::device::Gpu;
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Medium, MediumPlace, Pass};
use nuage_gpu::renderer::{Depth, Renderer};
use nuage_gpu::upload::Volume;
use nuage_render::camera::Camera;
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::scene::Phase;
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::TreeBuilder;
use nuage_volume::channel::{Channel, IndexBox};

/// What nuage keeps between frames.
struct Cloud {
    renderer: Renderer,
    volume: Volume,
    look: Look,
}

/// The cloud over the engine's colours, and behind what its depth buffer has in front.
fn draw_cloud(
    cloud: &mut Cloud,
    encoder: &mut wgpu::CommandEncoder,
    colours: &wgpu::TextureView,
    depth: &Depth<'_>,
    camera: Camera,
) -> Result<(), GpuError> {
    cloud.look.camera = camera;
    let pass = Pass::March(Quality { step_voxels: 1.0, ..Quality::default() });
    cloud.renderer.prepare(&cloud.volume, &cloud.look, &pass, 0, Some(depth))?;
    cloud.renderer.record(encoder, &cloud.volume)?;
    cloud.renderer.composite(encoder, colours, 1.0)
}

fn main() -> Result<(), Box<dyn Error>> {
    // The engine's device, colours and depth.
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()))?;
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor::default()))?;
    let size = wgpu::Extent3d { width: 320, height: 180, depth_or_array_layers: 1 };
    let texture = |format| {
        device.create_texture(&wgpu::TextureDescriptor {
            label: Some("engine"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        })
    };
    let colours =
        texture(wgpu::TextureFormat::Rgba8Unorm).create_view(&wgpu::TextureViewDescriptor::default());
    let depth =
        texture(wgpu::TextureFormat::Depth32Float).create_view(&wgpu::TextureViewDescriptor::default());
    let camera = Camera::look_at(DVec3::new(0.0, 1.0, 4.0), DVec3::ZERO, DVec3::Y, 40.0).ok_or("no view")?;
    // Right, up and back of the camera, then a reversed depth without a far end.
    let world_from_view = DMat3::from_cols(camera.right, camera.up, -camera.forward);
    let view_from_world =
        DMat4::from_mat3(world_from_view.transpose()) * DMat4::from_translation(-camera.origin);
    let (x, y) = (DVec4::X / camera.half_width_tangent, DVec4::Y / camera.half_width_tangent * (16.0 / 9.0));
    let clip_from_world = DMat4::from_cols(x, y, -DVec4::W, 0.1 * DVec4::Z) * view_from_world;

    // Made once: the cloud on the engine's device.
    let gpu = Gpu::from_host(device.clone(), queue.clone(), adapter.get_info().name);
    let volume = Volume::new(&gpu, &Arrays::of_channels(&[&ball()?])?)?;
    let sun = Sun::point(Vec3::new(0.6, 0.8, 0.0), [3.0; 3]);
    let medium = Medium {
        place: MediumPlace::Channel(0),
        coarse: None,
        extinction: [4.0; 3],
        albedo: [0.9; 3],
        phase: Phase::HenyeyGreenstein { g: 0.3 },
        glow: None,
    };
    let look = Look {
        camera,
        media: vec![medium],
        lights: vec![Light::Sun(sun)],
        sky: Sky::Constant([0.2, 0.3, 0.4]),
    };
    let mut cloud = Cloud { renderer: Renderer::new(&gpu, [160, 90])?, volume, look };

    // Each frame: what the engine draws, here nothing, then the cloud.
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    clear(&mut encoder, &colours, &depth);
    let depth = Depth { view: &depth, clip_from_world };
    draw_cloud(&mut cloud, &mut encoder, &colours, &depth, camera)?;
    queue.submit([encoder.finish()]);
    gpu.wait()?;
    let seen = cloud.renderer.pixels()?.iter().filter(|pixel| pixel[3] > 0.0).count();
    println!("{}: the cloud covers {seen} of {} pixels", gpu.name(), 160 * 90);
    Ok(())
}

/// What stands for the engine's own passes: an empty frame, with a depth of 0 far away.
fn clear(encoder: &mut wgpu::CommandEncoder, colours: &wgpu::TextureView, depth: &wgpu::TextureView) {
    let store = wgpu::StoreOp::Store;
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("engine"),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: colours,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store },
        })],
        depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
            view: depth,
            depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store }),
            stencil_ops: None,
        }),
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    });
}

/// A ball of 16 voxels across, two world lengths wide.
fn ball() -> Result<Channel, Box<dyn Error>> {
    let mut builder = TreeBuilder::new();
    let mut all = Vec::new();
    for i in 0..8 {
        let brick = IVec3::new(i >> 2, i >> 1 & 1, i & 1) - 1;
        let values: [f32; 512] = std::array::from_fn(|voxel| {
            let local = IVec3::new(voxel as i32 >> 6, voxel as i32 >> 3 & 7, voxel as i32 & 7);
            let first: IVec3 = brick << 3;
            let p = (first + local).as_vec3() + 0.5;
            (1.0 - p.length() / 8.0).max(0.0)
        });
        builder.brick(brick, BrickSummary::of(&values))?;
        all.extend(values);
    }
    let tree = builder.finish(Bricks::F32(all))?;
    let world_from_index = DAffine3::from_scale(DVec3::splat(0.125));
    Ok(Channel {
        tree,
        world_from_index,
        active_box: Some(IndexBox { min: IVec3::splat(-8), max: IVec3::splat(7) }),
    })
}
