//! Frames one after the other: nothing is taken or copied where all of them fit, and where they do not, no more than a budget,
//! with the same pictures.

mod common;

use std::sync::Arc;

use common::{gpu, lit, packed, picture, unpacked};
use nuage_gpu::arrays::{Arrays, Bricks, Meaning, Wanted};
use nuage_gpu::device::Gpu;
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::stream::Stream;
use nuage_gpu::upload::Volume;
use nuage_pipeline::pack::options::Options;
use nuage_render::views::View;
use nuage_vdb::AnyTree;
use nuage_volume::format::Asset;

const FRAMES: usize = 4;

/// Frames that fade, the bricks of which are of several codecs.
fn asset() -> Asset {
    let frames: Vec<_> = (0..FRAMES)
        .map(|frame| {
            let mut grid = common::grid("density");
            let share = 1.0 - 0.12 * frame as f32;
            grid.tree = match &*grid.tree {
                AnyTree::Float(tree) => Arc::new(tree.map(|value| (share * value).powf(share)).into()),
                other => panic!("{}", other.value_type()),
            };
            vec![grid]
        })
        .collect();
    packed(&frames, &Options::default())
}

fn wanted() -> [Wanted; 1] {
    [Wanted { name: "density".to_owned(), meaning: Meaning::Density }]
}

/// The device's memory that is ours, by the names that we gave it, but for what a wait or a look at a picture takes for a moment.
fn taken(gpu: &Gpu) -> Option<Vec<(String, u64)>> {
    let report = gpu.device().generate_allocator_report()?;
    let is_ours =
        |name: &str| name.starts_with("nuage") && !["nuage probe", "nuage read-back"].contains(&name);
    let ours = report.allocations.iter().filter(|allocation| is_ours(&allocation.name));
    let mut ours: Vec<_> = ours.map(|allocation| (allocation.name.clone(), allocation.size)).collect();
    ours.sort();
    Some(ours)
}

#[test]
fn switching_frames_takes_no_memory() {
    let Some(gpu) = gpu() else { return };
    let asset = asset();
    let arrays = Arrays::of_asset(&asset, &wanted(), 0..FRAMES, Bricks::AsStored).expect("arrays");
    let volume = Volume::new(&gpu, &arrays).expect("a volume");
    let look = Look::of_scene(&lit(&unpacked(&asset, 0, "density"))).expect("a look");
    let mut renderer = Renderer::new(&gpu, [32, 18]).expect("a renderer");
    renderer
        .prepare(&volume, &look, &Pass::View(View::Density { extinction: 2.0 }), 0, None)
        .expect("a pass");
    renderer.run(&volume).expect("a run");
    let before = taken(&gpu);
    for i in 0..100 {
        renderer.set_frame(&volume, i % FRAMES).expect("a frame");
        renderer.run(&volume).expect("a run");
        assert_eq!(taken(&gpu), before, "at frame {i}");
    }
    assert!(before.is_none_or(|before| before.len() >= 5), "names are known");
}

#[test]
fn streams_stay_within_their_budget_and_show_the_same() {
    let Some(gpu) = gpu() else { return };
    let asset = asset();
    let look = Look::of_scene(&lit(&unpacked(&asset, 0, "density"))).expect("a look");
    let pass = Pass::View(View::Density { extinction: 2.0 });
    let mut renderer = Renderer::new(&gpu, [80, 45]).expect("a renderer");
    let wanted = wanted();
    let (pictures, counts): (Vec<_>, Vec<_>) = {
        let arrays = Arrays::of_asset(&asset, &wanted, 0..FRAMES, Bricks::AsStored).expect("arrays");
        let whole = Volume::new(&gpu, &arrays).expect("a volume");
        let pictures = (0..FRAMES).map(|frame| picture(&mut renderer, &whole, &look, &pass, frame)).collect();
        let counts = (0..FRAMES).map(|frame| renderer.count(&whole, &look, &pass, frame).expect("counts"));
        (pictures, counts.collect())
    };
    gpu.wait().expect("the volume to go");
    let without = taken(&gpu);
    let sum = |taken: Option<Vec<(String, u64)>>| {
        taken.unwrap_or_default().iter().map(|(_, size)| *size).sum::<u64>()
    };

    let too_small = Stream::new(&gpu, &asset, &wanted, Bricks::AsStored, 1000).map(drop);
    let Err(GpuError::Limit { size_bytes: one, limit_bytes: 1000, .. }) = too_small else {
        panic!("{too_small:?}")
    };
    let budget = 5 * one / 2;
    let mut stream = Stream::new(&gpu, &asset, &wanted, Bricks::AsStored, budget).expect("a stream");
    assert_eq!((stream.room(), stream.size_bytes()), (2, 2 * one));
    let before = taken(&gpu);
    // What devices round sizes up to is theirs.
    assert!(sum(before.clone()) - sum(without) <= budget, "{before:?}");
    let mut sent = 0;
    // Forwards with the next one ahead, then here and there.
    let order = (0..FRAMES).flat_map(|frame| [frame, (frame + 1) % FRAMES]).chain([3, 1, 0, 2]);
    for (i, frame) in order.enumerate() {
        let was_there = stream.has(frame);
        let volume = stream.frame(&asset, frame).expect("a frame");
        assert_eq!(
            picture(&mut renderer, volume, &look, &pass, 0),
            pictures[frame],
            "turn {i}, frame {frame}"
        );
        assert_eq!(stream.sent_bytes() == sent, was_there, "turn {i}, frame {frame}");
        sent = stream.sent_bytes();
        assert!(stream.size_bytes() <= budget);
        assert_eq!(taken(&gpu), before, "turn {i}, frame {frame}");
    }
    // Rays leap as far as through the whole: frames that take others' place have maps of bricks too.
    for (frame, counts) in counts.iter().enumerate() {
        let volume = stream.frame(&asset, frame).expect("a frame");
        assert_eq!(renderer.count(volume, &look, &pass, 0).expect("counts"), *counts, "frame {frame}");
    }
    sent = stream.sent_bytes();
    assert!(stream.frame(&asset, FRAMES).is_err());
    assert!(
        stream.frame(&asset, FRAMES - 1).is_ok() && stream.sent_bytes() == sent,
        "what was there still is"
    );
}
