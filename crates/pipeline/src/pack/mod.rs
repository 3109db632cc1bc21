//! From grids to packed volumes and back.
//!
//! Packing goes through a sequence up to three times. [`plan`] notes the range of each channel over all frames;
//! [`frame`] weighs what errors cost, where a ratio or a size is asked for, and then encodes each frame on its own;
//! [`assemble`] puts frames one after the other into a file, where what they have in common stands once. [`sequence`]
//! does one after the other. [`options`] is what is asked of it; [`append`] says how frames are added to a file that is
//! there, [`work`] keeps what is finished for a run that is taken up again. [`level`] makes the coarser levels of a tree, `light` tells how much of a brick is seen,
//! [`unpack`] makes grids of a packed frame again.
//!
//! A grid becomes a channel, a vector grid three. Values keep their meaning: a level set stays one. What does not
//! fit (points, strings, trees of other shapes) is named in a warning and left out. Which codec a brick gets is
//! [`crate::encode`]'s; the layout of trees and files is the volume crate's.

pub mod append;
pub mod assemble;
pub mod frame;
pub mod level;
mod light;
pub mod options;
pub mod plan;
pub mod sequence;
pub mod unpack;
pub mod work;
