//! Plays a packed volume on the GPU as fast as it goes, and says what switching frames costs beside drawing them.
//!
//! `cargo run --release -p nuage-gpu --example playback -- FILE.nuage [GRID] [FRAMES] [BUDGET_KIB]`
//!
//! Each frame is drawn as soon as it is switched to, and then twice again without a switch: what the first picture takes longer
//! than the second, with the switch, is the hitch; what the second takes longer than the third is what a device's times
//! scatter by themselves. All frames stay on the device, unless a budget is given: then they are streamed within it, once when they
//! are asked for, and once the next one ahead, while one is drawn. Rounds before those that count warm up: drivers make their code
//! in the first.

#![allow(clippy::print_stdout, reason = "an example says what it found")]

use std::error::Error;
use std::time::{Duration, Instant};

use glam::{DAffine3, DVec3, Vec3};
use nuage_gpu::arrays::{Arrays, Meaning, Wanted};
use nuage_gpu::device::{Gpu, Wanted as Device};
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Medium, MediumPlace, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::stream::Stream;
use nuage_gpu::upload::Volume;
use nuage_render::camera::Camera;
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::scene::Phase;
use nuage_volume::format::Asset;

const SIZE: [u32; 2] = [64, 36];
const WARM_UP: usize = 2;

/// What one frame took.
#[derive(Debug, Clone, Copy, Default)]
struct Turn {
    /// Until the frame could be drawn.
    switch: Duration,
    /// Drawn at once, and twice again.
    drawn: [Duration; 3],
    /// Copied to the device.
    bytes: u64,
    /// What the device's memory grew by.
    taken: u64,
}

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
    let mut renderer = Renderer::new(&gpu, SIZE)?;
    println!("{}, {count} frames of {SIZE:?}", gpu.name());
    match budget_kib {
        None => {
            let start = Instant::now();
            let volume = Volume::new(&gpu, &Arrays::of_asset(&asset, &wanted, 0..frames, form)?)?;
            println!("{frames} frames copied in {:.1?}: {:?}", start.elapsed(), volume.size_bytes());
            let turns = play_whole(&gpu, &mut renderer, &volume, &look, count)?;
            say("all at once", &turns);
        }
        Some(kib) => {
            for (how, is_ahead) in [("streamed", false), ("streamed, the next one ahead", true)] {
                let stream = Stream::new(&gpu, &asset, &wanted, form, 1024 * kib)?;
                if !is_ahead {
                    println!(
                        "{} of {frames} frames at a time in {} bytes",
                        stream.room(),
                        stream.size_bytes()
                    );
                }
                let turns = play_stream(&gpu, &mut renderer, stream, &asset, &look, count, is_ahead)?;
                say(how, &turns);
            }
        }
    }
    Ok(())
}

/// Plays frames that are all there.
fn play_whole(
    gpu: &Gpu,
    renderer: &mut Renderer,
    volume: &Volume,
    look: &Look,
    count: usize,
) -> Result<Vec<Turn>, GpuError> {
    renderer.prepare(volume, look, &pass(), 0, None)?;
    let mut turns = Vec::new();
    for i in 0..count + WARM_UP {
        let mut turn = Turn::default();
        let before = taken(gpu);
        let start = Instant::now();
        renderer.set_frame(volume, i % volume.frames())?;
        turn.switch = start.elapsed();
        renderer.run(volume)?;
        let first = start.elapsed() - turn.switch;
        turn.taken = taken(gpu).saturating_sub(before);
        turn.drawn = [first, again(renderer, volume)?, again(renderer, volume)?];
        turns.push(turn);
    }
    Ok(turns.split_off(WARM_UP))
}

/// Plays frames that are sent when they are asked for, or while the one before is drawn.
fn play_stream(
    gpu: &Gpu,
    renderer: &mut Renderer,
    mut stream: Stream,
    asset: &Asset,
    look: &Look,
    count: usize,
    is_ahead: bool,
) -> Result<Vec<Turn>, GpuError> {
    let frames = asset.contents().frames.len();
    let mut turns = Vec::new();
    for i in 0..count + WARM_UP {
        let mut turn = Turn::default();
        let (before, sent) = (taken(gpu), stream.sent_bytes());
        let start = Instant::now();
        let volume = stream.frame(asset, i % frames)?;
        renderer.prepare(volume, look, &pass(), 0, None)?;
        turn.switch = start.elapsed();
        if is_ahead {
            let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            renderer.record(&mut encoder, volume)?;
            gpu.queue().submit([encoder.finish()]);
            stream.frame(asset, (i + 1) % frames)?;
            gpu.wait()?;
        } else {
            renderer.run(volume)?;
        }
        let first = start.elapsed() - turn.switch;
        turn.bytes = stream.sent_bytes() - sent;
        turn.taken = taken(gpu).saturating_sub(before);
        let volume = stream.frame(asset, i % frames)?;
        turn.drawn = [first, again(renderer, volume)?, again(renderer, volume)?];
        turns.push(turn);
    }
    Ok(turns.split_off(WARM_UP))
}

/// How long the picture takes that was drawn last.
fn again(renderer: &mut Renderer, volume: &Volume) -> Result<Duration, GpuError> {
    let start = Instant::now();
    renderer.run(volume)?;
    Ok(start.elapsed())
}

/// The memory of ours on the device, in bytes; 0 if that does not say.
fn taken(gpu: &Gpu) -> u64 {
    let report = gpu.device().generate_allocator_report();
    let allocations = report.map_or(Vec::new(), |report| report.allocations);
    // What a wait takes for a moment is no frame's.
    let is_ours = |name: &str| name.starts_with("nuage") && name != "nuage probe";
    allocations.iter().filter(|allocation| is_ours(&allocation.name)).map(|allocation| allocation.size).sum()
}

fn say(how: &str, turns: &[Turn]) {
    let line = |what: &str, of: &dyn Fn(&Turn) -> f64| {
        let mut ms: Vec<f64> = turns.iter().map(|turn| 1e3 * of(turn)).collect();
        ms.sort_by(f64::total_cmp);
        let at = |share: f64| ms[((ms.len() - 1) as f64 * share).round() as usize];
        println!("  {what:10} {:8.2} {:8.2} {:8.2}", at(0.5), at(0.95), at(1.0));
    };
    println!("{how}: ms, median, 95 %, worst");
    line("switch", &|turn| turn.switch.as_secs_f64());
    line("picture", &|turn| turn.drawn[2].as_secs_f64());
    line("hitch", &|turn| (turn.switch + turn.drawn[0]).as_secs_f64() - turn.drawn[1].as_secs_f64());
    line("scatter", &|turn| turn.drawn[1].as_secs_f64() - turn.drawn[2].as_secs_f64());
    let (bytes, taken) =
        turns.iter().fold((0, 0), |(bytes, taken), turn| (bytes + turn.bytes, taken + turn.taken));
    let sent = turns.iter().filter(|turn| turn.bytes > 0).count();
    println!("  {sent} frames sent in {bytes} bytes; {taken} bytes of memory taken");
}

fn pass() -> Pass {
    Pass::March(Quality { step_voxels: 2.0, sky_rays: 0, ..Quality::default() })
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
