//! The ray marcher: single scattering, deterministic.
//!
//! Along a camera ray, light from sun and sky that the medium scatters once, and light that it emits, are
//! summed up and weighed by the transmittance to the camera. Steps lie on a lattice of equal steps that is
//! shifted per pixel by a hash; each is a sample at its middle, with the light inside the step integrated
//! under the assumption that the step is homogeneous, so that no energy is lost whatever its length (Hillaire,
//! "Physically Based and Unified Volumetric Rendering in Frostbite", 2015). Homogeneous runs are integrated in
//! closed form.
//!
//! Shadow rays cost the most, and most steps scatter too little to deserve one. Steps are therefore lit in
//! groups that scatter about the same share of the light: the sun's transmittance is taken at the group's
//! centre of scattering, which leaves an error of second order in its length. The sky's rays stand for equal
//! shares too, in directions drawn from the phase function, so that their mean is right however few they are.
//!
//! What a shadow ray finds is biased where it takes steps: light that passes is the exponential of an optical depth that is off
//! by chance, the mean of which is more than the exponential of the mean. Without steps it is exact, and slower.
//!
//! Only scenes of one grid with a grey extinction, one sun without extent and an even sky are marched; [`unsupported`]
//! tells what else a scene has.
//!
//! What does not live here: pixels, threads, pictures ([`crate::picture`]).

use glam::Vec3;
use nuage_volume::accessor::Accessor;
use nuage_volume::channel::Channel;

use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::depth;
use crate::filter::{Filter, Lookup};
use crate::hash::{PLASTIC_STEPS, hash_u32, unit_f32};
use crate::light::{Light, Sky, Sun};
use crate::math::{exp, one_minus_exp_neg};
use crate::scene::{Phase, Scene, Shape, Spectrum, Volume};
use crate::traverse::{Field, LocalRay, Reader, Run, RunKind, Runs, floor};

/// A lit homogeneous run is cut after this optical depth, …
pub const LIT_PIECE_DEPTH: f32 = 0.25;
/// … or after this many voxels, whichever is shorter.
pub const LIT_PIECE_VOXELS: f32 = 8.0;
/// The most pieces of one run.
pub const MOST_PIECES: f32 = 65536.0;
/// A group of steps that share a ray to the sun is no longer than this, …
pub const GROUP_VOXELS: f32 = 8.0;
/// … unless it scatters less than this part of a full group; then …
pub const FAINT_GROUP: f32 = 0.1;
/// … this is its end.
pub const FAINT_GROUP_VOXELS: f32 = 32.0;

/// What tells the hash of the first ray to the sky, and of the directions of such rays, from others.
pub const SKY_SEEDS: [u32; 2] = [0x5bd1_e995, 0x2545_f491];

/// How finely a picture is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quality {
    /// The length of a step of a camera ray, in voxels.
    pub step_voxels: f32,
    /// The length of the first step of a shadow ray, in voxels of the level that it reads. If it is 0, shadow rays take no steps
    /// but integrate exactly, and in place of a cubic filter see trilinear interpolation, which has a closed form.
    pub shadow_step_voxels: f32,
    /// Each step of a shadow ray is longer than the one before by this part of the first: what is far from the
    /// lit point need not be known as well.
    pub shadow_growth: f32,
    /// A ray ends where less than this share of the light passes.
    pub min_transmittance: f32,
    /// Shadow rays towards the sun for a camera ray all of whose light is scattered; more where the medium is
    /// thin and long. Without bound: one per step.
    pub sun_rays: u32,
    /// Shadow rays towards the sky for such a camera ray.
    pub sky_rays: u32,
    /// Camera rays per pixel.
    pub samples: u32,
    /// How values between voxels are looked up. A stochastic form is only the filter in the mean where steps are short: what
    /// passes depends on values by an exponential.
    pub lookup: Lookup,
}

impl Default for Quality {
    fn default() -> Self {
        Quality {
            step_voxels: 0.5,
            shadow_step_voxels: 2.0,
            shadow_growth: 0.05,
            min_transmittance: 3e-4,
            sun_rays: 16,
            sky_rays: 8,
            samples: 1,
            lookup: Lookup::Trilinear,
        }
    }
}

/// The light that reaches the camera along a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Radiance {
    /// From the medium.
    pub scattered: Vec3,
    /// The share of the light behind the medium that passes.
    pub transmittance: f32,
}

