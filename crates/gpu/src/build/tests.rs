//! Trees of the device held to those that the processor makes of the same values, entry for entry.

use glam::{DVec3, IVec3, Vec3};
use nuage_pipeline::import::{import, import_surface};
use nuage_render::camera::Camera;
use nuage_render::hash::{hash_pixel, unit_f32};
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::scene::{Phase, Spectrum};
use nuage_render::views::View;
use nuage_volume::codec::Codec;
use nuage_volume::packed::{Content, Trees};

use super::*;
use crate::device::Wanted;
use crate::look::{Look, Medium, MediumPlace, Pass};
use crate::params::Field;
use crate::renderer::Renderer;

/// The word of a field that counts the cells of its tree.
const FIELD_CELL_COUNT: usize = std::mem::offset_of!(Field, box_first) / 4 + 3;

/// A device, or `None` after saying that there is none.
fn gpu() -> Option<Gpu> {
    match Gpu::open(&Wanted::Best) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            nuage_testkit::left_out("gpu", &error.to_string());
            None
        }
    }
}

/// Values at all voxels of a box, x the slowest.
struct Array {
    name: &'static str,
    size: [u32; 3],
    meaning: Meaning,
    values: Vec<f32>,
}

impl Array {
    fn new(name: &'static str, size: [u32; 3], meaning: Meaning, f: impl Fn(IVec3) -> f32) -> Array {
        let values = voxels(size).map(f).collect();
        Array { name, size, meaning, values }
    }

    /// On a device.
    fn grid(&self, gpu: &Gpu) -> Grid {
        let [_, y, z] = self.size;
        let usage = wgpu::BufferUsages::STORAGE;
        let values = gpu.buffer("values", bytemuck::cast_slice(&self.values), usage).expect("a buffer");
        Grid {
            values: Values::Dense { values, strides: [y * z, z, 1] },
            size: self.size,
            meaning: self.meaning,
            world_from_index: DAffine3::from_scale(DVec3::splat(0.1)),
            max_bricks: None,
        }
    }

    /// What the processor makes of them, where the device's tree has them: one brick from the origin.
    fn channel(&self) -> nuage_volume::channel::Channel {
        use nuage_vdb::{MetaValue, Shape, Transform, TreeBuilder};
        let [x, y, z] = self.size.map(|side| side as i32);
        let band = match self.meaning {
            Meaning::Density => 0.0,
            Meaning::Fog { band } | Meaning::Surface { band } => band,
        };
        let mut builder = TreeBuilder::new(band, Shape::STANDARD);
        for brick in voxels(self.size.map(|side| side.div_ceil(8))) {
            let (mut mask, mut stored) = ([0_u64; 8], [band; 512]);
            for offset in 0..512 {
                let voxel: IVec3 = (brick << 3) + IVec3::new(offset >> 6, offset >> 3 & 7, offset & 7);
                if voxel.x < x && voxel.y < y && voxel.z < z {
                    mask[offset as usize / 64] |= 1 << (offset % 64);
                    stored[offset as usize] = self.values[((voxel.x * y + voxel.y) * z + voxel.z) as usize];
                }
            }
            let first: IVec3 = (brick << 3) + 8;
            builder.leaf(first.to_array(), &mask, &stored);
        }
        let tree = builder.build().expect("leaves side by side");
        let mut grid = nuage_vdb::Grid::new("values", Transform::uniform_scale(0.1), tree);
        if self.meaning != Meaning::Density {
            grid.metadata.insert("class", MetaValue::from_text("level set"));
        }
        match self.meaning {
            Meaning::Surface { .. } => import_surface(grid).expect("a channel").0,
            _ => import(grid).expect("a channel").0,
        }
    }

    fn arrays(&self) -> Arrays {
        Arrays::of_channels(&[&self.channel()]).expect("arrays")
    }
}

fn voxels([x, y, z]: [u32; 3]) -> impl Iterator<Item = IVec3> {
    let at = |x, y, z| glam::UVec3::new(x, y, z).as_ivec3();
    (0..x).flat_map(move |i| (0..y).flat_map(move |j| (0..z).map(move |k| at(i, j, k))))
}

fn random(seed: u32, at: IVec3) -> f32 {
    unit_f32(hash_pixel(seed, at.x as u32, at.y as u32, at.z as u32))
}

