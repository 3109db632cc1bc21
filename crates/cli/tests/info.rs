//! The program as a user runs it: `info` and `probe` against ground truth, exit codes and messages.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use nuage_testkit as testkit;
use serde_json::Value;

fn nuage() -> Command {
    Command::new(env!("CARGO_BIN_EXE_nuage"))
}

fn edge(name: &str) -> PathBuf {
    testkit::committed("data/edge").join(name)
}

fn run(command: &mut Command) -> Output {
    command.stdin(Stdio::null()).output().unwrap()
}

fn run_with_input(command: &mut Command, input: &str) -> Output {
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let input = input.to_owned();
    let writer = std::thread::spawn(move || {
        // The program may stop reading at a wrong line.
        let _ = stdin.write_all(input.as_bytes());
    });
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    output
}

fn stdout(output: &Output) -> &str {
    std::str::from_utf8(&output.stdout).unwrap()
}

fn stderr(output: &Output) -> &str {
    std::str::from_utf8(&output.stderr).unwrap()
}

fn json_lines(output: &Output) -> Vec<Value> {
    stdout(output).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The file with 200 bytes overwritten in the middle of the body of its first grid.
fn damaged(name: &str, folder: &Path) -> PathBuf {
    let mut bytes = std::fs::read(edge(name)).unwrap();
    let middle = bytes.len() / 4;
    bytes[middle..middle + 200].fill(0xa5);
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

/// Equal, numbers up to a relative `tolerance`.
fn same(got: &Value, want: &Value, tolerance: f64) -> bool {
    match (got, want) {
        (Value::Number(a), Value::Number(b)) => {
            let (a, b) = (a.as_f64().unwrap(), b.as_f64().unwrap());
            (a - b).abs() <= tolerance * b.abs().max(1.0)
        }
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b, tolerance))
        }
        _ => got == want,
    }
}

#[test]
fn info_in_json_equals_the_truth() {
    let truths = testkit::truths();
    assert!(truths.len() >= 30);
    let output = run(nuage().args(["info", "--json", "--hash"]).args(truths.iter().map(|(path, _)| path)));
    assert!(output.status.success(), "{}", stderr(&output));
    let files = json_lines(&output);
    assert_eq!(files.len(), truths.len());
    for (got, (path, want)) in files.iter().zip(&truths) {
        for key in ["file", "size", "file_version", "library_version", "file_metadata"] {
            assert_eq!(got[key], want[key], "{}: {key}", path.display());
        }
        let (grids, wanted) = (got["grids"].as_array().unwrap(), want["grids"].as_array().unwrap());
        assert_eq!(grids.len(), wanted.len(), "{}", path.display());
        for want in wanted {
            let got = grids.iter().find(|grid| grid["unique_name"] == want["unique_name"]).unwrap();
            compare_grid(got, want, &format!("{} {}", path.display(), want["unique_name"]));
        }
    }
}

fn compare_grid(got: &Value, want: &Value, context: &str) {
    let equal =
        |key: &str| assert!(same(&got[key], &want[key], 0.0), "{context} {key}: {} {}", got[key], want[key]);
    let null = |key: &str| assert!(got.get(key).is_some_and(Value::is_null), "{context} {key}: {}", got[key]);
    [
        "name",
        "unique_name",
        "grid_type",
        "value_type",
        "grid_class",
        "vector_type",
        "creator",
        "save_float_as_half",
        "in_world_space",
        "metadata",
        "active_bbox",
    ]
    .into_iter()
    .for_each(equal);
    for key in ["type", "linear", "mat4_row_vector"] {
        let (got, want) = (got["transform"].get(key), want["transform"].get(key));
        let [got, want] = [got, want].map(|value| value.unwrap_or(&Value::Null));
        assert!(same(got, want, 0.0), "{context} {key}: {got} {want}");
    }
    for key in ["voxel_size", "index_to_world"] {
        let (got, want) = (&got["transform"][key], &want["transform"][key]);
        assert!(same(got, want, 1e-9), "{context} {key}: {got} {want}");
    }
    let of_voxels = [
        "background",
        "active_voxels",
        "active_tiles",
        "node_counts_leaf_to_root",
        "leaf_count",
        "leaf_bbox",
        "active_leaf_voxels",
    ];
    let of_numbers = ["min", "max", "nan_count"];
    of_voxels.into_iter().for_each(equal);
    match want.get("min") {
        Some(_) => of_numbers.iter().for_each(|key| equal(key)),
        None => {
            ["min", "max"].into_iter().for_each(null);
            assert_eq!(got["nan_count"], 0, "{context}");
        }
    }
    if want.get("point_count").is_some() {
        equal("point_count");
        let attributes = got["attributes"].as_array().unwrap();
        assert!(attributes.iter().any(|a| a["name"] == "P" && a["type"] == "vec3s"), "{context}");
    }
    equal("fnv1a64_topology");
    // A NaN has many bit patterns, and not every writer keeps them.
    if want["background"] != "nan" && want["nan_count"].as_u64().unwrap_or(0) == 0 {
        equal("fnv1a64_leaf_values");
    }
}