/// What of a scene the marcher cannot follow, in words; `None` if it sees all of it.
pub fn unsupported(scene: &Scene<'_>) -> Option<&'static str> {
    let [volume] = scene.volumes.as_slice() else { return Some("more than one volume, or none") };
    let [red, green, blue] = volume.extinction;
    match (volume.shape, scene.lights.as_slice()) {
        (Shape::Box { .. } | Shape::Ball { .. }, _) => Some("a homogeneous box or ball"),
        _ if red != green || green != blue => Some("an extinction with a colour"),
        (_, [_, _, ..]) => Some("more than one light"),
        (_, [Light::Point { .. } | Light::Spot(_) | Light::Sphere { .. }]) => {
            Some("a light that is not a sun")
        }
        (_, [Light::Sun(sun)]) if sun.angle_degrees > 0.0 => Some("a sun with an extent"),
        _ if !matches!(scene.sky, Sky::Constant(_)) => Some("a sky that is not the same from everywhere"),
        _ => None,
    }
}

/// A scene made ready for marching.
pub struct Marcher<'s> {
    medium: Medium,
    quality: Quality,
    density: Option<Field<'s>>,
    /// What shadow rays meet, if it is not that.
    coarse: Option<Field<'s>>,
    emission: Option<(Field<'s>, &'s Spectrum)>,
    sun: Option<Sun>,
    sky: Option<Vec3>,
    /// The optical depth at which a shadow ray ends.
    max_shadow_depth: f32,
}

/// What the one volume is made of.
struct Medium {
    density_scale: f32,
    albedo: Vec3,
    phase: Phase,
}

/// What one thread needs to march.
pub struct Worker<'s> {
    density: Option<Reader<'s>>,
    shadow: Option<Reader<'s>>,
    emission: Option<Reader<'s>>,
}

/// The walker of a reader apart from what samples are read from.
fn split<'w, 's>(
    reader: Option<&'w mut Reader<'s>>,
) -> (Option<&'w mut Accessor<'s>>, Option<&'w mut Blocks<'s>>) {
    reader.map(|Reader { walker, blocks, .. }| (walker, blocks)).unzip()
}

/// The light on the medium along one camera ray.
struct Lighting<'m, 's> {
    marcher: &'m Marcher<'s>,
    /// What shadow rays meet.
    field: &'m Field<'s>,
    /// The camera ray, how far along it t = 0 is, in world lengths and in voxels, and the voxels per world length.
    ray: Ray,
    start: f64,
    voxels_to_start: f64,
    voxels_per_length: f32,
    /// The sun: its irradiance times albedo times phase function, and its direction.
    sun: Option<(Vec3, Vec3)>,
    group: Group,
    /// A group's longest extent in t, and a faint group's.
    group_lengths: [f32; 2],
    /// The sky's radiance times albedo.
    sky: Option<Vec3>,
    /// The share of scattered light at which the next ray goes to the sky.
    next_sky: f32,
    /// The share of scattered light so far.
    scattered: f32,
    sky_index: u32,
    random: u32,
}

/// Steps that are lit together: what they scatter of the camera's light, the same times t, and where they
/// begin.
#[derive(Debug, Clone, Copy, Default)]
struct Group {
    share: f32,
    moment: f32,
    start: f32,
}

impl<'s> Marcher<'s> {
    /// Makes a scene ready: its first volume that is a grid, in the light of its first sun and of a sky that is everywhere
    /// as it is straight above. See [`unsupported`].
    pub fn new(scene: &'s Scene<'s>, quality: Quality) -> Self {
        let volume = scene.volumes.iter().find(|volume| volume.shape.channel().is_some());
        let field = |channel: Option<&'s Channel>| quality.lookup.field(channel?);
        let emission = |volume: &'s Volume<'s>| {
            let emission = volume.emission.as_ref()?;
            Some((field(emission.channel.or(volume.shape.channel()))?, &emission.spectrum))
        };
        let sky = scene.sky.radiance(Vec3::Y);
        let medium = volume.map(|volume| Medium {
            density_scale: volume.extinction[0],
            albedo: Vec3::from_array(volume.albedo),
            phase: volume.phase,
        });
        let nothing =
            Medium { density_scale: 0.0, albedo: Vec3::ZERO, phase: Phase::HenyeyGreenstein { g: 0.0 } };
        let suns = scene.lights.iter().filter_map(|light| match light {
            Light::Sun(sun) => Some(*sun),
            _ => None,
        });
        Marcher {
            medium: medium.unwrap_or(nothing),
            quality,
            density: volume.and_then(|volume| field(volume.shape.channel())),
            coarse: volume.and_then(|volume| field(volume.coarse)),
            emission: volume.and_then(emission),
            sun: { suns }.next(),
            sky: (sky != Vec3::ZERO && quality.sky_rays > 0).then_some(sky),
            max_shadow_depth: -quality.min_transmittance.clamp(f32::MIN_POSITIVE, 1.0).ln(),
        }
    }

