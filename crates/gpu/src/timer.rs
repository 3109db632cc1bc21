//! How long passes take on the device, by timestamps where it has them: written around passes, read when they have come
//! back, which nothing waits for.
//!
//! What does not live here: what times are good for ([`crate::budget`]).

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use crate::budget::Effort;
use crate::device::Gpu;
use crate::error::GpuError;

/// How many pictures may be under way.
const SLOTS: usize = 4;

/// Two timestamps of 64 bits.
const BYTES: u64 = 16;

/// Times pictures.
#[derive(Debug)]
pub(crate) struct Timer {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    slots: [wgpu::Buffer; SLOTS],
    free: Vec<usize>,
    under_way: VecDeque<(usize, Effort)>,
    /// Whether the buffer of each slot has come back, and whole.
    returned: Arc<Mutex<[Option<bool>; SLOTS]>>,
}

impl Timer {
    /// `None` if the device has no timestamps, or none that mean something: one in software works when it comes to it, not
    /// between what it writes.
    ///
    /// # Errors
    /// If it fails.
    pub(crate) fn new(gpu: &Gpu) -> Result<Option<Timer>, GpuError> {
        let is_software = gpu.device().adapter_info().device_type == wgpu::DeviceType::Cpu;
        if is_software || !gpu.device().features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            return Ok(None);
        }
        let descriptor =
            wgpu::QuerySetDescriptor { label: Some("nuage times"), ty: wgpu::QueryType::Timestamp, count: 2 };
        let queries = gpu.guarded(|| gpu.device().create_query_set(&descriptor))?;
        let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
        let resolved = gpu.empty_buffer("nuage times", BYTES, usage)?;
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let slot = || gpu.empty_buffer("nuage times", BYTES, usage);
        Ok(Some(Timer {
            queries,
            resolved,
            slots: [slot()?, slot()?, slot()?, slot()?],
            free: (0..SLOTS).collect(),
            under_way: VecDeque::new(),
            returned: Arc::default(),
        }))
    }

    /// What a pass writes: the first of a picture when it begins, the last when it ends.
    pub(crate) fn writes(&self, is_first: bool, is_last: bool) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: is_first.then_some(0),
            end_of_pass_write_index: is_last.then_some(1),
        }
    }

    /// Records the way back of what a picture's passes wrote. Too many pictures under way are not timed.
    pub(crate) fn send_back(&mut self, encoder: &mut wgpu::CommandEncoder, effort: Effort) {
        let Some(slot) = self.free.pop() else { return };
        encoder.resolve_query_set(&self.queries, 0..2, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.slots[slot], 0, BYTES);
        let returned = Arc::clone(&self.returned);
        encoder.map_buffer_on_submit(&self.slots[slot], wgpu::MapMode::Read, .., move |outcome| {
            returned.lock().unwrap_or_else(PoisonError::into_inner)[slot] = Some(outcome.is_ok());
        });
        self.under_way.push_back((slot, effort));
    }

    /// Milliseconds of the oldest picture whose time has come back and was not given out, and its effort.
    pub(crate) fn next(&mut self, gpu: &Gpu) -> Option<(Effort, f32)> {
        let (slot, effort) = *self.under_way.front()?;
        // Only looks: a device that fails says so elsewhere.
        let _ = gpu.device().poll(wgpu::PollType::Poll);
        let is_whole = self.returned.lock().unwrap_or_else(PoisonError::into_inner)[slot].take()?;
        self.under_way.pop_front();
        self.free.push(slot);
        if !is_whole {
            return None;
        }
        let ticks = self.slots[slot].get_mapped_range(..).ok().map(|bytes| {
            let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(&bytes);
            stamps[1].saturating_sub(stamps[0])
        });
        self.slots[slot].unmap();
        let period_ns = f64::from(gpu.queue().get_timestamp_period());
        Some((effort, (ticks? as f64 * period_ns * 1e-6) as f32))
    }
}
