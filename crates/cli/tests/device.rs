//! `--device` as a user meets it: pictures of a GPU where there is one, and words where there is none.

use std::path::Path;
use std::process::{Command, Output};

use nuage_testkit as testkit;

fn render(output: &Path, options: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nuage"))
        .arg("render")
        .arg(testkit::workspace().join("assets/blast/blast.0009.vdb"))
        .arg("--output")
        .arg(output)
        .args("--up z --size 48 --density 4 --sky 0".split(' '))
        .args(options.split_whitespace())
        .output()
        .expect("a run")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_device_that_is_not_there_is_said_to_be_missing() {
    let folder = tempfile::tempdir().expect("a folder");
    let picture = folder.path().join("picture.png");
    let out = render(&picture, "--device no-such-device");
    assert_eq!(out.status.code(), Some(2), "{}", said(&out));
    assert!(said(&out).contains("no-such-device") && !picture.exists(), "{}", said(&out));
}

/// The same picture by both, but for rounding.
#[cfg(feature = "gpu")]
#[test]
fn a_gpu_renders_what_the_processor_does() {
    let folder = tempfile::tempdir().expect("a folder");
    let read = |name: &str, options: &str| {
        let picture = folder.path().join(name);
        let out = render(&picture, options);
        (out.status.code() == Some(0)).then(|| pixels(&picture)).ok_or_else(|| said(&out))
    };
    let by_gpu = match read("gpu.png", "--device gpu") {
        Ok(pixels) => pixels,
        Err(said) => {
            assert!(said.contains("no GPU"), "{said}");
            testkit::left_out("gpu", &said);
            return;
        }
    };
    let by_cpu = read("cpu.png", "--device cpu").expect("a picture");
    assert_eq!(by_gpu.len(), by_cpu.len());
    let near = by_gpu.iter().zip(&by_cpu).filter(|(a, b)| a.abs_diff(**b) <= 1).count();
    assert!(near as f64 >= 0.999 * by_cpu.len() as f64, "{near} of {}", by_cpu.len());
    assert!(by_cpu.iter().any(|value| *value != by_cpu[0]), "something is seen");
    let refused = render(&folder.path().join("other.exr"), "--device gpu --integrator path --aovs");
    assert_eq!(refused.status.code(), Some(2));
    assert!(said(&refused).contains("--aovs is for --device cpu"), "{}", said(&refused));
}

#[cfg(feature = "gpu")]
fn pixels(path: &Path) -> Vec<u8> {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).expect("a file")));
    let mut reader = decoder.read_info().expect("a picture");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut pixels).expect("a frame");
    pixels
}
