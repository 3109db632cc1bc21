//! Pictures of paths held to those of the CPU: the scenes of the oracle, and what else a scene may hold.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use std::f32::consts::TAU;
use std::sync::Arc;

use common::paths::compare;
use common::{bent, channel_of, cloud, gpu, grid, lit};
use glam::{DAffine3, DQuat, DVec3, IVec3, Vec3};
use nuage_gpu::device::Gpu;
use nuage_gpu::look::{Look, Pass, channels_of};
use nuage_gpu::renderer::Renderer;
use nuage_render::camera::Camera;
use nuage_render::color::Blackbody;
use nuage_render::envmap::{self, EnvironmentMap};
use nuage_render::filter::Lookup;
use nuage_render::framing::WorldBox;
use nuage_render::light::{Light, Sky, Spot, Sun};
use nuage_render::lod::coarser_by;
use nuage_render::march::{Quality, unsupported};
use nuage_render::path::PathSettings;
use nuage_render::scene::{Emission, Phase, Scene, Shape, Spectrum, Volume};
use nuage_render::traverse::Field;
use nuage_render::views::{View, render_view};
use nuage_volume::channel::Channel;

#[test]
fn a_cloud_in_the_sun_is_that_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let channel = cloud();
    let mut scene = lit(&channel);
    scene.sky = Sky::Gradient {
        up: Vec3::Y,
        zenith: [0.1, 0.2, 0.6],
        horizon: [0.5, 0.4, 0.3],
        ground: [0.05, 0.04, 0.02],
    };
    compare("grey", &gpu, &scene, PathSettings::default());
}

/// Everything at once: colours, heat, four kinds of lights, and a phase function of two lobes.
#[test]
fn a_coloured_cloud_that_glows_among_lights_is_that_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let channel = cloud();
    let heat = channel_of([IVec3::new(-10, -40, 20), IVec3::new(40, 0, 60)], bent(), &[], |voxel| {
        common::noise(voxel.as_vec3() / 11.0)
    });
    let mut scene = lit(&channel);
    let world_box = WorldBox::of(&channel).expect("a place");
    let (centre, size) = (world_box.centre(), (world_box.max - world_box.min).length());
    let [strongest, ..] = scene.volumes[0].extinction;
    scene.volumes[0].extinction = [strongest, 0.6 * strongest, 0.3 * strongest];
    scene.volumes[0].phase = Phase::Draine { g: 0.3, alpha: 2.0 };
    let spectrum = Spectrum::Linear { rgb: [0.3, 0.1, 0.02] };
    scene.volumes[0].emission = Some(Emission { channel: Some(&heat), spectrum });
    let up = DVec3::Y * size;
    let bright = |colour: [f32; 3]| colour.map(|c| c * (size * size) as f32);
    scene.lights = vec![
        Light::Sun(Sun { angle_degrees: 12.0, ..Sun::point(Vec3::new(0.6, 0.64, 0.48), [3.0, 2.0, 1.0]) }),
        Light::Point { position: centre + up, intensity: bright([2.0, 1.0, 3.0]) },
        Light::Sphere { centre: centre - up, radius: 0.3 * size, radiance: [5.0, 9.0, 4.0] },
        Light::Spot(Spot {
            position: centre + DVec3::X * size,
            direction: Vec3::NEG_X,
            intensity: bright([9.0, 9.0, 3.0]),
            inner_degrees: 10.0,
            outer_degrees: 25.0,
        }),
    ];
    let settings = PathSettings { max_scatterings: Some(6), ..PathSettings::default() };
    compare("coloured", &gpu, &scene, settings);
}

fn imported(name: &str) -> Channel {
    nuage_pipeline::import::import(grid(name)).expect("a linear transform").0
}

/// A scene of the oracle: one volume before its camera, in the light of a sky and perhaps of a sun.
fn oracle(
    shape: Shape<'_>,
    extinction: f32,
    albedo: [f32; 3],
    g: f32,
    sky: [f32; 3],
    has_sun: bool,
) -> Scene<'_> {
    let camera = Camera::look_at(DVec3::new(1.8, 1.4, 3.2), DVec3::ZERO, DVec3::Y, 36.0).expect("a view");
    let phase = Phase::HenyeyGreenstein { g };
    let volume = Volume { albedo, phase, ..Volume::absorbing(shape, extinction) };
    let sun = Sun::point(Vec3::new(0.6, 0.7, 0.3).normalize(), [6.0, 5.4, 4.2]);
    Scene::of_one(camera, volume, has_sun.then_some(sun), sky)
}

