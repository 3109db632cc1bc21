//! Trees built on the device: from values that a simulation left there to a volume that is drawn, without a way through
//! the processor.
//!
//! The words are those of `nuage_volume`'s builder and packer over `nuage_pipeline::import`, entry for entry, but that equal
//! masks and nodes are not shared: bricks of one value become tiles, those of zeros vanish, what touches a value has an entry,
//! and bounds are those of trilinear footprints. Maps of bricks, where they are worth it, are those of `maps`. Room for
//! the largest tree of an array's size is taken once; building again allocates nothing, and is the same work each time.
//!
//! What does not live here: how a volume is drawn ([`crate::renderer`]), and trees from files ([`crate::arrays`]).

use bytemuck::{Pod, Zeroable};
use glam::{DAffine3, IVec3};
use nuage_volume::channel::IndexBox;
use nuage_volume::packed::{Entry, Node, RootCell, mask};
use nuage_volume::space::{
    BRICK_VOXELS, LOG2_BRICK, LOG2_NODE4_BRICKS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS,
};

use crate::arrays::{self, Arrays, Meaning};
use crate::device::Gpu;
use crate::error::GpuError;
use crate::maps;
use crate::params::Place;
use crate::shader::{HEADER_WORDS, build_text, scatter_text};
use crate::upload::{Volume, bind, buffer_entry, most_bytes, storage_entry};

/// Lanes of a workgroup: one for each row of slots of a `Node4`.
pub(crate) const LANES: u32 = 1 << (2 * LOG2_NODE4_BRICKS);
/// The steps of a build, by their entry points; …
pub(crate) const STEPS: [&str; 5] = ["summarise", "nodes", "root", "entries", "bricks"];
/// … and those that come behind where there is a map.
pub(crate) const MAP_STEPS: [&str; 3] = ["map_z", "map_y", "map_x"];
/// The bricks along z of a workgroup that takes several: rows of values side by side.
pub(crate) const GROUP_BRICKS: u32 = 8;
/// The words of the scratch buffer that count: bricks, and the bits of the largest value.
pub(crate) const COUNT_WORDS: u64 = 4;
/// Where, in what is known of a node, the rows of its slots begin.
pub(crate) const NODE_INFO_ROWS: u32 = 8;
/// The words of what is known of a node.
pub(crate) const NODE_INFO_WORDS: u32 = NODE_INFO_ROWS + LANES;
/// The words of what is known of a brick: its number and eight bounds.
const BRICK_INFO_WORDS: u64 = 17;
/// The words of what is known of a cell of a map: how far along z, and along z and y, the nearest entry is.
const CELL_INFO_WORDS: u64 = 2;
/// The binding of the first buffer of bricks.
pub(crate) const BRICKS_BINDING: u32 = 5;
/// What values mean; other than these, a density.
pub(crate) const MEANS_FOG: u32 = 1;
pub(crate) const MEANS_SURFACE: u32 = 2;

/// The most voxels along each axis: with one brick before them they fill a `Node5`.
pub const MAX_SIDE: u32 = (1 << (LOG2_NODE5_BRICKS + LOG2_BRICK)) - (1 << LOG2_BRICK);

/// Where the values of a grid are: storage buffers of the device.
#[derive(Debug, Clone)]
pub enum Values {
    /// A float for each voxel.
    Dense {
        /// The values.
        values: wgpu::Buffer,
        /// How many values apart neighbours stand along x, y and z.
        strides: [u32; 3],
    },
    /// Voxels in any order, four words each: the indices as whole numbers, then the value as a float. What lies outside of the
    /// grid is left out, so that what is not used can be -1; of several at one place the densest counts.
    List {
        /// The voxels, as many as the buffer holds.
        voxels: wgpu::Buffer,
    },
}

/// A grid of values on the device, and what it is in the world. Outside of it there is nothing.
#[derive(Debug, Clone)]
pub struct Grid {
    /// Where the values are.
    pub values: Values,
    /// Voxels along each axis, at most [`MAX_SIDE`]. Their indices begin at 0.
    pub size: [u32; 3],
    /// What values mean. NaN counts as 0, what is infinite as the largest number.
    pub meaning: Meaning,
    /// Where indices lie in the world.
    pub world_from_index: DAffine3,
    /// The most bricks of 8³ voxels that are ever filled, for which memory is taken; all that there could be if not said.
    pub max_bricks: Option<u32>,
}

