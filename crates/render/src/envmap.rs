//! Light from infinitely far away, by direction: pictures of all surroundings, and a sky of three colours.
//! What it does to a medium is the integrator's; reading picture files is not done here.

use crate::color::luminance;
use crate::math::{atan2_turns, sin_cos_turns};
use glam::{Mat3, Vec3};
use std::f32::consts::{PI, TAU};

/// The largest width and height of an [`EnvironmentMap`].
pub const MAX_SIDE: u32 = 1 << 15;

/// The most texels of an [`EnvironmentMap`]: 16384 × 8192.
pub const MAX_TEXELS: usize = 1 << 27;

/// The largest component of a texel: far above any light, and far enough below the largest float to be
/// summed.
pub const MAX_RADIANCE: f32 = 1e30;

/// Shares are counted in these parts of the whole. It is as fine as [`unit_f32`](crate::hash::unit_f32):
/// every number that it can return belongs to one texel, so that chances are exact.
pub const PARTS: u32 = 1 << 24;

/// Why a picture can't be an [`EnvironmentMap`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EnvironmentError {
    /// The picture is empty or too large.
    #[error(
        "an environment map of {width} x {height} pixels is empty or larger than {MAX_SIDE} a side or \
         {MAX_TEXELS} pixels; scale it"
    )]
    Size {
        /// In pixels.
        width: u32,
        /// In pixels.
        height: u32,
    },
    /// There are not as many pixels as width and height say.
    #[error("an environment map of {width} x {height} pixels came with {count}")]
    Count {
        /// In pixels.
        width: u32,
        /// In pixels.
        height: u32,
        /// How many pixels there were.
        count: usize,
    },
    /// A pixel is not light.
    #[error(
        "pixel ({x}, {y}) of an environment map is negative, not a number or above {MAX_RADIANCE:e}; \
         repair the picture"
    )]
    Texel {
        /// From the left.
        x: u32,
        /// From the top.
        y: u32,
    },
}

/// Surroundings as a picture: radiance over all directions, and directions chosen by it.
///
/// Columns are longitudes and rows are latitudes, all of equal angle. Unturned, +Y is up (the top row), the
/// middle of the picture looks along +Z, a quarter of the width left of it lies +X, right of it -X, and -Z at
/// both ends, as the OpenEXR library's `LatLongMap` has it. Between the centres of texels radiance is
/// bilinear; it goes round from end to end, and is that of the outermost row around the poles.
///
/// Directions are chosen by the mean brightness of each texel, evenly over its solid angle.
#[derive(Debug, Clone)]
pub struct EnvironmentMap {
    width: u32,
    height: u32,
    texels: Vec<[f32; 3]>,
    map_from_world: Mat3,
    /// Solid angle of a texel of each row.
    solid_angles: Vec<f32>,
    /// For each row, which of [`PARTS`] is the first that belongs to the row behind it.
    row_ends: Vec<u32>,
    /// The same for the columns of each row, row by row. All 0 in rows without light.
    column_ends: Vec<u32>,
}

/// What an [`EnvironmentMap`] is made of, for renderers that look it up by themselves.
#[derive(Debug, Clone, Copy)]
pub struct EnvironmentParts<'m> {
    /// In texels.
    pub width: u32,
    /// In texels.
    pub height: u32,
    /// Radiance, from the top left, row by row.
    pub texels: &'m [[f32; 3]],
    /// Takes directions of the world to those of the map.
    pub map_from_world: Mat3,
    /// The solid angle of a texel of each row.
    pub solid_angles: &'m [f32],
    /// For each row, which of [`PARTS`] is the first that belongs to the row behind it.
    pub row_ends: &'m [u32],
    /// The same for the columns of each row, row by row. All 0 in rows without light.
    pub column_ends: &'m [u32],
}

/// A direction towards an environment, chosen by its light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EnvironmentSample {
    /// Towards the light, in the world, of length 1.
    pub direction: Vec3,
    /// The radiance that comes from there.
    pub radiance: Vec3,
    /// The density of such directions [1/sr]. Above 0.
    pub pdf: f32,
}

