//! How much of what a brick holds can be seen: where light hardly gets, errors hardly matter.
//!
//! A budget of words is best spent where it shows. Nothing is known here of cameras and lights, so what counts is the light that
//! gets from the outside to a place and back out, on the way of any of 26 directions, through cells of a few voxels taken as
//! homogeneous, in a medium so dense that a good part of it is hidden. Each frame is taken to be as dense as that: an error shows
//! by what it is of the optical depth, so those of the thin last frames of an explosion count more than the same ones in its dense
//! first. What errors then count is the encoder's ([`seen`](crate::encode::seen)).

use glam::IVec3;
use nuage_volume::build::TileSize;

use super::level::Level;
use crate::encode::seen::Light;

const BRICK_SIDE: usize = 8;

/// The optical depth of the denser columns of cells: about as much as `nuage render` has where it is told nothing.
const OPTICAL_DEPTH: f32 = 9.5;

/// The part of rays that are less dense than these.
const DENSER: f32 = 0.9;

/// The sides of cells that are tried, in voxels.
const CELL_SIDES: [usize; 3] = [2, 4, 8];

/// The most cells of a box. In boxes that need more, all bricks count the same.
const MAX_CELLS: i64 = 1 << 24;

/// Light is rounded to multiples of this, so that it does not hang on the last digits of exponentials.
const STEP: f32 = 1.0 / 1024.0;

/// There is at least so much everywhere.
const LEAST: f32 = 4.0 * STEP;

/// The mean densities of cells of 2³, 4³ or 8³ voxels in a box of bricks, z fastest.
struct Cells {
    size: [usize; 3],
    /// The cells of a brick along an axis.
    per_brick: usize,
    means: Vec<f32>,
    /// The first brick of the box.
    first: IVec3,
}

/// What an extinction of so much in a voxel of the channel's unit may count, so that nothing is lost in single precision.
const EXTINCTIONS: [f32; 2] = [1.0 / 1024.0, 1024.0];

/// The light in each brick of a density times the optical depth of a voxel of the unit, for errors in that unit to be multiplied by.
pub(super) fn light(level: &Level, unit: f32) -> Vec<Light> {
    let Some(cells) = Cells::of(level) else { return vec![[1.0; 64]; level.bricks.len()] };
    let extinction = OPTICAL_DEPTH / cells.denser_depth();
    let mut light = vec![0.0; cells.means.len()];
    let directions = (0..27).map(|i| [i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1]).filter(|d| *d != [0; 3]);
    for direction in directions {
        let depth = cells.depth(direction);
        // What comes in along one direction goes out along another.
        light
            .iter_mut()
            .zip(&depth)
            .for_each(|(sum, depth)| *sum += (-2.0 * extinction * depth).exp() / 26.0);
    }
    let [least, most] = EXTINCTIONS;
    let in_unit = (extinction * unit).clamp(least, most);
    let rounded = |light: f32| ((light / STEP).round() * STEP).max(LEAST);
    let in_brick = |place: &IVec3| {
        let [x, y, z] = cells.first_cell(*place);
        std::array::from_fn(|block| {
            let [i, j, k] = [block >> 4, block >> 2 & 3, block & 3].map(|c| c * cells.per_brick / 4);
            in_unit * rounded(light[cells.index([x + i, y + j, z + k])])
        })
    };
    level.places.iter().map(in_brick).collect()
}

impl Cells {
    /// The box around all bricks and tiles. `None` if it is too large or empty.
    fn of(level: &Level) -> Option<Cells> {
        let bricks = level.places.iter().map(|place| (*place, 1));
        let all = || {
            level.tiles.iter().map(|(place, size, _)| (*place, bricks_across(*size))).chain(bricks.clone())
        };
        let first = all().map(|(place, _)| place).reduce(IVec3::min)?;
        let end = all().map(|(place, side)| place + side).reduce(IVec3::max)?;
        let size = end.as_i64vec3() - first.as_i64vec3();
        let bricks = size.x.checked_mul(size.y)?.checked_mul(size.z)?;
        let per_brick = CELL_SIDES.map(|side| BRICK_SIDE / side).into_iter();
        let per_brick = per_brick
            .filter(|count| bricks.checked_mul(count.pow(3) as i64).is_some_and(|cells| cells <= MAX_CELLS))
            .max()?;
        let size = size.to_array().map(|side| side as usize * per_brick);
        let mut cells = Cells { size, per_brick, means: vec![0.0; size.iter().product()], first };
        for (place, size, value) in &level.tiles {
            let [x, y, z] = cells.first_cell(*place);
            let side = bricks_across(*size) as usize * per_brick;
            for (i, j) in (0..side * side).map(|i| (i / side, i % side)) {
                let begin = cells.index([x + i, y + j, z]);
                cells.means[begin..begin + side].fill(value.max(0.0));
            }
        }
        let cell_side = BRICK_SIDE / per_brick;
        let part = 1.0 / (cell_side.pow(3)) as f32;
        for (place, brick) in level.places.iter().zip(&level.bricks) {
            let [x, y, z] = cells.first_cell(*place);
            for (voxel, value) in brick.iter().enumerate() {
                let [i, j, k] = [voxel >> 6, voxel >> 3 & 7, voxel & 7].map(|c| c / cell_side);
                let cell = cells.index([x + i, y + j, z + k]);
                // Parts of the largest float add up to one.
                cells.means[cell] += part * value.max(0.0);
            }
        }
        Some(cells)
    }

