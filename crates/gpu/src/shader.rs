//! Shaders as text: a prelude of constants that are printed from the Rust that they belong to, then the files of
//! `shader/` in an order such that each pass has what it calls. No number stands in both.
//!
//! What does not live here: pipelines ([`crate::renderer`]).

use std::fmt::Write as _;
use std::mem::offset_of;

use nuage_render::color::Blackbody;
use nuage_render::filter::Lookup;
use nuage_render::{color, envmap, hash, march, math, path, phase, surface, traverse};
use nuage_volume::brick::f32_from_finite_f16;
use nuage_volume::codec::block::{BlockFormat, PackingAxis, bc7};
use nuage_volume::codec::{self, Codec, bounds, sparse};
use nuage_volume::packed::{Entry, RootCell, mask};
use nuage_volume::space::{
    BRICK_VOXELS, LOG2_BRICK, LOG2_NODE4_BRICKS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS,
};

use crate::blocks::FORMATS;
use crate::build;
use crate::hdda::{ADD_VOXELS, Layer, MEET_VOXEL, PASS_SAMPLES, PASS_VOXELS};
use crate::maps::{self, ABSENT_TAG};
use crate::params::{self, Field, MAX_LIGHTS, MAX_MEDIA};
use crate::upload::FIRST_TEXTURE;
use crate::{blue_noise, light_volume, real_time, rounds};

/// Pixels along each side of a workgroup.
pub(crate) const WORKGROUP_SIDE: u32 = 8;
/// The most random numbers of one path, and leaps of one ray over regions of many bricks: paths and volumes that ask for more
/// would keep a device busy until its driver takes it for lost.
const MAX_DRAWS: u32 = 1 << 20;
const MAX_LEAPS: u32 = 1 << 16;
/// The opacity from which on a pixel is marked: it is not known yet, or cannot be since the driver left loops before their end.
/// A power of two, so that what is multiplied by it comes back.
pub(crate) const UNSOUND: f32 = -((1_u128 << 100) as f32);
/// The turns of the loop that tells, which a loop that is left after one does not take.
pub(crate) const TELLING_TURNS: u32 = 2;
/// The words in front of the arrays of trees that say where each begins.
pub(crate) const HEADER_WORDS: usize = 8;

/// What a shader is made for: what does not occur is left out of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Features {
    /// The kinds of codecs that occur, by [`CODEC_KINDS`].
    pub(crate) codecs: u32,
    /// The formats of blocks that stand in textures, a bit each: then all blocks do.
    pub(crate) textures: u32,
    /// How many buffers hold the bricks.
    pub(crate) chunks: u32,
    /// log2 of the words of such a buffer.
    pub(crate) log2_chunk_words: u32,
    /// How many media there are.
    pub(crate) media: u32,
    /// Whether one of them is a box or a ball.
    pub(crate) has_solids: bool,
    /// The channel of the first medium's densities, and that which its shadow rays read.
    pub(crate) density_channels: [u32; 2],
    /// Whether something glows, and the channel that does in the first medium.
    pub(crate) glow_channel: Option<u32>,
    /// Whether extinction is the same for all colours.
    pub(crate) is_grey: bool,
    /// How values between voxels are looked up.
    pub(crate) lookup: Lookup,
    /// Whether shadow rays of the marcher take no steps.
    pub(crate) has_exact_shadows: bool,
    /// Whether the sky is a picture, and whether each collision looks for it.
    pub(crate) sky_map: [bool; 2],
    /// Whether rays end at a host's depth buffer.
    pub(crate) has_depth: bool,
    /// Whether bricks are looked up in maps.
    pub(crate) has_maps: bool,
    /// Whether all values mean themselves.
    pub(crate) are_densities: bool,
    /// What a view shows. Others have none.
    pub(crate) view: u32,
    /// Whether a view takes more than four samples in a voxel, of which there are seven at most.
    pub(crate) has_short_steps: bool,
    /// Whether pictures follow each other, with what `real_time.wgsl` does for them.
    pub(crate) is_real_time: bool,
    /// Whether the sun's light is read from the light volume.
    pub(crate) has_light_volume: bool,
    /// Whether a target takes encoded colours.
    pub(crate) encodes_srgb: bool,
    /// Whether look-ups are counted in place of light.
    pub(crate) counts: bool,
}

