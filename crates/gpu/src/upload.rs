//! A volume on a device: the buffers of its trees and bricks, and what binds them.
//!
//! Trees stand in one buffer, fields in another, bricks in as many as the device's limit of a binding asks for, and those of
//! texture blocks in a texture for each format, where that is asked for.
//! All frames are there at once: which one is shown is a number that passes are told.

use glam::DVec3;

use crate::arrays::Arrays;
use crate::blocks::{self, Blocks, FORMATS};
use crate::device::Gpu;
use crate::error::GpuError;
use crate::params::Place;
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
    bricks: Vec<wgpu::Buffer>,
    arrays: Summary,
    log2_chunk_words: u32,
    textures: u32,
    size_bytes: SizeBytes,
}

/// What is still wanted of the arrays once their words are on the device.
#[derive(Debug)]
struct Summary {
    origin: DVec3,
    codecs: u32,
    frames: usize,
    channels: usize,
    /// Of each channel.
    largest: Vec<f32>,
    /// Of each channel, frame by frame.
    places: Vec<Option<Place>>,
}

/// The memory that a volume takes on its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SizeBytes {
    /// Nodes, masks and entries.
    pub trees: u64,
    /// Bricks and shapes.
    pub bricks: u64,
    /// Bricks in textures, with what no brick fills.
    pub textures: u64,
    /// Fields and tables.
    pub tables: u64,
}

impl Volume {
    /// Copies the words of a volume to a device.
    ///
    /// # Errors
    /// If they exceed what the device takes, or it fails.
    pub fn new(gpu: &Gpu, arrays: &Arrays) -> Result<Volume, GpuError> {
        let limits = gpu.device().limits();
        let binding = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let storage = wgpu::BufferUsages::STORAGE;
        let within = |what, size_bytes: u64, limit_bytes| match size_bytes <= limit_bytes {
            true => Ok(()),
            false => Err(GpuError::Limit { what, size_bytes, limit_bytes }),
        };
        let tree_words = arrays.tree_words();
        within("a tree", size_of_val(tree_words.as_slice()) as u64, binding)?;
        let tree = gpu.buffer("nuage tree", bytemuck::cast_slice(&tree_words), storage)?;
        let fields = arrays.fields();
        within("a table of frames", size_of_val(fields.as_slice()) as u64, binding)?;
        let fields_buffer = gpu.buffer("nuage fields", bytemuck::cast_slice(&fields), storage)?;
        let table_words = tables::words();
        let tables = gpu.buffer("nuage tables", bytemuck::cast_slice(&table_words), storage)?;

        let [bricks, shapes] = arrays.brick_words();
        let log2_chunk_words = (binding / 4).clamp(1, 1 << 31).ilog2();
        let chunk_words = 1_usize << log2_chunk_words;
        let count = bricks.len() + shapes.len();
        within("the bricks of a volume", 4 * count as u64, MAX_CHUNKS * 4 * chunk_words as u64)?;
        let chunks = count.div_ceil(chunk_words).max(1);
        let mut buffers = Vec::with_capacity(chunks);
        for chunk in 0..chunks {
            let first = chunk * chunk_words;
            let words = chunk_words.min(count - first).max(1);
            let buffer =
                gpu.empty_buffer("nuage bricks", 4 * words as u64, storage | wgpu::BufferUsages::COPY_DST)?;
            // What of bricks and of shapes falls into this buffer.
            for (words_before, part) in [(0, bricks), (bricks.len(), shapes)] {
                let begin = first.max(words_before);
                let end = (first + words).min(words_before + part.len());
                if begin < end {
                    let words = &part[begin - words_before..end - words_before];
                    let at = 4 * (begin - first) as u64;
                    gpu.guarded(|| gpu.queue().write_buffer(&buffer, at, bytemuck::cast_slice(words)))?;
                }
            }
            buffers.push(buffer);
        }

        let mut textures = Vec::new();
        for (binding, (format, words)) in
            (FIRST_TEXTURE..).zip(FORMATS.iter().zip(arrays.blocks().into_iter().flatten()))
        {
            if words.is_empty() {
                continue;
            }
            if !gpu.device().features().contains(blocks::NEEDED) {
                return Err(GpuError::Misuse("textures of blocks on a device that has none".to_owned()));
            }
            let texture = Blocks::new(gpu, *format, words.len() / blocks::brick_words(*format))?;
            texture.write(gpu, words)?;
            textures.push((binding, texture));
        }

        let all: Vec<&wgpu::Buffer> = [&tree, &fields_buffer, &tables].into_iter().chain(&buffers).collect();
        let entry = |binding: usize| storage_entry(binding as u32, true, wgpu::ShaderStages::COMPUTE);
        let of_textures = textures.iter().map(|(binding, _)| texture_entry(*binding));
        let entries: Vec<_> = (0..all.len()).map(entry).chain(of_textures).collect();
        let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("nuage volume"), entries: &entries };
        let layout = gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))?;
        let views: Vec<_> = textures.iter().map(|(binding, texture)| (*binding, texture.view())).collect();
        let bind_group = bind_all(gpu, "nuage volume", &layout, &all, &views)?;
        Ok(Volume {
            layout,
            bind_group,
            arrays: Summary {
                origin: arrays.origin(),
                codecs: arrays.codecs(),
                frames: arrays.frames(),
                channels: arrays.channels(),
                largest: (0..arrays.channels()).map(|channel| arrays.largest(channel)).collect(),
                places: arrays.places().to_vec(),
            },
            log2_chunk_words,
            textures: textures.iter().fold(0, |bits, (binding, _)| bits | 1 << (binding - FIRST_TEXTURE)),
            size_bytes: SizeBytes {
                trees: tree.size(),
                bricks: buffers.iter().map(wgpu::Buffer::size).sum(),
                textures: textures.iter().map(|(_, texture)| texture.size_bytes()).sum(),
                tables: fields_buffer.size() + 4 * table_words.len() as u64,
            },
            tree,
            bricks: buffers,
        })
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

    /// Where the world of shaders begins.
    pub(crate) fn origin(&self) -> DVec3 {
        self.arrays.origin
    }

    pub(crate) fn codecs(&self) -> u32 {
        self.arrays.codecs
    }

    /// How many buffers hold bricks, and log2 of the words of each.
    pub(crate) fn chunks(&self) -> (u32, u32) {
        (self.bricks.len() as u32, self.log2_chunk_words)
    }

    /// The buffers of the tree and of bricks, for tests of what happens if they hold anything.
    #[cfg(test)]
    pub(crate) fn buffers(&self) -> impl Iterator<Item = &wgpu::Buffer> {
        std::iter::once(&self.tree).chain(&self.bricks)
    }

    /// The formats of which there are textures, a bit each.
    pub(crate) fn textures(&self) -> u32 {
        self.textures
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
