//! The path tracer: light scattered any number of times, without bias.
//!
//! Where a path collides is found by delta tracking: tentative collisions at the rate of a majorant, each real with the
//! chance of the extinction there over it (Woodcock et al., "Techniques used in the GEM code", 1965). Majorants are those of
//! the tree's own regions, so that empty space costs nothing and thin parts little. At each collision the light of
//! the sun and of the sky is taken with a transmittance by residual ratio tracking (Novák et al., "Residual Ratio Tracking for
//! Estimating Attenuation in Participating Media", 2014). Paths end by Russian roulette.
//!
//! What does not live here: pixels, threads, pictures ([`crate::picture`]).

use glam::Vec3;
use nuage_volume::accessor::Accessor;

use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::hash::{hash_u32, unit_f32};
use crate::math::{exp, ln};
use crate::phase::{hg, sample_hg};
use crate::scene::{Emission, Scene};
use crate::traverse::{Field, Reader};

/// How paths are made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathSettings {
    /// How often light may scatter before it reaches the camera; as often as it does if `None`.
    pub max_scatterings: Option<u32>,
    /// Whether each collision looks for the sky with a ray of its own. Else only paths that leave the medium see it. The sun
    /// can be seen in no other way.
    pub sky_rays: bool,
}

impl Default for PathSettings {
    fn default() -> Self {
        PathSettings { max_scatterings: None, sky_rays: true }
    }
}

/// A path whose weight is less than this goes on with a chance of its weight over it.
const ROULETTE_WEIGHT: f32 = 0.25;

/// A shadow ray through which less passes goes on with a chance of that over it.
const ROULETTE_TRANSMITTANCE: f32 = 0.1;

/// A scene made ready for paths.
pub struct PathTracer<'s> {
    scene: &'s Scene<'s>,
    settings: PathSettings,
    density: Option<Field<'s>>,
    emission: Option<(Field<'s>, &'s Emission<'s>)>,
}

/// What one thread needs to trace paths.
pub struct PathWorker<'s> {
    density: Option<Reader<'s>>,
    emission: Option<Reader<'s>>,
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

/// Random numbers of one path.
struct Random {
    path: u32,
    count: u32,
}

impl Random {
    fn bits(&mut self) -> u32 {
        self.count = self.count.wrapping_add(1);
        hash_u32(hash_u32(self.path.wrapping_add(self.count)) ^ self.path.rotate_left(16))
    }

    /// From 0 to less than 1.
    fn unit(&mut self) -> f32 {
        unit_f32(self.bits())
    }

    /// An optical depth at which a ray collides.
    fn depth(&mut self) -> f32 {
        // Never infinite: the number is less than 1 by 2⁻²⁴ or more.
        -ln(1.0 - self.unit())
    }
}

impl<'s> PathTracer<'s> {
    /// Makes a scene ready.
    pub fn new(scene: &'s Scene<'s>, settings: PathSettings) -> Self {
        let emission = scene.medium.emission.as_ref();
        PathTracer {
            scene,
            settings,
            density: Field::new(scene.medium.density).filter(|_| scene.medium.density_scale > 0.0),
            emission: emission.and_then(|emission| Some((Field::new(emission.channel)?, emission))),
        }
    }

