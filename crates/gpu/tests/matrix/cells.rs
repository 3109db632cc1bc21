//! The matrix of volumes, forms of bricks and filters, each cell of which is a picture of the GPU held to that of the CPU.

use std::collections::BTreeMap;
use std::time::Instant;

use glam::{DVec2, DVec3, IVec3};
use nuage_gpu::arrays::{Arrays, Bricks, Meaning, Wanted};
use nuage_gpu::device::Gpu;
use nuage_gpu::error::GpuError;
use nuage_gpu::look::{Look, Pass};
use nuage_gpu::renderer::Renderer;
use nuage_gpu::upload::Volume as GpuVolume;
use nuage_pipeline::import::{import, import_surface, is_level_set};
use nuage_pipeline::pack::options::{Bound, Options};
use nuage_pipeline::select::is_drawable;
use nuage_render::depth::stepped_transmittance;
use nuage_render::filter::{Filter, Lookup};
use nuage_render::framing::{WorldBox, fit_camera, fit_density_scale};
use nuage_render::light::Sun;
use nuage_render::march::Quality;
use nuage_render::path::PathSettings;
use nuage_render::scene::{Phase, Scene, Shape, Volume};
use nuage_render::surface::{SurfaceHit, VoxelHit, first_hit, first_voxel};
use nuage_render::traverse::Field;
use nuage_render::views::{View, render_view};
use nuage_vdb::Grid;
use nuage_volume::channel::Channel;
use nuage_volume::codec::Codec;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};

use crate::common::paths::compare_on;
use crate::common::{differences, is_same_hit, packed, unpacked_as};
use crate::reference::in_packed_tree;

/// What is looked at, by name.
#[derive(Clone)]
pub(crate) struct Subject {
    pub name: String,
    pub grid: Grid,
}

/// A form in which a device has bricks.
pub(crate) struct Form {
    pub name: String,
    /// How they are packed; `None` for a channel that never was.
    pub options: Option<Options>,
    pub bricks: Bricks,
}

/// All forms: every codec that an encoder can be told to use, what it chooses by itself, and floats that never were packed.
/// Blocks also as textures, in the form that the device takes them best, and one codec decoded at upload.
pub(crate) fn forms(textures: Bricks) -> Vec<Form> {
    let nothing = Options { max_error: None, psnr: None, ..Options::default() };
    let of = |name: &str, codec, bricks| Form {
        name: name.to_owned(),
        options: Some(Options { codec: Some(codec), ..nothing.clone() }),
        bricks,
    };
    let mut forms = vec![Form { name: "channel".to_owned(), options: None, bricks: Bricks::AsStored }];
    forms.push(of("f32", Codec::F32, Bricks::AsStored));
    forms.push(of("f16", Codec::F16, Bricks::AsStored));
    for bits in 1..=8 {
        forms.push(of(&format!("u{bits}"), Codec::Uniform { bits }, Bricks::AsStored));
    }
    for bits in 1..=8 {
        forms.push(of(&format!("s{bits}"), Codec::Split { bits }, Bricks::AsStored));
    }
    for bits in 0..=8 {
        forms.push(of(&format!("g{bits}"), Codec::Gradient { bits }, Bricks::AsStored));
    }
    for bits in 0..=5 {
        forms.push(of(&format!("l{bits}"), Codec::Lattice { bits }, Bricks::AsStored));
    }
    for (format, name) in [(BlockFormat::Bc4, "bc4"), (BlockFormat::Bc3, "bc3"), (BlockFormat::Bc7, "bc7")] {
        for (axis, letter) in [(PackingAxis::X, 'x'), (PackingAxis::Y, 'y'), (PackingAxis::Z, 'z')] {
            let codec = Codec::Block { format, axis };
            forms.push(of(&format!("{name}{letter}"), codec, Bricks::AsStored));
            forms.push(of(&format!("{name}{letter} texture"), codec, textures));
        }
    }
    forms.push(of("u4 decoded", Codec::Uniform { bits: 4 }, Bricks::Decoded));
    let mut mixture = |name: &str, options| {
        forms.push(Form { name: name.to_owned(), options: Some(options), bricks: Bricks::AsStored });
    };
    mixture("45 dB", Options::default());
    mixture("35 dB with shapes", Options { psnr: Some(35.0), shapes: 16, ..Options::default() });
    mixture("error of 2 %", Options { max_error: Some(Bound::OfPeak(0.02)), ..nothing.clone() });
    forms
}