/// What a build found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Built {
    /// Bricks with more than one value.
    pub bricks: u32,
    /// The largest density.
    pub largest: f32,
}

/// As `Build` in `shader/build.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Params {
    size: [u32; 4],
    strides: [u32; 4],
    bricks: [u32; 4],
    nodes: [u32; 4],
    first: [u32; 4],
    map: [u32; 4],
}

/// As `Scatter` in `shader/scatter.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Scatter {
    size: [u32; 4],
    count: [u32; 4],
}

/// What is recorded for one channel.
#[derive(Debug)]
struct Channel {
    params: Params,
    group: wgpu::BindGroup,
    scratch: wgpu::Buffer,
    /// Of a list of voxels.
    list: Option<List>,
}

/// How the voxels of a list become dense.
#[derive(Debug)]
struct List {
    group: wgpu::BindGroup,
    dense: wgpu::Buffer,
    groups: [u32; 2],
}

/// Builds the trees of a volume of one frame, as often as its values change.
#[derive(Debug)]
pub struct Builder {
    gpu: Gpu,
    volume: Volume,
    channels: Vec<Channel>,
    steps: Vec<wgpu::ComputePipeline>,
    scatter: wgpu::ComputePipeline,
    /// What was found of each channel.
    counts: wgpu::Buffer,
}

impl Builder {
    /// Takes memory for the trees of some grids, the channels of a volume in this order, which is empty until a build.
    ///
    /// # Errors
    /// If a grid is larger than its buffer or than what the device takes, or the device fails.
    pub fn new(gpu: &Gpu, grids: &[Grid]) -> Result<Builder, GpuError> {
        let (mut room, mut params, mut places) = (Room::default(), Vec::new(), Vec::new());
        for grid in grids {
            check(grid)?;
            places.push(place(grid, room.channels));
            params.push(room.take(grid)?);
        }
        let mut arrays = Arrays::of_places(places);
        let most = most_bytes(gpu);
        let within = |what, words: u64, limit_bytes: u64| match 4 * words {
            size_bytes if size_bytes > limit_bytes => Err(GpuError::Limit { what, size_bytes, limit_bytes }),
            _ => Ok(()),
        };
        // Offsets have 32 bits.
        within("the bricks of a volume", room.bricks * BRICK_VOXELS as u64, 1 << 34)?;
        let mut room_of_arrays = room.of_arrays(grids.len());
        let map_words = arrays.make_maps_elsewhere(room_of_arrays);
        room_of_arrays.tree_words += map_words;
        let mut volume = Volume::with_room(gpu, room_of_arrays)?;
        volume.fill(gpu, &arrays)?;
        let (tree, fields, bricks) = volume.parts();
        gpu.guarded(|| gpu.queue().write_buffer(tree, 0, bytemuck::cast_slice(&room.header())))?;
        if arrays.has_maps() {
            // What no node reaches stays as it is.
            let empty = maps::empty(map_words / maps::CELL_WORDS);
            let at = 4 * room.tree_words();
            gpu.guarded(|| gpu.queue().write_buffer(tree, at, bytemuck::cast_slice(&empty)))?;
            for (params, (place, field)) in
                params.iter_mut().zip(arrays.places().iter().flatten().zip(arrays.fields()))
            {
                let [first, last] = place.bricks();
                params.map = (last - first + 3).extend(field.box_last[3]).as_uvec4().to_array();
            }
        }

        let (layout, scatter_layout) =
            (layout(gpu, BRICKS_BINDING as usize + bricks.len())?, layout(gpu, 3)?);
        let (chunks, log2_chunk_words) = volume.chunks();
        let text = build_text(chunks, log2_chunk_words, arrays.has_maps());
        let of_maps = MAP_STEPS.iter().filter(|_| arrays.has_maps());
        let steps = STEPS.iter().chain(of_maps).map(|step| pipeline(gpu, &layout, &text, step));
        let steps = steps.collect::<Result<_, _>>()?;
        let scatter = pipeline(gpu, &scatter_layout, &scatter_text(), "scatter")?;
        let mut channels = Vec::with_capacity(grids.len());
        for (grid, params) in grids.iter().zip(params) {
            let [x, y, z] = grid.size.map(u64::from);
            let (values, list) = match &grid.values {
                Values::Dense { values, .. } => (values.clone(), None),
                Values::List { voxels } => {
                    within("a grid of voxels", x * y * z, most)?;
                    let list = list(gpu, &scatter_layout, voxels, grid)?;
                    (list.dense.clone(), Some(list))
                }
            };
            let (uniform, storage) = (wgpu::BufferUsages::UNIFORM, wgpu::BufferUsages::STORAGE);
            let words = scratch_words(&params);
            within("what is known of a grid", words, most)?;
            let scratch =
                gpu.empty_buffer("nuage build", 4 * words, storage | wgpu::BufferUsages::COPY_SRC)?;
            let told = gpu.buffer("nuage build", bytemuck::bytes_of(&params), uniform)?;
            let buffers = [&told, &values, &scratch, tree, fields].into_iter().chain(bricks);
            let group = bind(gpu, "nuage build", &layout, &buffers.collect::<Vec<_>>())?;
            channels.push(Channel { params, group, scratch, list });
        }
        let usage = wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
        let counts =
            gpu.empty_buffer("nuage counts", 4 * COUNT_WORDS * channels.len().max(1) as u64, usage)?;
        Ok(Builder { gpu: gpu.clone(), volume, channels, steps, scatter, counts })
    }

