//! What the tests of the GPU renderer share: a device or a word that there is none, channels, packed volumes, and the
//! comparison of pictures.

#![allow(dead_code, reason = "each test binary uses its own part")]
#![allow(unreachable_pub, reason = "a module of test binaries, not of a library")]
#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

pub mod paths;

use std::convert::Infallible;
use std::io::Cursor;

use glam::{DAffine3, DQuat, DVec3, IVec3, Vec3};
use nuage_gpu::arrays::Arrays;
use nuage_gpu::device::{Gpu, Wanted};
use nuage_gpu::look::{Look, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume as GpuVolume;
use nuage_pipeline::pack::options::Options;
use nuage_pipeline::pack::sequence::{FrameName, pack};
use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_render::camera::Camera;
use nuage_render::hash::{hash_u32, unit_f32};
use nuage_render::light::Sun;
use nuage_render::scene::{Phase, Scene, Shape, Volume};
use nuage_render::surface::VoxelHit;
use nuage_vdb::{Grid, Metadata};
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::format::Asset;
use nuage_volume::format::contents::FrameGrid;
use nuage_volume::space::{BRICK_VOXELS, brick_of, voxel_offset};

/// The pictures that are compared.
pub const SIZE: [u32; 2] = [160, 90];

/// A device, or `None` after saying that there is none.
pub fn gpu() -> Option<Gpu> {
    match Gpu::open(&Wanted::Best) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            nuage_testkit::left_out("gpu", &error.to_string());
            None
        }
    }
}

/// A device that a host opened without any feature, or `None` if there is none.
pub fn host(required_limits: wgpu::Limits) -> Option<Gpu> {
    let name = gpu()?.name().to_owned();
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    let adapter =
        adapters.into_iter().find(|adapter| adapter.get_info().name == name).expect("the same device");
    let descriptor = wgpu::DeviceDescriptor { required_limits, ..Default::default() };
    let (device, queue) = pollster::block_on(adapter.request_device(&descriptor)).expect("a device");
    Some(Gpu::from_host(device, queue, name))
}

/// A channel of the values of `f` at all voxels from `min` to `max`, and of tiles of value 1.
pub fn channel_of(
    [min, max]: [IVec3; 2],
    world_from_index: DAffine3,
    tiles: &[(IVec3, TileSize)],
    f: impl Fn(IVec3) -> f32,
) -> Channel {
    let mut builder = TreeBuilder::new();
    let mut all = Vec::new();
    for (brick, size) in tiles {
        builder.tile(*brick, *size, 1.0).expect("a free place");
    }
    let (first, last) = (brick_of(min), brick_of(max));
    for brick in boxed(first, last) {
        let mut values = [0.0; BRICK_VOXELS];
        let first_voxel: IVec3 = brick << 3;
        for voxel in boxed(first_voxel.max(min), (first_voxel + 7).min(max)) {
            values[voxel_offset(voxel)] = f(voxel);
        }
        // Where a tile is, there is no room.
        if values.iter().any(|v| *v != 0.0) && builder.brick(brick, BrickSummary::of(&values)).is_ok() {
            all.extend(values);
        }
    }
    let tree = builder.finish(Bricks::F32(all)).expect("a small tree");
    Channel { tree, world_from_index, active_box: Some(IndexBox { min, max }) }
}

/// All coordinates from `min` to `max`, both included.
pub fn boxed(min: IVec3, max: IVec3) -> impl Iterator<Item = IVec3> {
    (min.x..=max.x).flat_map(move |x| {
        (min.y..=max.y).flat_map(move |y| (min.z..=max.z).map(move |z| IVec3::new(x, y, z)))
    })
}

/// Noise between its lattice of points, from 0 to 1.
pub fn noise(p: Vec3) -> f32 {
    let corner = p.floor();
    let f = p - corner;
    let f = f * f * (3.0 - 2.0 * f);
    let at = |d: IVec3| {
        let v = corner.as_ivec3() + d;
        unit_f32(hash_u32(
            (v.x as u32).wrapping_mul(7919) ^ (v.y as u32).wrapping_mul(104_729) ^ hash_u32(v.z as u32),
        ))
    };
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let line = |x, y| mix(at(IVec3::new(x, y, 0)), at(IVec3::new(x, y, 1)), f.z);
    mix(mix(line(0, 0), line(0, 1), f.y), mix(line(1, 0), line(1, 1), f.y), f.x)
}

