//! The scenes with known answers: their camera, grids and lights.

use std::convert::Infallible;
use std::io::Cursor;

use glam::DVec3;
use nuage_pipeline::pack::options::Options;
use nuage_pipeline::pack::sequence::{FrameName, pack};
use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_render::camera::Camera;
use nuage_render::light::Sun;
use nuage_render::scene::{Phase, Scene, Shape, Volume};
use nuage_vdb::{Grid, Metadata};
use nuage_volume::channel::Channel;
use nuage_volume::format::Asset;
use serde_json::Value;

/// Pixels per side of every reference picture.
pub(crate) const SIZE: u32 = 128;

pub(crate) fn path(name: &str) -> std::path::PathBuf {
    nuage_testkit::find(&format!("oracle/{name}")).expect("a committed file")
}

pub(crate) fn json() -> Value {
    serde_json::from_slice(&std::fs::read(path("oracle.json")).expect("readable")).expect("JSON")
}

pub(crate) fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    std::array::from_fn(|i| value[i].as_f64().expect("a number"))
}

pub(crate) fn colour(value: &Value) -> [f32; 3] {
    numbers(value).map(|v| v as f32)
}

pub(crate) fn camera(json: &Value) -> Camera {
    let vector = |name: &str| DVec3::from_array(numbers(&json["camera"][name]));
    let fov = json["camera"]["fov_deg"].as_f64().expect("a number");
    Camera::look_at(vector("origin"), vector("target"), vector("up"), fov).expect("a view")
}

fn grid(name: &str) -> Grid {
    let bytes = std::fs::read(path("oracle_64.vdb")).expect("readable");
    let file = nuage_vdb::File::open(bytes).expect("a VDB file");
    file.read_grid(file.find(name).expect("the grid")).expect("an intact grid")
}

pub(crate) fn channel(name: &str) -> Channel {
    nuage_pipeline::import::import(grid(name)).expect("a linear transform").0
}

/// The same as it comes back from a packed file.
#[allow(dead_code, reason = "not every test binary takes packed values")]
pub(crate) fn packed_channel(name: &str) -> Channel {
    let frames = [FrameName { number: None, name: name.to_owned() }];
    let load = |_| Ok::<_, Infallible>((vec![grid(name)], Metadata::default()));
    let mut bytes = Cursor::new(Vec::new());
    let options = Options { psnr: Some(40.0), ..Options::default() };
    pack(&frames, load, &mut bytes, &options, None, &mut |_| ()).expect("a packed file");
    let mut asset = Asset::open(bytes.into_inner()).expect("a sound file");
    asset.load_frame(0).expect("sound bricks");
    let (mut grids, _) = unpack_frame(&asset, 0).expect("a frame");
    nuage_pipeline::import::import(grids.remove(0)).expect("a linear transform").0
}

pub(crate) fn lit_scene<'a>(json: &Value, density: &'a Channel, phase_g: f32) -> Scene<'a> {
    let scene = &json["scenes"]["het64_g0_ss"];
    let travel = DVec3::from_array(numbers(&scene["sun_direction_of_travel"]));
    let extinction = scene["sigma_scale"].as_f64().expect("a number") as f32;
    let volume = Volume {
        albedo: colour(&scene["albedo"]),
        phase: Phase::HenyeyGreenstein { g: phase_g },
        ..Volume::absorbing(Shape::Grid(density), extinction)
    };
    let irradiance = colour(&scene["sun_irradiance"]);
    let sun = Sun::point((-travel).normalize().as_vec3(), irradiance);
    Scene::of_one(camera(json), volume, Some(sun), colour(&scene["sky_radiance"]))
}
