//! Every volume, every form of bricks and every filter: pictures of the GPU held to those of the CPU.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod cells;
#[path = "../common/mod.rs"]
mod common;
mod reference;

use std::time::Instant;

use cells::{ALL_PARTS, Form, Matrix, Pair, Part, SMALL, Shown, Subject, forms, hold, pairs, subjects};
use common::gpu;
use nuage_gpu::device::Gpu;
use nuage_gpu::renderer::Renderer;
use nuage_render::filter::{Filter, Lookup};

/// Files whose volumes are small and differ in kind.
const SMALL_FILES: [&str; 24] = [
    "oracle/oracle_64.vdb",
    "data/samples/blast.0001.vdb",
    "data/samples/blast.0008.vdb",
    "data/samples/blast.0016.vdb",
    "data/public/openusd_densityAndHeat.vdb",
    "data/public/openusd_smoke_000002.vdb",
    "data/public/arnoldusd_torus01.vdb",
    "data/public/arnoldusd_grids.vdb",
    "data/edge/background_nonzero.vdb",
    "data/edge/comp_random_zip.vdb",
    "data/edge/comp_seven_zipmask.vdb",
    "data/edge/comp_sphere_zip.vdb",
    "data/edge/cross_zero.vdb",
    "data/edge/dense_constant_unpruned.vdb",
    "data/edge/half_zip.vdb",
    "data/edge/leaf_masks.vdb",
    "data/edge/lower_tiles_only.vdb",
    "data/edge/metadata_all.vdb",
    "data/edge/py10_mixed.vdb",
    "data/edge/special_values.vdb",
    "data/edge/single_voxel_m1.vdb",
    "data/edge/transforms.vdb",
    "data/edge/classes.vdb",
    "data/edge/v12_sphere_half.vdb",
];

/// Files whose volumes reach far, so that loops on lavapipe may. Their pictures take longest.
const WIDE_FILES: [&str; 9] = [
    "data/edge/empty_grid.vdb",
    "data/edge/empty_grid_background.vdb",
    "data/edge/far_coords.vdb",
    "data/edge/many_root_children.vdb",
    "data/edge/root_tiles_only.vdb",
    "data/edge/single_voxel_far.vdb",
    "data/edge/single_voxel_corner.vdb",
    "data/edge/tiles_levels.vdb",
    "data/edge/tiles_levels_bg_m1_none.vdb",
];

/// Volumes that take seconds to be packed, the largest last.
const LARGE_FILES: [&str; 8] = [
    "data/public/gaffer_smoke.vdb",
    "data/static/bunny_ls200_f16_zip.vdb",
    "data/static/bunny_fog200_f32_zip.vdb",
    "data/static/armadillo_fog300_f16_blosc.vdb",
    "data/static/teapot_ls256_f16_none.vdb",
    "data/edge/types_none.vdb",
    "data/static/dragon_ls1000_f16_blosc.vdb",
    "data/static/cumulus_half_f16_blosc.vdb",
];

/// Forms of which no two share a decoder, or the widths of codes in one.
const UNLIKE_FORMS: [&str; 20] = [
    "channel",
    "f32",
    "f16",
    "u1",
    "u4",
    "u5",
    "u8",
    "s3",
    "g0",
    "g4",
    "l2",
    "bc4z",
    "bc3y",
    "bc7x",
    "bc4x texture",
    "bc3z texture",
    "bc7y texture",
    "u4 decoded",
    "45 dB",
    "error of 2 %",
];

/// All files of the corpus that are in no list, by their paths below the data: other frames of sequences, and the same volumes as
/// others, written otherwise. Damaged ones are left out.
fn other_files() -> Vec<String> {
    let Some(data) = nuage_testkit::find("data") else { return Vec::new() };
    let listed = [&SMALL_FILES[..], &WIDE_FILES[..], &LARGE_FILES[..]].concat();
    let (mut folders, mut files) = (vec![data.clone()], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("a file or folder").path();
            let relative = format!("data/{}", path.strip_prefix(&data).expect("below the data").display());
            if path.is_dir() && !path.ends_with("bad") {
                folders.push(path);
            } else if path.extension().is_some_and(|kind| kind == "vdb")
                && !listed.contains(&relative.as_str())
            {
                files.push(relative);
            }
        }
    }
    files.sort();
    files
}

/// Forms in which volumes that reach far are looked at: these are trees more than bricks, and trees are the same in all forms.
const WIDE_FORMS: [&str; 4] = ["channel", "f16", "u4", "45 dB"];

struct Bench {
    gpu: Gpu,
    renderer: Renderer,
    matrix: Matrix,
    forms: Vec<Form>,
}

impl Bench {
    fn new() -> Option<Bench> {
        let gpu = gpu()?;
        let renderer = Renderer::new(&gpu, SMALL).expect("a renderer");
        let forms = forms(gpu.smallest_bricks().expect("a form"));
        Some(Bench { gpu, renderer, matrix: Matrix::default(), forms })
    }

    /// Holds volumes in a form. Part after part: lavapipe takes seconds to make a shader, and forgets large ones.
    fn hold(&mut self, form: usize, subjects: &[&Subject], parts: &[Part]) {
        let pairs: Vec<Pair> =
            subjects.iter().flat_map(|subject| pairs(&self.gpu, subject, &self.forms[form])).collect();
        let shown: Vec<Shown<'_>> = pairs.iter().filter_map(Pair::shown).collect();
        for part in parts {
            for shown in &shown {
                hold(&mut self.matrix, &mut self.renderer, shown, *part);
            }
        }
    }

