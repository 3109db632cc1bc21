//! Attributes of points: what they are, and the arrays that hold their values.
//!
//! Arrays keep the bytes of the file, in the coding of the file, and are decoded when asked for: a position
//! takes three bytes in the narrowest coding and twenty-four as doubles. Codings that are not known here keep
//! their bytes all the same.
//!
//! Layouts and codings are those of OpenVDB's `points/AttributeArray.h` and `math/QuantizedUnitVec.h`.

use half::f16;

use crate::metadata::Metadata;

/// The attributes of a leaf, its groups, and what else belongs to them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AttributeSet {
    /// The attributes in the order in which leaves hold them.
    pub attributes: Vec<Attribute>,
    /// The groups that points can belong to.
    pub groups: Vec<Group>,
    /// Default values (`default:name`) and the texts of string attributes (`string:0` and so on).
    pub metadata: Metadata,
}

/// What an attribute is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attribute {
    /// The name: `P` for positions.
    pub name: String,
    /// The type of the values as files name it: `float`, `vec3s`, `quatd`, …
    pub value_type: String,
    /// How values are coded: `null` as they are, `trnc` in half width, `fxpt8` and `fxpt16` as parts of the
    /// unit interval around 0, `ufxpt8` and `ufxpt16` of that from 0 to 1, `uvec` as a direction in two
    /// bytes, `grp` as bits of groups, `str` as numbers of texts.
    pub codec: String,
}

/// A group: a named bit of each point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// The name.
    pub name: String,
    /// Which bit, counted over the attributes of coding `grp`, eight to each.
    pub bit: u64,
}

/// The values of an attribute in one leaf.
#[derive(Debug, Clone, Copy)]
pub struct AttributeArray<'a> {
    /// What the values are.
    pub attribute: &'a Attribute,
    array: &'a Array,
    bytes: &'a [u8],
}

/// The members of a group in one leaf.
#[derive(Debug, Clone, Copy)]
pub struct GroupMembers<'a> {
    pub(super) array: AttributeArray<'a>,
    pub(super) bit: u32,
}

/// Decoded values: the numbers of all of them one after the other, [`AttributeArray::components`] per value.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the variants are named as their types")]
pub enum Numbers {
    Bool(Vec<bool>),
    Int8(Vec<i8>),
    Int16(Vec<i16>),
    Int32(Vec<i32>),
    Int64(Vec<i64>),
    Uint8(Vec<u8>),
    Uint32(Vec<u32>),
    Float(Vec<f32>),
    Double(Vec<f64>),
}

/// The arrays of all leaves for one position in the sets of attributes, one after the other.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Column {
    /// One per leaf.
    pub(super) arrays: Vec<Array>,
    pub(super) bytes: Vec<u8>,
}

/// What a file says of the array of one leaf.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Array {
    /// Where it begins in the bytes of its column.
    pub(super) begin: u64,
    pub(super) points: u32,
    /// Values per point, or of all points where that is not constant.
    pub(super) stride: u32,
    /// The bytes of one value as it is coded.
    pub(super) value_bytes: u32,
    pub(super) flags: u8,
    pub(super) storage: u8,
}

impl Array {
    const TRANSIENT: u8 = 1;
    const HIDDEN: u8 = 2;
    const CONSTANT_STRIDE: u8 = 8;
    /// Flags of how the array is stored in the file.
    pub(super) const STRIDED: u8 = 1;
    pub(super) const UNIFORM: u8 = 2;
    pub(super) const PAGED: u8 = 8;
    pub(super) const ALL_STORAGE: u8 = 15;
    /// Of this crate: there is none in the file.
    const ABSENT: u8 = 128;

    /// That of a leaf without the attribute.
    pub(super) const NONE: Array = Array {
        begin: 0,
        points: 0,
        stride: 1,
        value_bytes: 0,
        flags: Array::CONSTANT_STRIDE,
        storage: Array::ABSENT,
    };

    pub(super) fn is_uniform(&self) -> bool {
        self.storage & Self::UNIFORM != 0
    }

    pub(super) fn is_paged(&self) -> bool {
        self.storage & Self::PAGED != 0
    }