    /// What a thread needs to call the other functions.
    pub fn worker(&self) -> Worker<'s> {
        Worker {
            density: self.density.as_ref().map(Field::reader),
            shadow: self.coarse.as_ref().or(self.density.as_ref()).map(Field::reader),
            emission: self.emission.as_ref().map(|(field, _)| field.reader()),
        }
    }

    /// The light along a camera ray. `random` shifts the steps and turns the rays to the sky.
    pub fn radiance(&self, worker: &mut Worker<'s>, ray: &Ray, random: u32) -> Radiance {
        let mut result = Radiance { scattered: Vec3::ZERO, transmittance: 1.0 };
        let density = self.density.as_ref().and_then(|field| Some((field, field.interval(ray)?)));
        let emission = self.emission.as_ref().and_then(|(field, e)| Some((field, *e, field.interval(ray)?)));
        // Distances along the ray count from where it first meets the medium: precise from any camera.
        let starts = [density.as_ref().map(|d| d.1[0]), emission.as_ref().map(|e| e.2[0])];
        let Some(start) = starts.into_iter().flatten().reduce(f64::min) else { return result };
        let span = |interval: [f64; 2]| interval.map(|t| (t - start) as f32);

        let density = density.map(|(field, interval)| (field, field.local(ray, start), span(interval)));
        let emission = emission.map(|(field, e, i)| (field, e, field.local(ray, start), span(i)));
        let scale = self.medium.density_scale;
        let voxels_per_length = [
            density.as_ref().map_or(0.0, |(_, local, _)| local.direction.length()),
            emission.as_ref().map_or(0.0, |(_, _, local, _)| local.direction.length()),
        ];
        let voxels_per_length = voxels_per_length[0].max(voxels_per_length[1]);
        let step = f64::from(self.quality.step_voxels) / f64::from(voxels_per_length);
        let lattice = Lattice {
            step: step as f32,
            // Steps lie where they do whatever box the medium has.
            shift: (f64::from(unit_f32(hash_u32(random))) - start / step).rem_euclid(1.0) as f32,
            curvature: 0.0,
        };
        let mut lighting =
            density.as_ref().map(|(field, local, _)| Lighting::new(self, field, ray, start, local, random));

        let shadow = &mut worker.shadow;
        let (mut walker, mut blocks) = split(worker.density.as_mut());
        let (mut glow_walker, mut glow) = split(worker.emission.as_mut());
        let density_runs = density
            .as_ref()
            .zip(walker.as_mut())
            .map(|((field, local, [t0, t1]), walker)| field.runs(walker, *local, *t0, *t1));
        let emission_runs = emission
            .as_ref()
            .zip(glow_walker.as_mut())
            .map(|((field, _, local, [t0, t1]), walker)| field.runs(walker, *local, *t0, *t1));
        let lookup = self.quality.lookup;
        let lit = lighting.as_ref().is_some_and(Lighting::is_lit);
        for piece in Pieces::new(density_runs, emission_runs) {
            let density_kind = piece.kinds[0];
            let emission_kind = piece.kinds[1];
            let varying = density_kind == Some(RunKind::Varying) || emission_kind == Some(RunKind::Varying);
            let constant = |kind| match kind {
                Some(RunKind::Constant(value)) => value,
                _ => 0.0,
            };
            let mut step = |t0: f32, t1: f32| {
                let t = 0.5 * (t0 + t1);
                let value = match (density_kind, &density, blocks.as_mut()) {
                    (Some(RunKind::Varying), Some((field, local, _)), Some(blocks)) => {
                        field.look_up(blocks, local.at(t), lookup, || three(random ^ t.to_bits()))
                    }
                    (kind, ..) => constant(kind),
                };
                let emitted = match (emission_kind, &emission, glow.as_mut()) {
                    (None, ..) | (_, None, _) => Vec3::ZERO,
                    (Some(RunKind::Varying), Some((field, e, local, _)), Some(glow)) => {
                        e.radiance(field.look_up(glow, local.at(t), lookup.mean(), || [0.0; 3]))
                    }
                    (kind, Some((_, e, ..)), _) => e.radiance(constant(kind)),
                };
                let length = t1 - t0;
                let depth = (value * scale * length).min(f32::MAX);
                if depth <= 0.0 {
                    result.scattered += result.transmittance * length * emitted;
                    return true;
                }
                let absorbed = one_minus_exp_neg(depth);
                let share = result.transmittance * absorbed;
                if let (Some(lighting), Some(shadow)) = (&mut lighting, shadow.as_mut()) {
                    result.scattered += lighting.scattered(shadow, t0, t1, share);
                }
                // ∫ e^(−σt) dt over the step is absorbed / σ.
                result.scattered += result.transmittance * (length * (absorbed / depth)) * emitted;
                result.transmittance *= 1.0 - absorbed;
                result.transmittance > self.quality.min_transmittance
            };
            let goes_on = if varying {
                lattice.steps(piece.t0, piece.t1, &mut step)
            } else {
                let length = piece.t1 - piece.t0;
                let depth = constant(density_kind) * scale * length;
                let pieces = (depth / LIT_PIECE_DEPTH).max(length * voxels_per_length / LIT_PIECE_VOXELS);
                let pieces = if lit && depth > 0.0 { pieces.ceil().clamp(1.0, MOST_PIECES) } else { 1.0 };
                let at = |i: f32| if i < pieces { piece.t0 + length * (i / pieces) } else { piece.t1 };
                (0..pieces as u32).all(|i| step(at(i as f32), at(i as f32 + 1.0)))
            };
            if !goes_on {
                break;
            }
        }
        if let (Some(lighting), Some(shadow)) = (&mut lighting, shadow.as_mut()) {
            result.scattered += lighting.close_group(shadow);
        }
        result
    }

    /// The optical depth of a camera ray per unit of density scale.
    pub fn depth_per_scale(&self, worker: &mut Worker<'s>, ray: &Ray) -> f32 {
        let (Some(field), Some(reader)) = (&self.density, &mut worker.density) else { return 0.0 };
        let Some([start, end]) = field.interval(ray) else { return 0.0 };
        let local = field.local(ray, start);
        let lattice = Lattice::new(self.quality.step_voxels, &local, 0.5);
        let lookup = self.quality.lookup.mean();
        stepped_depth(field, reader, &local, (end - start) as f32, lattice, 1.0, f32::INFINITY, lookup)
    }
}

