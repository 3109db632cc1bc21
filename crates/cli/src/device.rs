//! `--device`: the processor, or a GPU by name or the best there is. What it renders is the library's.

use crate::error::Failure;

#[cfg(feature = "gpu")]
pub(crate) use nuage_gpu::device::Gpu;

/// Without the feature `gpu` there is none.
#[cfg(not(feature = "gpu"))]
pub(crate) enum Gpu {}

/// The GPU that is asked for; `None` for the processor.
///
/// # Errors
/// If there is no such device.
pub(crate) fn open(name: &str) -> Result<Option<Gpu>, Failure> {
    match name {
        "cpu" => Ok(None),
        name => open_gpu(name).map(Some),
    }
}

#[cfg(feature = "gpu")]
fn open_gpu(name: &str) -> Result<Gpu, Failure> {
    use nuage_gpu::device::Wanted;
    let wanted = if name == "gpu" { Wanted::Best } else { Wanted::Name(name.to_owned()) };
    Gpu::open(&wanted).map_err(|error| Failure::Usage(format!("--device {name}: {error}")))
}

#[cfg(not(feature = "gpu"))]
fn open_gpu(name: &str) -> Result<Gpu, Failure> {
    Err(Failure::Usage(format!(
        "--device {name}: this program was built without the GPU renderer; build it with --features gpu"
    )))
}