/// A transform that turns, stretches and moves.
pub fn bent() -> DAffine3 {
    DAffine3::from_scale_rotation_translation(
        DVec3::new(0.05, 0.06, 0.04),
        DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.8, 0.2),
        DVec3::new(100.0, -20.0, 5.0),
    )
}

/// A cloud with holes, off the origin.
pub fn cloud() -> Channel {
    let centre = Vec3::new(13.0, -21.0, 40.0);
    channel_of([IVec3::new(-19, -53, 8), IVec3::new(45, 11, 72)], bent(), &[], |voxel| {
        let p = voxel.as_vec3();
        let inside = 1.0 - (p - centre).length() / 32.0;
        (inside * 1.5 + noise(p / 9.0) + 0.5 * noise(p / 3.0) - 0.7).clamp(0.0, 1.0)
    })
}

/// The same in half floats.
pub fn half_cloud() -> Channel {
    let mut channel = cloud();
    if let Bricks::F32(values) = &channel.tree.bricks {
        let halves = values.iter().map(|value| half::f16::from_f32(*value));
        let rounded: Vec<half::f16> = halves.collect();
        let [min, max] = channel.active_box.map_or([IVec3::ZERO; 2], |b| [b.min, b.max]);
        let values = channel.tree.clone();
        let f32s = channel_of([min, max], bent(), &[], |voxel| {
            let content = values.region(brick_of(voxel)).content;
            match content {
                nuage_volume::tree::Content::Constant(value) => value,
                nuage_volume::tree::Content::Brick(brick) => {
                    rounded[brick as usize * BRICK_VOXELS + voxel_offset(voxel)].to_f32()
                }
            }
        });
        channel = f32s;
        if let Bricks::F32(values) = &channel.tree.bricks {
            let bits = values.iter().map(|value| half::f16::from_f32(*value).to_bits()).collect();
            channel.tree.bricks = Bricks::F16(bits);
        }
    }
    channel
}

/// Bricks beside tiles of two sizes, whose borders blend.
pub fn tiles() -> Channel {
    let tiles = [(IVec3::ZERO, TileSize::Node4), (IVec3::new(16, 2, 3), TileSize::Brick)];
    channel_of(
        [IVec3::splat(0), IVec3::new(170, 127, 127)],
        DAffine3::from_scale(DVec3::splat(0.02)),
        &tiles,
        |voxel| {
            if voxel.x > 140 { 0.5 * noise(voxel.as_vec3() / 7.0) } else { 0.0 }
        },
    )
}

/// A camera that sees all of a channel from aside.
pub fn camera_of(channel: &Channel) -> Camera {
    let world_box = nuage_render::framing::WorldBox::of(channel).expect("a place");
    let aspect = f64::from(SIZE[0]) / f64::from(SIZE[1]);
    let camera =
        nuage_render::framing::fit_camera(world_box, DVec3::new(0.5, 0.35, 1.0), DVec3::Y, 35.0, aspect);
    let mut camera = camera.expect("a view");
    // Half as wide: most of the picture shows something.
    camera.half_width_tangent *= 0.5;
    camera
}

/// A cloud in the light of a sun and an even sky.
pub fn lit(channel: &Channel) -> Scene<'_> {
    let camera = camera_of(channel);
    let aspect = f64::from(SIZE[0]) / f64::from(SIZE[1]);
    let extinction = nuage_render::framing::fit_density_scale(channel, &camera, aspect).unwrap_or(1.0);
    let volume = Volume {
        albedo: [0.95, 0.9, 0.8],
        phase: Phase::HenyeyGreenstein { g: 0.4 },
        ..Volume::absorbing(Shape::Grid(channel), extinction)
    };
    let sun = Sun::point(Vec3::new(0.48, 0.8, -0.36), [3.0, 2.8, 2.5]);
    Scene::of_one(camera, volume, Some(sun), [0.2, 0.3, 0.5])
}

/// A grid of the committed file.
pub fn grid(name: &str) -> Grid {
    let path = nuage_testkit::committed("oracle/oracle_64.vdb");
    let file = nuage_vdb::File::open(std::fs::read(path).expect("readable")).expect("a VDB file");
    file.read_grid(file.find(name).expect("the grid")).expect("an intact grid")
}

