//! PNG and animated PNG: eight bits, sRGB, alpha not premultiplied (PNG knows no other), for screens and web
//! pages.
//!
//! Light is clamped to what the format can show, never tone mapped. Light without coverage (a flame in front
//! of nothing) can't be expressed with such alpha: put the picture over a background first
//! ([`Image::over`](crate::film::Image::over)).

use super::{OutputError, check};
use crate::{color::linear_to_srgb8, film::Image};
use png::{BitDepth, ColorType, DeflateCompression, Encoder, Filter, SrgbRenderingIntent};

/// The effort of compression, 1 to 9. On rendered pictures of 1024 x 1024 this takes two thirds of the time of the
/// usual 6 for files 2 to 4 % larger; level 1 and the encoders without a level make them 10 to 50 % larger.
const EFFORT: DeflateCompression = DeflateCompression::Level(2);

/// A picture as a PNG file: RGBA, whether or not anything shines through, so that all pictures of a sequence are
/// of one kind. NaN becomes 0.
pub fn encode_png(image: &Image) -> Result<Vec<u8>, OutputError> {
    check(image)?;
    encode(image, true)
}

/// As [`encode_png`], but RGB if the picture is opaque everywhere: smaller, for pictures that stand alone.
pub fn encode_png_compact(image: &Image) -> Result<Vec<u8>, OutputError> {
    check(image)?;
    encode(image, !is_opaque(image))
}

fn encode(image: &Image, with_alpha: bool) -> Result<Vec<u8>, OutputError> {
    let mut file = Vec::new();
    let mut writer = encoder(&mut file, image, with_alpha).write_header().map_err(refused)?;
    writer.write_image_data(&image_bytes(image, with_alpha)).map_err(refused)?;
    writer.finish().map_err(refused)?;
    Ok(file)
}

/// Pictures of one size as an animated PNG that loops forever: RGBA, or RGB if all are opaque everywhere.
/// Each frame after the first stores only the rectangle in which it differs from the one before.
///
/// `frames_per_second` is kept to better than 0.1 % between 0.001 and 65535, rates such as 24000/1001
/// included. Fails without frames, on frames of different sizes, and on other rates.
pub fn encode_apng(frames: &[Image], frames_per_second: f64) -> Result<Vec<u8>, OutputError> {
    let (delay_numerator, delay_denominator) = frame_delay(frames_per_second)?;
    let [first, ..] = frames else {
        return Err(OutputError::Misuse("an animation needs at least one frame".to_owned()));
    };
    for frame in frames {
        check(frame)?;
        if (frame.width, frame.height) != (first.width, first.height) {
            let sizes = (first.width, first.height, frame.width, frame.height);
            return Err(OutputError::Misuse(format!("frames of one animation differ in size: {sizes:?}")));
        }
    }
    let count = u32::try_from(frames.len())
        .map_err(|_| OutputError::Misuse("an animation holds at most 4294967295 frames".to_owned()))?;

    let with_alpha = !frames.iter().all(is_opaque);
    let mut file = Vec::new();
    let mut encoder = encoder(&mut file, first, with_alpha);
    encoder.set_animated(count, 0).map_err(refused)?;
    encoder.set_frame_delay(delay_numerator, delay_denominator).map_err(refused)?;
    let mut writer = encoder.write_header().map_err(refused)?;
    let mut before = image_bytes(first, with_alpha);
    writer.write_image_data(&before).map_err(refused)?;
    for frame in frames.iter().skip(1) {
        let bytes = image_bytes(frame, with_alpha);
        let row_bytes = bytes.len() / frame.height as usize;
        let changed = changed_rectangle(&before, &bytes, row_bytes, row_bytes / frame.width as usize);
        // In this order: each call is checked against what the others have set so far.
        writer.reset_frame_position().map_err(refused)?;
        writer.set_frame_dimension(changed.width, changed.height).map_err(refused)?;
        writer.set_frame_position(changed.left, changed.top).map_err(refused)?;
        writer.write_image_data(&changed.bytes).map_err(refused)?;
        before = bytes;
    }
    writer.finish().map_err(refused)?;
    Ok(file)
}

fn refused(error: png::EncodingError) -> OutputError {
    OutputError::Encode { format: "PNG", reason: error.to_string() }
}

fn encoder<'a>(file: &'a mut Vec<u8>, image: &Image, with_alpha: bool) -> Encoder<'a, &'a mut Vec<u8>> {
    let mut encoder = Encoder::new(file, image.width, image.height);
    encoder.set_color(if with_alpha { ColorType::Rgba } else { ColorType::Rgb });
    encoder.set_depth(BitDepth::Eight);
    encoder.set_deflate_compression(EFFORT);
    encoder.set_filter(Filter::Adaptive);
    encoder.set_source_srgb(SrgbRenderingIntent::Perceptual);
    encoder
}

/// Alpha as an eight-bit code: linear, clamped, NaN as 0.
fn alpha_code(alpha: f32) -> u8 {
    (alpha * 255.0 + 0.5) as u8
}

fn is_opaque(image: &Image) -> bool {
    image.pixels.iter().all(|pixel| alpha_code(pixel[3]) == 255)
}

