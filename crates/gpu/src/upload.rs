//! A volume on a device: the buffers of its trees and bricks, and what binds them.
//!
//! Trees stand in one buffer, fields in another, bricks in as many as the device's limit of a binding asks for, and those of
//! texture blocks in a texture for each format, where that is asked for.
//! All frames are there at once: which one is shown is a number that passes are told.

use glam::DVec3;

use crate::arrays::{Arrays, Room};
use crate::blocks::{self, Blocks, FORMATS};
use crate::device::Gpu;
use crate::error::GpuError;
use crate::params::{Field, Place};
use crate::shader::tables;

/// The most buffers of bricks: with what else a pass reads, as many storage buffers as WebGPU promises.
pub(crate) const MAX_CHUNKS: u64 = 4;
/// The binding of the texture of the first format of blocks.
pub(crate) const FIRST_TEXTURE: u32 = 3 + MAX_CHUNKS as u32;

/// A volume on a device.
#[derive(Debug)]
pub struct Volume {
    layout: wgpu::BindGroupLayout,
    bind_group: wgpu::BindGroup,
    tree: wgpu::Buffer,
    fields: wgpu::Buffer,
    bricks: Vec<wgpu::Buffer>,
    /// With their place among the formats.
    textures: Vec<(usize, Blocks)>,
    arrays: Summary,
    /// How often words were copied over what was there.
    fills: u64,
    log2_chunk_words: u32,
    size_bytes: SizeBytes,
}

/// What is still wanted of the arrays once their words are on the device.
#[derive(Debug, Default)]
struct Summary {
    origin: DVec3,
    codecs: u32,
    has_maps: bool,
    are_densities: bool,
    frames: usize,
    channels: usize,
    /// Of each channel.
    largest: Vec<f32>,
    /// Of each channel, frame by frame.
    places: Vec<Option<Place>>,
}

/// Which volume it is, and how often it was filled.
pub(crate) type Content = (wgpu::BindGroup, u64);

/// The memory that a volume takes on its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SizeBytes {
    /// Nodes, masks, entries and maps of bricks.
    pub trees: u64,
    /// Bricks and shapes.
    pub bricks: u64,
    /// Bricks in textures, with what no brick fills.
    pub textures: u64,
    /// Fields and tables.
    pub tables: u64,
}

impl SizeBytes {
    /// All of it.
    pub fn total(self) -> u64 {
        self.trees + self.bricks + self.textures + self.tables
    }
}

impl Volume {
    /// Copies the words of a volume to a device.
    ///
    /// # Errors
    /// If they exceed what the device takes, or it fails.
    pub fn new(gpu: &Gpu, arrays: &Arrays) -> Result<Volume, GpuError> {
        let mut volume = Volume::with_room(gpu, arrays.room())?;
        volume.fill(gpu, arrays)?;
        Ok(volume)
    }

    /// The memory that room takes.
    ///
    /// # Errors
    /// If textures are larger than the device takes.
    pub(crate) fn size_of(gpu: &Gpu, room: Room) -> Result<SizeBytes, GpuError> {
        let bytes = |words: usize| (words * size_of::<u32>()) as u64;
        let mut textures = 0;
        for (format, bricks) in FORMATS.iter().zip(room.blocks).filter(|(_, bricks)| *bricks > 0) {
            textures += Blocks::size_bytes(gpu, *format, bricks)?;
        }
        Ok(SizeBytes {
            trees: bytes(room.tree_words),
            bricks: bytes(room.brick_words.max(1)),
            textures,
            tables: bytes(tables::words().len()) + (room.fields * size_of::<Field>()) as u64,
        })
    }

