//! The thesis' ways to store bricks (sections 4.4, 4.5 and 6.3), each as a tree of what is read back.
//!
//! Values are stored as they are, as half floats, or as fractions of one range over the whole model (*unorm*): in 8
//! bits each or as blocks of texture compression. Tiles and background stand in the nodes and stay as they are.

use half::f16;
use nuage_vdb::Tree;
use nuage_volume::codec::block::{BlockFormat, PackingAxis, decode_brick};
use nuage_volume::space::BRICK_VOXELS;

use crate::cluster::shapes::Shapes;
use crate::cluster::thesis::Clusters;
use crate::cluster::{Brick, map};
use crate::encode::block::{Quality, encode_bricks};

/// How the voxels of bricks are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Half floats.
    F16,
    /// Eight bits between the smallest and the largest value of the model.
    Unorm8,
    /// The same fractions as texture blocks; those of four channels hold four voxels along z in a texel.
    Block(BlockFormat),
}

impl Format {
    /// All of them, the largest first.
    pub const ALL: [Format; 5] = [
        Format::F16,
        Format::Unorm8,
        Format::Block(BlockFormat::Bc4),
        Format::Block(BlockFormat::Bc3),
        Format::Block(BlockFormat::Bc7),
    ];

    /// The name in the thesis' tables.
    pub fn name(self) -> &'static str {
        match self {
            Format::F16 => "f16",
            Format::Unorm8 => "Unorm",
            Format::Block(BlockFormat::Bc4) => "BC4",
            Format::Block(BlockFormat::Bc3) => "BC3",
            Format::Block(BlockFormat::Bc7) => "BC7",
        }
    }

    /// The bytes of a brick.
    pub fn brick_bytes(self) -> usize {
        match self {
            Format::F16 => 2 * BRICK_VOXELS,
            Format::Unorm8 => BRICK_VOXELS,
            Format::Block(format) => format.brick_bytes(),
        }
    }
}

/// So many bricks are encoded at a time.
const BATCH: usize = 64;

/// The bricks of a tree.
pub fn bricks(tree: &Tree<f32>) -> &[Brick] {
    tree.leaves.values.as_chunks().0
}

/// The same tree with other values in its bricks, and the same active voxels.
///
/// # Panics
/// If there is another number of bricks.
pub fn with_bricks(tree: &Tree<f32>, bricks: Vec<Brick>) -> Tree<f32> {
    assert_eq!(bricks.len(), tree.leaves.len(), "one brick per leaf");
    let mut tree = tree.clone();
    tree.leaves.values = bricks.into_flattened();
    tree
}

/// The smallest and the largest value of some bricks. What is not finite does not count.
pub fn range(bricks: &[Brick]) -> [f32; 2] {
    let ends = |[min, max]: [f32; 2], value: &f32| match value.is_finite() {
        true => [min.min(*value), max.max(*value)],
        false => [min, max],
    };
    bricks.iter().flatten().fold([f32::INFINITY, f32::NEG_INFINITY], ends)
}

/// What is read of bricks that are stored in a format. `range` is that of the whole model.
pub fn stored(bricks: &[Brick], format: Format, range: [f32; 2]) -> Vec<Brick> {
    let [min, max] = range.map(f64::from);
    let width = if max > min { max - min } else { 1.0 };
    // The comparison is false for NaN.
    let fraction = |value: f32| if value > 0.0 { value.min(1.0) } else { 0.0 };
    let unorm = |value: f32| fraction(((f64::from(value) - min) / width) as f32);
    let value = |unorm: f32| (min + width * f64::from(unorm)) as f32;
    match format {
        Format::F16 => bricks.iter().map(|brick| brick.map(|value| f16::from_f32(value).to_f32())).collect(),
        Format::Unorm8 => {
            let byte = |value: f32| (unorm(value) * 255.0).round() / 255.0;
            bricks.iter().map(|brick| brick.map(|v| value(byte(v)))).collect()
        }
        Format::Block(format) => {
            let batches: Vec<&[Brick]> = bricks.chunks(BATCH).collect();
            let encode = |_: &mut (), batch: usize| -> Vec<Brick> {
                let scaled: Vec<Brick> = batches[batch].iter().map(|brick| brick.map(unorm)).collect();
                let bytes = encode_bricks(format, PackingAxis::Z, &scaled, Quality::Best);
                let decode = |bytes: &[u8]| {
                    let mut decoded = [0.0; BRICK_VOXELS];
                    // The encoder gives all bytes of each brick.
                    decode_brick(format, PackingAxis::Z, bytes, &mut decoded);
                    decoded.map(value)
                };
                bytes.chunks(format.brick_bytes()).map(decode).collect()
            };
            map(batches.len(), || (), encode).concat()
        }
    }
}

/// What is read of bricks of which some are replaced by the centre of their cluster.
pub fn clustered(bricks: &[Brick], clusters: &Clusters) -> Vec<Brick> {
    let centre = |centre: &Option<u32>| centre.and_then(|centre| clusters.centres.get(centre as usize));
    bricks.iter().zip(&clusters.of_brick).map(|(brick, of)| *centre(of).unwrap_or(brick)).collect()
}

