//! Packed files as a user has them: `convert` there and back, and every subcommand that looks into one.

use std::ffi::OsStr;
use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use nuage_testkit as testkit;
use serde_json::Value;
use tempfile::TempDir;

fn command<I: AsRef<OsStr>>(args: impl IntoIterator<Item = I>) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nuage"));
    command.args(args).stdin(Stdio::null());
    command
}

fn nuage<I: AsRef<OsStr>>(args: impl IntoIterator<Item = I>) -> Output {
    command(args).output().unwrap()
}

fn stdout(output: &Output) -> &str {
    std::str::from_utf8(&output.stdout).unwrap()
}

fn stderr(output: &Output) -> &str {
    std::str::from_utf8(&output.stderr).unwrap()
}

fn succeeds<I: AsRef<OsStr>>(args: impl IntoIterator<Item = I>) -> String {
    let output = nuage(args);
    assert!(output.status.success(), "{}{}", stdout(&output), stderr(&output));
    stdout(&output).to_owned()
}

/// That it fails with this code and says this.
fn fails<I: AsRef<OsStr>>(args: impl IntoIterator<Item = I>, code: i32, says: &str) {
    let output = nuage(args);
    let said = format!("{}{}", stdout(&output), stderr(&output));
    assert!(output.status.code() == Some(code) && said.contains(says), "{:?}: {said}", output.status);
}

/// The first frames of the committed sequence.
const FRAMES: [i64; 3] = [2, 3, 4];

fn blast(frame: &str) -> PathBuf {
    testkit::workspace().join(format!("assets/blast/blast.{frame}.vdb"))
}

/// A folder, and in it the frames as `blast.nuage`.
struct Folder(TempDir);

impl Folder {
    fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_str().unwrap().to_owned()
    }

    fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

fn folder() -> Folder {
    let folder = Folder(tempfile::tempdir().unwrap());
    let input = blast("####");
    let said = succeeds([
        "convert",
        "--frames=2-4",
        "--fps=24",
        "--max-error=0.5%",
        input.to_str().unwrap(),
        &folder.at("blast.nuage"),
    ]);
    assert!(said.contains("3 frames") && said.contains("dB"), "{said}");
    assert_eq!(folder.names(), ["blast.nuage"]);
    folder
}

/// Per grid: the largest difference of a voxel, and the largest value.
fn differences(a: &str, b: &str) -> Vec<f64> {
    let output = nuage(["diff", "--json", "--values-only", a, b]);
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", stderr(&output));
    let object: Value = serde_json::from_str(stdout(&output)).unwrap();
    let grids = object["grids"].as_array().unwrap();
    grids.iter().map(|grid| grid["voxels"]["max_error"].as_f64().unwrap()).collect()
}

fn info(path: &str) -> Value {
    serde_json::from_str(&succeeds(["info", "--json", path])).unwrap()
}

