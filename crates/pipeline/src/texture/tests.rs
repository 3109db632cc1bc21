//! Textures held against the volume that they were made from, through readers and decoders of others.

use std::io::Cursor;

use nuage_vdb::{Grid, Metadata, Shape, Transform, Tree, TreeBuilder};
use nuage_volume::codec::Codec;
use nuage_volume::format::Asset;
use nuage_volume::packed::Content;
use nuage_volume::space::BRICK_VOXELS;
use proptest::prelude::*;

use super::build::{BrickTexture, Options, TextureError, build, channel_name, find_channel};
use super::layout::TextureFormat;
use super::{Container, dds, ktx2, sidecar};
use crate::pack::frame;
use crate::pack::sequence::{FrameName, pack};

/// Leaves of smooth values at some bricks, zero at some voxels unless there is a background; a tile of 128³.
fn tree(bricks: &[[i32; 3]], seed: f32, background: f32) -> Tree<f32> {
    let mut builder = TreeBuilder::new(background, Shape::STANDARD);
    for (n, brick) in bricks.iter().enumerate() {
        let values: Vec<f32> = (0..BRICK_VOXELS)
            .map(|i| {
                let [x, y, z] = [i >> 6, i >> 3 & 7, i & 7].map(|i| i as f32);
                let wave = (0.3 * x + 0.2 * y + 0.4 * z + seed + n as f32).sin();
                if background == 0.0 { (30.0 * wave).max(0.0) } else { wave }
            })
            .collect();
        builder.leaf(brick.map(|i| i * 8), &[u64::MAX; 8], &values);
    }
    builder.tile(2, [256, 128, -128], 3.5, true);
    builder.tile(1, [512, 256, -256], 7.25, true);
    builder.build().unwrap()
}

fn asset(frames: &[Vec<Grid>], codec: Option<Codec>) -> Asset {
    let names: Vec<FrameName> =
        (0..frames.len()).map(|i| FrameName { number: Some(i as i64 * 2), name: format!("f{i}") }).collect();
    let default = frame::Options::default();
    let psnr = match codec {
        None => default.psnr,
        // More than codes of 8 bits reach, which would do otherwise.
        Some(Codec::F16) => Some(65.0),
        Some(_) => None,
    };
    let options = frame::Options { codec, psnr, ..default };
    let mut bytes = Cursor::new(Vec::new());
    let load = |frame: usize| Ok::<_, ()>((frames[frame].clone(), Metadata::default()));
    pack(&names, load, &mut bytes, &options, Some(24.0), &mut |_| {}).unwrap();
    let mut asset = Asset::open(bytes.into_inner()).unwrap();
    asset.load_all().unwrap();
    asset
}

fn grid(name: &str, tree: Tree<f32>) -> Grid {
    Grid::new(name, Transform::identity(), tree)
}

/// Two frames that have the first bricks in common.
fn two_frames(bricks: &[[i32; 3]], background: f32, codec: Option<Codec>) -> Asset {
    let frames = [bricks.len(), bricks.len().div_ceil(2)]
        .map(|count| vec![grid("density", tree(&bricks[..count], 1.0, background))]);
    asset(&frames, codec)
}

fn options(format: TextureFormat, common_scale: bool) -> Options {
    Options { format, channel: 0, frames: vec![0, 1], common_scale, max_bytes: 1 << 30 }
}

/// The channels of a texel, by a decoder of others.
fn texel(texture: &BrickTexture, at: [u32; 3]) -> [f32; 4] {
    let format = texture.layout.format();
    let from = texture.layout.byte_offset(at) as usize;
    let block = &texture.bytes[from..from + format.block_bytes() as usize];
    let in_block = (at[1] % 4 * 4 + at[0] % 4) as usize;
    let mut bytes = [0_u8; 64];
    let mut floats = [0.0_f32; 16];
    match format {
        TextureFormat::R8 => return [f32::from(block[0]) / 255.0, 0.0, 0.0, 0.0],
        TextureFormat::R16F => {
            return [half::f16::from_le_bytes([block[0], block[1]]).to_f32(), 0.0, 0.0, 0.0];
        }
        TextureFormat::Bc4 => {
            bcdec_rs::bc4_float(block, &mut floats, 4, false);
            return [floats[in_block], 0.0, 0.0, 0.0];
        }
        TextureFormat::Bc3 => bcdec_rs::bc3(block, &mut bytes, 16),
        TextureFormat::Bc7 => bcdec_rs::bc7(block, &mut bytes, 16),
    }
    std::array::from_fn(|channel| f32::from(bytes[in_block * 4 + channel]) / 255.0)
}

