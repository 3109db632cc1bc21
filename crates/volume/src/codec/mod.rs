//! How the values of bricks are packed into fewer bytes, as far as reading goes.
//!
//! What does not live here: packing itself, which is the pipeline's.

pub mod block;
