//! Finding a device and talking to it: by name or the best there is, with no window, or one that a host owns.
//!
//! What does not live here: buffers of volumes ([`crate::upload`]) and pipelines ([`crate::renderer`]).

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use crate::arrays::Bricks;
use crate::blocks;
use crate::error::GpuError;

/// Which device to use.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wanted {
    /// A graphics card if there is one, else whatever there is.
    Best,
    /// The first whose name holds this text, in any case.
    Name(String),
}

/// A device, its queue, and what it has complained of.
#[derive(Debug, Clone)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    name: String,
    fault: Arc<Mutex<Option<GpuError>>>,
    /// Whether it says so by itself when it is lost.
    is_own: bool,
    /// Whether textures of blocks are read right, once that was tried.
    reads_blocks: Arc<OnceLock<bool>>,
}

/// The names of all devices, the best first.
pub fn names() -> Vec<String> {
    adapters().iter().map(|adapter| adapter.get_info().name).collect()
}

/// All devices, the best first.
fn adapters() -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    adapters.sort_by_key(|adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    adapters
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// If there is none, or it does not open.
    pub fn open(wanted: &Wanted) -> Result<Gpu, GpuError> {
        let adapters = adapters();
        let name_of = |adapter: &wgpu::Adapter| adapter.get_info().name;
        let found = match wanted {
            Wanted::Best => adapters.first(),
            Wanted::Name(name) => {
                let name = name.to_lowercase();
                adapters.iter().find(|adapter| name_of(adapter).to_lowercase().contains(&name))
            }
        };
        let Some(adapter) = found else {
            let wanted = match wanted {
                Wanted::Best => None,
                Wanted::Name(name) => Some(name.clone()),
            };
            return Err(GpuError::NoDevice { wanted, found: adapters.iter().map(name_of).collect() });
        };
        // Everything runs within the limits of WebGPU; larger buffers are taken where the device has them.
        let offered = adapter.limits();
        let required_limits = wgpu::Limits {
            max_buffer_size: offered.max_buffer_size,
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            ..wgpu::Limits::default()
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("nuage"),
            required_features: adapter.features() & (wgpu::Features::TIMESTAMP_QUERY | blocks::NEEDED),
            required_limits,
            ..Default::default()
        };
        let opened = pollster::block_on(adapter.request_device(&descriptor));
        let (device, queue) = opened.map_err(|error| GpuError::Device(error.to_string()))?;
        let gpu = Gpu { is_own: true, ..Gpu::from_host(device, queue, name_of(adapter)) };
        // A device of our own tells us of its faults; by default they would end the program.
        let fault = Arc::clone(&gpu.fault);
        gpu.device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| keep(&fault, fault_of(&error))));
        let fault = Arc::clone(&gpu.fault);
        gpu.device.set_device_lost_callback(move |_, _| keep(&fault, GpuError::Lost));
        Ok(gpu)
    }

    /// A device that somebody else opened and goes on using. Its handlers of faults stay as they are.
    pub fn from_host(device: wgpu::Device, queue: wgpu::Queue, name: String) -> Gpu {
        Gpu { device, queue, name, fault: Arc::default(), is_own: false, reads_blocks: Arc::default() }
    }

    /// The name of the device.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The device itself.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// Its queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// How bricks take the least memory on this device: [`Bricks::Textures`] if it reads such textures right, which is tried
    /// once, else [`Bricks::AsStored`].
    ///
    /// # Errors
    /// If the device fails.
    pub fn smallest_bricks(&self) -> Result<Bricks, GpuError> {
        let reads = match self.reads_blocks.get() {
            Some(known) => *known,
            None => {
                let found = blocks::are_read(self)?;
                *self.reads_blocks.get_or_init(|| found)
            }
        };
        Ok(if reads { Bricks::Textures } else { Bricks::AsStored })
    }

    /// Does something with the device, whose complaints become errors.
    ///
    /// # Errors
    /// If the device is lost, runs out of memory, or refuses something.
    pub(crate) fn guarded<T>(&self, run: impl FnOnce() -> T) -> Result<T, GpuError> {
        self.health()?;
        let (result, complaint) = self.heard(run);
        match complaint {
            // What is made of a lost device is refused later, for no reason that helps.
            Some(wgpu::Error::Validation { .. }) if self.is_lost() => Err(GpuError::Lost),
            Some(error) => Err(fault_of(&error)),
            None => self.health().map(|()| result),
        }
    }

    /// Does something with the device, and hears what it complains of.
    fn heard<T>(&self, run: impl FnOnce() -> T) -> (T, Option<wgpu::Error>) {
        let filters =
            [wgpu::ErrorFilter::OutOfMemory, wgpu::ErrorFilter::Internal, wgpu::ErrorFilter::Validation];
        let scopes = filters.map(|filter| self.device.push_error_scope(filter));
        let result = run();
        let mut found = None;
        // The scope that was opened last closes first.
        for scope in scopes.into_iter().rev() {
            found = pollster::block_on(scope.pop()).or(found);
        }
        (result, found)
    }

    /// Whether the device is lost. Only who opened it may be told so by itself; what it then makes is refused without a
    /// word, and so is found out by using it.
    fn is_lost(&self) -> bool {
        let descriptor = wgpu::BufferDescriptor {
            label: Some("nuage probe"),
            size: wgpu::COPY_BUFFER_ALIGNMENT,
            usage: wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        };
        let probe = || {
            let buffer = self.device.create_buffer(&descriptor);
            self.queue.write_buffer(&buffer, 0, &[0; wgpu::COPY_BUFFER_ALIGNMENT as usize]);
        };
        matches!(self.heard(probe).1, Some(wgpu::Error::Validation { .. }))
    }

    /// Whether the device still works.
    ///
    /// # Errors
    /// Its first complaint since it was opened.
    pub fn health(&self) -> Result<(), GpuError> {
        self.fault.lock().unwrap_or_else(PoisonError::into_inner).clone().map_or(Ok(()), Err)
    }

    /// Waits until the device has done all that was submitted.
    ///
    /// # Errors
    /// If it is lost, or complained of something.
    pub fn wait(&self) -> Result<(), GpuError> {
        // wgpu panics where a wait is what finds the device lost.
        let poll = AssertUnwindSafe(|| self.device.poll(wgpu::PollType::wait_indefinitely()));
        let waited = catch_unwind(poll).map_err(|_| GpuError::Lost)?;
        waited.map_err(|error| GpuError::Device(error.to_string()))?;
        self.health()?;
        if !self.is_own && self.is_lost() { Err(GpuError::Lost) } else { Ok(()) }
    }

    /// A buffer of these bytes.
    ///
    /// # Errors
    /// If the device has no memory left.
    pub(crate) fn buffer(
        &self,
        label: &str,
        bytes: &[u8],
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, GpuError> {
        let buffer = self.empty_buffer(label, bytes.len() as u64, usage | wgpu::BufferUsages::COPY_DST)?;
        self.guarded(|| self.queue.write_buffer(&buffer, 0, bytes))?;
        Ok(buffer)
    }

    /// A buffer of zeros.
    ///
    /// # Errors
    /// If the device has no memory left.
    pub(crate) fn empty_buffer(
        &self,
        label: &str,
        size: u64,
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer, GpuError> {
        let descriptor =
            wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        self.guarded(|| self.device.create_buffer(&descriptor))
    }

    /// The bytes of a buffer, which must be a source of copies, once all that was submitted is done.
    ///
    /// # Errors
    /// If the device is lost or has no memory left.
    pub fn read(&self, buffer: &wgpu::Buffer) -> Result<Vec<u8>, GpuError> {
        self.read_range(buffer, 0..buffer.size())
    }

    /// As [`Gpu::read`], of some of the bytes, from one multiple of four to another.
    pub(crate) fn read_range(&self, buffer: &wgpu::Buffer, range: Range<u64>) -> Result<Vec<u8>, GpuError> {
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let size = range.end - range.start;
        let staging = self.empty_buffer("nuage read-back", size, usage)?;
        self.guarded(|| {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(buffer, range.start, &staging, 0, size);
            self.queue.submit([encoder.finish()]);
        })?;
        let mapped: Arc<Mutex<Option<Result<(), wgpu::BufferAsyncError>>>> = Arc::default();
        let result = Arc::clone(&mapped);
        self.guarded(|| {
            staging.slice(..).map_async(wgpu::MapMode::Read, move |outcome| {
                *result.lock().unwrap_or_else(PoisonError::into_inner) = Some(outcome);
            });
        })?;
        self.wait()?;
        let outcome = mapped.lock().unwrap_or_else(PoisonError::into_inner).take();
        if !matches!(outcome, Some(Ok(()))) {
            return Err(GpuError::Device("a buffer could not be read back".to_owned()));
        }
        let range = staging.slice(..).get_mapped_range();
        let range = range.map_err(|error| GpuError::Device(error.to_string()))?;
        Ok(range.to_vec())
    }
}

/// Keeps the first fault.
fn keep(fault: &Mutex<Option<GpuError>>, error: GpuError) {
    fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
}

/// What a complaint comes to.
fn fault_of(error: &wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { .. } => GpuError::OutOfMemory,
        error => GpuError::Device(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// More than any machine has, in one piece, which is refused before it is touched.
    #[test]
    fn no_memory_left_is_an_error_and_not_the_end() {
        let Some(gpu) = crate::twins::gpu() else { return };
        let side = gpu.device().limits().max_texture_dimension_3d;
        let descriptor = wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d { width: side, height: side, depth_or_array_layers: side },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format: wgpu::TextureFormat::Rgba32Float,
            usage: wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        };
        let made = gpu.guarded(|| gpu.device().create_texture(&descriptor)).map(drop);
        assert_eq!(made, Err(GpuError::OutOfMemory));
        let bytes: Vec<u8> = (0..64).collect();
        let buffer = gpu.buffer("small", &bytes, wgpu::BufferUsages::COPY_SRC).expect("a small buffer");
        assert_eq!(gpu.read(&buffer), Ok(bytes));
    }
}