#[test]
fn a_sequence_comes_back_frame_by_frame() {
    let folder = folder();
    let (nuage_file, out) = (folder.at("blast.nuage"), folder.at("back.####.vdb"));
    succeeds(["convert", &nuage_file, &out]);
    assert_eq!(folder.names(), ["back.0002.vdb", "back.0003.vdb", "back.0004.vdb", "blast.nuage"]);
    for number in FRAMES {
        let back = folder.at(&format!("back.{number:04}.vdb"));
        let original = blast(&format!("{number:04}"));
        let original = original.to_str().unwrap();
        let (before, after) = (info(original), info(&back));
        let grids = [&before, &after].map(|object| object["grids"].as_array().unwrap().clone());
        assert_eq!(grids[0].len(), grids[1].len());
        for key in ["name", "type", "class", "transform", "background", "half"] {
            for (before, after) in grids[0].iter().zip(&grids[1]) {
                assert_eq!(before[key], after[key], "{key}");
            }
        }
        for difference in differences(original, &back) {
            assert!(difference < 0.5, "{difference}");
        }
        // The frame where it is, and the file that came of it.
        let inside = format!("{nuage_file}#{number}");
        let said = succeeds(["diff", &inside, &back]);
        assert!(said.ends_with("equal\n"), "{said}");
        let one = folder.at(&format!("one.{number}.vdb"));
        succeeds(["convert", &inside, &one]);
        assert!(nuage(["diff", &one, &back]).status.success());
    }
    // The number stays with the frame.
    succeeds(["convert", &format!("{nuage_file}#3"), &folder.at("some.####.vdb")]);
    succeeds(["convert", &format!("{nuage_file}#3"), &folder.at("some.nuage")]);
    succeeds(["info", &format!("{}#3", folder.at("some.nuage"))]);
    succeeds(["convert", "--frames=4", &nuage_file, &folder.at("some.####.vdb")]);
    let names = folder.names();
    let some: Vec<&String> = names.iter().filter(|name| name.starts_with("some")).collect();
    assert_eq!(some, ["some.0003.vdb", "some.0004.vdb", "some.nuage"]);
    fails(["convert", "--force", &nuage_file, &folder.at("all.vdb")], 1, "all.####.vdb");
    fails(["convert", "--frames=9", &nuage_file, &folder.at("no.####.vdb")], 1, "there are 2 to 4");
    fails(["convert", &format!("{nuage_file}#9"), &folder.at("no.vdb")], 1, "there is no frame 9");
}

#[test]
fn every_subcommand_reads_frames() {
    let folder = folder();
    let path = folder.at("blast.nuage");
    let frame = format!("{path}#4");
    let said = succeeds(["info", &path]);
    assert!(said.contains("3 (2 to 4, 24 per second)") && said.contains("largest error"), "{said}");
    assert!(succeeds(["info", &frame]).contains("density"));
    for path in [&path, &frame] {
        assert!(succeeds(["validate", path]).contains("valid"));
        assert!(succeeds(["diff", path, path]).ends_with("equal\n"));
    }
    // Of a sequence, the frame that is held against one of a number is that of this number.
    for frame in ["#2", "#4"].map(|number| format!("{path}{number}")) {
        assert!(nuage(["diff", &path, &frame]).status.success());
    }
    assert!(!nuage(["diff", &format!("{path}#2"), &frame]).status.success());
    let name = info(&frame)["grids"][0]["name"].as_str().unwrap().to_owned();
    let probe = |path: &str| {
        let grid = format!("--grid={name}");
        let said = succeeds(["probe", &grid, path, "--", "3", "4", "5"]);
        said.split_whitespace().nth(3).unwrap().parse::<f64>().unwrap()
    };
    let original = blast("0004");
    assert!((probe(&frame) - probe(original.to_str().unwrap())).abs() < 0.5);
    let picture = |input: &str, name: &str| {
        let output = folder.at(name);
        let options = "--up z --size 24 --samples 1 --step 4 --shadow-step 8 --sun-rays 1 --sky-rays 1";
        succeeds(["render", input, "--output", &output].into_iter().chain(options.split_whitespace()));
    };
    picture(&frame, "one.png");
    picture(&path, "all.####.png");
    let pictures = folder.names().into_iter().filter(|name| name.ends_with("png")).collect::<Vec<_>>();
    assert_eq!(pictures, ["all.0002.png", "all.0003.png", "all.0004.png", "one.png"]);
    // As the file that the frame is.
    let unpacked = folder.at("four.vdb");
    succeeds(["convert", &frame, &unpacked]);
    picture(&unpacked, "same.png");
    assert!(fs::read(folder.at("one.png")).unwrap() == fs::read(folder.at("same.png")).unwrap());
}

