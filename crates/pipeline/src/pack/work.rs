//! Work that is finished while a sequence is packed, kept so that a run that was stopped can be taken up again, and the
//! digests by which a packed file is known to be what would be made again.
//!
//! Kept are the plan, which ends the passes over all frames that measure, and each frame once it is encoded. Nothing
//! depends on any of it: what is missing, damaged or of another recipe is made anew. The bytes are read by the same
//! program alone and may change with it. With the feature `fs`, [`Work`] keeps them in a folder.

#[cfg(feature = "fs")]
use std::{
    fs::{self, File},
    io::{self, Read, Write},
    path::{Path, PathBuf},
};

use std::sync::Arc;

use glam::IVec3;
use nuage_volume::build::TileSize;
use nuage_volume::codec::Codec;
use nuage_volume::format::{Contents, Frame, Quality};
use xxhash_rust::xxh3::{Xxh3, xxh3_128};

use super::assemble::hex;
use super::frame::{EncodedFrame, EncodedGrid, EncodedLevel, Options};
use super::plan::Plan;
use super::sequence::FrameName;
use crate::encode::quantize::ChannelScale;
use crate::encode::shapes::{SHAPE_CODEC, Shapes};

/// Goes up whenever the same frames and options give other bytes than before.
const REVISION: u32 = 5;

/// The name of the plan among what is kept.
pub const PLAN: &str = "plan";

/// The name of an encoded frame among what is kept.
pub fn frame_name(frame: usize) -> String {
    format!("frame.{frame}")
}

/// Where finished work goes and comes from, by its name. Both may fail without harm.
#[derive(Clone, Copy)]
pub struct Keep<'a> {
    /// The bytes that were saved under a name.
    pub load: &'a (dyn Fn(&str) -> Option<Vec<u8>> + Sync),
    /// Saves bytes under a name.
    pub save: &'a (dyn Fn(&str, &[u8]) + Sync),
}

/// All that a packed file is made by, in digests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recipe {
    /// Of everything but the sources: what is asked, and how the program goes about it.
    pub digest: u128,
    /// Of the source of each frame.
    pub sources: Vec<u128>,
}

impl Recipe {
    /// The recipe of frames with these sources. `selection` is what the caller does to a frame before it is packed.
    pub fn new(options: &Options, frame_rate: Option<f64>, selection: &str, sources: Vec<u128>) -> Recipe {
        let version = env!("CARGO_PKG_VERSION");
        let native = cfg!(feature = "native-zstd");
        let text = format!("{REVISION} {version} {native} {options:?} {frame_rate:?} {selection}");
        Recipe { digest: xxh3_128(text.as_bytes()), sources }
    }

    /// One digest of all of it, of the frames' names, and of the file that they are added to.
    pub fn key(&self, names: &[FrameName], base: Option<u128>) -> u128 {
        let mut digest = Xxh3::new();
        digest.update(&self.digest.to_le_bytes());
        digest.update(format!("{base:?} {names:?}").as_bytes());
        self.sources.iter().for_each(|source| digest.update(&source.to_le_bytes()));
        digest.digest128()
    }

    /// Whether a file with these contents was made of these frames by this recipe.
    pub fn made(&self, contents: &Contents, names: &[FrameName]) -> bool {
        let sources = self.sources.iter().copied().map(hex);
        let same = |(frame, (name, source)): (&Frame, (&FrameName, String))| {
            (frame.number, &frame.name, &frame.source) == (name.number, &name.name, &Some(source))
        };
        contents.recipe == Some(hex(self.digest))
            && contents.frames.len() == names.len()
            && self.sources.len() == names.len()
            && contents.frames.iter().zip(names.iter().zip(sources)).all(same)
    }
}

/// The words and the limit of each channel's shapes, the limit as bits, since it may be infinite.
type StoredShapes = Vec<(Vec<Vec<u32>>, u32)>;

