//! How long a picture takes: by timestamps of the device where it has them, and by the clock.
//!
//! What does not live here: what a picture looks up, which its shaders count ([`Renderer::count`]).

use std::time::{Duration, Instant};

use crate::device::Gpu;
use crate::error::GpuError;
use crate::renderer::Renderer;
use crate::upload::Volume;

/// How long a picture took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Took {
    /// From submission until it was there.
    pub wall: Duration,
    /// On the device alone; `None` if that has no timestamps, or the picture took more than one submission.
    pub device: Option<Duration>,
}

/// Runs what was prepared, and measures it.
///
/// # Errors
/// As [`Renderer::run`].
pub fn time(gpu: &Gpu, renderer: &mut Renderer, volume: &Volume) -> Result<Took, GpuError> {
    let device = gpu.device();
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    if !device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
        renderer.record(&mut encoder, volume)?;
        let (wall, _) = finished(gpu, encoder, renderer, volume)?;
        return Ok(Took { wall, device: None });
    }
    let descriptor =
        wgpu::QuerySetDescriptor { label: Some("nuage time"), ty: wgpu::QueryType::Timestamp, count: 2 };
    let queries = gpu.guarded(|| device.create_query_set(&descriptor))?;
    // Passes without work, before and behind: each notes the time at its beginning.
    let note = |encoder: &mut wgpu::CommandEncoder, query: u32| {
        let writes = wgpu::ComputePassTimestampWrites {
            query_set: &queries,
            beginning_of_pass_write_index: Some(query),
            end_of_pass_write_index: None,
        };
        let descriptor =
            wgpu::ComputePassDescriptor { label: Some("nuage time"), timestamp_writes: Some(writes) };
        encoder.begin_compute_pass(&descriptor);
    };
    note(&mut encoder, 0);
    renderer.record(&mut encoder, volume)?;
    note(&mut encoder, 1);
    let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
    let resolved = gpu.empty_buffer("nuage time", 16, usage)?;
    encoder.resolve_query_set(&queries, 0..2, &resolved, 0);
    let (wall, went_on) = finished(gpu, encoder, renderer, volume)?;
    if went_on {
        return Ok(Took { wall, device: None });
    }
    let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&gpu.read(&resolved)?);
    let period_ns = f64::from(gpu.queue().get_timestamp_period());
    let passed = ticks[1].saturating_sub(ticks[0]) as f64 * period_ns;
    Ok(Took { wall, device: Some(Duration::from_nanos(passed as u64)) })
}

/// Submits, waits, and finishes the picture. Gives the time that took, and whether the picture went on in other submissions.
fn finished(
    gpu: &Gpu,
    encoder: wgpu::CommandEncoder,
    renderer: &mut Renderer,
    volume: &Volume,
) -> Result<(Duration, bool), GpuError> {
    let commands = encoder.finish();
    let start = Instant::now();
    gpu.guarded(|| gpu.queue().submit([commands]))?;
    gpu.wait()?;
    let wall = start.elapsed();
    let went_on = renderer.finish(volume)?;
    Ok((if went_on { start.elapsed() } else { wall }, went_on))
}
