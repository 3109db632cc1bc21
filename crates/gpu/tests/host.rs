//! What hosts rely on: frames that are switched by a number, volumes that end at a depth buffer, and errors in place of
//! panics.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use common::{SIZE, gpu, hold, lit, packed, picture, unpacked, uploaded};
use glam::{DAffine3, DMat3, DMat4, DVec2, DVec3, DVec4, IVec3, Vec3};
use nuage_gpu::arrays::{Arrays, Bricks, Meaning, Wanted};
use nuage_gpu::device::{self, Gpu};
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Pass};
use nuage_gpu::renderer::{Depth, Renderer};
use nuage_gpu::upload::Volume as GpuVolume;
use nuage_pipeline::pack::options::Options;
use nuage_render::light::{Light, Sun};
use nuage_render::march::Quality;
use nuage_vdb::AnyTree;
use nuage_volume::build::TileSize;
use nuage_volume::codec::Codec;
use nuage_volume::format::Asset;
use nuage_volume::format::contents::Contents;
use nuage_volume::packed::{Entry, TreeRef, Trees};

/// Frames of a packed volume, one after the other, without another upload.
#[test]
fn frames_are_switched_by_a_number() {
    let Some(gpu) = gpu() else { return };
    let first = common::grid("density");
    let mut second = first.clone();
    second.tree = match &*first.tree {
        AnyTree::Float(tree) => std::sync::Arc::new(tree.map(|value| 0.3 * value * value).into()),
        other => panic!("{}", other.value_type()),
    };
    let asset = packed(&[vec![first], vec![second]], &Options::default());
    let wanted = [Wanted { name: "density".to_owned(), meaning: Meaning::Density }];
    let arrays = Arrays::of_asset(&asset, &wanted, 0..2, Bricks::AsStored).expect("arrays");
    let volume = GpuVolume::new(&gpu, &arrays).expect("a volume");
    assert_eq!((volume.frames(), volume.channels()), (2, 1));
    let channels = [0, 1].map(|frame| unpacked(&asset, frame, "density"));
    let scenes = channels.each_ref().map(lit);
    let mut renderer = common::renderer(&gpu);
    let mut look = Look::of_scene(&scenes[0]).expect("a look");
    let quality = Quality { step_voxels: 2.0, shadow_step_voxels: 4.0, sky_rays: 0, ..Quality::default() };
    look.media[0].extinction = scenes[0].volumes[0].extinction;
    let march = |frame: usize| {
        let mut scene = scenes[frame].clone();
        scene.camera = scenes[0].camera;
        scene.volumes[0].extinction = look.media[0].extinction;
        nuage_render::picture::render(&scene, quality, SIZE[0], SIZE[1], &|_, _| ())
            .expect("a picture")
            .pixels
    };
    renderer.prepare(&volume, &look, &Pass::March(quality), 0, None).expect("a pass");
    for frame in [0, 1, 0] {
        renderer.set_frame(&volume, frame).expect("a frame");
        renderer.run(&volume).expect("a run");
        hold(&format!("frame {frame}"), &renderer.pixels().expect("pixels"), &march(frame));
    }
    assert!(matches!(renderer.set_frame(&volume, 2), Err(GpuError::Misuse(_))));
}

/// A texture of a depth everywhere.
fn depth_of(gpu: &Gpu, value: f32) -> wgpu::TextureView {
    let texture = gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d { width: SIZE[0], height: SIZE[1], depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Depth32Float,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
        view_formats: &[],
    });
    let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
    let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: None,
        color_attachments: &[],
        depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
            view: &view,
            depth_ops: Some(wgpu::Operations {
                load: wgpu::LoadOp::Clear(value),
                store: wgpu::StoreOp::Store,
            }),
            stencil_ops: None,
        }),
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    });
    gpu.queue().submit([encoder.finish()]);
    view
}

