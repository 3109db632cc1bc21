//! The path tracer: light scattered any number of times, without bias.
//!
//! Where a path collides is found by delta tracking: tentative collisions at the rate of a majorant, each real with the
//! chance of the extinction there over it (Woodcock et al., "Techniques used in the GEM code", 1965). Majorants are those of
//! the tree's own regions, so that empty space costs nothing and thin parts little. Several volumes have tentative
//! collisions of their own, and the nearest counts: where volumes overlap, this is a collision with the sum of their
//! extinctions. Where extinction has a colour, the majorant is that of the strongest colour, and the choice between real
//! and not is made for all colours at once: with the chance that it has for a path of one colour chosen at random, given the
//! path so far. Each colour then weighs by its share of that chance, which is the balance heuristic over the colours (Wilkie
//! et al., "Hero Wavelength Spectral Sampling", 2014; Miller et al., "A null-scattering path integral formulation of light
//! transport", 2019); no weight can exceed 3.
//!
//! At each collision the light of each light, and of a sky that is a picture, is taken with a transmittance by residual ratio
//! tracking (Novák et al., "Residual Ratio Tracking for Estimating Attenuation in Participating Media", 2014). Of a light with
//! extent, a direction is taken evenly from what is seen of it, or, where the phase function is narrower than the light, from
//! either with even chances, weighed by the balance heuristic; of a sky that is a picture always from either (Veach, "Robust
//! Monte Carlo Methods for Light Transport Simulation", 1997). Other skies are seen by paths that leave the media: with most of
//! their weight left, whatever way they went, which is quieter than a sum over collisions. Paths end by Russian roulette.
//!
//! Two control variates make suns cheap and quiet where all media are grey. Most collisions take the sun's transmittance from
//! a lattice (`shade`), and the few that follow a ray, an exact one, count with what they find beside it for the
//! others. And of what a direction of scattering makes more likely to be found by the next collisions, the expected part is
//! taken off, whose mean is 0 (`expected_later`).
//!
//! The first few scatterings of a path take numbers that are spread evenly over the paths of a pixel ([`sampler`](crate::sampler)):
//! which way it goes, whether a shadow ray looks, how far it goes next. All others are random.
//!
//! Where volumes have a coarser level, shadow rays and rays of scattered light read that, with its own majorants.
//!
//! What does not live here: pixels, threads, pictures ([`crate::picture`]).

use glam::{DVec3, Vec3};
use nuage_volume::accessor::Accessor;

use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::depth::optical_depth;
use crate::envmap::EnvironmentMap;
use crate::filter::{Filter, Lookup};
use crate::light::{Arriving, Light, Sky, Sun};
use crate::math::{exp, ln};
use crate::phase::MAX_ASYMMETRY;
use crate::sampler::Sampler;
use crate::scene::{Phase, Scene, Shape, Spectrum, Volume};
use crate::shade::{Caster, Shade, Shaded};
use crate::solid::Solid;
use crate::track::first_collision;
use crate::traverse::{Field, LocalRay, Reader, Runs, Segment};

/// How paths are made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathSettings {
    /// How often light may scatter before it reaches the camera; as often as it does if `None`.
    pub max_scatterings: Option<u32>,
    /// Whether each collision looks with a ray of its own for a sky that is a picture. Else only paths that leave the medium
    /// see it, as they do skies of other kinds. The other lights can be seen in no other way.
    pub sky_rays: bool,
    /// How values between voxels are looked up.
    pub lookup: Lookup,
}

impl Default for PathSettings {
    fn default() -> Self {
        PathSettings { max_scatterings: None, sky_rays: true, lookup: Lookup::Trilinear }
    }
}

/// A path whose weight is less than this goes on with a chance of its weight over it.
pub const ROULETTE_WEIGHT: f32 = 0.25;

/// A shadow ray through which less passes goes on with a chance of that over it.
pub const ROULETTE_TRANSMITTANCE: f32 = 0.1;

/// Of collisions that are in the shade of a sun, so many follow a shadow ray at least. What one finds that the shade did not
/// know of counts for as many as there are to each of them, so fewer would make bright specks.
const LEAST_SHADOW_RAYS: f32 = 0.04;

/// How much more follow one where the shade is uncertain, for a path of weight 1 and a phase function of 1: where it changes
/// from node to node, and where half of the light passes. Fewer save little time, for by far the most of it goes to collisions.
const SHADE_EDGES: f32 = 4.0;
const SHADE_HALVES: f32 = 0.5;

