//! The JSON that stands beside a texture file: all that an engine needs and the file cannot say. `docs/texture.md`
//! describes it.

use nuage_volume::format::Role;
use serde::Serialize;

use super::build::{BrickScale, BrickTexture, FrameTable, channel_name};

/// The version of the sidecar: another one means that a member changed its meaning.
pub const VERSION: u32 = 1;

#[derive(Serialize)]
struct Sidecar<'a> {
    kind: &'static str,
    version: u32,
    texture: &'a str,
    format: &'static str,
    size: [u32; 3],
    channels: u32,
    brick_size: [u32; 3],
    bricks_per_axis: [u32; 3],
    brick_count: usize,
    channel: Channel<'a>,
    common_scale: Option<BrickScale>,
    brick_scales: &'a [BrickScale],
    frame_rate: Option<f64>,
    frames: &'a [FrameTable],
}

#[derive(Serialize)]
struct Channel<'a> {
    name: String,
    role: Role,
    physical_unit: &'a str,
    floor: f32,
    peak: f32,
}

/// The JSON for a texture that stands in a file of this name.
///
/// # Errors
/// None that a texture gives cause to.
pub fn to_json(texture: &BrickTexture, file_name: &str) -> serde_json::Result<Vec<u8>> {
    let (layout, channel) = (&texture.layout, &texture.channel);
    let format = layout.format();
    let sidecar = Sidecar {
        kind: "nuage brick texture",
        version: VERSION,
        texture: file_name,
        format: format.name(),
        size: layout.size(),
        channels: format.channels(),
        brick_size: format.brick_texels(),
        bricks_per_axis: layout.bricks(),
        brick_count: texture.bricks.len(),
        channel: Channel {
            name: channel_name(channel),
            role: channel.role,
            physical_unit: &channel.physical_unit,
            floor: channel.floor,
            peak: channel.peak,
        },
        common_scale: texture.common_scale,
        brick_scales: if texture.common_scale.is_some() { &[] } else { &texture.bricks },
        frame_rate: texture.frame_rate,
        frames: &texture.frames,
    };
    serde_json::to_vec(&sidecar)
}
