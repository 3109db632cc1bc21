//! OpenEXR: the picture as it was computed, scene-linear and premultiplied, for compositing and for
//! measuring.
//!
//! One part, ZIP-compressed scan lines, channels R, G, B, A. No chromaticities are written: without them a
//! reader assumes Rec.709, which is what ours are.

use super::{OutputError, check};
use crate::film::Image;
use exr::prelude::{Encoding, IntoSample, LayerAttributes, SpecificChannels, Vec2, WritableImage, f16};
use std::io::Cursor;

/// How many bits a component keeps in the file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ExrPrecision {
    /// 16 bits: 11 bits of precision, up to 65504. What lies beyond, infinity included, becomes ±65504.
    #[default]
    Half,
    /// 32 bits: exact.
    Float,
}

/// A picture as an OpenEXR file.
pub fn encode_exr(image: &Image, precision: ExrPrecision) -> Result<Vec<u8>, OutputError> {
    check(image)?;
    match precision {
        ExrPrecision::Half => encode(image, to_half),
        ExrPrecision::Float => encode(image, |value| value),
    }
}

/// The nearest half float; the largest finite one for what is beyond it; NaN for NaN.
pub(super) fn to_half(value: f32) -> f16 {
    f16::from_f32(value.clamp(f16::MIN.to_f32(), f16::MAX.to_f32()))
}

fn encode<S: IntoSample>(image: &Image, sample: impl Fn(f32) -> S + Sync) -> Result<Vec<u8>, OutputError> {
    let size = Vec2(image.width as usize, image.height as usize);
    let channels = SpecificChannels::rgba(|at: Vec2<usize>| {
        let [r, g, b, a] = image.pixels.get(at.y() * size.x() + at.x()).copied().unwrap_or_default();
        (sample(r), sample(g), sample(b), sample(a))
    });
    let layer =
        exr::prelude::Layer::new(size, LayerAttributes::default(), Encoding::SMALL_LOSSLESS, channels);
    let picture = exr::prelude::Image::from_layer(layer);
    let writer = picture.write();
    let writer = if cfg!(feature = "parallel") { writer } else { writer.non_parallel() };
    let mut file = Cursor::new(Vec::new());
    let written = writer.to_buffered(&mut file);
    written.map_err(|error| OutputError::Encode { format: "OpenEXR", reason: error.to_string() })?;
    Ok(file.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_pixel, unit_f32};
    use exr::prelude::*;

    fn noise(width: u32, height: u32) -> Image {
        let value = |i: u32, channel| (unit_f32(hash_pixel(i, 0, 0, channel)) * 20.0 - 10.0).exp2();
        let pixel = |i| [value(i, 0), value(i, 1), -value(i, 2), unit_f32(hash_pixel(i, 0, 0, 3))];
        Image { width, height, pixels: (0..width * height).map(pixel).collect() }
    }

    /// Pixels by an `exr` reader, and the type in which the file holds red.
    fn decode(file: &[u8]) -> (Image, SampleType) {
        let picture = read()
            .no_deep_data()
            .largest_resolution_level()
            .rgba_channels(
                |size, _| Image {
                    width: size.x() as u32,
                    height: size.y() as u32,
                    pixels: vec![[0.0; 4]; size.area()],
                },
                |image, at, (r, g, b, a): (f32, f32, f32, f32)| {
                    image.pixels[at.y() * image.width as usize + at.x()] = [r, g, b, a];
                },
            )
            .first_valid_layer()
            .all_attributes()
            .from_buffered(Cursor::new(file))
            .unwrap();
        let layer = picture.layer_data;
        assert_eq!(layer.encoding.compression, Compression::ZIP16);
        assert_eq!(layer.encoding.blocks, Blocks::ScanLines);
        (layer.channel_data.pixels, layer.channel_data.channels.0.sample_type)
    }

    type Image = crate::film::Image;

    #[test]
    fn float_files_are_exact() {
        for (width, height) in [(1, 1), (33, 70), (200, 17)] {
            let mut image = noise(width, height);
            image.pixels[0] = [f32::INFINITY, f32::MAX, f32::MIN_POSITIVE, 1.0];
            let (back, kind) = decode(&encode_exr(&image, ExrPrecision::Float).unwrap());
            assert_eq!((back, kind), (image, SampleType::F32));
        }
    }

    #[test]
    fn half_files_are_rounded_and_clamped() {
        let mut image = noise(40, 50);
        image.pixels[7] = [f32::INFINITY, f32::NEG_INFINITY, 1e9, 65_519.0];
        let (back, kind) = decode(&encode_exr(&image, ExrPrecision::Half).unwrap());
        assert_eq!(kind, SampleType::F16);
        assert_eq!(back.pixels[7], [65_504.0, -65_504.0, 65_504.0, 65_504.0]);
        for (value, got) in image.pixels.iter().flatten().zip(back.pixels.iter().flatten()) {
            if value.abs() < 65_504.0 {
                assert_eq!(f16::from_f32(*value).to_f32(), *got);
                assert!((value - got).abs() <= value.abs() / 2048.0 + 3e-8);
            }
        }
        image.pixels[0] = [f32::NAN; 4];
        let (back, _) = decode(&encode_exr(&image, ExrPrecision::Half).unwrap());
        assert!(back.pixels[0].iter().all(|v| v.is_nan()));
    }

    #[test]
    fn same_picture_same_bytes() {
        let image = noise(300, 200);
        let first = encode_exr(&image, ExrPrecision::Half).unwrap();
        for _ in 0..5 {
            assert_eq!(encode_exr(&image, ExrPrecision::Half).unwrap(), first);
        }
    }

    #[test]
    fn bad_pictures_are_refused() {
        for (width, height) in [(0, 3), (3, 0), (u32::MAX, 2)] {
            let image = Image { width, height, pixels: Vec::new() };
            assert!(matches!(encode_exr(&image, ExrPrecision::Half), Err(OutputError::Size(_))));
        }
        let short = Image { width: 2, height: 2, pixels: vec![[0.0; 4]; 5] };
        assert!(matches!(encode_exr(&short, ExrPrecision::Float), Err(OutputError::Misuse(_))));
    }
}