/// Of the light of a sun that scatters once more and then again and again, what counts in [`expected_later`]: by trial.
const LATER_LOBES: [f32; 3] = [1.2, 0.72, 0.43];

/// An extinction per world length through which nothing passes.
pub const OPAQUE: f32 = 1e30;

/// A scene made ready for paths.
pub struct PathTracer<'s> {
    scene: &'s Scene<'s>,
    settings: PathSettings,
    media: Vec<Medium<'s>>,
    /// What rays of scattered light meet, if that is not the same: some are coarser levels.
    far: Option<Vec<Medium<'s>>>,
    glows: Vec<Glow<'s>>,
    /// Of each light that is a sun, if all media are grey.
    shades: Vec<Option<Shade>>,
}

/// A volume made ready for paths.
struct Medium<'s> {
    region: Region<'s>,
    /// Extinction per density and world length of the strongest colour.
    scale: f32,
    /// The extinction of each colour as a share of that.
    shares: Vec3,
    is_grey: bool,
    albedo: Vec3,
    phase: Phase,
}

/// What glows, made ready for paths.
struct Glow<'s> {
    region: Region<'s>,
    spectrum: &'s Spectrum,
}

/// Where something is.
enum Region<'s> {
    Field(Box<Field<'s>>),
    Solid(Solid),
}

impl<'s> Region<'s> {
    /// `None` if it is nowhere.
    fn new(shape: Shape<'s>, lookup: Lookup) -> Option<Self> {
        match shape {
            Shape::Grid(channel) => Some(Region::Field(Box::new(lookup.field(channel)?))),
            shape => Solid::new(shape).map(Region::Solid),
        }
    }

    fn reader(&self) -> Option<Reader<'s>> {
        match self {
            Region::Field(field) => Some(field.reader()),
            Region::Solid(_) => None,
        }
    }
}

/// What one thread needs to trace paths.
pub struct PathWorker<'s> {
    /// Of each medium and each glow: solids need none.
    media: Vec<Option<Reader<'s>>>,
    far: Vec<Option<Reader<'s>>>,
    glows: Vec<Option<Reader<'s>>>,
}

/// What one path brings. Means over many paths are what the ray sees.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PathSample {
    /// Light that the medium gives off towards the camera.
    pub emission: Vec3,
    /// Light of lights that scattered once.
    pub direct: Vec3,
    /// Light that scattered more often, or was given off by the medium and scattered.
    pub indirect: Vec3,
    /// Whether the ray passed the medium.
    pub passed: bool,
    /// The distance of the first collision, in world lengths; 0 if the ray passed.
    pub depth: f32,
    /// The albedo there; 0 if the ray passed.
    pub albedo: Vec3,
}

impl PathSample {
    /// All light that comes along the ray.
    pub fn light(&self) -> Vec3 {
        self.emission + self.direct + self.indirect
    }
}

/// An optical depth at which a ray collides, by a number from 0 to less than 1.
fn depth_of(number: f32) -> f32 {
    // Never infinite: the number is less than 1 by 2⁻²⁴ or more.
    -ln(1.0 - number)
}

/// Where a path collides.
struct Collision<'t, 's> {
    /// The distance along the ray.
    distance: f64,
    /// With which of the media.
    medium: &'t Medium<'s>,
}

/// Where light is scattered.
struct Scattering {
    at: DVec3,
    /// The direction before.
    before: Vec3,
    phase: Phase,
    /// What the path is worth there.
    worth: f32,
}

/// What a path is worth on its way.
struct Carried {
    /// What light is multiplied by.
    weight: Vec3,
    /// The share of each colour in the chance of the path, times three: all 1 in a grey medium.
    colours: Vec3,
}

impl Carried {
    fn worth(&self) -> Vec3 {
        self.weight * self.colours
    }

    /// Takes one of two turns, `part` for a colour being its chance there. Gives whether it is that one.
    fn turns(&mut self, part: Vec3, numbers: &mut Sampler) -> bool {
        let taken = self.colours * part;
        let chance = taken.element_sum() / 3.0;
        let (is_taken, left, chance) = match numbers.random() < chance {
            true => (true, taken, chance),
            false => (false, self.colours - taken, 1.0 - chance),
        };
        // A turn without chance is not taken, but for rounding.
        if chance > 0.0 {
            self.colours = left.max(Vec3::ZERO) / chance;
        }
        is_taken
    }
}

