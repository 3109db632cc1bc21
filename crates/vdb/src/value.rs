//! The types of values that a tree can hold, and how each stands in a file and in memory.
//!
//! [`Value`] is what the generic code of this crate needs of a type. It is sealed: the types are those that
//! OpenVDB registers. How blocks of values are compressed does not live here.

use std::fmt::Debug;

use half::f16;

/// A type of values that a [`crate::Tree`] can hold.
pub trait Value: Copy + PartialEq + Debug + Default + Send + Sync + sealed::Sealed + 'static {
    /// The type's name in grid types: `float` in `Tree_float_5_4_3`.
    const NAME: &'static str;
    /// The bytes of one value in a file.
    const SIZE_BYTES: usize;
    /// The bytes of one value in a block of a grid that is saved as half floats. The same as
    /// [`Value::SIZE_BYTES`] for types that are not affected by that.
    const HALF_BYTES: usize;
    /// How many numbers a value consists of: 1, or 3 for vectors.
    const COMPONENTS: usize;

    /// What leaves hold: the value itself, a word of 64 bits for `bool`, nothing for [`ValueMask`].
    type Stored: Copy + PartialEq + Debug + Default + Send + Sync;

    /// How many [`Value::Stored`] a leaf of `voxels` voxels has.
    fn stored_per_leaf(voxels: usize) -> usize {
        voxels
    }

    /// The value of one voxel of a leaf, from what is stored of that leaf and its active mask.
    fn in_leaf(stored: &[Self::Stored], mask: &[u64], offset: usize) -> Self;

    /// A leaf's stored values by the way they are stored.
    fn leaf(stored: &[Self::Stored]) -> LeafValues<&[Self], &[u64]>;

    /// As [`Value::leaf`], to be written to.
    fn leaf_mut(stored: &mut [Self::Stored]) -> LeafValues<&mut [Self], &mut [u64]>;

    /// The value of opposite sign, as far as the type has one: what OpenVDB uses inside a level set. For `bool`
    /// and masks the other value.
    fn negative(self) -> Self;

    /// The number of this component as a double; 0 past the last one.
    fn component(self, i: usize) -> f64;

    /// How far the number of this component is from another value's. NaN if one of the two is NaN.
    fn distance(self, other: Self, i: usize) -> f64 {
        (self.component(i) - other.component(i)).abs()
    }

    /// Whether both are the same to the bit, so that NaN is the same as itself and 0 differs from −0.
    fn same_bits(self, other: Self) -> bool;

    /// The value's bits as a number to hash. Of vectors, mixed.
    fn hash_bits(self) -> u64;

    /// Appends the value as a file holds it, little-endian.
    fn append_to(self, bytes: &mut Vec<u8>);

    /// The value at the start of `bytes`.
    ///
    /// # Panics
    /// If there are less than [`Value::SIZE_BYTES`] bytes.
    fn from_bytes(bytes: &[u8]) -> Self;

    /// Decodes as many values as `out` holds from the start of `bytes`, as half floats if `half` is set and the
    /// type has such a form.
    ///
    /// # Panics
    /// If there are too few bytes.
    fn decode(bytes: &[u8], half: bool, out: &mut [Self]);

    /// Appends values as a block holds them before compression.
    fn encode(values: &[Self], half: bool, bytes: &mut Vec<u8>);
}

/// The ways in which leaves hold values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeafValues<P, B> {
    /// One value per voxel.
    Plain(P),
    /// One bit per voxel.
    Bits(B),
    /// None: the active mask is the values.
    Mask,
}

/// A value of a mask grid: the active state. Such grids have no other values than that.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ValueMask(pub bool);

/// A value of a grid of points: where the points of a voxel end in the arrays of its leaf.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PointOffset(pub u32);

mod sealed {
    pub trait Sealed {}
}

/// The parts of [`Value`] that are alike for values stored one per voxel.
macro_rules! plain_leaves {
    () => {
        type Stored = Self;

        fn in_leaf(stored: &[Self], _mask: &[u64], offset: usize) -> Self {
            stored[offset]
        }

        fn leaf(stored: &[Self]) -> LeafValues<&[Self], &[u64]> {
            LeafValues::Plain(stored)
        }

        fn leaf_mut(stored: &mut [Self]) -> LeafValues<&mut [Self], &mut [u64]> {
            LeafValues::Plain(stored)
        }
    };
}

