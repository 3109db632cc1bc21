//! The program as a user runs it: `diff`, `validate` and `convert`.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use nuage_testkit as testkit;
use serde_json::Value;

fn nuage<I: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = I>) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nuage"));
    command.args(args).stdin(Stdio::null()).output().unwrap()
}

fn edge(name: &str) -> PathBuf {
    testkit::committed("data/edge").join(name)
}

/// The .vdb files in a folder.
fn vdb_files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|e| e == "vdb")).collect();
    files.sort();
    files
}

fn stdout(output: &Output) -> &str {
    std::str::from_utf8(&output.stdout).unwrap()
}

fn stderr(output: &Output) -> &str {
    std::str::from_utf8(&output.stderr).unwrap()
}

fn succeeds<I: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = I>) -> Output {
    let output = nuage(args);
    assert!(output.status.success(), "{}{}", stdout(&output), stderr(&output));
    output
}

/// Runs `diff` and gives whether it found the files equal, and what it said.
fn diff(a: &Path, b: &Path, options: &[&str]) -> (bool, String) {
    let mut args = vec!["diff".as_ref(), a.as_os_str(), b.as_os_str()];
    args.extend(options.iter().map(std::ffi::OsStr::new));
    let output = nuage(args);
    let code = output.status.code();
    assert!(matches!(code, Some(0 | 1)) && stderr(&output).is_empty(), "{}", stderr(&output));
    (code == Some(0), stdout(&output).to_owned())
}

#[test]
fn sound_files_are_valid() {
    let files = vdb_files(&testkit::committed("data/edge"));
    assert!(files.len() >= 30);
    let output = nuage(["validate".as_ref()].into_iter().chain(files.iter().map(|f| f.as_os_str())));
    assert!(output.status.success(), "{}", stdout(&output));
    let verdicts = stdout(&output).lines().filter(|line| !line.starts_with(' ')).count();
    assert_eq!(verdicts, files.len());
    // What a writer noted about the voxels is what they are.
    assert!(!stdout(&output).contains("its metadata state"), "{}", stdout(&output));
    assert!(stdout(&output).contains("are NaN or infinite, the first at ["));
    // A warning is a failure for those who ask for it.
    let special = edge("special_values.vdb");
    assert_eq!(nuage(["validate".as_ref(), special.as_os_str()]).status.code(), Some(0));
    let strict = ["validate".as_ref(), "--strict".as_ref(), special.as_os_str()];
    assert_eq!(nuage(strict).status.code(), Some(1));
}

#[test]
fn damaged_files_are_one_line_each() {
    let start = Instant::now();
    for path in vdb_files(&edge("bad")) {
        let output = nuage(["validate".as_ref(), "--max-memory=0.5".as_ref(), path.as_os_str()]);
        let name = path.file_name().unwrap().to_str().unwrap();
        assert!(matches!(output.status.code(), Some(0 | 1)), "{name}: {}", stderr(&output));
        assert!(stderr(&output).is_empty(), "{name}: {}", stderr(&output));
        let line = stdout(&output).lines().next().unwrap();
        assert!(line.starts_with(&*path.to_string_lossy()), "{line}");
        if !name.starts_with("noise") {
            assert_eq!(output.status.code(), Some(1), "{line}");
            assert_eq!(stdout(&output).lines().count(), 1, "{}", stdout(&output));
        }
        if name.starts_with("trunc") {
            assert!(line.contains("malformed file at byte "), "{line}");
        }
    }
    assert!(start.elapsed() < Duration::from_secs(60), "{:?}", start.elapsed());
    let output = nuage(["validate", "--json", "nowhere.vdb"]);
    let object: Value = serde_json::from_str(stdout(&output)).unwrap();
    assert_eq!((&object["valid"], output.status.code()), (&Value::Bool(false), Some(1)));
}

#[test]
fn a_file_equals_itself() {
    for path in vdb_files(&testkit::committed("data/edge")) {
        let (equal, said) = diff(&path, &path, &[]);
        assert!(equal && said.ends_with("equal\n") && !said.contains("note"), "{}: {said}", path.display());
    }
}

#[test]
fn differences_are_named_and_tolerated() {
    let (half, full) = (edge("half_mask.vdb"), edge("comp_sphere_mask.vdb"));
    let folder = tempfile::tempdir().unwrap();
    let halved = folder.path().join("halved.vdb");
    succeeds(["convert".as_ref(), "--half".as_ref(), full.as_os_str(), halved.as_os_str()]);
    let (equal, said) = diff(&full, &halved, &[]);
    assert!(!equal && said.contains("active voxels differ") && said.contains("PSNR"), "{said}");
    assert!(said.contains("(note) saved as: full width | half floats"), "{said}");
    // Rounded to eleven bits.
    let (equal, said) = diff(&full, &halved, &["--tolerance", "0.002"]);
    assert!(equal, "{said}");
    let (equal, said) = diff(&half, &full, &[]);
    assert!(!equal && said.contains("only in"), "{said}");

    let output = nuage(["diff".as_ref(), "--json".as_ref(), full.as_os_str(), halved.as_os_str()]);
    let object: Value = serde_json::from_str(stdout(&output)).unwrap();
    let voxels = &object["grids"][0]["voxels"];
    assert_eq!(object["equal"], false);
    assert!(voxels["differing_values"].as_u64() > Some(0) && voxels["psnr"].as_f64() > Some(60.0));
    assert!(voxels["first"].as_array().is_some_and(|first| first.len() == 5));
    assert_eq!(nuage(["diff".as_ref(), full.as_os_str()]).status.code(), Some(2));
    assert_eq!(nuage(["diff".as_ref(), full.as_os_str(), "nowhere.vdb".as_ref()]).status.code(), Some(1));
}

