//! What NanoVDB nodes say of the active values in and below them: box, extremes, average, deviation.
//!
//! Of vectors, NanoVDB compares the squared lengths, and gives the average and deviation of those; so do we.
//! The statistics of whole grids that `.vdb` tools print live in [`crate::Statistics`].

use super::layout::{Kind, StatsLayout};
use crate::stats::{IndexBox, grow};
use crate::value::{Value, ValueMask};

/// A type of values that is written.
pub(super) trait NanoValue: Value {
    /// The type as which it is written in full width.
    const KIND: Kind;
    /// Whether there are statistics of the values beside their box.
    const HAS_STATS: bool = true;

    /// The number that extremes and averages are taken of.
    fn measure(self) -> f64;

    /// Whether the value counts as smaller.
    fn is_less(self, other: Self) -> bool {
        self.measure() < other.measure()
    }
}

impl NanoValue for f32 {
    const KIND: Kind = Kind::Float;

    fn measure(self) -> f64 {
        self.into()
    }
}

impl NanoValue for f64 {
    const KIND: Kind = Kind::Double;

    fn measure(self) -> f64 {
        self
    }
}

impl NanoValue for i32 {
    const KIND: Kind = Kind::Int32;

    fn measure(self) -> f64 {
        self.into()
    }
}

impl NanoValue for i64 {
    const KIND: Kind = Kind::Int64;

    fn measure(self) -> f64 {
        self as f64
    }

    // Doubles do not tell all of them apart.
    fn is_less(self, other: i64) -> bool {
        self < other
    }
}

impl NanoValue for [f32; 3] {
    const KIND: Kind = Kind::Vec3f;

    fn measure(self) -> f64 {
        self.iter().map(|x| x * x).sum::<f32>().into()
    }
}

impl NanoValue for [f64; 3] {
    const KIND: Kind = Kind::Vec3d;

    fn measure(self) -> f64 {
        self.iter().map(|x| x * x).sum()
    }
}

// Of bits there are no statistics beside the box.
impl NanoValue for bool {
    const KIND: Kind = Kind::Bool;
    const HAS_STATS: bool = false;

    fn measure(self) -> f64 {
        0.0
    }
}

impl NanoValue for ValueMask {
    const KIND: Kind = Kind::Mask;
    const HAS_STATS: bool = false;

    fn measure(self) -> f64 {
        0.0
    }
}

/// The active values of a part of a grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct NodeStats<V> {
    pub(super) bbox: Option<IndexBox>,
    /// The smallest and the largest value.
    pub(super) range: Option<[V; 2]>,
    count: u64,
    mean: f64,
    /// The sum of the squares of all distances from the mean.
    squares: f64,
}

impl<V: NanoValue> Default for NodeStats<V> {
    fn default() -> Self {
        NodeStats { bbox: None, range: None, count: 0, mean: 0.0, squares: 0.0 }
    }
}

impl<V: NanoValue> NodeStats<V> {
    /// Those of active voxels in a box.
    pub(super) fn of_voxels(values: impl Iterator<Item = V> + Clone, bbox: Option<IndexBox>) -> Self {
        let mut stats = NodeStats { bbox, ..NodeStats::default() };
        values.clone().for_each(|value| stats.stretch([value; 2]));
        stats.count = values.clone().count() as u64;
        if stats.count > 0 {
            stats.mean = values.clone().map(V::measure).sum::<f64>() / stats.count as f64;
            stats.squares = values.map(|value| (value.measure() - stats.mean).powi(2)).sum();
        }
        stats
    }

    /// Those of an active tile.
    pub(super) fn of_tile(value: V, origin: [i32; 3], log2_voxels: u32) -> Self {
        let last = origin.map(|c| c.wrapping_add((1 << log2_voxels) - 1));
        NodeStats {
            bbox: Some([origin, last]),
            range: Some([value; 2]),
            count: 1 << (3 * log2_voxels),
            mean: value.measure(),
            squares: 0.0,
        }
    }