/// The parts that are alike for bytes taken one value after the other.
macro_rules! one_by_one {
    () => {
        fn decode(bytes: &[u8], _half: bool, out: &mut [Self]) {
            for (value, bytes) in out.iter_mut().zip(bytes.chunks_exact(Self::SIZE_BYTES)) {
                *value = Self::from_bytes(bytes);
            }
        }

        fn encode(values: &[Self], _half: bool, bytes: &mut Vec<u8>) {
            values.iter().for_each(|value| value.append_to(bytes));
        }
    };
}

/// Numbers: `$half` says how a block of half floats becomes them and the reverse.
macro_rules! number {
    ($type:ty, $name:literal, $half_bytes:expr, $negative:expr, $to_f64:expr, $bits:expr, { $($coding:tt)* }) => {
        impl sealed::Sealed for $type {}

        impl Value for $type {
            const NAME: &'static str = $name;
            const SIZE_BYTES: usize = size_of::<$type>();
            const HALF_BYTES: usize = $half_bytes;
            const COMPONENTS: usize = 1;

            plain_leaves!();

            fn negative(self) -> Self {
                $negative(self)
            }

            fn component(self, i: usize) -> f64 {
                if i == 0 { $to_f64(self) } else { 0.0 }
            }

            fn same_bits(self, other: Self) -> bool {
                $bits(self) == $bits(other)
            }

            fn hash_bits(self) -> u64 {
                $bits(self) as u64
            }

            fn append_to(self, bytes: &mut Vec<u8>) {
                bytes.extend_from_slice(&self.to_le_bytes());
            }

            fn from_bytes(bytes: &[u8]) -> Self {
                <$type>::from_le_bytes(bytes[..size_of::<$type>()].try_into().expect("as many bytes"))
            }

            $($coding)*
        }
    };
}

/// Decoding and encoding of floats that may be saved as half floats.
macro_rules! maybe_half {
    ($type:ty, $encode_halves:ident, $decode_halves:ident) => {
        fn decode(bytes: &[u8], half: bool, out: &mut [Self]) {
            if half {
                return $decode_halves(bytes, out);
            }
            for (value, bytes) in out.iter_mut().zip(bytes.as_chunks().0) {
                *value = <$type>::from_le_bytes(*bytes);
            }
        }

        fn encode(values: &[Self], half: bool, bytes: &mut Vec<u8>) {
            if half {
                return $encode_halves(values, bytes);
            }
            let begin = bytes.len();
            bytes.resize(begin + size_of_val(values), 0);
            for (bytes, value) in bytes[begin..].as_chunks_mut().0.iter_mut().zip(values) {
                *bytes = value.to_le_bytes();
            }
        }
    };
}

number!(f32, "float", 2, |x: f32| -x, f64::from, f32::to_bits, {
    maybe_half!(f32, f32_to_halves, halves_to_f32);
});
number!(f64, "double", 2, |x: f64| -x, |x: f64| x, f64::to_bits, {
    maybe_half!(f64, f64_to_halves, halves_to_f64);
});
number!(f16, "half", 2, |x: f16| -x, f64::from, f16::to_bits, {
    one_by_one!();
});
number!(i32, "int32", 4, i32::wrapping_neg, f64::from, |x: i32| x, {
    one_by_one!();
});
number!(i64, "int64", 8, i64::wrapping_neg, |x: i64| x as f64, |x: i64| x, {
    one_by_one!();

    // Numbers beyond 2⁵³ that differ may be the same double.
    fn distance(self, other: Self, _i: usize) -> f64 {
        self.abs_diff(other) as f64
    }
});

/// Vectors, component by component.
macro_rules! vector {
    ($scalar:ty, $name:literal, $half_bytes:expr) => {
        impl sealed::Sealed for [$scalar; 3] {}

        impl Value for [$scalar; 3] {
            const NAME: &'static str = $name;
            const SIZE_BYTES: usize = 3 * size_of::<$scalar>();
            const HALF_BYTES: usize = $half_bytes;
            const COMPONENTS: usize = 3;

            plain_leaves!();

            fn negative(self) -> Self {
                self.map(Value::negative)
            }

            fn component(self, i: usize) -> f64 {
                self.get(i).map_or(0.0, |x| x.component(0))
            }

            fn same_bits(self, other: Self) -> bool {
                (0..3).all(|i| self[i].same_bits(other[i]))
            }

            fn hash_bits(self) -> u64 {
                // An odd factor loses no bits of the numbers before.
                self.iter().fold(0, |hash, x| hash.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ x.hash_bits())
            }

            fn append_to(self, bytes: &mut Vec<u8>) {
                self.iter().for_each(|x| x.append_to(bytes));
            }

            fn from_bytes(bytes: &[u8]) -> Self {
                std::array::from_fn(|i| <$scalar>::from_bytes(&bytes[i * size_of::<$scalar>()..]))
            }

            fn decode(bytes: &[u8], half: bool, out: &mut [Self]) {
                <$scalar>::decode(bytes, half, out.as_flattened_mut());
            }

            fn encode(values: &[Self], half: bool, bytes: &mut Vec<u8>) {
                <$scalar>::encode(values.as_flattened(), half, bytes);
            }
        }
    };
}