impl Features {
    /// What is least of all.
    pub(crate) const BARE: Features = Features {
        codecs: 0,
        textures: 0,
        chunks: 1,
        log2_chunk_words: 0,
        media: 1,
        has_solids: false,
        density_channels: [0, 0],
        glow_channel: None,
        is_grey: true,
        lookup: Lookup::Trilinear,
        has_exact_shadows: false,
        sky_map: [false, false],
        has_depth: false,
        has_maps: false,
        are_densities: true,
        view: 0,
        has_short_steps: false,
        is_real_time: false,
        has_light_volume: false,
        encodes_srgb: false,
        counts: false,
    };

    /// All there is.
    #[cfg(test)]
    pub(crate) const ALL: Features = Features {
        codecs: u32::MAX,
        textures: 0,
        chunks: 2,
        log2_chunk_words: 25,
        media: 3,
        has_solids: true,
        density_channels: [0, 2],
        glow_channel: Some(1),
        is_grey: false,
        lookup: Lookup::StochasticTrilinear,
        has_exact_shadows: true,
        sky_map: [true, true],
        has_depth: false,
        has_maps: true,
        are_densities: false,
        view: 0,
        has_short_steps: true,
        is_real_time: false,
        has_light_volume: false,
        encodes_srgb: true,
        counts: false,
    };

    /// What matters to a shader: all, but to those that read nothing of the volume.
    pub(crate) fn of(self, source: Source) -> Features {
        match source {
            Source::Upsample | Source::Accumulate => {
                Features { has_depth: self.has_depth, is_real_time: self.is_real_time, ..Features::BARE }
            }
            _ => self,
        }
    }

    /// Whether there is one grid and nothing else.
    fn is_one_grid(&self) -> bool {
        self.media == 1 && !self.has_solids
    }
}

/// The channel of densities, or of what glows, of a medium that has none.
pub(crate) const SOLID_CHANNEL: u32 = u32::MAX - 1;

/// The filters, as shaders number them.
const LOOKUPS: [(Lookup, &str); 5] = [
    (Lookup::Nearest, "LOOKUP_NEAREST"),
    (Lookup::Trilinear, "LOOKUP_TRILINEAR"),
    (Lookup::Tricubic, "LOOKUP_TRICUBIC"),
    (Lookup::StochasticTrilinear, "LOOKUP_STOCHASTIC_TRILINEAR"),
    (Lookup::StochasticTricubic, "LOOKUP_STOCHASTIC_TRICUBIC"),
];

/// The number of a filter.
fn lookup_number(lookup: Lookup) -> u32 {
    LOOKUPS.iter().position(|(known, _)| *known == lookup).unwrap_or(0) as u32
}

/// The kinds of codecs of which decoders can be left out.
const CODEC_KINDS: [&str; 10] =
    ["F32", "F16", "UNIFORM", "SPARSE", "SPLIT", "BLOCK", "LATTICE", "GRADIENT", "SHARED", "UNEVEN"];

/// The bit of a codec's kind.
pub(crate) fn codec_bit(codec: Codec) -> u32 {
    let kind = match codec {
        Codec::Constant => return 0,
        Codec::F32 => 0,
        Codec::F16 => 1,
        // Codes that reach over the ends of words are a kind of their own.
        Codec::Uniform { bits } if u32::BITS % u32::from(bits) != 0 => return 1 << 2 | 1 << 9,
        Codec::Uniform { .. } => 2,
        Codec::Sparse { .. } => 3,
        Codec::Split { .. } => 4,
        Codec::Block { .. } => 5,
        Codec::Lattice { .. } => 6,
        Codec::Gradient { .. } => 7,
        Codec::Shared => 8,
    };
    1 << kind
}

/// What a shader does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Source {
    /// The debug views.
    Views,
    /// The surface of a level set.
    Surface,
    /// The ray marcher.
    March,
    /// The ray marcher, a share of its work at a time.
    MarchOn,
    /// The path tracer.
    Path,
    /// The path tracer, a share of its work at a time.
    PathOn,
    /// The light volume.
    LightVolume,
    /// From pictures of a quarter of the pixels to all of them.
    Upsample,
    /// The mean of pictures that follow each other.
    Accumulate,
    /// The volume's shadow on a scene.
    Shadow,
    /// From sums of light to a target.
    Tone,
    /// Small functions over many inputs, for tests.
    #[cfg(test)]
    Twins,
    /// Walks that tell what they visit, for tests.
    #[cfg(test)]
    Visits,
}

macro_rules! file {
    ($name:literal) => {
        include_str!(concat!("shader/", $name, ".wgsl"))
    };
}

