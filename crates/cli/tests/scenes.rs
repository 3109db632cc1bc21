//! Scene files: the scenes with known answers, which lie beside this file, and what is wrong with others.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use nuage_testkit as testkit;
use nuage_testkit::blocks::{Estimate, hold};
use nuage_testkit::npy::{read_f32, read_raw_f64};

const SIDE: usize = 128;
const PIXELS: usize = SIDE * SIDE;

type Pixels = Vec<[f32; 4]>;

fn nuage(options: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nuage"));
    command.arg("render").args(options).stdin(Stdio::null()).output().unwrap()
}

fn stderr(output: &Output) -> &str {
    std::str::from_utf8(&output.stderr).unwrap()
}

/// That it worked.
fn done(options: &[&str]) {
    let output = nuage(options);
    assert_eq!((output.status.code(), stderr(&output)), (Some(0), ""), "{options:?}");
}

/// That it ended with that exit code and said this.
fn fails(options: &[&str], code: i32, message: &str) {
    let output = nuage(options);
    assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
    assert!(stderr(&output).contains(message), "'{message}' is not in: {}", stderr(&output));
}

fn scene(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scenes").join(name);
    path.with_extension("toml").display().to_string()
}

fn blast(name: &str) -> String {
    testkit::workspace().join("assets/blast").join(name).display().to_string()
}

/// A file with an answer; `None`, after saying so, where the large ones are absent.
fn oracle(name: &str) -> Option<PathBuf> {
    testkit::find(&format!("oracle/{name}"))
}

fn exr(path: &Path) -> Pixels {
    let image = exr::prelude::read_first_rgba_layer_from_file(
        path,
        |size, _| (size.width(), vec![[0.0f32; 4]; size.width() * size.height()]),
        |(width, pixels), at, (r, g, b, a): (f32, f32, f32, f32)| {
            pixels[at.y() * *width + at.x()] = [r, g, b, a];
        },
    );
    image.unwrap().layer_data.channel_data.pixels.1
}

/// Pictures of a scene with so many seeds, one beside the other.
fn pictures(name: &str, seeds: u32, options: &[&str]) -> Vec<Pixels> {
    let folder = tempfile::tempdir().unwrap();
    let picture = |seed: u32| {
        let path = folder.path().join(format!("{seed}.exr"));
        let (scene, seed) = (scene(name), (seed + 1).to_string());
        let own = ["--scene", &scene, "--output", path.to_str().unwrap(), "--exr-float", "--seed", &seed];
        done(&[&own, options].concat());
        exr(&path)
    };
    (0..seeds).map(picture).collect()
}

/// Holds a scene to its answer, three values per pixel with their standard errors. Each of the pictures of `seeds` has `samples`
/// paths per pixel.
fn holds(name: &str, seeds: u32, samples: &str, expected: &[f64], stderr: &[f64]) {
    let pictures = pictures(name, seeds, &["--samples", samples]);
    let count = f64::from(seeds);
    for colour in 0..3 {
        let ours = |i: usize| {
            let each = || pictures.iter().map(|picture| f64::from(picture[i][colour]));
            let mean = each().sum::<f64>() / count;
            let variance = each().map(|value| (value - mean).powi(2)).sum::<f64>() / (count * (count - 1.0));
            Estimate { mean, variance }
        };
        let theirs =
            |i: usize| Estimate { mean: expected[3 * i + colour], variance: stderr[3 * i + colour].powi(2) };
        let ours: Vec<Estimate> = (0..PIXELS).map(ours).collect();
        let theirs: Vec<Estimate> = (0..PIXELS).map(theirs).collect();
        hold(&format!("{name} {colour}"), SIDE, &ours, &theirs);
    }
}

/// Holds a scene to converged pictures of another renderer.
fn holds_to_another_renderer(name: &str, seeds: u32, samples: &str) {
    let read = |what: &str| -> Option<Vec<f64>> {
        Some(read_f32(&oracle(&format!("{name}_{what}.npy"))?).into_iter().map(f64::from).collect())
    };
    if let (Some(mean), Some(stderr)) = (read("mean"), read("stderr")) {
        holds(name, seeds, samples, &mean, &stderr);
    }
}

#[test]
fn a_cloud_that_scatters_evenly_is_that_of_another_renderer() {
    holds_to_another_renderer("het64_g0", 6, "8");
}

#[test]
fn a_cloud_that_scatters_forward_is_that_of_another_renderer() {
    holds_to_another_renderer("het64_g08", 6, "8");
}

#[test]
fn light_that_is_scattered_once_is_that_of_another_renderer() {
    holds_to_another_renderer("het64_g0_ss", 6, "10");
}

#[test]
fn a_homogeneous_sphere_is_that_of_another_renderer() {
    holds_to_another_renderer("homog_sphere", 6, "8");
}

