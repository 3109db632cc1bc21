//! Less noise, by Open Image Denoise where it is installed: its own program `oidnDenoise` is run on PFM
//! files.
//!
//! Nothing of it is linked: whoever has the program has the feature. What is given to it is decided by the
//! caller: a picture in front of its background, or one with alpha.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use nuage_render::film::Image;

use crate::error::Failure;

/// The example program of Open Image Denoise 1.2 and later.
const PROGRAM: &str = "oidnDenoise";

/// Where the program is. To be asked before the time for a render is spent.
///
/// # Errors
/// If it is not on the PATH, with where to get it.
pub(crate) fn find() -> Result<PathBuf, Failure> {
    find_in(&std::env::var_os("PATH").unwrap_or_default())
}

fn find_in(path: &OsStr) -> Result<PathBuf, Failure> {
    let name = format!("{PROGRAM}{}", std::env::consts::EXE_SUFFIX);
    let found = std::env::split_paths(path).map(|folder| folder.join(&name)).find(|file| file.is_file());
    found.ok_or_else(|| {
        Failure::Usage(format!(
            "--denoise needs the program {PROGRAM}, which is nowhere on the PATH: install Open Image Denoise from \
             https://www.openimagedenoise.org, or render without --denoise"
        ))
    })
}

/// The picture with less noise, guided by the albedo where paths first collide, one colour per pixel. Alpha
/// is freed of noise by itself, if it differs from pixel to pixel.
///
/// # Errors
/// If the program fails, with what it says.
pub(crate) fn denoise(program: &Path, image: &Image, albedo: &[[f32; 3]]) -> Result<Image, Failure> {
    let colour: Vec<[f32; 3]> = image.pixels.iter().map(|[r, g, b, _]| [*r, *g, *b]).collect();
    let colour = run(program, [image.width, image.height], &colour, albedo)?;
    let mut alpha: Vec<f32> = image.pixels.iter().map(|pixel| pixel[3]).collect();
    if alpha.windows(2).any(|pair| pair[0] != pair[1]) {
        let grey: Vec<[f32; 3]> = alpha.iter().map(|alpha| [*alpha; 3]).collect();
        let grey = run(program, [image.width, image.height], &grey, albedo)?;
        alpha = grey.iter().map(|[r, g, b]| ((r + g + b) / 3.0).clamp(0.0, 1.0)).collect();
    }
    let pixels = colour.iter().zip(alpha).map(|([r, g, b], alpha)| [*r, *g, *b, alpha]).collect();
    Ok(Image { width: image.width, height: image.height, pixels })
}

/// One run of the program.
fn run(
    program: &Path,
    size: [u32; 2],
    colour: &[[f32; 3]],
    albedo: &[[f32; 3]],
) -> Result<Vec<[f32; 3]>, Failure> {
    let failed = |what: String| Failure::file(program, what);
    let io = |what: &str, error: std::io::Error| failed(format!("cannot {what}: {error}"));
    let folder = tempfile::tempdir().map_err(|e| io("make a temporary folder", e))?;
    let [noisy, guide, clean] =
        ["noisy", "albedo", "clean"].map(|name| folder.path().join(name).with_extension("pfm"));
    for (path, pixels) in [(&noisy, colour), (&guide, albedo)] {
        std::fs::write(path, encode_pfm(size, pixels)).map_err(|e| io("write a temporary file for it", e))?;
    }
    let mut command = Command::new(program);
    command.arg("--hdr").arg(&noisy).arg("--alb").arg(&guide).arg("-o").arg(&clean);
    let output = command.output().map_err(|e| io("start", e))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("it says nothing");
        return Err(failed(format!("it failed ({}): {last}", output.status)));
    }
    let bytes = std::fs::read(&clean).map_err(|e| io("read what it wrote", e))?;
    decode_pfm(&bytes, size)
        .ok_or_else(|| failed("what it wrote is no PFM picture of the size given to it".into()))
}

/// Colours, row by row from the top, as a PFM file. Such files hold rows from the bottom; a negative scale
/// says little-endian.
fn encode_pfm([width, height]: [u32; 2], pixels: &[[f32; 3]]) -> Vec<u8> {
    let mut bytes = format!("PF\n{width} {height}\n-1.0\n").into_bytes();
    for row in pixels.chunks(width.max(1) as usize).rev() {
        bytes.extend(row.iter().flatten().flat_map(|value| value.to_le_bytes()));
    }
    bytes
}