/// A plan in bytes.
pub(super) fn plan_bytes(plan: &Plan) -> Vec<u8> {
    let shapes = plan.channels.iter().map(|channel| &channel.shapes);
    let shapes: StoredShapes =
        shapes.map(|shapes| (shapes.words.clone(), shapes.limit().to_bits())).collect();
    // Without bytes it is not found again, which is all that can come of it.
    serde_json::to_vec(&(plan, shapes)).unwrap_or_default()
}

/// The plan of [`plan_bytes`].
pub(super) fn plan(bytes: &[u8]) -> Option<Plan> {
    let (mut plan, shapes): (Plan, StoredShapes) = serde_json::from_slice(bytes).ok()?;
    let is_shape = |words: &Vec<u32>| words.len() == SHAPE_CODEC.word_count();
    let are_shapes = shapes.iter().all(|(words, _)| words.iter().all(is_shape));
    if !are_shapes || shapes.len() != plan.channels.len() {
        return None;
    }
    for (channel, (words, limit)) in plan.channels.iter_mut().zip(shapes) {
        channel.shapes = Arc::new(Shapes::of(words, f32::from_bits(limit)));
    }
    Some(plan)
}

/// Numbers in words.
#[derive(Default)]
struct Words(Vec<u32>);

impl Words {
    fn long(&mut self, number: u64) {
        self.0.extend([number as u32, (number >> 32) as u32]);
    }

    fn float(&mut self, number: f32) {
        self.0.push(number.to_bits());
    }

    fn place(&mut self, place: [i32; 3]) {
        self.0.extend(place.map(i32::cast_unsigned));
    }
}

/// An encoded frame in bytes.
pub(super) fn frame_bytes(frame: &EncodedFrame) -> Vec<u8> {
    let mut out = Words::default();
    out.long(frame.grids.len() as u64);
    for grid in &frame.grids {
        out.long(grid.channel as u64);
        let ChannelScale { unit, floor, background, background_tolerance, keeps_sign, max_error } =
            grid.scale;
        [unit, floor, background, background_tolerance, max_error]
            .into_iter()
            .for_each(|number| out.float(number));
        out.0.push(u32::from(keeps_sign));
        out.place(grid.index_offset);
        out.0.push(u32::from(grid.active_box.is_some()));
        grid.active_box.iter().flatten().for_each(|place| out.place(*place));
        out.0.push(u32::from(grid.world_from_index.is_some()));
        grid.world_from_index.iter().flatten().for_each(|number| out.long(number.to_bits()));
        out.long(grid.source_header.len() as u64);
        for bytes in grid.source_header.chunks(4) {
            let mut word = [0; 4];
            word[..bytes.len()].copy_from_slice(bytes);
            out.0.push(u32::from_le_bytes(word));
        }
        out.float(grid.quality.max_error);
        out.long(grid.quality.squared_error.to_bits());
        out.long(grid.quality.voxels);
        out.long(grid.source_bricks);
        out.long(grid.levels.len() as u64);
        for level in &grid.levels {
            out.long(level.bricks.len() as u64);
            for (place, codec, _) in &level.bricks {
                out.place(place.to_array());
                out.0.push(u32::from(codec.tag()));
            }
            out.0.extend_from_slice(&level.words);
            out.long(level.tiles.len() as u64);
            for (place, size, value) in &level.tiles {
                out.place(place.to_array());
                out.0.push(*size as u32);
                out.float(*value);
            }
        }
    }
    out.0.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// Reads numbers in words.
struct Reader<'a>(&'a [[u8; 4]]);

impl Reader<'_> {
    fn word(&mut self) -> Option<u32> {
        self.0.split_off_first().map(|word| u32::from_le_bytes(*word))
    }

    fn long(&mut self) -> Option<u64> {
        Some(u64::from(self.word()?) | u64::from(self.word()?) << 32)
    }

    fn float(&mut self) -> Option<f32> {
        self.word().map(f32::from_bits)
    }

    fn double(&mut self) -> Option<f64> {
        self.long().map(f64::from_bits)
    }

    fn place(&mut self) -> Option<[i32; 3]> {
        Some([self.word()?, self.word()?, self.word()?].map(u32::cast_signed))
    }

    fn flag(&mut self) -> Option<bool> {
        self.word().map(|word| word != 0)
    }

    /// So many things, each of at least one word.
    fn list<T>(&mut self, mut read: impl FnMut(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        let count = self.long()?;
        (count <= self.0.len() as u64).then(|| (0..count).map(|_| read(self)).collect())?
    }
}

