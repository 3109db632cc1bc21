//! What a ray costs, by the resolution of the same cloud: `cargo bench -p nuage-render --bench cost [-- --plot docs/cost.svg]`.
//!
//! Prints two tables in Markdown. The first: bricks and look-ups of a ray and its time, from 128³ to 1024³ voxels, where cost should
//! grow as the number of bricks that the ray crosses. The second: rays about a voxel apart at every resolution, then the rays of the
//! first table in the order of the picture and in none, whose difference is what memory takes. Resolutions may be named:
//! `-- 128 1024`. `--plot` draws the first table.
//!
//! Time is that of the processor where the system tells it, since machines are shared. Cycles are told from a chain of
//! multiplications timed beside each kernel, so that they stay right when the clock changes.

#![allow(clippy::print_stdout, reason = "the tables printed are what the program is for")]

use std::error::Error;
use std::hint::black_box;

use glam::{DAffine3, DVec2, DVec3, IVec3, Vec3};
use half::f16;
use nuage_render::camera::{Camera, Ray};
use nuage_render::filter::Filter;
use nuage_render::hash::{hash_u32, unit_f32};
use nuage_render::packet::{RAYS, SIDE, first_collisions, optical_depths, stepped_transmittances};
use nuage_render::tiling::Tiling;
use nuage_render::traverse::{Field, Reader};
use nuage_testkit::clock::processor_ms;
use nuage_volume::accessor::Accessor;
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::TreeBuilder;
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::BRICK_VOXELS;
use rayon::prelude::*;

const RESOLUTIONS: [i32; 4] = [128, 256, 512, 1024];
/// The sides of the picture.
const SIZE: u32 = 1024;
/// Of the rays in no order one in so many is timed.
const SHUFFLED_PART: usize = 16;
/// The cycles of a multiplication and of an exclusive or on the processors of the last decade.
const CHAIN_CYCLES: f64 = 4.0;
/// A kernel is timed so often, and the median counts; each time for so long at least, since processor time is told in steps.
const ROUNDS: usize = 3;
const ROUND_NS: f64 = 3e8;
/// The cloud is as large as this in the world whatever its resolution, and through its middle of so much optical depth.
const WIDTH: f64 = 1.0;
const EXTINCTION: f32 = 20.0;
const STEP_VOXELS: f32 = 0.5;
const KERNELS: [&str; 5] = ["nearest", "trilinear", "exact", "cubic", "track"];

/// Noise of one size, from 0 to 1: random numbers at whole places, interpolated.
fn noise(p: Vec3, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let [x, y, z] = (f * f * (3.0 - 2.0 * f)).to_array();
    let at = |d: IVec3| {
        let c = (cell.as_ivec3() + d).as_uvec3();
        unit_f32(hash_u32(c.x ^ hash_u32(c.y ^ hash_u32(c.z ^ seed))))
    };
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let along_z = |x, y| mix(at(IVec3::new(x, y, 0)), at(IVec3::new(x, y, 1)), z);
    let along_y = |x| mix(along_z(x, 0), along_z(x, 1), y);
    mix(along_y(0), along_y(1), x)
}

/// A cloud in the cube from -1 to 1.
fn density(p: Vec3) -> f32 {
    let radius = p.length();
    if radius >= 1.0 {
        return 0.0;
    }
    let octaves = (0..5).map(|i| noise((p + 4.0) * (2 << i) as f32, i) / (2 << i) as f32);
    (2.0 * (octaves.sum::<f32>() - 0.35) + 0.8 * (0.7 - radius)).clamp(0.0, 1.0)
}