/// A block of fog that a wall cuts: what is in front of the wall has a closed form, whatever the host's projection.
#[test]
fn volumes_end_at_the_depth_buffer() {
    let Some(gpu) = gpu() else { return };
    let voxel = 1.0 / 64.0;
    let last = IVec3::splat(127);
    let block = common::channel_of(
        [IVec3::ZERO, last],
        DAffine3::from_scale(DVec3::splat(voxel)),
        &[(IVec3::ZERO, TileSize::Node4)],
        |_| 0.0,
    );
    let volume = uploaded(&gpu, &[&block]);
    let mut scene = lit(&block);
    scene.lights.clear();
    let (eye, target) = (DVec3::new(1.0, 1.0, 6.0), DVec3::new(1.0, 1.0, 0.0));
    scene.camera = nuage_render::camera::Camera::look_at(eye, target, DVec3::Y, 30.0).expect("a view");
    scene.volumes[0].extinction = [0.8; 3];
    let look = Look::of_scene(&scene).expect("a look");
    let quality = Quality { sky_rays: 0, min_transmittance: 1e-6, ..Quality::default() };
    let nuage_render::camera::Camera { forward, right, up, half_width_tangent, .. } = scene.camera;
    let view =
        DMat4::from_mat3(DMat3::from_cols(right, up, -forward).transpose()) * DMat4::from_translation(-eye);
    let (near, far, wall): (f64, f64, f64) = (0.5, 50.0, 5.2);
    // What a depth buffer holds is `a + b / depth`.
    let projection = |a: f64, b: f64| {
        DMat4::from_cols(
            DVec4::X / half_width_tangent,
            DVec4::Y / half_width_tangent * (16.0 / 9.0),
            DVec4::new(0.0, 0.0, -a, -1.0),
            DVec4::new(0.0, 0.0, b, 0.0),
        )
    };
    let ordinary = projection(far / (far - near), -near * far / (far - near));
    let projections = [
        ("ordinary", ordinary),
        ("reversed", projection(near / (near - far), -near * far / (near - far))),
        ("without end", projection(1.0, -near)),
        ("reversed without end", projection(0.0, near)),
    ];
    let mut renderer = common::renderer(&gpu);
    let mut show = |look: &Look, pass: &Pass, clip_from_view: DMat4, value: f32| {
        let depth = Depth { view: &depth_of(&gpu, value), clip_from_world: clip_from_view * view };
        renderer.prepare(&volume, look, pass, 0, Some(&depth)).expect("a pass");
        renderer.run(&volume).expect("a run");
        renderer.pixels().expect("pixels")
    };
    for (name, clip_from_view) in projections {
        let value = clip_from_view.project_point3(DVec3::new(0.0, 0.0, -wall)).z as f32;
        let pixels = show(&look, &Pass::March(quality), clip_from_view, value);
        let mut worst = 0.0_f64;
        let mut cut = 0;
        for (i, pixel) in (0..).zip(&pixels) {
            let at = DVec2::new(f64::from(i % SIZE[0]), f64::from(i / SIZE[0])) + 0.5;
            let ray = scene.camera.ray(at, SIZE[0], SIZE[1]);
            // Inside of the block's last voxels, where it is 1 everywhere.
            let (low, high) = (DVec3::ZERO, last.as_dvec3() * voxel);
            let (a, b) = ((low - ray.origin) / ray.direction, (high - ray.origin) / ray.direction);
            let (enters, leaves) = (a.min(b).max_element(), a.max(b).min_element());
            let ends = wall / ray.direction.dot(scene.camera.forward);
            // Beside these, and where the block's border blends, there is no such form.
            if enters + 0.3 > ends || leaves < ends || enters > leaves {
                continue;
            }
            // The border in front is half a voxel of 1 in the mean, across its slope.
            let across = voxel / ray.direction.z.abs();
            let expected = 1.0 - (-0.8 * (ends - enters + 0.5 * across)).exp();
            worst = worst.max((f64::from(pixel[3]) - expected).abs());
            cut += 1;
        }
        println!("{name}: {cut} pixels are cut, the worst is off by {worst:.2e}");
        assert!(cut > 2000 && worst < 1e-3, "{name}: {cut}, {worst}");
    }
    // The shadow on the wall of a sun behind the camera has a closed form too.
    let sun = Sun::point(Vec3::new(0.3, 0.2, 1.0).normalize(), [1.0; 3]);
    let in_light = Look { lights: vec![Light::Sun(sun)], ..look.clone() };
    let quality = Quality { shadow_step_voxels: 0.5, shadow_growth: 0.0, ..quality };
    for (name, clip_from_view) in projections {
        let value = clip_from_view.project_point3(DVec3::new(0.0, 0.0, -wall)).z as f32;
        let pixels = show(&in_light, &Pass::Shadow(quality), clip_from_view, value);
        let (mut worst, mut shaded) = (0.0_f64, 0);
        for (i, pixel) in (0..).zip(&pixels) {
            let at = DVec2::new(f64::from(i % SIZE[0]), f64::from(i / SIZE[0])) + 0.5;
            let ray = scene.camera.ray(at, SIZE[0], SIZE[1]);
            let place = ray.origin + ray.direction * (wall / ray.direction.dot(scene.camera.forward));
            let to_sun = sun.direction_to.as_dvec3();
            let leaves = ((last.as_dvec3() * voxel - place) / to_sun).min_element();
            // Where the ray leaves the block by its front, and begins well inside.
            let out = place + to_sun * leaves;
            let is_inside = place.min_element() > 0.1 && out.truncate().max_element() < 1.9;
            if !is_inside || place.truncate().max_element() > 1.9 {
                continue;
            }
            let expected = (-0.8 * (leaves + 0.5 * voxel / to_sun.z)).exp();
            worst = worst.max((f64::from(pixel[0]) - expected).abs());
            shaded += 1;
        }
        println!("{name}: {shaded} pixels are shaded, the worst is off by {worst:.2e}");
        assert!(shaded > 1000 && worst < 1e-3, "{name}: {shaded}, {worst}");
        // What is nowhere has no shadow; a far plane is somewhere.
        if name.ends_with("without end") {
            let value = if name.starts_with("reversed") { 0.0 } else { 1.0 };
            let nothing = show(&in_light, &Pass::Shadow(quality), clip_from_view, value);
            assert!(nothing.iter().all(|pixel| pixel[0] == 1.0), "{name}: a shadow on nothing");
        }
    }
    // With nothing in front all of it is there.
    let whole = show(&look, &Pass::March(quality), ordinary, 1.0);
    let alone = picture(&mut common::renderer(&gpu), &volume, &look, &Pass::March(quality), 0);
    hold("nothing in front", &whole, &alone);
}

