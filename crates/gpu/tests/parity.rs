//! Pictures of the GPU held to those of the CPU: views, first hits, surfaces, and the ray marcher.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use common::{
    SIZE, camera_of, channel_of, cloud, gpu, half_cloud, hold, is_same_hit, lit, picture, tiles, uploaded,
};
use glam::{DVec2, IVec3};
use nuage_gpu::arrays::{Arrays, Bricks, Meaning, Wanted};
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Pass, channels_of};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume as GpuVolume;
use nuage_pipeline::pack::options::Options;
use nuage_render::color::Blackbody;
use nuage_render::depth::stepped_transmittance;
use nuage_render::film::Image;
use nuage_render::filter::{Filter, Lookup};
use nuage_render::lod::coarser_by;
use nuage_render::march::Quality;
use nuage_render::scene::{Emission, Scene, Spectrum};
use nuage_render::surface::{first_hit, first_voxel};
use nuage_render::traverse::Field;
use nuage_render::views::{View, render_view};
use nuage_volume::channel::Channel;
use nuage_volume::codec::Codec;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};

const WIDTH: u32 = SIZE[0];
const HEIGHT: u32 = SIZE[1];

fn marched(scene: &Scene<'_>, quality: Quality) -> Image {
    nuage_render::picture::render(scene, quality, WIDTH, HEIGHT, &|_, _| ()).expect("a picture")
}

/// Views and first hits of a channel.
fn hold_views(name: &str, renderer: &mut Renderer, volume: &GpuVolume, channel: &Channel) {
    let scene = lit(channel);
    let look = Look::of_scene(&scene).expect("a look");
    let field = Field::new(channel).expect("a field");
    let density = View::Density { extinction: scene.volumes[0].extinction[0] };
    for view in [density, View::Depth, View::Index, View::FirstDensity] {
        let reference = render_view(&field, view, &scene.camera, SIZE, &|_, _| ()).expect("a picture");
        hold(
            &format!("{name} {view:?}"),
            &picture(renderer, volume, &look, &Pass::View(view), 0),
            &reference.pixels,
        );
    }
    let hits = picture(renderer, volume, &look, &Pass::Hits { above: 0.0 }, 0);
    let mut reader = field.reader();
    for (filter, step_voxels) in [(Filter::Nearest, 0.5), (Filter::Nearest, 0.25), (Filter::Trilinear, 0.5)] {
        let extinction = scene.volumes[0].extinction[0];
        let pass = Pass::Opacity { filter, step_voxels };
        let ours = picture(renderer, volume, &look, &pass, 0);
        let reference: Vec<[f32; 4]> = (0..WIDTH * HEIGHT)
            .map(|i| {
                let pixel = DVec2::new(f64::from(i % WIDTH), f64::from(i / WIDTH)) + 0.5;
                let ray = scene.camera.ray(pixel, WIDTH, HEIGHT);
                [1.0 - stepped_transmittance(&field, &mut reader, &ray, filter, step_voxels, extinction); 4]
            })
            .collect();
        hold(&format!("{name}, steps of {step_voxels}, {filter:?}"), &ours, &reference);
    }
    let (mut same, mut met) = (0, 0);
    for (i, hit) in (0..).zip(&hits) {
        let pixel = DVec2::new(f64::from(i % WIDTH), f64::from(i / WIDTH)) + 0.5;
        let expected = first_voxel(&field, &mut reader, &scene.camera.ray(pixel, WIDTH, HEIGHT), 0.0);
        same += u32::from(is_same_hit(hit, expected.as_ref()));
        met += u32::from(expected.is_some());
    }
    println!(
        "{name}: first hits are the same in {same} of {} pixels, {met} of which meet one",
        WIDTH * HEIGHT
    );
    assert!(f64::from(same) >= 0.995 * f64::from(WIDTH * HEIGHT) && met > 1000, "{name}: {same}, {met}");
}

#[test]
fn views_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    for (name, channel) in [("cloud", cloud()), ("halves", half_cloud()), ("tiles", tiles())] {
        hold_views(name, &mut renderer, &uploaded(&gpu, &[&channel]), &channel);
    }
}