#[test]
fn transmittance_and_emission_follow_the_quadrature() {
    // The reference is the mean over 4 × 4 rays of a pixel; ours goes over the pixel itself.
    let exact = vec![0.0; 3 * PIXELS];
    let colours = |file: &str, by: [f64; 3]| -> Vec<f64> {
        let values = read_raw_f64(&oracle(file).expect("a committed file"));
        values.into_iter().flat_map(|value| by.map(|by| by * value)).collect()
    };
    // Paths that pass are counted: where hardly any does, a few of them do not tell their own error.
    let through = colours("trans_box4x4.f64", [1.0; 3]);
    let counted: Vec<f64> =
        through.iter().map(|share| (share * (1.0 - share) / 72.0).max(0.0).sqrt()).collect();
    holds("het64_trans", 6, "12", &through, &counted);
    holds("emission", 8, "20", &colours("emit_box4x4.f64", [6.0, 2.5, 0.8]), &exact);
}

/// Nothing is lost in a medium that absorbs nothing: it cannot be seen before a sky of the same light.
#[test]
fn furnaces_are_white() {
    for (name, samples) in
        [("het64_furnace", "64"), ("homog_cube_furnace", "224"), ("homog_sphere_furnace", "160")]
    {
        let blind = pictures(name, 1, &["--samples", "2", "--no-sky-rays"]);
        for pixel in blind.iter().flatten() {
            assert!(pixel[..3].iter().all(|value| (value - 1.0).abs() < 1e-4), "{name}: {pixel:?}");
        }
        let seeing = pictures(name, 1, &["--samples", samples]);
        let mean = seeing.iter().flatten().map(|pixel| f64::from(pixel[1])).sum::<f64>() / PIXELS as f64;
        println!("{name}: {mean}");
        assert!((mean - 1.0).abs() < 1e-3, "{name}: {mean}");
    }
}

/// What is saved says the same as the options, and what is read and saved again says the same once more.
#[test]
fn a_saved_scene_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let small = "--size 20x16 --step 2 --shadow-step 4 --sun-rays 4 --sky-rays 1";
    let small = &small.split_whitespace().collect::<Vec<_>>()[..];
    let input = blast("blast.####.vdb");
    let marched = format!(
        "{input} -o {} --frames 3,9 --up z --flame flame --sun 0.3,1,0.7 --filter tricubic",
        at("a.####.exr")
    );
    let traced = format!(
        "{} -o {} --up 0.1,0,1 --temperature temperature --integrator path --lod 1 --filter stochastic-trilinear",
        blast("blast.0009.vdb"),
        at("b.exr")
    );
    let stage = at("stage.toml");
    fs::write(&stage, STAGE.replace("FILE", &blast("blast.0009.vdb"))).unwrap();
    let staged = format!("--scene {stage} -o {}", at("c.exr"));
    for (name, options) in [("a.0009.exr", marched), ("b.exr", traced), ("c.exr", staged)] {
        let options: Vec<&str> = options.split_whitespace().collect();
        let (once, twice) = (at("once.toml"), at("twice.toml"));
        done(&[&options, small, &["--save-scene", &once, "--overwrite"]].concat());
        let first = fs::read(at(name)).unwrap();
        fs::remove_file(at(name)).unwrap();
        done(&["--scene", &once, "--save-scene", &twice, "--overwrite"]);
        assert!(first == fs::read(at(name)).unwrap(), "{name}: {}", fs::read_to_string(&once).unwrap());
        assert_eq!(fs::read_to_string(&once).unwrap(), fs::read_to_string(&twice).unwrap());
        assert!(!fs::read_to_string(&once).unwrap().contains("auto"), "everything is settled");
    }
}

/// Something of each kind.
const STAGE: &str = r#"
[camera]
up = "z"
fov = 30
[integrator]
kind = "path"
samples = 2
seed = 7
[sky]
zenith = [0.1, 0.2, 0.4]
horizon = 0.5
[[lights]]
kind = "sun"
position = [-30, 20]
irradiance = 3
angle = 5
[[lights]]
kind = "point"
position = [1, 2, 3]
power = [30, 20, 10]
[[lights]]
kind = "spot"
position = [5, 5, 5]
look_at = [1, 2, 0]
intensity = 20
angle = 50
inner_angle = 33.3
[[lights]]
kind = "sphere"
centre = [-3, 0, 4]
radius = 0.7
radiance = [3, 2, 1]
[[volumes]]
file = "FILE"
transform = { translate = [1, 0, 0], rotate = [0, 0, 30], scale = 1.1 }
emission = { temperature = "temperature", kelvin = 900 }
[[volumes]]
box = { min = [0, 0, 0], max = [4, 4, 0.5] }
extinction = [0.3, 0.1, 0.2]
albedo = [0.9, 0.8, 0.7]
phase = -0.3
[[volumes]]
sphere = { radius = 0.8 }
transform = { matrix = [[1, 0, 0, 2], [0, 2, 0, 2], [0, 0.5, 1, 2]] }
extinction = 2
emission = { color = [0.1, 0.3, 0.1] }
"#;

