//! Where light collides first along a ray, by delta tracking: the seam of [`path`](crate::path) by itself.
//!
//! Tentative collisions come at the rate of a brick's largest extinction, each real with the chance of the extinction there over
//! it (Woodcock et al., "Techniques used in the GEM code", 1965).

use fearless_simd::{Simd, dispatch};
use nuage_volume::brick::Bounds;

use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::depth::{block_of, interpolate};
use crate::math::ln;
use crate::simd::level;
use crate::traverse::{Field, LocalRay, Reader};
use crate::walk::{Sight, SortedRay, SpanContent, Spans, with_spans};

/// The distance at which a ray collides with a medium of `extinction` at value 1, per world length; `None` if it passes. Over
/// many rays the share that passes is `exp(-extinction × optical depth)`, with trilinear interpolation.
///
/// `random` gives numbers from 0 to less than 1 by 2⁻²⁴ or more, each once.
pub fn first_collision<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    extinction: f32,
    mut random: impl FnMut() -> f32,
) -> Option<f64> {
    dispatch!(level(), simd => simd.vectorize(
        #[inline(always)]
        || {
            let entered = field.enter(ray, 0.0)?;
            let [start, end] = entered.interval;
            let sorted = SortedRay::new(entered.local(start));
            let length = (end - start) as f32;
            let Reader { walker, blocks, .. } = reader;
            let t = with_spans!(simd, Sight::Cells, field, walker, &sorted, length, |spans| {
                collide(field, blocks, &sorted.local, spans, extinction, &mut random)
            })?;
            Some(start + f64::from(t))
        }
    ))
}

#[inline(always)]
fn collide<'a>(
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    local: &LocalRay,
    mut spans: impl Spans,
    extinction: f32,
    random: &mut impl FnMut() -> f32,
) -> Option<f32> {
    // What is left of the optical depth up to the next tentative collision.
    let mut depth = -ln(1.0 - random());
    while let Some(span) = spans.next_span() {
        let max = match span.content {
            SpanContent::Constant(value) => value,
            SpanContent::Brick(entry) => field.bounds(entry).max,
            SpanContent::TileBorder => field.tile_bounds(span.corner).max,
        };
        let majorant = max * extinction;
        let mut t = span.t0;
        loop {
            let left = (span.t1 - t) * majorant;
            if depth >= left {
                depth -= left;
                break;
            }
            t += depth / majorant;
            let value = match block_of(field, blocks, &span) {
                Ok(block) => interpolate(block, local.at(t) - span.corner),
                Err(_) => return Some(t),
            };
            if random() * max < value {
                return Some(t);
            }
            depth = -ln(1.0 - random());
        }
    }
    None
}

impl Field<'_> {
    /// Bounds of the interpolation in the brick of an entry.
    #[inline(always)]
    pub(crate) fn bounds(&self, entry: u32) -> Bounds {
        self.tree().node4.footprints[entry as usize]
    }

    /// Bounds of the interpolation in a brick of a tile.
    #[cold]
    fn tile_bounds(&self, corner: glam::Vec3) -> Bounds {
        self.tree().region(self.brick_at(corner)).footprint
    }
}
