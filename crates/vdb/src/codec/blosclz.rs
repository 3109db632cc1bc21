//! BloscLZ streams, the compressor that Blosc brings along: a byte-oriented LZ77 in the FastLZ family.
//!
//! A stream is a row of instructions, each led by a control byte `c`:
//!
//! - `c < 32`: the `c + 1` bytes that follow are copied out.
//! - `c >= 32`: bytes already written are repeated. The length is `(c >> 5) + 2`; if `c >> 5` is 7, bytes
//!   that follow are added to it, up to and including the first below 255. The next byte `low` gives the
//!   distance `256 · (c & 31) + low + 1`. If that has its largest value, two more bytes, the high one
//!   first, are added to it.
//!
//! The first control byte is always a copy: only its low five bits count. The end of the input ends the
//! stream; neither the size of the output nor a checksum is stored.
//!
//! Source: the format as `blosclz.c` of <https://github.com/Blosc/c-blosc> defines it.

/// Decodes `input` into `out`. `None` unless it is sound and gives exactly `out.len()` bytes.
pub(super) fn decompress(input: &[u8], out: &mut [u8]) -> Option<()> {
    let mut input = Bytes(input);
    let mut written = 0;
    let mut control = input.next()? & 31;
    loop {
        if control < 32 {
            let literals = input.take(usize::from(control) + 1)?;
            let end = written + literals.len();
            out.get_mut(written..end)?.copy_from_slice(literals);
            written = end;
        } else {
            let length = match_length(control, &mut input)?;
            let distance = match_distance(control, &mut input)?;
            let end = written.checked_add(length).filter(|&end| end <= out.len())?;
            repeat(&mut out[..end], written, distance)?;
            written = end;
        }
        match input.next() {
            Some(next) => control = next,
            None => return (written == out.len()).then_some(()),
        }
    }
}

fn match_length(control: u8, input: &mut Bytes) -> Option<usize> {
    let mut length = usize::from(control >> 5) + 2;
    if control >> 5 == 7 {
        loop {
            let more = input.next()?;
            // Where usize has 32 bits, 17 MB of input could overflow it. No output is usize::MAX long.
            length = length.saturating_add(usize::from(more));
            if more < 255 {
                break;
            }
        }
    }
    Some(length)
}

fn match_distance(control: u8, input: &mut Bytes) -> Option<usize> {
    const NEAR_MAX: usize = 256 * 31 + 255 + 1;
    let near = 256 * usize::from(control & 31) + usize::from(input.next()?) + 1;
    if near < NEAR_MAX {
        return Some(near);
    }
    let far = u16::from_be_bytes([input.next()?, input.next()?]);
    Some(NEAR_MAX + usize::from(far))
}

/// Fills `out[from..]` with what stands `distance` bytes earlier, which may overlap with what is being
/// filled. `None` if that would be before the start.
fn repeat(out: &mut [u8], from: usize, distance: usize) -> Option<()> {
    let source = from.checked_sub(distance)?;
    if distance == 1 {
        let byte = out[source];
        out[from..].fill(byte);
        return Some(());
    }
    // What has been copied is a period longer than before, so each step may copy all that is there.
    let mut at = from;
    while at < out.len() {
        let count = (at - source).min(out.len() - at);
        out.copy_within(source..source + count, at);
        at += count;
    }
    Some(())
}

/// The input not yet read.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn next(&mut self) -> Option<u8> {
        let (&first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(first)
    }

    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn decoded(input: &[u8], size: usize) -> Option<Vec<u8>> {
        let mut out = vec![0; size];
        decompress(input, &mut out).map(|()| out)
    }

    #[test]
    fn each_instruction_does_what_the_format_says() {
        // Copy three; the top bits of the first control byte mean nothing.
        assert_eq!(decoded(&[0xe2, 1, 2, 3], 3), Some(vec![1, 2, 3]));
        // Length 3 at distance 2, overlapping itself.
        assert_eq!(decoded(&[1, 7, 8, 1 << 5, 1], 5), Some(vec![7, 8, 7, 8, 7]));
        // A run of 7 + 2 + 255 + 4 bytes at distance 1, then a literal.
        let mut run = vec![9; 1 + 268];
        run.push(5);
        assert_eq!(decoded(&[0, 9, 7 << 5, 255, 4, 0, 0, 5], 270), Some(run));
        // The high distance bits: 256 · 1 + 0 + 1 back after 258 bytes.
        let mut stream = Vec::new();
        let mut expected = Vec::new();
        for (first, count) in (0..8).map(|i| (i * 32, 32)).chain([(100, 2)]) {
            stream.push(count - 1);
            stream.extend((0..count).map(|i| first + i));
            expected.extend((0..count).map(|i| first + i));
        }
        stream.extend([1 << 5 | 1, 0]);
        expected.extend([1, 2, 3]);
        assert_eq!(decoded(&stream, 261), Some(expected));
    }

    #[test]
    fn a_far_match_reaches_beyond_8192_bytes() {
        // One byte 1, then 8999 zeros (a literal and a match), then 3 bytes from the very start.
        let mut stream = vec![1, 1, 0, 7 << 5];
        let mut left = 8998 - 9;
        while left >= 255 {
            stream.push(255);
            left -= 255;
        }
        stream.extend([left as u8, 0]);
        let far = 9000 - 8192_u16;
        stream.extend([1 << 5 | 31, 255, (far >> 8) as u8, far as u8]);
        let out = decoded(&stream, 9003).unwrap();
        assert!(out[1..9000].iter().all(|&b| b == 0));
        assert_eq!(out[9000..], [1, 0, 0]);
    }

    #[test]
    fn what_reaches_outside_is_refused() {
        assert_eq!(decoded(&[], 0), None);
        assert_eq!(decoded(&[5, 1, 2], 6), None, "literals cut off");
        assert_eq!(decoded(&[1, 1, 2], 1), None, "literals past the end of the output");
        assert_eq!(decoded(&[1, 1, 2], 3), None, "too little");
        assert_eq!(decoded(&[0, 1, 1 << 5, 1], 4), None, "a match before the start");
        assert_eq!(decoded(&[0, 1, 1 << 5, 0], 3), None, "a match past the end");
        assert_eq!(decoded(&[0, 1, 1 << 5], 4), None, "no distance");
        assert_eq!(decoded(&[0, 1, 7 << 5, 255], 300), None, "no end of the length");
        assert_eq!(decoded(&[0, 1, 0x3f, 255, 0], 4), None, "half a far distance");
    }

    proptest! {
        #[test]
        fn any_bytes_decode_or_fail(
            input in proptest::collection::vec(any::<u8>(), 0..200), size in 0_usize..500,
        ) {
            if let Some(out) = decoded(&input, size) {
                prop_assert_eq!(out.len(), size);
                // A stream has one size only.
                prop_assert_eq!(decoded(&input, size + 1), None);
            }
        }
    }
}