#[test]
fn a_picture_of_an_even_sky_is_an_even_sky() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    exr::prelude::write_rgb_file(at("sky.exr"), 16, 8, |_, _| (0.25_f32, 0.5_f32, 1.0_f32)).unwrap();
    let mean = |name: &str, sky: &str| {
        let volume = "[[volumes]]\nsphere = { radius = 1 }\nextinction = 2\nphase = { droplets = 8 }\n";
        let text =
            format!("[film]\nsize = 24\n[integrator]\nkind = \"path\"\nsamples = 48\n[sky]\n{sky}\n{volume}");
        fs::write(at(name), text).unwrap();
        done(&["--scene", &at(name), "-o", &at("x.exr"), "--exr-float", "--overwrite"]);
        let pixels = exr(Path::new(&at("x.exr")));
        assert_eq!(pixels[0], [0.5, 1.0, 2.0, 1.0], "the sky in the corner");
        pixels.iter().map(|pixel| f64::from(pixel[1])).sum::<f64>() / pixels.len() as f64
    };
    let (map, even) =
        (mean("a.toml", "map = \"sky.exr\"\nscale = 2\nturn = 30"), mean("b.toml", "radiance = [0.5, 1, 2]"));
    assert!((map / even - 1.0).abs() < 0.02, "{map} {even}");
    fs::write(at("c.toml"), "[sky]\nmap = \"c.toml\"\n[integrator]\nkind = \"path\"\n").unwrap();
    fails(&["--scene", &at("c.toml"), "-o", &at("y.exr")], 1, "c.toml");
}

/// Each filter and each level makes a picture of its own, in both renderers; and the picture says what it was made with.
#[test]
fn filters_and_levels_are_seen_and_said() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let input = blast("blast.0009.vdb");
    let own = ["--size", "24x24", "--up", "z", "--exr-float", "--overwrite"];
    for integrator in ["march", "path"] {
        let mut seen: Vec<Vec<u8>> = Vec::new();
        let options = [
            "--lod 0",
            "--lod 1",
            "--lod 2",
            "--filter nearest",
            "--filter tricubic",
            "--filter stochastic-trilinear",
            "--filter stochastic-tricubic",
        ];
        for options in options {
            let output = at("x.exr");
            let options: Vec<&str> = options.split_whitespace().collect();
            let start = [&input, "-o", &output, "--integrator", integrator];
            done(&[&start[..], &own, &options].concat());
            let picture = fs::read(&output).unwrap();
            assert!(!seen.contains(&picture), "{integrator} {options:?}");
            seen.push(picture);
        }
    }
    let output = at("layers.exr");
    let traced = ["--integrator", "path", "--aovs", "--samples", "1", "--lod", "2", "--filter", "tricubic"];
    done(&[&[input.as_str(), "-o", &output][..], &own, &traced].concat());
    let head = String::from_utf8_lossy(&fs::read(&output).unwrap()).into_owned();
    assert!(head.contains("\nlod = 2\n") && head.contains("\nfilter = \"tricubic\"\n"));
    for options in [["--lod", "1"], ["--filter", "nearest"]] {
        let view = [&input, "-o", &at("view.exr"), "--view", "depth"];
        fails(&[&view[..], &options].concat(), 2, "leave out --lod and --filter");
    }
}

#[test]
fn options_overrule_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let (file, saved, picture) = (at("a.toml"), at("b.toml"), at("x.exr"));
    let volume =
        format!("[[volumes]]\nfile = \"{}\"\nextinction = 3\nalbedo = 0.5\n", blast("blast.0009.vdb"));
    let text = format!("[camera]\nfov = 20\nup = \"z\"\n[film]\nsize = 8\n[sky]\nradiance = 1\n{volume}");
    fs::write(&file, &text).unwrap();
    let options = "--fov 25 --albedo 0.75 --sky 0.25 --sun 10,20 --size 9x7";
    let own = ["--scene", &file, "-o", &picture, "--save-scene", &saved];
    done(&[&own[..], &options.split_whitespace().collect::<Vec<_>>()].concat());
    let saved = fs::read_to_string(&saved).unwrap();
    for line in [
        "fov = 25",
        "albedo = 0.75",
        "radiance = 0.25",
        "position = [10, 20]",
        "size = [9, 7]",
        "extinction = 3",
    ] {
        assert!(saved.lines().any(|found| found == line), "{line}: {saved}");
    }
    // Which of two is meant is not said.
    fs::write(&file, format!("{text}{volume}")).unwrap();
    fails(&["--scene", &file, "-o", &at("y.exr"), "--albedo", "0.3"], 2, "--albedo is about one volume");
    fails(
        &["--scene", &file, "-o", &at("y.exr")],
        2,
        "--integrator march cannot render more than one volume",
    );
    fails(&["--scene", &file], 2, "--output");
    fails(&["-o", &at("y.exr")], 2, "INPUT");
    assert!(!Path::new(&at("y.exr")).exists());
}