#[test]
fn what_makes_no_sense_is_said() {
    let folder = folder();
    let (input, output) = (blast("0001"), folder.at("out.nuage"));
    let input = input.to_str().unwrap();
    for (options, says) in [
        (&["--psnr=0"][..], "a number above 0"),
        (&["--psnr=nan"], "a number above 0"),
        (&["--bits-per-voxel=-1"], "--bits-per-voxel"),
        (&["--max-error=-1"], "0 or above"),
        (&["--max-error=big"], "write a number"),
        (&["--levels=40"], "--levels"),
        (&["--codec=zip"], "codecs of .nvdb"),
        (&["--codec=u9"], "u1 to u8"),
        (&["--half"], "--half is for"),
        (&["--compression=zip"], "--compression is for"),
        (&["--encoding=fp8"], "--encoding is for"),
        (&["--split"], "--split is for"),
        (&["--fps=inf"], "--fps must be"),
    ] {
        fails(["convert"].iter().chain(options).chain(&[input, &output]), 2, says);
    }
    let (vdb, nvdb) = (folder.at("out.vdb"), folder.at("out.nvdb"));
    fails(["convert", "--psnr=40", input, &vdb], 2, "--psnr is for");
    fails(["convert", "--codec=f16", input, &vdb], 2, "--codec is for");
    fails(["convert", "--codec=f16", input, &nvdb], 2, "none, zip and blosc");
    fails(["convert", "--levels=2", input, &nvdb], 2, "--levels is for");
    fails(["convert", input, input, &output], 2, "two frames would have the number");
    assert_eq!(folder.names(), ["blast.nuage"]);
}

#[test]
fn nothing_is_replaced_unasked() {
    let folder = folder();
    let (input, output) = (blast("0001"), folder.at("blast.nuage"));
    let before = fs::read(&output).unwrap();
    fails(["convert", input.to_str().unwrap(), &output], 1, "--force");
    assert_eq!(fs::read(&output).unwrap(), before);
    succeeds(["convert", "--force", input.to_str().unwrap(), &output]);
    assert_ne!(fs::read(&output).unwrap(), before);
    assert_eq!(folder.names(), ["blast.nuage"]);
}

#[test]
fn damage_is_noticed_wherever_it_is() {
    let folder = folder();
    let sound = fs::read(folder.at("blast.nuage")).unwrap();
    let bad = folder.at("bad.nuage");
    let damaged = |at: usize| {
        let mut bytes = sound.clone();
        bytes[at] ^= 1;
        bytes
    };
    let places = [8, 20, 100, sound.len() / 3, sound.len() / 2, sound.len() - 500, sound.len() - 3];
    for (what, bytes) in places
        .into_iter()
        .map(|at| (at, damaged(at)))
        .chain([0, 63, sound.len() / 2, sound.len() - 1].map(|len| (len, sound[..len].to_vec())))
    {
        fs::write(&bad, bytes).unwrap();
        for args in [&["validate", &bad][..], &["convert", &bad, &folder.at("no.####.vdb")]] {
            let output = nuage(args);
            let said = format!("{}{}", stdout(&output), stderr(&output));
            let is_error = output.status.code() == Some(1) && said.contains("bad.nuage");
            assert!(
                is_error && said.lines().count() <= FRAMES.len() && !said.contains("panicked"),
                "{what}: {said}"
            );
        }
        for number in FRAMES {
            let _ = fs::remove_file(folder.at(&format!("no.{number:04}.vdb")));
        }
    }
    for command in ["info", "validate"] {
        fs::write(&bad, &sound[..sound.len() / 2]).unwrap();
        fails([command, &bad], 1, "bad.nuage");
        fails([command, &format!("{bad}#3")], 1, "bad.nuage");
        fails([command, &folder.at("nowhere.nuage")], 1, "nowhere.nuage");
    }
    // A file of another kind under the name.
    fs::copy(blast("0001"), &bad).unwrap();
    fails(["info", &bad], 1, "bad.nuage");
}

