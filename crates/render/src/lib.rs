//! The CPU renderer: the reference that every other renderer of the project is held to.
//!
//! [`scene`] says what is rendered, [`light`] what lights it, and [`camera`] from where; [`traverse`] walks rays through the packed tree;
//! [`blocks`] keeps
//! decoded bricks, [`lod`] makes coarser levels; [`packet`] follows sixteen rays at once; [`march`] integrates light along them;
//! [`path`] follows it through any number of scatterings;
//! [`picture`] runs both over all pixels in the order of [`tiling`], and [`progressive`] paths in passes, until a picture is good enough;
//! [`checkpoint`] keeps one that is not; [`framing`] finds views and
//! densities for volumes that nobody described; [`film`] and [`output`] hold and encode pictures. Physics in
//! small functions: [`phase`], [`envmap`], [`color`], [`math`]; random numbers: [`hash`], [`sampler`].
//!
//! Light is scene-linear Rec.709 in f32 throughout. Distances are world lengths, steps are voxels.
//!
//! What does not live here: files, sequences, the import of grids and the program.

pub mod blocks;
pub mod camera;
pub mod checkpoint;
pub mod color;
pub mod depth;
pub mod envmap;
pub mod film;
pub mod filter;
#[cfg(test)]
mod fixtures;
pub mod framing;
mod gather;
pub mod hash;
pub mod light;
pub mod lod;
pub mod march;
pub mod math;
pub mod output;
pub mod packet;
pub mod path;
pub mod phase;
pub mod picture;
pub mod progressive;
pub mod sampler;
pub mod scene;
mod shade;
mod simd;
mod solid;
pub mod surface;
pub mod tiling;
pub mod track;
pub mod traverse;
pub mod views;
mod walk;