    /// What a thread needs.
    pub fn worker(&self) -> PathWorker<'s> {
        PathWorker {
            density: self.density.as_ref().map(Field::reader),
            emission: self.emission.as_ref().map(|(field, _)| field.reader()),
        }
    }

    /// What one path says of the light along a ray.
    pub fn sample(&self, worker: &mut PathWorker<'s>, ray: &Ray, seed: u32) -> PathSample {
        let Scene { medium, sun, sky, .. } = self.scene;
        let (albedo, g) = (Vec3::from_array(medium.albedo), medium.phase_g);
        let sky = Vec3::from_array(*sky);
        let mut random = Random { path: seed, count: 0 };
        let (mut weight, mut sample) = (Vec3::ONE, PathSample::default());
        let mut ray = *ray;
        let mut scatterings = 0;
        loop {
            let collision = self.fly(worker, &ray, &mut random);
            let emitted =
                weight * self.emitted(worker, &ray, collision.unwrap_or(f64::INFINITY), &mut random);
            *(if scatterings == 0 { &mut sample.emission } else { &mut sample.indirect }) += emitted;
            let Some(distance) = collision else {
                match scatterings {
                    0 => sample.passed = true,
                    _ if self.settings.sky_rays => {}
                    1 => sample.direct += weight * sky,
                    _ => sample.indirect += weight * sky,
                }
                break;
            };
            if scatterings == 0 {
                (sample.depth, sample.albedo) = (distance as f32, albedo);
            }
            if self.settings.max_scatterings.is_some_and(|most| scatterings >= most) {
                break;
            }
            weight *= albedo;
            scatterings += 1;
            let chance = weight.max_element() / ROULETTE_WEIGHT;
            if chance < 1.0 {
                if random.unit() >= chance {
                    break;
                }
                weight /= chance;
            }
            let origin = ray.origin + ray.direction * distance;
            let before = ray.direction.as_vec3();
            let mut light = Vec3::ZERO;
            if let Some(sun) = sun {
                let towards = Ray { origin, direction: sun.direction_to.as_dvec3() };
                let phase = hg(before.dot(sun.direction_to), g);
                let passes = self.transmittance(worker, &towards, &mut random);
                light += Vec3::from_array(sun.irradiance) * (phase * passes);
            }
            let scattered = |random: &mut Random| {
                let direction = sample_hg(before, g, [random.unit(), random.unit()]).as_dvec3();
                Ray { origin, direction: direction.normalize() }
            };
            if self.settings.sky_rays && sky != Vec3::ZERO {
                let towards = scattered(&mut random);
                light += sky * self.transmittance(worker, &towards, &mut random);
            }
            *(if scatterings == 1 { &mut sample.direct } else { &mut sample.indirect }) += weight * light;
            ray = scattered(&mut random);
        }
        sample
    }

    /// The distance at which a ray collides, by delta tracking. `None` if it leaves the medium.
    fn fly(&self, worker: &mut PathWorker<'s>, ray: &Ray, random: &mut Random) -> Option<f64> {
        let (field, reader) = (self.density.as_ref()?, worker.density.as_mut()?);
        let Reader { walker, blocks, .. } = reader;
        let [start, end] = field.interval(ray)?;
        let local = field.local(ray, start);
        let mut segments = field.runs(walker, local, 0.0, (end - start) as f32);
        let mut depth = random.depth();
        while let Some(segment) = segments.next_segment() {
            let majorant = segment.max * self.scene.medium.density_scale;
            let mut t = segment.t0;
            loop {
                let left = (segment.t1 - t) * majorant;
                if depth >= left {
                    depth -= left;
                    break;
                }
                t += depth / majorant;
                let is_real = segment.min == segment.max
                    || random.unit() * segment.max < field.sample(blocks, local.at(t));
                if is_real {
                    return Some(start + f64::from(t));
                }
                depth = random.depth();
            }
        }
        None
    }

    /// A number whose mean is the share of light that passes along a ray, by residual ratio tracking: what the least
    /// extinction of a segment takes away is known, only the rest is left to chance.
    fn transmittance(&self, worker: &mut PathWorker<'s>, ray: &Ray, random: &mut Random) -> f32 {
        let (Some(field), Some(reader)) = (&self.density, &mut worker.density) else { return 1.0 };
        let Some([start, end]) = field.interval(ray) else { return 1.0 };
        let Reader { shadow_walker, blocks, .. } = reader;
        let (walker, blocks): (&mut Accessor<'s>, &mut Blocks<'s>) = (shadow_walker, blocks);
        let scale = self.scene.medium.density_scale;
        let local = field.local(ray, start);
        let mut segments = field.runs(walker, local, 0.0, (end - start) as f32);
        // What passes is `ratio × e^-known`; the exponential is taken where it is wanted.
        let (mut ratio, mut known, mut depth) = (1.0_f32, 0.0_f32, random.depth());
        while let Some(segment) = segments.next_segment() {
            let residual = segment.max - segment.min;
            known += segment.min * scale * (segment.t1 - segment.t0);
            let mut t = segment.t0;
            loop {
                let left = (segment.t1 - t) * residual * scale;
                if depth >= left {
                    depth -= left;
                    break;
                }
                t += depth / (residual * scale);
                let density = field.sample(blocks, local.at(t));
                ratio *= (1.0 - (density - segment.min) / residual).max(0.0);
                depth = random.depth();
            }
            let passes = ratio * exp(-known);
            if passes < ROULETTE_TRANSMITTANCE {
                if random.unit() * ROULETTE_TRANSMITTANCE >= passes {
                    return 0.0;
                }
                (ratio, known) = (ROULETTE_TRANSMITTANCE, 0.0);
            }
        }
        ratio * exp(-known)
    }

    /// What the medium emits along a ray up to a distance. As a path gets beyond a point with the chance of the transmittance up to
    /// there, its mean over paths is weighed by that.
    fn emitted(&self, worker: &mut PathWorker<'s>, ray: &Ray, distance: f64, random: &mut Random) -> Vec3 {
        let (Some((field, emission)), Some(reader)) = (&self.emission, &mut worker.emission) else {
            return Vec3::ZERO;
        };
        let Some([start, end]) = field.interval(ray) else { return Vec3::ZERO };
        let Reader { walker, blocks, .. } = reader;
        let local = field.local(ray, start);
        let length = (end.min(distance) - start) as f32;
        if length <= 0.0 {
            return Vec3::ZERO;
        }
        let mut segments = field.runs(walker, local, 0.0, length);
        let mut light = Vec3::ZERO;
        while let Some(segment) = segments.next_segment() {
            let length = segment.t1 - segment.t0;
            let t = segment.t0 + random.unit() * length;
            light += emission.spectrum.radiance(field.sample(blocks, local.at(t))) * length;
        }
        light
    }
}