#[test]
fn surfaces_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    // Grows inwards from 0 at a distance of 3 outside of a bumpy ball.
    let ball = channel_of(
        [IVec3::splat(-30), IVec3::splat(30)],
        glam::DAffine3::from_scale(glam::DVec3::splat(0.04)),
        &[],
        |voxel| {
            let p = voxel.as_vec3();
            (3.0 - (p.length() - 20.0 - 4.0 * common::noise(p / 8.0))).clamp(0.0, 6.0)
        },
    );
    let volume = uploaded(&gpu, &[&ball]);
    let scene = lit(&ball);
    let look = Look::of_scene(&scene).expect("a look");
    let field = Field::new(&ball).expect("a field");
    let view = View::Surface { level: 3.0 };
    let reference = render_view(&field, view, &scene.camera, SIZE, &|_, _| ()).expect("a picture");
    hold("surface", &picture(&mut renderer, &volume, &look, &Pass::View(view), 0), &reference.pixels);
    let hits = picture(&mut renderer, &volume, &look, &Pass::SurfaceHits { level: 3.0 }, 0);
    let mut reader = field.reader();
    let mut same = 0;
    for (i, hit) in (0..).zip(&hits) {
        let pixel = DVec2::new(f64::from(i % WIDTH), f64::from(i / WIDTH)) + 0.5;
        let expected = first_hit(&field, &mut reader, &scene.camera.ray(pixel, WIDTH, HEIGHT), 3.0);
        // A tenth of a voxel is 0.004 here; a hundredth of that is asked for.
        let is_same =
            expected.map_or(hit[0] < 0.0, |expected| (f64::from(hit[0]) - expected.distance).abs() < 4e-5);
        same += u32::from(is_same);
    }
    println!("surface: the distance is the same in {same} of {} pixels", WIDTH * HEIGHT);
    assert!(f64::from(same) >= 0.995 * f64::from(WIDTH * HEIGHT), "{same}");
}

#[test]
fn marched_pictures_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    for (name, channel) in [("cloud", cloud()), ("halves", half_cloud()), ("tiles", tiles())] {
        let volume = uploaded(&gpu, &[&channel]);
        let scene = lit(&channel);
        let look = Look::of_scene(&scene).expect("a look");
        for (kind, quality) in [
            ("sun and sky", Quality { step_voxels: 1.0, ..Quality::default() }),
            ("two samples", Quality { step_voxels: 2.0, sky_rays: 0, samples: 2, ..Quality::default() }),
        ] {
            let ours = picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
            hold(&format!("{name}, {kind}"), &ours, &marched(&scene, quality).pixels);
        }
    }
}

#[test]
fn what_glows_looks_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    let density = cloud();
    let heat = channel_of([IVec3::new(-10, -40, 20), IVec3::new(40, 0, 60)], common::bent(), &[], |voxel| {
        1500.0 * common::noise(voxel.as_vec3() / 11.0)
    });
    let blackbody =
        Spectrum::Blackbody { kelvin_per_unit: 1.5, scale: 1.0, table: Box::new(Blackbody::new(1500.0)) };
    let volume = uploaded(&gpu, &[&density, &heat]);
    for spectrum in [blackbody, Spectrum::Linear { rgb: [2e-3, 1e-3, 5e-4] }] {
        let mut scene = lit(&density);
        scene.volumes[0].emission = Some(Emission { channel: Some(&heat), spectrum });
        let look = Look::of_scene(&scene).expect("a look");
        let quality = Quality { step_voxels: 1.0, sky_rays: 4, ..Quality::default() };
        let ours = picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
        hold("glow", &ours, &marched(&scene, quality).pixels);
    }
}

/// Every codec that an encoder can be told to use, and the mixture that it takes by itself.
#[test]
fn packed_volumes_look_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    let block = |format| Some(Codec::Block { format, axis: PackingAxis::Z });
    let nothing = Options { max_error: None, psnr: None, ..Options::default() };
    // As decoded floats one mixture is enough: which codec they came from is not seen.
    let mixtures = [
        ("mixture", Options::default(), Bricks::AsStored),
        ("decoded", Options::default(), Bricks::Decoded),
        ("shapes", Options { psnr: Some(35.0), shapes: 16, ..Options::default() }, Bricks::AsStored),
        ("halves", Options { codec: Some(Codec::F16), ..nothing.clone() }, Bricks::AsStored),
        ("BC4", Options { codec: block(BlockFormat::Bc4), ..nothing.clone() }, Bricks::AsStored),
        ("BC7", Options { codec: block(BlockFormat::Bc7), ..nothing }, Bricks::AsStored),
    ];
    let wanted = [Wanted { name: "density".to_owned(), meaning: Meaning::Density }];
    for (name, options, form) in mixtures {
        let asset = common::packed(&[vec![common::grid("density")]], &options);
        let channel = common::unpacked(&asset, 0, "density");
        let scene = lit(&channel);
        let look = Look::of_scene(&scene).expect("a look");
        let quality =
            Quality { step_voxels: 2.0, shadow_step_voxels: 4.0, sky_rays: 0, ..Quality::default() };
        let arrays = Arrays::of_asset(&asset, &wanted, 0..1, form).expect("arrays");
        let volume = GpuVolume::new(&gpu, &arrays).expect("a volume");
        let ours = picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
        let kib = volume.size_bytes().bricks / 1024;
        hold(&format!("{name}, {kib} KiB of bricks"), &ours, &marched(&scene, quality).pixels);
    }
}