/// The drawable grids of a file below the data.
pub(crate) fn subjects(relative: &str) -> Vec<Subject> {
    let Some(path) = nuage_testkit::find(relative) else { return Vec::new() };
    let file = nuage_vdb::File::open(std::fs::read(path).expect("readable")).expect("a VDB file");
    let name = relative.rsplit('/').next().unwrap_or(relative).trim_end_matches(".vdb");
    (0..file.grids.len())
        .filter(|i| is_drawable(&file.grids[*i]))
        .map(|i| Subject {
            name: format!("{name} {}", file.grids[i].unique_name),
            grid: file.read_grid(i).expect("an intact grid"),
        })
        // Other transforms are refused.
        .filter(|subject| subject.grid.transform.matrix().is_some())
        .collect()
}

/// What a comparison found.
#[derive(Default, Clone)]
pub(crate) struct Tally {
    pub pictures: u32,
    pub pixels: u64,
    pub good: u64,
    pub sum: f64,
    pub worst: f64,
    pub worst_at: String,
    pub seen: u64,
    pub failed: Vec<String>,
    pub left_out: Vec<String>,
    pub is_of_hits: bool,
    /// What the device and the CPU took.
    pub seconds: [f64; 2],
}

/// Comparisons by form and by what is shown.
#[derive(Default)]
pub(crate) struct Matrix {
    pub tallies: BTreeMap<(String, String), Tally>,
}

/// Of a picture so many pixels may be off, and so much in the mean: at the faces of nearest voxels rounding decides, and a
/// picture is small. All pictures of a form together are held to what the renderer promises.
const MOST_BAD: usize = 4;
const MOST_MEAN: f64 = 5e-4;
/// What colours may differ by.
const TOLERANCE: f64 = 1.0 / 255.0;
const PIXELS: usize = (SMALL[0] * SMALL[1]) as usize;
/// Pictures of the matrix are small.
pub(crate) const SMALL: [u32; 2] = [48, 32];

impl Matrix {
    fn tally(&mut self, form: &str, pass: &str) -> &mut Tally {
        self.tallies.entry((form.to_owned(), pass.to_owned())).or_default()
    }

    /// Counts a picture of so many pixels, those that are good, and those that show something.
    fn count(&mut self, form: &str, pass: &str, [pixels, good, seen]: [usize; 3]) -> &mut Tally {
        let tally = self.tally(form, pass);
        tally.pictures += 1;
        tally.pixels += pixels as u64;
        tally.good += good as u64;
        tally.seen += seen as u64;
        tally
    }

    /// Notes per-pixel errors. A few may be worse than `tolerance`.
    fn note(&mut self, form: &str, pass: &str, at: &str, errors: &[f64], seen: usize, tolerance: f64) {
        let good = errors.iter().filter(|error| **error <= tolerance).count();
        let sum: f64 = errors.iter().map(|error| error.min(1.0)).sum();
        let worst = errors.iter().copied().fold(0.0, f64::max);
        let tally = self.count(form, pass, [errors.len(), good, seen]);
        tally.sum += sum;
        if worst > tally.worst {
            (tally.worst, tally.worst_at) = (worst, at.to_owned());
        }
        let bad = errors.len() - good;
        let mean = sum / errors.len() as f64;
        if bad > MOST_BAD || mean >= MOST_MEAN {
            tally.failed.push(format!("{at}: {bad} pixels off, mean {mean:.1e}, worst {worst:.1e}"));
        }
    }

