//! Looking up sixteen values at once, in a slice and at places that differ from lane to lane.
//!
//! The only `unsafe` code of this crate. Processors with AVX2 or AVX-512 have instructions that gather under a mask, which makes
//! places outside of a slice as cheap as others.

#![cfg_attr(target_arch = "x86_64", expect(unsafe_code, reason = "instructions that gather take pointers"))]

use fearless_simd::{Simd, f32x16, i32x16, prelude::*, u32x16};
#[cfg(target_arch = "x86_64")]
use fearless_simd::{f32x8, i32x8, u32x8};

use crate::packet::each_ray;

/// Functions that look up the values at sixteen places of a slice, by the instructions of the processor.
macro_rules! gathers {
    ($($(#[$doc:meta])* $name:ident: [$value:ty] -> $wide:ident, $half:ident;)*) => {$(
        $(#[$doc])*
        #[inline(always)]
        pub(crate) fn $name<S: Simd>(simd: S, values: &[$value], at: i32x16<S>) -> $wide<S> {
            let at = at.to_array();
            #[cfg(target_arch = "x86_64")]
            if let Some(avx512) = simd.level().as_avx512() {
                let at = i32x16::simd_from(avx512, at);
                let found = $wide::simd_from(avx512, avx512::$name(avx512, values, at.into()));
                return $wide::simd_from(simd, found.to_array());
            }
            #[cfg(target_arch = "x86_64")]
            if let Some(avx2) = simd.level().as_avx2() {
                let (low, high) = i32x16::simd_from(avx2, at).split();
                let low = $half::simd_from(avx2, avx2::$name(avx2, values, low.into()));
                let high = $half::simd_from(avx2, avx2::$name(avx2, values, high.into()));
                return $wide::simd_from(simd, low.combine(high).to_array());
            }
            $wide::simd_from(simd, each_ray!(|lane| match values.get(at[lane] as u32 as usize) {
                Some(value) => (*value).into(),
                None => Default::default(),
            }))
        }
    )*};
}

gathers! {
    /// The numbers at places of a slice; 0 outside of it.
    gather_i32: [i32] -> i32x16, i32x8;
    /// The numbers at places of a slice; 0 outside of it.
    gather_f32: [f32] -> f32x16, f32x8;
    /// The numbers at places of a slice, whose last one may be taken for 0 if there is an odd number of them; 0 outside of it.
    gather_u16: [u16] -> u32x16, u32x8;
}

/// Asks for the lines of the cache in which values stand, so that they are near when they are looked up; on other processors
/// than x86-64 it asks for nothing.
#[inline(always)]
#[cfg_attr(not(target_arch = "x86_64"), expect(unused_variables, reason = "there is no such instruction"))]
pub(crate) fn prefetch<V>(values: &[V]) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        const LINE_BYTES: usize = 64;
        for line in 0..size_of_val(values).div_ceil(LINE_BYTES) {
            let place = values.as_ptr().cast::<i8>().wrapping_add(line * LINE_BYTES);
            // SAFETY: the instruction is a hint, which does nothing where there is no memory.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(place) }
        }
    }
}

