//! Plays a packed volume on the GPU as fast as it goes, and says how long frames take and what was copied to the device.
//!
//! `cargo run --release -p nuage-gpu --example playback -- FILE.nuage [GRID] [FRAMES] [BUDGET_KIB]`
//!
//! All frames stay on the device, unless a budget is given: then they are streamed within it. The first two rounds warm up:
//! drivers make their code in the first.

#![allow(clippy::print_stdout, reason = "an example says what it found")]

use std::error::Error;
use std::time::{Duration, Instant};

use glam::{DAffine3, DVec3, Vec3};
use nuage_gpu::arrays::{Arrays, Meaning, Wanted};
use nuage_gpu::device::{Gpu, Wanted as Device};
use nuage_gpu::look::{Look, Medium, MediumPlace, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::stream::Stream;
use nuage_gpu::upload::Volume;
use nuage_render::camera::Camera;
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::scene::Phase;
use nuage_volume::format::Asset;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let file = args.next().ok_or("which file?")?;
    let name = args.next().unwrap_or_else(|| "density".to_owned());
    let count: usize = args.next().map_or(Ok(100), |text| text.parse())?;
    let budget_kib: Option<u64> = args.next().map(|text| text.parse()).transpose()?;

    let mut asset = Asset::open(std::fs::read(file)?)?;
    asset.load_all()?;
    let gpu = Gpu::open(&Device::Best)?;
    let form = gpu.smallest_bricks()?;
    let wanted = [Wanted { name, meaning: Meaning::Density }];
    let frames = asset.contents().frames.len();
    let look = look(&asset).ok_or("nothing is active in any frame")?;
    let size = [64, 36];
    let mut renderer = Renderer::new(&gpu, size)?;
    let pass = Pass::March(Quality { step_voxels: 2.0, sky_rays: 0, ..Quality::default() });

    let mut times = Vec::new();
    let mut copied = Vec::new();
    match budget_kib {
        None => {
            let start = Instant::now();
            let volume = Volume::new(&gpu, &Arrays::of_asset(&asset, &wanted, 0..frames, form)?)?;
            println!("{frames} frames copied in {:.1?}: {:?}", start.elapsed(), volume.size_bytes());
            renderer.prepare(&volume, &look, &pass, 0, None)?;
            for i in 0..count + 2 {
                let start = Instant::now();
                renderer.set_frame(&volume, i % frames)?;
                renderer.run(&volume)?;
                times.push(start.elapsed());
                copied.push(0);
            }
        }
        Some(kib) => {
            let mut stream = Stream::new(&gpu, &asset, &wanted, form, 1024 * kib)?;
            println!("{} of {frames} frames at a time in {} bytes", stream.room(), stream.size_bytes());
            for i in 0..count + 2 {
                let before = stream.sent_bytes();
                let start = Instant::now();
                let volume = stream.frame(&asset, i % frames)?;
                renderer.prepare(volume, &look, &pass, 0, None)?;
                renderer.run(volume)?;
                times.push(start.elapsed());
                copied.push(stream.sent_bytes() - before);
            }
        }
    }
    let mut played: Vec<Duration> = times.split_off(2);
    let copied: u64 = copied[2..].iter().sum();
    played.sort();
    let [median, worst] = [played[played.len() / 2], played[played.len() - 1]];
    println!(
        "{} on {}: {count} frames of {size:?}, median {median:.2?}, worst {worst:.2?}, {copied} bytes of volumes copied",
        if budget_kib.is_some() { "streamed" } else { "all at once" },
        gpu.name()
    );
    Ok(())
}

/// A view of the last frame, which is the largest in most sequences.
fn look(asset: &Asset) -> Option<Look> {
    let grid = asset.contents().grids().filter(|grid| grid.active_box.is_some()).last()?;
    let world_from_index = DAffine3::from_cols_array(&grid.world_from_index?);
    let [min, max] = grid.active_box?.map(|corner| DVec3::from_array(corner.map(f64::from)));
    let centre = world_from_index.transform_point3(0.5 * (min + max));
    let side = world_from_index.transform_vector3(max - min).length();
    let camera = Camera::look_at(centre + DVec3::new(0.6, 0.5, 1.0) * side, centre, DVec3::Z, 40.0)?;
    let medium = Medium {
        place: MediumPlace::Channel(0),
        coarse: None,
        extinction: [(20.0 / side) as f32; 3],
        albedo: [0.9; 3],
        phase: Phase::HenyeyGreenstein { g: 0.3 },
        glow: None,
    };
    Some(Look {
        camera,
        media: vec![medium],
        lights: vec![Light::Sun(Sun::point(Vec3::new(0.6, 0.0, 0.8), [3.0; 3]))],
        sky: Sky::Constant([0.0; 3]),
    })
}