/// The distance from a ball.
fn ball(at: IVec3) -> f32 {
    at.as_vec3().distance(Vec3::new(24.3, 20.1, 27.7)) - 17.5
}

/// A cloud of a file, level sets as fog and as surfaces, dots across the borders of nodes, a wall at one, and values of all
/// kinds.
fn arrays() -> Vec<Array> {
    let path = nuage_testkit::committed("oracle/oracle_64.vdb");
    let file = nuage_vdb::File::open(std::fs::read(path).expect("readable")).expect("a VDB file");
    let grid = file.read_grid(file.find("density").expect("the grid")).expect("an intact grid");
    let cloud = grid.tree.as_float().expect("floats");
    let strange = [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -2.5, -0.0, 0.0, 1e30, 3e-38];
    vec![
        Array::new("cloud", [64; 3], Meaning::Density, |at| cloud.voxel(at.to_array()).value),
        Array::new("fog", [50, 41, 53], Meaning::Fog { band: 3.0 }, ball),
        Array::new("surface", [50, 41, 53], Meaning::Surface { band: 3.0 }, ball),
        Array::new("dots", [270, 12, 140], Meaning::Density, |at| {
            let is_dot = random(3, at) < 3e-4 || at == IVec3::new(119, 7, 119) || at.x == 120;
            if is_dot { 1e-3 + random(4, at) } else { 0.0 }
        }),
        // The nodes before it hold nothing, but touch it: tiles of zeros.
        Array::new(
            "wall",
            [150, 40, 20],
            Meaning::Density,
            |at| {
                if at.x >= 120 { random(7, at) } else { 0.0 }
            },
        ),
        Array::new("strange", [40, 33, 17], Meaning::Density, |at| match (at.x / 8, at.z) {
            (0, _) => 2.0,
            (1, z) if z < 8 => f32::INFINITY,
            (2, z) if z < 8 => f32::NAN,
            _ => *strange.get((random(5, at) * 60.0) as usize).unwrap_or(&random(6, at)),
        }),
    ]
}

/// The trees in words as a device has them.
fn trees(words: &[u32]) -> Trees {
    let array = |i: usize| match i {
        4 => &words[words[4] as usize..],
        i => &words[words[i] as usize..words[i + 1] as usize],
    };
    Trees {
        cells: bytemuck::pod_collect_to_vec(array(0)),
        node5s: bytemuck::pod_collect_to_vec(array(1)),
        node4s: bytemuck::pod_collect_to_vec(array(2)),
        entries: bytemuck::pod_collect_to_vec(array(3)),
        masks: array(4).to_vec(),
    }
}

/// The words of all buffers of a builder, trees first.
fn words(builder: &Builder) -> [Vec<u32>; 3] {
    let (tree, fields, bricks) = builder.volume.parts();
    [tree, fields, &bricks[0]].map(|buffer| {
        let bytes = builder.gpu.read(buffer).expect("a buffer");
        bytemuck::pod_collect_to_vec(&bytes)
    })
}

/// A tree with the words of its bricks.
struct Side {
    trees: Trees,
    bricks: Vec<u32>,
}

impl Side {
    fn slots(&self, node: Node, slots: usize) -> Vec<(usize, Entry)> {
        let set = mask::slots(&self.trees, node.mask, slots).collect::<Vec<_>>();
        let entries = &self.trees.entries[node.first_entry as usize..];
        set.into_iter().zip(entries.iter().copied()).collect()
    }
}