fn image_bytes(image: &Image, with_alpha: bool) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(image.pixels.len() * if with_alpha { 4 } else { 3 });
    for &[r, g, b, alpha] in &image.pixels {
        let code = alpha_code(alpha);
        // Where nothing is visible colour has no meaning, and even zeros compress best.
        let scale = if code == 0 { 0.0 } else { 1.0 / alpha.min(1.0) };
        bytes.extend([r, g, b].map(|component| linear_to_srgb8(component * scale)));
        if with_alpha {
            bytes.push(code);
        }
    }
    bytes
}

/// A part of a frame, with its rows' bytes packed together.
struct Rectangle {
    left: u32,
    top: u32,
    width: u32,
    height: u32,
    bytes: Vec<u8>,
}

/// The smallest rectangle of `now` that holds every difference from `before`; one pixel if they are equal,
/// because a frame can't be empty.
fn changed_rectangle(before: &[u8], now: &[u8], row_bytes: usize, pixel_bytes: usize) -> Rectangle {
    let (mut left, mut right, mut top, mut bottom) = (usize::MAX, 0, usize::MAX, 0);
    for (y, (old, new)) in before.chunks_exact(row_bytes).zip(now.chunks_exact(row_bytes)).enumerate() {
        let mut differences = old.iter().zip(new).map(|(a, b)| a != b);
        let Some(first) = differences.position(|different| different) else { continue };
        let last = old.iter().zip(new).rposition(|(a, b)| a != b).unwrap_or(first);
        left = left.min(first / pixel_bytes);
        right = right.max(last / pixel_bytes);
        top = top.min(y);
        bottom = y;
    }
    if top == usize::MAX {
        (left, top) = (0, 0);
    }
    let row_part =
        |row: &'_ [u8]| row.get(left * pixel_bytes..(right + 1) * pixel_bytes).unwrap_or(&[]).to_vec();
    let rows = now.chunks_exact(row_bytes).skip(top).take(bottom - top + 1);
    // All of these are within the picture, whose sides are u32.
    Rectangle {
        left: left as u32,
        top: top as u32,
        width: (right - left + 1) as u32,
        height: (bottom - top + 1) as u32,
        bytes: rows.flat_map(row_part).collect(),
    }
}