/// The optical depth of a ray from t = 0 to `end` by steps, given up once it passes `limit`.
#[expect(clippy::too_many_arguments, reason = "a ray, what it goes through, and how")]
fn stepped_depth<'s>(
    field: &Field<'s>,
    reader: &mut Reader<'s>,
    ray: &LocalRay,
    end: f32,
    lattice: Lattice,
    scale: f32,
    limit: f32,
    lookup: Lookup,
) -> f32 {
    let mut depth = 0.0;
    let Reader { walker, blocks, .. } = reader;
    let seed = hash_u32(lattice.shift.to_bits());
    for run in field.runs(walker, *ray, 0.0, end) {
        match run.kind {
            RunKind::Constant(value) => depth += value * scale * (run.t1 - run.t0),
            RunKind::Varying => {
                lattice.steps(run.t0, run.t1, &mut |t0, t1| {
                    let t = 0.5 * (t0 + t1);
                    let value = field.look_up(blocks, ray.at(t), lookup, || three(seed ^ t.to_bits()));
                    depth += value * scale * (t1 - t0);
                    depth <= limit
                });
            }
        }
        if depth > limit {
            break;
        }
    }
    depth
}

/// Three numbers from 0 to less than 1.
fn three(seed: u32) -> [f32; 3] {
    let seed = hash_u32(seed);
    [1, 2, 3].map(|i| unit_f32(hash_u32(seed.wrapping_add(i))))
}