impl<'s> PathTracer<'s> {
    /// Makes a scene ready.
    pub fn new(scene: &'s Scene<'s>, settings: PathSettings) -> Self {
        let lookup = settings.lookup;
        let medium = |volume: &'s Volume<'s>, shape: Shape<'s>| {
            let extinction = Vec3::from_array(volume.extinction);
            let scale = extinction.max_element();
            let region = Region::new(shape, lookup).filter(|_| scale > 0.0)?;
            let is_grey = extinction == Vec3::splat(scale);
            let shares = if is_grey { Vec3::ONE } else { extinction / scale };
            let albedo = Vec3::from_array(volume.albedo);
            Some(Medium { region, scale, shares, is_grey, albedo, phase: volume.phase })
        };
        let glow = |volume: &'s Volume<'s>| {
            let emission = volume.emission.as_ref()?;
            let region = Region::new(emission.channel.map_or(volume.shape, Shape::Grid), lookup)?;
            Some(Glow { region, spectrum: &emission.spectrum })
        };
        let media: Vec<_> = scene.volumes.iter().filter_map(|volume| medium(volume, volume.shape)).collect();
        let far = scene.volumes.iter().any(|volume| volume.coarse.is_some()).then(|| {
            let coarse =
                |volume: &'s Volume<'s>| medium(volume, volume.coarse.map_or(volume.shape, Shape::Grid));
            scene.volumes.iter().filter_map(coarse).collect::<Vec<_>>()
        });
        let glows = scene.volumes.iter().filter_map(glow).collect();
        let shades = scene.lights.iter().map(|light| shade(light, far.as_ref().unwrap_or(&media))).collect();
        PathTracer { scene, settings, media, far, glows, shades }
    }

    /// What a thread needs.
    pub fn worker(&self) -> PathWorker<'s> {
        let readers = |media: &[Medium<'s>]| media.iter().map(|medium| medium.region.reader()).collect();
        PathWorker {
            media: readers(&self.media),
            far: self.far.as_deref().map_or(Vec::new(), readers),
            glows: self.glows.iter().map(|glow| glow.region.reader()).collect(),
        }
    }

    /// What one path says of the light along a ray, by numbers of its own. Whoever chose the ray by some of them took those of
    /// the first set.
    pub fn sample(&self, worker: &mut PathWorker<'s>, ray: &Ray, mut numbers: Sampler) -> PathSample {
        let Scene { lights, sky, .. } = self.scene;
        // A sky without sharp lights is best met by chance: a path that leaves the medium sees it with its whole weight.
        let sky_map = match sky {
            Sky::Map(map) if self.settings.sky_rays && !map.is_black() => Some(map.as_ref()),
            _ => None,
        };
        let mut carried = Carried { weight: Vec3::ONE, colours: Vec3::ONE };
        let mut sample = PathSample::default();
        let mut ray = *ray;
        let mut scatterings = 0;
        loop {
            let emitted = if scatterings == 0 { &mut sample.emission } else { &mut sample.indirect };
            let is_far = scatterings > 0 && self.far.is_some();
            let collision = self.fly(worker, is_far, &ray, &mut carried, emitted, &mut numbers);
            let Some(Collision { distance, medium }) = collision else {
                match scatterings {
                    0 => sample.passed = true,
                    _ if sky_map.is_some() => {}
                    _ => {
                        let light = carried.worth() * sky.radiance(ray.direction.as_vec3());
                        *(if scatterings == 1 { &mut sample.direct } else { &mut sample.indirect }) += light;
                    }
                }
                break;
            };
            if scatterings == 0 {
                (sample.depth, sample.albedo) = (distance as f32, medium.albedo);
            }
            if self.settings.max_scatterings.is_some_and(|most| scatterings >= most) {
                break;
            }
            carried.weight *= medium.albedo;
            scatterings += 1;
            let chance = carried.worth().max_element() / ROULETTE_WEIGHT;
            if chance < 1.0 {
                if numbers.random() >= chance {
                    break;
                }
                carried.weight /= chance;
            }
            let origin = ray.origin + ray.direction * distance;
            let before = ray.direction.as_vec3();
            let mut light = Vec3::ZERO;
            let from =
                Scattering { at: origin, before, phase: medium.phase, worth: carried.worth().max_element() };
            // A set of even numbers for each scattering: where to, whether a shadow ray looks, how far to the next.
            numbers.start_set(scatterings);
            let (after, _) = medium.phase.sample(before, numbers.next_2d());
            let may_go_on = self.settings.max_scatterings.is_none_or(|most| scatterings < most);
            let mut later = Vec3::ZERO;
            for (source, shade) in lights.iter().zip(&self.shades) {
                let shaded = shade.as_ref().map(|shade| shade.at(origin));
                light += self.arriving(worker, source, shaded, &from, &mut numbers);
                if let (true, Light::Sun(sun), Some(shaded)) = (may_go_on, source, shaded) {
                    later += Vec3::from_array(sun.irradiance) * expected_later(sun, shaded, &from, after);
                }
            }
            if let Some(map) = sky_map {
                light += self.mapped(worker, map, origin, before, medium.phase, &mut numbers);
            }
            let light = carried.worth() * light;
            *(if scatterings == 1 { &mut sample.direct } else { &mut sample.indirect }) += light;
            sample.indirect -= carried.worth() * later;
            ray = Ray { origin, direction: after.as_dvec3().normalize() };
        }
        sample
    }

    /// The light of a light that a point scatters along `before`, over the share of light that it scatters at all.
    fn arriving(
        &self,
        worker: &mut PathWorker<'s>,
        light: &Light,
        shade: Option<Shaded>,
        from: &Scattering,
        numbers: &mut Sampler,
    ) -> Vec3 {
        let Scattering { at, before, phase, .. } = *from;
        match light.arriving(at) {
            Arriving::Nothing => Vec3::ZERO,
            Arriving::Ray { direction, distance, irradiance } => {
                let scatters = phase.between(before, direction.as_vec3());
                let towards = Ray { origin: at, direction };
                irradiance
                    * (scatters
                        * self.passes(worker, &towards, distance, shade, scatters * from.worth, numbers))
            }
            Arriving::Cone { cone, radiance } => {
                let solid_angle = cone.solid_angle();
                // Where the phase function has a peak narrower than the light, that is looked for as well.
                let peak = phase.value(1.0).max(phase.value(-1.0));
                let is_narrower = peak * solid_angle > 1.0;
                let takes_phase = is_narrower && numbers.random() < 0.5;
                let u = numbers.random_2d();
                let direction = if takes_phase { phase.sample(before, u).0 } else { cone.sample(u) };
                if takes_phase && !cone.contains(direction) {
                    return Vec3::ZERO;
                }
                let scatters = phase.between(before, direction);
                let density = 1.0 / solid_angle;
                let density = if is_narrower { 0.5 * (scatters + density) } else { density };
                let direction = direction.as_dvec3().normalize();
                let towards = Ray { origin: at, direction };
                let distance = light.distance(at, direction);
                radiance
                    * (scatters / density
                        * self.passes(worker, &towards, distance, shade, scatters * from.worth, numbers))
            }
        }
    }

    /// The light of a picture of the surroundings that a point scatters along `before`, over the share of light that it
    /// scatters at all: from a direction that the picture or the phase function chose.
    fn mapped(
        &self,
        worker: &mut PathWorker<'s>,
        map: &EnvironmentMap,
        origin: DVec3,
        before: Vec3,
        phase: Phase,
        numbers: &mut Sampler,
    ) -> Vec3 {
        let takes_map = numbers.random() < 0.5;
        let u = numbers.random_2d();
        let direction = match takes_map {
            true => map.sample(u).map(|sample| sample.direction),
            false => Some(phase.sample(before, u).0),
        };
        let Some(direction) = direction else { return Vec3::ZERO };
        let scatters = phase.between(before, direction);
        let density = 0.5 * (scatters + map.pdf(direction));
        let towards = Ray { origin, direction: direction.as_dvec3().normalize() };
        let passes = self.transmittance(worker, &towards, f64::INFINITY, numbers);
        if density > 0.0 { map.radiance(direction) * (scatters / density) * passes } else { Vec3::ZERO }
    }

    /// Where a ray collides, by delta tracking; `None` if it leaves all media. What they emit on the way is added to
    /// `emitted`.
    fn fly<'t>(
        &'t self,
        worker: &mut PathWorker<'s>,
        is_far: bool,
        ray: &Ray,
        carried: &mut Carried,
        emitted: &mut Vec3,
        numbers: &mut Sampler,
    ) -> Option<Collision<'t, 's>> {
        let PathWorker { media: readers, far: far_readers, glows } = worker;
        let (media, readers) = match &self.far {
            Some(far) if is_far => (far, far_readers),
            _ => (&self.media, readers),
        };
        let (collision, told) = match (media.as_slice(), readers.as_mut_slice()) {
            ([medium @ Medium { region: Region::Field(field), is_grey: true, .. }], [Some(reader)])
                if self.settings.lookup == Lookup::Trilinear =>
            {
                let mut first = Some(numbers.next_1d());
                let number = || first.take().unwrap_or_else(|| numbers.random());
                let distance = first_collision(field, reader, ray, medium.scale, number);
                (distance.map(|distance| Collision { distance, medium }), 0.0)
            }
            _ => self.fly_among(media, readers, glows, ray, carried, emitted, numbers),
        };
        let end = collision.as_ref().map_or(f64::INFINITY, |collision| collision.distance);
        if !self.glows.is_empty() {
            *emitted += carried.worth() * self.emitted(glows, ray, [told, end], numbers);
        }
        collision
    }

    /// As [`fly`](Self::fly), among any media; gives also how far emission has been counted.
    #[expect(
        clippy::too_many_arguments,
        reason = "they are the parts of a worker and of a path that change on the way"
    )]
    fn fly_among<'t>(
        &self,
        media: &'t [Medium<'s>],
        readers: &mut [Option<Reader<'s>>],
        glows: &mut [Option<Reader<'s>>],
        ray: &Ray,
        carried: &mut Carried,
        emitted: &mut Vec3,
        numbers: &mut Sampler,
    ) -> (Option<Collision<'t, 's>>, f64) {
        let mut told = 0.0;
        let lookup = self.settings.lookup;
        let media = media.iter().zip(readers);
        let mut fronts: Vec<Front<'_, 't, 's>> = media
            .filter_map(|(medium, reader)| Front::new(medium, reader.as_mut(), ray, carried.colours, numbers))
            .collect();
        loop {
            let nearest = fronts.iter_mut().min_by(|a, b| a.next.total_cmp(&b.next));
            let Some(front) = nearest.filter(|front| front.next < f64::INFINITY) else { return (None, told) };
            let distance = front.next;
            let part = front.density_over_majorant(lookup, numbers);
            let is_real = if front.medium.is_grey {
                part >= 1.0 || numbers.random() < part
            } else {
                // What is emitted up to here is worth what the path was worth up to here.
                if !self.glows.is_empty() {
                    *emitted += carried.worth() * self.emitted(glows, ray, [told, distance], numbers);
                    told = distance;
                }
                carried.turns((front.medium.shares * (part / front.live)).min(Vec3::ONE), numbers)
            };
            if is_real {
                return (Some(Collision { distance, medium: front.medium }), told);
            }
            front.advance(carried.colours, numbers);
        }
    }

    /// The same as [`transmittance`](Self::transmittance), for a light of which a path of `worth` wants to know: where the
    /// shade of a sun is known, shadow rays are followed the more seldom the less they can change.
    fn passes(
        &self,
        worker: &mut PathWorker<'s>,
        ray: &Ray,
        limit: f64,
        shade: Option<Shaded>,
        worth: f32,
        numbers: &mut Sampler,
    ) -> Vec3 {
        // A shadow ray that is uncertain itself would not do: it counts for many.
        let (Some(Shaded { passes, varies }), Some(filter)) = (shade, self.settings.lookup.along_lines())
        else {
            return self.transmittance(worker, ray, limit, numbers);
        };
        let chance = worth * (SHADE_EDGES * varies + SHADE_HALVES * passes * (1.0 - passes));
        let chance = chance.clamp(LEAST_SHADOW_RAYS, 1.0);
        let mut light = passes;
        // What a shadow ray finds beside it has to count for all those that are not followed.
        if numbers.next_1d() < chance {
            light += (self.exact_transmittance(worker, ray, filter) - passes) / chance;
        }
        Vec3::splat(light)
    }

    /// The share of light that passes along a ray to its end, where all media are grey and integrals have a closed form.
    fn exact_transmittance(&self, worker: &mut PathWorker<'s>, ray: &Ray, filter: Filter) -> f32 {
        let depth = self.far(worker).map(|(medium, reader)| match (&medium.region, reader) {
            (Region::Field(field), Some(reader)) => medium.scale * optical_depth(field, reader, ray, filter),
            (Region::Solid(solid), _) => {
                let length = solid.interval(ray).map_or(0.0, |[start, end]| end - start);
                medium.scale * length as f32
            }
            (Region::Field(_), None) => 0.0,
        });
        exp(-depth.sum::<f32>())
    }

    /// The media that rays of scattered light meet, with their readers.
    fn far<'t, 'w>(
        &'t self,
        worker: &'w mut PathWorker<'s>,
    ) -> impl Iterator<Item = (&'t Medium<'s>, &'w mut Option<Reader<'s>>)> {
        match &self.far {
            Some(far) => far.iter().zip(&mut worker.far),
            None => self.media.iter().zip(&mut worker.media),
        }
    }

    /// A vector whose mean is the share of light that passes along a ray up to a distance.
    fn transmittance(
        &self,
        worker: &mut PathWorker<'s>,
        ray: &Ray,
        limit: f64,
        numbers: &mut Sampler,
    ) -> Vec3 {
        let mut passes = Vec3::ONE;
        let lookup = self.settings.lookup;
        for (medium, reader) in self.far(worker) {
            passes *= match (&medium.region, reader) {
                (Region::Field(field), Some(reader)) if medium.is_grey => {
                    let [passes] = pass(field, reader, lookup, medium.scale, [1.0], ray, limit, numbers);
                    Vec3::splat(passes)
                }
                (Region::Field(field), Some(reader)) => {
                    let shares = medium.shares.to_array();
                    Vec3::from_array(pass(field, reader, lookup, medium.scale, shares, ray, limit, numbers))
                }
                (Region::Solid(solid), _) => match solid.interval(ray) {
                    Some([start, end]) => {
                        let depth = (medium.scale * (end.min(limit) - start).max(0.0) as f32).min(f32::MAX);
                        (medium.shares * depth).map(|depth| exp(-depth))
                    }
                    None => Vec3::ONE,
                },
                (Region::Field(_), None) => Vec3::ONE,
            };
            if passes == Vec3::ZERO {
                break;
            }
        }
        passes
    }

    /// What the media emit along a stretch of a ray. As a path gets beyond a point with the chance of the transmittance up
    /// to there, its mean over paths is weighed by that.
    fn emitted(
        &self,
        readers: &mut [Option<Reader<'s>>],
        ray: &Ray,
        [from, to]: [f64; 2],
        numbers: &mut Sampler,
    ) -> Vec3 {
        // What glows is not linear in what is looked up, so that a voxel at random would not do.
        let lookup = self.settings.lookup.mean();
        let mut light = Vec3::ZERO;
        for (glow, reader) in self.glows.iter().zip(readers) {
            let cut = |[start, end]: [f64; 2]| [start.max(from), end.min(to)];
            match (&glow.region, reader) {
                (Region::Field(field), Some(reader)) => {
                    let Some([start, end]) = field.interval(ray).map(cut) else { continue };
                    let length = (end - start) as f32;
                    if length <= 0.0 {
                        continue;
                    }
                    let Reader { walker, blocks, .. } = reader;
                    let local = field.local(ray, start);
                    let mut segments = field.runs(walker, local, 0.0, length);
                    while let Some(segment) = segments.next_segment() {
                        let length = segment.t1 - segment.t0;
                        let t = segment.t0 + numbers.random() * length;
                        let value = field.look_up(blocks, local.at(t), lookup, || [0.0; 3]);
                        light += glow.spectrum.radiance(value) * length;
                    }
                }
                (Region::Solid(solid), _) => {
                    let length = solid.interval(ray).map(cut).map_or(0.0, |[start, end]| end - start);
                    light += glow.spectrum.radiance(1.0) * length.max(0.0) as f32;
                }
                (Region::Field(_), None) => {}
            }
        }
        light
    }
}

/// A number whose mean is the share of light that passes along a ray through a field up to a distance, for each of some
/// colours, whose extinctions are `shares` of `scale`. By residual ratio tracking: what the least extinction of a segment
/// takes away is known, only the rest is left to chance.
#[expect(
    clippy::too_many_arguments,
    reason = "a medium in its parts, as colours are only known to the caller"
)]
fn pass<'s, const COLOURS: usize>(
    field: &Field<'s>,
    reader: &mut Reader<'s>,
    lookup: Lookup,
    scale: f32,
    shares: [f32; COLOURS],
    ray: &Ray,
    limit: f64,
    numbers: &mut Sampler,
) -> [f32; COLOURS] {
    let Some([start, end]) = field.interval(ray) else { return [1.0; COLOURS] };
    let Reader { shadow_walker, blocks, .. } = reader;
    let (walker, blocks): (&mut Accessor<'s>, &mut Blocks<'s>) = (shadow_walker, blocks);
    let local = field.local(ray, start);
    let mut segments = field.runs(walker, local, 0.0, (end.min(limit) - start) as f32);
    // What passes is `ratio × e^-known`; the exponential is taken where it is wanted.
    let (mut ratio, mut known, mut depth) = ([1.0_f32; COLOURS], 0.0_f32, depth_of(numbers.random()));
    let passes = |ratio: &[f32; COLOURS], known: f32| -> [f32; COLOURS] {
        std::array::from_fn(|i| ratio[i] * exp(-known.min(f32::MAX) * shares[i]))
    };
    while let Some(segment) = segments.next_segment() {
        let residual = segment.max - segment.min;
        if residual * scale > OPAQUE {
            return [0.0; COLOURS];
        }
        known += segment.min * scale * (segment.t1 - segment.t0);
        let mut t = segment.t0;
        loop {
            let left = (segment.t1 - t) * residual * scale;
            if depth >= left {
                depth -= left;
                break;
            }
            t += depth / (residual * scale);
            let value = field.look_up(blocks, local.at(t), lookup, || numbers.random_3d());
            let part = (value - segment.min) / residual;
            for (ratio, share) in ratio.iter_mut().zip(shares) {
                *ratio *= (1.0 - part * share).max(0.0);
            }
            depth = depth_of(numbers.random());
        }
        let now = passes(&ratio, known);
        let most = now.iter().copied().fold(0.0, f32::max);
        if most < ROULETTE_TRANSMITTANCE {
            if numbers.random() * ROULETTE_TRANSMITTANCE >= most {
                return [0.0; COLOURS];
            }
            // Exactly that for the strongest: a last bit less would ask for the next turn at once.
            let raised = |passes: f32| passes * (ROULETTE_TRANSMITTANCE / most);
            ratio = now.map(|passes| if passes < most { raised(passes) } else { ROULETTE_TRANSMITTANCE });
            known = 0.0;
        }
    }
    passes(&ratio, known)
}

