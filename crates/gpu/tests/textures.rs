//! Bricks of texture blocks: the same pictures whether a device decodes them or shaders do, and on devices that cannot.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use std::path::Path;
use std::process::Command;

use common::{gpu, host, lit, picture};
use nuage_gpu::arrays::{Arrays, Bricks, Meaning, Wanted};
use nuage_gpu::device::Gpu;
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::{SizeBytes, Volume};
use nuage_pipeline::pack::options::Options;
use nuage_render::views::View;
use nuage_volume::codec::Codec;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};
use nuage_volume::format::Asset;

/// What tells this program, as a child of itself, that SwiftShader is its device.
const CHILD: &str = "NUAGE_SWIFTSHADER_CHILD";

/// What the same numbers differ by, since shaders differ in which operations they fuse.
const ROUNDING: f32 = 1e-5;

/// A volume's bricks in one format of blocks.
fn blocks(format: BlockFormat) -> Asset {
    let codec = Some(Codec::Block { format, axis: PackingAxis::Y });
    let options = Options { codec, max_error: None, psnr: None, ..Options::default() };
    common::packed(&[vec![common::grid("density")]], &options)
}

fn arrays_of(asset: &Asset, form: Bricks) -> Arrays {
    let wanted = [Wanted { name: "density".to_owned(), meaning: Meaning::Density }];
    Arrays::of_asset(asset, &wanted, 0..1, form).expect("arrays")
}

/// A picture of all of a volume, and what it takes.
fn show(gpu: &Gpu, renderer: &mut Renderer, asset: &Asset, form: Bricks) -> (Vec<[f32; 4]>, SizeBytes) {
    let look = Look::of_scene(&lit(&common::unpacked(asset, 0, "density"))).expect("a look");
    let volume = Volume::new(gpu, &arrays_of(asset, form)).expect("a volume");
    let pass = Pass::View(View::Density { extinction: look.media[0].extinction[0] });
    (picture(renderer, &volume, &look, &pass, 0), volume.size_bytes())
}

fn renderer(gpu: &Gpu) -> Renderer {
    Renderer::new(gpu, [80, 45]).expect("a renderer")
}

fn worst_of(a: &[[f32; 4]], b: &[[f32; 4]]) -> f32 {
    let apart =
        |(a, b): (&[f32; 4], &[f32; 4])| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    a.iter().zip(b).map(apart).fold(0.0, f32::max)
}

/// On whatever device there is, bricks as it takes them best give the picture that shaders give by decoding them.
#[test]
fn textures_show_what_buffers_do() {
    let Some(gpu) = gpu() else { return };
    let form = gpu.smallest_bricks().expect("a form");
    let is_child = std::env::var_os(CHILD).is_some();
    if is_child {
        assert!(gpu.name().contains("SwiftShader"), "{}", gpu.name());
        assert_eq!(form, Bricks::AsStored, "its fault is noticed");
    }
    let mut renderer = renderer(&gpu);
    let assets = [
        ("BC4", blocks(BlockFormat::Bc4), 2.0 / 255.0),
        ("BC3", blocks(BlockFormat::Bc3), 2.0 / 255.0),
        ("BC7", blocks(BlockFormat::Bc7), ROUNDING),
    ];
    // SwiftShader takes long to make a shader.
    for (name, asset, bound) in assets.into_iter().filter(|(name, ..)| !is_child || *name == "BC7") {
        let (decoded, in_buffers) = show(&gpu, &mut renderer, &asset, Bricks::AsStored);
        let (read, in_textures) = show(&gpu, &mut renderer, &asset, form);
        let worst = worst_of(&read, &decoded);
        println!(
            "{name}, {form:?}: off by {:.3}/255 at most, {in_textures:?} instead of {in_buffers:?}",
            255.0 * worst
        );
        assert!(worst <= bound, "{name}: {worst}");
        assert!(decoded.iter().filter(|pixel| pixel[3] > 0.1).count() > 300, "{name} is seen");
        let sum = |size: SizeBytes| size.bricks + size.textures;
        // A number for each brick, and room in the last layer.
        assert!(sum(in_textures) <= sum(in_buffers) * 21 / 20 + 4096, "{name}");
        assert!(form == Bricks::AsStored || in_textures.textures > 0, "{name}");
    }
}

/// With nothing of textures: what a device without them is given, and that it is not given them.
#[test]
fn devices_without_block_textures_show_the_same() {
    let Some(with) = gpu() else { return };
    let without = host(wgpu::Limits::default()).expect("a device");
    assert_eq!(without.smallest_bricks(), Ok(Bricks::AsStored));
    let asset = blocks(BlockFormat::Bc7);
    let refused = Volume::new(&without, &arrays_of(&asset, Bricks::Textures)).map(drop);
    assert!(matches!(refused, Err(GpuError::Misuse(_))), "{refused:?}");
    let form = with.smallest_bricks().expect("a form");
    let (read, _) = show(&with, &mut renderer(&with), &asset, form);
    let (decoded, size) = show(&without, &mut renderer(&without), &asset, Bricks::AsStored);
    assert_eq!(size.textures, 0);
    assert!(worst_of(&read, &decoded) <= ROUNDING, "{}", worst_of(&read, &decoded));
}

/// SwiftShader reads garbage from textures of blocks in compute shaders: it is found out, and gets its bricks in buffers.
#[test]
fn swiftshader_shows_the_same() {
    let driver = Path::new("/usr/lib/chromium/vk_swiftshader_icd.json");
    if std::env::var_os(CHILD).is_some() {
        return;
    }
    if !driver.exists() {
        nuage_testkit::left_out("swiftshader", "the driver that comes with chromium");
        return;
    }
    let child = Command::new(std::env::current_exe().expect("this program"))
        .args(["--exact", "textures_show_what_buffers_do", "--nocapture"])
        .env("VK_DRIVER_FILES", driver)
        .env(CHILD, "1")
        .output()
        .expect("a child");
    let said = String::from_utf8_lossy(&child.stdout);
    assert!(child.status.success(), "{said}{}", String::from_utf8_lossy(&child.stderr));
    assert!(said.contains("BC7, AsStored"), "{said}");
}
