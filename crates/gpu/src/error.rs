//! What can go wrong between a scene and its picture on a GPU, by whose fault it is.

use nuage_volume::codec::DecodeError;

/// An error of the GPU renderer.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GpuError {
    /// There is no device, or none of the name that was asked for.
    #[error("no GPU {}: {}", wanted.as_ref().map_or("was found".to_owned(), |name| format!("is named '{name}'")), hint(found))]
    NoDevice {
        /// The name that was asked for.
        wanted: Option<String>,
        /// The names of those that are there.
        found: Vec<String>,
    },
    /// The device is lost: it was taken away, reset, or destroyed. Nothing that it held is left.
    #[error("the GPU is lost: open it again, and give it anew what it held")]
    Lost,
    /// The device has no memory left.
    #[error("the GPU has no memory left: take fewer frames or smaller pictures, or end what else uses it")]
    OutOfMemory,
    /// The device or its driver failed: it refuses what it should take.
    #[error("the GPU failed: {0}")]
    Device(String),
    /// The volume is damaged.
    #[error("a brick cannot be decoded: {0}")]
    Malformed(#[from] DecodeError),
    /// The scene has something that this renderer cannot draw.
    #[error("the GPU renderer does not draw {feature}; --device cpu does")]
    Unsupported {
        /// What it is, as a noun.
        feature: &'static str,
    },
    /// Something is too large for the device.
    #[error("{what} of {size_bytes} bytes exceeds the {limit_bytes} that this GPU takes")]
    Limit {
        /// What is too large.
        what: &'static str,
        /// Its size.
        size_bytes: u64,
        /// What the device takes.
        limit_bytes: u64,
    },
    /// The caller asked for what makes no sense.
    #[error("{0}")]
    Misuse(String),
}

/// What to do about a device that is not there.
fn hint(found: &[String]) -> String {
    match found {
        [] => "install a driver for Vulkan, Metal or Direct3D 12, such as mesa-vulkan-drivers (lavapipe needs no \
               graphics card), and set XDG_RUNTIME_DIR where that driver asks for it"
            .to_owned(),
        found => format!("there is {}", found.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_say_how_to_mend_it() {
        let nothing = GpuError::NoDevice { wanted: None, found: Vec::new() }.to_string();
        assert!(nothing.contains("no GPU was found") && nothing.contains("mesa-vulkan-drivers"), "{nothing}");
        let found = vec!["a".to_owned(), "b".to_owned()];
        let other = GpuError::NoDevice { wanted: Some("x".to_owned()), found }.to_string();
        assert_eq!(other, "no GPU is named 'x': there is a, b");
    }
}