/// Light over a target: a picture of a known value lands where it should, encoded.
#[test]
fn pictures_are_laid_over_targets() {
    let Some(gpu) = gpu() else { return };
    let volume = uploaded(&gpu, &[&common::cloud()]);
    let channel = common::cloud();
    let scene = lit(&channel);
    let look = Look::of_scene(&scene).expect("a look");
    let mut renderer = Renderer::new(&gpu, [64, 40]).expect("a renderer");
    let pass = Pass::View(nuage_render::views::View::Depth);
    renderer.prepare(&volume, &look, &pass, 0, None).expect("a pass");
    let texture = gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d { width: 64, height: 40, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let target = texture.create_view(&wgpu::TextureViewDescriptor::default());
    let buffer = gpu.device().create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: 4 * 64 * 40,
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    renderer.record(&mut encoder, &volume).expect("recorded");
    renderer.composite(&mut encoder, &target, 0.5).expect("recorded");
    let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * 64), rows_per_image: None };
    let to = wgpu::TexelCopyBufferInfo { buffer: &buffer, layout };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), to, texture.size());
    gpu.queue().submit([encoder.finish()]);
    let shown = gpu.read(&buffer).expect("bytes");
    let pixels = renderer.pixels().expect("pixels");
    assert!(pixels.iter().filter(|pixel| pixel[3] > 0.0).count() > 200);
    for (shown, pixel) in shown.chunks(4).zip(&pixels) {
        let expected = pixel.map(|value| f32::from(nuage_render::color::linear_to_srgb8(0.5 * value)));
        let off = (f32::from(shown[0]) - expected[0]).abs();
        assert!(off <= 1.0 && shown[3] == if pixel[3] > 0.0 { 255 } else { 0 }, "{shown:?} {pixel:?}");
    }
}