/// By how much more of a sun's irradiance than the mean over all directions the next collisions are expected to scatter, if a path
/// goes on in the direction `after`. The mean over the phase function is exactly 0, whatever is expected: taken off from what a
/// path brings it leaves the mean as it is, and much less noise where scattering is forward.
///
/// As if as much light got to the next collisions as gets to this one, and part of the paths left before: deep in the shade nothing
/// comes, and in full light there is little medium. Lobes that follow each other are a lobe of the product of their asymmetries.
fn expected_later(sun: &Sun, shaded: Shaded, from: &Scattering, after: Vec3) -> f32 {
    let Phase::HenyeyGreenstein { g } = from.phase else { return 0.0 };
    let g = g.clamp(-MAX_ASYMMETRY, MAX_ASYMMETRY);
    let scale = shaded.passes * (1.0 - shaded.passes);
    if g == 0.0 || scale <= 0.0 {
        return 0.0;
    }
    let lobe = |g: f32, direction: Vec3| Phase::HenyeyGreenstein { g }.between(direction, sun.direction_to);
    let (mut sum, mut power) = (0.0, g);
    for part in LATER_LOBES {
        sum += part * (lobe(power, after) - lobe(power * g, from.before));
        power *= g;
    }
    scale * sum
}

/// The shade of a light, if it is a sun and all media are grey.
fn shade(light: &Light, media: &[Medium<'_>]) -> Option<Shade> {
    let Light::Sun(sun) = light else { return None };
    if !media.iter().all(|medium| medium.is_grey) {
        return None;
    }
    let casters = media.iter().map(|medium| match &medium.region {
        Region::Field(field) => Caster::Field(field, medium.scale),
        Region::Solid(solid) => Caster::Solid(solid, medium.scale),
    });
    Shade::new(&casters.collect::<Vec<_>>(), sun.direction_to)
}

/// The next tentative collision of a ray with one medium.
struct Front<'r, 't, 's> {
    medium: &'t Medium<'s>,
    /// Its distance along the ray; infinite if there is none.
    next: f64,
    /// Of the strongest colour's extinction, the share of which it was made.
    live: f32,
    place: Place<'r, 't, 's>,
}

