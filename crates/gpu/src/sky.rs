//! A picture of the sky as a texture: what `nuage_render::envmap` knows of it, to be read texel by texel.
//!
//! Texels hold radiance and, in the fourth component, where their share of their row ends. In the rows behind the picture, one
//! texel after the other says where each row's share of the whole ends, and the solid angle of the row's texels.

use nuage_render::envmap::EnvironmentMap;

use crate::device::Gpu;
use crate::error::GpuError;

/// What binds the picture of a sky.
///
/// # Errors
/// If the device fails.
pub(crate) fn sky_layout(gpu: &Gpu) -> Result<wgpu::BindGroupLayout, GpuError> {
    let entry = wgpu::BindGroupLayoutEntry {
        binding: 0,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Float { filterable: false },
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        },
        count: None,
    };
    let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("nuage sky"), entries: &[entry] };
    gpu.guarded(|| gpu.device().create_bind_group_layout(&descriptor))
}

/// Copies a picture of the sky to a device, and binds it.
///
/// # Errors
/// If it is larger than the device takes, or that fails.
pub(crate) fn sky_group(
    gpu: &Gpu,
    layout: &wgpu::BindGroupLayout,
    map: &EnvironmentMap,
) -> Result<wgpu::BindGroup, GpuError> {
    let parts = map.parts();
    let [width, height] = [parts.width, parts.height + parts.height.div_ceil(parts.width)];
    // Shares are counted in as many parts as single precision counts exactly.
    let texel = |(rgb, end): (&[f32; 3], &u32)| [rgb[0], rgb[1], rgb[2], *end as f32];
    let row = |(end, solid_angle): (&u32, &f32)| [*end as f32, *solid_angle, 0.0, 0.0];
    let texels = parts.texels.iter().zip(parts.column_ends).map(texel);
    let mut texels: Vec<[f32; 4]> =
        texels.chain(parts.row_ends.iter().zip(parts.solid_angles).map(row)).collect();
    texels.resize(width as usize * height as usize, [0.0; 4]);

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
        let rows =
            wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(16 * width), rows_per_image: None };
        gpu.queue().write_texture(texture.as_image_copy(), bytemuck::cast_slice(&texels), rows, size);
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let resource = wgpu::BindingResource::TextureView(&view);
        let entries = [wgpu::BindGroupEntry { binding: 0, resource }];
        let descriptor = wgpu::BindGroupDescriptor { label: Some("nuage sky"), layout, entries: &entries };
        gpu.device().create_bind_group(&descriptor)
    })
}