    /// Adds those of another part.
    pub(super) fn add(&mut self, other: &Self) {
        if let Some([min, max]) = other.bbox {
            grow(&mut self.bbox, min, max);
        }
        if let Some(range) = other.range {
            self.stretch(range);
        }
        if other.count > 0 {
            let (mine, others) = (self.count as f64, other.count as f64);
            let all = mine + others;
            let distance = other.mean - self.mean;
            self.mean += distance * (others / all);
            self.squares += other.squares + distance * distance * mine * (others / all);
            self.count += other.count;
        }
    }

    /// Takes values into the range; one that is not a number stays only where there is no other.
    fn stretch(&mut self, [low, high]: [V; 2]) {
        let [min, max] = self.range.get_or_insert([low, high]);
        if low.is_less(*min) || min.measure().is_nan() {
            *min = low;
        }
        if max.is_less(high) || max.measure().is_nan() {
            *max = high;
        }
    }

    pub(super) fn average(&self) -> f64 {
        self.mean
    }

    pub(super) fn deviation(&self) -> f64 {
        if self.count < 2 { 0.0 } else { (self.squares / self.count as f64).sqrt() }
    }

    /// Writes range, average and deviation to a node's bytes; of no values nothing.
    pub(super) fn write_to(&self, bytes: &mut [u8], at: StatsLayout) {
        let Some([min, max]) = self.range else { return };
        let mut encoded = Vec::with_capacity(24);
        for (value, at) in [(min, at.min), (max, at.max)] {
            encoded.clear();
            value.append_to(&mut encoded);
            bytes[at..at + encoded.len()].copy_from_slice(&encoded);
        }
        for (number, begin) in [(self.average(), at.average), (self.deviation(), at.deviation)] {
            match at.deviation - at.average {
                8 => bytes[begin..begin + 8].copy_from_slice(&number.to_le_bytes()),
                _ => bytes[begin..begin + 4].copy_from_slice(&(number as f32).to_le_bytes()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn parts_add_up_to_the_whole(
            values in proptest::collection::vec(-10.0_f64..10.0, 2..200),
            cut in 0_usize..200, tile in -10.0_f64..10.0,
        ) {
            let cut = cut.min(values.len());
            let part = |values: &[f64]| NodeStats::of_voxels(values.iter().copied(), None);
            let mut sum = part(&values[..cut]);
            sum.add(&part(&values[cut..]));
            sum.add(&NodeStats::of_tile(tile, [8, -8, 0], 3));
            let all: Vec<f64> = values.iter().copied().chain([tile; 512]).collect();
            let whole = part(&all);
            prop_assert_eq!(sum.range, whole.range);
            prop_assert_eq!(sum.count, whole.count);
            prop_assert_eq!(sum.bbox, Some([[8, -8, 0], [15, -1, 7]]));
            prop_assert!((sum.average() - whole.average()).abs() < 1e-12);
            prop_assert!((sum.deviation() - whole.deviation()).abs() < 1e-12);
        }
    }

    #[test]
    fn ranges_skip_what_is_not_a_number_and_compare_vectors_by_length() {
        let stats = NodeStats::of_voxels([f32::NAN, 2.0, -1.0].into_iter(), None);
        assert_eq!(stats.range, Some([-1.0, 2.0]));
        let vectors =
            NodeStats::of_voxels([[3.0_f32, 4.0, 0.0], [-9.0, 0.0, 0.0], [1.0; 3]].into_iter(), None);
        assert_eq!(vectors.range, Some([[1.0; 3], [-9.0, 0.0, 0.0]]));
        assert_eq!(vectors.average(), (25.0 + 81.0 + 3.0) / 3.0);
        let far = NodeStats::of_voxels([i64::MAX - 1, i64::MAX, i64::MAX - 2].into_iter(), None);
        assert_eq!(far.range, Some([i64::MAX - 2, i64::MAX]));
    }
}