    /// Colours may differ by 1/255.
    fn colours(&mut self, form: &str, pass: &str, at: &str, ours: &[[f32; 4]], reference: &[[f32; 4]]) {
        let errors = differences(ours, reference);
        let seen = reference.iter().filter(|pixel| pixel[3] > 0.0).count();
        self.note(form, pass, at, &errors, seen, TOLERANCE);
    }

    fn left_out(&mut self, form: &str, pass: &str, at: &str, why: &str) {
        self.tally(form, pass).left_out.push(format!("{at}: {why}"));
    }

    /// Holds all pictures of each form and pass, and of each pass in all forms.
    pub(crate) fn check(&self) {
        let mut failed: Vec<String> = Vec::new();
        for ((form, pass), tally) in &self.tallies {
            failed.extend(tally.failed.iter().map(|what| format!("{form}, {pass}, {what}")));
            let share = tally.good as f64 / tally.pixels.max(1) as f64;
            let least = if tally.is_of_hits { 0.995 } else { 0.999 };
            let mean = tally.sum / tally.pixels.max(1) as f64;
            if tally.pixels > 0 && (share < least || mean >= 1e-4) && tally.pictures > 1 {
                failed.push(format!("{form}, {pass}: {share} of the pixels are good, mean error {mean}"));
            }
        }
        assert!(failed.is_empty(), "{}", failed.join("\n"));
        let seen: u64 = self.tallies.values().map(|tally| tally.seen).sum();
        assert!(seen > 0, "nothing is seen");
    }

    /// Prints a line for each pass of a form, or of all.
    pub(crate) fn print(&self, of_form: &str) {
        let mine = || self.tallies.iter().filter(|((form, _), _)| of_form.is_empty() || form == of_form);
        for ((form, pass), t) in mine() {
            println!(
                "{form:18} {pass:24} {:4} pictures, {:9} pixels, {:8} seen, {:8.4} % good, mean {:.1e}, worst {:.1e} ({}), {:.1} s and {:.1} s",
                t.pictures,
                t.pixels,
                t.seen,
                100.0 * t.good as f64 / t.pixels as f64,
                t.sum / t.pixels as f64,
                t.worst,
                t.worst_at,
                t.seconds[0],
                t.seconds[1]
            );
        }
        for ((form, pass), t) in mine() {
            t.failed.iter().for_each(|failed| println!("FAILED {form}, {pass}, {failed}"));
            t.left_out.iter().for_each(|at| println!("LEFT OUT {form}, {pass}, {at}"));
        }
    }
}

/// What of a volume is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Part {
    Density,
    Depth,
    Index,
    FirstDensity,
    Hits,
    Steps(Filter),
    Surface,
    SurfaceHits,
    March(Lookup),
    Exact(Lookup),
}

pub(crate) const ALL_PARTS: [Part; 16] = [
    Part::Density,
    Part::Depth,
    Part::Index,
    Part::FirstDensity,
    Part::Hits,
    Part::Steps(Filter::Nearest),
    Part::Steps(Filter::Trilinear),
    Part::Surface,
    Part::SurfaceHits,
    Part::March(Lookup::Nearest),
    Part::March(Lookup::Trilinear),
    Part::March(Lookup::Tricubic),
    Part::March(Lookup::StochasticTrilinear),
    Part::March(Lookup::StochasticTricubic),
    Part::Exact(Lookup::Nearest),
    Part::Exact(Lookup::Trilinear),
];

/// A volume on both sides, in a form.
pub(crate) struct Pair {
    subject: String,
    form: String,
    channel: Channel,
    /// What is added to the channel's indices for those of the grid.
    index_offset: IVec3,
    volume: GpuVolume,
    /// The level of its surface, if it is to be shown as one.
    level: Option<f32>,
}