#[test]
fn files_come_back_equal_in_every_compression() {
    let folder = tempfile::tempdir().unwrap();
    for path in vdb_files(&testkit::committed("data/edge")) {
        let name = path.file_name().unwrap().to_str().unwrap();
        if holds_points(&path) {
            continue;
        }
        for (i, options) in [
            &["--compression", "blosc"][..],
            &["--compression=zip"],
            &["--compression=none", "--no-active-mask"],
        ]
        .into_iter()
        .enumerate()
        {
            let converted = folder.path().join(format!("{i}_{name}"));
            let mut args = vec!["convert".as_ref(), path.as_os_str(), converted.as_os_str()];
            args.extend(options.iter().map(std::ffi::OsStr::new));
            succeeds(args);
            let (equal, said) = diff(&path, &converted, &[]);
            assert!(equal, "{name} {options:?}: {said}");
            succeeds(["validate".as_ref(), converted.as_os_str()]);
        }
    }
}

fn holds_points(path: &Path) -> bool {
    stdout(&nuage(["info".as_ref(), path.as_os_str()])).contains("ptdataidx32")
}

#[test]
fn float_grids_come_back_from_nanovdb() {
    let folder = tempfile::tempdir().unwrap();
    let [full, fp8, back] = ["full.nvdb", "fp8.nvdb", "back.vdb"].map(|name| folder.path().join(name));
    for name in ["comp_sphere_blosc.vdb", "tiles_levels.vdb", "cross_zero.vdb", "py10_mixed.vdb"] {
        let path = edge(name);
        if holds_points(&path) {
            continue;
        }
        succeeds(
            ["convert", "--force"]
                .map(std::ffi::OsStr::new)
                .into_iter()
                .chain([path.as_os_str(), full.as_os_str()]),
        );
        let (equal, said) = diff(&path, &full, &["--values-only"]);
        assert!(equal, "{name}: {said}");
        succeeds(
            ["convert", "--force"]
                .map(std::ffi::OsStr::new)
                .into_iter()
                .chain([full.as_os_str(), back.as_os_str()]),
        );
        let (equal, said) = diff(&path, &back, &["--values-only"]);
        assert!(equal, "{name}: {said}");
    }
    let sphere = edge("comp_sphere_blosc.vdb");
    succeeds(["convert".as_ref(), "--encoding=fp8".as_ref(), sphere.as_os_str(), fp8.as_os_str()]);
    let (equal, said) = diff(&sphere, &fp8, &["--values-only"]);
    assert!(!equal && said.contains("PSNR"), "{said}");
    let (equal, said) = diff(&sphere, &fp8, &["--values-only", "--tolerance=0.05"]);
    assert!(equal, "{said}");
    for command in ["info", "validate"] {
        let output = succeeds([command.as_ref(), fp8.as_os_str()]);
        assert!(stdout(&output).contains("2 grids"), "{}", stdout(&output));
    }
    let output = succeeds(["info".as_ref(), "--json".as_ref(), fp8.as_os_str()]);
    let object: Value = serde_json::from_str(stdout(&output)).unwrap();
    assert_eq!(object["format"], "NanoVDB");
    let args = ["probe", "--grid=density", "--", "0", "0", "0"].map(std::ffi::OsStr::new);
    let output = succeeds([&args[..2], &[fp8.as_os_str()], &args[2..]].concat());
    assert!(stdout(&output).starts_with("0 0 0 "), "{}", stdout(&output));
}

