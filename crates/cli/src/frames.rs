//! The frames that an input names: files of a sequence on disk, or frames of a packed file.
//!
//! A frame of a packed file is named `smoke.nuage#12`, wherever a file is named; without a number it is the first.

use std::path::{Path, PathBuf};

use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_pipeline::sequence::{FrameFile, FrameRange, find_frames};
use nuage_vdb::{Compression, WriteOptions};
use nuage_volume::format::{Asset, FormatError};
use rayon::prelude::*;

use crate::error::Failure;
use crate::source::DiskFile;

/// The path of a packed file and the number after `#`, if the path is one.
pub(crate) fn packed(path: &Path) -> Option<(PathBuf, Option<i64>)> {
    let text = path.to_str()?;
    let is_packed = |text: &str| text.to_lowercase().ends_with(".nuage");
    match text.rsplit_once('#') {
        _ if is_packed(text) => Some((path.to_owned(), None)),
        Some((file, number)) if is_packed(file) => Some((PathBuf::from(file), Some(number.parse().ok()?))),
        _ => None,
    }
}

/// The frames that an input names.
///
/// # Errors
/// If there are none, or the input makes no sense.
pub(crate) fn find(input: &Path, range: Option<&FrameRange>) -> Result<Vec<FrameFile>, Failure> {
    match packed(input) {
        Some((path, None)) => {
            let asset = open(&path)?;
            let numbers = (0..asset.contents().frames.len()).map(|frame| number(&asset, frame));
            let wanted = numbers.filter(|number| range.is_none_or(|range| range.contains(*number)));
            let frame = |number: i64| FrameFile {
                frame: Some(number),
                path: PathBuf::from(format!("{}#{number}", path.display())),
            };
            let found: Vec<FrameFile> = wanted.map(frame).collect();
            match found.is_empty() {
                true => Err(Failure::file(input, none_wanted(&asset))),
                false => Ok(found),
            }
        }
        Some((_, number)) => Ok(vec![FrameFile { frame: number, path: input.to_owned() }]),
        None => {
            let found = find_frames(&input.to_string_lossy(), range);
            Ok(found.map_err(|error| Failure::file(input, error.to_string()))?.frames)
        }
    }
}

/// Why no frame is left.
fn none_wanted(asset: &Asset) -> String {
    match asset.contents().frames.len().checked_sub(1) {
        Some(last) => {
            format!("no frame is in that range; there are {} to {}", number(asset, 0), number(asset, last))
        }
        None => "there is no frame in this file".to_owned(),
    }
}

/// The number by which a frame is named: its own, else its place from 1.
pub(crate) fn number(asset: &Asset, frame: usize) -> i64 {
    let own = asset.contents().frames.get(frame).and_then(|frame| frame.number);
    own.unwrap_or(frame as i64 + 1)
}

/// Opens a packed file.
///
/// # Errors
/// If it is damaged or not packed.
pub(crate) fn open(path: &Path) -> Result<Asset, Failure> {
    Asset::open(DiskFile::open_plain(path)?).map_err(|error| Failure::file(path, error.to_string()))
}

/// Reads all bricks of a packed file, to see whether they are sound.
///
/// # Errors
/// If the file is damaged.
pub(crate) fn check(path: &Path) -> Result<(), Failure> {
    let asset = open(path)?;
    let mut pages = 0..asset.store().pages().len();
    let checked = pages.try_for_each(|page| asset.read_page(page).map(drop));
    checked.map_err(|error| Failure::file(path, error.to_string()))
}

/// Loads the pages that a frame needs, as far as they are absent, on all threads.
///
/// # Errors
/// As those of [`Asset::load_frame`].
pub(crate) fn load_frame(asset: &mut Asset, frame: usize) -> Result<(), FormatError> {
    let mut pages = asset.pages_of_frame(frame)?;
    pages.retain(|page| asset.store().pages()[*page].words().is_none());
    // A page for each thread at a time: what is read counts towards the limit of memory only once it is set.
    for pages in pages.chunks(rayon::current_num_threads()) {
        let read: Vec<_> = pages.par_iter().map(|page| asset.read_page(*page)).collect();
        pages.iter().zip(read).try_for_each(|(page, words)| asset.set_page(*page, words?))?;
    }
    Ok(())
}

/// The bytes of a .vdb file that holds what a frame of a packed file holds.
///
/// # Errors
/// If there is no such frame, or the file is damaged.
pub(crate) fn as_vdb(path: &Path, wanted: Option<i64>) -> Result<Vec<u8>, Failure> {
    let failed = |what: String| Failure::file(path, what);
    let mut asset = open(path)?;
    let count = asset.contents().frames.len();
    let frame = match wanted {
        None => 0,
        Some(wanted) => (0..count)
            .find(|frame| number(&asset, *frame) == wanted)
            .ok_or_else(|| failed(format!("there is no frame {wanted}")))?,
    };
    load_frame(&mut asset, frame).map_err(|error| failed(error.to_string()))?;
    let (grids, metadata) = unpack_frame(&asset, frame).map_err(|error| failed(error.to_string()))?;
    let mut bytes = Vec::new();
    let options = WriteOptions { compression: Compression::NONE };
    nuage_vdb::write(&grids, &metadata, &options, &mut bytes).map_err(|error| failed(error.to_string()))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_after_the_name_is_a_frame() {
        let of = |text: &str| packed(Path::new(text));
        assert_eq!(of("a/b.nuage"), Some(("a/b.nuage".into(), None)));
        assert_eq!(of("b.nuage#-3"), Some(("b.nuage".into(), Some(-3))));
        assert_eq!(of("b.vdb"), None);
        assert_eq!(of("b.nuage#x"), None);
    }
}