#[test]
fn frames_are_added_to_a_file() {
    let folder = Folder(tempfile::tempdir().unwrap());
    let (input, all, some) = (blast("####"), folder.at("all.nuage"), folder.at("some.nuage"));
    let input = input.to_str().unwrap();
    let convert = |frames: &str, output: &str, more: &[&str]| {
        let args = ["convert", frames, input, output];
        args.iter().chain(more).map(|arg| (*arg).to_owned()).collect::<Vec<String>>()
    };
    succeeds(convert("--frames=1-10", &all, &["--max-error=1%", "--fps=25"]));
    succeeds(convert("--frames=1-6", &some, &["--max-error=1%", "--fps=25"]));
    let before = folder.at("before.nuage");
    fs::copy(&some, &before).unwrap();
    let said = succeeds(convert("--frames=7-10", &some, &["--append"]));
    assert!(said.contains("4 frames") && said.contains("added to 6"), "{said}");
    assert!(succeeds(["info", &some]).contains("10 (1 to 10, 25 per second)"));
    assert!(succeeds(["validate", &some]).contains("valid"));
    for number in 1..=6 {
        let said = succeeds(["diff", &format!("{before}#{number}"), &format!("{some}#{number}")]);
        assert!(said.ends_with("equal\n"), "{said}");
    }
    for number in 7..=10 {
        let [one, other] = [&all, &some].map(|file| format!("{file}#{number}"));
        // Both are within a hundredth of the peak.
        let bounds = differences(&one, &other);
        assert!(bounds.iter().all(|difference| *difference < 0.5), "{bounds:?}");
    }
    let [all_bytes, some_bytes] = [&all, &some].map(|file| fs::metadata(file).unwrap().len() as f64);
    assert!(some_bytes < 1.05 * all_bytes, "{some_bytes} of {all_bytes}");
    // What makes no sense changes nothing.
    let whole = fs::read(&some).unwrap();
    fails(convert("--frames=10-11", &some, &["--append"]), 1, "there is a frame 10 already");
    fails(convert("--frames=11", &some, &["--append", "--psnr=40"]), 2, "--psnr is not for --append");
    fails(convert("--frames=11", &some, &["--append", "--max-error=1"]), 2, "--max-error is not for");
    fails(convert("--frames=11", &folder.at("none.nuage"), &["--append"]), 1, "none.nuage");
    fails(convert("--frames=11", &folder.at("none.vdb"), &["--append"]), 2, "--append is for");
    assert!(fs::read(&some).unwrap() == whole);
    // Nor does a file that is damaged, in its pages or in what stands behind them.
    for at in [100, whole.len() / 2, whole.len() - 500, whole.len() - 3] {
        let mut damaged = whole.clone();
        damaged[at] ^= 1;
        fs::write(&some, &damaged).unwrap();
        fails(convert("--frames=11", &some, &["--append"]), 1, "some.nuage");
        assert!(fs::read(&some).unwrap() == damaged, "damage at byte {at}");
    }
    let names: Vec<String> = folder.names().into_iter().filter(|name| name.ends_with("nuage")).collect();
    assert_eq!(names, ["all.nuage", "before.nuage", "some.nuage"]);
}

