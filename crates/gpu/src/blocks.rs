//! Bricks of texture blocks in 3D textures, which a device decodes as it reads them: where each brick lies, and whether a
//! device reads them right.
//!
//! A brick is 8 × 8 texels of as many slices as its format has. A layer of bricks is a square whose side is a power of two, so
//! that a brick's place follows from its number and the width of the texture alone.
//!
//! What does not live here: which bricks there are ([`crate::arrays`]), and decoding in shaders (`shader/block.wgsl`).

use nuage_volume::codec::block::{BlockFormat, PackingAxis, decode_brick};
use nuage_volume::space::{BRICK_VOXELS, LOG2_BRICK};

use crate::device::Gpu;
use crate::error::GpuError;
use crate::shader;
use crate::upload::{storage_entry, texture_entry};

/// The formats, in the order of their tags.
pub(crate) const FORMATS: [BlockFormat; 3] = [BlockFormat::Bc4, BlockFormat::Bc3, BlockFormat::Bc7];

/// What a device must have for such textures.
pub(crate) const NEEDED: wgpu::Features =
    wgpu::Features::TEXTURE_COMPRESSION_BC.union(wgpu::Features::TEXTURE_COMPRESSION_BC_SLICED_3D);

/// The place of a format among [`FORMATS`].
pub(crate) fn number_of(format: BlockFormat) -> usize {
    match format {
        BlockFormat::Bc4 => 0,
        BlockFormat::Bc3 => 1,
        BlockFormat::Bc7 => 2,
    }
}

/// The words of a brick's blocks.
pub(crate) fn brick_words(format: BlockFormat) -> usize {
    format.brick_bytes() / size_of::<u32>()
}

/// A texture of bricks of one format.
#[derive(Debug)]
pub(crate) struct Blocks {
    format: BlockFormat,
    texture: wgpu::Texture,
    log2_side: u32,
}

impl Blocks {
    /// A texture that has room for so many bricks, and for one at least.
    ///
    /// # Errors
    /// If they are more than the device takes, or it fails.
    pub(crate) fn new(gpu: &Gpu, format: BlockFormat, bricks: usize) -> Result<Blocks, GpuError> {
        let (log2_side, layers) = Blocks::layout(gpu, format, bricks)?;
        let side = 1 << (log2_side + LOG2_BRICK);
        let descriptor = wgpu::TextureDescriptor {
            label: Some("nuage blocks"),
            size: wgpu::Extent3d {
                width: side,
                height: side,
                depth_or_array_layers: (layers * format.slices()) as u32,
            },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format: match format {
                BlockFormat::Bc4 => wgpu::TextureFormat::Bc4RUnorm,
                BlockFormat::Bc3 => wgpu::TextureFormat::Bc3RgbaUnorm,
                BlockFormat::Bc7 => wgpu::TextureFormat::Bc7RgbaUnorm,
            },
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        };
        let texture = gpu.guarded(|| gpu.device().create_texture(&descriptor))?;
        Ok(Blocks { format, texture, log2_side })
    }

    /// log2 of the bricks along the sides of a layer, and how many layers there are.
    fn layout(gpu: &Gpu, format: BlockFormat, bricks: usize) -> Result<(u32, usize), GpuError> {
        let bricks = bricks.max(1);
        let limit = gpu.device().limits().max_texture_dimension_3d;
        let (most_layers, most_log2) = (limit as usize / format.slices(), limit.ilog2() - LOG2_BRICK);
        let fits = |log2_side: &u32| bricks.div_ceil(1 << (2 * log2_side)) <= most_layers;
        let log2_side = (0..=most_log2).find(fits).ok_or_else(|| GpuError::Limit {
            what: "a texture of bricks",
            size_bytes: (bricks * format.brick_bytes()) as u64,
            limit_bytes: ((most_layers << (2 * most_log2)) * format.brick_bytes()) as u64,
        })?;
        Ok((log2_side, bricks.div_ceil(1 << (2 * log2_side))))
    }

    /// The memory of a texture of so many bricks.
    ///
    /// # Errors
    /// If they are more than the device takes.
    pub(crate) fn size_bytes(gpu: &Gpu, format: BlockFormat, bricks: usize) -> Result<u64, GpuError> {
        let (log2_side, layers) = Blocks::layout(gpu, format, bricks)?;
        Ok(((layers << (2 * log2_side)) * format.brick_bytes()) as u64)
    }