/// Where in a medium a tentative collision is.
#[expect(
    clippy::large_enum_variant,
    reason = "there are a few of them per ray, and a box would be an allocation each"
)]
enum Place<'r, 't, 's> {
    /// In a segment of a field, whose distances count from `start`.
    Field {
        field: &'t Field<'s>,
        blocks: &'r mut Blocks<'s>,
        local: LocalRay,
        start: f64,
        segments: Runs<'r, 's>,
        segment: Segment,
        t: f32,
    },
    /// Before the end of a solid.
    Solid { end: f64 },
}

impl<'r, 't, 's> Front<'r, 't, 's> {
    /// The first tentative collision; `None` if the ray misses the medium.
    fn new(
        medium: &'t Medium<'s>,
        reader: Option<&'r mut Reader<'s>>,
        ray: &Ray,
        colours: Vec3,
        numbers: &mut Sampler,
    ) -> Option<Self> {
        let (next, place) = match (&medium.region, reader) {
            (Region::Field(field), Some(reader)) => {
                let Reader { walker, blocks, .. } = reader;
                let [start, end] = field.interval(ray)?;
                let local = field.local(ray, start);
                let mut segments = field.runs(walker, local, 0.0, (end - start) as f32);
                let segment = segments.next_segment()?;
                (start, Place::Field { field, blocks, local, start, segments, segment, t: segment.t0 })
            }
            (Region::Solid(solid), _) => {
                let [start, end] = solid.interval(ray)?;
                (start, Place::Solid { end })
            }
            (Region::Field(_), None) => return None,
        };
        let mut front = Front { medium, next, live: 1.0, place };
        front.advance(colours, numbers);
        Some(front)
    }

