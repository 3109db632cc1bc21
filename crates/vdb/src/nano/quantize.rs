//! Codes of quantised leaves: floats as whole numbers of 1 to 16 bits, counted in quanta from the leaf's
//! minimum.
//!
//! A code stands for `minimum + code * quantum`, in single precision. Where minimum and codes stand in a leaf
//! is said in `layout`.

use super::layout::code_bytes;
use crate::tree::LEAF_VOXELS;

/// How a leaf maps values to codes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Quantizer {
    pub(super) minimum: f32,
    pub(super) quantum: f32,
    pub(super) bits: u32,
    /// Codes per unit of value.
    scale: f64,
}

impl Quantizer {
    /// The mapping that covers all values of a leaf with codes of that many bits, 16 at most. `None` if they
    /// are not all finite, or further apart than a float can say.
    pub(super) fn covering(values: &[f32], bits: u32) -> Option<Self> {
        let minimum = values.iter().copied().fold(f32::INFINITY, f32::min);
        let maximum = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let range = maximum - minimum;
        if !range.is_finite() || values.iter().any(|value| value.is_nan()) {
            return None;
        }
        let last_code = Self::last_code(bits);
        let quantum = range / last_code as f32;
        let scale = if range > 0.0 { f64::from(last_code) / f64::from(range) } else { 0.0 };
        Some(Quantizer { minimum, quantum, bits, scale })
    }

    fn last_code(bits: u32) -> u32 {
        (1 << bits) - 1
    }

    /// The code of the nearest value that has one.
    pub(super) fn code(&self, value: f32) -> u32 {
        let code = self.scale * f64::from(value - self.minimum) + 0.5;
        (code as u32).min(Self::last_code(self.bits))
    }

    /// The value that a code stands for.
    pub(super) fn value(&self, code: u32) -> f32 {
        code as f32 * self.quantum + self.minimum
    }

    /// The value that is stored for this one.
    pub(super) fn round(&self, value: f32) -> f32 {
        self.value(self.code(value))
    }
}

/// The fewest bits, of 1, 2, 4, 8 and 16, whose codes keep all values of a leaf within that error, or 16 if
/// none do. `None` as in [`Quantizer::covering`].
pub(super) fn narrowest(values: &[f32], max_error: f32) -> Option<Quantizer> {
    for bits in [1, 2, 4, 8] {
        let quantizer = Quantizer::covering(values, bits)?;
        if values.iter().all(|value| (quantizer.round(*value) - value).abs() <= max_error) {
            return Some(quantizer);
        }
    }
    Quantizer::covering(values, 16)
}

/// Writes the codes of a leaf, the first in the lowest bits.
///
/// # Panics
/// If the bits are not 1, 2, 4, 8 or 16 or the bytes not as many as 512 codes take.
pub(super) fn pack(codes: impl Iterator<Item = u32>, bits: u32, bytes: &mut [u8]) {
    assert!(matches!(bits, 1 | 2 | 4 | 8 | 16) && bytes.len() == code_bytes(bits));
    bytes.fill(0);
    for (i, code) in codes.take(LEAF_VOXELS).enumerate() {
        let at = i * bits as usize;
        let shifted = code << (at % 8);
        bytes[at / 8] |= shifted as u8;
        if bits == 16 {
            bytes[at / 8 + 1] = (shifted >> 8) as u8;
        }
    }
}

/// Code `i` of a leaf.
///
/// # Panics
/// As [`pack`], and past the last code.
pub(super) fn unpack(bytes: &[u8], bits: u32, i: usize) -> u32 {
    match bits {
        16 => u16::from_le_bytes([bytes[2 * i], bytes[2 * i + 1]]).into(),
        _ => {
            let at = i * bits as usize;
            u32::from(bytes[at / 8]) >> (at % 8) & ((1 << bits) - 1)
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
        fn codes_come_back(codes in proptest::collection::vec(any::<u16>(), LEAF_VOXELS), log2 in 0_u32..5) {
            let bits = 1 << log2;
            let codes: Vec<u32> = codes.iter().map(|code| u32::from(*code) & ((1 << bits) - 1)).collect();
            let mut bytes = vec![0xff; code_bytes(bits)];
            pack(codes.iter().copied(), bits, &mut bytes);
            let unpacked: Vec<u32> = (0..LEAF_VOXELS).map(|i| unpack(&bytes, bits, i)).collect();
            prop_assert_eq!(unpacked, codes);
        }

        #[test]
        fn no_value_moves_by_more_than_half_a_quantum(
            values in proptest::collection::vec(-1000.0_f32..1000.0, 512),
            bits in prop::sample::select(vec![4, 8, 16]),
        ) {
            let quantizer = Quantizer::covering(&values, bits).unwrap();
            for value in values {
                // The range, the quantum, their product and the sum are each rounded at magnitudes of up to 2000.
                let most = 0.5001 * quantizer.quantum + 4.0 * 1000.0 * f32::EPSILON;
                prop_assert!((quantizer.round(value) - value).abs() <= most);
            }
        }

        #[test]
        fn the_narrowest_codes_keep_to_the_error(
            values in proptest::collection::vec(0.0_f32..1.0, 512), max_error in 0.0001_f32..0.6,
        ) {
            let quantizer = narrowest(&values, max_error).unwrap();
            for value in &values {
                prop_assert!((quantizer.round(*value) - value).abs() <= max_error);
            }
            if quantizer.bits > 1 {
                let narrower = Quantizer::covering(&values, quantizer.bits / 2).unwrap();
                prop_assert!(values.iter().any(|value| (narrower.round(*value) - value).abs() > max_error));
            }
        }
    }

    #[test]
    fn constant_leaves_are_exact_and_others_without_a_range_refused() {
        for bits in [1, 4, 8, 16] {
            let quantizer = Quantizer::covering(&[0.7; 512], bits).unwrap();
            assert_eq!((quantizer.round(0.7), quantizer.code(0.7)), (0.7, 0));
        }
        for wrong in [[f32::NAN, 0.0], [f32::INFINITY, 0.0], [f32::MAX, f32::MIN]] {
            assert_eq!(Quantizer::covering(&wrong, 8), None);
            assert_eq!(narrowest(&wrong, 0.1), None);
        }
        assert_eq!(narrowest(&[0.0, 1.0], 0.0).unwrap().bits, 1);
        let tiny = Quantizer::covering(&[0.0, 1e-45], 16).unwrap();
        assert!(tiny.code(1e-45) <= 65535 && tiny.round(1e-45).is_finite());
    }
}