/// The time of one frame as the fraction of 16-bit numbers that comes closest, the smallest if several do.
fn frame_delay(frames_per_second: f64) -> Result<(u16, u16), OutputError> {
    if !(0.001..=65535.0).contains(&frames_per_second) {
        return Err(OutputError::Misuse(format!(
            "{frames_per_second} frames per second: must be 0.001 to 65535"
        )));
    }
    let mut best = (1, 1, f64::INFINITY);
    for numerator in 1..=u16::MAX {
        let denominator = (f64::from(numerator) * frames_per_second).round();
        if denominator > 65535.0 {
            break;
        }
        let error = (denominator / f64::from(numerator) / frames_per_second - 1.0).abs();
        if denominator >= 1.0 && error < best.2 - 1e-12 {
            best = (numerator, denominator as u16, error);
        }
    }
    Ok((best.0, best.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::color::linear_to_srgb;
    use std::io::Cursor;

    fn ramp(width: u32, height: u32, alpha: impl Fn(u32) -> f32) -> Image {
        let pixel = |i: u32| {
            let (a, t) = (alpha(i), i as f32 / (width * height) as f32);
            [t * a, (1.0 - t) * a, t * t * 1.5 * a, a]
        };
        Image { width, height, pixels: (0..width * height).map(pixel).collect() }
    }

    fn decode(file: &[u8]) -> (png::Info<'static>, Vec<u8>) {
        let mut reader = png::Decoder::new(Cursor::new(file)).read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut bytes).unwrap();
        (reader.info().clone(), bytes)
    }

    #[test]
    fn colours_lie_on_the_srgb_curve() {
        let image = ramp(37, 11, |_| 1.0);
        let (info, bytes) = decode(&encode_png(&image).unwrap());
        assert_eq!((info.width, info.height, info.color_type), (37, 11, ColorType::Rgba));
        assert_eq!(info.srgb, Some(SrgbRenderingIntent::Perceptual));
        for (pixel, code) in image.pixels.iter().zip(bytes.chunks_exact(4)) {
            for (linear, code) in pixel.iter().zip(code) {
                let expected = linear_to_srgb(linear.clamp(0.0, 1.0)) * 255.0;
                assert!((f32::from(*code) - expected).abs() < 0.501, "{linear} became {code}");
            }
        }
    }

    #[test]
    fn compact_pictures_leave_out_alpha_where_it_says_nothing() {
        let opaque = ramp(37, 11, |_| 1.0);
        let (_, rgba) = decode(&encode_png(&opaque).unwrap());
        let (info, rgb) = decode(&encode_png_compact(&opaque).unwrap());
        assert_eq!(info.color_type, ColorType::Rgb);
        assert!(rgb.chunks_exact(3).eq(rgba.chunks_exact(4).map(|pixel| &pixel[..3])));

        let with_a_hole = ramp(37, 11, |i| if i == 200 { 0.5 } else { 1.0 });
        assert_eq!(encode_png_compact(&with_a_hole), encode_png(&with_a_hole));
    }

    #[test]
    fn alpha_is_straight_in_the_file() {
        let image = ramp(16, 16, |i| (i % 17) as f32 / 16.0);
        let (info, bytes) = decode(&encode_png(&image).unwrap());
        assert_eq!(info.color_type, ColorType::Rgba);
        for ([r, _, _, alpha], code) in image.pixels.iter().zip(bytes.chunks_exact(4)) {
            assert!((f32::from(code[3]) - alpha * 255.0).abs() <= 0.501);
            let expected = if *alpha == 0.0 { 0.0 } else { linear_to_srgb(r / alpha) * 255.0 };
            assert!((f32::from(code[0]) - expected).abs() < 0.51, "{r} at {alpha} became {}", code[0]);
        }
    }

    #[test]
    fn wild_values_are_clamped() {
        let pixels =
            vec![[f32::NAN, f32::INFINITY, -1.0, 1.0], [1.0, 1.0, 1.0, f32::NAN], [2.0, 0.5, 9.0, 7.0]];
        let (_, bytes) = decode(&encode_png(&Image { width: 3, height: 1, pixels }).unwrap());
        assert_eq!(bytes, [0, 255, 0, 255, 0, 0, 0, 0, 255, 188, 255, 255]);
    }

    #[test]
    fn same_picture_same_bytes() {
        let image = ramp(64, 48, |i| (i % 5) as f32 / 4.0);
        assert_eq!(encode_png(&image), encode_png(&image.clone()));
        let frames = [image.clone(), image.exposed(1.0)];
        assert_eq!(encode_apng(&frames, 24.0), encode_apng(&frames, 24.0));
    }

    #[test]
    fn bad_pictures_are_refused() {
        let short = Image { width: 2, height: 2, pixels: vec![[0.0; 4]; 3] };
        assert!(matches!(encode_png(&short), Err(OutputError::Misuse(_))));
        for (width, height) in [(0, 1), (1, 0), (u32::MAX, u32::MAX)] {
            let image = Image { width, height, pixels: Vec::new() };
            assert!(matches!(encode_png(&image), Err(OutputError::Size(_))));
            assert!(matches!(encode_apng(&[image], 24.0), Err(OutputError::Size(_))));
        }
        let one = ramp(2, 2, |_| 1.0);
        assert!(encode_apng(&[], 24.0).is_err());
        assert!(encode_apng(&[one.clone(), ramp(2, 3, |_| 1.0)], 24.0).is_err());
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e6] {
            assert!(encode_apng(std::slice::from_ref(&one), rate).is_err(), "{rate}");
        }
    }

    #[test]
    fn animations_play_back_as_drawn() {
        for alpha in [1.0, 0.5] {
            // A dot that moves and rests, on a ramp: small rectangles, and one frame without a change.
            let frames: Vec<Image> = [3, 40, 40, 200, 0]
                .map(|dot| {
                    let mut image = ramp(20, 13, |_| alpha);
                    image.pixels[dot] = [alpha, 0.0, 0.0, alpha];
                    image
                })
                .into();
            let file = encode_apng(&frames, 24.0).unwrap();
            let mut reader = png::Decoder::new(Cursor::new(&file)).read_info().unwrap();
            let control = reader.info().animation_control.unwrap();
            assert_eq!((control.num_frames, control.num_plays), (5, 0));
            let pixel_bytes = if alpha == 1.0 { 3 } else { 4 };
            let mut canvas = vec![0u8; 20 * 13 * pixel_bytes];
            for frame in &frames {
                let mut part = vec![0u8; canvas.len()];
                reader.next_frame(&mut part).unwrap();
                let at = *reader.info().frame_control().unwrap();
                assert_eq!((at.delay_num, at.delay_den), (1, 24));
                let (width, left, top) = (at.width as usize, at.x_offset as usize, at.y_offset as usize);
                for y in 0..at.height as usize {
                    let from = &part[y * width * pixel_bytes..(y + 1) * width * pixel_bytes];
                    let start = ((top + y) * 20 + left) * pixel_bytes;
                    canvas[start..start + from.len()].copy_from_slice(from);
                }
                assert_eq!(canvas, image_bytes(frame, alpha != 1.0));
            }
        }
    }

    #[test]
    fn frame_delays_are_close_and_small() {
        assert_eq!(frame_delay(24.0), Ok((1, 24)));
        assert_eq!(frame_delay(12.5), Ok((2, 25)));
        assert_eq!(frame_delay(0.5), Ok((2, 1)));
        assert_eq!(frame_delay(24_000.0 / 1001.0), Ok((1001, 24_000)));
        for i in 0..500 {
            let rate = 0.001 * 65_535_000f64.powf(f64::from(i) / 499.0).min(65_535_000.0);
            let (numerator, denominator) = frame_delay(rate).unwrap();
            let got = f64::from(denominator) / f64::from(numerator);
            assert!((got / rate - 1.0).abs() < 1e-3, "{rate} became {got}");
        }
    }
}
