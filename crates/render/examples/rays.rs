//! Our side of `bench/rays_vs_nanovdb.sh`: one kernel over all pixels of a picture, timed.
//!
//! `cargo run --release -p nuage-render --example rays -- FILE.vdb KERNEL THREADS REPEATS [SIZE [PICTURE.f32 [SEED]]]`
//! prints one line: `median_ms=... min_ms=... cpu_ms=... mean=...`. Reading the file is not timed, and one picture is made before
//! the first that is. The view, the kernels and the picture are those of `bench/peers/nanovdb_rays.cc`, which says more; what it calls
//! `surface` is `voxel` here, for it finds the first voxel behind the surface, and `surface` is where the interpolation reaches it.

#![allow(clippy::print_stdout, reason = "the line printed is what the program is for")]

use std::error::Error;
use std::time::Instant;

use glam::{DVec2, DVec3, IVec3, Vec3};
use nuage_pipeline::import::{import, import_surface};
use nuage_render::camera::{Camera, Ray};
use nuage_render::filter::Filter;
use nuage_render::hash::{hash_pixel, hash_u32, unit_f32};
use nuage_render::packet::{
    RAYS, Surface, first_collisions, first_voxels, optical_depths, stepped_transmittances,
};
use nuage_render::picture::each_tile;
use nuage_render::tiling::Tiling;
use nuage_render::traverse::{Field, Reader};
use nuage_testkit::clock::processor_ms;
use nuage_volume::channel::Channel;

/// Per voxel at density 1.
const EXTINCTION_PER_VOXEL: f64 = 0.1;
const STEP_VOXELS: f32 = 0.5;

/// The channel of a file's first grid, and the value at its surface if it is a level set that is to be drawn.
fn channel(path: &str, is_surface: bool) -> Result<(Channel, f32), Box<dyn Error>> {
    let bytes = std::fs::read(path)?;
    let file = nuage_vdb::File::open(bytes.as_slice())?;
    let grid = file.read_all()?.into_iter().next().ok_or("the file has no grid")?;
    Ok(match is_surface {
        true => import_surface(grid)?,
        false => (import(grid)?.0, 0.0),
    })
}

/// Makes the tiles of a picture, packet by packet. Gives how many milliseconds it took.
fn picture<'a>(
    field: &Field<'a>,
    tiling: Tiling,
    kernel: &Kernel<'_, 'a>,
    tiles: &mut [Vec<[f32; RAYS]>],
) -> f64 {
    let begin = Instant::now();
    each_tile(
        tiles,
        || field.reader(),
        |reader, tile, values: &mut Vec<[f32; RAYS]>| {
            values.clear();
            values.extend(tiling.squares(tile).map(|pixels| kernel(reader, pixels)));
        },
    );
    begin.elapsed().as_secs_f64() * 1e3
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    0.5 * (values[values.len() / 2] + values[(values.len() - 1) / 2])
}

