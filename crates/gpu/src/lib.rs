//! The GPU renderer: the pictures of `nuage-render` by a device that wgpu reaches, from the bytes of a packed volume.
//!
//! [`device`] finds a device; [`arrays`] gathers the words of frames and [`upload`] takes them to the device, where
//! shaders decode bricks as they stand; [`build`] makes a volume of values that are on the device already; [`look`] says what a picture shows and how; [`renderer`] records passes into an
//! encoder, which may be a host's own; [`picture`] does all of it at once, [`measure`] says how long a picture takes. Shaders are files in `shader/`, made into text by `shader.rs`.
//!
//! Distances in shaders count from the middle of the volume in single precision: a camera further away than some ten
//! thousand times the volume's size sees it tremble.
//!
//! What does not live here: scenes, windows, files, and the reference that all this is held to (`nuage-render`).

#![forbid(unsafe_code)]

pub mod arrays;
mod blocks;
mod blue_noise;
mod budget;
pub mod build;
pub mod device;
pub mod error;
mod hdda;
mod light_volume;
pub mod look;
mod maps;
pub mod measure;
mod params;
pub mod picture;
pub mod real_time;
pub mod renderer;
mod rounds;
mod shader;
mod sky;
pub mod stream;
mod timer;
pub mod upload;

#[cfg(test)]
mod hostile;
#[cfg(test)]
mod twins;