/// The length of a slice as an index of lanes, which are signed.
#[cfg(target_arch = "x86_64")]
fn length(count: usize) -> i32 {
    i32::try_from(count).unwrap_or(i32::MAX)
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;

    use super::length;

    fearless_simd::kernel!(
        /// The lanes whose index is below a number.
        #[inline]
        fn below(token: Avx2, at: __m256i, end: i32) -> __m256i {
            let is_below = _mm256_cmpgt_epi32(_mm256_set1_epi32(end), at);
            _mm256_andnot_si256(_mm256_srai_epi32::<31>(at), is_below)
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_i32(token: Avx2, values: &[i32], at: __m256i) -> __m256i {
            let inside = below(token, at, length(values.len()));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice.
            unsafe { _mm256_mask_i32gather_epi32::<4>(_mm256_setzero_si256(), values.as_ptr(), at, inside) }
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_f32(token: Avx2, values: &[f32], at: __m256i) -> __m256 {
            let inside = _mm256_castsi256_ps(below(token, at, length(values.len())));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice.
            unsafe { _mm256_mask_i32gather_ps::<4>(_mm256_setzero_ps(), values.as_ptr(), at, inside) }
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_u16(token: Avx2, values: &[u16], at: __m256i) -> __m256i {
            let pair = _mm256_srli_epi32::<1>(at);
            let inside = below(token, pair, length(values.len() / 2));
            let pairs = values.as_ptr().cast();
            // SAFETY: of lanes in the mask, and only of these, memory is read: both values of a pair that the slice has. The
            // instruction asks for no alignment.
            let found =
                unsafe { _mm256_mask_i32gather_epi32::<4>(_mm256_setzero_si256(), pairs, pair, inside) };
            // On this kind of processor the first of a pair stands in the low bits.
            let shift = _mm256_slli_epi32::<4>(_mm256_and_si256(at, _mm256_set1_epi32(1)));
            _mm256_and_si256(_mm256_srlv_epi32(found, shift), _mm256_set1_epi32(0xffff))
        }
    );
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use std::arch::x86_64::*;

    use super::length;

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_i32(token: Avx512, values: &[i32], at: __m512i) -> __m512i {
            let inside = _mm512_cmplt_epu32_mask(at, _mm512_set1_epi32(length(values.len())));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice.
            unsafe { _mm512_mask_i32gather_epi32::<4>(_mm512_setzero_si512(), inside, at, values.as_ptr()) }
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_f32(token: Avx512, values: &[f32], at: __m512i) -> __m512 {
            let inside = _mm512_cmplt_epu32_mask(at, _mm512_set1_epi32(length(values.len())));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice.
            unsafe { _mm512_mask_i32gather_ps::<4>(_mm512_setzero_ps(), inside, at, values.as_ptr()) }
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_u16(token: Avx512, values: &[u16], at: __m512i) -> __m512i {
            let pair = _mm512_srli_epi32::<1>(at);
            let inside = _mm512_cmplt_epu32_mask(pair, _mm512_set1_epi32(length(values.len() / 2)));
            // SAFETY: of lanes in the mask, and only of these, memory is read: both values of a pair that the slice has. The
            // instruction asks for no alignment.
            let found = unsafe {
                _mm512_mask_i32gather_epi32::<4>(_mm512_setzero_si512(), inside, pair, values.as_ptr().cast())
            };
            // On this kind of processor the first of a pair stands in the low bits.
            let shift = _mm512_slli_epi32::<4>(_mm512_and_si512(at, _mm512_set1_epi32(1)));
            _mm512_and_si512(_mm512_srlv_epi32(found, shift), _mm512_set1_epi32(0xffff))
        }
    );
}

#[cfg(test)]
mod tests {
    use fearless_simd::dispatch;

    use super::*;
    use crate::hash::hash_u32;
    use crate::simd::levels;

    #[test]
    fn what_is_gathered_stands_in_the_slice() {
        for length in [0, 1, 2, 15, 512, 1024] {
            let halves: Vec<u16> = (0..length / 2 * 2).map(|i| hash_u32(i) as u16).collect();
            let whole: Vec<i32> = (0..length).map(|i| hash_u32(i) as i32).collect();
            let floats: Vec<f32> = whole.iter().map(|value| *value as f32).collect();
            for round in 0..200 {
                let at: [i32; 16] = std::array::from_fn(|lane| {
                    let random = hash_u32(round * 16 + lane as u32);
                    match random % 5 {
                        0 => random as i32,
                        1 => i32::try_from(length).unwrap() - (random as i32 & 1),
                        _ => (random >> 4) as i32 % (length as i32).max(1),
                    }
                });
                let expected = |lane: usize| usize::try_from(at[lane]).ok();
                for level in levels() {
                    let (i, f, h) = dispatch!(level, simd => {
                        let at = i32x16::simd_from(simd, at);
                        (
                            gather_i32(simd, &whole, at).to_array(),
                            gather_f32(simd, &floats, at).to_array(),
                            gather_u16(simd, &halves, at).to_array(),
                        )
                    });
                    for lane in 0..16 {
                        let inside = |i: &usize| *i < length as usize;
                        let place = expected(lane).filter(inside);
                        assert_eq!(i[lane], place.map_or(0, |at| whole[at]));
                        assert_eq!(f[lane], place.map_or(0.0, |at| floats[at]));
                        let half = place.and_then(|at| halves.get(at));
                        assert_eq!(h[lane], half.map_or(0, |half| u32::from(*half)));
                    }
                }
            }
        }
    }
}
