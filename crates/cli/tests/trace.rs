//! Pictures made of paths as a user gets them: stopped by what was asked, kept and gone on with, written with all that is known.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use exr::prelude::{ReadChannels, ReadLayers};
use nuage_testkit as testkit;
use tempfile::TempDir;

fn command(output: &Path, options: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nuage"));
    command
        .arg("render")
        .arg(testkit::workspace().join("assets/blast/blast.0009.vdb"))
        .arg("--output")
        .arg(output)
        .args("--up z --size 24 --density 4 --integrator path --exr-float".split(' '))
        .args(options.split_whitespace())
        .stdin(Stdio::null());
    command
}

fn run(output: &Path, options: &str) -> Output {
    command(output, options).output().unwrap()
}

/// Renders, and gives what was said.
fn rendered(output: &Path, options: &str) -> String {
    let out = run(output, options);
    let said = String::from_utf8(out.stderr).unwrap();
    assert_eq!(out.status.code(), Some(0), "{said}");
    said
}

fn refused(output: &Path, options: &str) -> String {
    let out = run(output, options);
    assert_eq!(out.status.code(), Some(2), "{options}");
    assert!(!output.exists());
    String::from_utf8(out.stderr).unwrap()
}

/// The paths per pixel that `--timing` tells of.
fn paths(said: &str) -> u32 {
    let line = said.lines().find(|line| line.contains("paths per pixel")).unwrap();
    let (before, _) = line.split_once(" paths per pixel").unwrap();
    before.rsplit(' ').next().unwrap().parse().unwrap()
}

struct Folder(TempDir);

