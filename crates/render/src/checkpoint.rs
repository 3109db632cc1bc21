//! A film that is not finished, as bytes: what a render that goes on later starts from.
//!
//! All numbers are little-endian. The head: the eight bytes `nuagefil`, the version (u32), columns and rows
//! (u32 each), the caller's digest of everything else that the film depends on (u128). Then the pixels, row
//! by row from the top, each [`Tally`]'s numbers in the order of its fields: two u32, then 17 f64. At the end
//! XXH3 (64 bits) of all bytes before it.
//!
//! What does not live here: files. What the digest is taken of is the caller's to say: the scene, the
//! settings of the paths, the seed, and the version of the program, as other versions may trace other paths.

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use crate::film::{Film, ImageSizeError, MAX_PIXELS, Tally, pixel_count};

/// The version of the format, which is raised with every change.
const VERSION: u32 = 1;

const MAGIC: &[u8; 8] = b"nuagefil";

/// Bytes before the pixels.
const HEAD_BYTES: usize = 8 + 3 * 4 + 16;

/// Bytes of a pixel.
const PIXEL_BYTES: usize = 2 * 4 + 17 * 8;

/// Bytes behind the pixels.
const CHECKSUM_BYTES: usize = 8;

/// The most bytes that a checkpoint has. A file that is larger is none and need not be read.
pub const MAX_BYTES: u64 = MAX_PIXELS * PIXEL_BYTES as u64 + (HEAD_BYTES + CHECKSUM_BYTES) as u64;

/// Why bytes are not the checkpoint that is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CheckpointError {
    /// Something else altogether.
    #[error("this is no checkpoint of a render")]
    Other,
    /// Another version wrote it.
    #[error(
        "the checkpoint has version {found} of the format, this program reads version {VERSION}: render anew"
    )]
    Version {
        /// The version.
        found: u32,
    },
    /// Bytes are missing, superfluous or changed.
    #[error("the checkpoint is damaged or incomplete: render anew")]
    Damaged,
    /// No such picture can exist.
    #[error(transparent)]
    Size(#[from] ImageSizeError),
    /// It is of another scene, or rendered with other settings.
    #[error(
        "the checkpoint is of another scene or other settings: render anew, or ask for what it was made with"
    )]
    Scene,
}

/// A digest of parts that say together what is rendered. Where one part ends and the next begins matters too.
pub fn digest<'p>(parts: impl IntoIterator<Item = &'p [u8]>) -> u128 {
    let mut hasher = Xxh3::new();
    for part in parts {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part);
    }
    hasher.digest128()
}

/// A film as bytes. `digest` stands for everything else that it depends on.
pub fn encode(film: &Film, digest: u128) -> Vec<u8> {
    let tallies = film.map(|tally| *tally);
    let mut bytes = Vec::with_capacity(HEAD_BYTES + tallies.len() * PIXEL_BYTES + CHECKSUM_BYTES);
    bytes.extend(MAGIC);
    for number in [VERSION, film.width(), film.height()] {
        bytes.extend(number.to_le_bytes());
    }
    bytes.extend(digest.to_le_bytes());
    for tally in tallies {
        bytes.extend(tally.samples.to_le_bytes());
        bytes.extend(tally.hits.to_le_bytes());
        let Tally { emission, direct, indirect, albedo, depth, spread, .. } = tally;
        let sums = [emission, direct, indirect, albedo].into_iter().flatten();
        sums.chain([depth]).chain(spread).for_each(|number| bytes.extend(number.to_le_bytes()));
    }
    bytes.extend(xxh3_64(&bytes).to_le_bytes());
    bytes
}

/// The film that was encoded with the same digest. Takes no more memory than four times the bytes.
///
/// # Errors
/// [`CheckpointError`]: bytes from anywhere are safe.
pub fn decode(bytes: &[u8], digest: u128) -> Result<Film, CheckpointError> {
    let (magic, rest) = bytes.split_first_chunk().ok_or(CheckpointError::Other)?;
    if magic != MAGIC {
        return Err(CheckpointError::Other);
    }
    let mut head = Numbers(rest);
    let found = u32::from_le_bytes(head.take().ok_or(CheckpointError::Damaged)?);
    if found != VERSION {
        return Err(CheckpointError::Version { found });
    }
    let (checked, checksum) = bytes.split_last_chunk().ok_or(CheckpointError::Damaged)?;
    if xxh3_64(checked) != u64::from_le_bytes(*checksum) {
        return Err(CheckpointError::Damaged);
    }
    let (film, scene) = read(checked).ok_or(CheckpointError::Damaged)??;
    if scene == digest { Ok(film) } else { Err(CheckpointError::Scene) }
}