fn cloud(resolution: i32) -> Result<Channel, Box<dyn Error>> {
    let across = resolution / 8;
    let places: Vec<IVec3> = (0..across.pow(3))
        .map(|i| IVec3::new(i / across / across, i / across % across, i % across))
        .collect();
    let brick = |place: &IVec3| -> Option<(IVec3, BrickSummary, [u16; BRICK_VOXELS])> {
        let values: [f32; BRICK_VOXELS] = std::array::from_fn(|i| {
            let voxel = *place * 8 + IVec3::new(i as i32 >> 6, i as i32 >> 3 & 7, i as i32 & 7);
            let p = (voxel.as_vec3() + 0.5) * (2.0 / resolution as f32) - 1.0;
            f16::from_f32(density(p)).to_f32()
        });
        let is_empty = values.iter().all(|value| *value == 0.0);
        (!is_empty).then(|| (*place, BrickSummary::of(&values), values.map(|v| f16::from_f32(v).to_bits())))
    };
    let mut builder = TreeBuilder::new();
    let mut all = Vec::new();
    // Some at a time, so that only the bricks themselves are all in memory.
    for places in places.chunks(1 << 14) {
        for (place, summary, values) in places.par_iter().filter_map(brick).collect::<Vec<_>>() {
            builder.brick(place, summary)?;
            all.extend(values);
        }
    }
    let world_from_index = DAffine3::from_scale(DVec3::splat(WIDTH / f64::from(resolution)));
    let active_box = Some(IndexBox { min: IVec3::ZERO, max: IVec3::splat(resolution - 1) });
    Ok(Channel { tree: builder.finish(Bricks::F16(all))?, world_from_index, active_box })
}

fn work<'a>(kernel: &str, field: &Field<'a>, reader: &mut Reader<'a>, rays: &[Ray; RAYS], seed: u32) -> f32 {
    let values = match kernel {
        "nearest" => stepped_transmittances(field, reader, rays, Filter::Nearest, STEP_VOXELS, EXTINCTION),
        "trilinear" => {
            stepped_transmittances(field, reader, rays, Filter::Trilinear, STEP_VOXELS, EXTINCTION)
        }
        "exact" => optical_depths(field, reader, rays, Filter::Nearest),
        "cubic" => optical_depths(field, reader, rays, Filter::Trilinear),
        _ => {
            let mut counts = [0; RAYS];
            let random = |ray: usize| {
                counts[ray] += 1;
                unit_f32(hash_u32(seed.wrapping_add(64 * ray as u32 + counts[ray])))
            };
            first_collisions(field, reader, rays, EXTINCTION, random).map(|t| t.map_or(0.0, |t| t as f32))
        }
    };
    values.iter().sum()
}

/// What a ray meets: bricks that are not empty, its length in them in voxels, and the cells that it crosses there.
fn met<'a>(field: &Field<'a>, accessor: &mut Accessor<'a>, ray: &Ray) -> [f64; 3] {
    let Some([start, end]) = field.interval(ray) else { return [0.0; 3] };
    let local = field.local(ray, start);
    let direction = field.directions() * ray.direction.as_vec3();
    let mut runs = field.runs(accessor, local, 0.0, (end - start) as f32);
    let (mut bricks, mut length) = (0.0, 0.0);
    while let Some(segment) = runs.next_segment() {
        bricks += 1.0;
        length += f64::from(segment.t1 - segment.t0);
    }
    let along = direction.abs().element_sum();
    [bricks, length * f64::from(direction.length()), length * f64::from(along)]
}

/// The nanoseconds of a cycle now.
fn cycle_ns() -> f64 {
    const PRODUCTS: u32 = 1 << 27;
    let factor = black_box(0xbf58_476d_1ce4_e5b9_u64);
    let begin = processor_ms();
    // Each product waits for the one before.
    let product = (0..PRODUCTS).fold(factor, |product, i| product.wrapping_mul(factor) ^ u64::from(i));
    black_box(product);
    (processor_ms() - begin) * 1e6 / f64::from(PRODUCTS) / CHAIN_CYCLES
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The nanoseconds of a ray on one thread.
fn ray_ns<'a>(kernel: &str, field: &Field<'a>, rays: &[Ray]) -> f64 {
    let mut reader = field.reader();
    let mut ns_of = |passes: u32| {
        let begin = processor_ms();
        for pass in 0..passes {
            let packets = rays.as_chunks::<RAYS>().0.iter().zip(0..);
            let sum: f32 =
                packets.map(|(rays, i)| work(kernel, field, &mut reader, rays, 1024 * i + pass)).sum();
            black_box(sum);
        }
        (processor_ms() - begin) * 1e6 / f64::from(passes)
    };
    // Bricks are decoded by the first who meets them.
    ns_of(1);
    let passes = (ROUND_NS / ns_of(1).max(1e6)).ceil() as u32;
    median((0..ROUNDS).map(|_| ns_of(passes)).collect()) / rays.len() as f64
}