/// The frame of [`frame_bytes`], if its channels and shapes are in the plan.
pub(super) fn frame(bytes: &[u8], plan: &Plan) -> Option<EncodedFrame> {
    let mut reader = Reader(bytes.as_chunks().0);
    let grids = reader.list(|reader| grid(reader, plan))?;
    reader.0.is_empty().then_some(EncodedFrame { grids })
}

fn grid(reader: &mut Reader, plan: &Plan) -> Option<EncodedGrid> {
    let channel = usize::try_from(reader.long()?).ok()?;
    let shapes = plan.channels.get(channel)?.shapes.words.len();
    let scale = ChannelScale {
        unit: reader.float()?,
        floor: reader.float()?,
        background: reader.float()?,
        background_tolerance: reader.float()?,
        max_error: reader.float()?,
        keeps_sign: reader.flag()?,
    };
    let index_offset = reader.place()?;
    let active_box = match reader.flag()? {
        true => Some([reader.place()?, reader.place()?]),
        false => None,
    };
    let world_from_index = match reader.flag()? {
        true => {
            let numbers: Option<Vec<f64>> = (0..12).map(|_| reader.double()).collect();
            Some(numbers?.try_into().ok()?)
        }
        false => None,
    };
    let header_bytes = usize::try_from(reader.long()?).ok()?;
    let mut source_header = reader.0.split_off(..header_bytes.div_ceil(4))?.as_flattened().to_vec();
    source_header.truncate(header_bytes);
    let quality =
        Quality { max_error: reader.float()?, squared_error: reader.double()?, voxels: reader.long()? };
    let source_bricks = reader.long()?;
    let levels = reader.list(|reader| level(reader, shapes))?;
    Some(EncodedGrid {
        channel,
        levels,
        scale,
        index_offset,
        active_box,
        world_from_index,
        source_header,
        quality,
        source_bricks,
    })
}

fn level(reader: &mut Reader, shapes: usize) -> Option<EncodedLevel> {
    let mut end = 0;
    let bricks = reader.list(|reader| {
        let place = IVec3::from_array(reader.place()?);
        let tag = u8::try_from(reader.word()?).ok()?;
        let codec = Codec::from_tag(tag).filter(|codec| *codec != Codec::Constant)?;
        end += codec.word_count();
        Some((place, codec, end))
    })?;
    let words: Vec<u32> = reader.0.split_off(..end)?.iter().map(|word| u32::from_le_bytes(*word)).collect();
    // The second word of a shared brick is the index of its shape.
    let mut shared = bricks.iter().filter(|(_, codec, _)| *codec == Codec::Shared);
    if shared.any(|(_, codec, end)| words[end - codec.word_count() + 1] as usize >= shapes) {
        return None;
    }
    let tiles = reader.list(|reader| {
        let place = IVec3::from_array(reader.place()?);
        let number = reader.word()?;
        let sizes = [TileSize::Brick, TileSize::Node4, TileSize::Node5];
        let size = sizes.into_iter().find(|size| *size as u32 == number)?;
        Some((place, size, reader.float()?))
    })?;
    Some(EncodedLevel { bricks, words, tiles })
}

/// The digest of a file's bytes.
///
/// # Errors
/// If it cannot be read.
#[cfg(feature = "fs")]
pub fn file_digest(path: &Path) -> io::Result<u128> {
    let (mut file, mut digest) = (File::open(path)?, Xxh3::new());
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(digest.digest128()),
            count => digest.update(&buffer[..count]),
        }
    }
}

/// A folder beside an output, of which each file holds one thing that is finished, under a checksum.
#[cfg(feature = "fs")]
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Work {
    folder: PathBuf,
    key: u128,
}

#[cfg(feature = "fs")]
impl Work {
    /// The bytes before what is kept: the key, the checksum, the length.
    const HEADER: usize = 40;
    /// How files begin that are being written.
    const PART: &str = "part-";

