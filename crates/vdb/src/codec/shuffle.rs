//! Blosc's two filters, which regroup a block before it is compressed: the byte shuffle both ways, the bit shuffle
//! as it is undone.
//!
//! The byte shuffle stores byte 0 of all elements, then byte 1 of all elements, and so on. The bit shuffle
//! does the same with bits: bit 0 of byte 0 of all elements, packed eight to a byte with the first element
//! in the lowest bit, then bit 1, … Bytes beyond the last whole element stay where they are.

/// Undoes the byte shuffle of elements of `typesize` bytes (at least 1). Both slices have the same length.
pub(super) fn unshuffle_bytes(typesize: usize, src: &[u8], out: &mut [u8]) {
    let count = src.len() / typesize;
    let (planes, rest) = src.split_at(count * typesize);
    let (elements, out_rest) = out.split_at_mut(count * typesize);
    out_rest.copy_from_slice(rest);
    if count == 0 {
        return;
    }
    match typesize {
        2 => unshuffle_2(planes, elements),
        4 => unshuffle_4(planes, elements),
        _ => {
            for (byte, plane) in planes.chunks_exact(count).enumerate() {
                for (element, &value) in elements.chunks_exact_mut(typesize).zip(plane) {
                    element[byte] = value;
                }
            }
        }
    }
}

fn unshuffle_2(planes: &[u8], elements: &mut [u8]) {
    let (p0, p1) = planes.split_at(planes.len() / 2);
    for ((out, &a), &b) in elements.as_chunks_mut::<2>().0.iter_mut().zip(p0).zip(p1) {
        *out = u16::from_le_bytes([a, b]).to_le_bytes();
    }
}

/// Pairs the bytes of two planes in a strip, then pairs those pairs: the compiler makes better vector code of
/// these loops than of one loop over all four planes.
fn unshuffle_4(planes: &[u8], elements: &mut [u8]) {
    const STRIP: usize = 64;
    let (p01, p23) = planes.split_at(planes.len() / 2);
    let (p0, p1) = p01.split_at(p01.len() / 2);
    let (p2, p3) = p23.split_at(p23.len() / 2);
    let (mut low, mut high) = ([0; STRIP], [0; STRIP]);
    let pair = |pairs: &mut [u16; STRIP], a: &[u8], b: &[u8]| {
        for ((pair, &a), &b) in pairs.iter_mut().zip(a).zip(b) {
            *pair = u16::from_le_bytes([a, b]);
        }
    };
    let strips = p0.chunks(STRIP).zip(p1.chunks(STRIP)).zip(p2.chunks(STRIP)).zip(p3.chunks(STRIP));
    for (out, (((a, b), c), d)) in elements.chunks_mut(4 * STRIP).zip(strips) {
        pair(&mut low, a, b);
        pair(&mut high, c, d);
        for ((out, &low), &high) in out.as_chunks_mut::<4>().0.iter_mut().zip(&low).zip(&high) {
            *out = (u32::from(low) | u32::from(high) << 16).to_le_bytes();
        }
    }
}

/// The byte shuffle of whole elements of `typesize` bytes (at least 1). Both slices have the same length.
pub(super) fn shuffle_bytes(typesize: usize, src: &[u8], out: &mut [u8]) {
    let count = src.len() / typesize;
    if count == 0 {
        return;
    }
    match typesize {
        2 => shuffle_array::<2>(src, out),
        4 => shuffle_4(src, out),
        8 => shuffle_array::<8>(src, out),
        _ => {
            for (byte, plane) in out.chunks_exact_mut(count).enumerate() {
                for (value, element) in plane.iter_mut().zip(src.chunks_exact(typesize)) {
                    *value = element[byte];
                }
            }
        }
    }
}

fn shuffle_array<const N: usize>(src: &[u8], out: &mut [u8]) {
    let elements = src.as_chunks::<N>().0;
    for (byte, plane) in out.chunks_exact_mut(elements.len()).enumerate() {
        for (value, element) in plane.iter_mut().zip(elements) {
            *value = element[byte];
        }
    }
}