/// What all but [`Source::Tone`] begin with.
const COMMON: [&str; 11] = [
    file!("math"),
    file!("hash"),
    file!("phase"),
    file!("color"),
    file!("bindings"),
    file!("tree"),
    file!("block"),
    file!("codec"),
    file!("brick"),
    file!("filter"),
    file!("walk"),
];

impl Source {
    /// The name of the entry point; of [`Source::Tone`] that of the fragment shader.
    pub(crate) fn entry_point(self) -> &'static str {
        match self {
            Source::Views => "views",
            Source::Surface => "surface",
            Source::March => "march",
            Source::MarchOn => "march_on",
            Source::Path => "path",
            Source::PathOn => "path_on",
            Source::LightVolume => "light_volume",
            Source::Upsample => "upsample",
            Source::Accumulate => "accumulate",
            Source::Shadow => "shadow",
            Source::Tone => "tone",
            #[cfg(test)]
            Source::Twins => "twins",
            #[cfg(test)]
            Source::Visits => "visits",
        }
    }

    /// The whole text.
    pub(crate) fn text(self, features: &Features) -> String {
        let picture = "@group(1) @binding(1) var<storage, read_write> picture: array<vec4<f32>>;\n";
        let mut text = prelude(features);
        if self == Source::Tone {
            text += "@group(1) @binding(1) var<storage, read> picture_read: array<vec4<f32>>;\n";
            for part in [file!("math"), file!("phase"), file!("color"), file!("bindings"), file!("tone")] {
                text += part;
            }
            return text;
        }
        text += picture;
        text += &brick_words(features);
        text += &block_texels(features);
        text += match self {
            Source::MarchOn | Source::PathOn => file!("share"),
            _ if features.counts => file!("count"),
            _ => file!("no_count"),
        };
        COMMON.iter().for_each(|part| text += part);
        let end = if features.has_depth { file!("depth_end") } else { file!("open_end") };
        let kind = if features.is_real_time { file!("real_time") } else { file!("still") };
        let [first_voxel, nearest_steps, samples, voxel_depth] =
            [MEET_VOXEL, PASS_VOXELS, PASS_SAMPLES, ADD_VOXELS].map(|body| body.text(features.has_maps));
        let sky_map = if features.sky_map[0] { file!("envmap") } else { file!("even_sky") };
        let media = if features.is_one_grid() { file!("one_grid") } else { file!("media") };
        let marching = [
            file!("camera"),
            file!("emission"),
            end,
            kind,
            file!("cells"),
            file!("depth"),
            &voxel_depth,
            file!("march"),
        ];
        let tracing = [
            file!("camera"),
            file!("emission"),
            end,
            file!("light"),
            sky_map,
            file!("solid"),
            file!("track"),
            media,
            file!("path"),
        ];
        let own: &[&str] = match self {
            Source::Views => &[
                file!("camera"),
                file!("cells"),
                file!("depth"),
                file!("views"),
                &first_voxel,
                &voxel_depth,
                &nearest_steps,
                &samples,
            ],
            Source::Surface => &[file!("camera"), file!("cells"), file!("surface")],
            Source::March => &marching,
            Source::MarchOn => &[&marching[..], &[file!("band"), file!("march_on")]].concat(),
            Source::Shadow => &[&marching[..], &[file!("shadow")]].concat(),
            Source::LightVolume => &[file!("camera"), file!("light_volume")],
            Source::Upsample => &[file!("camera"), end, file!("upsample")],
            Source::Accumulate => &[file!("camera"), end, file!("accumulate")],
            Source::Path => &tracing,
            Source::PathOn => &[&tracing[..], &[file!("band"), file!("path_on")]].concat(),
            Source::Tone => &[],
            #[cfg(test)]
            Source::Twins => &[file!("twins")],
            #[cfg(test)]
            Source::Visits => {
                &[file!("cells"), file!("visits"), &crate::hdda::tests::bodies(features.has_maps)]
            }
        };
        own.iter().for_each(|part| text += part);
        text
    }
}

