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

/// All that this crate tells apart and the processor has, the least first.
#[cfg(test)]
pub(crate) fn levels() -> Vec<Level> {
    let mut levels = vec![Level::baseline()];
    #[cfg(target_arch = "x86_64")]
    levels.extend(level().as_avx2().map(fearless_simd::Simd::level));
    levels.push(level());
    levels
}

/// An array of what an expression gives for each of eight lanes.
///
/// A macro: functions such as `array::map` are not always inlined where the vector instructions are known, and a call for each
/// lane costs more than what it does.
macro_rules! each_lane {
    (|$lane:ident| $value:expr) => {
        each_lane!(@ $lane, $value, 0 1 2 3 4 5 6 7)
    };
    (@ $lane:ident, $value:expr, $($number:literal)*) => {
        [$({ let $lane: usize = $number; $value }),*]
    };
}
pub(crate) use each_lane;