/// The rays of a picture of so many pixels across, a multiple of a packet's, tile by tile as the renderer makes it.
fn picture_rays(side: u32) -> Result<Vec<Ray>, Box<dyn Error>> {
    let middle = DVec3::splat(0.5 * WIDTH);
    let camera = Camera::look_at(middle + DVec3::new(0.9, 0.5, 1.4) * WIDTH, middle, DVec3::Y, 40.0)
        .ok_or("no view")?;
    let tiling = Tiling { width: side, height: side };
    let pixels = (0..tiling.count()).flat_map(|tile| tiling.squares(tile)).flatten();
    let place = |[x, y]: [u32; 2]| DVec2::new(f64::from(x), f64::from(y)) + 0.5;
    Ok(pixels.map(|pixel| camera.ray(place(pixel), side, side)).collect())
}

/// Some of them in an order that no cache knows.
fn shuffled(rays: &[Ray]) -> Vec<Ray> {
    let mut order: Vec<u32> = (0..rays.len() as u32).collect();
    order.sort_by_key(|i| hash_u32(*i));
    order.iter().step_by(SHUFFLED_PART).map(|i| rays[*i as usize]).collect()
}

/// A line per kernel, the bricks that a ray crosses to the right and its nanoseconds upwards, both in logarithms.
fn plot(resolutions: &[i32], points: &[(f64, Vec<f64>)]) -> String {
    let (width, height, margin) = (560.0, 360.0, 60.0);
    let last = points.len() - 1;
    let range = |values: Vec<f64>| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        (low.ln() - 0.1, values.into_iter().fold(0.0, f64::max).ln() + 0.1)
    };
    let (x0, x1) = range(points.iter().map(|(bricks, _)| *bricks).collect());
    let (y0, y1) = range(points.iter().flat_map(|(_, ns)| ns.clone()).collect());
    let x = |bricks: f64| margin + (bricks.ln() - x0) / (x1 - x0) * (width - 2.0 * margin - 40.0);
    let y = |ns: f64| height - margin - (ns.ln() - y0) / (y1 - y0) * (height - 2.0 * margin);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    let text = |x: f64, y: f64, anchor: &str, text: &str| {
        format!("<text x=\"{x:.0}\" y=\"{y:.0}\" text-anchor=\"{anchor}\">{text}</text>\n")
    };
    for ((bricks, ns), resolution) in points.iter().zip(resolutions) {
        svg += &text(x(*bricks), height - margin + 18.0, "middle", &format!("{resolution}³"));
        svg += &text(x(*bricks), height - margin + 34.0, "middle", &format!("{bricks:.1}"));
        svg += &text(margin - 8.0, y(ns[3]) + 4.0, "end", &format!("{:.0}", ns[3]));
    }
    svg += &text(0.5 * width, height - 8.0, "middle", "bricks that a ray crosses");
    svg += &text(8.0, 20.0, "start", "ns per ray (figures: cubic)");
    // From the top down, so that names of lines which end together stand below each other.
    let (end, end_ns) = &points[last];
    let mut order: Vec<usize> = (0..KERNELS.len()).collect();
    order.sort_by(|a, b| end_ns[*b].total_cmp(&end_ns[*a]));
    let mut free_from = 0.0;
    for i in order {
        let colour = format!("hsl({},70%,40%)", 72 * i);
        let line: String = points.iter().map(|(b, ns)| format!("{:.1},{:.1} ", x(*b), y(ns[i]))).collect();
        svg +=
            &format!("<polyline points=\"{line}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>\n");
        let label = f64::max(y(end_ns[i]) + 4.0, free_from);
        svg += &text(x(*end) + 6.0, label, "start", KERNELS[i]);
        free_from = label + 13.0;
    }
    // As fast as bricks grow, from the first point of the first kernel.
    let (first, first_ns) = (points[0].0, points[0].1[0]);
    svg += &format!(
        "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"grey\" stroke-dasharray=\"4\"/>\n",
        x(first),
        y(first_ns),
        x(*end),
        y(first_ns * end / first)
    );
    svg + "</svg>\n"
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let plot_file = arguments.iter().position(|a| a == "--plot").and_then(|i| arguments.get(i + 1));
    let named: Vec<i32> = arguments.iter().filter_map(|argument| argument.parse().ok()).collect();
    let resolutions = if named.is_empty() { RESOLUTIONS.to_vec() } else { named };
    let rays = picture_rays(SIZE)?;
    let scattered = shuffled(&rays);
    let mut points = Vec::new();
    let mut order_rows = Vec::new();
    println!(
        "| voxels | bricks | MB | bricks per ray | kernel | look-ups per ray | ns per ray | ns per brick | ns per look-up | cycles per look-up |"
    );
    println!("| ---: | ---: | ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: |");
    for resolution in &resolutions {
        let channel = cloud(*resolution)?;
        let field = Field::new(&channel).ok_or("no cloud")?;
        // A picture of as many pixels across as the cloud has voxels: rays lie as far apart at every resolution.
        let apart = picture_rays(resolution.unsigned_abs().next_multiple_of(SIDE))?;
        let mut accessor = Accessor::new(&channel.tree);
        let mut sums = [0.0; 3];
        for ray in &rays {
            let met = met(&field, &mut accessor, ray);
            sums.iter_mut().zip(met).for_each(|(sum, met)| *sum += met / rays.len() as f64);
        }
        let [bricks, voxels, cells] = sums;
        let stored = channel.tree.node4.entries.len();
        let mut all = Vec::new();
        for kernel in KERNELS {
            let (ns, cycle) = (ray_ns(kernel, &field, &rays), cycle_ns());
            let look_ups = match kernel {
                "nearest" | "trilinear" => Some(voxels / f64::from(STEP_VOXELS)),
                "exact" | "cubic" => Some(cells),
                _ => None,
            };
            let of_look_up = look_ups.map_or("– | – | –".to_owned(), |count| {
                format!("{:.1} | {:.2} | {:.1}", ns / bricks, ns / count, ns / count / cycle)
            });
            let count = look_ups.map_or("–".to_owned(), |count| format!("{count:.0}"));
            let megabytes = (stored * BRICK_VOXELS * 2) as f64 * 1e-6;
            println!(
                "| {resolution}³ | {stored} | {megabytes:.0} | {bricks:.1} | {kernel} | {count} | {ns:.0} | {of_look_up} |"
            );
            let (apart_ns, shuffled_ns) =
                (ray_ns(kernel, &field, &apart), ray_ns(kernel, &field, &scattered));
            order_rows.push(format!(
                "| {resolution}³ | {kernel} | {apart_ns:.0} | {ns:.0} | {shuffled_ns:.0} | {:.2} |",
                shuffled_ns / ns
            ));
            all.push(ns);
        }
        points.push((bricks, all));
    }
    println!(
        "\n| voxels | kernel | ns per ray, a voxel apart | in order | shuffled | shuffled to in order |\n| ---: | --- | ---: | ---: | ---: | ---: |"
    );
    order_rows.iter().for_each(|row| println!("{row}"));
    if let Some(file) = plot_file {
        // Cargo runs benchmarks in the folder of their package.
        let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
        std::fs::write(std::path::Path::new(root).join(file), plot(&resolutions, &points))?;
    }
    Ok(())
}