#[test]
fn what_is_up_to_date_is_not_made_again() {
    let folder = Folder(tempfile::tempdir().unwrap());
    for number in [1, 2] {
        fs::copy(blast(&format!("{number:04}")), folder.at(&format!("a.{number}.vdb"))).unwrap();
    }
    let (input, output) = (folder.at("a.#.vdb"), folder.at("a.nuage"));
    let convert = |more: &[&str]| {
        let args = ["convert", "--crop=24,24,8,39,39,23", &input, &output];
        args.iter().chain(more).map(|arg| (*arg).to_owned()).collect::<Vec<String>>()
    };
    succeeds(convert(&[]));
    let (made, when) = (fs::read(&output).unwrap(), fs::metadata(&output).unwrap().modified().unwrap());
    // Of the sources their bytes count, whenever they were written.
    fs::write(folder.at("a.1.vdb"), fs::read(blast("0001")).unwrap()).unwrap();
    assert!(succeeds(convert(&[])).contains("up to date"));
    assert_eq!(fs::metadata(&output).unwrap().modified().unwrap(), when);
    for other in ["--psnr=30", "--fps=24", "--levels=1", "--frames=1", "--rename=density=d"] {
        fails(convert(&[other]), 1, "--force");
    }
    assert!(!succeeds(convert(&["--force"])).contains("up to date"));
    assert!(fs::read(&output).unwrap() == made);
    let mut damaged = made.clone();
    damaged[70] ^= 1;
    fs::write(&output, &damaged).unwrap();
    fails(convert(&[]), 1, "--force");
    fs::write(&output, &made).unwrap();
    fs::copy(blast("0003"), folder.at("a.2.vdb")).unwrap();
    fails(convert(&[]), 1, "--force");
    assert!(fs::read(&output).unwrap() == made);
    assert_eq!(folder.names(), ["a.1.vdb", "a.2.vdb", "a.nuage"]);
}

/// The work that is kept beside `out.nuage`.
#[cfg(unix)]
fn finished_frames(folder: &Folder) -> usize {
    let entries = fs::read_dir(folder.at(".out.nuage.work")).into_iter().flatten();
    entries
        .filter(|entry| entry.as_ref().unwrap().file_name().to_str().unwrap().starts_with("frame."))
        .count()
}

#[cfg(unix)]
#[test]
fn a_conversion_that_is_killed_leaves_nothing_or_all_and_is_taken_up_again() {
    let folder = Folder(tempfile::tempdir().unwrap());
    let (input, output) = (blast("####"), folder.at("out.nuage"));
    let input = input.to_str().unwrap();
    let args = ["convert", "--crop=24,24,8,39,39,31", "--frames=1-8", "--force", input, &output];
    let with_threads = |threads: u64| {
        let mut command = command(args);
        command.env("RAYON_NUM_THREADS", threads.to_string()).stdout(Stdio::null()).stderr(Stdio::piped());
        command
    };
    let mut took = Duration::ZERO;
    let mut whole = Vec::new();
    for threads in [1, 2] {
        let start = Instant::now();
        assert!(with_threads(threads).status().unwrap().success());
        took = start.elapsed();
        let made = fs::read(&output).unwrap();
        assert!(threads == 1 || made == whole, "another file with {threads} threads");
        whole = made;
    }
    let mut seed = 1_u64;
    let mut random = |end: u64| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) % end
    };
    let mut kill_after = |part: f64| {
        // Half of the times something stands there before.
        let before = if random(2) == 0 { Some(b"precious".to_vec()) } else { None };
        let _ = fs::remove_file(&output);
        if let Some(before) = &before {
            fs::write(&output, before).unwrap();
        }
        let mut child = with_threads(1 + random(2)).spawn().unwrap();
        std::thread::sleep(took.mul_f64(part));
        child.kill().unwrap();
        child.wait().unwrap();
        let after = fs::read(&output).ok();
        let bytes = after.as_ref().map(Vec::len);
        assert!(after == before || after.as_ref() == Some(&whole), "{bytes:?} bytes, {part} of the time");
        random(1000) as f64 / 1000.0
    };
    let mut part = 0.5;
    for kill in 0..50 {
        part = kill_after(part);
        // Now and then from the start again.
        if kill % 4 == 0 {
            let _ = fs::remove_dir_all(folder.at(".out.nuage.work"));
        }
    }
    // Where a run ends before it is killed, nothing is left to take up.
    let _ = fs::remove_dir_all(folder.at(".out.nuage.work"));
    let mut part = 0.5;
    for _ in 0..40 {
        kill_after(part);
        if finished_frames(&folder) > 0 {
            break;
        }
        part = if fs::read(&output).is_ok_and(|bytes| bytes == whole) { part * 0.9 } else { part * 1.1 };
    }
    assert!(finished_frames(&folder) > 0, "no run was killed between its first frame and its last");
    let last = with_threads(2).output().unwrap();
    assert!(last.status.success() && stderr(&last).contains("resuming: "), "{}", stderr(&last));
    assert!(stderr(&last).contains(" of 8 frames were done"), "{}", stderr(&last));
    assert!(fs::read(&output).unwrap() == whole);
    assert!(!fs::exists(folder.at(".out.nuage.work")).unwrap());
    // What is kept is not looked at unasked.
    let again = with_threads(2).arg("--no-resume").output().unwrap();
    assert!(!stderr(&again).contains("resuming") && fs::read(&output).unwrap() == whole);
}