    /// The folder for an output: `.smoke.nuage.work` for `smoke.nuage`. What is in it already stays if it was saved with
    /// the same key. `None` if the output has no name.
    pub fn beside(output: &Path, key: u128) -> Option<Work> {
        let name = format!(".{}.work", output.file_name()?.to_str()?);
        let work = Work { folder: output.with_file_name(name), key };
        for name in work.names().into_iter().filter(|name| !work.is_whole(name)) {
            // What stays is looked at again before it is used.
            let _ = fs::remove_file(work.folder.join(name));
        }
        Some(work)
    }

    /// The names of all files in the folder that can be ours.
    fn names(&self) -> Vec<String> {
        let Ok(entries) = fs::read_dir(&self.folder) else { return Vec::new() };
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let is_ours = |name: &String| {
            name == PLAN || ["frame.", Work::PART].iter().any(|prefix| name.starts_with(prefix))
        };
        names.filter(is_ours).collect()
    }

    /// How many frames are finished.
    pub fn finished_frames(&self) -> usize {
        self.names().iter().filter(|name| name.starts_with("frame.") && self.is_whole(name)).count()
    }

    /// Whether a file has our key and its length; the checksum is left to [`Work::load`].
    fn is_whole(&self, name: &str) -> bool {
        let read = || {
            let mut file = File::open(self.folder.join(name)).ok()?;
            let mut header = [0; Work::HEADER];
            file.read_exact(&mut header).ok()?;
            let len = file.metadata().ok()?.len().checked_sub(Work::HEADER as u64)?;
            Some(header[..16] == self.key.to_le_bytes() && header[32..] == len.to_le_bytes())
        };
        !name.starts_with(Work::PART) && read() == Some(true)
    }

    fn checksum(name: &str, bytes: &[u8]) -> [u8; 16] {
        let mut digest = Xxh3::new();
        digest.update(name.as_bytes());
        digest.update(bytes);
        digest.digest128().to_le_bytes()
    }

    /// What was saved under a name, if it is there and sound.
    pub fn load(&self, name: &str) -> Option<Vec<u8>> {
        if !self.is_whole(name) {
            return None;
        }
        let mut bytes = fs::read(self.folder.join(name)).ok()?;
        let header: Vec<u8> = bytes.drain(..Work::HEADER.min(bytes.len())).collect();
        (header.get(16..32)? == Work::checksum(name, &bytes)).then_some(bytes)
    }

    /// Saves something under a name. It is there as a whole or not at all; that it is not costs only time.
    pub fn save(&self, name: &str, bytes: &[u8]) {
        let write = || -> Option<()> {
            if !self.folder.is_dir() {
                fs::create_dir(&self.folder).ok()?;
            }
            let mut file = tempfile::Builder::new().prefix(Work::PART).tempfile_in(&self.folder).ok()?;
            let mut header = self.key.to_le_bytes().to_vec();
            header.extend(Work::checksum(name, bytes));
            header.extend((bytes.len() as u64).to_le_bytes());
            file.write_all(&header).ok()?;
            file.write_all(bytes).ok()?;
            file.persist(self.folder.join(name)).ok().map(drop)
        };
        let _ = write();
    }