    /// A volume that holds nothing yet, and has room.
    ///
    /// # Errors
    /// If that is more than the device takes, or it fails.
    pub(crate) fn with_room(gpu: &Gpu, room: Room) -> Result<Volume, GpuError> {
        let size_bytes = Volume::size_of(gpu, room)?;
        let binding = most_bytes(gpu);
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let within = |what, size_bytes: u64, limit_bytes| match size_bytes <= limit_bytes {
            true => Ok(()),
            false => Err(GpuError::Limit { what, size_bytes, limit_bytes }),
        };
        let field_bytes = (room.fields * size_of::<Field>()) as u64;
        within("a tree", size_bytes.trees, binding)?;
        let tree = gpu.empty_buffer("nuage tree", size_bytes.trees, usage)?;
        within("a table of frames", field_bytes, binding)?;
        let fields = gpu.empty_buffer("nuage fields", field_bytes, usage)?;
        let tables = gpu.buffer("nuage tables", bytemuck::cast_slice(&tables::words()), usage)?;

        let log2_chunk_words = (binding / 4).clamp(1, 1 << 31).ilog2();
        let chunk_words = 1_usize << log2_chunk_words;
        let count = room.brick_words;
        within("the bricks of a volume", 4 * count as u64, MAX_CHUNKS * 4 * chunk_words as u64)?;
        let chunk = |chunk: usize| {
            let words = chunk_words.min(count - chunk * chunk_words).max(1);
            gpu.empty_buffer("nuage bricks", 4 * words as u64, usage)
        };
        let bricks: Vec<wgpu::Buffer> =
            (0..count.div_ceil(chunk_words).max(1)).map(chunk).collect::<Result<_, _>>()?;
        let mut textures = Vec::new();
        for (number, bricks) in room.blocks.iter().enumerate().filter(|(_, bricks)| **bricks > 0) {
            if !gpu.device().features().contains(blocks::NEEDED) {
                return Err(GpuError::Misuse("textures of blocks on a device that has none".to_owned()));
            }
            textures.push((number, Blocks::new(gpu, FORMATS[number], *bricks)?));
        }

        let all: Vec<&wgpu::Buffer> = [&tree, &fields, &tables].into_iter().chain(&bricks).collect();
        let views: Vec<(u32, wgpu::TextureView)> = textures
            .iter()
            .map(|(number, texture)| (FIRST_TEXTURE + *number as u32, texture.view()))
            .collect();
        let entry = |binding: usize| storage_entry(binding as u32, true, wgpu::ShaderStages::COMPUTE);
        let of_textures = views.iter().map(|(binding, _)| texture_entry(*binding));
        let entries: Vec<_> = (0..all.len()).map(entry).chain(of_textures).collect();
        let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("nuage volume"), entries: &entries };
        let layout = gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))?;
        let bind_group = bind_all(gpu, "nuage volume", &layout, &all, &views)?;
        let arrays = Summary::default();
        Ok(Volume {
            layout,
            bind_group,
            tree,
            fields,
            bricks,
            textures,
            arrays,
            fills: 0,
            log2_chunk_words,
            size_bytes,
        })
    }

    /// Copies words to where there is room for them, over what was there. Gives their bytes.
    ///
    /// # Errors
    /// If the device fails.
    pub(crate) fn fill(&mut self, gpu: &Gpu, arrays: &Arrays) -> Result<u64, GpuError> {
        self.fills += 1;
        let mut sent = 0;
        let mut write = |buffer: &wgpu::Buffer, at: u64, bytes: &[u8]| {
            sent += bytes.len() as u64;
            gpu.guarded(|| gpu.queue().write_buffer(buffer, at, bytes))
        };
        write(&self.tree, 0, bytemuck::cast_slice(&arrays.tree_words()))?;
        write(&self.fields, 0, bytemuck::cast_slice(&arrays.fields()))?;
        let [bricks, shapes] = arrays.brick_words();
        let chunk_words = 1_usize << self.log2_chunk_words;
        for (chunk, buffer) in self.bricks.iter().enumerate() {
            let first = chunk * chunk_words;
            // What of bricks and of shapes falls into this buffer.
            for (words_before, part) in [(0, bricks), (bricks.len(), shapes)] {
                let begin = first.max(words_before);
                let end = (first + chunk_words).min(words_before + part.len());
                if begin < end {
                    let words = &part[begin - words_before..end - words_before];
                    write(buffer, 4 * (begin - first) as u64, bytemuck::cast_slice(words))?;
                }
            }
        }
        for (number, texture) in &self.textures {
            let words = arrays.blocks().map_or(&[][..], |blocks| &blocks[*number]);
            sent += size_of_val(words) as u64;
            texture.write(gpu, words)?;
        }
        self.arrays = Summary {
            origin: arrays.origin(),
            codecs: arrays.codecs(),
            has_maps: arrays.has_maps(),
            are_densities: arrays.are_densities(),
            frames: arrays.frames(),
            channels: arrays.channels(),
            largest: (0..arrays.channels()).map(|channel| arrays.largest(channel)).collect(),
            places: arrays.places().to_vec(),
        };
        Ok(sent)
    }

    /// How many frames there are.
    pub fn frames(&self) -> usize {
        self.arrays.frames
    }

    /// How many channels each frame has.
    pub fn channels(&self) -> usize {
        self.arrays.channels
    }

    /// The memory taken on the device.
    pub fn size_bytes(&self) -> SizeBytes {
        self.size_bytes
    }

    pub(crate) fn layout(&self) -> &wgpu::BindGroupLayout {
        &self.layout
    }

    pub(crate) fn bind_group(&self) -> &wgpu::BindGroup {
        &self.bind_group
    }

    /// What is another once anything is there that was not.
    pub(crate) fn content(&self) -> Content {
        (self.bind_group.clone(), self.fills)
    }

    /// Where the world of shaders begins.
    pub(crate) fn origin(&self) -> DVec3 {
        self.arrays.origin
    }

    pub(crate) fn codecs(&self) -> u32 {
        self.arrays.codecs
    }

    /// Whether all values mean themselves.
    pub(crate) fn are_densities(&self) -> bool {
        self.arrays.are_densities
    }

    /// Whether bricks are looked up in maps.
    pub(crate) fn has_maps(&self) -> bool {
        self.arrays.has_maps
    }

    /// How many buffers hold bricks, and log2 of the words of each.
    pub(crate) fn chunks(&self) -> (u32, u32) {
        (self.bricks.len() as u32, self.log2_chunk_words)
    }

    /// The buffers of the tree, of fields, and of bricks.
    pub(crate) fn parts(&self) -> (&wgpu::Buffer, &wgpu::Buffer, &[wgpu::Buffer]) {
        (&self.tree, &self.fields, &self.bricks)
    }

    /// Says what the largest value of each channel turned out to be.
    pub(crate) fn set_largest(&mut self, largest: impl Iterator<Item = f32>) {
        self.arrays.largest = largest.collect();
    }

    /// The buffers of the tree and of bricks, for tests of what happens if they hold anything.
    #[cfg(test)]
    pub(crate) fn buffers(&self) -> impl Iterator<Item = &wgpu::Buffer> {
        std::iter::once(&self.tree).chain(&self.bricks)
    }

    /// The formats of which there are textures, a bit each.
    pub(crate) fn textures(&self) -> u32 {
        self.textures.iter().fold(0, |bits, (number, _)| bits | 1 << number)
    }

    /// The largest value of a channel in all frames.
    pub(crate) fn largest(&self, channel: usize) -> f32 {
        self.arrays.largest.get(channel).copied().unwrap_or(0.0)
    }

    /// Where a channel is in a frame.
    pub(crate) fn place(&self, frame: usize, channel: usize) -> Option<&Place> {
        self.arrays.places.get(frame * self.arrays.channels + channel)?.as_ref()
    }
}