    fn named(&self, names: &[&str]) -> Vec<usize> {
        (0..self.forms.len()).filter(|i| names.contains(&self.forms[*i].name.as_str())).collect()
    }
}

/// All forms of the volumes that differ, by all filters: those that share a decoder with another of each third volume in turn,
/// and large volumes and all that are like others in a form each, in turn. Prints what it found. `NUAGE_FORMS` names the forms
/// that are wanted, with commas between them, and `NUAGE_VOLUMES` the files.
#[test]
#[ignore = "takes minutes for each form on a device in software"]
fn the_whole_matrix_is_that_of_the_cpu() {
    let Some(mut bench) = Bench::new() else { return };
    let start = Instant::now();
    let wanted = |variable: &str, name: &str| {
        std::env::var(variable).map_or(true, |names| names.split(',').any(|wanted| wanted == name))
    };
    let is_wanted = |file: &&str| {
        wanted("NUAGE_VOLUMES", file.rsplit('/').next().unwrap_or(file).trim_end_matches(".vdb"))
    };
    let load = |files: &[&str]| -> Vec<Subject> {
        files.iter().copied().filter(is_wanted).flat_map(subjects).collect()
    };
    let others = other_files();
    let others: Vec<&str> = others.iter().map(String::as_str).collect();
    let (small, wide) = (load(&SMALL_FILES), load(&WIDE_FILES));
    let in_turn = [&others[..], &LARGE_FILES[..]].concat();
    let unlike = bench.named(&UNLIKE_FORMS);
    for form in 0..bench.forms.len() {
        if !wanted("NUAGE_FORMS", &bench.forms[form].name) {
            continue;
        }
        let step = if unlike.contains(&form) { 1 } else { 3 };
        let own = small.iter().skip(form % step).step_by(step);
        let is_wide = WIDE_FORMS.contains(&bench.forms[form].name.as_str());
        let others: Vec<&str> = in_turn.iter().skip(form).step_by(bench.forms.len()).copied().collect();
        let others = load(&others);
        let chosen: Vec<&Subject> = own.chain(wide.iter().filter(|_| is_wide)).chain(&others).collect();
        bench.hold(form, &chosen, &ALL_PARTS);
        println!(
            "{}: {} volumes, {:.0} s",
            bench.forms[form].name,
            chosen.len(),
            start.elapsed().as_secs_f32()
        );
        bench.matrix.print(&bench.forms[form].name);
    }
    bench.matrix.check();
}

/// One volume in all forms that differ, each fourth small or wide one in one of two, and one by all filters: what is made soonest.
#[test]
fn a_turn_through_the_matrix_is_that_of_the_cpu() {
    let Some(mut bench) = Bench::new() else { return };
    let files = SMALL_FILES.iter().chain(&WIDE_FILES);
    let all: Vec<Subject> = files.flat_map(|file| subjects(file)).collect();
    // The other widths of codes have tests of their own.
    for form in bench.named(&[
        "channel",
        "f32",
        "u5",
        "s3",
        "g4",
        "l2",
        "bc4z",
        "bc3y",
        "bc7x",
        "bc7y texture",
        "45 dB",
    ]) {
        bench.hold(form, &[&all[0]], &[Part::Density]);
    }
    for (i, form) in bench.named(&["f16", "u4"]).into_iter().enumerate() {
        let chosen: Vec<&Subject> = all.iter().skip(4 * i).step_by(8).collect();
        bench.hold(form, &chosen, &[[Part::Density, Part::Hits][i]]);
    }
    let below_zero: Vec<&Subject> =
        all.iter().filter(|subject| subject.name.contains("cross_zero")).collect();
    bench.hold(bench.named(&["f32"])[0], &below_zero, &[Part::Steps(Filter::Nearest)]);
    // Marching, by each filter once, and with exact shadows.
    bench.hold(bench.named(&["f16"])[0], &[&all[0]], &[Part::March(Lookup::Trilinear)]);
    let others = [Lookup::StochasticTrilinear, Lookup::StochasticTricubic].map(Part::March);
    bench.hold(bench.named(&["channel"])[0], &[&all[0]], &others);
    bench.hold(bench.named(&["channel"])[0], &[&all[0]], &[Part::Exact(Lookup::Tricubic)]);
    bench.matrix.print("");
    bench.matrix.check();
}

/// Paths look values up by functions of their own, at distances that chance decides.
#[test]
#[ignore = "takes a minute on a device in software"]
fn paths_through_packed_bricks_are_those_of_the_cpu() {
    let Some(bench) = Bench::new() else { return };
    let subjects = [subjects(SMALL_FILES[0]), subjects("data/edge/v12_sphere_half.vdb")].concat();
    for form in bench.named(&["u8", "u4", "bc4z", "bc7y texture", "45 dB"]) {
        for subject in [&subjects[0], &subjects[subjects.len() - 1]] {
            let pairs = pairs(&bench.gpu, subject, &bench.forms[form]);
            let shown = pairs.first().and_then(Pair::shown);
            shown.expect("something to be seen").compare_paths(&bench.gpu);
        }
    }
}