/// What a kernel makes of the pixels of a packet.
type Kernel<'r, 'a> = Box<dyn Fn(&mut Reader<'a>, [[u32; 2]; RAYS]) -> [f32; RAYS] + Sync + 'r>;

/// The cosine between a ray and the slope at a voxel, over its neighbours along each axis. Voxels are taken to be cubes.
fn facing(reader: &mut Reader<'_>, voxel: IVec3, ray: &Ray) -> f32 {
    let mut along = |axis| reader.walker.voxel(voxel + axis) - reader.walker.voxel(voxel - axis);
    let slope = Vec3::new(along(IVec3::X), along(IVec3::Y), along(IVec3::Z));
    slope.normalize_or_zero().dot(ray.direction.as_vec3()).abs()
}

fn kernel_of<'r, 'a: 'r>(
    kernel: &str,
    field: &'r Field<'a>,
    rays: impl Fn(&[[u32; 2]; RAYS]) -> [Ray; RAYS] + Sync + 'r,
    extinction: f32,
    voxel_size: f64,
    level: f32,
    seed: u32,
) -> Result<Kernel<'r, 'a>, Box<dyn Error>> {
    let filter = if matches!(kernel, "nearest" | "exact") { Filter::Nearest } else { Filter::Trilinear };
    Ok(match kernel {
        "nearest" | "trilinear" => Box::new(move |reader, pixels| {
            let passes =
                stepped_transmittances(field, reader, &rays(&pixels), filter, STEP_VOXELS, extinction);
            passes.map(|passes| 1.0 - passes)
        }),
        "exact" | "cubic" => Box::new(move |reader, pixels| {
            let depths = optical_depths(field, reader, &rays(&pixels), filter);
            depths.map(|depth| 1.0 - (-extinction * depth).exp())
        }),
        "track" => Box::new(move |reader, pixels| {
            let paths = pixels.map(|[x, y]| hash_pixel(x, y, 0, hash_u32(seed)));
            let mut counts = [0_u32; RAYS];
            let random = |ray: usize| {
                counts[ray] += 1;
                unit_f32(hash_u32(paths[ray].wrapping_add(counts[ray])))
            };
            let hits = first_collisions(field, reader, &rays(&pixels), extinction, random);
            hits.map(|hit| f32::from(hit.is_some()))
        }),
        "voxel" | "voxel-shaded" => {
            let is_shaded = kernel == "voxel-shaded";
            Box::new(move |reader, pixels| {
                let rays = rays(&pixels);
                let hits = first_voxels(field, reader, &rays, level);
                std::array::from_fn(|i| {
                    hits[i].map_or(0.0, |hit| match is_shaded {
                        true => facing(reader, hit.voxel, &rays[i]),
                        false => (hit.distance / voxel_size) as f32,
                    })
                })
            })
        }
        "surface" | "surface-shaded" => {
            let is_shaded = kernel == "surface-shaded";
            let surface = Surface::new(field, level);
            Box::new(move |reader, pixels| {
                let rays = rays(&pixels);
                let hits = surface.first_hits(reader, &rays);
                std::array::from_fn(|i| {
                    hits[i].map_or(0.0, |hit| match is_shaded {
                        true => hit.normal.dot(rays[i].direction.as_vec3()).abs(),
                        false => (hit.distance / voxel_size) as f32,
                    })
                })
            })
        }
        _ => return Err(format!("no kernel '{kernel}'").into()),
    })
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [path, kernel, threads, repeats, rest @ ..] = arguments.as_slice() else {
        return Err("usage: rays FILE.vdb KERNEL THREADS REPEATS [SIZE [PICTURE.f32 [SEED]]]".into());
    };
    let repeats: usize = repeats.parse()?;
    let size: u32 = rest.first().map_or(Ok(1024), |size| size.parse())?;
    let seed: u32 = rest.get(2).map_or(Ok(0), |seed| seed.parse())?;
    let (channel, level) = channel(path, kernel.starts_with("surface") || kernel.starts_with("voxel"))?;
    let field = Field::new(&channel).ok_or("the grid is empty")?;
    let active = channel.active_box.ok_or("the grid is empty")?;
    let (low, extent) = (active.min.as_dvec3(), (active.max - active.min + 1).as_dvec3());
    // Voxels of NanoVDB's nearest filter begin at their place; ours are centred on it.
    let shift =
        if matches!(kernel.as_str(), "nearest" | "exact" | "voxel" | "voxel-shaded") { 0.5 } else { 0.0 };
    let target = low + 0.5 * extent - shift;
    let eye = target + DVec3::new(0.0, 0.0, 2.0 * extent.z);
    let world = |p: DVec3| channel.world_from_index.transform_point3(p);
    let camera = Camera::look_at(world(eye), world(target), DVec3::Y, 45.0).ok_or("no view")?;
    let voxel_size = channel.world_from_index.matrix3.x_axis.length();
    let extinction = (EXTINCTION_PER_VOXEL / voxel_size) as f32;
    let rays = |pixels: &[[u32; 2]; RAYS]| -> [Ray; RAYS] {
        camera.rays(&pixels.map(|[x, y]| DVec2::new(x.into(), y.into()) + 0.5), size, size)
    };
    let kernel = kernel_of(kernel, &field, rays, extinction, voxel_size, level, seed)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.parse()?).build()?;
    let (mut times, mut cpu_times) = (Vec::new(), Vec::new());
    let tiling = Tiling { width: size, height: size };
    let mut tiles = vec![Vec::new(); tiling.count() as usize];
    for turn in 0..=repeats {
        let cpu = processor_ms();
        let time = pool.install(|| picture(&field, tiling, &kernel, &mut tiles));
        if turn > 0 {
            times.push(time);
            cpu_times.push(processor_ms() - cpu);
        }
    }
    if times.is_empty() {
        return Err("nothing was timed".into());
    }
    let mut values = vec![0.0_f32; size as usize * size as usize];
    for (tile, tile_values) in (0..).zip(&tiles) {
        for ([x, y], value) in tiling.squares(tile).flatten().zip(tile_values.as_flattened()) {
            // Packets may reach over the edge.
            if x < size && y < size {
                values[(y * size + x) as usize] = *value;
            }
        }
    }
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / values.len() as f64;
    let (time, cpu) = (median(&mut times), median(&mut cpu_times));
    println!("median_ms={time:.3} min_ms={:.3} cpu_ms={cpu:.3} mean={mean:.6}", times[0]);
    if let Some(path) = rest.get(1) {
        std::fs::write(path, values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())?;
    }
    Ok(())
}