impl<'m, 's> Lighting<'m, 's> {
    fn new(
        marcher: &'m Marcher<'s>,
        density: &'m Field<'s>,
        ray: &Ray,
        start: f64,
        local: &LocalRay,
        random: u32,
    ) -> Self {
        let Medium { albedo, phase, .. } = marcher.medium;
        let view = ray.direction.as_vec3();
        let sun = marcher.sun.as_ref().map(|sun| {
            // Light travels along −direction_to before and −view after it is scattered.
            let phase = phase.between(sun.direction_to, view);
            (Vec3::from_array(sun.irradiance) * albedo * phase, sun.direction_to)
        });
        let rays = marcher.quality.sky_rays.max(1) as f32;
        let voxels_per_length = local.direction.length();
        Lighting {
            marcher,
            field: marcher.coarse.as_ref().unwrap_or(density),
            ray: *ray,
            start,
            voxels_to_start: start * f64::from(voxels_per_length),
            voxels_per_length,
            sun: sun.filter(|(light, _)| *light != Vec3::ZERO),
            group: Group::default(),
            group_lengths: [GROUP_VOXELS / voxels_per_length, FAINT_GROUP_VOXELS / voxels_per_length],
            sky: marcher.sky.map(|sky| sky * albedo).filter(|light| *light != Vec3::ZERO),
            next_sky: unit_f32(hash_u32(random ^ SKY_SEEDS[0])) / rays,
            scattered: 0.0,
            sky_index: 0,
            random,
        }
    }

    fn is_lit(&self) -> bool {
        self.sun.is_some() || self.sky.is_some()
    }

    /// The light scattered towards the camera by a step that accounts for `share` of the camera's light, or by
    /// a group of steps that ends with it.
    #[inline]
    fn scattered(&mut self, shadow: &mut Reader<'s>, t0: f32, t1: f32, share: f32) -> Vec3 {
        let mut light = Vec3::ZERO;
        let Quality { sun_rays, sky_rays, .. } = self.marcher.quality;
        if self.sun.is_some() {
            let full = 1.0 / sun_rays as f32;
            // A group is full in the midst of a step: what changes little is divided nearly the same.
            let missing = (full - self.group.share) / share;
            let cut = if missing < 1.0 && share < full { t0 + missing * (t1 - t0) } else { t1 };
            for (begin, end) in [(t0, cut), (cut, t1)].into_iter().filter(|(begin, end)| begin < end) {
                if self.group.share == 0.0 {
                    self.group.start = begin;
                }
                let share = share * ((end - begin) / (t1 - t0));
                self.group.share += share;
                self.group.moment += share * 0.5 * (begin + end);
                let is_full = self.group.share >= full || end == cut && cut < t1;
                let is_faint = self.group.share < FAINT_GROUP * full;
                if is_full || end - self.group.start >= self.group_lengths[usize::from(is_faint)] {
                    light += self.close_group(shadow);
                }
            }
        }
        if let Some(radiance) = self.sky {
            let before = self.scattered;
            self.scattered += share;
            let rays = sky_rays as f32;
            while self.scattered > self.next_sky {
                let part = ((self.next_sky - before) / share).clamp(0.0, 1.0);
                self.next_sky += 1.0 / rays;
                let direction = self.sky_direction();
                light += radiance / rays * self.transmittance(shadow, t0 + part * (t1 - t0), direction);
            }
        }
        light
    }

    /// The sun's light that the steps since the last call scatter towards the camera.
    fn close_group(&mut self, shadow: &mut Reader<'s>) -> Vec3 {
        let Group { share, moment, .. } = std::mem::take(&mut self.group);
        match self.sun {
            Some((radiance, direction)) if share > 0.0 => {
                radiance * share * self.transmittance(shadow, moment / share, direction)
            }
            _ => Vec3::ZERO,
        }
    }

    /// The next direction towards the sky, drawn from the phase function.
    fn sky_direction(&mut self) -> Vec3 {
        // Started anew for each camera ray.
        let sequence =
            |start: u32, step: u32| unit_f32(start.wrapping_add(self.sky_index.wrapping_mul(step)));
        let start = hash_u32(self.random ^ SKY_SEEDS[1]);
        let u = [sequence(start, PLASTIC_STEPS[0]), sequence(hash_u32(start), PLASTIC_STEPS[1])];
        self.sky_index += 1;
        self.marcher.medium.phase.sample(self.ray.direction.as_vec3(), u).0
    }