/// Two entries of one place, and what stands below them: equal but for the numbers of nodes. Counts the entries.
fn hold_entry(name: &str, ours: &Side, theirs: &Side, [a, b]: [Entry; 2], level: usize) -> usize {
    assert_eq!(a.kind, b.kind, "{name}: tag and bounds of an entry {level} above bricks");
    match [a, b].map(|entry| entry.content()) {
        [Some(Content::Node(i)), Some(Content::Node(j))] => {
            let (nodes, other, slots) = match level {
                2 => (&ours.trees.node5s, &theirs.trees.node5s, NODE5_SLOTS),
                _ => (&ours.trees.node4s, &theirs.trees.node4s, NODE4_SLOTS),
            };
            let (a, b) = (ours.slots(nodes[i as usize], slots), theirs.slots(other[j as usize], slots));
            assert_eq!(
                a.iter().map(|(slot, _)| *slot).collect::<Vec<_>>(),
                b.iter().map(|(slot, _)| *slot).collect::<Vec<_>>(),
                "{name}: slots of a node {level} above bricks"
            );
            let below = a.iter().zip(&b).map(|(a, b)| hold_entry(name, ours, theirs, [a.1, b.1], level - 1));
            1 + below.sum::<usize>()
        }
        [Some(Content::Brick { codec: Codec::F32, offset }), Some(Content::Brick { .. })] => {
            let at = offset as usize;
            let other = b.payload as usize;
            assert_eq!(ours.bricks[at..at + 512], theirs.bricks[other..other + 512], "{name}: a brick");
            1
        }
        [Some(Content::Constant(a)), Some(Content::Constant(b))] => {
            assert_eq!(a, b, "{name}: a constant");
            1
        }
        other => panic!("{name}: {other:?}"),
    }
}

/// Ten builds of each of six grids, with other values in the same memory between them.
#[test]
fn trees_are_those_of_the_processor() {
    let Some(gpu) = gpu() else { return };
    for array in arrays() {
        let grid = array.grid(&gpu);
        let Values::Dense { values, .. } = &grid.values else { panic!("dense") };
        let mut builder = Builder::new(&gpu, std::slice::from_ref(&grid)).expect("a builder");
        let others: Vec<f32> = array.values.iter().rev().copied().collect();
        let run = |builder: &mut Builder, of: &[f32]| {
            gpu.queue().write_buffer(values, 0, bytemuck::cast_slice(of));
            builder.run().expect("a build")
        };
        let mut first = None;
        let name = array.name;
        for i in 0..10 {
            run(&mut builder, &others);
            let built = run(&mut builder, &array.values)[0];
            let found = (built, words(&builder));
            assert!(first.get_or_insert_with(|| found.clone()) == &found, "{name}: build {i}");
        }
        let (built, [tree, fields, bricks]) = first.expect("ten builds");
        let reference = array.arrays();
        let ours = Side { trees: trees(&tree), bricks };
        let theirs =
            Side { trees: trees(&reference.tree_words()), bricks: reference.brick_words()[0].to_vec() };
        assert_eq!((ours.trees.cells.len(), theirs.trees.cells.len()), (1, 1), "{name}");
        let (a, b) = (ours.trees.cells[0], theirs.trees.cells[0]);
        assert_eq!(a.cell, b.cell);
        let entries = hold_entry(name, &ours, &theirs, [a.entry, b.entry], 2);
        assert!(entries > 50, "{name}: {entries} entries");
        let mut fields: Vec<Field> = bytemuck::pod_collect_to_vec(&fields);
        let mut of_reference = reference.fields();
        // The map of the processor for the tree of the device, and beside that of its own.
        let at = |field: &Field| field.box_last[3] as usize;
        let map = &tree[at(&fields[0])..];
        let [first, last] = builder.volume.place(0, 0).expect("a place").bricks();
        let of_processor = maps::map(&ours.trees, [0, 1], first, last).expect("a map");
        let kinds = |map: &[u32]| map.iter().step_by(maps::CELL_WORDS).copied().collect::<Vec<_>>();
        assert!(builder.volume.has_maps() && map == of_processor, "{name}: the map");
        assert_eq!(name == "wall", kinds(map).iter().any(|kind| kind & 0xff == maps::TILE_TAGS[0]), "{name}");
        assert!(
            kinds(map) == kinds(&reference.tree_words()[at(&of_reference[0])..]),
            "{name}: kinds in the map"
        );
        for field in fields.iter_mut().chain(&mut of_reference) {
            (field.index_offset, field.box_last[3]) = ([0; 4], 0);
        }
        assert_eq!(fields, of_reference, "{name}");
        assert_eq!(built.largest, reference.largest(0), "{name}");
        assert_eq!(built.bricks as usize * BRICK_VOXELS, reference.brick_words()[0].len(), "{name}");
    }
}