#[test]
fn what_makes_no_sense_is_an_error() {
    let Some(gpu) = gpu() else { return };
    let missing = Gpu::open(&device::Wanted::Name("no such device".to_owned()));
    let Err(GpuError::NoDevice { found, .. }) = missing else { panic!("{missing:?}") };
    assert_eq!(found, device::names());
    assert!(matches!(Renderer::new(&gpu, [0, 5]), Err(GpuError::Misuse(_))));
    assert!(matches!(Renderer::new(&gpu, [1 << 20, 1 << 20]), Err(GpuError::Limit { .. })));
    let channel = common::cloud();
    let volume = uploaded(&gpu, &[&channel]);
    let scene = lit(&channel);
    let mut look = Look::of_scene(&scene).expect("a look");
    look.media[0].extinction = [1.0, 2.0, 3.0];
    let mut renderer = common::renderer(&gpu);
    let prepared = renderer.prepare(&volume, &look, &Pass::March(Quality::default()), 0, None);
    assert!(matches!(prepared, Err(GpuError::Unsupported { .. })), "{prepared:?}");
    assert!(matches!(renderer.run(&volume), Err(GpuError::Misuse(_))), "nothing was prepared");
    assert!(matches!(
        renderer.prepare(&volume, &look, &Pass::Hits { above: 0.0 }, 1, None),
        Err(GpuError::Misuse(_))
    ));
}

/// Moves a pointer by some words, nodes or cells.
type Damage<'a> = dyn Fn(&mut Contents, &mut Trees, u32) + 'a;

/// The finest tree of the first grid.
fn level(contents: &mut Contents) -> &mut TreeRef {
    &mut contents.frames[0].grids[0].levels[0]
}

