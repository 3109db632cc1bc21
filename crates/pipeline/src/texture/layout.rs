//! Where bricks stand in a 3D texture, and how large it is: arithmetic alone.
//!
//! Brick numbers run along x first, then y, then z. A texel is one voxel, or four that follow each other along z in red,
//! green, blue and alpha. In bytes, slices of constant z follow each other; a slice is rows of blocks of 4×4×1 texels,
//! or of single texels where the format has no blocks.

use nuage_volume::codec::Codec;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};

/// The most texels of a 3D texture along an axis: the limit that Direct3D 12 sets, and Vulkan on desktop cards.
pub const MAX_TEXELS: u32 = 2048;

/// The kinds of texel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextureFormat {
    /// A byte a voxel, 0 to 1.
    R8,
    /// A half float a voxel.
    R16F,
    /// Blocks of one channel, 4 bits a voxel, 0 to 1.
    Bc4,
    /// Blocks of four channels, 2 bits a voxel, 0 to 1.
    Bc3,
    /// Blocks of four channels, 2 bits a voxel, 0 to 1: better than BC3, slower to make.
    Bc7,
}

impl TextureFormat {
    /// All of them.
    pub const ALL: [TextureFormat; 5] =
        [TextureFormat::R8, TextureFormat::R16F, TextureFormat::Bc4, TextureFormat::Bc3, TextureFormat::Bc7];

    /// The name in options and sidecars.
    pub fn name(self) -> &'static str {
        match self {
            TextureFormat::R8 => "r8",
            TextureFormat::R16F => "r16f",
            TextureFormat::Bc4 => "bc4",
            TextureFormat::Bc3 => "bc3",
            TextureFormat::Bc7 => "bc7",
        }
    }

    /// The codec of a brick store whose bricks hold the same numbers.
    pub fn codec(self) -> Codec {
        let block = |format| Codec::Block { format, axis: PackingAxis::Z };
        match self {
            TextureFormat::R8 => Codec::Uniform { bits: 8 },
            TextureFormat::R16F => Codec::F16,
            TextureFormat::Bc4 => block(BlockFormat::Bc4),
            TextureFormat::Bc3 => block(BlockFormat::Bc3),
            TextureFormat::Bc7 => block(BlockFormat::Bc7),
        }
    }

    /// The voxels of a texel, which follow each other along z.
    pub fn channels(self) -> u32 {
        match self {
            TextureFormat::R8 | TextureFormat::R16F | TextureFormat::Bc4 => 1,
            TextureFormat::Bc3 | TextureFormat::Bc7 => 4,
        }
    }

    /// The texels of a brick along x, y, z.
    pub fn brick_texels(self) -> [u32; 3] {
        [8, 8, 8 / self.channels()]
    }

    /// The texels of a block along x and along y; 1 where there are no blocks.
    pub fn block_texels(self) -> u32 {
        match self {
            TextureFormat::R8 | TextureFormat::R16F => 1,
            TextureFormat::Bc4 | TextureFormat::Bc3 | TextureFormat::Bc7 => 4,
        }
    }

    /// The bytes of a block, or of a texel where there are no blocks.
    pub fn block_bytes(self) -> u32 {
        match self {
            TextureFormat::R8 => 1,
            TextureFormat::R16F => 2,
            TextureFormat::Bc4 => 8,
            TextureFormat::Bc3 | TextureFormat::Bc7 => 16,
        }
    }

    /// The bytes of a brick.
    pub fn brick_bytes(self) -> u32 {
        let [x, y, z] = self.brick_texels();
        (x / self.block_texels()) * (y / self.block_texels()) * z * self.block_bytes()
    }
}

/// A texture of bricks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    format: TextureFormat,
    /// At least one each.
    bricks: [u32; 3],
}

impl Layout {
    /// A texture for so many bricks: of all that are large enough the one whose box of texels has the least surface,
    /// which is near to a cube and leaves little room unused. `None` if none is large enough.
    pub fn for_bricks(format: TextureFormat, count: u32) -> Option<Layout> {
        let texels = format.brick_texels();
        let most = texels.map(|texels| MAX_TEXELS / texels);
        let mut best: Option<([u64; 2], Layout)> = None;
        for y in 1..=most[1] {
            for x in 1..=most[0] {
                let z = count.div_ceil(x * y).max(1);
                if z > most[2] {
                    continue;
                }
                let layout = Layout { format, bricks: [x, y, z] };
                let [width, height, depth] = layout.size().map(u64::from);
                let surface = width * height + height * depth + depth * width;
                let cost = [surface, width * height * depth];
                if best.is_none_or(|(least, _)| cost < least) {
                    best = Some((cost, layout));
                }
            }
        }
        best.map(|(_, layout)| layout)
    }

    /// The kind of texel.
    pub fn format(&self) -> TextureFormat {
        self.format
    }

    /// The bricks that fit along x, y, z.
    pub fn bricks(&self) -> [u32; 3] {
        self.bricks
    }

    /// Where a brick stands, counted in bricks. Numbers past the last come out beyond the texture, along z.
    pub fn place(&self, number: u32) -> [u32; 3] {
        let [x, y, _] = self.bricks;
        [number % x, number / x % y, number / x / y]
    }

    /// The number of the brick that stands somewhere, counted in bricks. `None` outside of the texture.
    pub fn number(&self, place: [u32; 3]) -> Option<u32> {
        let [x, y, _] = self.bricks;
        let is_inside = place.iter().zip(self.bricks).all(|(at, count)| *at < count);
        is_inside.then(|| (place[2] * y + place[1]) * x + place[0])
    }