    /// The volume, whose one frame is what was built last.
    pub fn volume(&self) -> &Volume {
        &self.volume
    }

    /// Records a build into an encoder: passes that come after it draw what the values are by then. A channel that needs more
    /// bricks than it may have is empty; [`Builder::check`] tells.
    pub fn record(&self, encoder: &mut wgpu::CommandEncoder) {
        for channel in &self.channels {
            if let Some(list) = &channel.list {
                encoder.clear_buffer(&list.dense, 0, None);
            }
            let descriptor =
                wgpu::ComputePassDescriptor { label: Some("nuage build"), timestamp_writes: None };
            let mut pass = encoder.begin_compute_pass(&descriptor);
            if let Some(list) = &channel.list {
                let [x, y] = list.groups;
                pass.set_pipeline(&self.scatter);
                pass.set_bind_group(0, &list.group, &[]);
                pass.dispatch_workgroups(x, y, 1);
            }
            pass.set_bind_group(0, &channel.group, &[]);
            let Params { bricks, nodes, map, .. } = channel.params;
            let rows = [bricks[0], bricks[1], bricks[2].div_ceil(GROUP_BRICKS), 0];
            let cells = [(map[1] * map[2]).div_ceil(LANES), map[0], 1, 0];
            let groups = [rows, nodes, [1; 4], nodes, rows, cells, cells, cells];
            for (step, [x, y, z, _]) in self.steps.iter().zip(groups) {
                pass.set_pipeline(step);
                pass.dispatch_workgroups(x, y, z);
            }
        }
        for (i, channel) in (0..).zip(&self.channels) {
            let bytes = 4 * COUNT_WORDS;
            encoder.copy_buffer_to_buffer(&channel.scratch, 0, &self.counts, i * bytes, bytes);
        }
    }

    /// Builds, and waits for it.
    ///
    /// # Errors
    /// As [`Builder::check`].
    pub fn run(&mut self) -> Result<Vec<Built>, GpuError> {
        let mut encoder = self.gpu.device().create_command_encoder(&Default::default());
        self.record(&mut encoder);
        self.gpu.guarded(|| self.gpu.queue().submit([encoder.finish()]))?;
        self.check()
    }

    /// What the last build that was submitted found of each channel, once it is done. Views of the first density have their
    /// colours go as far as the largest of the last check.
    ///
    /// # Errors
    /// If a channel needs more bricks than it may have, or the device fails.
    pub fn check(&mut self) -> Result<Vec<Built>, GpuError> {
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&self.gpu.read(&self.counts)?);
        let counts = words.chunks(COUNT_WORDS as usize).take(self.channels.len());
        let found: Vec<Built> =
            counts.map(|counts| Built { bricks: counts[0], largest: f32::from_bits(counts[1]) }).collect();
        for (channel, built) in self.channels.iter().zip(&found) {
            let limit = channel.params.strides[3];
            if built.bricks > limit {
                let brick_bytes = 4 * BRICK_VOXELS as u64;
                return Err(GpuError::Limit {
                    what: "a grid's filled bricks",
                    size_bytes: u64::from(built.bricks) * brick_bytes,
                    limit_bytes: u64::from(limit) * brick_bytes,
                });
            }
        }
        self.volume.set_largest(found.iter().map(|built| built.largest));
        Ok(found)
    }
}