/// A pair as it is looked at: what all its pictures share, made once.
pub(crate) struct Shown<'p> {
    pair: &'p Pair,
    scene: Scene<'p>,
    look: Look,
    field: Field<'p>,
}

impl Pair {
    /// What pictures of it share; `None` if there is nothing to be seen.
    pub(crate) fn shown(&self) -> Option<Shown<'_>> {
        let scene = scene_of(&self.channel)?;
        let look = Look::of_scene(&scene).expect("a look");
        Some(Shown { pair: self, look, field: Field::new(&self.channel)?, scene })
    }
}

impl Shown<'_> {
    /// Holds paths through the volume to those of the CPU.
    pub(crate) fn compare_paths(&self, gpu: &Gpu) {
        let name = format!("{}, {}", self.pair.form, self.pair.subject);
        compare_on(&name, gpu, &self.pair.volume, &self.scene, PathSettings::default());
    }
}

/// A volume in a form; as a surface too, if it is a level set.
pub(crate) fn pairs(gpu: &Gpu, subject: &Subject, form: &Form) -> Vec<Pair> {
    let fog = pair(gpu, subject, form, false);
    let surface = is_level_set(&subject.grid).then(|| pair(gpu, subject, form, true));
    fog.into_iter().chain(surface.flatten()).collect()
}

fn pair(gpu: &Gpu, subject: &Subject, form: &Form, is_surface: bool) -> Option<Pair> {
    let channel_of = |grid: Grid| match is_surface {
        true => import_surface(grid).expect("a linear transform").0,
        false => import(grid).expect("a linear transform").0,
    };
    let level = is_surface.then(|| import_surface(subject.grid.clone()).expect("a linear transform").1);
    let report = import(subject.grid.clone()).expect("a linear transform").1;
    let made = |channel, index_offset, arrays: &Arrays| {
        let volume = GpuVolume::new(gpu, arrays).expect("a volume");
        Pair { subject: subject.name.clone(), form: form.name.clone(), channel, index_offset, volume, level }
    };
    let Some(options) = &form.options else {
        let channel = channel_of(subject.grid.clone());
        let arrays = Arrays::of_channels(&[&channel]).expect("arrays");
        return Some(made(channel, IVec3::ZERO, &arrays));
    };
    let mut grid = subject.grid.clone();
    let band = report.level_set_band;
    grid.name = "shown".to_owned();
    let asset = packed(&[vec![grid]], options);
    let channel = unpacked_as(&asset, 0, "shown", channel_of)?;
    let meaning = match (band, is_surface) {
        (None, _) => Meaning::Density,
        (Some(band), false) => Meaning::Fog { band },
        (Some(band), true) => Meaning::Surface { band },
    };
    let wanted = [Wanted { name: "shown".to_owned(), meaning }];
    let arrays = match Arrays::of_asset(&asset, &wanted, 0..1, form.bricks) {
        // Refused, since shaders take it that nothing is where nothing stands.
        Err(GpuError::Unsupported { feature }) if feature.contains("not empty") => return None,
        arrays => arrays.expect("arrays"),
    };
    let (channel, index_offset) = in_packed_tree(&asset, &channel, meaning).unwrap_or((channel, IVec3::ZERO));
    Some(made(channel, index_offset, &arrays))
}

/// A volume in the light of a sun and an even sky, seen whole.
fn scene_of(channel: &Channel) -> Option<Scene<'_>> {
    let aspect = f64::from(SMALL[0]) / f64::from(SMALL[1]);
    let world_box = WorldBox::of(channel)?;
    let mut camera = fit_camera(world_box, DVec3::new(0.5, 0.35, 1.0), DVec3::Y, 35.0, aspect)?;
    camera.half_width_tangent *= 0.75;
    let extinction = fit_density_scale(channel, &camera, aspect).unwrap_or(1.0);
    let volume = Volume {
        albedo: [0.95, 0.9, 0.8],
        phase: Phase::HenyeyGreenstein { g: 0.4 },
        ..Volume::absorbing(Shape::Grid(channel), extinction)
    };
    let sun = Sun::point(glam::Vec3::new(0.48, 0.8, -0.36), [3.0, 2.8, 2.5]);
    Some(Scene::of_one(camera, volume, Some(sun), [0.2, 0.3, 0.5]))
}