#[test]
fn hashes_come_only_when_asked_for() {
    let output = run(nuage().args(["info", "--json"]).arg(edge("tiles_levels.vdb")));
    let grid = &json_lines(&output)[0]["grids"][0];
    assert!(grid["leaf_count"] == 1 && grid.get("fnv1a64_topology").is_none());
}

#[test]
fn probes_in_json_equal_the_truth() {
    let files = ["tiles_levels", "special_values", "cross_zero", "far_coords", "half_blosc"];
    for name in files {
        let path = edge(&format!("{name}.vdb"));
        let truth = std::fs::read_to_string(edge(&format!("{name}.truth.json"))).unwrap();
        let truth: Value = serde_json::from_str(&truth).unwrap();
        let is_float = |grid: &&Value| grid["grid_type"] == "Tree_float_5_4_3";
        for grid in truth["grids"].as_array().unwrap().iter().filter(is_float) {
            let wanted = grid["probes"].as_array().unwrap();
            let line = |probe: &Value| {
                let ijk: [i32; 3] = serde_json::from_value(probe["ijk"].clone()).unwrap();
                format!("{} {} {}\n", ijk[0], ijk[1], ijk[2])
            };
            let input: String = wanted.iter().map(line).collect();
            let grid_name = grid["unique_name"].as_str().unwrap();
            let output =
                run_with_input(nuage().args(["probe", "--json", "--grid", grid_name]).arg(&path), &input);
            assert!(output.status.success(), "{name} {grid_name}: {}", stderr(&output));
            let probes = json_lines(&output);
            assert_eq!(probes.len(), wanted.len());
            for (got, want) in probes.iter().zip(wanted) {
                for key in ["ijk", "v", "on", "depth"] {
                    assert!(same(&got[key], &want[key], 0.0), "{name} {grid_name}: {got} {want}");
                }
            }
        }
    }
}

#[test]
fn coordinates_come_from_the_command_line_or_from_standard_input() {
    let file = edge("tiles_levels.vdb");
    let plain = run(nuage().arg("probe").arg(&file).args(["-1", "-2", "-3", "8191", "4095", "4095"]));
    assert_eq!(stdout(&plain), "-1 -2 -3  1.25  active  2\n8191 4095 4095  3  active  0\n", "{plain:?}");
    let dashes = run(nuage().arg("probe").arg(&file).args(["--", "-1", "-2", "-3", "8191", "4095", "4095"]));
    assert_eq!(stdout(&dashes), stdout(&plain));
    let input = "# two corners\n\n-1, -2, -3\r\n 8191,4095\t4095";
    let lines = run_with_input(nuage().arg("probe").arg(&file), input);
    assert_eq!(stdout(&lines), stdout(&plain), "{}", stderr(&lines));
}

#[test]
fn a_wrong_line_is_named_after_the_answers_before_it() {
    let output =
        run_with_input(nuage().arg("probe").arg(edge("tiles_levels.vdb")), "0 0 0\n# fine\n1 2\n0 0 0\n");
    assert_eq!(output.status.code(), Some(1));
    assert_eq!(stdout(&output).lines().count(), 1);
    assert!(
        stderr(&output).starts_with("nuage: standard input, line 3: '1 2' is not"),
        "{}",
        stderr(&output)
    );
    let endless = run_with_input(nuage().arg("probe").arg(edge("tiles_levels.vdb")), &" 1".repeat(100_000));
    assert_eq!(endless.status.code(), Some(1), "{}", stderr(&endless));
}

#[test]
fn a_grid_that_is_not_named_well_is_answered_with_the_names() {
    let file = edge("special_values.vdb");
    let unknown = run(nuage().arg("probe").arg(&file).args(["--grid", "spezial", "0", "0", "0"]));
    let none = run(nuage().arg("probe").arg(&file).args(["0", "0", "0"]));
    for output in [&unknown, &none] {
        assert_eq!(output.status.code(), Some(1));
        assert!(output.stdout.is_empty());
        let message = stderr(output);
        assert!(message.starts_with(&format!("nuage: {}: ", file.display())), "{message}");
        for name in ["special", "special_half", "background_nan", "background_inf"] {
            assert!(message.contains(name), "{message}");
        }
    }
    assert!(stderr(&unknown).contains("grid 'spezial' not found; the file has: "));
    let empty = run(nuage().arg("probe").arg(edge("no_grids.vdb")).args(["0", "0", "0"]));
    assert!(stderr(&empty).contains("no grids") && empty.status.code() == Some(1));
    let points = run(nuage().arg("probe").arg(edge("points.vdb")).args(["--grid", "points", "0", "0", "0"]));
    assert!(points.status.success(), "{points:?}");
}