impl Folder {
    fn new() -> Folder {
        Folder(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
}

#[test]
fn a_picture_that_was_kept_becomes_the_one_that_was_never_stopped() {
    let folder = Folder::new();
    let (whole, kept) = (folder.path("whole.exr"), folder.path("kept.exr"));
    rendered(&whole, "--spp 5");
    rendered(&kept, "--spp 2 --checkpoint");
    let checkpoint = folder.path("kept.exr.checkpoint");
    assert!(checkpoint.exists());
    assert_ne!(fs::read(&kept).unwrap(), fs::read(&whole).unwrap());
    rendered(&kept, "--spp 5 --checkpoint --resume --threads 1");
    assert_eq!(fs::read(&kept).unwrap(), fs::read(&whole).unwrap());

    // Of another scene, or damaged, it is refused and the picture stays.
    let before = fs::read(&kept).unwrap();
    for (options, what) in [("--phase 0.5", "another scene"), ("--seed 1", "another scene")] {
        let out = run(&kept, &format!("--spp 9 --checkpoint --resume {options}"));
        let said = String::from_utf8(out.stderr).unwrap();
        assert!(out.status.code() == Some(1) && said.contains(what), "{said}");
    }
    let mut bytes = fs::read(&checkpoint).unwrap();
    bytes[100] ^= 1;
    fs::write(&checkpoint, bytes).unwrap();
    let out = run(&kept, "--spp 9 --checkpoint --resume");
    assert!(String::from_utf8(out.stderr).unwrap().contains("damaged"));
    assert_eq!(fs::read(&kept).unwrap(), before);

    // What cannot be kept is said, but the picture is there.
    fs::remove_file(&checkpoint).unwrap();
    fs::create_dir(&checkpoint).unwrap();
    fs::remove_file(&kept).unwrap();
    let out = run(&kept, "--spp 5 --checkpoint");
    let said = String::from_utf8(out.stderr).unwrap();
    assert!(out.status.code() == Some(1) && said.contains("kept.exr.checkpoint"), "{said}");
    assert_eq!(fs::read(&kept).unwrap(), fs::read(&whole).unwrap());
}

#[test]
fn a_picture_stops_by_noise_and_by_time() {
    let folder = Folder::new();
    let said = rendered(&folder.path("noise.exr"), "--noise 0.5 --timing");
    let coarse = paths(&said);
    assert!(coarse >= 16 && said.contains("the noise that was asked for"), "{said}");
    let fine = paths(&rendered(&folder.path("fine.exr"), "--noise 0.2 --timing"));
    assert!(fine > 2 * coarse, "{fine} and {coarse}");
    // Whatever comes first.
    let said = rendered(&folder.path("few.exr"), "--noise 0.0001 --spp 3 --timing");
    assert_eq!(paths(&said), 3);
    let begin = Instant::now();
    let said = rendered(&folder.path("time.exr"), "--time 0.3 --timing");
    assert!(said.contains("time was up") && paths(&said) >= 1, "{said}");
    assert!(begin.elapsed() < Duration::from_secs(60));
}

#[test]
fn layers_add_up_to_the_picture_and_carry_the_scene() {
    let folder = Folder::new();
    let (layers, scene) = (folder.path("layers.exr"), folder.path("scene.toml"));
    let flame = "--temperature temperature --emission 0.03 --background none";
    rendered(&layers, &format!("--spp 4 --aovs {flame} --save-scene {}", scene.display()));
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_file(&layers)
        .unwrap();
    let layer = &image.layer_data;
    let channel = |name: &str| -> Vec<f32> {
        let found = layer.channel_data.list.iter().find(|channel| channel.name.to_string() == name);
        found.unwrap_or_else(|| panic!("no {name}")).sample_data.values_as_f32().collect()
    };
    let parts = ["emission.G", "direct.G", "indirect.G"].map(channel);
    for (i, beauty) in channel("G").into_iter().enumerate() {
        let sum = parts[0][i] + parts[1][i] + parts[2][i];
        assert!((beauty - sum).abs() <= 1e-5 * (1.0 + beauty), "{beauty} and {sum}");
    }
    assert!(parts.iter().all(|part| part.iter().any(|light| *light > 0.0)));
    assert!(channel("samples.Y").iter().all(|count| *count == 4.0));
    assert!(channel("Z").iter().any(|depth| depth.is_finite() && *depth > 0.0));
    let text = layer.attributes.other.iter().find(|(name, _)| **name == *"nuage/scene");
    let (_, exr::prelude::AttributeValue::Text(text)) = text.unwrap() else { panic!("no text") };
    assert!(text.to_string().contains("[[volumes]]"));

    // The scene that was saved makes the same file again.
    let again = folder.path("again.exr");
    let out = Command::new(env!("CARGO_BIN_EXE_nuage"))
        .args(["render", "--scene"])
        .arg(&scene)
        .arg("--output")
        .arg(&again)
        .output()
        .unwrap();
    assert_eq!(out.status.code(), Some(0), "{}", String::from_utf8_lossy(&out.stderr));
    assert_eq!(fs::read(&again).unwrap(), fs::read(&layers).unwrap());
}

#[test]
fn what_makes_no_sense_is_refused_before_anything_is_rendered() {
    let folder = Folder::new();
    let png = folder.path("picture.png");
    assert!(refused(&png, "--aovs").contains(".exr"));
    let exr = folder.path("picture.exr");
    for option in ["--noise 0.1", "--time 1", "--checkpoint", "--aovs", "--denoise"] {
        let said = refused(&exr, &format!("{option} --integrator march"));
        assert!(said.contains("is for --integrator path") || said.contains("cannot be used"), "{said}");
    }
    let mut denoise = command(&exr, "--denoise --spp 1");
    let out = denoise.env("PATH", folder.0.path()).output().unwrap();
    assert_eq!(out.status.code(), Some(2));
    assert!(String::from_utf8(out.stderr).unwrap().contains("oidnDenoise"));
}

#[cfg(unix)]
#[test]
fn an_interrupt_writes_what_there_is() {
    let folder = Folder::new();
    let exr = folder.path("picture.exr");
    let mut child: Child =
        command(&exr, "--spp 10000000 --checkpoint").stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_secs(2));
    let interrupt = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(interrupt.success());
    let begin = Instant::now();
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status,
            None if begin.elapsed() > Duration::from_secs(60) => {
                child.kill().unwrap();
                panic!("it does not end");
            }
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    let said = std::io::read_to_string(child.stderr.take().unwrap()).unwrap();
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("called off") && exr.exists(), "{said}");
    // What was kept goes on.
    let before = paths(&said);
    let more = rendered(&exr, &format!("--spp {} --checkpoint --resume --timing", before + 1));
    assert_eq!(paths(&more), before + 1);
}