/// Lists of voxels in any order give what dense arrays do; two channels stand side by side, one of values whose x is fastest.
#[test]
fn lists_and_channels_stand_beside_each_other() {
    let Some(gpu) = gpu() else { return };
    for array in arrays() {
        let [x, y, z] = array.size;
        let mut list: Vec<[u32; 4]> = voxels(array.size)
            .zip(&array.values)
            .map(|(at, value)| [at.x as u32, at.y as u32, at.z as u32, value.to_bits()])
            .collect();
        list.sort_by_key(|voxel| hash_pixel(voxel[0], voxel[1], voxel[2], 9));
        // Beside the array, and twice at one place.
        list.extend([[u32::MAX, 0, 0, 1.0_f32.to_bits()], [x, 0, 0, 1.0_f32.to_bits()], list[0]]);
        let usage = wgpu::BufferUsages::STORAGE;
        let voxels_buffer = gpu.buffer("voxels", bytemuck::cast_slice(&list), usage).expect("a buffer");
        let of_list = Grid { values: Values::List { voxels: voxels_buffer }, ..array.grid(&gpu) };
        let turned = (0..z).flat_map(|k| (0..y).flat_map(move |j| (0..x).map(move |i| (i, j, k))));
        let turned: Vec<f32> = turned.map(|(i, j, k)| array.values[((i * y + j) * z + k) as usize]).collect();
        let values = gpu.buffer("values", bytemuck::cast_slice(&turned), usage).expect("a buffer");
        let turned = Grid { values: Values::Dense { values, strides: [1, x, x * y] }, ..array.grid(&gpu) };
        let mut builder = Builder::new(&gpu, &[of_list, turned]).expect("a builder");
        let built = builder.run().expect("a build");
        let [tree, fields, bricks] = words(&builder);
        let ours = Side { trees: trees(&tree), bricks };
        let reference = array.arrays();
        let theirs =
            Side { trees: trees(&reference.tree_words()), bricks: reference.brick_words()[0].to_vec() };
        assert_eq!((built.len(), ours.trees.cells.len()), (2, 2));
        for cell in &ours.trees.cells {
            hold_entry(array.name, &ours, &theirs, [cell.entry, theirs.trees.cells[0].entry], 2);
        }
        let fields: Vec<Field> = bytemuck::pod_collect_to_vec(&fields);
        for (field, channel) in fields.iter().zip(0..) {
            let [first, last] = builder.volume.place(0, channel as usize).expect("a place").bricks();
            let map = maps::map(&ours.trees, [channel, 1], first, last).expect("a map");
            assert!(tree[field.box_last[3] as usize..][..map.len()] == map, "{}: map {channel}", array.name);
        }
    }
}

/// Nothing at all is an empty volume, too much is an error and an empty volume, and both pass.
#[test]
fn what_does_not_fit_is_said() {
    let Some(gpu) = gpu() else { return };
    let array = Array::new("noise", [30, 20, 10], Meaning::Density, |at| random(1, at));
    let grid = array.grid(&gpu);
    let Values::Dense { values, .. } = &grid.values else { panic!("dense") };
    let limited = Grid { max_bricks: Some(5), ..grid.clone() };
    let mut builder = Builder::new(&gpu, &[limited]).expect("a builder");
    assert_eq!(builder.volume().size_bytes().bricks, 5 * 2048, "as much as was asked for");
    let cell_count = |builder: &Builder| words(builder)[1][FIELD_CELL_COUNT];
    let Err(GpuError::Limit { size_bytes, limit_bytes, .. }) = builder.run() else {
        panic!("24 bricks in 5")
    };
    assert_eq!((size_bytes, limit_bytes, cell_count(&builder)), (24 * 2048, 5 * 2048, 0));
    let [tree, fields, _] = words(&builder);
    let map = &tree[fields[FIELD_CELL_COUNT + 4] as usize..];
    assert_eq!(
        map,
        maps::empty(map.len() / maps::CELL_WORDS),
        "nothing is met by whoever looks nevertheless"
    );
    gpu.queue().write_buffer(values, 0, &vec![0; array.values.len() * 4]);
    assert_eq!(builder.run(), Ok(vec![Built { bricks: 0, largest: 0.0 }]));
    assert_eq!(cell_count(&builder), 0);
    gpu.queue().write_buffer(values, 0, bytemuck::cast_slice(&[0.5_f32]));
    assert_eq!(builder.run(), Ok(vec![Built { bricks: 1, largest: 0.5 }]));
    assert_eq!(cell_count(&builder), 1);

    let refused = |grid: Grid| matches!(Builder::new(&gpu, &[grid]), Err(GpuError::Misuse(_)));
    assert!(refused(Grid { size: [30, 20, 11], ..grid.clone() }), "beyond its buffer");
    assert!(refused(Grid { size: [0, 20, 10], ..grid.clone() }));
    assert!(refused(Grid { size: [MAX_SIDE + 1, 1, 1], ..grid.clone() }));
    assert!(refused(Grid { meaning: Meaning::Fog { band: f32::NAN }, ..grid.clone() }));
    let strides = [u32::MAX; 3];
    assert!(refused(Grid { values: Values::Dense { values: values.clone(), strides }, ..grid.clone() }));
    let sparse = Values::Dense { values: values.clone(), strides: [0; 3] };
    let huge = Builder::new(&gpu, &[Grid { values: sparse, size: [MAX_SIDE; 3], ..grid }]);
    assert!(matches!(huge, Err(GpuError::Limit { .. })), "{:?}", huge.map(drop));
}