/// The values of a brick, as an engine would find them by `docs/texture.md`.
fn brick_of(texture: &BrickTexture, number: u32) -> [f32; BRICK_VOXELS] {
    let scale = texture.bricks[number as usize];
    std::array::from_fn(|i| {
        let i = i as u32;
        let (at, channel) = texture.layout.texel(number, [i >> 6, i >> 3 & 7, i & 7]);
        let value = scale.bias + scale.scale * texel(texture, at)[channel as usize];
        value.max(texture.channel.floor)
    })
}

fn source_of(asset: &Asset, brick: [i32; 3], frame: usize) -> Option<(Codec, [f32; BRICK_VOXELS])> {
    let tree = asset.contents().frames[frame].grids[0].levels[0];
    match asset.trees().find(tree, brick.into()).0 {
        Content::Brick { codec, offset } => {
            let mut values = [0.0; BRICK_VOXELS];
            asset.decode(0, codec, offset, &mut values).unwrap();
            Some((codec, values))
        }
        _ => None,
    }
}

fn places() -> impl Strategy<Value = Vec<[i32; 3]>> {
    let place = proptest::array::uniform3(-30_i32..14);
    proptest::collection::btree_set(place, 1..12).prop_map(|places| places.into_iter().collect())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn textures_hold_what_the_volume_holds(
        places in places(), is_stored_so in any::<bool>(), is_common in any::<bool>(), has_negative in any::<bool>(),
    ) {
        for format in TextureFormat::ALL {
            let background = if has_negative { 0.5 } else { 0.0 };
            let asset = two_frames(&places, background, is_stored_so.then(|| format.codec()));
            let texture = build(&asset, &options(format, is_common)).unwrap();
            prop_assert_eq!(texture.bytes.len() as u64, texture.layout.size_bytes());
            prop_assert_eq!(texture.common_scale.is_some(), is_common);
            let mut copied = 0;
            let range = if has_negative { 9.0 } else { 30.0 };
            for (i, frame) in texture.frames.iter().enumerate() {
                for placed in &frame.bricks {
                    let Some((codec, expected)) = source_of(&asset, placed.brick, i) else {
                        return Err(TestCaseError::fail("a brick that the tree does not have"));
                    };
                    let is_copied = codec == format.codec() && !is_common;
                    let tolerance = match format {
                        // Decoders of others round to 8 bits.
                        TextureFormat::Bc3 | TextureFormat::Bc7 if is_copied => range * 1.01 / 255.0,
                        _ if is_copied => 1e-5 * range,
                        TextureFormat::R16F => range / 2048.0,
                        TextureFormat::R8 => range / 255.0,
                        // Smooth, but cut off at 0: a few voxels are far off, most are not.
                        _ => 0.6 * range,
                    };
                    copied += usize::from(is_copied);
                    let found = brick_of(&texture, placed.number);
                    let squares: f32 = found.iter().zip(&expected).map(|(a, b)| (a - b).powi(2)).sum();
                    let deviation = (squares / BRICK_VOXELS as f32).sqrt();
                    prop_assert!(deviation < 0.08 * range, "{:?}: {}", format, deviation);
                    for (found, expected) in found.iter().zip(&expected) {
                        prop_assert!(
                            (found - expected).abs() <= tolerance,
                            "{:?}: {} {}",
                            format,
                            found,
                            expected
                        );
                    }
                }
            }
            // The packer takes blocks only where empty voxels stay empty, and halves where 8 bits do not do.
            let is_sure = is_stored_so && has_negative != (format == TextureFormat::R16F);
            prop_assert!(copied > 0 || is_common || !is_sure, "{:?}: none was copied", format);
        }
    }

    #[test]
    fn lists_say_what_the_trees_say(places in places(), has_background in any::<bool>()) {
        let background = if has_background { 0.5 } else { 0.0 };
        // Kept exactly, so that what is equal in both frames stays so.
        let asset = two_frames(&places, background, Some(Codec::F32));
        let texture = build(&asset, &options(TextureFormat::R8, false)).unwrap();
        let mut numbers = std::collections::HashSet::new();
        for (i, frame) in texture.frames.iter().enumerate() {
            let grid = &asset.contents().frames[i].grids[0];
            prop_assert_eq!(frame.number, Some(2 * i as i64));
            prop_assert_eq!(frame.index_offset, grid.index_offset);
            prop_assert_eq!(frame.background, background);
            numbers.extend(frame.bricks.iter().map(|placed| placed.number));
            let offset = glam::IVec3::from_array(grid.index_offset) >> 3;
            let sources = places.iter().map(|place| glam::IVec3::from_array(*place));
            let tiles = [[32, 16, -16], [40, 20, -10], [64, 32, -32], [80, 40, -20], [500, 0, 0], [0, 0, 500]];
            for source in sources.chain(tiles.map(glam::IVec3::from_array)) {
                let at = source - offset;
                let (content, _) = asset.trees().find(grid.levels[0], at);
                let brick = frame.bricks.iter().find(|placed| placed.brick == at.to_array());
                prop_assert_eq!(brick.is_some(), matches!(content, Content::Brick { .. }));
                let covers = |brick: [i32; 3], extent: u32| {
                    (0..3).all(|axis| (0..extent as i32).contains(&(at[axis] - brick[axis])))
                };
                let constants: Vec<f32> = frame.constants.iter()
                    .filter(|constant| covers(constant.brick, constant.extent))
                    .map(|constant| constant.value).collect();
                match content {
                    Content::Constant(value) if value != background => prop_assert_eq!(constants, [value]),
                    _ => prop_assert!(constants.is_empty()),
                }
            }
        }
        // Bricks that frames have in common stand there once, and none stands there unused.
        prop_assert_eq!(numbers.len(), texture.bricks.len());
        prop_assert!(texture.bricks.len() <= places.len());
    }

    #[test]
    fn readers_of_others_find_the_texels(places in places()) {
        let asset = two_frames(&places, 0.0, None);
        for format in TextureFormat::ALL {
            let texture = build(&asset, &options(format, false)).unwrap();
            let [width, height, depth] = texture.layout.size();
            let file = Container::Dds.file(texture.clone());
            prop_assert_eq!(file.len(), dds::HEADER_BYTES + texture.bytes.len());
            let read = ddsfile::Dds::read(file.as_slice()).unwrap();
            let extension = read.header10.as_ref().unwrap();
            prop_assert_eq!(extension.dxgi_format as u32, dds::dxgi_format(format));
            prop_assert_eq!(extension.resource_dimension, ddsfile::D3D10ResourceDimension::Texture3D);
            prop_assert_eq!([read.get_width(), read.get_height(), read.get_depth()], [width, height, depth]);
            prop_assert_eq!(read.get_num_mipmap_levels(), 1);
            prop_assert_eq!(read.get_data(0).unwrap(), texture.bytes.as_slice());

            let file = Container::Ktx2.file(texture.clone());
            let read = ::ktx2::Reader::new(file.as_slice()).unwrap();
            let header = read.header();
            prop_assert_eq!(header.format.map(|format| format.value()), Some(ktx2::vk_format(format)));
            prop_assert_eq!([header.pixel_width, header.pixel_height, header.pixel_depth], [width, height, depth]);
            prop_assert_eq!([header.layer_count, header.face_count, header.level_count], [0, 1, 1]);
            prop_assert!(header.supercompression_scheme.is_none());
            let level = read.levels().next().unwrap();
            prop_assert_eq!(level.data, texture.bytes.as_slice());
            let at = level.data.as_ptr() as usize - file.as_ptr() as usize;
            prop_assert_eq!(at % format.block_bytes().max(4) as usize, 0);
            // The descriptor is what the other library would write, but for primaries, which voxels have none of.
            let (mut expected, type_size) = ::ktx2::dfd::Basic::from_format(header.format.unwrap()).unwrap();
            expected.color_primaries = None;
            prop_assert_eq!(read.basic_dfd(), Some(&expected));
            prop_assert_eq!(header.type_size, type_size);
            prop_assert_eq!(read.writer(), Some(concat!("nuage ", env!("CARGO_PKG_VERSION"), "\0")));
        }
    }
}