/// What is read of bricks of which some share a shape. The shapes themselves are stored as `store` says, in -1..=1.
pub fn shared(bricks: &[Brick], shapes: &Shapes, store: impl Fn(&[Brick]) -> Vec<Brick>) -> Vec<Brick> {
    let stored = store(&shapes.shapes);
    let brick = |(brick, of): (&Brick, &Option<crate::cluster::shapes::SharedBrick>)| {
        of.and_then(|of| Some(of.values(stored.get(of.shape as usize)?))).unwrap_or(*brick)
    };
    bricks.iter().zip(&shapes.of_brick).map(brick).collect()
}

/// The values of voxels that the source leaves at its background.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Fog {
    /// Voxels of the source's bricks that are background there.
    pub voxels: u64,
    /// Those of them that are not when read back.
    pub changed: u64,
    /// By how much at most.
    pub largest: f32,
}

/// What the background of a tree became, in the bricks of the source.
pub fn fog(source: &Tree<f32>, decoded: &Tree<f32>) -> Fog {
    let places: std::collections::HashMap<[i32; 3], usize> =
        decoded.leaves.origins.iter().enumerate().map(|(i, origin)| (*origin, i)).collect();
    let decoded_bricks = bricks(decoded);
    let mut fog = Fog::default();
    for (origin, brick) in source.leaves.origins.iter().zip(bricks(source)) {
        let found = places.get(origin).and_then(|i| decoded_bricks.get(*i));
        let constant;
        let found = match found {
            Some(found) => found,
            None => {
                constant = [decoded.voxel(*origin).value; BRICK_VOXELS];
                &constant
            }
        };
        for (value, found) in brick.iter().zip(found).filter(|(value, _)| **value == source.background) {
            let error = (value - found).abs();
            fog.voxels += 1;
            fog.changed += u64::from(error > 0.0);
            fog.largest = fog.largest.max(error);
        }
    }
    fog
}

#[cfg(test)]
mod tests {
    use super::*;
    use nuage_vdb::{Shape, TreeBuilder};
    use proptest::prelude::*;

    fn random_bricks(seed: u64, count: usize) -> Vec<Brick> {
        let value = |i: usize| {
            let bits = (seed ^ i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            (bits >> 40) as f32 / 16_777_216.0 * 7.0 - 2.0
        };
        (0..count).map(|brick| std::array::from_fn(|voxel| value(brick * 512 + voxel))).collect()
    }

    #[test]
    fn bytes_are_those_of_the_formats_bits() {
        let bits = Format::ALL.map(|format| (format.name(), format.brick_bytes() * 8 / BRICK_VOXELS));
        assert_eq!(bits, [("f16", 16), ("Unorm", 8), ("BC4", 4), ("BC3", 2), ("BC7", 2)]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        #[test]
        fn unorm_is_within_half_a_step_of_the_models_range(seed in any::<u64>()) {
            let source = random_bricks(seed, 3);
            let range = range(&source);
            let half_step = (range[1] - range[0]) / 510.0;
            for (a, b) in source.iter().flatten().zip(stored(&source, Format::Unorm8, range).iter().flatten()) {
                prop_assert!((a - b).abs() <= half_step * 1.0001);
            }
            for (a, b) in source.iter().flatten().zip(stored(&source, Format::F16, range).iter().flatten()) {
                prop_assert!((a - b).abs() <= a.abs() / 2048.0 + 1e-7);
            }
        }

        #[test]
        fn bricks_of_one_value_come_back_from_every_format(value in 0.0f32..100.0) {
            let source = [[0.0; 512], [value; 512], [100.0; 512]];
            for format in Format::ALL {
                let read = stored(&source, format, range(&source));
                for (a, b) in source.iter().flatten().zip(read.iter().flatten()) {
                    // The ends of 5 and 6 bits of BC3.
                    let step = if format == Format::Block(BlockFormat::Bc3) { 100.0 / 50.0 } else { 100.0 / 240.0 };
                    prop_assert!((a - b).abs() <= step, "{format:?}: {a} became {b}");
                }
            }
        }
    }

    #[test]
    fn fog_is_what_the_background_became() {
        let mut builder = TreeBuilder::new(1.0, Shape::STANDARD);
        let mut values = [1.0; 512];
        values[7] = 3.0;
        builder.leaf([0, 0, 0], &[0; 8], &values);
        builder.leaf([8, 0, 0], &[0; 8], &[1.0; 512]);
        let source = builder.build().unwrap();
        assert_eq!(fog(&source, &source), Fog { voxels: 1023, changed: 0, largest: 0.0 });
        values[8] = 1.25;
        values[9] = 0.5;
        let mut builder = TreeBuilder::new(1.0, Shape::STANDARD);
        builder.leaf([0, 0, 0], &[0; 8], &values);
        builder.tile(2, [8, 0, 0], 2.0, true);
        let decoded = builder.build().unwrap();
        assert_eq!(fog(&source, &decoded), Fog { voxels: 1023, changed: 514, largest: 1.0 });
    }
}
