//! Which vector instructions loops are compiled for and which the processor has.
//!
//! Vector code of this crate multiplies and adds in the order of the scalar code and never fuses the two, in eight lanes on
//! every processor: all levels give the same bits.

use std::sync::LazyLock;

use fearless_simd::Level;

static LEVEL: LazyLock<Level> = LazyLock::new(Level::new);

/// What the processor can do.
pub(crate) fn level() -> Level {
    *LEVEL
}