#[test]
fn the_sidecar_says_it_all() {
    let asset = two_frames(&[[0, 0, 0], [5, 3, 1], [-20, 0, 4]], 0.0, None);
    for is_common in [false, true] {
        let texture = build(&asset, &options(TextureFormat::Bc7, is_common)).unwrap();
        let json: serde_json::Value =
            serde_json::from_slice(&sidecar::to_json(&texture, "a.dds").unwrap()).unwrap();
        assert_eq!(json["texture"], "a.dds");
        assert_eq!(json["format"], "bc7");
        assert_eq!(json["size"], serde_json::json!(texture.layout.size()));
        assert_eq!(json["brick_size"], serde_json::json!([8, 8, 2]));
        assert_eq!(json["channel"]["name"], "density");
        assert_eq!(json["channel"]["floor"], 0.0);
        assert_eq!(json["brick_count"], 3);
        assert_eq!(json["brick_scales"].as_array().unwrap().len(), if is_common { 0 } else { 3 });
        assert_eq!(json["common_scale"].is_null(), !is_common);
        let frames = json["frames"].as_array().unwrap();
        assert_eq!(frames.len(), 2);
        assert_eq!(frames[0]["bricks"].as_array().unwrap().len(), 3);
        let first = texture.frames[0].bricks[0];
        let [x, y, z] = first.brick;
        assert_eq!(frames[0]["bricks"][0], serde_json::json!([x, y, z, first.number]));
        assert_eq!(frames[0]["constants"].as_array().unwrap().len(), texture.frames[0].constants.len());
        assert_eq!(frames[0]["world_from_index"].as_array().unwrap().len(), 12);
    }
}

