//! The program as a user runs it: `texture`.

use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use nuage_testkit as testkit;
use serde_json::Value;

fn nuage(args: &[&OsStr]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nuage")).args(args).stdin(Stdio::null()).output().unwrap()
}

fn succeeds(args: &[&OsStr]) -> String {
    let output = nuage(args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn fails(args: &[&OsStr], code: i32) -> String {
    let output = nuage(args);
    assert_eq!(output.status.code(), Some(code), "{}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8(output.stderr).unwrap()
}

/// Runs `texture` on a file, with options.
fn arguments<'a>(input: &'a Path, output: &'a Path, options: &[&'a str]) -> Vec<&'a OsStr> {
    let mut args = vec![OsStr::new("texture"), input.as_os_str(), output.as_os_str()];
    args.extend(options.iter().map(|option| OsStr::new(*option)));
    args
}

fn packed(folder: &Path, name: &str, options: &[&str]) -> std::path::PathBuf {
    let (source, target) = (testkit::committed("data/edge").join(name), folder.join("a.nuage"));
    let mut args = vec![OsStr::new("convert"), source.as_os_str(), target.as_os_str()];
    args.extend(options.iter().map(|option| OsStr::new(*option)));
    succeeds(&args);
    target
}

fn names_in(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name != "a.nuage")
        .collect();
    names.sort();
    names
}

#[test]
fn texture_and_sidecar_go_together() {
    let folder = tempfile::tempdir().unwrap();
    let input = packed(folder.path(), "comp_sphere_zipmask.vdb", &[]);
    for (format, brick_bytes) in [("r8", 512), ("r16f", 1024), ("bc4", 256), ("bc3", 128), ("bc7", 128)] {
        for (extension, letters) in [("dds", &b"DDS "[..]), ("ktx2", b"\xabKTX 20\xbb")] {
            let output = folder.path().join(format!("{format}.{extension}"));
            let said = succeeds(&arguments(&input, &output, &["--format", format]));
            assert!(said.contains(format) && said.contains("bricks in 1 frames"), "{said}");
            let bytes = fs::read(&output).unwrap();
            assert!(bytes.starts_with(letters));
            let json = fs::read(folder.path().join(format!("{format}.{extension}.json"))).unwrap();
            let json: Value = serde_json::from_slice(&json).unwrap();
            assert_eq!(json["texture"], format!("{format}.{extension}"));
            let bricks = json["frames"][0]["bricks"].as_array().unwrap();
            let count = json["brick_count"].as_u64().unwrap();
            assert!(count > 0 && bricks.iter().all(|brick| brick[3].as_u64().unwrap() < count));
            let per_axis = json["bricks_per_axis"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap());
            let texels = per_axis.product::<u64>() * brick_bytes;
            let header_bytes = bytes.len() as u64 - texels;
            assert!((148..512).contains(&header_bytes), "{header_bytes}");
        }
    }
    assert_eq!(names_in(folder.path()).len(), 20);
}

#[test]
fn nothing_is_replaced_or_left_half() {
    let folder = tempfile::tempdir().unwrap();
    let input = packed(folder.path(), "comp_sphere_zipmask.vdb", &["--codec", "bc7"]);
    let output = folder.path().join("b.dds");
    fs::write(folder.path().join("b.dds.json"), b"mine").unwrap();
    assert!(fails(&arguments(&input, &output, &[]), 1).contains("b.dds.json"));
    assert_eq!(names_in(folder.path()), ["b.dds.json"]);
    succeeds(&arguments(&input, &output, &["--force", "--global"]));
    let json: Value = serde_json::from_slice(&fs::read(folder.path().join("b.dds.json")).unwrap()).unwrap();
    assert!(json["common_scale"].is_array());
    assert!(fails(&arguments(&input, &output, &["--frames=1"]), 1).contains("--force"));
    let other = folder.path().join("c.ktx2");
    assert!(fails(&arguments(&input, &other, &["--channel", "fog"]), 1).contains("'fog'"));
    assert!(fails(&arguments(&input, &other, &["--frames=7"]), 1).contains("none of these frames"));
    assert!(fails(&arguments(&input, &other, &["--format=png"]), 2).contains("r16f"));
    assert!(fails(&arguments(&input, &folder.path().join("c.png"), &[]), 2).contains(".ktx2"));
    assert_eq!(names_in(folder.path()), ["b.dds", "b.dds.json"]);
}