/// Holds what a part shows of a volume to what the CPU does.
pub(crate) fn hold(matrix: &mut Matrix, renderer: &mut Renderer, shown: &Shown<'_>, part: Part) {
    let Shown { pair, scene, look, field } = shown;
    let Pair { subject: at, form, channel, index_offset, volume, level } = pair;
    let is_of_surface = matches!(part, Part::Surface | Part::SurfaceHits);
    if is_of_surface != level.is_some() {
        return;
    }
    let name = format!("{part:?}");
    let extinction = scene.volumes[0].extinction[0];
    let level = level.unwrap_or(0.0);
    let few =
        Quality { step_voxels: 1.5, shadow_step_voxels: 4.0, sun_rays: 6, sky_rays: 2, ..Quality::default() };
    let quality_by = |lookup: Lookup| match lookup {
        // A step through a whole layer of voxels has its middle on the border of two, where rounding decides which is nearest:
        // no step is so long.
        Lookup::Nearest => {
            Quality { step_voxels: 0.7, shadow_step_voxels: 0.9, shadow_growth: 0.0, lookup, ..few }
        }
        lookup => Quality { lookup, ..few },
    };
    let pass = match part {
        Part::Density => Pass::View(View::Density { extinction }),
        Part::Depth => Pass::View(View::Depth),
        Part::Index => Pass::View(View::Index),
        Part::FirstDensity => Pass::View(View::FirstDensity),
        Part::Hits => Pass::Hits { above: 0.0 },
        Part::Steps(filter) => Pass::Opacity { filter, step_voxels: 0.5 },
        Part::Surface => Pass::View(View::Surface { level }),
        Part::SurfaceHits => Pass::SurfaceHits { level },
        Part::March(lookup) if lookup.mean() == lookup => Pass::March(quality_by(lookup)),
        Part::March(lookup) => Pass::March(Quality { lookup, samples: 4, ..few }),
        Part::Exact(lookup) => {
            let by = quality_by(lookup);
            Pass::March(Quality { shadow_step_voxels: 0.0, sun_rays: 3, sky_rays: 0, ..by })
        }
    };
    let start = Instant::now();
    renderer.prepare(volume, look, &pass, 0, None).expect("a pass");
    renderer.run(volume).expect("a run");
    let ours = match renderer.pixels() {
        Ok(pixels) => pixels,
        Err(error) if error.to_string().contains("leaves loops") => {
            return matrix.left_out(form, &name, at, "the driver leaves loops");
        }
        Err(error) => panic!("{error}"),
    };
    let on_device = start.elapsed();
    let rays = (0..PIXELS as u32).map(|i| {
        let pixel = DVec2::new(f64::from(i % SMALL[0]), f64::from(i / SMALL[0])) + 0.5;
        scene.camera.ray(pixel, SMALL[0], SMALL[1])
    });
    let mut reader = field.reader();
    let count = |pixels: &[[f32; 4]]| pixels.iter().filter(|pixel| pixel[3] > 0.0).count();
    match pass {
        Pass::View(view) => {
            let theirs =
                render_view(field, view, &scene.camera, SMALL, &|_, _| ()).expect("a picture").pixels;
            match part {
                Part::Density | Part::Surface => matrix.colours(form, &name, at, &ours, &theirs),
                _ => matrix.hits(form, &name, at, &differences(&ours, &theirs), count(&theirs)),
            }
        }
        Pass::Opacity { filter, step_voxels } => {
            let theirs: Vec<[f32; 4]> = rays
                .map(|ray| {
                    let passes =
                        stepped_transmittance(field, &mut reader, &ray, filter, step_voxels, extinction);
                    [1.0 - passes; 4]
                })
                .collect();
            matrix.colours(form, &name, at, &ours, &theirs);
        }
        Pass::Hits { above } => {
            let in_grid = |hit: VoxelHit| VoxelHit { voxel: hit.voxel + *index_offset, ..hit };
            let expected: Vec<_> =
                rays.map(|ray| first_voxel(field, &mut reader, &ray, above).map(in_grid)).collect();
            let errors: Vec<f64> = ours
                .iter()
                .zip(&expected)
                .map(|(hit, expected)| f64::from(u8::from(!is_same_hit(hit, expected.as_ref()))))
                .collect();
            matrix.hits(form, &name, at, &errors, expected.iter().flatten().count());
        }
        Pass::SurfaceHits { level } => {
            let expected: Vec<_> = rays.map(|ray| first_hit(field, &mut reader, &ray, level)).collect();
            let voxel = channel.world_from_index.matrix3.x_axis.length();
            let is_same = |(hit, expected): (&[f32; 4], &Option<SurfaceHit>)| {
                expected.map_or(hit[0] < 0.0, |expected| {
                    (f64::from(hit[0]) - expected.distance).abs() < 0.01 * voxel
                })
            };
            let errors: Vec<f64> =
                ours.iter().zip(&expected).map(|pair| f64::from(u8::from(!is_same(pair)))).collect();
            matrix.hits(form, &name, at, &errors, expected.iter().flatten().count());
        }
        Pass::March(quality) => {
            let picture = nuage_render::picture::render(scene, quality, SMALL[0], SMALL[1], &|_, _| ());
            let theirs = picture.expect("a picture").pixels;
            match quality.samples {
                1 => matrix.colours(form, &name, at, &ours, &theirs),
                _ => matrix.deviation(form, &name, at, standard_errors(&ours, &theirs), count(&theirs)),
            }
        }
        _ => {}
    }
    let tally = matrix.tally(form, &name);
    tally.seconds[0] += on_device.as_secs_f64();
    tally.seconds[1] += (start.elapsed() - on_device).as_secs_f64();
}