    /// Copies bricks to the texture, from the first one on: the words of one after the other.
    ///
    /// # Errors
    /// If the device fails.
    pub(crate) fn write(&self, gpu: &Gpu, words: &[u32]) -> Result<(), GpuError> {
        let Blocks { format, log2_side, .. } = *self;
        let (slices, block_bytes) = (format.slices(), format.block_bytes());
        let side = 1_usize << log2_side;
        let row_bytes = 2 * side * block_bytes;
        let layer_bytes = side * side * format.brick_bytes();
        let bytes: &[u8] = bytemuck::cast_slice(words);
        for (layer, bytes) in (0..).zip(bytes.chunks(layer_bytes)) {
            // Rows of bricks that are not there are not sent.
            let rows = bytes.len().div_ceil(side * format.brick_bytes());
            let mut laid_out = vec![0; slices * 2 * rows * row_bytes];
            for (brick, blocks) in bytes.chunks_exact(format.brick_bytes()).enumerate() {
                let (x, y) = (brick & (side - 1), brick >> log2_side);
                for (i, pair) in blocks.chunks_exact(2 * block_bytes).enumerate() {
                    let (slice, row) = (i >> 1, i & 1);
                    let at = ((slice * rows + y) * 2 + row) * row_bytes + x * 2 * block_bytes;
                    laid_out[at..at + pair.len()].copy_from_slice(pair);
                }
            }
            let origin = wgpu::Origin3d { x: 0, y: 0, z: layer * slices as u32 };
            let to = wgpu::TexelCopyTextureInfo { origin, ..self.texture.as_image_copy() };
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row_bytes as u32),
                rows_per_image: Some(2 * rows as u32),
            };
            let size = wgpu::Extent3d {
                width: (side << LOG2_BRICK) as u32,
                height: (rows << LOG2_BRICK) as u32,
                depth_or_array_layers: slices as u32,
            };
            gpu.guarded(|| gpu.queue().write_texture(to, &laid_out, layout, size))?;
        }
        Ok(())
    }

    /// All of it, to be bound.
    pub(crate) fn view(&self) -> wgpu::TextureView {
        self.texture.create_view(&wgpu::TextureViewDescriptor::default())
    }
}

/// Whether compute shaders of a device read textures of blocks, and read what is in them: SwiftShader gives them what it has
/// not decoded yet.
///
/// # Errors
/// If the device fails.
pub(crate) fn are_read(gpu: &Gpu) -> Result<bool, GpuError> {
    if !gpu.device().features().contains(NEEDED) {
        return Ok(false);
    }
    // A brick of blocks of BC7's seventh mode, which every texel has its own weight in.
    let format = BlockFormat::Bc7;
    let random = |i: u32| nuage_render::hash::hash_u32(i) & 0xffff_ff00 | 1 << 6;
    let words: Vec<u32> = (0..brick_words(format) as u32).map(random).collect();
    let blocks = Blocks::new(gpu, format, 1)?;
    blocks.write(gpu, &words)?;
    let stage = wgpu::ShaderStages::COMPUTE;
    let entries = [texture_entry(0), storage_entry(1, false, stage)];
    let texels = BRICK_VOXELS / format.channels();
    let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
    let found = gpu.empty_buffer("nuage probe", (texels * size_of::<[f32; 4]>()) as u64, usage)?;
    gpu.guarded(|| {
        let device = gpu.device();
        let label = Some("nuage probe");
        let layout =
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label, entries: &entries });
        let view = blocks.view();
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label,
            layout: &layout,
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) },
                wgpu::BindGroupEntry { binding: 1, resource: found.as_entire_binding() },
            ],
        });
        let source = wgpu::ShaderSource::Wgsl(shader::probe().into());
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor { label, source });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label,
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label,
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some("probe"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label });
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label, timestamp_writes: None });
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(1, 1, format.slices() as u32);
        drop(pass);
        gpu.queue().submit([encoder.finish()]);
    })?;
    let found: Vec<f32> = bytemuck::pod_collect_to_vec(&gpu.read(&found)?);
    let mut expected = [0.0; BRICK_VOXELS];
    let axis = PackingAxis::Z;
    if decode_brick(format, axis, bytemuck::cast_slice(&words), &mut expected).is_none() {
        return Ok(false);
    }
    let [along_u, along_v, along_packing] = axis.strides();
    Ok((0..).zip(&found).all(|(i, found)| {
        let (texel, channel) = (i / 4, i % 4);
        let (u, v, slice) = (texel & 7, texel >> 3 & 7, texel >> 6);
        let voxel = u * along_u + v * along_v + (4 * slice + channel) * along_packing;
        (found - expected[voxel]).abs() < 0.5 / 255.0
    }))
}