/// The most bytes that can be bound at once.
pub(crate) fn most_bytes(gpu: &Gpu) -> u64 {
    let limits = gpu.device().limits();
    limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
}

/// A binding of a storage buffer.
pub(crate) fn storage_entry(
    binding: u32,
    read_only: bool,
    visibility: wgpu::ShaderStages,
) -> wgpu::BindGroupLayoutEntry {
    buffer_entry(binding, visibility, wgpu::BufferBindingType::Storage { read_only })
}

/// A binding of a texture of blocks.
pub(crate) fn texture_entry(binding: u32) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: false },
        view_dimension: wgpu::TextureViewDimension::D3,
        multisampled: false,
    };
    wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::COMPUTE, ty, count: None }
}

/// A binding of a buffer.
pub(crate) fn buffer_entry(
    binding: u32,
    visibility: wgpu::ShaderStages,
    ty: wgpu::BufferBindingType,
) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None };
    wgpu::BindGroupLayoutEntry { binding, visibility, ty, count: None }
}

/// Binds whole buffers in order.
///
/// # Errors
/// If the device fails.
pub(crate) fn bind(
    gpu: &Gpu,
    label: &str,
    layout: &wgpu::BindGroupLayout,
    buffers: &[&wgpu::Buffer],
) -> Result<wgpu::BindGroup, GpuError> {
    bind_all(gpu, label, layout, buffers, &[])
}

/// As [`bind`], with textures at bindings of their own.
fn bind_all(
    gpu: &Gpu,
    label: &str,
    layout: &wgpu::BindGroupLayout,
    buffers: &[&wgpu::Buffer],
    textures: &[(u32, wgpu::TextureView)],
) -> Result<wgpu::BindGroup, GpuError> {
    let buffers = (0..).zip(buffers.iter().map(|buffer| buffer.as_entire_binding()));
    let textures =
        textures.iter().map(|(binding, view)| (*binding, wgpu::BindingResource::TextureView(view)));
    let entries: Vec<_> = buffers
        .chain(textures)
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource })
        .collect();
    let descriptor = wgpu::BindGroupDescriptor { label: Some(label), layout, entries: &entries };
    gpu.guarded(|| gpu.device().create_bind_group(&descriptor))
}