#[test]
fn scenes_of_the_oracle_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let (density, flame) = (imported("density"), imported("emission"));
    let cloud = Shape::Grid(&density);
    let ball = Shape::Ball { world_from_unit: DAffine3::IDENTITY };
    let world_from_unit =
        DAffine3::from_scale_rotation_translation(DVec3::splat(2.0), DQuat::IDENTITY, DVec3::NEG_ONE);
    let (white, day) = ([1.0; 3], [0.3, 0.4, 0.6]);
    let once = PathSettings { max_scatterings: Some(1), ..PathSettings::default() };
    let any = PathSettings::default();
    let mut emission = oracle(cloud, 1.5, [0.0; 3], 0.0, [0.0; 3], false);
    let spectrum = Spectrum::Linear { rgb: [6.0, 2.5, 0.8] };
    emission.volumes[0].emission = Some(Emission { channel: Some(&flame), spectrum });
    for (name, scene, settings) in [
        ("emission", emission, any),
        ("het64_furnace", oracle(cloud, 8.0, white, 0.8, white, false), any),
        ("het64_g0", oracle(cloud, 8.0, [0.99; 3], 0.0, day, true), any),
        ("het64_g08", oracle(cloud, 8.0, [0.99; 3], 0.8, day, true), any),
        ("het64_g0_ss", oracle(cloud, 8.0, [0.99; 3], 0.0, day, true), once),
        ("het64_trans", oracle(cloud, 8.0, [0.0; 3], 0.0, white, false), any),
        ("homog_cube_furnace", oracle(Shape::Box { world_from_unit }, 2.0, white, 0.0, white, false), any),
        ("homog_sphere", oracle(ball, 4.0, [0.9, 0.6, 0.2], 0.5, white, false), any),
        ("homog_sphere_furnace", oracle(ball, 4.0, white, 0.5, white, false), any),
    ] {
        compare(name, &gpu, &scene, settings);
        if unsupported(&scene).is_none() {
            march(name, &gpu, &scene);
        }
    }
}

/// Holds a scene's picture of one scattering to that of the CPU, and what its rays meet.
fn march(name: &str, gpu: &Gpu, scene: &Scene<'_>) {
    let size = [96, 64];
    let mut renderer = Renderer::new(gpu, size).expect("a renderer");
    let volume = common::uploaded(gpu, &channels_of(scene));
    let look = Look::of_scene(scene).expect("a look");
    let quality = Quality { step_voxels: 1.0, sky_rays: 4, ..Quality::default() };
    let ours = common::picture(&mut renderer, &volume, &look, &Pass::March(quality), 0);
    let theirs = nuage_render::picture::render(scene, quality, size[0], size[1], &|_, _| ());
    common::hold(&format!("{name}, marched"), &ours, &theirs.expect("a picture").pixels);
    let Shape::Grid(channel) = scene.volumes[0].shape else { return };
    let field = Field::new(channel).expect("a field");
    for view in [View::Density { extinction: scene.volumes[0].extinction[0] }, View::Depth] {
        let ours = common::picture(&mut renderer, &volume, &look, &Pass::View(view), 0);
        let theirs = render_view(&field, view, &scene.camera, size, &|_, _| ()).expect("a picture");
        common::hold(&format!("{name}, {view:?}"), &ours, &theirs.pixels);
    }
}