/// Room in the arrays that the trees of all channels share.
#[derive(Debug, Default)]
struct Room {
    channels: u64,
    node4s: u64,
    entries: u64,
    mask_words: u64,
    bricks: u64,
}

impl Room {
    /// Takes what a grid can need at most.
    fn take(&mut self, grid: &Grid) -> Result<Params, GpuError> {
        let [x, y, z] = grid.size;
        let strides = match grid.values {
            Values::Dense { strides, .. } => strides,
            Values::List { .. } => [y * z, z, 1],
        };
        let bricks = grid.size.map(|side| side.div_ceil(1 << LOG2_BRICK));
        // What touches the array is one brick before it, and the tree's first.
        let nodes = bricks.map(|side| (side + 1).div_ceil(1 << LOG2_NODE4_BRICKS));
        let count = |sides: [u32; 3]| sides.map(u64::from).iter().product::<u64>();
        let most_bricks = grid.max_bricks.map_or(count(bricks), |limit| count(bricks).min(u64::from(limit)));
        let index = |words: u64| u32::try_from(words).map_err(|_| too_large());
        let (meaning, band) = match grid.values {
            Values::Dense { .. } => meaning(grid.meaning),
            // These are made dense as densities.
            Values::List { .. } => meaning(Meaning::Density),
        };
        let with = |sides: [u32; 3], last: u32| [sides[0], sides[1], sides[2], last];
        let params = Params {
            size: with([x, y, z], meaning),
            strides: with(strides, index(most_bricks)?),
            bricks: with(bricks, index(self.bricks)?),
            nodes: with(nodes, index(self.channels)?),
            first: [index(self.node4s)?, index(self.entries)?, index(self.mask_words)?, band.to_bits()],
            map: [0; 4],
        };
        let words = |slots: usize| mask::most_words(slots) as u64;
        self.channels += 1;
        self.node4s += count(nodes);
        // Those of bricks and of nodes.
        self.entries += count(bricks.map(|side| side + 1)) + count(nodes);
        self.mask_words += count(nodes) * words(NODE4_SLOTS) + words(NODE5_SLOTS);
        self.bricks += most_bricks;
        Ok(params)
    }

    /// The words of each array.
    fn array_words(&self) -> [u64; 5] {
        let words = |count: u64, bytes: usize| count * (bytes / 4) as u64;
        [
            words(self.channels, size_of::<RootCell>()),
            words(self.channels, size_of::<Node>()),
            words(self.node4s, size_of::<Node>()),
            words(self.entries, size_of::<Entry>()),
            self.mask_words,
        ]
    }

    fn tree_words(&self) -> u64 {
        HEADER_WORDS as u64 + self.array_words().iter().sum::<u64>()
    }

    /// The same as volumes take it.
    fn of_arrays(&self, channels: usize) -> arrays::Room {
        let [tree_words, brick_words] =
            [self.tree_words(), self.bricks * BRICK_VOXELS as u64].map(|words| words as usize);
        let counts = [self.channels, self.node4s, self.bricks].map(|count| count as usize);
        let most_bytes = maps::most_bytes(counts, false);
        arrays::Room { tree_words, fields: channels.max(1), brick_words, blocks: [0; 3], most_bytes }
    }

    /// As `Arrays::tree_words` has it. There are no shapes.
    fn header(&self) -> Vec<u32> {
        let mut words = Vec::with_capacity(HEADER_WORDS);
        let mut at = HEADER_WORDS as u64;
        for array in self.array_words() {
            words.push(at as u32);
            at += array;
        }
        words.extend([0, self.channels as u32]);
        words.resize(HEADER_WORDS, 0);
        words
    }
}

fn scratch_words(params: &Params) -> u64 {
    let count = |sides: [u32; 4]| sides[..3].iter().map(|side| u64::from(*side)).product::<u64>();
    COUNT_WORDS
        + u64::from(NODE_INFO_WORDS) * count(params.nodes)
        + BRICK_INFO_WORDS * count(params.bricks)
        + CELL_INFO_WORDS * count(params.map)
}