    /// The share of the light from a direction that gets to a place on the camera ray.
    fn transmittance(&self, shadow: &mut Reader<'s>, t: f32, direction: Vec3) -> f32 {
        let scale = self.marcher.medium.density_scale;
        let Quality { shadow_step_voxels, shadow_growth, lookup, .. } = self.marcher.quality;
        let origin = self.ray.origin + self.ray.direction * (self.start + f64::from(t));
        let ray = Ray { origin, direction: direction.as_dvec3() };
        if shadow_step_voxels <= 0.0 {
            let filter = lookup.along_lines().unwrap_or(Filter::Trilinear);
            return exp(-(scale * depth::optical_depth(self.field, shadow, &ray, filter)).min(f32::MAX));
        }
        let ray = self.field.local(&ray, 0.0);
        // Where the ray begins scrambles the lattice, so that neighbouring steps do not share its error: by voxels, so that
        // what is nearly the same looks nearly the same.
        let voxel = (self.voxels_to_start + f64::from(t * self.voxels_per_length)).floor() as i64 as u32;
        let shift = unit_f32(hash_u32(self.random ^ hash_u32(voxel ^ self.sky_index << 24)));
        let lattice = Lattice::new(shadow_step_voxels, &ray, shift).growing(shadow_growth);
        let end = self.field.exit(&ray);
        let limit = self.marcher.max_shadow_depth;
        exp(-stepped_depth(self.field, shadow, &ray, end, lattice, scale, limit, lookup))
    }
}

/// Where steps end: at w((k + shift) × step) for all integers k, where w(u) = u + ½ curvature × u² lets steps
/// grow along the ray.
#[derive(Debug, Clone, Copy)]
struct Lattice {
    step: f32,
    shift: f32,
    /// Growth of the step per length.
    curvature: f32,
}

impl Lattice {
    /// Equal steps.
    fn new(step_voxels: f32, ray: &LocalRay, shift: f32) -> Self {
        Lattice { step: step_voxels / ray.direction.length(), shift, curvature: 0.0 }
    }

    /// Steps each of which is longer than the one before by `growth` times the first.
    fn growing(self, growth: f32) -> Self {
        Lattice { curvature: growth / self.step, ..self }
    }

    /// Calls `step(t0, t1)` for all steps between `start` and `end`, the first and last cut to them, until it
    /// returns false; returns whether it never did.
    #[inline]
    fn steps(self, start: f32, end: f32, step: &mut impl FnMut(f32, f32) -> bool) -> bool {
        // A million steps at most, which single precision can still count.
        let length = self.step.max(end * 1e-6);
        let uniform = if self.curvature > 0.0 {
            ((1.0 + 2.0 * self.curvature * start).sqrt() - 1.0) / self.curvature
        } else {
            start
        };
        let mut k = floor(uniform / length - self.shift);
        let mut t0 = start;
        while t0 < end {
            k += 1;
            let u = (k as f32 + self.shift) * length;
            let t1 = (u + 0.5 * self.curvature * u * u).min(end);
            // Where rounding makes a step empty it is passed over.
            if t1 > t0 {
                if !step(t0, t1) {
                    return false;
                }
                t0 = t1;
            }
        }
        true
    }
}

/// A stretch of a ray on which each channel is of one kind.
struct Piece {
    t0: f32,
    t1: f32,
    kinds: [Option<RunKind>; 2],
}

/// The runs of two channels along one ray, cut where either begins or ends.
struct Pieces<'r, 'a> {
    runs: [Option<Runs<'r, 'a>>; 2],
    heads: [Option<Run>; 2],
}

impl<'r, 'a> Pieces<'r, 'a> {
    fn new(first: Option<Runs<'r, 'a>>, second: Option<Runs<'r, 'a>>) -> Self {
        let mut runs = [first, second];
        let heads = runs.each_mut().map(|runs| runs.as_mut().and_then(Iterator::next));
        Pieces { runs, heads }
    }
}

impl Iterator for Pieces<'_, '_> {
    type Item = Piece;

    fn next(&mut self) -> Option<Piece> {
        let t0 = self.heads.iter().flatten().map(|run| run.t0).reduce(f32::min)?;
        // The piece ends where a run that covers its start ends, or where another begins.
        let cuts = self.heads.iter().flatten().map(|run| if run.t0 > t0 { run.t0 } else { run.t1 });
        let t1 = cuts.reduce(f32::min)?;
        let kinds = self.heads.map(|head| head.filter(|run| run.t0 <= t0).map(|run| run.kind));
        for (head, runs) in self.heads.iter_mut().zip(&mut self.runs) {
            if let Some(run) = head
                && run.t0 <= t0
            {
                run.t0 = t1;
                if run.t0 >= run.t1 {
                    *head = runs.as_mut().and_then(Iterator::next);
                }
            }
        }
        Some(Piece { t0, t1, kinds })
    }
}
