//! `nuage render` as a user runs it: pictures, sequences, messages and exit codes, on committed data and with
//! tiny pictures. What `nuage demo` adds is tested beside it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use nuage_testkit as testkit;
use tempfile::TempDir;

/// Options that make a picture small and quick, unless a test gives its own.
const SMALL: [&str; 8] = [
    "--up z",
    "--size 32",
    "--samples 1",
    "--step 2",
    "--shadow-step 4",
    "--sun-rays 4",
    "--sky-rays 1",
    "--density 4",
];

fn blast(name: &str) -> PathBuf {
    testkit::workspace().join("assets/blast").join(name)
}

fn edge(name: &str) -> PathBuf {
    testkit::committed("data/edge").join(name)
}

fn run(input: &Path, output: &Path, options: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nuage"))
        .arg("render")
        .arg(input)
        .arg("--output")
        .arg(output)
        .args(options.split_whitespace())
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

fn render(input: &Path, output: &Path, options: &str) -> Output {
    let given = |small: &str| {
        let name = small.split_whitespace().next();
        options.split_whitespace().any(|word| Some(word) == name)
    };
    let small: Vec<&str> = SMALL.into_iter().filter(|small| !given(small)).collect();
    run(input, output, &format!("{} {options}", small.join(" ")))
}

fn stderr(output: &Output) -> &str {
    std::str::from_utf8(&output.stderr).unwrap()
}

/// That it worked, and had nothing to say.
fn done(output: &Output) {
    assert_eq!((output.status.code(), stderr(output)), (Some(0), ""));
}

/// That it ended with that exit code and said this.
fn fails(output: &Output, code: i32, message: &str) {
    assert_eq!(output.status.code(), Some(code), "{}", stderr(output));
    assert!(stderr(output).contains(message), "'{message}' is not in: {}", stderr(output));
}

/// The size and the RGBA codes of a PNG file.
fn png(path: &Path) -> (u32, u32, Vec<[u8; 4]>) {
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgba, png::BitDepth::Eight));
    (info.width, info.height, bytes.as_chunks().0.to_vec())
}

/// The size and the pixels of an EXR file.
fn exr(path: &Path) -> (usize, usize, Vec<[f32; 4]>) {
    let image = exr::prelude::read_first_rgba_layer_from_file(
        path,
        |size, _| (size.width(), vec![[0.0f32; 4]; size.width() * size.height()]),
        |(width, pixels), at, (r, g, b, a): (f32, f32, f32, f32)| {
            pixels[at.y() * *width + at.x()] = [r, g, b, a];
        },
    )
    .unwrap();
    let size = image.layer_data.size;
    (size.width(), size.height(), image.layer_data.channel_data.pixels.1)
}