/// Whether a grid is as it should be.
fn check(grid: &Grid) -> Result<(), GpuError> {
    let misuse = |message: String| Err(GpuError::Misuse(message));
    let [x, y, z] = grid.size;
    if grid.size.iter().any(|side| !(1..=MAX_SIDE).contains(side)) {
        return misuse(format!("a grid of {x} × {y} × {z} voxels: each axis takes 1 to {MAX_SIDE}"));
    }
    if let Meaning::Fog { band } | Meaning::Surface { band } = grid.meaning
        && !(band.is_normal() && band > 0.0 && band <= f32::MAX / 2.0)
    {
        return misuse(format!("a level set's band of {band}"));
    }
    if let Values::Dense { values, strides } = &grid.values {
        let steps =
            grid.size.iter().zip(strides).map(|(side, stride)| u128::from(side - 1) * u128::from(*stride));
        let needed = 4 * (steps.sum::<u128>() + 1);
        if needed > u128::from(values.size()) {
            return misuse(format!(
                "a grid of {x} × {y} × {z} voxels reaches {needed} bytes far, its buffer holds {}",
                values.size()
            ));
        }
    }
    Ok(())
}

fn too_large() -> GpuError {
    GpuError::Misuse("grids of more than 2³² bricks or entries in all".to_owned())
}

/// Where the tree of a grid is.
fn place(grid: &Grid, channel: u64) -> Place {
    // The grid begins at the second brick of its tree.
    let first = IVec3::splat(1 << LOG2_BRICK);
    let size = glam::UVec3::from_array(grid.size).as_ivec3();
    Place {
        world_from_index: grid.world_from_index * DAffine3::from_translation(-first.as_dvec3()),
        active_box: IndexBox { min: first, max: first + size - 1 },
        index_offset: -first,
        // No cell until there is a tree.
        cells: [channel as u32, 0],
        brick_unit: 1.0,
        bounds_unit: 1.0,
        floor: 0.0,
        // What is in the tree is a density already.
        meaning: Meaning::Density.line(),
    }
}

fn meaning(meaning: Meaning) -> (u32, f32) {
    match meaning {
        Meaning::Density => (0, 1.0),
        Meaning::Fog { band } => (MEANS_FOG, band),
        Meaning::Surface { band } => (MEANS_SURFACE, band),
    }
}

fn list(
    gpu: &Gpu,
    layout: &wgpu::BindGroupLayout,
    voxels: &wgpu::Buffer,
    grid: &Grid,
) -> Result<List, GpuError> {
    let [x, y, z] = grid.size;
    let bytes = 4 * [x, y, z].map(u64::from).iter().product::<u64>();
    let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
    let dense = gpu.empty_buffer("nuage voxels", bytes, usage)?;
    let count = u32::try_from(voxels.size() / 16).map_err(|_| too_large())?;
    let (meaning, band) = meaning(grid.meaning);
    let params = Scatter { size: [x, y, z, meaning], count: [count, band.to_bits(), 0, 0] };
    let told = gpu.buffer("nuage voxels", bytemuck::bytes_of(&params), wgpu::BufferUsages::UNIFORM)?;
    let group = bind(gpu, "nuage voxels", layout, &[&told, voxels, &dense])?;
    let groups = count.div_ceil(LANES).max(1);
    let most = gpu.device().limits().max_compute_workgroups_per_dimension;
    let columns = groups.min(most);
    Ok(List { group, dense, groups: [columns, groups.div_ceil(columns)] })
}

/// What is told, what is read, and what is written.
fn layout(gpu: &Gpu, bindings: usize) -> Result<wgpu::BindGroupLayout, GpuError> {
    let stage = wgpu::ShaderStages::COMPUTE;
    let entry = |binding: u32| match binding {
        0 => buffer_entry(0, stage, wgpu::BufferBindingType::Uniform),
        binding => storage_entry(binding, binding == 1, stage),
    };
    let entries: Vec<_> = (0..bindings as u32).map(entry).collect();
    let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("nuage build"), entries: &entries };
    gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))
}

fn pipeline(
    gpu: &Gpu,
    layout: &wgpu::BindGroupLayout,
    text: &str,
    entry_point: &str,
) -> Result<wgpu::ComputePipeline, GpuError> {
    let device = gpu.device();
    gpu.guarded(|| {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(entry_point),
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(entry_point),
            bind_group_layouts: &[Some(layout)],
            immediate_size: 0,
        });
        device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry_point),
            layout: Some(&layout),
            module: &module,
            entry_point: Some(entry_point),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        })
    })
}

#[cfg(test)]
mod tests;