vector!(f32, "vec3s", 6);
vector!(f64, "vec3d", 6);
vector!(i32, "vec3i", 12);

impl sealed::Sealed for bool {}

impl Value for bool {
    const NAME: &'static str = "bool";
    const SIZE_BYTES: usize = 1;
    const HALF_BYTES: usize = 1;
    const COMPONENTS: usize = 1;

    type Stored = u64;

    fn stored_per_leaf(voxels: usize) -> usize {
        voxels.div_ceil(64)
    }

    fn in_leaf(stored: &[u64], _mask: &[u64], offset: usize) -> Self {
        stored[offset / 64] >> (offset % 64) & 1 == 1
    }

    fn leaf(stored: &[u64]) -> LeafValues<&[Self], &[u64]> {
        LeafValues::Bits(stored)
    }

    fn leaf_mut(stored: &mut [u64]) -> LeafValues<&mut [Self], &mut [u64]> {
        LeafValues::Bits(stored)
    }

    fn negative(self) -> Self {
        !self
    }

    fn component(self, i: usize) -> f64 {
        if i == 0 { f64::from(u8::from(self)) } else { 0.0 }
    }

    fn same_bits(self, other: Self) -> bool {
        self == other
    }

    fn hash_bits(self) -> u64 {
        u64::from(self)
    }

    fn append_to(self, bytes: &mut Vec<u8>) {
        bytes.push(self.into());
    }

    fn from_bytes(bytes: &[u8]) -> Self {
        bytes[0] != 0
    }

    one_by_one!();
}

impl sealed::Sealed for ValueMask {}

impl Value for ValueMask {
    const NAME: &'static str = "mask";
    const SIZE_BYTES: usize = 1;
    const HALF_BYTES: usize = 1;
    const COMPONENTS: usize = 1;

    type Stored = ();

    fn stored_per_leaf(_voxels: usize) -> usize {
        0
    }

    fn in_leaf(_stored: &[()], mask: &[u64], offset: usize) -> Self {
        ValueMask(mask[offset / 64] >> (offset % 64) & 1 == 1)
    }

    fn leaf(_stored: &[()]) -> LeafValues<&[Self], &[u64]> {
        LeafValues::Mask
    }

    fn leaf_mut(_stored: &mut [()]) -> LeafValues<&mut [Self], &mut [u64]> {
        LeafValues::Mask
    }

    fn negative(self) -> Self {
        ValueMask(!self.0)
    }

    fn component(self, i: usize) -> f64 {
        self.0.component(i)
    }

    fn same_bits(self, other: Self) -> bool {
        self == other
    }

    fn hash_bits(self) -> u64 {
        u64::from(self.0)
    }

    fn append_to(self, bytes: &mut Vec<u8>) {
        self.0.append_to(bytes);
    }

    fn from_bytes(bytes: &[u8]) -> Self {
        ValueMask(bool::from_bytes(bytes))
    }

    one_by_one!();
}

impl sealed::Sealed for PointOffset {}

impl Value for PointOffset {
    const NAME: &'static str = "ptdataidx32";
    const SIZE_BYTES: usize = 4;
    const HALF_BYTES: usize = 4;
    const COMPONENTS: usize = 1;

    plain_leaves!();

    fn negative(self) -> Self {
        PointOffset(self.0.wrapping_neg())
    }

    fn component(self, i: usize) -> f64 {
        if i == 0 { self.0.into() } else { 0.0 }
    }

    fn same_bits(self, other: Self) -> bool {
        self == other
    }

    fn hash_bits(self) -> u64 {
        u64::from(self.0)
    }

    fn append_to(self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.0.to_le_bytes());
    }

    fn from_bytes(bytes: &[u8]) -> Self {
        PointOffset(u32::from_le_bytes(bytes[..4].try_into().expect("four bytes")))
    }

    one_by_one!();
}

/// Conversions are faster over runs of halves than one by one.
const HALVES_AT_ONCE: usize = 64;