/// The same bits in each pixel as from the tree of the processor, also where bricks fill several buffers.
#[test]
fn pictures_are_those_of_the_processors_tree() {
    let Some(ours) = gpu() else { return };
    // A device that binds no more than 1 MiB at once: 512 bricks.
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()));
    let required_limits =
        wgpu::Limits { max_storage_buffer_binding_size: 1 << 20, ..wgpu::Limits::default() };
    let descriptor = wgpu::DeviceDescriptor { required_limits, ..Default::default() };
    let opened = pollster::block_on(adapter.expect("an adapter").request_device(&descriptor));
    let (device, queue) = opened.expect("a device");
    let small = Gpu::from_host(device, queue, "small".to_owned());

    let array = Array::new("cloud", [65, 57, 57], Meaning::Density, |at| {
        let inside = 1.0 - at.as_vec3().distance(Vec3::splat(30.0)) / 30.0;
        (inside + 0.4 * random(2, at)).clamp(0.01, 0.7)
    });
    let centre = DVec3::splat(3.8);
    let camera = Camera::look_at(centre + DVec3::new(4.0, 3.0, 9.0), centre, DVec3::Y, 40.0).expect("a view");
    let mut look = Look {
        camera,
        media: vec![Medium {
            place: MediumPlace::Channel(0),
            coarse: None,
            extinction: [1.5; 3],
            albedo: [0.9; 3],
            phase: Phase::HenyeyGreenstein { g: 0.4 },
            glow: Some((Some(1), Spectrum::Linear { rgb: [0.5, 0.2, 0.1] })),
        }],
        lights: vec![Light::Sun(Sun::point(Vec3::new(0.48, 0.8, -0.36), [3.0; 3]))],
        sky: Sky::Constant([0.2, 0.3, 0.5]),
    };
    let quality = Quality { step_voxels: 2.0, shadow_step_voxels: 6.0, sky_rays: 0, ..Quality::default() };
    let channel = array.channel();
    let arrays = Arrays::of_channels(&[&channel, &channel]).expect("arrays");
    for (gpu, pass) in
        [(&ours, Pass::March(quality)), (&small, Pass::View(View::Density { extinction: 0.5 }))]
    {
        let grid = array.grid(gpu);
        let mut builder = Builder::new(gpu, &[grid.clone(), grid]).expect("a builder");
        builder.run().expect("a build");
        let reference = Volume::new(gpu, &arrays).expect("a volume");
        assert_eq!(builder.volume().chunks().0, if std::ptr::eq(gpu, &small) { 3 } else { 1 });
        let mut renderer = Renderer::new(gpu, [64, 36]).expect("a renderer");
        let mut pixels = |volume: &Volume, shift: f64| {
            look.camera.origin = camera.origin + shift;
            renderer.prepare(volume, &look, &pass, 0, None).expect("a pass");
            renderer.run(volume).expect("a run");
            renderer.pixels().expect("pixels")
        };
        // Indices of the array are eight less than those of the reference.
        let built = pixels(builder.volume(), -0.8);
        assert!(built.iter().filter(|pixel| pixel[3] > 0.1).count() > 300, "{pass:?}");
        assert_eq!(built, pixels(&reference, 0.0), "{pass:?}");
    }
}