/// By how many standard errors the means of two pictures differ at most. Which voxel is chosen hangs on the last bits of distances,
/// so that pixels are off by chance: how much so they tell themselves.
fn standard_errors(ours: &[[f32; 4]], theirs: &[[f32; 4]]) -> f64 {
    let of_channel = |channel: usize| {
        let off: Vec<f64> =
            ours.iter().zip(theirs).map(|(a, b)| f64::from(a[channel] - b[channel])).collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        let variance = off.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / off.len() as f64;
        mean.abs() / (variance / off.len() as f64).sqrt().max(1e-5)
    };
    (0..4).map(of_channel).fold(0.0, f64::max)
}

impl Matrix {
    /// Means may be off by some standard errors: of thousands, one by four and a half.
    fn deviation(&mut self, form: &str, pass: &str, at: &str, errors: f64, seen: usize) {
        let tally = self.count(form, pass, [1, usize::from(errors < 4.5), seen]);
        if errors > tally.worst {
            (tally.worst, tally.worst_at) = (errors, at.to_owned());
        }
        if errors >= 4.5 {
            tally.failed.push(format!("{at}: {errors:.1} standard errors"));
        }
    }

    /// Of first hits five pixels in a thousand may differ.
    fn hits(&mut self, form: &str, pass: &str, at: &str, errors: &[f64], seen: usize) {
        let bad = errors.iter().filter(|error| **error > 1.0 / 255.0).count();
        let tally = self.count(form, pass, [errors.len(), errors.len() - bad, seen]);
        tally.is_of_hits = true;
        if bad as f64 > 0.005 * errors.len() as f64 {
            tally.failed.push(format!("{at}: {bad} of {} pixels meet something else", errors.len()));
        }
    }
}
