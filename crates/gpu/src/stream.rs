//! Frames of a packed volume that do not all fit: some at a time, within a stated budget of the device's memory.
//!
//! All memory is taken at once, as so many places as the budget allows, each with room for any frame. A frame that is asked for
//! takes the place of the one that was asked for longest ago; playing takes no memory, makes no pipeline, and changes no
//! picture. Where all frames fit as one [`Volume`], that is smaller, since frames share their bricks there.
//!
//! What does not live here: pages of files, which the caller loads ahead (`nuage_volume::format::Asset::load_frame`), and
//! when which frame is shown.

use nuage_volume::format::Asset;

use crate::arrays::{Arrays, Bricks, Room, Wanted};
use crate::device::Gpu;
use crate::error::GpuError;
use crate::upload::Volume;

/// Some frames of a packed volume on a device.
#[derive(Debug)]
pub struct Stream {
    gpu: Gpu,
    wanted: Vec<Wanted>,
    form: Bricks,
    /// What all frames agree on; without their words.
    common: Arrays,
    slots: Vec<Slot>,
    turn: u64,
    sent_bytes: u64,
}

/// A place for a frame.
#[derive(Debug)]
struct Slot {
    volume: Volume,
    frame: Option<usize>,
    /// When it was last asked for.
    turn: u64,
}

impl Stream {
    /// Takes as many places for frames as fit into so many bytes of the device's memory. Looks at the trees of all frames; no
    /// page needs to be loaded.
    ///
    /// What wgpu stages on the way to the device comes on top, at most what one frame takes until the next submission.
    ///
    /// # Errors
    /// If not even one fits, the volume is damaged, or the device fails.
    pub fn new(
        gpu: &Gpu,
        asset: &Asset,
        wanted: &[Wanted],
        form: Bricks,
        budget_bytes: u64,
    ) -> Result<Stream, GpuError> {
        let mut common = Arrays::default();
        let mut room = Room::default();
        let mut map_words = Some(0);
        let frames = asset.contents().frames.len();
        for frame in 0..frames {
            let arrays = Arrays::room_of(asset, wanted, frame, form)?;
            room = room.max(arrays.room());
            map_words = map_words.zip(arrays.map_words()).map(|(most, words)| most.max(words));
            common.append_places(&arrays);
        }
        // What is the same for all: maps, or none.
        if let Some(words) = map_words.filter(|words| room.are_maps_worth(*words)) {
            room.tree_words += words;
            common.set_maps();
        }
        let size_bytes = Volume::size_of(gpu, room)?.total();
        let count = usize::try_from(budget_bytes / size_bytes).unwrap_or(usize::MAX).min(frames);
        if count == 0 {
            let what = "a frame within the budget";
            return Err(GpuError::Limit { what, size_bytes, limit_bytes: budget_bytes });
        }
        let slot = |_| Ok(Slot { volume: Volume::with_room(gpu, room)?, frame: None, turn: 0 });
        let slots: Vec<Slot> = (0..count).map(slot).collect::<Result<_, GpuError>>()?;
        Ok(Stream { gpu: gpu.clone(), wanted: wanted.to_vec(), form, common, slots, turn: 0, sent_bytes: 0 })
    }

    /// A frame, as the only one of its volume, which the next frames may take over: to be prepared, and recorded at once.
    /// Copies it to the device if it is not there; its pages must be loaded then.
    ///
    /// # Errors
    /// If there is no such frame, its pages are not loaded or damaged, or the device fails.
    pub fn frame(&mut self, asset: &Asset, frame: usize) -> Result<&Volume, GpuError> {
        self.turn += 1;
        let there = self.slots.iter().position(|slot| slot.frame == Some(frame));
        let oldest = || (0..self.slots.len()).min_by_key(|slot| self.slots[*slot].turn).unwrap_or(0);
        let slot = there.unwrap_or_else(oldest);
        let slot = &mut self.slots[slot];
        if there.is_none() {
            let mut arrays = Arrays::of_frame(asset, &self.wanted, frame, self.form)?;
            arrays.agree_with(&self.common);
            // Whatever fails on the way leaves nothing that could be taken for a frame.
            slot.frame = None;
            self.sent_bytes += slot.volume.fill(&self.gpu, &arrays)?;
            slot.frame = Some(frame);
        }
        slot.turn = self.turn;
        Ok(&slot.volume)
    }

    /// Whether a frame is on the device.
    pub fn has(&self, frame: usize) -> bool {
        self.slots.iter().any(|slot| slot.frame == Some(frame))
    }

    /// How many frames there is room for.
    pub fn room(&self) -> usize {
        self.slots.len()
    }

    /// The memory taken on the device: never more than the budget, whatever is shown.
    pub fn size_bytes(&self) -> u64 {
        self.slots.iter().map(|slot| slot.volume.size_bytes().total()).sum()
    }

    /// The bytes copied to the device so far.
    pub fn sent_bytes(&self) -> u64 {
        self.sent_bytes
    }
}
