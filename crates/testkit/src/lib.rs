//! Test data, ground truth and image comparison for the tests of all crates.
//!
//! Every path to data goes through [`find`], so that tests run on the small committed files everywhere and on
//! the large ones where they are. A test that finds nothing says so; with `NUAGE_REQUIRE=data` it fails.
//! Nothing here is part of the product.

#![allow(clippy::print_stderr, reason = "tests report what they leave out")]
#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

use std::env;
use std::path::{Path, PathBuf};

use serde_json::Value;

pub mod blocks;
pub mod clock;
pub mod npy;
pub mod synthetic;

/// The root of the repository.
pub fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The folders that hold test data: `NUAGE_DATA` (default `../shared` beside the repository), then the
/// committed part of it.
pub fn data_roots() -> [PathBuf; 2] {
    let external = env::var_os("NUAGE_DATA").map_or_else(|| workspace().join("../shared"), PathBuf::from);
    [external, workspace().join("testdata")]
}

/// Whether `NUAGE_REQUIRE` names this kind of thing: `data`, `gpu` or `openvdb`.
pub fn required(kind: &str) -> bool {
    env::var("NUAGE_REQUIRE").is_ok_and(|list| list.split(',').any(|item| item.trim() == kind))
}

/// Says that a test leaves something out.
///
/// # Panics
/// If `NUAGE_REQUIRE` names that kind of thing.
pub fn left_out(kind: &str, what: &str) {
    assert!(!required(kind), "{what} is absent, and NUAGE_REQUIRE names {kind}");
    eprintln!("left out: {what} is absent (kind: {kind})");
}

/// The path of a data file or folder such as `data/edge/points.vdb`, or `None` after saying so.
///
/// # Panics
/// If it is nowhere and `NUAGE_REQUIRE` names `data`.
pub fn find(relative: &str) -> Option<PathBuf> {
    let found = data_roots().into_iter().map(|root| root.join(relative)).find(|path| path.exists());
    if found.is_none() {
        left_out("data", relative);
    }
    found
}

/// The path of a file that is committed with the repository, below `testdata`.
pub fn committed(relative: &str) -> PathBuf {
    workspace().join("testdata").join(relative)
}

/// All files with ground truth, each as the path of the .vdb file and its truth. Of a file that stands both
/// outside and in the repository, the outside one.
///
/// # Panics
/// If a truth file cannot be read, or the large data is absent and `NUAGE_REQUIRE` names `data`.
pub fn truths() -> Vec<(PathBuf, Value)> {
    let [external, committed] = data_roots();
    let mut found: Vec<(PathBuf, PathBuf)> = Vec::new();
    for root in [external, committed] {
        let mut files = Vec::new();
        walk(&root.join("data"), &mut files);
        if files.is_empty() {
            left_out("data", &root.display().to_string());
        }
        for file in files {
            let relative = file.strip_prefix(&root).expect("a file below its root").to_owned();
            if !found.iter().any(|(known, _)| *known == relative) {
                found.push((relative, file));
            }
        }
    }
    found.sort();
    let read = |(_, path): (PathBuf, PathBuf)| {
        let text = std::fs::read_to_string(&path).expect("a readable truth file");
        let truth = serde_json::from_str(&text).expect("a truth file in JSON");
        let name = path.file_name().and_then(|n| n.to_str()).expect("a name in UTF-8");
        (path.with_file_name(name.replace(".truth.json", ".vdb")), truth)
    };
    found.into_iter().map(read).collect()
}

fn walk(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            walk(&path, files);
        } else if path.to_string_lossy().ends_with(".truth.json") {
            files.push(path);
        }
    }
}

/// A number of a truth file, where NaN and the infinities are strings.
///
/// # Panics
/// If it is neither.
pub fn number(value: &Value) -> f64 {
    match value.as_str() {
        Some("nan") => f64::NAN,
        Some("inf") => f64::INFINITY,
        Some("-inf") => f64::NEG_INFINITY,
        Some(other) => panic!("{other} is not a number"),
        None => value.as_f64().expect("a number"),
    }
}

/// Equal as numbers, NaN equal to itself.
pub fn same(a: f64, b: f64) -> bool {
    a == b || (a.is_nan() && b.is_nan())
}