/// Two grids, a box and a ball that overlap, each of another medium, and two of which glow.
fn crowd<'a>(first: &'a Channel, second: &'a Channel) -> Scene<'a> {
    let mut scene = lit(first);
    let world_box = WorldBox::of(first).expect("a place");
    let (centre, size) = (world_box.centre(), (world_box.max - world_box.min).length());
    let strongest = scene.volumes[0].extinction[0];
    let turned = |scale: f64, offset: DVec3| {
        DAffine3::from_scale_rotation_translation(
            DVec3::new(1.0, 0.7, 1.3) * size * scale,
            DQuat::from_rotation_z(0.6),
            centre + offset * size,
        )
    };
    let kinds = [
        (Shape::Grid(second), 0.7, [0.3, 0.6, 0.9], 0.8),
        (Shape::Box { world_from_unit: turned(0.3, DVec3::new(-0.2, -0.3, 0.0)) }, 0.4, [0.9, 0.2, 0.5], 0.0),
        (
            Shape::Ball { world_from_unit: turned(0.15, DVec3::new(0.15, 0.1, 0.1)) },
            0.3,
            [0.8, 0.9, 0.7],
            -0.4,
        ),
    ];
    for (shape, share, albedo, g) in kinds {
        let phase = Phase::HenyeyGreenstein { g };
        scene.volumes.push(Volume { albedo, phase, ..Volume::absorbing(shape, share * strongest) });
    }
    let blackbody = |reference: f32| Spectrum::Blackbody {
        kelvin_per_unit: 3000.0,
        scale: 0.3 / size as f32,
        table: Box::new(Blackbody::new(reference)),
    };
    scene.volumes[1].emission = Some(Emission { channel: None, spectrum: blackbody(2500.0) });
    scene.volumes[3].emission = Some(Emission { channel: None, spectrum: blackbody(3200.0) });
    scene
}

fn other_cloud() -> Channel {
    channel_of([IVec3::new(0, -30, 0), IVec3::new(30, 0, 50)], bent(), &[], |voxel| {
        common::noise(voxel.as_vec3() / 7.0)
    })
}

#[test]
fn volumes_that_overlap_collide_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let (first, second) = (cloud(), other_cloud());
    let mut scene = crowd(&first, &second);
    let settings = PathSettings { max_scatterings: Some(8), ..PathSettings::default() };
    compare("grey crowd", &gpu, &scene, settings);
    let [strongest, ..] = scene.volumes[0].extinction;
    scene.volumes[0].extinction = [0.4 * strongest, strongest, 0.1 * strongest];
    scene.volumes[3].extinction = [0.5 * strongest, 0.0, 0.2 * strongest];
    compare("coloured crowd", &gpu, &scene, settings);
}

/// A sky with a sharp sun in one of its texels, turned aside.
#[test]
fn skies_that_are_pictures_light_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let channel = cloud();
    let (width, height) = (20, 12);
    let mut texels: Vec<[f32; 3]> = (0..width * height)
        .map(|i| [0.2, 0.3, 0.5].map(|c| c * (1.0 + (TAU * i as f32 / width as f32).sin())))
        .collect();
    texels[2 * width as usize + 5] = [90.0, 70.0, 40.0];
    texels[9 * width as usize..11 * width as usize].fill([0.0; 3]);
    let turned = envmap::orientation(Vec3::new(0.2, 1.0, 0.1), 0.3);
    let map = EnvironmentMap::new(width, height, texels, turned).expect("a sky");
    let mut scene = lit(&channel);
    scene.lights.clear();
    scene.sky = Sky::Map(Arc::new(map));
    for sky_rays in [true, false] {
        let settings = PathSettings { sky_rays, max_scatterings: Some(4), ..PathSettings::default() };
        compare(if sky_rays { "sky rays" } else { "no sky rays" }, &gpu, &scene, settings);
    }
}

#[test]
fn paths_look_values_up_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let channel = cloud();
    let coarse = coarser_by(&channel, 2).expect("few tiles").expect("a coarser level");
    let mut scene = lit(&channel);
    for lookup in [Lookup::Nearest, Lookup::StochasticTrilinear, Lookup::Tricubic, Lookup::StochasticTricubic]
    {
        let settings = PathSettings { lookup, max_scatterings: Some(4), ..PathSettings::default() };
        compare(&format!("{lookup:?}"), &gpu, &scene, settings);
    }
    scene.volumes[0].coarse = Some(&coarse);
    compare(
        "a coarser level",
        &gpu,
        &scene,
        PathSettings { max_scatterings: Some(4), ..PathSettings::default() },
    );
}