fn halves_to_f32(bytes: &[u8], out: &mut [f32]) {
    use half::slice::HalfFloatSliceExt;
    let mut halves = [f16::ZERO; HALVES_AT_ONCE];
    for (out, bytes) in out.chunks_mut(HALVES_AT_ONCE).zip(bytes.chunks(2 * HALVES_AT_ONCE)) {
        for (half, bytes) in halves.iter_mut().zip(bytes.as_chunks().0) {
            *half = f16::from_le_bytes(*bytes);
        }
        halves[..out.len()].convert_to_f32_slice(out);
    }
}

fn f32_to_halves(values: &[f32], bytes: &mut Vec<u8>) {
    use half::slice::HalfFloatSliceExt;
    let mut halves = [f16::ZERO; HALVES_AT_ONCE];
    for values in values.chunks(HALVES_AT_ONCE) {
        let halves = &mut halves[..values.len()];
        halves.convert_from_f32_slice(values);
        bytes.extend(halves.iter().flat_map(|half| half.to_le_bytes()));
    }
}

/// OpenVDB goes by way of a single-precision float, which can round twice.
fn f64_to_halves(values: &[f64], bytes: &mut Vec<u8>) {
    let mut singles = [0.0; HALVES_AT_ONCE];
    for values in values.chunks(HALVES_AT_ONCE) {
        singles.iter_mut().zip(values).for_each(|(single, value)| *single = *value as f32);
        f32_to_halves(&singles[..values.len()], bytes);
    }
}

fn halves_to_f64(bytes: &[u8], out: &mut [f64]) {
    for (value, bytes) in out.iter_mut().zip(bytes.as_chunks().0) {
        *value = f16::from_le_bytes(*bytes).into();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn comes_back<V: Value>(values: &[V]) {
        let mut bytes = Vec::new();
        V::encode(values, false, &mut bytes);
        assert_eq!(bytes.len(), values.len() * V::SIZE_BYTES, "{}", V::NAME);
        let mut decoded = vec![V::default(); values.len()];
        V::decode(&bytes, false, &mut decoded);
        let mut one_by_one = Vec::new();
        for (i, value) in values.iter().enumerate() {
            assert!(decoded[i].same_bits(*value), "{}", V::NAME);
            assert!(V::from_bytes(&bytes[i * V::SIZE_BYTES..]).same_bits(*value), "{}", V::NAME);
            value.append_to(&mut one_by_one);
        }
        assert_eq!(one_by_one, bytes, "{}", V::NAME);
        let mut halves = Vec::new();
        V::encode(values, true, &mut halves);
        assert_eq!(halves.len(), values.len() * V::HALF_BYTES, "{}", V::NAME);
        V::decode(&halves, true, &mut decoded);
        let mut again = Vec::new();
        V::encode(&decoded, true, &mut again);
        assert_eq!(again, halves, "{}: what halves say is saved as the same halves", V::NAME);
    }

    #[test]
    fn every_type_comes_back_from_its_bytes() {
        let floats: Vec<f32> = (0..150).map(|i| (i as f32 - 70.0) * 1.37).chain([-0.0, 1e30]).collect();
        comes_back(&floats);
        comes_back(&floats.iter().map(|x| f64::from(*x) * 1.1).collect::<Vec<f64>>());
        comes_back(&floats.iter().map(|x| f16::from_f32(*x)).collect::<Vec<f16>>());
        comes_back(&[0_i32, 1, -1, i32::MIN, i32::MAX]);
        comes_back(&[0_i64, 1, -1, i64::MIN, i64::MAX]);
        comes_back(&[true, false, true]);
        comes_back(&[ValueMask(true), ValueMask(false)]);
        comes_back(&[PointOffset(7), PointOffset(u32::MAX)]);
        comes_back(&floats.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect::<Vec<[f32; 3]>>());
        comes_back(&[[1.5_f64, -2.0, 3.0], [1e10, 0.1, -0.0]]);
        comes_back(&[[1_i32, -2, 3], [i32::MIN, 0, i32::MAX]]);
    }

    #[test]
    fn halves_are_exact_in_any_number() {
        for count in [0, 1, 63, 64, 65, 512] {
            let wanted: Vec<f32> = (0..count).map(|i| i as f32 * 0.25 - 3.0).collect();
            let mut bytes = Vec::new();
            f32::encode(&wanted, true, &mut bytes);
            let (mut singles, mut doubles) = (vec![0.0_f32; count], vec![0.0_f64; count]);
            f32::decode(&bytes, true, &mut singles);
            f64::decode(&bytes, true, &mut doubles);
            assert_eq!(singles, wanted);
            assert!(doubles.iter().zip(&wanted).all(|(a, b)| *a == f64::from(*b)));
        }
    }
}