impl EnvironmentMap {
    /// A map of linear Rec.709 radiance, from the top left, row by row. `world_from_map` is a rotation, such
    /// as that of [`orientation`].
    ///
    /// # Errors
    ///
    /// If there are no or too many pixels, not as many as stated, or if one is negative, not finite or too
    /// bright.
    pub fn new(
        width: u32,
        height: u32,
        texels: Vec<[f32; 3]>,
        world_from_map: Mat3,
    ) -> Result<Self, EnvironmentError> {
        let count = (width as usize)
            .checked_mul(height as usize)
            .filter(|count| (1..=MAX_TEXELS).contains(count) && width <= MAX_SIDE && height <= MAX_SIDE);
        let Some(count) = count else { return Err(EnvironmentError::Size { width, height }) };
        if texels.len() != count {
            return Err(EnvironmentError::Count { width, height, count: texels.len() });
        }
        let is_light = |texel: &[f32; 3]| texel.iter().all(|c| (0.0..=MAX_RADIANCE).contains(c));
        if let Some(at) = texels.iter().position(|texel| !is_light(texel)) {
            // Within the limits of a side, checked above.
            let (x, y) = ((at % width as usize) as u32, (at / width as usize) as u32);
            return Err(EnvironmentError::Texel { x, y });
        }
        let mut map = EnvironmentMap {
            width,
            height,
            texels,
            map_from_world: world_from_map.transpose(),
            solid_angles: (0..height).map(|y| texel_solid_angle(width, height, y)).collect(),
            row_ends: Vec::new(),
            column_ends: Vec::with_capacity(count),
        };
        let (mut rows, mut row) = (Vec::with_capacity(height as usize), Vec::with_capacity(width as usize));
        for y in 0..height {
            map.row_brightness(y, &mut row);
            rows.push(row.iter().sum::<f64>() * f64::from(map.texel_solid_angle(y)));
            push_ends(&row, &mut map.column_ends);
        }
        push_ends(&rows, &mut map.row_ends);
        Ok(map)
    }

    /// The mean of the bilinear brightness over each texel of a row. Above 0 wherever radiance is in any part
    /// of the texel, though the texel itself be black.
    fn row_brightness(&self, y: u32, row: &mut Vec<f64>) {
        let (above, below) = (y.saturating_sub(1), (y + 1).min(self.height - 1));
        let down = |x: u32| {
            let at = |y| f64::from(luminance(self.texel(x, y)));
            (at(above) + 6.0 * at(y) + at(below)) / 8.0
        };
        row.clear();
        row.extend((0..self.width).map(|x| {
            let (left, right) = (self.wrapped(x + self.width - 1), self.wrapped(x + 1));
            (down(left) + 6.0 * down(x) + down(right)) / 8.0
        }));
    }

    #[inline]
    fn wrapped(&self, x: u32) -> u32 {
        if x >= self.width { x - self.width } else { x }
    }

    #[inline]
    fn texel(&self, x: u32, y: u32) -> [f32; 3] {
        self.texels.get(y as usize * self.width as usize + x as usize).copied().unwrap_or_default()
    }

