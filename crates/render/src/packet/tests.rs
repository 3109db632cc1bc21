//! Packets against single rays, against other packets, and on each kind of vector instructions.

use fearless_simd::Level;
use nuage_volume::brick::Bricks;
use nuage_volume::channel::Channel;

use super::*;
use crate::depth::{optical_depth, stepped_transmittance};
use crate::filter::Filter;
use crate::fixtures::{channel, random, rays};
use crate::simd::levels;
use crate::surface::{first_hit, first_voxel};
use crate::track::first_collision;

const FILTERS: [Filter; 2] = [Filter::Nearest, Filter::Trilinear];
const LEVEL: f32 = 0.45;

/// The same in half floats, as near as these get.
fn halves(channel: Channel) -> Channel {
    let Bricks::F32(values) = &channel.tree.bricks else { return channel };
    let values = values.iter().map(|value| half::f16::from_f32(*value).to_bits()).collect();
    let mut channel = Channel { tree: channel.tree.clone(), ..channel };
    channel.tree.bricks = Bricks::F16(values);
    channel
}

fn packets() -> Vec<[Ray; RAYS]> {
    let rays: Vec<Ray> = rays().collect();
    rays.as_chunks().0.to_vec()
}

/// Each kernel's results for a packet, as bits.
fn all(level: Level, field: &Field<'_>, rays: &[Ray; RAYS]) -> Vec<[u64; RAYS]> {
    let reader = &mut field.reader();
    let mut found = Vec::new();
    for filter in FILTERS {
        found.push(lines::optical_depths_at(level, field, reader, rays, filter).map(|x| x.to_bits().into()));
        let passes = lines::stepped_transmittances_at(level, field, reader, rays, filter, 0.5, 0.3);
        found.push(passes.map(|x| x.to_bits().into()));
    }
    // The numbers of a ray are its own, wherever it stands.
    let seeds = rays.map(|ray| ray.origin.x.to_bits() as u32 ^ ray.direction.y.to_bits() as u32);
    let mut counts = [0_u32; RAYS];
    let numbers = |ray: usize| {
        counts[ray] += 1;
        random(seeds[ray].wrapping_add(counts[ray]))
    };
    let collisions = tracks::first_collisions_at(level, field, reader, rays, 0.3, numbers);
    found.push(collisions.map(|t| t.map_or(0, f64::to_bits)));
    let voxels = voxels::first_voxels_at(level, field, reader, rays, LEVEL);
    found
        .push(voxels.map(|hit| hit.map_or(0, |hit| hit.distance.to_bits() ^ u64::from(hit.value.to_bits()))));
    let hits = Surface::new(field, LEVEL).first_hits_at(level, reader, rays);
    found.push(hits.map(|hit| hit.map_or(0, |hit| hit.distance.to_bits())));
    found.push(hits.map(|hit| hit.map_or(0, |hit| hit.normal.x.to_bits().into())));
    found
}

#[test]
fn all_levels_give_the_same_bits() {
    for channel in [channel(), halves(channel())] {
        let field = Field::new(&channel).unwrap();
        for rays in packets() {
            let expected = all(Level::new(), &field, &rays);
            for level in levels() {
                assert_eq!(all(level, &field, &rays), expected);
            }
        }
    }
}

#[test]
fn a_ray_is_the_same_in_any_company() {
    let channel = channel();
    let field = Field::new(&channel).unwrap();
    let packets = packets();
    for (i, rays) in packets.iter().enumerate() {
        let alone = all(Level::new(), &field, rays);
        let others = &packets[(i + 1) % packets.len()];
        let mixed: [Ray; RAYS] =
            std::array::from_fn(|lane| if lane % 3 == 0 { others[lane] } else { rays[RAYS - 1 - lane] });
        for (alone, mixed) in alone.iter().zip(all(Level::new(), &field, &mixed)) {
            for lane in (0..RAYS).filter(|lane| lane % 3 != 0) {
                assert_eq!(mixed[lane], alone[RAYS - 1 - lane]);
            }
        }
    }
}