    /// Whether it stands in the file on its own, and not in a page with others.
    pub(super) fn is_alone(&self) -> bool {
        self.storage & (Self::PAGED | Self::ABSENT) == 0
    }

    fn has_constant_stride(&self) -> bool {
        self.flags & Self::CONSTANT_STRIDE != 0
    }

    /// The values that the array stands for.
    fn values(&self) -> u64 {
        match self.has_constant_stride() {
            true => u64::from(self.points) * u64::from(self.stride),
            false => self.stride.into(),
        }
    }

    /// The values that it stores.
    pub(super) fn stored_values(&self) -> u64 {
        if self.is_uniform() { 1 } else { self.values() }
    }

    /// The bytes of its values. Saturating: they are counted before they are read.
    pub(super) fn bytes(&self) -> u64 {
        self.stored_values().saturating_mul(self.value_bytes.into())
    }
}

impl Column {
    pub(super) fn array<'a>(&'a self, leaf: usize, attribute: &'a Attribute) -> Option<AttributeArray<'a>> {
        let array = self.arrays.get(leaf)?;
        let begin = usize::try_from(array.begin).ok()?;
        let bytes = self.bytes.get(begin..)?.get(..usize::try_from(array.bytes()).ok()?)?;
        Some(AttributeArray { attribute, array, bytes })
    }
}

impl AttributeSet {
    /// The text that a value of a string attribute stands for: 0 is the empty one.
    pub fn text(&self, value: u32) -> Option<&str> {
        match value.checked_sub(1) {
            None => Some(""),
            Some(number) => self.metadata.string(&format!("string:{number}")),
        }
    }

    /// The attribute that holds a group, by its position, and the bit in it.
    pub(super) fn group_bit(&self, group: &Group) -> Option<(usize, u32)> {
        let mut holders =
            self.attributes.iter().enumerate().filter(|(_, attribute)| attribute.codec == "grp");
        let (position, _) = holders.nth(usize::try_from(group.bit / 8).ok()?)?;
        Some((position, (group.bit % 8) as u32))
    }

    pub(super) fn memory_bytes(&self) -> u64 {
        let attributes = self.attributes.iter().map(|a| a.name.len() + a.value_type.len() + a.codec.len());
        let groups = self.groups.iter().map(|group| group.name.len());
        let metadata = self.metadata.iter().map(|(name, value)| name.len() + value.bytes.len());
        let owned: usize = attributes.chain(groups).chain(metadata).sum();
        (size_of_val(self) + size_of_val(&*self.attributes) + size_of_val(&*self.groups) + owned) as u64
    }
}

impl Attribute {
    /// The bytes of one value as it is coded, if that is known.
    pub(super) fn value_bytes(&self) -> Option<u32> {
        self.coding().map(Coding::value_bytes)
    }

    fn coding(&self) -> Option<Coding> {
        let components = match self.value_type.as_str() {
            "vec3s" | "vec3d" | "vec3i" => 3,
            "quats" | "quatd" => 4,
            "mat3s" | "mat3d" => 9,
            "mat4s" | "mat4d" => 16,
            _ => 1,
        };
        let number = match (self.value_type.as_str(), self.codec.as_str()) {
            ("bool", "null") => Number::Bool,
            ("int8", "null") => Number::Int8,
            ("int16", "null") => Number::Int16,
            ("int32" | "vec3i", "null") => Number::Int32,
            ("int64", "null") => Number::Int64,
            ("uint8", "grp") => Number::Uint8,
            ("uint32", "str") => Number::Uint32,
            ("float" | "vec3s" | "quats" | "mat3s" | "mat4s", "null") => Number::Float,
            ("double" | "vec3d" | "quatd" | "mat3d" | "mat4d", "null") => Number::Double,
            ("half", "null") | ("float" | "vec3s", "trnc") => Number::Half,
            ("float" | "vec3s", "fxpt8") => Number::Fixed8 { least: -0.5 },
            ("float" | "vec3s", "fxpt16") => Number::Fixed16 { least: -0.5 },
            ("float" | "vec3s", "ufxpt8") => Number::Fixed8 { least: 0.0 },
            ("float" | "vec3s", "ufxpt16") => Number::Fixed16 { least: 0.0 },
            ("vec3s", "uvec") => Number::UnitVector,
            _ => return None,
        };
        Some(Coding { number, components })
    }
}