    /// What it is made of.
    pub fn parts(&self) -> EnvironmentParts<'_> {
        EnvironmentParts {
            width: self.width,
            height: self.height,
            texels: &self.texels,
            map_from_world: self.map_from_world,
            solid_angles: &self.solid_angles,
            row_ends: &self.row_ends,
            column_ends: &self.column_ends,
        }
    }

    /// Whether no light comes from anywhere.
    pub fn is_black(&self) -> bool {
        self.row_ends.last() == Some(&0)
    }

    /// Radiance from a direction, towards the light, in the world, of length 1.
    pub fn radiance(&self, direction: Vec3) -> Vec3 {
        let [x, y] = self.position(self.map_from_world * direction);
        self.bilinear(x, y)
    }

    /// Radiance at a position in texels from the top left corner.
    fn bilinear(&self, x: f32, y: f32) -> Vec3 {
        // From the centres of texels. Left of the first lies the last.
        let x = if x < 0.5 { x - 0.5 + self.width as f32 } else { x - 0.5 };
        let y = (y - 0.5).max(0.0);
        let (left, top) = ((x as u32).min(self.width - 1), (y as u32).min(self.height - 1));
        let (right, bottom) = (self.wrapped(left + 1), (top + 1).min(self.height - 1));
        let (u, v) = (x - x.floor(), y - y.floor());
        let at = |x, y| Vec3::from_array(self.texel(x, y));
        let across = |y| at(left, y) * (1.0 - u) + at(right, y) * u;
        across(top) * (1.0 - v) + across(bottom) * v
    }

    /// Where a direction in the map lies, in texels from the top left corner.
    fn position(&self, d: Vec3) -> [f32; 2] {
        let longitude = atan2_turns(d.x, d.z);
        let from_top = atan2_turns((d.x * d.x + d.z * d.z).sqrt(), d.y);
        [(0.5 - longitude) * self.width as f32, 2.0 * from_top * self.height as f32]
    }

    /// The density [1/sr] with which [`sample`](Self::sample) chooses a direction: one value for each texel.
    pub fn pdf(&self, direction: Vec3) -> f32 {
        let [x, y] = self.position(self.map_from_world * direction);
        // The casts turn what is not a number to 0.
        let (x, y) = ((x as u32).min(self.width - 1), (y as u32).min(self.height - 1));
        let (_, row_parts) = parts(&self.row_ends, y as usize);
        let (_, column_parts) = parts(self.row(y), x as usize);
        self.density(y, row_parts, column_parts)
    }

    #[inline]
    fn density(&self, y: u32, row_parts: u32, column_parts: u32) -> f32 {
        let share = |parts: u32| parts as f32 / PARTS as f32;
        share(row_parts) * share(column_parts) / self.texel_solid_angle(y)
    }

    fn row(&self, y: u32) -> &[u32] {
        let start = y as usize * self.width as usize;
        self.column_ends.get(start..start + self.width as usize).unwrap_or_default()
    }

    #[inline]
    fn texel_solid_angle(&self, y: u32) -> f32 {
        self.solid_angles.get(y as usize).copied().unwrap_or(1.0)
    }

    /// A direction chosen by where the light is, `None` where there is none. `u` are two uniform numbers in
    /// 0..1, for longitude and latitude.
    pub fn sample(&self, u: [f32; 2]) -> Option<EnvironmentSample> {
        let (y, v, row_parts) = pick(&self.row_ends, u[1])?;
        let (x, u, column_parts) = pick(self.row(y), u[0])?;
        let direction = self.in_texel(x, y, u, v);
        // Not from x and y: the radiance is to be that of `radiance`.
        let [column, line] = self.position(direction);
        Some(EnvironmentSample {
            direction: (self.map_from_world.transpose() * direction).normalize(),
            radiance: self.bilinear(column, line),
            pdf: self.density(y, row_parts, column_parts),
        })
    }

    /// The direction in the map at `u` and `v`, both 0..1, of a texel, where equal steps are equal solid
    /// angles.
    fn in_texel(&self, x: u32, y: u32, u: f32, v: f32) -> Vec3 {
        // Rows of the lower half are measured from below: near a pole, its own distance is what has digits.
        let is_lower = y >= self.height.div_ceil(2);
        let (y, v) = if is_lower { (self.height - 1 - y, 1.0 - v) } else { (y, v) };
        let turns_per_row = 0.5 / self.height as f32;
        let (half, _) = sin_cos_turns(y as f32 * turns_per_row / 2.0);
        let thickness = self.texel_solid_angle(y) * self.width as f32 / TAU;
        let from_pole = (2.0 * half * half + v * thickness).min(2.0);
        let sin = (from_pole * (2.0 - from_pole)).sqrt();
        let up = if is_lower { from_pole - 1.0 } else { 1.0 - from_pole };
        let (sin_longitude, cos_longitude) = sin_cos_turns(0.5 - (x as f32 + u) / self.width as f32);
        Vec3::new(sin * sin_longitude, up, sin * cos_longitude)
    }
}

/// The solid angle of each texel of a row, in steradians. As a product of sines it loses no digits in thin rows.
fn texel_solid_angle(width: u32, height: u32, y: u32) -> f32 {
    let turns_per_row = 0.5 / height as f32;
    let (middle, _) = sin_cos_turns((y as f32 + 0.5) * turns_per_row);
    let (half, _) = sin_cos_turns(turns_per_row / 2.0);
    2.0 * middle * half * (TAU / width as f32)
}

/// Appends where each weight's share of [`PARTS`] ends. Each weight above 0 has a part at least. All 0 if no
/// weight is above 0.
fn push_ends(weights: &[f64], ends: &mut Vec<u32>) {
    let whole: f64 = weights.iter().sum();
    let lit = weights.iter().filter(|&&weight| weight > 0.0).count() as u32;
    // At most `MAX_SIDE` weights, so enough is left to share.
    let shared = f64::from(PARTS - lit);
    let (mut sum, mut before) = (0.0, 0u32);
    ends.extend(weights.iter().map(|&weight| {
        if weight > 0.0 {
            sum += weight;
            before += 1;
        }
        // Rounded sums may not reach the whole: the last one that is lit ends the last part.
        if before == lit && lit > 0 { PARTS } else { (sum / whole * shared) as u32 + before }
    }));
    if lit == 0 {
        let start = ends.len() - weights.len();
        ends.iter_mut().skip(start).for_each(|end| *end = 0);
    }
}