/// The film and the digest in bytes without their checksum; `None` if they don't make a film.
fn read(bytes: &[u8]) -> Option<Result<(Film, u128), ImageSizeError>> {
    let mut head = Numbers(bytes.get(MAGIC.len() + 4..)?);
    let [width, height] = [head.u32()?, head.u32()?];
    let digest = u128::from_le_bytes(head.take()?);
    let count = match pixel_count(width, height) {
        Ok(count) => count,
        Err(error) => return Some(Err(error)),
    };
    // Before memory is taken for the film.
    if head.0.len() != count.checked_mul(PIXEL_BYTES)? {
        return None;
    }
    let mut film = Film::new(width, height).ok()?;
    for (index, tile) in (0..).zip(&mut film.tiles) {
        for ([x, y], tally) in film.tiling.pixels(index).zip(tile) {
            let at = (y as usize * width as usize + x as usize) * PIXEL_BYTES;
            *tally = Numbers(head.0.get(at..)?).tally().filter(|tally| tally.hits <= tally.samples)?;
        }
    }
    Some(Ok((film, digest)))
}

/// Bytes from which numbers are taken.
struct Numbers<'b>(&'b [u8]);

impl Numbers<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*first)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take()?);
        }
        Some(numbers)
    }

    fn tally(&mut self) -> Option<Tally> {
        Some(Tally {
            samples: self.u32()?,
            hits: self.u32()?,
            emission: self.f64s()?,
            direct: self.f64s()?,
            indirect: self.f64s()?,
            albedo: self.f64s()?,
            depth: self.f64s::<1>()?[0],
            spread: self.f64s()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_pixel, unit_f32};
    use crate::path::PathSample;
    use glam::Vec3;

    /// A film whose numbers all differ.
    fn film(width: u32, height: u32) -> Film {
        let mut film = Film::new(width, height).unwrap();
        for (i, tally) in (0..).zip(film.tiles.iter_mut().flatten()) {
            for path in 0..i % 5 {
                let value = |d| unit_f32(hash_pixel(i, path, 3, d)) - 0.2;
                let colour = |d| Vec3::new(value(d), value(d + 1), value(d + 2));
                let [emission, direct, indirect, albedo] = [0, 3, 6, 9].map(colour);
                let passed = value(12) > 0.3;
                tally.add(&PathSample { emission, direct, indirect, passed, depth: value(13), albedo });
            }
        }
        film
    }

    #[test]
    fn films_come_back_as_they_were() {
        for (width, height) in [(1, 1), (16, 16), (50, 33), (3, 70)] {
            let film = film(width, height);
            let bytes = encode(&film, 7);
            assert_eq!(decode(&bytes, 7), Ok(film));
            assert_eq!(decode(&bytes, 8), Err(CheckpointError::Scene));
            assert!(bytes.len() as u64 <= MAX_BYTES);
        }
    }

    #[test]
    fn damage_is_seen_wherever_it_is() {
        let bytes = encode(&film(3, 2), 7);
        for length in 0..bytes.len() {
            assert!(decode(&bytes[..length], 7).is_err());
        }
        assert_eq!(decode(&[&bytes[..], &[0]].concat(), 7), Err(CheckpointError::Damaged));
        for bit in 0..bytes.len() * 8 {
            let mut bytes = bytes.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            let error = decode(&bytes, 7).expect_err("a flipped bit");
            let expected = match bit / 8 {
                0..8 => CheckpointError::Other,
                8..12 => CheckpointError::Version { found: VERSION ^ (1 << (bit - 64)) },
                _ => CheckpointError::Damaged,
            };
            assert_eq!(error, expected);
        }
    }

    /// Bytes with a right checksum are not trusted either.
    #[test]
    fn sizes_and_counts_are_checked_behind_a_right_checksum() {
        let changed = |at: usize, number: u32| {
            let mut bytes = encode(&film(2, 2), 7);
            bytes[at..at + 4].copy_from_slice(&number.to_le_bytes());
            let end = bytes.len() - CHECKSUM_BYTES;
            let checksum = xxh3_64(&bytes[..end]).to_le_bytes();
            bytes[end..].copy_from_slice(&checksum);
            decode(&bytes, 7)
        };
        // The width, and how many paths of the first pixel met the medium.
        for (at, number) in [(12, 3), (12, 1), (12, 8192), (HEAD_BYTES + 4, 1000)] {
            assert_eq!(changed(at, number), Err(CheckpointError::Damaged), "{at} {number}");
        }
        for number in [0, u32::MAX] {
            assert!(matches!(changed(12, number), Err(CheckpointError::Size(_))));
        }
    }

    #[test]
    fn digests_see_where_parts_end() {
        let of = |parts: &[&str]| digest(parts.iter().map(|part| part.as_bytes()));
        assert_eq!(of(&["a", "bc"]), of(&["a", "bc"]));
        assert_ne!(of(&["a", "bc"]), of(&["ab", "c"]));
        assert_ne!(of(&["a"]), of(&["a", ""]));
    }
}