/// The shader that builds trees, into bricks of so many buffers, and maps of them.
pub(crate) fn build_text(chunks: u32, log2_chunk_words: u32, has_maps: bool) -> String {
    let features = Features { codecs: 0, chunks, log2_chunk_words, has_maps, ..Features::BARE };
    let mut text = prelude(&features);
    for chunk in 0..chunks {
        let binding = build::BRICKS_BINDING + chunk;
        let _ = writeln!(
            text,
            "@group(0) @binding({binding}) var<storage, read_write> bricks_{chunk}: array<u32>;"
        );
    }
    text += "fn set_brick_word(at: u32, word: u32) {\n";
    let _ = writeln!(text, "    let within = at & ((1u << {log2_chunk_words}u) - 1u);");
    let _ = writeln!(text, "    switch (at >> {log2_chunk_words}u) {{");
    for chunk in 1..chunks {
        let _ = writeln!(text, "        case {chunk}u: {{ bricks_{chunk}[within] = word; }}");
    }
    text += "        default: { bricks_0[within] = word; }\n    }\n}\n";
    text + file!("density") + file!("build") + file!("maps")
}

/// The shader that puts lists of voxels into dense arrays.
pub(crate) fn scatter_text() -> String {
    prelude(&Features::BARE) + file!("density") + file!("scatter")
}

/// Reads a word of the bricks, from whichever buffer holds it.
fn brick_words(features: &Features) -> String {
    let mut text = String::new();
    for chunk in 0..features.chunks {
        let _ = writeln!(
            text,
            "@group(0) @binding({}) var<storage, read> bricks_{chunk}: array<u32>;",
            3 + chunk
        );
    }
    text += "fn brick_word(at: u32) -> u32 {\n";
    if features.chunks > 1 {
        let shift = features.log2_chunk_words;
        let _ =
            writeln!(text, "    let within = at & ((1u << {shift}u) - 1u);\n    switch (at >> {shift}u) {{");
        for chunk in 1..features.chunks {
            let _ = writeln!(text, "        case {chunk}u: {{ return bricks_{chunk}[within]; }}");
        }
        text += "        default: { return bricks_0[within]; }\n    }\n}\n";
    } else {
        text += "    return bricks_0[at];\n}\n";
    }
    text
}

/// Reads a texel of the texture of a format, and how wide it is.
fn block_texels(features: &Features) -> String {
    let there: Vec<usize> =
        (0..FORMATS.len()).filter(|format| features.textures >> format & 1 == 1).collect();
    let mut text = String::new();
    for format in &there {
        let binding = FIRST_TEXTURE + *format as u32;
        let _ = writeln!(text, "@group(0) @binding({binding}) var blocks_{format}: texture_3d<f32>;");
    }
    let mut function = |head: &str, none: &str, read: &dyn Fn(usize) -> String| {
        let _ = writeln!(text, "fn {head} {{\n    switch (format) {{");
        for format in &there {
            let _ = writeln!(text, "        case {format}u: {{ return {}; }}", read(*format));
        }
        let _ = writeln!(text, "        default: {{ return {none}; }}\n    }}\n}}");
    };
    function("block_texel(format: u32, at: vec3<u32>) -> vec4<f32>", "vec4<f32>(0.0)", &|format| {
        format!("textureLoad(blocks_{format}, at, 0)")
    });
    function("blocks_width(format: u32) -> u32", "1u << LOG2_BRICK", &|format| {
        format!("textureDimensions(blocks_{format}).x")
    });
    text
}

/// The shader that reads a texture of blocks to see whether a device does.
pub(crate) fn probe() -> String {
    let mut p = Prelude(String::new());
    p.u("WORKGROUP_SIDE", WORKGROUP_SIDE);
    p.0 + file!("probe")
}

/// Where tables stand in the buffer of tables.
pub(crate) mod tables {
    use super::bc7;

    pub(crate) const BC7_MODES: usize = 0;
    pub(crate) const BC7_WEIGHTS: usize = BC7_MODES + 10 * bc7::MODES.len();
    /// Weights of indices of n bits begin at 2ⁿ.
    pub(crate) const BC7_TWO_SUBSETS: usize = BC7_WEIGHTS + 32;
    pub(crate) const BC7_THREE_SUBSETS: usize = BC7_TWO_SUBSETS + 64;
    pub(crate) const BC7_TWO_ANCHOR: usize = BC7_THREE_SUBSETS + 64;
    pub(crate) const BC7_THREE_SECOND_ANCHOR: usize = BC7_TWO_ANCHOR + 64;
    pub(crate) const BC7_THREE_THIRD_ANCHOR: usize = BC7_THREE_SECOND_ANCHOR + 64;

