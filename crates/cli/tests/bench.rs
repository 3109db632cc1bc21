//! `nuage bench` as a user meets it.

use std::process::{Command, Output};

use nuage_testkit as testkit;
use serde_json::Value;

fn bench(options: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nuage"))
        .arg("bench")
        .arg(testkit::workspace().join("assets/blast/blast.0009.vdb"))
        .args(options.split_whitespace())
        .output()
        .expect("a run")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn the_processor_is_measured() {
    let out = bench("--size 32x18 --repeats 3 --kinds density,march --json");
    assert_eq!(out.status.code(), Some(0), "{}", said(&out));
    let found: Value = serde_json::from_slice(&out.stdout).expect("JSON");
    let kinds = found["kinds"].as_array().expect("kinds");
    let names: Vec<&str> = kinds.iter().filter_map(|kind| kind["kind"].as_str()).collect();
    assert_eq!(names, ["density", "march"]);
    for kind in kinds {
        let ms = kind["frame_ms"].as_f64().expect("a time");
        let rays = kind["camera_rays_per_second"].as_f64().expect("a rate");
        assert!(ms > 0.0 && (rays * ms / 1e3 - 32.0 * 18.0).abs() < 1e-6, "{kind}");
        assert!(kind["values_per_pixel"].is_null(), "the processor does not count");
    }
    assert!(found["memory_bytes"]["bricks"].as_u64().is_some_and(|bytes| bytes > 0), "{found}");
    let text = bench("--size 32x18 --repeats 1 --warm-up 0 --kinds depth");
    let text = String::from_utf8_lossy(&text.stdout).into_owned();
    assert!(text.contains("32 × 18") && text.contains("medians of 1, by the clock"), "{text}");
}

#[test]
fn what_makes_no_sense_is_refused() {
    for options in ["--repeats 0", "--kinds none", "--device no-such-device", "--size 0x5"] {
        let out = bench(options);
        assert_eq!((out.status.code(), out.stdout.len()), (Some(2), 0), "{options}: {}", said(&out));
    }
    let out = bench("--grid none");
    assert_eq!(out.status.code(), Some(1), "{}", said(&out));
}

#[cfg(feature = "gpu")]
#[test]
fn a_gpu_is_measured_and_counts() {
    let out = bench("--size 32x18 --repeats 2 --kinds depth --device gpu --json");
    if said(&out).contains("no GPU") {
        testkit::left_out("gpu", &said(&out));
        return;
    }
    assert_eq!(out.status.code(), Some(0), "{}", said(&out));
    let found: Value = serde_json::from_slice(&out.stdout).expect("JSON");
    let kind = &found["kinds"][0];
    let count = |name: &str| kind[name].as_f64().unwrap_or(-1.0);
    assert!(count("rays_per_pixel") > 0.0 && count("rays_per_pixel") <= 1.0, "{kind}");
    assert!(count("look_ups_per_pixel") > 0.0 && count("values_per_pixel") > 0.0, "{kind}");
    for part in ["trees", "bricks", "tables"] {
        assert!(found["memory_bytes"][part].as_u64().is_some_and(|bytes| bytes > 0), "{found}");
    }
    assert!(found["upload_ms"].as_f64().is_some_and(|ms| ms > 0.0), "{found}");
}