/// The first part of an entry, and how many there are.
#[inline]
fn parts(ends: &[u32], index: usize) -> (u32, u32) {
    let end = ends.get(index).copied().unwrap_or(0);
    let start = index.checked_sub(1).and_then(|before| ends.get(before)).copied().unwrap_or(0);
    (start, end.saturating_sub(start))
}

/// The entry that a uniform number chooses, where in it the number lies (0..1), and how many parts the entry
/// has. `None` if none has any.
#[inline]
fn pick(ends: &[u32], u: f32) -> Option<(u32, f32, u32)> {
    let part = ((u * PARTS as f32) as u32).min(PARTS - 1);
    let index = ends.partition_point(|&end| end <= part);
    ends.get(index)?;
    let (start, count) = parts(ends, index);
    Some((index as u32, ((part - start) as f32 + 0.5) / count as f32, count))
}

/// The rotation that sets a map's +Y along `up`, of any length but 0, after turning the map around that by
/// `turns`: positive from +Z to +X. For +Y as `up` it is this turn alone. Not a direction counts as +Y.
pub fn orientation(up: Vec3, turns: f32) -> Mat3 {
    let up = up.try_normalize().unwrap_or(Vec3::Y);
    let (sin, cos) = sin_cos_turns(turns);
    let turn = Mat3::from_cols(Vec3::new(cos, 0.0, -sin), Vec3::Y, Vec3::new(sin, 0.0, cos));
    // The shortest way from +Y to `up`, in the plane of both; half a turn around X if they are opposite.
    let tilt = if up.y > -0.999_999 {
        let k = 1.0 / (1.0 + up.y);
        Mat3::from_cols(
            Vec3::new(1.0 - up.x * up.x * k, -up.x, -up.x * up.z * k),
            up,
            Vec3::new(-up.x * up.z * k, -up.z, 1.0 - up.z * up.z * k),
        )
    } else {
        Mat3::from_cols(Vec3::X, -Vec3::Y, -Vec3::Z)
    };
    tilt * turn
}

/// The colours of a sky that depends on the height above the horizon alone. Radiance, linear Rec.709.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GradientSky {
    /// Straight up.
    pub zenith: [f32; 3],
    /// On the horizon.
    pub horizon: [f32; 3],
    /// Straight down.
    pub ground: [f32; 3],
}

impl GradientSky {
    /// The share that the horizon has in the mean radiance over all directions. Zenith and ground have half
    /// of the rest each.
    pub const HORIZON_SHARE: f32 = 128.0 / 315.0;

    /// The mean radiance over all directions.
    pub fn mean(&self) -> [f32; 3] {
        let rest = (1.0 - Self::HORIZON_SHARE) / 2.0;
        std::array::from_fn(|i| {
            self.horizon[i] * Self::HORIZON_SHARE + (self.zenith[i] + self.ground[i]) * rest
        })
    }
}

/// The radiance of a sky from a direction, towards the light; both it and `up` of length 1.
///
/// With s the sine of the elevation, the horizon has the weight (1 - s²)⁴, and the zenith (s > 0) or the
/// ground (s < 0) the rest. The blend is smooth everywhere; it is half at an elevation of about 23°.
#[inline]
pub fn gradient_sky(direction: Vec3, up: Vec3, colours: &GradientSky) -> Vec3 {
    let s = direction.dot(up);
    let cos2 = (1.0 - s * s).max(0.0);
    let horizon = (cos2 * cos2) * (cos2 * cos2);
    let end = Vec3::from_array(if s < 0.0 { colours.ground } else { colours.zenith });
    Vec3::from_array(colours.horizon) * horizon + end * (1.0 - horizon)
}

/// A direction evenly over the sphere, of density 1 / 4π per steradian, from two uniform numbers in 0..=1.
#[inline]
pub fn uniform_direction(u: [f32; 2]) -> Vec3 {
    let from_pole = 2.0 * u[0];
    let sin = (from_pole * (2.0 - from_pole)).max(0.0).sqrt();
    let (sin_turn, cos_turn) = sin_cos_turns(u[1]);
    Vec3::new(sin * cos_turn, sin * sin_turn, 1.0 - from_pole)
}

/// The density of [`uniform_direction`] [1/sr].
pub const UNIFORM_PDF: f32 = 1.0 / (4.0 * PI);

#[cfg(test)]
mod tests;