    /// All tables.
    pub(crate) fn words() -> Vec<u32> {
        let mut words = Vec::with_capacity(BC7_THREE_THIRD_ANCHOR + 64);
        for mode in &bc7::MODES {
            words.extend([mode.subsets as u32, mode.partition, mode.rotation, mode.selection, mode.colour]);
            words.extend([mode.alpha, mode.endpoint_low, mode.shared_low, mode.index, mode.second_index]);
        }
        words.extend([0; 4]);
        words.extend(bc7::WEIGHTS_2.map(u32::from));
        words.extend(bc7::WEIGHTS_3.map(u32::from));
        words.extend(bc7::WEIGHTS_4.map(u32::from));
        words.extend(bc7::TWO_SUBSETS.map(u32::from));
        words.extend(bc7::THREE_SUBSETS);
        for anchors in [bc7::TWO_ANCHOR, bc7::THREE_SECOND_ANCHOR, bc7::THREE_THIRD_ANCHOR] {
            words.extend(anchors.map(u32::from));
        }
        words
    }
}

/// Constants as WGSL has them.
struct Prelude(String);

impl Prelude {
    fn u(&mut self, name: &str, value: impl TryInto<u32>) {
        // What is printed here are small constants of this program.
        let value = value.try_into().unwrap_or(u32::MAX);
        let _ = writeln!(self.0, "const {name}: u32 = {value}u;");
    }

    fn i(&mut self, name: &str, value: i32) {
        let _ = writeln!(self.0, "const {name}: i32 = {value};");
    }

    fn f(&mut self, name: &str, value: f32) {
        let _ = writeln!(self.0, "const {name}: f32 = {value:e}f;");
    }

    fn b(&mut self, name: &str, value: bool) {
        let _ = writeln!(self.0, "const {name}: bool = {value};");
    }
}

