//! The little of NumPy's `.npy` format that the reference images use, and raw arrays of doubles.

use std::path::Path;

/// The values of a C-ordered little-endian float32 `.npy` file (version 1 or 2 of the format).
///
/// # Panics
/// If the file cannot be read or holds something else.
pub fn read_f32(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    assert_eq!(&bytes[..6], b"\x93NUMPY", "{} is no .npy file", path.display());
    let (header_len, start) = match bytes[6] {
        1 => (usize::from(u16::from_le_bytes([bytes[8], bytes[9]])), 10),
        _ => (u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize, 12),
    };
    let header = std::str::from_utf8(&bytes[start..start + header_len]).expect("a header in ASCII");
    assert!(header.contains("'<f4'") && header.contains("'fortran_order': False"), "{header}");
    let values = bytes[start + header_len..].chunks_exact(4);
    values.map(|b| f32::from_le_bytes(b.try_into().expect("four bytes"))).collect()
}

/// The values of a file of little-endian float64.
///
/// # Panics
/// If the file cannot be read.
pub fn read_raw_f64(path: &Path) -> Vec<f64> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    bytes.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().expect("eight bytes"))).collect()
}
