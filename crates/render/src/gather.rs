//! Looking up sixteen values at once, in a slice and at places that differ from lane to lane.
//!
//! The only `unsafe` code of this crate. Processors with AVX-512 have instructions that gather under a mask, which makes places
//! outside of a slice as cheap as others. What AVX2 has is no faster than single loads.

#![cfg_attr(target_arch = "x86_64", expect(unsafe_code, reason = "instructions that gather take pointers"))]

use fearless_simd::{Simd, f32x16, i32x16, prelude::*, u32x16};

use crate::packet::each_ray;

/// The numbers at places of a slice; 0 outside of it.
#[inline(always)]
pub(crate) fn gather_i32<S: Simd>(simd: S, values: &[i32], at: i32x16<S>) -> i32x16<S> {
    #[cfg(target_arch = "x86_64")]
    if let Some(avx512) = simd.level().as_avx512() {
        let at = i32x16::simd_from(avx512, at.to_array());
        let found = i32x16::simd_from(avx512, avx512::gather_i32(avx512, values, at.into()));
        return i32x16::simd_from(simd, found.to_array());
    }
    let at = at.to_array();
    i32x16::simd_from(simd, each_ray!(|lane| values.get(at[lane] as u32 as usize).copied().unwrap_or(0)))
}

/// The numbers at places of a slice; 0 outside of it.
#[inline(always)]
pub(crate) fn gather_f32<S: Simd>(simd: S, values: &[f32], at: i32x16<S>) -> f32x16<S> {
    #[cfg(target_arch = "x86_64")]
    if let Some(avx512) = simd.level().as_avx512() {
        let at = i32x16::simd_from(avx512, at.to_array());
        let found = f32x16::simd_from(avx512, avx512::gather_f32(avx512, values, at.into()));
        return f32x16::simd_from(simd, found.to_array());
    }
    let at = at.to_array();
    f32x16::simd_from(simd, each_ray!(|lane| values.get(at[lane] as u32 as usize).copied().unwrap_or(0.0)))
}

/// The numbers at places of a slice of an even length, whose last one does not count if it is not; 0 outside of it.
#[inline(always)]
pub(crate) fn gather_u16<S: Simd>(simd: S, values: &[u16], at: i32x16<S>) -> u32x16<S> {
    let pairs = values.as_chunks::<2>().0;
    #[cfg(target_arch = "x86_64")]
    if let Some(avx512) = simd.level().as_avx512() {
        let at = i32x16::simd_from(avx512, at.to_array());
        let found = u32x16::simd_from(avx512, avx512::gather_u16(avx512, pairs, at.into()));
        return u32x16::simd_from(simd, found.to_array());
    }
    let at = at.to_array();
    let found = each_ray!(|lane| {
        let at = at[lane] as u32 as usize;
        pairs.get(at / 2).map_or(0, |pair| u32::from(pair[at % 2]))
    });
    u32x16::simd_from(simd, found)
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

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use std::arch::x86_64::*;

    /// Indices of lanes are signed.
    fn length<T>(values: &[T]) -> i32 {
        i32::try_from(values.len()).unwrap_or(i32::MAX)
    }

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_i32(token: Avx512, values: &[i32], at: __m512i) -> __m512i {
            let inside = _mm512_cmplt_epu32_mask(at, _mm512_set1_epi32(length(values)));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice.
            unsafe { _mm512_mask_i32gather_epi32::<4>(_mm512_setzero_si512(), inside, at, values.as_ptr()) }
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_f32(token: Avx512, values: &[f32], at: __m512i) -> __m512 {
            let inside = _mm512_cmplt_epu32_mask(at, _mm512_set1_epi32(length(values)));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice.
            unsafe { _mm512_mask_i32gather_ps::<4>(_mm512_setzero_ps(), inside, at, values.as_ptr()) }
        }
    );

    fearless_simd::kernel!(
        #[inline]
        pub(super) fn gather_u16(token: Avx512, pairs: &[[u16; 2]], at: __m512i) -> __m512i {
            let pair = _mm512_srli_epi32::<1>(at);
            let inside = _mm512_cmplt_epu32_mask(pair, _mm512_set1_epi32(length(pairs)));
            // SAFETY: of lanes in the mask, and only of these, memory is read, and they are indices of the slice. The
            // instruction asks for no alignment.
            let found = unsafe {
                _mm512_mask_i32gather_epi32::<4>(_mm512_setzero_si512(), inside, pair, pairs.as_ptr().cast())
            };
            // On this kind of processor the first of a pair stands in the low bits.
            let shift = _mm512_slli_epi32::<4>(_mm512_and_si512(at, _mm512_set1_epi32(1)));
            _mm512_and_si512(_mm512_srlv_epi32(found, shift), _mm512_set1_epi32(0xffff))
        }
    );
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use crate::hash::hash_u32;

    #[test]
    fn what_is_gathered_stands_in_the_slice() {
        for length in [0, 1, 2, 15, 512, 1024] {
            let halves: Vec<u16> = (0..length).map(|i| hash_u32(i) as u16).collect();
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
                for level in [Level::baseline(), Level::new()] {
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
                        let even = place.filter(|at| *at < length as usize / 2 * 2);
                        assert_eq!(h[lane], even.map_or(0, |at| u32::from(halves[at])));
                    }
                }
            }
        }
    }
}