    /// Removes all that was saved.
    pub fn remove(&self) {
        for name in self.names() {
            let _ = fs::remove_file(self.folder.join(name));
        }
        // If there is something in it that is not ours, it stays.
        let _ = fs::remove_dir(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn example(seed: u32) -> (EncodedFrame, Plan) {
        let codecs = [Codec::Gradient { bits: 0 }, Codec::Uniform { bits: 3 }, Codec::F16];
        let mut level = EncodedLevel::default();
        for (i, codec) in codecs.into_iter().cycle().take(seed as usize % 8).enumerate() {
            level.words.extend((0..codec.word_count() as u32).map(|word| word.wrapping_mul(seed)));
            level.bricks.push((IVec3::new(i as i32 - 3, 7, i32::MIN), codec, level.words.len()));
            level.tiles.push((IVec3::splat(-1), TileSize::Node4, 0.5));
        }
        let grid = |channel: usize| EncodedGrid {
            channel,
            levels: vec![level.clone(), EncodedLevel::default()],
            scale: ChannelScale {
                unit: 2.0,
                floor: -0.0,
                background: 1e-30,
                background_tolerance: 0.1,
                max_error: 0.2,
                keeps_sign: channel == 1,
            },
            index_offset: [-128, 0, 128],
            active_box: (channel == 0).then_some([[-1; 3], [5; 3]]),
            world_from_index: (channel == 1).then_some([1.0 / 3.0; 12]),
            source_header: (0..seed as u8).collect(),
            quality: Quality { max_error: 0.3, squared_error: 1e300, voxels: u64::MAX },
            source_bricks: 1 << 40,
        };
        let mut plan = Plan::default();
        let values = nuage_vdb::Tree::empty(0.0_f32, nuage_vdb::Shape::STANDARD);
        let grids = ["a", "b"]
            .map(|name| nuage_vdb::Grid::new(name, nuage_vdb::Transform::identity(), values.clone()));
        plan.note(&grids);
        (EncodedFrame { grids: vec![grid(0), grid(1)] }, plan)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn frames_come_back_and_nothing_else_does(seed in 0_u32..200, cut in 0_usize..400, words in prop::collection::vec(any::<u32>(), 0..60)) {
            let (encoded, plan) = example(seed);
            let bytes = frame_bytes(&encoded);
            let back = frame(&bytes, &plan).unwrap();
            prop_assert_eq!(frame_bytes(&back), &bytes[..]);
            prop_assert_eq!(format!("{back:?}"), format!("{encoded:?}"));
            prop_assert!(frame(&bytes, &Plan::default()).is_none(), "of another plan");
            let cut = bytes.len().saturating_sub(4 * (cut + 1));
            prop_assert!(frame(&bytes[..cut], &plan).is_none());
            // Whatever the words, there is no panic.
            let any: Vec<u8> = words.iter().flat_map(|word| (word % 7).to_le_bytes()).collect();
            let _ = frame(&any, &plan);
            prop_assert_eq!(super::plan(&plan_bytes(&plan)), Some(plan));
        }
    }

    #[cfg(feature = "fs")]
    #[test]
    fn what_is_saved_is_there_until_something_is_wrong_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("a.nuage");
        let work = Work::beside(&output, 1).unwrap();
        work.remove();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is made before it is needed");
        let names = [PLAN, "frame.0", "frame.1", "frame.2"];
        let save = |work: &Work| names.iter().for_each(|name| work.save(name, name.as_bytes()));
        save(&work);
        assert_eq!((work.finished_frames(), work.load("frame.2")), (3, Some(b"frame.2".to_vec())));
        // Damaged, cut off, under another name: as if it were not there.
        let path = |name: &str| folder.path().join(".a.nuage.work").join(name);
        let sound = fs::read(path("frame.0")).unwrap();
        for at in 0..sound.len() {
            let mut bytes = sound.clone();
            bytes[at] ^= 1;
            fs::write(path("frame.0"), &bytes).unwrap();
            assert_eq!(work.load("frame.0"), None, "byte {at}");
            fs::write(path("frame.0"), &sound[..at]).unwrap();
            assert_eq!(work.load("frame.0"), None, "{at} bytes");
        }
        fs::copy(path("frame.1"), path("frame.0")).unwrap();
        assert_eq!(work.load("frame.0"), None);
        fs::write(path("part-1"), b"begun").unwrap();
        fs::write(path("not ours"), b"precious").unwrap();
        assert!(Work::beside(&output, 1).unwrap().load("frame.1").is_some() && !path("part-1").exists());
        // Of another recipe.
        let other = Work::beside(&output, 2).unwrap();
        assert!(names.iter().all(|name| other.load(name).is_none() && !path(name).exists()));
        save(&other);
        other.remove();
        assert_eq!(fs::read_dir(folder.path().join(".a.nuage.work")).unwrap().count(), 1);
        assert_eq!(fs::read(path("not ours")).unwrap(), b"precious");
    }
}