    /// The first cell of a brick.
    fn first_cell(&self, place: IVec3) -> [usize; 3] {
        (place - self.first).to_array().map(|c| c as usize * self.per_brick)
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.size[1] + y) * self.size[2] + z
    }

    /// The sum of means along the denser columns, of all axes together.
    fn denser_depth(&self) -> f32 {
        let mut sums = Vec::new();
        for axis in 0..3 {
            let [first, second] = [(axis + 1) % 3, (axis + 2) % 3];
            for i in 0..self.size[first] * self.size[second] {
                let mut at = [0; 3];
                (at[first], at[second]) = (i / self.size[second], i % self.size[second]);
                let column = (0..self.size[axis]).map(|c| {
                    at[axis] = c;
                    self.means[self.index(at)]
                });
                sums.push(column.sum::<f32>());
            }
        }
        sums.retain(|sum| *sum > 0.0);
        sums.sort_by(f32::total_cmp);
        let denser = (sums.len() as f32 * DENSER) as usize;
        sums.get(denser).or(sums.last()).copied().unwrap_or(1.0)
    }

    /// The sum of means from the middle of each cell to the outside, times the length of a step.
    fn depth(&self, direction: [i32; 3]) -> Vec<f32> {
        let step = (direction.iter().map(|d| d * d).sum::<i32>() as f32).sqrt();
        let mut depth = vec![0.0; self.means.len()];
        let order = |axis: usize, i: usize| if direction[axis] > 0 { self.size[axis] - 1 - i } else { i };
        let [nx, ny, nz] = self.size;
        for (i, j, k) in (0..nx * ny * nz).map(|i| (i / nz / ny, i / nz % ny, i % nz)) {
            let at = [order(0, i), order(1, j), order(2, k)];
            let next: [usize; 3] =
                std::array::from_fn(|axis| at[axis].wrapping_add_signed(direction[axis] as isize));
            let is_inside = (0..3).all(|axis| next[axis] < self.size[axis]);
            let here = self.index(at);
            let beyond = match is_inside {
                true => depth[self.index(next)] + 0.5 * step * self.means[self.index(next)],
                false => 0.0,
            };
            depth[here] = beyond + 0.5 * step * self.means[here];
        }
        depth
    }
}

/// The bricks along a side of a tile.
fn bricks_across(size: TileSize) -> i32 {
    match size {
        TileSize::Brick => 1,
        TileSize::Node4 => 16,
        TileSize::Node5 => 512,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ball of bricks of a density, in the middle of which light comes from nowhere.
    fn ball(radius: i32, density: f32) -> Level {
        let mut level = Level::default();
        for i in 0..(2 * radius + 1).pow(3) {
            let side = 2 * radius + 1;
            let place = IVec3::new(i / side / side, i / side % side, i % side) - radius;
            if place.length_squared() <= radius * radius {
                level.places.push(place);
                level.bricks.push([density; 512]);
            }
        }
        level
    }

    #[test]
    fn what_lies_deeper_has_less_light_whatever_the_density() {
        let level = ball(6, 1.0);
        let lit = light(&level, 1.0);
        let at = |place: IVec3| lit[level.places.iter().position(|p| *p == place).unwrap()];
        // The blocks of a row of bricks from the middle to the outside.
        let along: Vec<f32> = (0..=6)
            .flat_map(|x| (0..4).map(move |i| (x, i)))
            .map(|(x, i)| at(IVec3::new(x, 0, 0))[i << 4])
            .collect();
        assert!(along[2..].is_sorted(), "{along:?}");
        assert!(along[2] <= 0.06 * along[27], "{along:?}");
        // Thirteen bricks across, a column of which has the whole depth.
        let extinction = OPTICAL_DEPTH / (13.0 * 4.0);
        assert!((0.3 * extinction..extinction).contains(&along[27]), "{along:?}");
        let mirrored = |x: i32| at(IVec3::new(0, 0, x));
        assert_eq!(mirrored(3)[2], at(IVec3::new(3, 0, 0))[2 << 4]);
        // The thinner, the more the same error counts.
        for density in [1e-30, 1e30] {
            let scaled = light(&ball(6, density), density).into_iter();
            assert!(scaled.zip(&lit).all(|(a, b)| a.iter().zip(b).all(|(a, b)| (a / b - 1.0).abs() < 1e-5)));
            let [thin, dense] = [0.5 * density, density].map(|value| light(&ball(1, value), density)[0][0]);
            assert!((thin / dense - 2.0).abs() < 1e-5);
        }
    }

    #[test]
    fn tiles_cast_shadows_and_what_is_too_large_is_all_lit() {
        let mut level = ball(0, 1.0);
        let alone = light(&level, 1.0);
        level.tiles.push((IVec3::splat(1), TileSize::Node4, 1.0));
        let shaded = light(&level, 1.0);
        assert!(shaded.len() == 1 && shaded[0][63] != alone[0][63]);
        level.tiles.push((IVec3::splat(1 << 20), TileSize::Brick, 1.0));
        assert_eq!(light(&level, 1.0), [[1.0; 64]]);
        assert!(light(&Level::default(), 1.0).is_empty());
    }
}
