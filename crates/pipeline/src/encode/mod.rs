//! From the values of bricks to their codecs and words.
//!
//! [`quantize`] measures and writes one brick in each of the codecs of few bits, `sparse` those that are partly empty; [`seen`] weighs errors by what is seen of them; [`choose`] takes, brick by brick, the
//! cheapest that keeps to what was asked for. [`shapes`] are
//! what bricks share that are alike; [`block`] makes the texture blocks of graphics cards. The decoders, which say what the words mean, live in
//! [`nuage_volume::codec`].

mod bc4;
pub mod block;
pub mod choose;
pub mod quantize;
pub mod seen;
pub mod shapes;
mod sparse;