#[test]
fn info_goes_on_after_a_file_that_fails() {
    let folder = tempfile::tempdir().unwrap();
    let absent = folder.path().join("absent.vdb");
    let text = folder.path().join("text.vdb");
    std::fs::write(&text, "This is a text, which is something else entirely.").unwrap();
    let good = edge("tiles_levels.vdb");
    let bad = [absent.as_path(), &text, folder.path()];
    let output = run(nuage().arg("info").args(bad).arg(&good));
    assert_eq!(output.status.code(), Some(1));
    assert!(stdout(&output).contains("68,723,672,065"));
    let messages: Vec<&str> = stderr(&output).lines().collect();
    assert_eq!(messages.len(), bad.len());
    for (message, path) in messages.iter().zip(bad) {
        assert!(message.starts_with(&format!("nuage: {}: ", path.display())), "{message}");
    }
    let output = run(nuage().args(["info", "--json"]).args(bad).arg(&good));
    assert_eq!(output.status.code(), Some(1));
    let files = json_lines(&output);
    assert_eq!(files.len(), 4);
    assert!(files[..3].iter().all(|file| file["error"].is_string()) && files[3].get("error").is_none());
    assert_eq!(files[0]["file"], "absent.vdb");
}

#[test]
fn a_damaged_grid_hides_neither_its_header_nor_the_other_grids() {
    let folder = tempfile::tempdir().unwrap();
    let file = damaged("special_values.vdb", folder.path());
    let output = run(nuage().arg("info").arg(&file));
    assert_eq!(output.status.code(), Some(1), "{}", stdout(&output));
    let header = format!("nuage: {}: grid '", file.display());
    assert!(
        stderr(&output).lines().count() == 1 && stderr(&output).starts_with(&header),
        "{}",
        stderr(&output)
    );
    assert_eq!(stdout(&output).matches("cannot be read").count(), 1);
    assert_eq!(stdout(&output).lines().filter(|line| line.starts_with("  active voxels")).count(), 3);

    let output = run(nuage().args(["info", "--json"]).arg(&file));
    assert_eq!(output.status.code(), Some(1));
    let json = &json_lines(&output)[0];
    let (bad, good): (Vec<&Value>, Vec<&Value>) =
        json["grids"].as_array().unwrap().iter().partition(|grid| grid.get("error").is_some());
    assert_eq!((bad.len(), good.len()), (1, 3));
    assert!(bad[0]["active_voxels"].is_null() && bad[0]["transform"].is_object());
    assert!(good.iter().all(|grid| grid["active_voxels"].is_number()));
    // One grid is read without the others.
    for (grids, code) in [(&bad, 1), (&good, 0)] {
        let name = grids[0]["unique_name"].as_str().unwrap();
        let output = run(nuage().arg("probe").arg(&file).args(["--grid", name, "1", "1", "1"]));
        assert_eq!(output.status.code(), Some(code), "{name}");
    }
}

#[test]
fn info_for_people_tells_what_the_file_holds() {
    let output = run(nuage().arg("info").arg(edge("py10_mixed.vdb")));
    assert!(output.status.success(), "{}", stderr(&output));
    let words = stdout(&output).split_whitespace().collect::<Vec<_>>().join(" ");
    for part in [
        "py10_mixed.vdb: 3 grids",
        "file version 224 (library 10.0)",
        "scene: edge",
        "density class unknown type Tree_float_5_4_3 compression blosc + active values only",
        "transform AffineMap",
        "world from index [0.1, 0, 0, 0] [0, 0.2, 0.01, 0] [0, -0.01, 0.2, 0] [1, 2, 3, 1]",
        "active values 0.00296297 to 1",
        "active voxels 9,093",
        "nodes root 1, 32³ 2, 16³ 2, leaves of 8³ 47",
        "active box [-5, 9, 101] to [19, 33, 125], 25 × 25 × 25 voxels",
        "pos: [1, 2, 3]",
        "active box [0, 0, 0] to [20, 20, 20], 21 × 21 × 21 voxels",
    ] {
        assert!(words.contains(part), "{part}\n{}", stdout(&output));
    }
}

#[test]
fn wrong_usage_is_exit_code_2() {
    let file = edge("tiles_levels.vdb");
    let file = file.to_str().unwrap();
    for arguments in [
        &[][..],
        &["unfold"],
        &["info"],
        &["info", "--jason", file],
        &["probe", file, "1", "2"],
        &["probe", file, "1", "2", "x"],
        &["probe", file, "1", "2", "2147483648"],
    ] {
        let output = run(nuage().args(arguments));
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{arguments:?}");
    }
    for arguments in [&["--help"][..], &["--version"], &["info", "--help"], &["probe", "--help"]] {
        assert_eq!(run(nuage().args(arguments)).status.code(), Some(0), "{arguments:?}");
    }
}

#[test]
fn a_reader_that_has_seen_enough_ends_the_program_quietly() {
    // More output than any pipe holds, so that the program must notice.
    let files = vec![edge("metadata_all.vdb"); 20];
    let mut command = nuage();
    command.args(["info", "--json"]).args(files).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.starts_with("{\"file\":\"metadata_all.vdb\""));
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
}