#[test]
fn channels_are_found_by_name_or_by_role() {
    let at = [[0, 0, 0]];
    let grids = ["heat", "density"].map(|name| grid(name, tree(&at, 1.0, 0.0)));
    let asset = asset(&[grids.to_vec()], None);
    let contents = asset.contents();
    let name = |found: usize| channel_name(&contents.channels[found]);
    assert_eq!(find_channel(contents, None).map(name).unwrap(), "density");
    assert_eq!(find_channel(contents, Some("heat")).map(name).unwrap(), "heat");
    let error = find_channel(contents, Some("fog")).unwrap_err().to_string();
    assert!(error.contains("'fog'") && error.contains("heat") && error.contains("density"), "{error}");
}

#[test]
fn what_cannot_be_is_an_error() {
    let asset = two_frames(&[[0, 0, 0], [1, 0, 0]], 0.0, None);
    let good = options(TextureFormat::Bc4, false);
    let no_frame = Options { frames: vec![2], ..good.clone() };
    assert!(matches!(build(&asset, &no_frame), Err(TextureError::NoFrame(2))));
    let no_channel = Options { channel: 1, ..good.clone() };
    assert!(matches!(build(&asset, &no_channel), Err(TextureError::Channel(_))));
    let too_large = Options { max_bytes: 300, ..good.clone() };
    assert!(matches!(build(&asset, &too_large), Err(TextureError::TooLarge { .. })));
    // Nothing at all is a texture of one empty brick.
    let nothing = Options { frames: Vec::new(), ..good };
    assert_eq!(build(&asset, &nothing).unwrap().bytes, [0; 256]);
}
