//! A picture of the sky as a texture: what `nuage_render::envmap` knows of it, to be read texel by texel.
//!
//! Texels hold radiance and, in the fourth component, where their share of their row ends. In the rows behind the picture, one
//! texel after the other says where each row's share of the whole ends, and the solid angle of the row's texels.

use nuage_render::envmap::EnvironmentMap;

use crate::device::Gpu;
use crate::error::GpuError;

/// Copies a picture of the sky to a device.
///
/// # Errors
/// If it is larger than the device takes, or that fails.
pub(crate) fn sky_texture(gpu: &Gpu, map: &EnvironmentMap) -> Result<wgpu::TextureView, GpuError> {
    let parts = map.parts();
    let size = [parts.width, parts.height + parts.height.div_ceil(parts.width)];
    // Shares are counted in as many parts as single precision counts exactly.
    let texel = |(rgb, end): (&[f32; 3], &u32)| [rgb[0], rgb[1], rgb[2], *end as f32];
    let row = |(end, solid_angle): (&u32, &f32)| [*end as f32, *solid_angle, 0.0, 0.0];
    let texels = parts.texels.iter().zip(parts.column_ends).map(texel);
    let mut texels: Vec<[f32; 4]> =
        texels.chain(parts.row_ends.iter().zip(parts.solid_angles).map(row)).collect();
    texels.resize(size[0] as usize * size[1] as usize, [0.0; 4]);
    texture(gpu, size, &texels)
}

/// What is bound where there is no picture of the sky.
///
/// # Errors
/// If the device fails.
pub(crate) fn bare_sky(gpu: &Gpu) -> Result<wgpu::TextureView, GpuError> {
    texture(gpu, [1, 1], &[[0.0; 4]])
}

fn texture(gpu: &Gpu, [width, height]: [u32; 2], texels: &[[f32; 4]]) -> Result<wgpu::TextureView, GpuError> {
    let most = gpu.device().limits().max_texture_dimension_2d;
    if width.max(height) > most {
        let bytes = |side: u32| 16 * u64::from(side).pow(2);
        let (size_bytes, limit_bytes) = (bytes(width.max(height)), bytes(most));
        return Err(GpuError::Limit { what: "a sky that is a picture", size_bytes, limit_bytes });
    }
    let size = wgpu::Extent3d { width, height, depth_or_array_layers: 1 };
    gpu.guarded(|| {
        let texture = gpu.device().create_texture(&wgpu::TextureDescriptor {
            label: Some("nuage sky"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rgba32Float,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        let layout =
            wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(16 * width), rows_per_image: None };
        gpu.queue().write_texture(texture.as_image_copy(), bytemuck::cast_slice(texels), layout, size);
        texture.create_view(&wgpu::TextureViewDescriptor::default())
    })
}