#[test]
fn what_is_wrong_with_a_file_is_said_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let file = at("a.toml");
    let solid = "[[volumes]]\nsphere = { radius = 1 }\n";
    for (text, message) in [
        (
            "[camera]\nfov = 20\nfoo = 1\n",
            "a.toml: line 3, column 1: camera has no key 'foo'; there are position",
        ),
        ("[camara]\n", "line 1, column 2: a scene has no key 'camara'"),
        ("[camera]\n  fov = 200\n", "line 2, column 9: fov: an angle between 0 and 180 degrees"),
        ("[camera]\nfov = nan\n", "line 2, column 7: fov"),
        ("[camera]\nposition = [1, 2]\n", "line 2, column 12: position: three numbers"),
        ("[camera]\nposition = [1, 2, inf]\n", "line 2, column 12: position"),
        ("[camera\n", "line 1, column 8"),
        ("camera = 3\n", "line 1, column 10: camera: a table is needed"),
        ("[film]\nsize = [70000, 70000]\n", "line 2, column 8: size"),
        ("[film]\nsize = true\n", "line 2, column 8: size: a number"),
        ("[integrator]\nkind = \"magic\"\n", "line 2, column 8: kind: 'march' or 'path'"),
        ("[integrator]\nfilter = \"soft\"\n", "line 2, column 10: filter: 'nearest', 'trilinear'"),
        ("[integrator]\nlod = 13\n", "line 2, column 7: lod: a whole number from 0 to 12"),
        ("[integrator]\nsamples = -1\n", "line 2, column 11: samples: a whole number from 1"),
        ("[output]\nframes = \"x\"\n", "line 2, column 10: frames"),
        ("[output]\nthreads = 0\n", "line 2, column 11: threads"),
        ("[sky]\nradiance = -1\n", "line 2, column 12: radiance"),
        ("[sky]\nzenith = 1\n", "a sky has either radiance, or zenith"),
        ("[[lights]]\nkind = \"moon\"\n", "'moon' is no kind of light"),
        ("[[lights]]\nkind = \"sun\"\nposition = [1, 2]\n", "lights needs the key 'irradiance'"),
        ("[[lights]]\nkind = \"point\"\nposition = [1, 2, 3]\n", "either intensity or power"),
        ("[[lights]]\nkind = \"sphere\"\ncentre = [1, 2, 3]\nradius = 1e-30\npower = 1\n", "too bright"),
        (solid, "need the key 'extinction'"),
        (&format!("{solid}extinction = \"auto\"\n"), "'auto' is for volumes with a file"),
        (&format!("{solid}extinction = 1e300\n"), "line 3, column 14: extinction"),
        (&format!("{solid}extinction = 1\nalbedo = 1.5\n"), "line 4, column 10: albedo"),
        (&format!("{solid}extinction = 1\nfile = \"a.vdb\"\n"), "either a file, a box or a sphere"),
        (&format!("{solid}extinction = 1\ntransform = {{ scale = 0 }}\n"), "line 4"),
        (&format!("{solid}extinction = 1\ntransform = {{ matrix = [[1, 2], 3] }}\n"), "3 rows of 4 numbers"),
        (&format!("{solid}extinction = 1\nemission = {{ flame = \"f\" }}\n"), "glow everywhere alike"),
        ("[[volumes]]\nbox = { min = [0, 0, 0], max = [1, 1, 0] }\nextinction = 1\n", "max of a box"),
        ("[[volumes]]\nfile = \"nowhere.vdb\"\n", "nowhere.vdb"),
    ] {
        fs::write(&file, text).unwrap();
        fails(&["--scene", &file, "-o", &at("x.exr")], 1, message);
    }
    fails(&["--scene", &at("nowhere.toml"), "-o", &at("x.exr")], 1, "cannot read the scene file");
    fails(&["--scene", &at(""), "-o", &at("x.exr")], 1, "this is no file");
    let many = "volumes = [".to_owned() + &"[".repeat(100_000);
    fs::write(&file, many).unwrap();
    fails(&["--scene", &file, "-o", &at("x.exr")], 1, "line 1");
    fs::write(&file, [0xff, 0xfe]).unwrap();
    fails(&["--scene", &file, "-o", &at("x.exr")], 1, "cannot read the scene file");
}