    /// The first texel of a brick.
    pub fn origin(&self, number: u32) -> [u32; 3] {
        let (place, texels) = (self.place(number), self.format.brick_texels());
        std::array::from_fn(|axis| place[axis].saturating_mul(texels[axis]))
    }

    /// The texel and the channel of a voxel of a brick.
    pub fn texel(&self, number: u32, voxel: [u32; 3]) -> ([u32; 3], u32) {
        let (origin, channels) = (self.origin(number), self.format.channels());
        let within = [voxel[0], voxel[1], voxel[2] / channels];
        (std::array::from_fn(|axis| origin[axis].saturating_add(within[axis])), voxel[2] % channels)
    }

    /// The texels along x, y, z.
    pub fn size(&self) -> [u32; 3] {
        let texels = self.format.brick_texels();
        std::array::from_fn(|axis| self.bricks[axis] * texels[axis])
    }

    /// The bytes of a row of blocks, or of texels.
    pub fn row_bytes(&self) -> u64 {
        u64::from(self.size()[0] / self.format.block_texels()) * u64::from(self.format.block_bytes())
    }

    /// The bytes of a slice.
    pub fn slice_bytes(&self) -> u64 {
        u64::from(self.size()[1] / self.format.block_texels()) * self.row_bytes()
    }

    /// The bytes of all.
    pub fn size_bytes(&self) -> u64 {
        u64::from(self.size()[2]) * self.slice_bytes()
    }

    /// Where the block that holds a texel begins.
    pub fn byte_offset(&self, texel: [u32; 3]) -> u64 {
        let block = u64::from(self.format.block_texels());
        let [x, y, z] = texel.map(u64::from);
        z * self.slice_bytes()
            + y / block * self.row_bytes()
            + x / block * u64::from(self.format.block_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn formats() -> impl Strategy<Value = TextureFormat> {
        prop::sample::select(TextureFormat::ALL.as_slice())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn every_brick_has_a_place_of_its_own(format in formats(), count in 0_u32..3000) {
            let layout = Layout::for_bricks(format, count).unwrap();
            for number in 0..count {
                prop_assert_eq!(layout.number(layout.place(number)), Some(number));
                let (origin, texels) = (layout.origin(number), format.brick_texels());
                for axis in 0..3 {
                    prop_assert!(origin[axis] + texels[axis] <= layout.size()[axis]);
                    prop_assert_eq!(origin[axis] / texels[axis], layout.place(number)[axis]);
                }
            }
            let [x, y, z] = layout.bricks;
            prop_assert_eq!(layout.number([x, 0, 0]), None);
            prop_assert_eq!(layout.number([0, y, 0]), None);
            prop_assert_eq!(layout.number([0, 0, z]), None);
            prop_assert_eq!(layout.place(x * y * z), [0, 0, z]);
        }

        #[test]
        fn textures_keep_to_the_limit_and_waste_little(format in formats(), count in 1_u32..9_000_000) {
            let layout = Layout::for_bricks(format, count).unwrap();
            let (size, all) = (layout.size(), layout.bricks.iter().product::<u32>());
            prop_assert!(size.iter().all(|texels| *texels <= MAX_TEXELS));
            prop_assert!(all >= count);
            prop_assert_eq!(layout.size_bytes(), u64::from(all) * u64::from(format.brick_bytes()));
            if count > 1000 {
                prop_assert!(all - count <= count / 16, "{all} for {count}");
                let (least, most) = (size.iter().min().unwrap(), size.iter().max().unwrap());
                prop_assert!(*most <= 2 * least, "{size:?}");
            }
        }

        #[test]
        fn the_voxels_of_a_brick_are_all_the_channels_of_its_texels(format in formats(), number in 0_u32..200) {
            let layout = Layout::for_bricks(format, 200).unwrap();
            let mut taken = std::collections::HashSet::new();
            let mut blocks = std::collections::HashSet::new();
            for voxel in 0..512 {
                let (texel, channel) = layout.texel(number, [voxel >> 6, voxel >> 3 & 7, voxel & 7]);
                prop_assert!(taken.insert((texel, channel)) && channel < format.channels());
                for (axis, at) in texel.iter().enumerate() {
                    let first = layout.origin(number)[axis];
                    prop_assert!((first..first + format.brick_texels()[axis]).contains(at));
                }
                let block = layout.byte_offset(texel);
                prop_assert!(block + u64::from(format.block_bytes()) <= layout.size_bytes());
                blocks.insert(block);
            }
            prop_assert_eq!(blocks.len() as u32 * format.block_bytes(), format.brick_bytes());
        }
    }

    #[test]
    fn small_and_large_textures_are_what_one_would_choose() {
        let bricks = |format, count| Layout::for_bricks(format, count).map(|layout| layout.bricks);
        assert_eq!(bricks(TextureFormat::R8, 0), Some([1, 1, 1]));
        assert_eq!(bricks(TextureFormat::R8, 7), Some([2, 2, 2]));
        assert_eq!(bricks(TextureFormat::R8, 1000), Some([10, 10, 10]));
        assert_eq!(bricks(TextureFormat::Bc7, 256), Some([4, 4, 16]));
        assert_eq!(bricks(TextureFormat::R8, 256 * 256 * 256), Some([256; 3]));
        assert_eq!(bricks(TextureFormat::R8, 256 * 256 * 256 + 1), None);
        assert_eq!(bricks(TextureFormat::Bc3, 256 * 256 * 1024), Some([256, 256, 1024]));
        assert_eq!(bricks(TextureFormat::Bc3, u32::MAX), None);
    }
}