#[test]
fn cameras_inside_and_far_away_see_the_same() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    let channel = cloud();
    let volume = uploaded(&gpu, &[&channel]);
    let outside = camera_of(&channel);
    let centre = nuage_render::framing::WorldBox::of(&channel).expect("a place").centre();
    for (name, distance, narrower) in [("inside", 0.05, 1.0), ("far away", 300.0, 300.0)] {
        let mut scene = lit(&channel);
        scene.camera.origin = centre + (outside.origin - centre) * distance;
        scene.camera.half_width_tangent /= narrower;
        let look = Look::of_scene(&scene).expect("a look");
        let quality = Quality { step_voxels: 1.0, ..Quality::default() };
        let ours = picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
        hold(name, &ours, &marched(&scene, quality).pixels);
    }
}

/// The filters, shadow rays without steps, and a coarser level for shadow rays.
#[test]
fn marched_pictures_look_values_up_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut renderer = common::renderer(&gpu);
    // A small cloud: exact rays and wide filters take long in software.
    let level = |levels| coarser_by(&cloud(), levels).expect("few tiles").expect("a coarser level");
    let (channel, coarse) = (level(1), level(2));
    let mut scene = lit(&channel);
    scene.volumes[0].coarse = Some(&coarse);
    let base = Quality { step_voxels: 1.0, sky_rays: 2, ..Quality::default() };
    let exact = Quality { shadow_step_voxels: 0.0, sun_rays: 6, sky_rays: 0, ..base };
    let few = Quality {
        lookup: Lookup::Tricubic,
        step_voxels: 1.0,
        shadow_step_voxels: 4.0,
        sky_rays: 0,
        ..Quality::default()
    };
    for (name, is_coarse, quality) in [
        ("tricubic", false, few),
        ("nearest", false, Quality { lookup: Lookup::Nearest, ..base }),
        ("exact shadows", false, exact),
        ("exact shadows of nearest voxels", false, Quality { lookup: Lookup::Nearest, ..exact }),
        ("coarse shadows", true, base),
        ("exact coarse shadows", true, exact),
    ] {
        let mut scene = scene.clone();
        scene.volumes[0].coarse = is_coarse.then_some(&coarse);
        let volume = uploaded(&gpu, &channels_of(&scene));
        let look = Look::of_scene(&scene).expect("a look");
        let ours = picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
        hold(name, &ours, &marched(&scene, quality).pixels);
    }
    // Which voxel is chosen hangs on the last bits of distances: the mean over the picture is the same.
    for lookup in [Lookup::StochasticTrilinear, Lookup::StochasticTricubic] {
        let quality = Quality { lookup, samples: 4, ..base };
        let volume = uploaded(&gpu, &channels_of(&scene));
        let look = Look::of_scene(&scene).expect("a look");
        let ours = picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
        let theirs = marched(&scene, quality).pixels;
        let mean = |pixels: &[[f32; 4]], i: usize| {
            pixels.iter().map(|pixel| f64::from(pixel[i])).sum::<f64>() / pixels.len() as f64
        };
        for i in 0..4 {
            let (found, expected) = (mean(&ours, i), mean(&theirs, i));
            println!("{lookup:?}: {found:.5} of {expected:.5}");
            assert!((found / expected - 1.0).abs() < 3e-3, "{lookup:?}: {found} instead of {expected}");
        }
    }
}

/// Pixels of more than 65,535 turns of loops, after which lavapipe leaves them: a host that records one dispatch is told so, and
/// others finish them.
#[test]
fn pictures_of_any_work_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let channel = cloud();
    let scene = lit(&channel);
    let look = Look::of_scene(&scene).expect("a look");
    let volume = uploaded(&gpu, &[&channel]);
    let size = [32, 20];
    let mut renderer = Renderer::new(&gpu, size).expect("a renderer");
    let quality =
        Quality { lookup: Lookup::Tricubic, shadow_step_voxels: 0.0, samples: 4, ..Quality::default() };
    renderer.prepare(&volume, &look, &Pass::March(quality), 0, None).expect("a pass");
    let mut encoder = gpu.device().create_command_encoder(&Default::default());
    renderer.record(&mut encoder, &volume).expect("a record");
    gpu.queue().submit([encoder.finish()]);
    if gpu.name().contains("llvmpipe") {
        assert!(matches!(renderer.pixels(), Err(GpuError::Misuse(_))), "one dispatch is enough");
    }
    renderer.finish(&volume).expect("an end");
    let theirs = nuage_render::picture::render(&scene, quality, size[0], size[1], &|_, _| ());
    hold("cubes and exact shadows", &renderer.pixels().expect("pixels"), &theirs.expect("a picture").pixels);
}