#[test]
fn packets_find_what_single_rays_find() {
    for channel in [channel(), halves(channel())] {
        let field = Field::new(&channel).unwrap();
        let by_tree = Field::new(&channel).unwrap().without_map();
        let (mut reader, mut tree_reader) = (field.reader(), by_tree.reader());
        let (mut sum, mut hits, mut voxels) = (0.0, 0, 0);
        for rays in packets() {
            for filter in FILTERS {
                let depths = optical_depths(&field, &mut reader, &rays, filter);
                let passes = stepped_transmittances(&field, &mut reader, &rays, filter, 0.5, 0.3);
                for lane in 0..RAYS {
                    let ray = &rays[lane];
                    let depth = optical_depth(&by_tree, &mut tree_reader, ray, filter);
                    assert!(
                        (depths[lane] - depth).abs() < 3e-5 * (1.0 + depth),
                        "{ray:?}: {} {depth}",
                        depths[lane]
                    );
                    let passed = stepped_transmittance(&by_tree, &mut tree_reader, ray, filter, 0.5, 0.3);
                    // A sample at the very face of a brick may fall to either side.
                    assert!((passes[lane] - passed).abs() < 0.02, "{ray:?}: {} {passed}", passes[lane]);
                    sum += depth;
                }
            }
            let found = first_voxels(&field, &mut reader, &rays, LEVEL);
            for (ray, found) in rays.iter().zip(found) {
                let single = first_voxel(&field, &mut reader, ray, LEVEL);
                voxels += u32::from(match (found, single) {
                    (Some(found), Some(single)) => {
                        found.voxel == single.voxel && (found.distance - single.distance).abs() < 1e-3
                    }
                    (found, single) => found.is_none() && single.is_none(),
                });
            }
            let found = Surface::new(&field, LEVEL).first_hits(&mut reader, &rays);
            for (ray, found) in rays.iter().zip(found) {
                let single = first_hit(&field, &mut reader, ray, LEVEL);
                assert_eq!(found.is_some(), single.is_some(), "{ray:?}: {found:?} {single:?}");
                let (Some(found), Some(single)) = (found, single) else { continue };
                hits += 1;
                // Ends of cells differ by rounding, and a ray that just touches a surface may pass it there.
                if (found.distance - single.distance).abs() > 2e-4 {
                    hits -= 1;
                    continue;
                }
                assert!(found.normal.dot(single.normal) > 0.99, "{ray:?}: {found:?} {single:?}");
            }
        }
        assert!(sum > 10.0, "{sum}");
        // A ray along an edge between voxels may take either.
        assert!(voxels >= 188, "{voxels} of 192");
        assert!(hits > 90, "{hits}");
    }
}

/// Rays that take their numbers in the same order collide at the same places.
#[test]
fn collisions_are_those_of_single_rays() {
    let channel = channel();
    let field = Field::new(&channel).unwrap();
    let mut reader = field.reader();
    let (mut hits, mut same) = (0, 0);
    for (i, rays) in packets().iter().enumerate() {
        let number = |ray: usize, count: u32| random(i as u32 * 100_000 + ray as u32 * 1000 + count);
        let mut counts = [0_u32; RAYS];
        let numbers = |ray: usize| {
            counts[ray] += 1;
            number(ray, counts[ray])
        };
        let found = first_collisions(&field, &mut reader, rays, 0.4, numbers);
        for lane in 0..RAYS {
            let mut count = 0;
            let numbers = || {
                count += 1;
                number(lane, count)
            };
            let single = first_collision(&field, &mut reader, &rays[lane], 0.4, numbers);
            hits += u32::from(single.is_some());
            same += u32::from(match (found[lane], single) {
                (Some(found), Some(single)) => (found - single).abs() < 1e-3,
                (found, single) => found.is_none() && single.is_none(),
            });
        }
    }
    assert!(hits > 50, "{hits}");
    // Rounding decides now and then whether a collision counts.
    assert!(same >= 190, "{same} of 192");
}

#[test]
fn rays_that_make_no_sense_find_nothing() {
    let channel = channel();
    let field = Field::new(&channel).unwrap();
    let good = rays().next().unwrap();
    for number in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, 1e300] {
        for axis in 0..6 {
            let mut rays = [good; RAYS];
            match axis {
                0..3 => rays[5].origin[axis] = number,
                _ => rays[5].direction[axis - 3] = number,
            }
            let found = all(Level::new(), &field, &rays);
            let expected = all(Level::new(), &field, &[good; RAYS]);
            for (found, expected) in found.iter().zip(&expected) {
                assert_eq!(found[0], expected[0], "{number} {axis}");
                assert_eq!(found[15], expected[15], "{number} {axis}");
            }
        }
    }
}