/// Pointers out of range are refused before anything of the asset reaches a device; pages that are absent when they are
/// wanted are an error.
#[test]
fn damaged_volumes_are_refused() {
    let asset = packed(&[vec![common::grid("density")]], &Options::default());
    let parts = || (asset.contents().clone(), asset.trees().clone(), asset.store().clone());
    let (contents, trees, store) = parts();
    let is_tagged = |entry: &Entry, tag: u8| entry.kind as u8 == tag;
    let brick = trees.entries.iter().position(|entry| !is_tagged(entry, 0) && !is_tagged(entry, Entry::NODE));
    let node4 = trees.entries.iter().position(|entry| is_tagged(entry, Entry::NODE));
    let (brick, node4) = (brick.expect("a brick"), node4.expect("a node"));
    assert!(Asset::from_parts(contents, trees, store).is_ok());
    // Each pointer that a shader follows, one beyond the last and far beyond.
    let damage: [(&str, &Damage<'_>); 11] = [
        ("the node of a root cell", &|_, trees, by| trees.cells[0].entry.payload += by),
        ("the node of an entry", &|_, trees, by| trees.entries[node4].payload += by),
        ("the mask of a Node5", &|_, trees, by| trees.node5s[0].mask += by),
        ("the mask of a Node4", &|_, trees, by| trees.node4s[0].mask += by),
        ("the entries of a Node5", &|_, trees, by| trees.node5s[0].first_entry += by.max(1 << 20)),
        ("the entries of a Node4", &|_, trees, by| trees.node4s[0].first_entry += by.max(1 << 20)),
        ("the words of a brick", &|_, trees, by| trees.entries[brick].payload += by),
        ("the codec of a brick", &|_, trees, _| trees.entries[brick].kind ^= 1),
        ("a brick in place of a node", &|_, trees, _| trees.entries[node4].kind ^= 0xff ^ 10),
        ("the first cell of a tree", &|contents, _, by| level(contents).first_cell += by),
        ("the cells of a tree", &|contents, _, by| level(contents).cell_count += by),
    ];
    for (what, damage) in damage {
        for by in [1, 1 << 30] {
            let (mut contents, mut trees, store) = parts();
            damage(&mut contents, &mut trees, by);
            let made = Asset::from_parts(contents, trees, store);
            assert!(made.is_err(), "{what}, by {by}");
        }
    }
    // A box whose sums overflow is met on the way to the device.
    let (mut contents, trees, store) = parts();
    let grid = &mut contents.frames[0].grids[0];
    (grid.index_offset[0], grid.active_box) = (8, Some([[i32::MIN; 3], [i32::MAX; 3]]));
    let wanted = [Wanted { name: "density".to_owned(), meaning: Meaning::Density }];
    if let Ok(asset) = Asset::from_parts(contents, trees, store) {
        assert!(Arrays::of_asset(&asset, &wanted, 0..1, Bricks::AsStored).is_err());
    }
    // A shared brick whose shape is not there is no page.
    let shapes = packed(
        &[vec![common::grid("density")]],
        &Options { psnr: Some(25.0), max_error: None, shapes: 8, ..Options::default() },
    );
    let mut store = shapes.store().clone();
    let shared = store.codecs().iter().position(|codec| *codec == Codec::Shared).expect("a shared brick");
    let at = store.offset(shared);
    let page = store.page_of(at).expect("its page");
    let first = store.pages()[page].first_word;
    for word in [1, 2] {
        let mut words = store.pages()[page].words().expect("a page that is loaded").to_vec();
        words[(at - first) as usize + word] += 1;
        assert!(store.set_page(page, words).is_err(), "word {word} of a shared brick");
    }
    let (contents, trees, mut store) = parts();
    store.drop_page(0);
    let without = Asset::from_parts(contents, trees, store).expect("all but its bricks");
    let arrays = Arrays::of_asset(&without, &wanted, 0..1, Bricks::AsStored);
    assert!(matches!(arrays, Err(GpuError::Malformed(_))), "{:?}", arrays.map(drop));
    assert!(matches!(Arrays::of_asset(&asset, &wanted, 3..4, Bricks::AsStored), Err(GpuError::Misuse(_))));
}

/// What shaders count is what a walk does: at a block that fills the picture each ray looks some things up, and beside a
/// volume none does.
#[test]
fn look_ups_are_counted_and_pictures_timed() {
    let Some(gpu) = gpu() else { return };
    let channel = common::cloud();
    let volume = uploaded(&gpu, &[&channel]);
    let mut look = Look::of_scene(&lit(&channel)).expect("a look");
    let mut renderer = Renderer::new(&gpu, [32, 18]).expect("a renderer");
    let pass = Pass::View(nuage_render::views::View::Depth);
    renderer.prepare(&volume, &look, &pass, 0, None).expect("a pass");
    let took = nuage_gpu::measure::time(&gpu, &mut renderer, &volume).expect("a time");
    assert!(took.wall.as_nanos() > 0);
    assert!(took.device.is_none_or(|device| device.as_nanos() > 0 && device <= took.wall), "{took:?}");
    let before = renderer.pixels().expect("pixels");
    let counts = renderer.count(&volume, &look, &pass, 0).expect("counts");
    let pixels = 32 * 18;
    println!("{counts:?} of {pixels} pixels");
    assert!(counts.rays > pixels / 4 && counts.rays <= pixels, "one walk at most for each pixel: {counts:?}");
    assert!(counts.regions >= counts.rays && counts.values > 0, "{counts:?}");
    renderer.prepare(&volume, &look, &pass, 0, None).expect("a pass");
    renderer.run(&volume).expect("a run");
    assert_eq!(renderer.pixels().expect("pixels"), before, "counting leaves pictures as they are");
    let quality = Quality { sky_rays: 0, ..Quality::default() };
    let marched = renderer.count(&volume, &look, &Pass::March(quality), 0).expect("counts");
    assert!(marched.rays > counts.rays && marched.values > counts.values, "shadow rays as well: {marched:?}");
    let measures = nuage_gpu::real_time::RealTime::default();
    let counted = renderer.count(&volume, &look, &Pass::RealTime { quality, measures }, 0);
    assert!(counted.is_err(), "{counted:?}");
    look.camera.forward = -look.camera.forward;
    let counts = renderer.count(&volume, &look, &pass, 0).expect("counts");
    assert_eq!((counts.rays, counts.regions, counts.values), (0, 0, 0), "it is behind the camera");
}