/// What `diff --json` says.
fn diff(args: &[&str]) -> (bool, Value) {
    let output = nuage(["diff", "--json"].iter().chain(args));
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", stderr(&output));
    (output.status.success(), serde_json::from_str(stdout(&output)).unwrap())
}

#[test]
fn sequences_are_compared_frame_by_frame() {
    let folder = folder();
    let (input, packed) = (blast("####"), folder.at("blast.nuage"));
    let input = input.to_str().unwrap();
    let (equal, all) = diff(&["--values-only", "--frames=2-4", input, &packed]);
    let frames = all["frames"].as_array().unwrap();
    assert_eq!(frames.iter().map(|frame| frame["frame"].as_i64().unwrap()).collect::<Vec<_>>(), FRAMES);
    assert!(!equal && all["equal"] == false);
    // The whole is the sum of the parts, with one peak and the worst frame.
    let totals = all["total"].as_array().unwrap();
    let names: Vec<&str> = totals.iter().map(|total| total["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["density", "flame", "temperature"]);
    let total = &totals[0];
    let of = |key: &str| -> Vec<f64> {
        frames.iter().map(|frame| frame["grids"][0]["voxels"][key].as_f64().unwrap()).collect()
    };
    let voxels = &total["voxels"];
    let largest = of("max_error").into_iter().fold(0.0, f64::max);
    assert!(largest > 0.0 && voxels["max_error"].as_f64() == Some(largest));
    let worst = of("max_error").iter().position(|error| *error == largest).unwrap();
    assert_eq!(voxels["worst_frame"].as_i64(), Some(FRAMES[worst]));
    assert!(of("peak").iter().all(|peak| Some(*peak) == voxels["peak"].as_f64()));
    let (psnr, ratios) = (voxels["psnr"].as_f64().unwrap(), of("psnr"));
    let least = ratios.iter().copied().fold(f64::INFINITY, f64::min);
    assert!(least <= psnr && psnr <= ratios.into_iter().fold(0.0, f64::max), "{psnr}");
    let [a, b] = [0, 1].map(|i| voxels["max_error_values"][i].as_f64().unwrap());
    assert!(((a - b).abs() - largest).abs() < 1e-9 * largest, "{a} {b} {largest}");
    // What was asked for when packing, and what rounding to the half floats of the source adds.
    let peak = voxels["peak"].as_f64().unwrap();
    assert!(largest <= 0.005 * peak + peak / 4096.0 && voxels["fog"].as_f64().unwrap() <= 1.001e-3 * peak);
    // In words.
    let said = stdout(&nuage(["diff", "--values-only", "--frames=2-4", input, &packed])).to_owned();
    let place = format!("of frame {} (", FRAMES[worst]);
    assert!(said.contains("all 3 frames:") && said.contains(&place) && said.contains("PSNR"), "{said}");
    // Frames of one side alone, and none in common.
    let (_, missing) = diff(&["--tolerance=1000", "--values-only", input, &packed]);
    assert!(missing["frames_only_a"].as_array().unwrap().contains(&Value::from(1)));
    assert_eq!(
        (&missing["frames_only_b"], &missing["equal"]),
        (&Value::from(Vec::<i64>::new()), &Value::Bool(false))
    );
    // One frame against a sequence is that of its number.
    let four = blast("0004");
    let (_, one) = diff(&["--values-only", four.to_str().unwrap(), &packed]);
    assert_eq!(one["grids"][0]["voxels"]["max_error"], frames[2]["grids"][0]["voxels"]["max_error"]);
    fails(["diff", blast("0001").to_str().unwrap(), &packed], 1, "there is no frame 1");
}

#[test]
fn a_difference_has_a_picture() {
    let folder = folder();
    let (input, packed, picture) = (blast("####"), folder.at("blast.nuage"), folder.at("out.png"));
    let look = "--up z --size 24 --step 4 --shadow-step 8 --sun-rays 1 --sky-rays 1";
    let args = ["diff", "--frames=2-4", input.to_str().unwrap(), &packed, "--picture", &picture];
    let args: Vec<&str> = args.into_iter().chain(look.split_whitespace()).collect();
    let with = |more: &[&'static str]| nuage(args.iter().chain(more));
    let output = with(&["--frame=3", "--amplify=4"]);
    assert!(
        stdout(&output).contains("out.png: A, B and their difference times 4 of frame 3"),
        "{}",
        stdout(&output)
    );
    let pixels = |path: &str| {
        let file = std::io::BufReader::new(fs::File::open(path).unwrap());
        let mut reader = png::Decoder::new(file).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let frame = reader.next_frame(&mut pixels).unwrap();
        (frame.width as usize, frame.height, pixels)
    };
    let (width, height, bytes) = pixels(&picture);
    assert_eq!((width, height), (3 * 24 + 2 * 4, 24));
    let channels = bytes.len() / (width * 24);
    let at = |x: usize, y: usize| &bytes[(y * width + x) * channels..][..3];
    // What is the same in A and B is black, and something differs.
    let columns = || (0..24).flat_map(|x| (0..24).map(move |y| (x, y)));
    assert!(columns().all(|(x, y)| at(x, y) == at(x + 28, y)
        || at(x + 56, y) != [0; 3]
        || at(x, y).iter().zip(at(x + 28, y)).all(|(a, b)| a.abs_diff(*b) <= 1)));
    assert!(columns().any(|(x, y)| at(x + 56, y) != [0; 3]));
    // The left part is the picture that `render` makes.
    let render = folder.at("render.png");
    let three = blast("0003");
    succeeds(
        ["render", three.to_str().unwrap(), "--output", &render].into_iter().chain(look.split_whitespace()),
    );
    let (_, _, alone) = pixels(&render);
    let alone_channels = alone.len() / (24 * 24);
    assert!(columns().all(|(x, y)| alone[(y * 24 + x) * alone_channels..][..3] == *at(x, y)));
    // Nothing is replaced unasked, nor is a frame shown that is not there.
    let before = fs::read(&picture).unwrap();
    let refused = with(&[]);
    assert!(refused.status.code() == Some(1) && stderr(&refused).contains("--force"), "{}", stderr(&refused));
    assert_eq!(fs::read(&picture).unwrap(), before);
    assert!(stdout(&with(&["--force"])).contains("difference times"));
    assert_eq!(with(&["--force", "--frame=9"]).status.code(), Some(2));
    fails(["diff", &packed, &packed, "--picture", &folder.at("out.jpg")], 2, ".png");
    fails(["diff", &packed, &packed, "--frame=2"], 2, "--picture");
}

#[test]
fn a_written_file_is_verified_before_it_gets_its_name() {
    let folder = Folder(tempfile::tempdir().unwrap());
    let input = blast("####");
    let input = input.to_str().unwrap();
    for options in [&["--max-error=1%"][..], &["--psnr=50", "--levels=2"], &["--codec=f16"], &["--codec=f32"]]
    {
        let args = ["convert", "--verify", "--force", "--frames=2-4"];
        let output = folder.at("out.nuage");
        let said = succeeds(args.iter().chain(options).chain(&[input, output.as_str()]));
        assert!(said.contains("verified: ") && said.contains("3 frames, 3 channels;"), "{said}");
    }
    let before = fs::read(folder.at("out.nuage")).unwrap();
    // A codec that makes a larger error than is asked for.
    let args = ["convert", "--verify", "--force", "--frames=2-4", "--codec=u2", "--max-error=1%", input];
    fails(args.iter().chain(&[folder.at("out.nuage").as_str()]), 1, "verifying failed");
    assert!(fs::read(folder.at("out.nuage")).unwrap() == before);
    let sphere = testkit::committed("data/edge").join("comp_sphere_mask.vdb");
    let sphere = sphere.to_str().unwrap();
    for (options, output, says) in [
        (&[][..], "a.vdb", "came back equal"),
        (&["--compression=zip"], "b.vdb", "came back equal"),
        (&["--half"], "c.vdb", "came back equal"),
        (&[], "d.nvdb", "came back equal"),
        (&["--encoding=fp8", "--codec=zip"], "e.nvdb", "no error above"),
        (&["--encoding=fp4"], "f.nvdb", "no error above"),
        (&["--encoding=fpn", "--max-error=0.01"], "g.nvdb", "no error above"),
    ] {
        let path = folder.at(output);
        let said = succeeds(["convert", "--verify"].iter().chain(options).chain(&[sphere, path.as_str()]));
        assert!(said.contains("verified: 2 grids") && said.contains(says), "{output}: {said}");
    }
    assert_eq!(folder.names().len(), 8);
}

#[test]
fn options_of_packing_may_be_for_one_grid() {
    let folder = Folder(tempfile::tempdir().unwrap());
    let (input, output) = (blast("0003"), folder.at("out.nuage"));
    let input = input.to_str().unwrap();
    let name = info(input)["grids"][0]["name"].as_str().unwrap().to_owned();
    let convert = |options: &[String]| {
        let fixed = ["convert", "--force", input, &output].map(str::to_owned);
        nuage(fixed.iter().chain(options))
    };
    let role_and_unit = [format!("--role={name}=flame"), format!("--unit={name}=1/m")];
    let made =
        convert(&[&role_and_unit[..], &["--codec=u2".into(), format!("--max-error={name}=0.2%")]].concat());
    assert!(made.status.success() && stderr(&made).is_empty(), "{}", stderr(&made));
    let said = succeeds(["info", &output]);
    assert!(said.contains("(Flame)") && said.contains(" 1/m, largest error"), "{said}");
    // What cannot be had together is said, and the file is there.
    let made = convert(&["--max-error=0.1%".into(), "--bits-per-voxel=1".into()]);
    assert!(
        made.status.success() && stderr(&made).contains("bits per voxel are above the 1 asked for"),
        "{made:?}"
    );
    let made = convert(&["--psnr=90".into(), "--bits-per-voxel=2".into()]);
    assert!(made.status.success() && stderr(&made).contains("below the 90 asked for"), "{made:?}");
    let wrong = convert(&["--psnr=smoke=40".into()]);
    let says = format!("'smoke', which is in no frame; there are: {name}");
    assert!(wrong.status.code() == Some(1) && stderr(&wrong).contains(&says), "{}", stderr(&wrong));
    for (options, says) in [
        (&["--psnr=40", "--psnr=50"][..], "given twice for all channels"),
        (&["--unit=a=K", "--unit=a=C"], "given twice for 'a'"),
        (&["--role=smoke"], "NAME=VALUE"),
        (&["--role=a=smoke"], "there are density"),
    ] {
        let options: Vec<String> = options.iter().map(|option| (*option).to_owned()).collect();
        let made = convert(&options);
        assert!(made.status.code() == Some(2) && stderr(&made).contains(says), "{}", stderr(&made));
    }
    fails(["convert", "--unit=a=K", input, &folder.at("x.vdb")], 2, "--unit is for");
    fails(["convert", "--codec=a=zip", input, &folder.at("x.nvdb")], 2, "one for all grids");
}