    /// Moves on to the next tentative collision. A colour that the path has no share of needs no majorant.
    fn advance(&mut self, colours: Vec3, numbers: &mut Sampler) {
        if !self.medium.is_grey {
            self.live = Vec3::select(colours.cmpgt(Vec3::ZERO), self.medium.shares, Vec3::ZERO).max_element();
        }
        let scale = self.medium.scale * self.live;
        if scale <= 0.0 {
            self.next = f64::INFINITY;
            return;
        }
        let mut depth = depth_of(numbers.random());
        self.next = match &mut self.place {
            Place::Solid { end } => {
                let next = self.next + f64::from(depth / scale);
                if next < *end { next } else { f64::INFINITY }
            }
            Place::Field { start, segments, segment, t, .. } => loop {
                let majorant = segment.max * scale;
                let left = (segment.t1 - *t) * majorant;
                if depth < left {
                    *t += depth / majorant;
                    break *start + f64::from(*t);
                }
                depth -= left;
                match segments.next_segment() {
                    Some(next) => (*segment, *t) = (next, next.t0),
                    None => break f64::INFINITY,
                }
            },
        };
    }

    /// The density at the tentative collision as a share of the majorant.
    fn density_over_majorant(&mut self, lookup: Lookup, numbers: &mut Sampler) -> f32 {
        match &mut self.place {
            Place::Solid { .. } => 1.0,
            Place::Field { segment, .. }
                if segment.min == segment.max || segment.max * self.medium.scale * self.live > OPAQUE =>
            {
                1.0
            }
            Place::Field { field, blocks, local, segment, t, .. } => {
                let value = field.look_up(blocks, local.at(*t), lookup, || numbers.random_3d());
                (value / segment.max).min(1.0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_expected_later_has_a_mean_of_nothing() {
        let sun = Sun::point(Vec3::new(0.6, 0.64, 0.48), [1.0; 3]);
        let shaded = Shaded { passes: 0.4, varies: 0.1 };
        let before = Vec3::new(0.0, 0.8, 0.6);
        for g in [-0.7, 0.2, 0.8] {
            let phase = Phase::HenyeyGreenstein { g };
            let from = Scattering { at: DVec3::ZERO, before, phase, worth: 1.0 };
            let mut numbers = Sampler::new(0, 0, 7, 0);
            let expected = |numbers: &mut Sampler| {
                let (after, _) = phase.sample(before, numbers.random_2d());
                f64::from(expected_later(&sun, shaded, &from, after))
            };
            let all: Vec<f64> = (0..200_000).map(|_| expected(&mut numbers)).collect();
            let mean = all.iter().sum::<f64>() / all.len() as f64;
            let variance = all.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / all.len() as f64;
            let error = (variance / all.len() as f64).sqrt();
            assert!(
                mean.abs() < 4.0 * error && variance > 0.0,
                "{g}: {mean} with a standard error of {error}"
            );
        }
        let from = Scattering { at: DVec3::ZERO, before, phase: Phase::mie(10.0), worth: 1.0 };
        assert_eq!(expected_later(&sun, shaded, &from, Vec3::Y), 0.0);
    }
}