/// The colours of a PFM file, row by row from the top; `None` if it is none or has another size.
fn decode_pfm(bytes: &[u8], [width, height]: [u32; 2]) -> Option<Vec<[f32; 3]>> {
    let mut rest = bytes;
    // Each word ends with one white space; behind the last begin the numbers.
    let mut word = || {
        let (word, behind) = rest.split_at_checked(rest.iter().position(u8::is_ascii_whitespace)?)?;
        rest = behind.get(1..)?;
        std::str::from_utf8(word).ok()
    };
    let right = word()? == "PF" && word()?.parse() == Ok(width) && word()?.parse() == Ok(height);
    let scale: f32 = word().filter(|_| right)?.parse().ok()?;
    let (numbers, []) = rest.as_chunks::<4>() else { return None };
    let value =
        |bytes: &[u8; 4]| if scale < 0.0 { f32::from_le_bytes(*bytes) } else { f32::from_be_bytes(*bytes) };
    let (pixels, []) = numbers.as_chunks::<3>() else { return None };
    let count = (width as usize).checked_mul(height as usize)?;
    if width == 0 || pixels.len() != count {
        return None;
    }
    let rows = pixels.chunks(width as usize).rev();
    Some(rows.flatten().map(|pixel| pixel.each_ref().map(value)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn colours(count: u32) -> Vec<[f32; 3]> {
        (0..count).map(|i| [i as f32, -0.5 * i as f32, 1e30 / (i + 1) as f32]).collect()
    }

    #[test]
    fn pfm_files_come_back_and_damaged_ones_do_not() {
        for [width, height] in [[1, 1], [3, 2], [2, 5]] {
            let pixels = colours(width * height);
            let bytes = encode_pfm([width, height], &pixels);
            assert_eq!(decode_pfm(&bytes, [width, height]), Some(pixels));
            assert_eq!(decode_pfm(&bytes, [width + 1, height]), None);
            for length in 0..bytes.len() {
                assert_eq!(decode_pfm(&bytes[..length], [width, height]), None);
            }
        }
        assert_eq!(decode_pfm(b"PF 0 0 -1 ", [0, 0]), None);
        // Two rows of one pixel, big-endian: the lower one is first.
        let numbers: Vec<u8> =
            [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0].into_iter().flat_map(f32::to_be_bytes).collect();
        let bytes = [b"PF\n1 2\n1.0\n", &numbers[..]].concat();
        assert_eq!(decode_pfm(&bytes, [1, 2]), Some(vec![[4.0, 5.0, 6.0], [1.0, 2.0, 3.0]]));
    }

    /// Stand-ins for the program: one gives back the picture, one the albedo, others fail.
    #[cfg(unix)]
    #[test]
    fn the_program_is_found_fed_and_believed_only_when_it_works() {
        use std::os::unix::fs::PermissionsExt;

        let folder = tempfile::tempdir().expect("a folder");
        let script = |name: &str, body: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).expect("a script");
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("a program");
            path
        };
        // All before the first is run: a program that is open for writing can't be.
        let same = script(PROGRAM, r#"[ "$1 $3 $5" = "--hdr --alb -o" ] && cp "$2" "$6""#);
        let albedo_instead = script("albedo", r#"cp "$4" "$6""#);
        let fails = script("fails", "echo first >&2; echo no device >&2; exit 3");
        let silent = script("silent", "exit 0");
        let small = script("small", r#"printf 'PF\n1 1\n-1.0\n' > "$6""#);

        assert_eq!(find_in(folder.path().as_os_str()).expect("the stand-in"), same);
        let absent = find_in(OsStr::new("/nowhere")).expect_err("nothing there").to_string();
        assert!(absent.contains("openimagedenoise.org"), "{absent}");

        let alpha = |i: u32| if i == 4 { 0.25 } else { 1.0 };
        let pixels = (0..).zip(colours(6)).map(|(i, [r, g, b])| [r, g, b, alpha(i)]).collect();
        let image = Image { width: 3, height: 2, pixels };
        let albedo = vec![[0.5, 0.25, 0.75]; 6];
        assert_eq!(denoise(&same, &image, &albedo).expect("a picture"), image);
        let guided = denoise(&albedo_instead, &image, &albedo).expect("a picture");
        assert_eq!(guided.pixels, [[0.5, 0.25, 0.75, 0.5]; 6]);
        // Alpha that is the same everywhere has no noise and stays.
        let opaque = image.over([0.0; 3]);
        assert_eq!(denoise(&albedo_instead, &opaque, &albedo).expect("a picture").pixels[0][3], 1.0);
        for (program, reason) in [
            (fails, "no device"),
            (silent, "cannot read what it wrote"),
            (small, "no PFM picture of the size"),
            (folder.path().join("absent"), "cannot start"),
        ] {
            let failure = denoise(&program, &image, &albedo).expect_err("a program that fails").to_string();
            assert!(failure.contains(reason), "{failure}");
        }
    }
}