/// Takes pairs apart in a strip and then the bytes of the pairs, as [`unshuffle_4`] does the reverse.
fn shuffle_4(src: &[u8], out: &mut [u8]) {
    const STRIP: usize = 64;
    let count = src.len() / 4;
    let (p01, p23) = out.split_at_mut(2 * count);
    let (p0, p1) = p01.split_at_mut(count);
    let (p2, p3) = p23.split_at_mut(count);
    let (mut low, mut high) = ([0_u16; STRIP], [0_u16; STRIP]);
    let unpair = |pairs: &[u16; STRIP], a: &mut [u8], b: &mut [u8]| {
        for ((pair, a), b) in pairs.iter().zip(a).zip(b) {
            [*a, *b] = pair.to_le_bytes();
        }
    };
    let planes =
        p0.chunks_mut(STRIP).zip(p1.chunks_mut(STRIP)).zip(p2.chunks_mut(STRIP)).zip(p3.chunks_mut(STRIP));
    for (elements, (((a, b), c), d)) in src.chunks(4 * STRIP).zip(planes) {
        for ((element, low), high) in elements.as_chunks::<4>().0.iter().zip(&mut low).zip(&mut high) {
            let element = u32::from_le_bytes(*element);
            (*low, *high) = (element as u16, (element >> 16) as u16);
        }
        unpair(&low, a, b);
        unpair(&high, c, d);
    }
}

/// Undoes the bit shuffle of elements of `typesize` bytes (at least 1). Both slices have the same length.
///
/// Blosc 1 shuffles bits only where the number of whole elements is a multiple of 8; other blocks it leaves
/// as they are, and so does this.
pub(super) fn unshuffle_bits(typesize: usize, src: &[u8], out: &mut [u8]) {
    let count = src.len() / typesize;
    if count == 0 || !count.is_multiple_of(8) {
        out.copy_from_slice(src);
        return;
    }
    let row = count / 8;
    let (rows, rest) = src.split_at(count * typesize);
    let (elements, out_rest) = out.split_at_mut(count * typesize);
    out_rest.copy_from_slice(rest);
    for (byte, rows) in rows.chunks_exact(8 * row).enumerate() {
        for (column, group) in elements.chunks_exact_mut(8 * typesize).enumerate() {
            let bits = std::array::from_fn(|bit| rows[bit * row + column]);
            for (element, value) in transpose_8x8(bits).into_iter().enumerate() {
                group[element * typesize + byte] = value;
            }
        }
    }
}

/// Bit `c` of byte `r` becomes bit `r` of byte `c`.
fn transpose_8x8(rows: [u8; 8]) -> [u8; 8] {
    let mut bits = u64::from_le_bytes(rows);
    // Swap across the diagonal in 2×2 squares of single bits, then of 2×2, then of 4×4 bits. The mask holds
    // the bits that move up by `shift`.
    for (shift, mask) in
        [(7, 0x00aa_00aa_00aa_00aa), (14, 0x0000_cccc_0000_cccc), (28, 0x0000_0000_f0f0_f0f0)]
    {
        let differing = (bits ^ bits >> shift) & mask;
        bits ^= differing ^ differing << shift;
    }
    bits.to_le_bytes()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The byte shuffle, element by element from its definition.
    fn plainly_shuffled_bytes(typesize: usize, src: &[u8]) -> Vec<u8> {
        let count = src.len() / typesize;
        let mut out = src.to_vec();
        for element in 0..count {
            for byte in 0..typesize {
                out[byte * count + element] = src[element * typesize + byte];
            }
        }
        out
    }

    /// The bit shuffle, bit by bit from its definition.
    fn shuffle_bits(typesize: usize, src: &[u8]) -> Vec<u8> {
        let count = src.len() / typesize;
        let mut out = src.to_vec();
        if !count.is_multiple_of(8) {
            return out;
        }
        out[..count * typesize].fill(0);
        for element in 0..count {
            for bit in 0..8 * typesize {
                let value = src[element * typesize + bit / 8] >> (bit % 8) & 1;
                out[bit * (count / 8) + element / 8] |= value << (element % 8);
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn unshuffling_undoes_shuffling(
            typesize in prop_oneof![1_usize..=16, 1_usize..=255],
            elements in 0_usize..150,
            rest in 0_usize..255,
            seed in proptest::collection::vec(any::<u8>(), 977),
        ) {
            let size = elements * typesize + rest % typesize;
            let data: Vec<u8> = seed.iter().copied().cycle().take(size).collect();
            let mut out = vec![0xa5; size];
            unshuffle_bytes(typesize, &plainly_shuffled_bytes(typesize, &data), &mut out);
            prop_assert!(out == data, "bytes, {typesize} × {elements}");
            let whole = &data[..elements * typesize];
            let mut shuffled = vec![0xa5; whole.len()];
            shuffle_bytes(typesize, whole, &mut shuffled);
            prop_assert!(shuffled == plainly_shuffled_bytes(typesize, whole), "{typesize} × {elements}");
            for size in [size, elements / 8 * 8 * typesize + rest % typesize] {
                let mut out = vec![0xa5; size];
                unshuffle_bits(typesize, &shuffle_bits(typesize, &data[..size]), &mut out);
                prop_assert!(out == data[..size], "bits, {typesize} × {elements}");
            }
        }
    }
}