/// The names in a folder.
fn names(folder: &TempDir) -> Vec<String> {
    let entries = fs::read_dir(folder.path()).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn one_file_becomes_a_png_or_an_exr_with_alpha_if_asked() {
    let folder = tempfile::tempdir().unwrap();
    let input = blast("blast.0012.vdb");

    let path = folder.path().join("a.png");
    done(&render(&input, &path, "--size 40x24 --background none"));
    let (width, height, pixels) = png(&path);
    assert_eq!((width, height), (40, 24));
    assert_eq!(pixels[0], [0; 4], "nothing is in the corner");
    assert!(pixels.iter().any(|p| p[3] > 200 && p[0] > 30), "something dense and lit is in the picture");

    let opaque = folder.path().join("b.png");
    done(&render(&input, &opaque, "--size 40x24 --background 0.2,0.4,0.8"));
    let (_, _, pixels) = png(&opaque);
    assert!(pixels.iter().all(|p| p[3] == 255));
    assert_eq!(pixels[0], [124, 170, 231, 255], "the background in sRGB");
    assert!(pixels.iter().any(|p| p != &pixels[0]));

    for options in ["", "--exr-float"] {
        let path = folder.path().join("c.exr");
        done(&render(&input, &path, &format!("--size 40x24 --overwrite --background none {options}")));
        let (width, height, pixels) = exr(&path);
        assert_eq!((width, height, pixels[0]), (40, 24, [0.0; 4]));
        assert!(
            pixels.iter().any(|p| p[3] > 0.8 && p[0] > 0.02),
            "something dense and lit is in the picture"
        );
        assert!(pixels.iter().flatten().all(|x| x.is_finite()));
    }
    let opaque = folder.path().join("d.exr");
    done(&render(&input, &opaque, "--background 0.25,0.5,1 --exposure 1"));
    let (_, _, pixels) = exr(&opaque);
    assert_eq!(pixels[0], [0.5, 1.0, 2.0, 1.0], "linear, and not clamped");
    assert!(pixels.iter().all(|p| p[3] == 1.0));
}

#[test]
fn fire_glows_in_the_dark() {
    let folder = tempfile::tempdir().unwrap();
    let dark = "--sun none --sky 0 --background 0";
    for (name, options) in [
        ("dark", ""),
        ("temperature", "--temperature temperature"),
        ("flame", "--flame flame"),
        ("dim", "--flame flame --emission 0.001"),
    ] {
        let path = folder.path().join(name).with_extension("exr");
        done(&render(&blast("blast.0004.vdb"), &path, &format!("{dark} {options}")));
        let (_, _, pixels) = exr(&path);
        let red = pixels.iter().map(|p| p[0]).fold(0.0, f32::max);
        let blue = pixels.iter().map(|p| p[2]).fold(0.0, f32::max);
        match name {
            "dark" => assert_eq!(red, 0.0),
            "dim" => assert!(red > 0.0 && red < 0.01, "{red}"),
            _ => assert!(red > 0.3 && red > 2.0 * blue, "{name}: red {red}, blue {blue}"),
        }
    }
}

#[test]
fn a_sequence_is_named_in_four_ways() {
    let expected = ["x.0001.png", "x.0006.png", "x.0011.png", "x.0016.png"];
    let mut pictures: Vec<Vec<Vec<u8>>> = Vec::new();
    for (input, output) in [
        ("blast.####.vdb", "x.####.png"),
        ("blast.%04d.vdb", "x.%04d.png"),
        ("blast.*.vdb", "x.$F4.png"),
        ("", "x.####.png"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        done(&render(&blast(input), &folder.path().join(output), "--size 16 --frames 1-16x5"));
        assert_eq!(names(&folder), expected, "{input} to {output}");
        pictures.push(expected.map(|name| fs::read(folder.path().join(name)).unwrap()).into());
    }
    assert!(pictures.iter().all(|set| *set == pictures[0]), "the way it is named changes nothing");
    assert_ne!(pictures[0][0], pictures[0][3]);
}

#[test]
fn all_frames_are_seen_from_one_place() {
    let folder = tempfile::tempdir().unwrap();
    let outcome = render(
        &blast("blast.####.vdb"),
        &folder.path().join("x.####.png"),
        "--frames 1,16 --timing --density auto",
    );
    assert_eq!(outcome.status.code(), Some(0));
    let settled: Vec<&str> = stderr(&outcome).lines().filter(|line| line.contains("--camera")).collect();
    assert_eq!(settled.len(), 1, "{}", stderr(&outcome));
    assert_eq!(stderr(&outcome).lines().filter(|line| line.contains("read ")).count(), 2);
    for frame in ["0001", "0016"] {
        // What --timing prints repeats the shot, up to the rounding of the direction.
        let alone = folder.path().join("alone.png");
        let options = format!("{} --overwrite", settled[0]);
        done(&render(&blast(&format!("blast.{frame}.vdb")), &alone, &options));
        let (_, _, together) = png(&folder.path().join(format!("x.{frame}.png")));
        let (_, _, alone) = png(&alone);
        let difference = together.iter().flatten().zip(alone.iter().flatten()).map(|(a, b)| a.abs_diff(*b));
        assert!(difference.max() <= Some(2), "frame {frame}");
    }
}

#[test]
fn missing_and_damaged_frames_are_named_and_the_others_rendered() {
    let input = tempfile::tempdir().unwrap();
    for frame in ["0001", "0003", "0004", "0005"] {
        fs::copy(blast(&format!("blast.{frame}.vdb")), input.path().join(format!("b.{frame}.vdb"))).unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let pattern = input.path().join("b.####.vdb");
    let outcome = render(&pattern, &folder.path().join("x.####.png"), "--frames 1-4");
    fails(&outcome, 0, "frames not there: 2");
    assert_eq!(names(&folder), ["x.0001.png", "x.0003.png", "x.0004.png"]);

    let cut_off = input.path().join("b.0003.vdb");
    let bytes = fs::read(&cut_off).unwrap();
    for length in [bytes.len() / 2, 100, 0] {
        fs::write(&cut_off, &bytes[..length]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let outcome = render(&pattern, &folder.path().join("x.####.png"), "");
        fails(&outcome, 1, "b.0003.vdb");
        assert_eq!(names(&folder), ["x.0001.png", "x.0004.png", "x.0005.png"], "cut off at {length}");
    }
}

#[test]
fn pictures_that_are_there_stay_unless_asked() {
    let folder = tempfile::tempdir().unwrap();
    let input = blast("blast.####.vdb");
    let output = folder.path().join("x.####.png");
    let mine = folder.path().join("x.0002.png");
    fs::write(&mine, "mine").unwrap();

    let outcome = render(&input, &output, "--frames 1-3");
    fails(&outcome, 1, "x.0002.png");
    assert!(stderr(&outcome).contains("--overwrite") && stderr(&outcome).contains("--resume"));
    assert_eq!((names(&folder), fs::read(&mine).unwrap()), (vec!["x.0002.png".to_owned()], b"mine".to_vec()));

    done(&render(&input, &output, "--frames 1-3 --resume"));
    assert_eq!(names(&folder), ["x.0001.png", "x.0002.png", "x.0003.png"]);
    assert_eq!(fs::read(&mine).unwrap(), b"mine");
    let resumed = png(&folder.path().join("x.0003.png"));

    fs::remove_file(&mine).unwrap();
    fs::write(&mine, "mine").unwrap();
    done(&render(&input, &output, "--frames 1-3 --overwrite"));
    assert_eq!(png(&mine).0, 32);
    assert_eq!(png(&folder.path().join("x.0003.png")), resumed, "a resumed frame is as it would have been");
}

#[test]
fn an_output_that_cannot_hold_the_frames_is_refused_with_a_way_out() {
    let folder = tempfile::tempdir().unwrap();
    let outcome = render(&blast("blast.####.vdb"), &folder.path().join("x.png"), "");
    fails(&outcome, 1, "x.####.png");
    fails(&render(&blast("blast.0001.vdb"), &folder.path().join("x.jpg"), ""), 2, ".png or .exr");
    fails(&render(&blast("blast.0001.vdb"), &folder.path().join("nowhere/x.png"), ""), 1, "nowhere");
    fails(
        &render(&blast("blast.####.vdb"), &folder.path().join("x.####.png"), "--frames 50-60"),
        1,
        "1 to 16",
    );
    fails(&render(&blast("nothing.vdb"), &folder.path().join("x.png"), ""), 1, "nothing.vdb");
    assert!(names(&folder).is_empty());
}

#[test]
fn wrong_options_are_wrong_usage() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.png");
    for options in [
        "--size 0x10",
        "--size 100000x100000",
        "--size big",
        "--samples 0",
        "--step 0",
        "--step nan",
        "--fov 180",
        "--albedo 1.5",
        "--phase 1",
        "--density -1",
        "--sun 0,0,0",
        "--sun-irradiance -1",
        "--background grey",
        "--exposure much",
        "--up 0,0,0",
        "--camera 1,2",
        "--frames 1-",
        "--threads 0",
        "--temperature a --flame b",
        "--overwrite --resume",
        "--nonsense",
    ] {
        let outcome = run(&blast("blast.0001.vdb"), &path, options);
        fails(&outcome, 2, "error:");
        assert!(!path.exists(), "{options}");
    }
    // Makes no sense only when all of the view is known.
    fails(&run(&blast("blast.0001.vdb"), &path, "--camera 1,2,3 --look-at 1,2,3"), 2, "--look-at");
}

#[test]
fn an_unknown_grid_is_answered_with_what_there_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.png");
    for option in ["--grid", "--temperature", "--flame"] {
        let outcome = render(&blast("blast.0001.vdb"), &path, &format!("{option} densty"));
        fails(&outcome, 1, "grid 'densty' not found; the file has: density, flame, temperature");
    }
    fails(&render(&edge("transforms.vdb"), &path, "--grid frustum"), 1, "grid 'frustum'");
    fails(&render(&edge("no_grids.vdb"), &path, ""), 1, "no_grids.vdb");
    assert!(!path.exists());
}

#[test]
fn the_number_of_threads_does_not_show() {
    let folder = tempfile::tempdir().unwrap();
    let files = [1, 2, 5].map(|threads| {
        let path = folder.path().join(format!("{threads}.exr"));
        let options = format!("--size 48 --samples 2 --temperature temperature --threads {threads}");
        done(&render(&blast("blast.0006.vdb"), &path, &options));
        fs::read(path).unwrap()
    });
    assert!(files[0] == files[1] && files[0] == files[2]);
}

/// Paths that scatter once show what the ray marcher shows, but for noise; those that scatter more are brighter.
#[test]
fn paths_show_what_marching_shows_and_light_that_scatters_on() {
    let folder = tempfile::tempdir().unwrap();
    let mean = |options: &str| {
        let path = folder.path().join("out.exr");
        let options = format!("--size 48 --background none --overwrite --exr-float {options}");
        done(&render(&blast("blast.0006.vdb"), &path, &options));
        let (_, _, pixels) = exr(&path);
        let count = pixels.len() as f32;
        std::array::from_fn::<f32, 4, _>(|i| pixels.iter().map(|pixel| pixel[i]).sum::<f32>() / count)
    };
    let marched = mean("--samples 4");
    let finer = mean("--samples 4 --shadow-step 1");
    let once = mean("--integrator path --samples 64 --scatterings 1");
    let often = mean("--integrator path --samples 64");
    for i in 0..4 {
        // Shadow steps of two voxels, the default, take shadows to be 2 % lighter than they are.
        assert!((once[i] - marched[i]).abs() < 0.03 * marched[i], "{once:?} {marched:?}");
        assert!((once[i] - finer[i]).abs() < 0.015 * finer[i], "{once:?} {finer:?}");
    }
    assert!((once[3] - often[3]).abs() < 0.01 * once[3], "{once:?} {often:?}");
    assert!(often[..3].iter().zip(&once).all(|(often, once)| *often > 1.2 * once), "{once:?} {often:?}");
}

#[test]
fn an_empty_grid_is_a_picture_of_the_background() {
    let folder = tempfile::tempdir().unwrap();
    for (name, options, expected) in [
        ("a.exr", "--background 0.25,0.5,1", [0.25, 0.5, 1.0, 1.0]),
        ("b.exr", "--background sky --sky 0.5,0.25,2", [0.5, 0.25, 2.0, 1.0]),
        ("c.exr", "--background none", [0.0; 4]),
    ] {
        let path = folder.path().join(name);
        let outcome = render(&edge("empty_grid.vdb"), &path, options);
        fails(&outcome, 0, "the picture is empty");
        assert!(exr(&path).2.iter().all(|pixel| *pixel == expected), "{options}");
    }
}

#[test]
fn a_level_set_is_drawn_as_fog_with_a_note() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let outcome = render(&edge("v12_sphere_half.vdb"), &path, "--background none");
    fails(&outcome, 0, "level set");
    let (width, height, pixels) = exr(&path);
    assert!(pixels[height / 2 * width + width / 2][3] > 0.9, "the middle of the ball is dense");
    assert_eq!(pixels[0], [0.0; 4]);
}

#[test]
fn every_float_grid_of_the_edge_cases_is_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.exr");
    let mut rendered = 0;
    for (file, truth) in testkit::truths() {
        // Those that are committed; the large ones would take long.
        let Some(file) = file.file_name().map(|name| edge(&name.to_string_lossy())).filter(|f| f.exists())
        else {
            continue;
        };
        for grid in truth["grids"].as_array().unwrap() {
            let name = grid["unique_name"].as_str().unwrap();
            if grid["value_type"] != "float" {
                continue;
            }
            let start = Instant::now();
            let options = format!(
                "--size 32 --samples 1 --sun-rays 2 --sky-rays 1 --background none --exr-float --overwrite --grid {name}"
            );
            let outcome = run(&file, &path, &options);
            let what = format!("{} {name}: {}", file.display(), stderr(&outcome));
            if grid["transform"]["linear"] == false {
                fails(&outcome, 1, "only linear transforms");
                continue;
            }
            assert_eq!(outcome.status.code(), Some(0), "{what}");
            assert!(start.elapsed() < Duration::from_secs(10), "{what} took {:?}", start.elapsed());
            for pixel in exr(&path).2 {
                assert!(
                    pixel.iter().all(|x| x.is_finite() && *x >= 0.0) && pixel[3] <= 1.0,
                    "{what}: {pixel:?}"
                );
            }
            rendered += 1;
        }
    }
    assert!(rendered >= 50, "{rendered}");
}