/// How values stand in an array.
#[derive(Debug, Clone, Copy)]
struct Coding {
    number: Number,
    components: usize,
}

#[derive(Debug, Clone, Copy)]
enum Number {
    Bool,
    Int8,
    Int16,
    Int32,
    Int64,
    Uint8,
    Uint32,
    Half,
    Float,
    Double,
    /// A part of the unit interval that begins at `least`.
    Fixed8 {
        least: f32,
    },
    Fixed16 {
        least: f32,
    },
    /// All three components in two bytes.
    UnitVector,
}

impl Coding {
    fn value_bytes(self) -> u32 {
        let number_bytes = match self.number {
            Number::Bool | Number::Int8 | Number::Uint8 | Number::Fixed8 { .. } => 1,
            Number::Int16 | Number::Half | Number::Fixed16 { .. } => 2,
            Number::Int32 | Number::Uint32 | Number::Float => 4,
            Number::Int64 | Number::Double => 8,
            Number::UnitVector => return 2,
        };
        number_bytes * self.components as u32
    }

    fn decode(self, bytes: &[u8]) -> Numbers {
        match self.number {
            Number::Bool => Numbers::Bool(each(bytes, |[b]| b != 0)),
            Number::Int8 => Numbers::Int8(each(bytes, i8::from_le_bytes)),
            Number::Int16 => Numbers::Int16(each(bytes, i16::from_le_bytes)),
            Number::Int32 => Numbers::Int32(each(bytes, i32::from_le_bytes)),
            Number::Int64 => Numbers::Int64(each(bytes, i64::from_le_bytes)),
            Number::Uint8 => Numbers::Uint8(bytes.to_vec()),
            Number::Uint32 => Numbers::Uint32(each(bytes, u32::from_le_bytes)),
            Number::Half => Numbers::Float(each(bytes, |b| f16::from_le_bytes(b).into())),
            Number::Float => Numbers::Float(each(bytes, f32::from_le_bytes)),
            Number::Double => Numbers::Double(each(bytes, f64::from_le_bytes)),
            Number::Fixed8 { least } => Numbers::Float(each(bytes, |[b]| f32::from(b) / 255.0 + least)),
            Number::Fixed16 { least } => {
                Numbers::Float(each(bytes, |b| f32::from(u16::from_le_bytes(b)) / 65535.0 + least))
            }
            Number::UnitVector => {
                let vectors = each(bytes, |b| unit_vector(u16::from_le_bytes(b)));
                Numbers::Float(vectors.into_flattened())
            }
        }
    }
}

/// Decodes items of `N` bytes.
fn each<const N: usize, T>(bytes: &[u8], decode: impl Fn([u8; N]) -> T) -> Vec<T> {
    bytes.as_chunks().0.iter().map(|bytes| decode(*bytes)).collect()
}

/// A direction in two bytes: a sign per axis, and x and y of a point on the plane x + y + z = 126.
///
/// The half of the square of x and y that lies beyond that plane is folded back.
fn unit_vector(coded: u16) -> [f32; 3] {
    let (mut x, mut y) = (i32::from(coded >> 7 & 63), i32::from(coded & 127));
    if x + y > 126 {
        (x, y) = (127 - x, 127 - y);
    }
    let p = [x, y, 126 - x - y];
    let length = f64::from(p.iter().map(|c| c * c).sum::<i32>()).sqrt();
    let weight = (1.0 / length) as f32;
    std::array::from_fn(|axis| {
        let c = p[axis] as f32 * weight;
        if coded >> (15 - axis) & 1 == 1 { -c } else { c }
    })
}

impl<'a> AttributeArray<'a> {
    /// The number of points.
    pub fn point_count(&self) -> usize {
        self.array.points as usize
    }

    /// The values per point; `None` if that differs from point to point.
    pub fn stride(&self) -> Option<usize> {
        self.array.has_constant_stride().then_some(self.array.stride as usize)
    }