fn prelude(features: &Features) -> String {
    let mut p = Prelude(String::new());
    p.u("WORKGROUP_SIDE", WORKGROUP_SIDE);
    p.u("MAX_LIGHTS", MAX_LIGHTS);
    p.f("MAX_F32", f32::MAX);
    p.f("MIN_F32", f32::MIN_POSITIVE);
    p.u("NONE", u32::MAX);

    p.f("LOG2_E", std::f32::consts::LOG2_E);
    p.f("PI", std::f32::consts::PI);
    p.f("TAU", std::f32::consts::TAU);
    p.f("LN_2_HIGH", math::LN_2_HIGH);
    p.f("LN_2_LOW", math::LN_2_LOW);
    p.f("EXP_LOWEST", math::EXP_LOWEST);
    p.f("EXP_HIGHEST", math::EXP_HIGHEST);
    p.f("OPAQUE_DEPTH", math::OPAQUE_DEPTH);
    p.i("ROOT_HALF", math::ROOT_HALF);
    p.f("TAN_SIXTEENTH", math::TAN_SIXTEENTH);
    let series = [
        ("EXP", &math::EXP_SERIES[..]),
        ("LN", &math::LN_SERIES),
        ("SIN", &math::SIN_SERIES),
        ("COS", &math::COS_SERIES),
        ("ATAN", &math::ATAN_SERIES),
    ];
    for (name, terms) in series {
        terms.iter().enumerate().for_each(|(i, term)| p.f(&format!("{name}_SERIES_{i}"), *term));
    }
    p.u("HASH_FIRST", hash::HASH_FACTORS[0]);
    p.u("HASH_SECOND", hash::HASH_FACTORS[1]);
    p.u("GOLDEN", hash::GOLDEN);
    p.f("UNIT_STEP", hash::UNIT_STEP);
    p.u("PLASTIC_X", hash::PLASTIC_STEPS[0]);
    p.u("PLASTIC_Y", hash::PLASTIC_STEPS[1]);

    p.f("MAX_ASYMMETRY", phase::MAX_ASYMMETRY);
    p.f("MAX_ALPHA", phase::MAX_ALPHA);
    p.f("DRAINE_TOLERANCE", phase::TOLERANCE);
    p.u("DRAINE_MAX_STEPS", phase::MAX_STEPS);
    p.f("SRGB_LINEAR_END", color::SRGB_LINEAR_END);
    p.f("SRGB_SLOPE", color::SRGB_SLOPE);
    p.f("SRGB_SCALE", color::SRGB_SCALE);
    p.f("SRGB_OFFSET", color::SRGB_OFFSET);
    p.f("SRGB_GAMMA", color::SRGB_GAMMA);
    p.f("COLDEST_KELVIN", Blackbody::COLDEST_KELVIN);
    p.f("HOTTEST_KELVIN", Blackbody::HOTTEST_KELVIN);
    p.f("BLACKBODY_STEPS", Blackbody::STEPS as f32);
    p.u("BLACKBODY_ROWS", params::BLACKBODY_ROWS);

    p.u("LOG2_BRICK", LOG2_BRICK);
    p.u("LOG2_NODE4_BRICKS", LOG2_NODE4_BRICKS);
    p.u("LOG2_NODE5_BRICKS", LOG2_NODE5_BRICKS);
    p.i("NODE5_BRICKS", 1 << LOG2_NODE5_BRICKS);
    p.f("BRICK_SIDE", (1 << LOG2_BRICK) as f32);
    p.f("NODE5_SIDE", (1 << (LOG2_NODE5_BRICKS + LOG2_BRICK)) as f32);
    p.u("NODE4_SUMMARY_WORDS", NODE4_SLOTS / 1024);
    p.u("NODE5_SUMMARY_WORDS", NODE5_SLOTS / 1024);
    p.u("CELL_WORDS", size_of::<RootCell>() / 4);
    for (i, name) in
        ["CELLS", "NODE5S", "NODE4S", "ENTRIES", "MASKS", "SHAPES", "FIELDS_PER_FRAME"].iter().enumerate()
    {
        p.u(name, i);
    }
    p.u("ABSENT_TAG", ABSENT_TAG);
    p.u("NODE4_TILE_TAG", maps::TILE_TAGS[0]);
    p.u("NODE5_TILE_TAG", maps::TILE_TAGS[1]);
    p.u("MAP_CELL_WORDS", maps::CELL_WORDS);
    p.u("FURTHEST", maps::FURTHEST);
    p.u("VIEW", features.view);
    p.b("HAS_SHORT_STEPS", features.has_short_steps);
    p.b("ARE_DENSITIES", features.are_densities);
    p.b("HAS_MAPS", features.has_maps);
    p.u("NODE_TAG", Entry::NODE);
    p.u("CONSTANT_TAG", Codec::Constant.tag());
    p.u("BOUND_SIGN", bounds::SIGN);
    p.u("BOUND_EXPONENT_OFFSET", bounds::EXPONENT_OFFSET);
    p.u("BOUND_DROPPED_BITS", bounds::DROPPED_BITS);
    // What a sample leaves of the light at least, and how far rounding moves faces, as a part of a ray's length.
    p.f("LEAST_SHARE", 0.5 * f32::EPSILON);
    p.f("FACE_BLUR", 4.0 * f32::EPSILON);
    p.u("BRICK_LAYER", Layer::Brick as u32);
    p.u("VOXEL_LAYER", Layer::Voxel as u32);

    p.u("LANES", build::LANES);
    p.u("GROUP_BRICKS", build::GROUP_BRICKS);
    p.u("COUNT_WORDS", build::COUNT_WORDS);
    p.u("NODE_INFO_ROWS", build::NODE_INFO_ROWS);
    p.u("NODE_INFO_WORDS", build::NODE_INFO_WORDS);
    p.u("NODE4_MASK_WORDS", NODE4_SLOTS / 32);
    p.u("NODE5_MASK_WORDS", NODE5_SLOTS / 32);
    p.u("NODE4_MOST_WORDS", mask::most_words(NODE4_SLOTS));
    p.u("BRICK_VOXELS", BRICK_VOXELS);
    p.u("FIELD_WORDS", size_of::<Field>() / 4);
    p.u("FIELD_BOUNDS_UNIT", offset_of!(Field, bounds_min) / 4 + 3);
    p.u("FIELD_CELL_COUNT", offset_of!(Field, box_first) / 4 + 3);
    p.u("MEANS_FOG", build::MEANS_FOG);
    p.u("MEANS_SURFACE", build::MEANS_SURFACE);
    p.u("MIN_F32_BITS", f32::MIN_POSITIVE.to_bits());
    p.u("ONE", 1.0_f32.to_bits());

    p.f("HALF_SUBNORMAL_STEP", f32_from_finite_f16(1));
    p.u("LAST_UNIFORM_TAG", Codec::Uniform { bits: 8 }.tag());
    p.u("F16_TAG", Codec::F16.tag());
    p.u("F32_TAG", Codec::F32.tag());
    p.u("SHARED_TAG", Codec::Shared.tag());
    p.u("FIRST_GRADIENT_TAG", Codec::Gradient { bits: 0 }.tag());
    p.u("FIRST_LATTICE_TAG", Codec::Lattice { bits: 0 }.tag());
    p.u("FIRST_BLOCK_TAG", Codec::Block { format: BlockFormat::Bc4, axis: PackingAxis::X }.tag());
    p.u("FIRST_SPLIT_TAG", Codec::Split { bits: 1 }.tag());
    p.u("FIRST_SPARSE_TAG", codec::SPARSE_TAG);
    p.u("FIRST_FITTED_TAG", codec::SPARSE_FITTED_TAG);
    p.u("SPARSE_BENT", sparse::BENT);
    p.f("SPARSE_BENT_START", sparse::BENT_START);
    p.f("SPARSE_BENT_GROWTH", sparse::BENT_GROWTH);
    p.u("SPARSE_HAS_ENDS", sparse::HAS_ENDS);
    p.f("SPARSE_LAST_END", sparse::LAST_END);
    CODEC_KINDS
        .iter()
        .enumerate()
        .for_each(|(i, name)| p.b(&format!("HAS_{name}"), features.codecs >> i & 1 == 1));
    let plain = codec_bit(Codec::F32) | codec_bit(Codec::F16) | codec_bit(Codec::Uniform { bits: 3 });
    p.b("ARE_FLOATS", features.codecs & !codec_bit(Codec::F32) == 0);
    p.b("HAS_OTHER_CODECS", features.codecs & !plain != 0);
    p.b("HAS_TEXTURES", features.textures != 0);
    p.u("BC7_MODES", tables::BC7_MODES);
    p.u("BC7_WEIGHTS", tables::BC7_WEIGHTS);
    p.u("BC7_TWO_SUBSETS", tables::BC7_TWO_SUBSETS);
    p.u("BC7_THREE_SUBSETS", tables::BC7_THREE_SUBSETS);
    p.u("BC7_TWO_ANCHOR", tables::BC7_TWO_ANCHOR);
    p.u("BC7_THREE_SECOND_ANCHOR", tables::BC7_THREE_SECOND_ANCHOR);
    p.u("BC7_THREE_THIRD_ANCHOR", tables::BC7_THREE_THIRD_ANCHOR);

    p.u("MAX_DRAWS", MAX_DRAWS);
    p.u("MAX_LEAPS", MAX_LEAPS);
    p.u("MAX_ROOT_LEAPS", traverse::MAX_ROOT_LEAPS);
    p.i("MAX_ROOT_LEAP", traverse::MAX_ROOT_LEAP as i32);
    p.u("MOST_REFINEMENTS", surface::MOST_REFINEMENTS);
    // Gauss' rule of two points.
    p.f("GAUSS_NODE", 1.0 / 3.0_f32.sqrt());
    p.f("LIT_PIECE_DEPTH", march::LIT_PIECE_DEPTH);
    p.f("LIT_PIECE_VOXELS", march::LIT_PIECE_VOXELS);
    p.f("MOST_PIECES", march::MOST_PIECES);
    p.f("GROUP_VOXELS", march::GROUP_VOXELS);
    p.f("FAINT_GROUP", march::FAINT_GROUP);
    p.f("FAINT_GROUP_VOXELS", march::FAINT_GROUP_VOXELS);
    p.u("SKY_SEED", march::SKY_SEEDS[0]);
    p.u("SKY_DIRECTION_SEED", march::SKY_SEEDS[1]);
    p.f("ROULETTE_WEIGHT", path::ROULETTE_WEIGHT);
    p.f("ROULETTE_TRANSMITTANCE", path::ROULETTE_TRANSMITTANCE);
    p.f("OPAQUE", path::OPAQUE);

    p.u("LIGHT_SUN", params::LIGHT_SUN);
    p.u("LIGHT_SPOT", params::LIGHT_SPOT);
    p.u("LIGHT_SPHERE", params::LIGHT_SPHERE);
    p.b("HAS_EXACT_SHADOWS", features.has_exact_shadows);
    p.u("SHAPE_GRID", params::SHAPE_GRID);
    p.u("SHAPE_BALL", params::SHAPE_BALL);
    p.u("SOLID_CHANNEL", SOLID_CHANNEL);
    p.u("MAX_MEDIA", MAX_MEDIA);
    p.u("MEDIA", features.media);
    p.b("HAS_SOLIDS", features.has_solids);
    p.f("ENVIRONMENT_PARTS", envmap::PARTS as f32);
    p.b("HAS_SKY_RAYS", features.sky_map[1]);
    LOOKUPS.iter().for_each(|(lookup, name)| p.u(name, lookup_number(*lookup)));
    p.u("LOOKUP", lookup_number(features.lookup));
    p.u("MEAN_LOOKUP", lookup_number(features.lookup.mean()));
    let is_wide = features.lookup.mean() == Lookup::Tricubic;
    p.b("IS_WIDE", is_wide);
    p.f("REACH", f32::from(u8::from(is_wide)));
    p.u("DENSITY_CHANNEL", features.density_channels[0]);
    p.u("SHADOW_CHANNEL", features.density_channels[1]);
    p.u("GLOW_CHANNEL", features.glow_channel.unwrap_or(0));
    p.b("HAS_EMISSION", features.glow_channel.is_some());
    p.b("IS_GREY", features.is_grey);
    p.b("HAS_DEPTH", features.has_depth);
    p.b("HAS_LIGHT_VOLUME", features.has_light_volume);
    p.u("LIGHT_NODES", light_volume::NODES);
    p.u("NOISE_SIDE", blue_noise::SIDE);
    p.f("LEAST_WEIGHT", real_time::LEAST_WEIGHT);
    p.f("UPSAMPLE_TOLERANCE", real_time::UPSAMPLE_TOLERANCE);
    p.f("KEPT_TOLERANCE", real_time::KEPT_TOLERANCE);
    p.b("ENCODES_SRGB", features.encodes_srgb);
    // What is accumulated would not forget.
    p.b("CHECKS_LOOPS", !features.is_real_time && !features.counts);
    p.f("UNSOUND", UNSOUND);
    p.u("BAND_PIXELS", rounds::BAND_PIXELS);
    for (i, name) in [
        "VIEW_DENSITY",
        "VIEW_DEPTH",
        "VIEW_INDEX",
        "VIEW_FIRST_DENSITY",
        "VIEW_HITS",
        "VIEW_NEAREST",
        "VIEW_TRILINEAR",
    ]
    .iter()
    .enumerate()
    {
        p.u(name, i);
    }
    p.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    fn validate(text: &str) {
        let module = naga::front::wgsl::parse_str(text)
            .unwrap_or_else(|error| panic!("{}", error.emit_to_string(text)));
        // With no capability beyond those of WebGPU.
        let mut validator = Validator::new(ValidationFlags::all(), Capabilities::empty());
        validator.validate(&module).unwrap_or_else(|error| panic!("{}", error.emit_to_string(text)));
    }

    #[test]
    fn every_entry_point_is_valid() {
        let sources = [
            Source::Views,
            Source::Surface,
            Source::March,
            Source::MarchOn,
            Source::Path,
            Source::PathOn,
            Source::LightVolume,
            Source::Upsample,
            Source::Accumulate,
            Source::Shadow,
            Source::Tone,
            Source::Twins,
            Source::Visits,
        ];
        let tricubic = Features { lookup: Lookup::Tricubic, glow_channel: Some(0), ..Features::BARE };
        validate(&probe());
        let textures = Features { textures: 7, ..Features::ALL };
        let depth = Features { has_depth: true, chunks: 4, textures: 4, counts: true, ..Features::ALL };
        let real_time = Features { is_real_time: true, has_light_volume: true, ..tricubic };
        let cut = Features { has_depth: true, has_exact_shadows: true, ..real_time };
        for features in [Features::ALL, Features::BARE, tricubic, textures, depth, real_time, cut] {
            for source in sources {
                let text = source.text(&features);
                validate(&text);
                assert!(text.contains(&format!("fn {}(", source.entry_point())), "{source:?}");
            }
        }
        for (chunks, has_maps) in [(1, false), (4, true)] {
            let text = build_text(chunks, 25, has_maps);
            validate(&text);
            for step in build::STEPS.iter().chain(&build::MAP_STEPS) {
                assert!(text.contains(&format!("fn {step}(")), "{step}");
            }
        }
        validate(&scatter_text());
    }

    #[test]
    fn tables_are_as_long_as_they_say() {
        let words = tables::words();
        assert_eq!(words[tables::BC7_WEIGHTS + 4], 0);
        assert_eq!(words[tables::BC7_WEIGHTS + 31], 64);
        assert_eq!(words[tables::BC7_TWO_SUBSETS], u32::from(bc7::TWO_SUBSETS[0]));
        assert_eq!(words[tables::BC7_THREE_THIRD_ANCHOR + 63], u32::from(bc7::THREE_THIRD_ANCHOR[63]));
        assert_eq!(words.len(), tables::BC7_THREE_THIRD_ANCHOR + 64);
    }
}