/// The views show what is there: something of the volume, nothing beside it, each its own.
#[test]
fn views_show_the_volume_itself() {
    let folder = tempfile::tempdir().unwrap();
    let picture = |input: &Path, options: &str| {
        let path = folder.path().join("view.exr");
        let options = format!("--size 32 --background none --overwrite --exr-float {options}");
        done(&render(input, &path, &options));
        exr(&path).2
    };
    let mut seen: Vec<Vec<[f32; 4]>> = Vec::new();
    for view in ["density", "depth", "index", "first-density"] {
        let pixels = picture(&blast("blast.0006.vdb"), &format!("--view {view}"));
        assert!(pixels.iter().any(|pixel| pixel[3] > 0.5) && pixels[0] == [0.0; 4], "{view}");
        assert!(pixels.iter().flatten().all(|value| (0.0..=1.0).contains(value)), "{view}");
        assert!(!seen.contains(&pixels));
        seen.push(pixels);
    }
    // A ball faces the camera in the middle and turns away from it towards its rim.
    let ball = picture(&edge("comp_sphere_blosc.vdb"), "--view surface");
    let middle = ball[16 * 32 + 16];
    assert!(middle[0] > 0.95 && middle[3] == 1.0, "{middle:?}");
    let rim = ball.iter().filter(|pixel| pixel[3] == 1.0).map(|pixel| pixel[0]);
    assert!(rim.fold(1.0, f32::min) < 0.6);

    let out = folder.path().join("out.png");
    fails(&render(&blast("blast.0006.vdb"), &out, "--view surface"), 1, "is no level set");
    fails(&render(&blast("blast.0006.vdb"), &out, "--view depth --integrator path"), 2, "--view");
}