    /// The number of values: as many as points times the stride.
    pub fn len(&self) -> u64 {
        self.array.values()
    }

    /// Whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether one value is stored for all points.
    pub fn is_uniform(&self) -> bool {
        self.array.is_uniform()
    }

    /// Whether the writer meant to hide the attribute from users.
    pub fn is_hidden(&self) -> bool {
        self.array.flags & Array::HIDDEN != 0
    }

    /// Whether the attribute is for the time of a computation only. Files rarely hold such.
    pub fn is_transient(&self) -> bool {
        self.array.flags & Array::TRANSIENT != 0
    }

    /// The values as they are coded; one if the array is uniform.
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// The bytes of one value as it is coded.
    pub fn value_bytes(&self) -> usize {
        self.array.value_bytes as usize
    }

    /// The numbers of a value: 3 for vectors, 4 for quaternions, 9 or 16 for matrices.
    pub fn components(&self) -> usize {
        self.attribute.coding().map_or(1, |coding| coding.components)
    }

    /// The values, decoded; one if the array is uniform. `None` if the type or coding is not known.
    pub fn numbers(&self) -> Option<Numbers> {
        Some(self.attribute.coding()?.decode(self.bytes))
    }

    /// One value as it is coded, whether or not the array is uniform. `None` past the last.
    pub fn value(&self, i: u64) -> Option<&'a [u8]> {
        let stored = if self.is_uniform() { 0 } else { i };
        let begin = usize::try_from(stored).ok()?.checked_mul(self.value_bytes())?;
        let value = self.bytes.get(begin..)?.get(..self.value_bytes())?;
        (i < self.len()).then_some(value)
    }

    /// The values as positions, one if the array is uniform. `None` unless they are three floats per point.
    pub(super) fn positions(&self) -> Option<Vec<[f64; 3]>> {
        if self.components() != 3 || self.stride() != Some(1) {
            return None;
        }
        match self.numbers()? {
            Numbers::Float(numbers) => {
                Some(numbers.as_chunks().0.iter().map(|p: &[f32; 3]| p.map(f64::from)).collect())
            }
            Numbers::Double(numbers) => Some(numbers.as_chunks().0.to_vec()),
            _ => None,
        }
    }
}

impl GroupMembers<'_> {
    /// Whether a point of the leaf belongs to the group. `false` past the last point.
    pub fn contains(&self, point: usize) -> bool {
        let bits = self.array.value(point as u64).and_then(<[u8]>::first);
        bits.is_some_and(|bits| bits >> self.bit & 1 == 1)
    }
}

impl Numbers {
    /// The number of numbers.
    pub fn len(&self) -> usize {
        match self {
            Numbers::Bool(numbers) => numbers.len(),
            Numbers::Int8(numbers) => numbers.len(),
            Numbers::Int16(numbers) => numbers.len(),
            Numbers::Int32(numbers) => numbers.len(),
            Numbers::Int64(numbers) => numbers.len(),
            Numbers::Uint8(numbers) => numbers.len(),
            Numbers::Uint32(numbers) => numbers.len(),
            Numbers::Float(numbers) => numbers.len(),
            Numbers::Double(numbers) => numbers.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// One of them as a double, exact for all types but `int64` beyond 2⁵³. `None` past the last.
    pub fn get(&self, i: usize) -> Option<f64> {
        match self {
            Numbers::Bool(numbers) => numbers.get(i).map(|x| f64::from(u8::from(*x))),
            Numbers::Int8(numbers) => numbers.get(i).map(|x| f64::from(*x)),
            Numbers::Int16(numbers) => numbers.get(i).map(|x| f64::from(*x)),
            Numbers::Int32(numbers) => numbers.get(i).map(|x| f64::from(*x)),
            Numbers::Int64(numbers) => numbers.get(i).map(|x| *x as f64),
            Numbers::Uint8(numbers) => numbers.get(i).map(|x| f64::from(*x)),
            Numbers::Uint32(numbers) => numbers.get(i).map(|x| f64::from(*x)),
            Numbers::Float(numbers) => numbers.get(i).map(|x| f64::from(*x)),
            Numbers::Double(numbers) => numbers.get(i).copied(),
        }
    }
}