#[test]
fn what_is_cut_out_is_what_was_there() {
    let folder = tempfile::tempdir().unwrap();
    let path = edge("comp_sphere_blosc.vdb");
    let cut = folder.path().join("cut.vdb");
    succeeds([
        "convert".as_ref(),
        "--crop".as_ref(),
        "-3,0,-20,5,20,4".as_ref(),
        "--grid=density".as_ref(),
        path.as_os_str(),
        cut.as_os_str(),
    ]);
    let output = succeeds(["info".as_ref(), "--json".as_ref(), cut.as_os_str()]);
    let object: Value = serde_json::from_str(stdout(&output)).unwrap();
    let bbox = object["grids"][0]["active_bbox"].clone();
    let corner = |end: usize, axis: usize| bbox[end][axis].as_i64().unwrap();
    let [min, max] = [[-3, 0, -20], [5, 20, 4]];
    assert!((0..3).all(|i| min[i] <= corner(0, i) && corner(1, i) <= max[i]), "{bbox}");
    let (equal, said) = diff(&path, &cut, &["--grid=density", "--list=100"]);
    assert!(!equal && !said.contains("[0, 0, 0]:"), "{said}");
    let probe = |path: &Path, ijk: [&str; 3]| {
        let args = ["probe".as_ref(), "--grid=density".as_ref(), path.as_os_str()]
            .into_iter()
            .chain(ijk.iter().map(std::ffi::OsStr::new));
        stdout(&succeeds(args)).to_owned()
    };
    let same = |ijk| {
        probe(&path, ijk).trim_end().rsplit_once(' ').map(|p| p.0.to_owned())
            == probe(&cut, ijk).trim_end().rsplit_once(' ').map(|p| p.0.to_owned())
    };
    assert!(same(["5", "4", "4"]) && same(["-3", "2", "-1"]));
    assert!(probe(&cut, ["6", "4", "4"]).contains("inactive"));
    let empty = nuage([
        "convert".as_ref(),
        "--crop-world=0.00001,0,0,0.00002,0,0".as_ref(),
        path.as_os_str(),
        folder.path().join("none.vdb").as_os_str(),
    ]);
    assert_eq!(empty.status.code(), Some(1));
    assert!(stderr(&empty).contains("no centre of a voxel"), "{}", stderr(&empty));
}

#[test]
fn grids_are_chosen_renamed_split_and_put_together() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (sphere, zero) = (edge("comp_sphere_blosc.vdb"), edge("cross_zero.vdb"));
    let names = |path: &Path| -> Vec<String> {
        let output = succeeds(["info".as_ref(), "--json".as_ref(), path.as_os_str()]);
        let object: Value = serde_json::from_str(stdout(&output)).unwrap();
        let grids = object["grids"].as_array().unwrap();
        grids.iter().map(|grid| grid["unique_name"].as_str().unwrap().to_owned()).collect()
    };
    let (first, second) = (names(&sphere).remove(0), names(&zero).remove(0));
    let renamed = format!("--rename={first}=ball");
    let both = at("both.vdb");
    succeeds(["convert".as_ref(), renamed.as_ref(), sphere.as_os_str(), zero.as_os_str(), both.as_os_str()]);
    let all = names(&both);
    assert!(all.contains(&"ball".to_owned()) && all.contains(&second), "{all:?}");

    succeeds(["convert".as_ref(), "--split".as_ref(), both.as_os_str(), at("out.vdb").as_os_str()]);
    assert_eq!(names(&at("out.ball.vdb")), ["ball"]);
    assert!(!at("out.vdb").exists());
    succeeds(["convert".as_ref(), "--grid=ball".as_ref(), both.as_os_str(), at("one.vdb").as_os_str()]);
    assert!(diff(&at("one.vdb"), &at("out.ball.vdb"), &[]).0);

    let missing =
        nuage(["convert".as_ref(), "--grid=nothing".as_ref(), both.as_os_str(), at("x.vdb").as_os_str()]);
    assert!(missing.status.code() == Some(1) && stderr(&missing).contains("'nothing' not found"));
    assert!(!at("x.vdb").exists());
}

#[test]
fn nothing_is_replaced_unasked() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out) = (edge("comp_sphere_blosc.vdb"), folder.path().join("out.vdb"));
    std::fs::write(&out, b"precious").unwrap();
    let refused = nuage(["convert".as_ref(), path.as_os_str(), out.as_os_str()]);
    assert!(refused.status.code() == Some(1) && stderr(&refused).contains("--force"), "{}", stderr(&refused));
    assert_eq!(std::fs::read(&out).unwrap(), b"precious");
    succeeds(["convert".as_ref(), "--force".as_ref(), path.as_os_str(), out.as_os_str()]);
    assert!(diff(&path, &out, &[]).0);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    let wrong = nuage(["convert".as_ref(), path.as_os_str(), folder.path().join("out.obj").as_os_str()]);
    assert_eq!(wrong.status.code(), Some(2));
    let wrong = nuage(["convert".as_ref(), "--codec=zip".as_ref(), path.as_os_str(), out.as_os_str()]);
    assert_eq!(wrong.status.code(), Some(2));
}

#[test]
fn the_limit_on_memory_is_the_users() {
    let path = edge("comp_sphere_blosc.vdb");
    for command in ["info", "validate"] {
        let output = nuage([command.as_ref(), "--max-memory=0.0001".as_ref(), path.as_os_str()]);
        let said = format!("{}{}", stdout(&output), stderr(&output));
        assert!(output.status.code() == Some(1) && said.contains("over the limit of"), "{said}");
    }
    assert_eq!(nuage(["info".as_ref(), "--max-memory=x".as_ref(), path.as_os_str()]).status.code(), Some(2));
}
