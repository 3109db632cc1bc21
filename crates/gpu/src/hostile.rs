//! Buffers that hold anything: every pass comes to an end, and the device goes on.
//!
//! Files are checked before anything of them reaches a device; this is for what gets there all the same, such as trees that a
//! host's simulation builds on the device itself.

use std::time::Instant;

use glam::{DAffine3, DVec3, IVec3};
use nuage_render::camera::Camera;
use nuage_render::hash::hash_u32;
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::path::PathSettings;
use nuage_render::scene::Phase;
use nuage_render::views::View;
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::TreeBuilder;
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::BRICK_VOXELS;

use crate::arrays::Arrays;
use crate::look::{Look, Medium, MediumPlace, Pass};
use crate::real_time::RealTime;
use crate::renderer::Renderer;
use crate::shader::HEADER_WORDS;
use crate::upload::Volume;

/// A block of bricks that are all there.
pub(crate) fn block(bricks: i32) -> Channel {
    let mut builder = TreeBuilder::new();
    let mut values = Vec::new();
    for i in 0..bricks.pow(3) {
        let brick: [f32; BRICK_VOXELS] = std::array::from_fn(|voxel| (voxel % 7) as f32 / 7.0);
        let place = IVec3::new(i / bricks / bricks, i / bricks % bricks, i % bricks);
        builder.brick(place, BrickSummary::of(&brick)).expect("a free place");
        values.extend(brick);
    }
    let tree = builder.finish(Bricks::F32(values)).expect("a small tree");
    let active_box = Some(IndexBox { min: IVec3::ZERO, max: IVec3::splat(8 * bricks - 1) });
    Channel { tree, world_from_index: DAffine3::from_scale(DVec3::splat(0.05)), active_box }
}

/// What it looks like in the light of a sun and an even sky.
pub(crate) fn look() -> Look {
    let camera = Camera::look_at(DVec3::new(5.0, 4.0, 6.0), DVec3::ONE, DVec3::Y, 30.0).expect("a view");
    let medium = Medium {
        place: MediumPlace::Channel(0),
        coarse: None,
        extinction: [3.0; 3],
        albedo: [0.99; 3],
        phase: Phase::HenyeyGreenstein { g: 0.3 },
        glow: None,
    };
    Look {
        camera,
        media: vec![medium],
        lights: vec![Light::Sun(Sun {
            direction_to: glam::Vec3::Y,
            irradiance: [1.0; 3],
            angle_degrees: 0.0,
        })],
        sky: Sky::Constant([1.0; 3]),
    }
}

/// How words are changed: word `i` of a buffer, `true` if that is the tree.
type Change = fn(u32, u32, bool) -> u32;

#[test]
fn any_words_come_to_an_end() {
    let Some(gpu) = crate::twins::gpu() else { return };
    let channel = block(5);
    let arrays = Arrays::of_channels(&[&channel]).expect("arrays");
    let look = look();
    let path = Pass::Path { settings: PathSettings::default(), sample: 0 };
    let measures = RealTime { accumulate: false, ..RealTime::default() };
    let passes = [
        Pass::View(View::Density { extinction: 1.0 }),
        Pass::View(View::Index),
        Pass::View(View::Surface { level: 0.5 }),
        Pass::March(Quality { sky_rays: 1, ..Quality::default() }),
        Pass::RealTime { quality: Quality::default(), measures },
        Pass::Shadow(Quality::default()),
        path,
    ];
    let changes: [(&str, Change); 4] =
        [
            ("anything", |_, i, _| hash_u32(i)),
            ("anything behind the header", |word, i, is_tree| {
                if is_tree && i < HEADER_WORDS as u32 { word } else { hash_u32(i) }
            }),
            ("a bit in sixteen words", |word, i, _| {
                if hash_u32(i) & 15 == 0 { word ^ 1 << (hash_u32(i) >> 27) } else { word }
            }),
            ("bounds above all values", |word, i, is_tree| {
                // Entries stand behind the nodes; what else becomes of the words that follow does not matter.
                if is_tree && i > HEADER_WORDS as u32 + 5 { word | 0x7fef_fe00 } else { word }
            }),
        ];
    let mut renderer = Renderer::new(&gpu, [24, 16]).expect("a renderer");
    let mut show = |volume: &Volume, pass: &Pass| {
        renderer.prepare(volume, &look, pass, 0, None).expect("a pass");
        renderer.run(volume).expect("an end");
        renderer.pixels().expect("pixels")
    };
    let sound = Volume::new(&gpu, &arrays).expect("a volume");
    let before = passes.map(|pass| show(&sound, &pass));
    for (name, change) in changes {
        let volume = Volume::new(&gpu, &arrays).expect("a volume");
        let [bricks, _] = arrays.brick_words();
        for (number, (buffer, words)) in
            volume.buffers().zip([arrays.tree_words(), bricks.to_vec()]).enumerate()
        {
            let changed: Vec<u32> = (0..).zip(words).map(|(i, word)| change(word, i, number == 0)).collect();
            gpu.queue().write_buffer(buffer, 0, bytemuck::cast_slice(&changed));
        }
        for pass in &passes {
            let start = Instant::now();
            show(&volume, pass);
            assert!(start.elapsed().as_secs() < 60, "{name}: {pass:?} takes {:?}", start.elapsed());
        }
    }
    // The device draws what it did before.
    assert!(passes.map(|pass| show(&sound, &pass)) == before, "a device that was hurt");
}