/// Frames of grids, packed.
pub fn packed(frames: &[Vec<Grid>], options: &Options) -> Asset {
    let names: Vec<FrameName> =
        (0..frames.len()).map(|i| FrameName { number: Some(i as i64), name: format!("{i}") }).collect();
    let load = |i: usize| Ok::<_, Infallible>((frames[i].clone(), Metadata::default()));
    let mut bytes = Cursor::new(Vec::new());
    pack(&names, load, &mut bytes, options, None, &mut |_| ()).expect("a packed file");
    let mut asset = Asset::open(bytes.into_inner()).expect("a sound file");
    asset.load_all().expect("sound bricks");
    asset
}

/// A grid of a frame of a packed volume, as the CPU renders it.
pub fn unpacked(asset: &Asset, frame: usize, name: &str) -> Channel {
    unpacked_as(asset, frame, name, |grid| {
        nuage_pipeline::import::import(grid).expect("a linear transform").0
    })
    .expect("voxels")
}

/// The same, as what its values are taken for; `None` if it has no voxels.
pub fn unpacked_as(
    asset: &Asset,
    frame: usize,
    name: &str,
    import: impl FnOnce(Grid) -> Channel,
) -> Option<Channel> {
    let (grids, _) = unpack_frame(asset, frame).expect("a frame");
    let grid = grids.into_iter().find(|grid| grid.name == name)?;
    let mut channel = import(grid);
    // Shaders keep to the source's box. What decodes to 0 at its faces is in none that importing finds.
    let contents = asset.contents();
    let is_same = |grid: &&FrameGrid| contents.channels[grid.channel as usize].name == name;
    let [min, max] = contents.frames[frame].grids.iter().find(is_same).and_then(|grid| grid.active_box)?;
    channel.active_box = Some(IndexBox { min: IVec3::from_array(min), max: IVec3::from_array(max) });
    Some(channel)
}

/// A renderer of pictures to be compared. Keep it: its pipelines take seconds on a device in software.
pub fn renderer(gpu: &Gpu) -> Renderer {
    Renderer::new(gpu, SIZE).expect("a renderer")
}

/// The picture of a pass.
pub fn picture(
    renderer: &mut Renderer,
    volume: &GpuVolume,
    look: &Look,
    pass: &Pass,
    frame: usize,
) -> Vec<[f32; 4]> {
    renderer.prepare(volume, look, pass, frame, None).expect("a pass");
    renderer.run(volume).expect("a run");
    renderer.pixels().expect("pixels")
}

/// Channels on the device.
pub fn uploaded(gpu: &Gpu, channels: &[&Channel]) -> GpuVolume {
    GpuVolume::new(gpu, &Arrays::of_channels(channels).expect("arrays")).expect("a volume")
}

/// The largest difference of each pixel. Values above 1 count in parts of themselves.
pub fn differences(ours: &[[f32; 4]], reference: &[[f32; 4]]) -> Vec<f64> {
    assert_eq!(ours.len(), reference.len());
    let error = |(a, b): (&[f32; 4], &[f32; 4])| {
        a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs() / b.abs().max(1.0))).fold(0.0, f64::max)
    };
    ours.iter().zip(reference).map(error).collect()
}

/// Whether a pixel of [`nuage_gpu::look::Pass::Hits`] has the voxel that the CPU finds: the same brick, as far away.
pub fn is_same_hit(hit: &[f32; 4], expected: Option<&VoxelHit>) -> bool {
    let Some(expected) = expected else { return hit[0] < 0.0 };
    let brick = IVec3::new(hit[1] as i32, hit[2] as i32, hit[3] as i32) >> 3;
    let is_near = (f64::from(hit[0]) / expected.distance - 1.0).abs() < 1e-5;
    brick == expected.voxel >> 3 && is_near
}

/// Holds a picture to that of the CPU: within 1/255 per channel on 99.9 % of the pixels, and a mean error of less than
/// 10⁻⁴. Values above 1 count in parts of themselves.
pub fn hold(name: &str, ours: &[[f32; 4]], reference: &[[f32; 4]]) {
    let errors = differences(ours, reference);
    let good = errors.iter().filter(|error| **error <= 1.0 / 255.0).count() as f64 / errors.len() as f64;
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let worst = errors.iter().copied().fold(0.0, f64::max);
    let seen = reference.iter().filter(|pixel| pixel[3] > 0.0).count();
    println!(
        "{name}: {:.3} % of pixels within 1/255, mean error {mean:.2e}, worst {worst:.2e}",
        100.0 * good
    );
    assert!(seen > reference.len() / 20, "{name}: only {seen} pixels show anything");
    assert!(good >= 0.999 && mean < 1e-4, "{name}: {good} good, mean {mean}, worst {worst}");
}
