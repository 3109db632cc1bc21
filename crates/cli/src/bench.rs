//! `nuage bench`: how long pictures of a file take on a device, and what they look up.
//!
//! Each kind of picture is made some times, of which the median counts; what is compiled or filled for the first is left out.
//! The pictures themselves are those of `nuage render` with the same options; none is kept.

use std::io::{self, BufWriter, Write};
use std::path::PathBuf;
use std::time::Instant;

use clap::{Parser, ValueEnum};
use nuage_vdb::GridInfo;
use serde_json::{Value, json};

use crate::device::{self, Gpu};
use crate::error::Failure;
#[cfg(feature = "gpu")]
use crate::frames;
use crate::look::{Integrator, Look, View};
use crate::shot::{self, Shot, Volume};
use crate::source::DiskFile;
use crate::text::{number, one_line, size, thousands};
use crate::values::Size;

/// Measure how long pictures of a file take, and what their rays look up.
///
/// Times are medians, of timestamps of the device where it has them, else of the clock. A ray is a walk through the volume: of a
/// camera ray, a shadow ray or a stretch of a path. Look-ups are of what stands at a brick; values are of voxels, eight to a
/// trilinear sample. Only a GPU counts these.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The file: smoke.vdb or smoke.nuage; smoke.nuage#12 is frame 12
    #[arg(value_name = "FILE")]
    input: PathBuf,

    /// The density grid [default: density, else the first fog volume, level set or float grid]
    #[arg(long, value_name = "NAME")]
    grid: Option<String>,

    /// What renders: cpu, gpu for the best graphics card, or a part of a card's name
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: String,

    /// What is drawn, several with commas between them
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        value_name = "KIND",
        default_value = "density,depth,march,path"
    )]
    kinds: Vec<Kind>,

    /// Size of the pictures in pixels, WIDTHxHEIGHT
    #[arg(long, value_name = "WxH", default_value = "640x360")]
    size: Size,

    /// Pictures of each kind that are measured
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,

    /// Pictures of each kind that are made before these
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(0..=1000))]
    warm_up: u32,

    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// What is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// The density along each ray, exact
    Density,
    /// The first voxel above 0
    Depth,
    /// Light scattered once
    March,
    /// One path per pixel, scattered any number of times
    Path,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Kind::Density => "density",
            Kind::Depth => "depth",
            Kind::March => "march",
            Kind::Path => "path",
        }
    }

    /// The options of `nuage render` for it.
    fn look(self, size: Size) -> Result<Look, Failure> {
        #[derive(Parser)]
        #[command(no_binary_name = true)]
        struct Options {
            #[command(flatten)]
            look: Look,
        }
        let options = Options::try_parse_from(["--spp", "1"]);
        let mut look = options.map_err(|e| Failure::Usage(e.to_string()))?.look;
        look.size = size;
        match self {
            Kind::Density => look.view = Some(View::Density),
            Kind::Depth => look.view = Some(View::Depth),
            Kind::March => look.integrator = Integrator::March,
            Kind::Path => look.integrator = Integrator::Path,
        }
        Ok(look)
    }
}

/// What was measured of one kind.
struct Row {
    kind: Kind,
    /// The median.
    frame_ms: f64,
    /// Per pixel, where the device counts: rays, look-ups, values.
    counts: Option<[f64; 3]>,
}

/// What was measured of a device.
struct Bench {
    device: String,
    /// Whether times are the device's own.
    has_timestamps: bool,
    upload_ms: Option<f64>,
    /// Bytes by what they hold.
    memory: Vec<(&'static str, u64)>,
    rows: Vec<Row>,
}

/// Measures, and prints what came out.
///
/// # Errors
/// If the file cannot be read, there is no such device, or it cannot draw the file.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let gpu = device::open(&args.device)?;
    let disk = DiskFile::open(&args.input)?;
    let file = disk.vdb()?;
    let (density, _) = shot::choose_grids(&file, args.grid.as_deref(), None, None)
        .map_err(|e| Failure::file(&args.input, e))?;
    let volume = shot::load_grids(&file, args.grid.as_deref(), None, None, &mut |_| {})
        .map_err(|e| Failure::file(&args.input, e))?;
    let mut volumes = [volume];
    let mut shots = Vec::with_capacity(args.kinds.len());
    for kind in &args.kinds {
        let shot = Shot::new(&kind.look(args.size)?, volumes[0].world_box(), &volumes);
        shots.push((*kind, shot.map_err(Failure::Usage)?));
    }
    let [volume] = &mut volumes;
    let bench = match &gpu {
        None => on_the_processor(args, volume, &shots)?,
        Some(gpu) => on_a_gpu(gpu, args, volume, &file.grids[density], &shots)?,
    };
    let mut out = BufWriter::new(io::stdout().lock());
    match args.json {
        true => writeln!(out, "{}", bench.json(args))?,
        false => bench.print(args, &mut out)?,
    }
    Ok(out.flush()?)
}

/// The median of what a run takes, after some that do not count.
fn median<E>(args: &Args, mut run: impl FnMut() -> Result<f64, E>) -> Result<f64, E> {
    for _ in 0..args.warm_up {
        run()?;
    }
    let mut times = (0..args.repeats).map(|_| run()).collect::<Result<Vec<f64>, E>>()?;
    times.sort_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}

fn ms(start: Instant) -> f64 {
    1e3 * start.elapsed().as_secs_f64()
}

fn on_the_processor(args: &Args, volume: &Volume, shots: &[(Kind, Shot)]) -> Result<Bench, Failure> {
    let mut rows = Vec::with_capacity(shots.len());
    for (kind, shot) in shots {
        let frame_ms = median(args, || {
            let start = Instant::now();
            shot.render_frame(&[Some(volume)], &|_, _| ()).map(|_| ms(start))
        });
        let frame_ms = frame_ms.map_err(|e| Failure::Usage(e.to_string()))?;
        rows.push(Row { kind: *kind, frame_ms, counts: None });
    }
    let tree = &volume.density.tree;
    Ok(Bench {
        device: format!("cpu, {} threads", rayon::current_num_threads()),
        has_timestamps: false,
        upload_ms: None,
        memory: vec![("trees", tree.topology_bytes() as u64), ("bricks", tree.bricks.size_bytes() as u64)],
        rows,
    })
}

#[cfg(feature = "gpu")]
fn on_a_gpu(
    gpu: &Gpu,
    args: &Args,
    volume: &Volume,
    grid: &GridInfo,
    shots: &[(Kind, Shot)],
) -> Result<Bench, Failure> {
    use nuage_gpu::measure::{Took, time};
    use nuage_gpu::renderer::Renderer;
    use nuage_gpu::upload;
    let failed = |error: nuage_gpu::error::GpuError| Failure::file(&args.input, error.to_string());
    let arrays = arrays(gpu, args, volume, grid)?;
    let start = Instant::now();
    let uploaded = upload::Volume::new(gpu, &arrays).map_err(failed)?;
    gpu.wait().map_err(failed)?;
    let upload_ms = ms(start);
    let mut renderer = Renderer::new(gpu, [args.size.width, args.size.height]).map_err(failed)?;
    let pixels = f64::from(args.size.width) * f64::from(args.size.height);
    let (mut rows, mut has_timestamps) = (Vec::with_capacity(shots.len()), true);
    for (kind, shot) in shots {
        let (look, pass) = shot.pass(&[Some(volume)]).map_err(failed)?;
        renderer.prepare(&uploaded, &look, &pass, 0, None).map_err(failed)?;
        let frame_ms = median(args, || {
            let Took { wall, device } = time(gpu, &mut renderer, &uploaded)?;
            has_timestamps &= device.is_some();
            Ok(1e3 * device.unwrap_or(wall).as_secs_f64())
        });
        let frame_ms = frame_ms.map_err(failed)?;
        let counts = renderer.count(&uploaded, &look, &pass, 0).map_err(failed)?;
        let counts = [counts.rays, counts.regions, counts.values].map(|count| count as f64 / pixels);
        rows.push(Row { kind: *kind, frame_ms, counts: Some(counts) });
    }
    let size = uploaded.size_bytes();
    Ok(Bench {
        device: gpu.name().to_owned(),
        has_timestamps,
        upload_ms: Some(upload_ms),
        memory: vec![
            ("trees", size.trees),
            ("bricks", size.bricks),
            ("textures", size.textures),
            ("tables", size.tables),
        ],
        rows,
    })
}

/// What is uploaded: of a packed file its bricks as they are stored, those of blocks in textures if the device reads them, unless it is a level set, which becomes a fog.
#[cfg(feature = "gpu")]
fn arrays(
    gpu: &Gpu,
    args: &Args,
    volume: &Volume,
    grid: &GridInfo,
) -> Result<nuage_gpu::arrays::Arrays, Failure> {
    use nuage_gpu::arrays::{Arrays, Meaning, Wanted};
    let failed = |error: &dyn std::fmt::Display| Failure::file(&args.input, error.to_string());
    let arrays = match frames::packed(&args.input) {
        Some((path, wanted)) if grid.grid_class() != "level set" => {
            let mut asset = frames::open(&path)?;
            let mut all = 0..asset.contents().frames.len();
            let is_wanted =
                |frame: &usize| wanted.is_none_or(|wanted| frames::number(&asset, *frame) == wanted);
            let frame = all.find(is_wanted).unwrap_or(0);
            frames::load_frame(&mut asset, frame).map_err(|error| failed(&error))?;
            let wanted = [Wanted { name: grid.name.clone(), meaning: Meaning::Density }];
            let form = gpu.smallest_bricks().map_err(|error| failed(&error))?;
            Arrays::of_asset(&asset, &wanted, frame..frame + 1, form)
        }
        _ => Arrays::of_channels(&[&volume.density]),
    };
    arrays.map_err(|error| failed(&error))
}

/// As above; without the feature `gpu` there is no device to call it with.
#[cfg(not(feature = "gpu"))]
fn on_a_gpu(
    gpu: &Gpu,
    _args: &Args,
    _volume: &Volume,
    _grid: &GridInfo,
    _shots: &[(Kind, Shot)],
) -> Result<Bench, Failure> {
    match *gpu {}
}

impl Bench {
    /// Camera rays a second.
    fn rays_per_second(args: &Args, row: &Row) -> f64 {
        f64::from(args.size.width) * f64::from(args.size.height) / (1e-3 * row.frame_ms)
    }

    fn clock(&self) -> &'static str {
        if self.has_timestamps { "timestamps of the device" } else { "the clock" }
    }

    fn print(&self, args: &Args, out: &mut impl Write) -> io::Result<()> {
        let Size { width, height } = args.size;
        writeln!(
            out,
            "{} on {}, {width} × {height}",
            one_line(&args.input.display().to_string()),
            one_line(&self.device)
        )?;
        writeln!(out, "  times        medians of {}, by {}", args.repeats, self.clock())?;
        if let Some(upload_ms) = self.upload_ms {
            writeln!(out, "  upload       {} ms", number(upload_ms))?;
        }
        for (name, bytes) in &self.memory {
            writeln!(out, "  {name:12} {}", size(*bytes))?;
        }
        writeln!(
            out,
            "  {:8}{:>12}{:>16}{:>14}{:>16}{:>14}",
            "", "ms", "camera rays/s", "rays/pixel", "look-ups/pixel", "values/pixel"
        )?;
        for row in &self.rows {
            let rays = thousands(Self::rays_per_second(args, row) as u64);
            write!(out, "  {:8}{:>12}{rays:>16}", row.kind.name(), format!("{:.3}", row.frame_ms))?;
            if let Some([rays, regions, values]) = row.counts {
                write!(out, "{rays:>14.2}{regions:>16.2}{values:>14.2}")?;
            }
            writeln!(out)?;
        }
        Ok(())
    }

    fn json(&self, args: &Args) -> Value {
        let row = |row: &Row| {
            let count = |i: usize| row.counts.map(|counts| counts[i]);
            json!({
                "kind": row.kind.name(),
                "frame_ms": row.frame_ms,
                "camera_rays_per_second": Self::rays_per_second(args, row),
                "rays_per_pixel": count(0),
                "look_ups_per_pixel": count(1),
                "values_per_pixel": count(2),
            })
        };
        let memory = self.memory.iter().map(|(name, bytes)| ((*name).to_owned(), json!(bytes)));
        json!({
            "file": args.input.display().to_string(),
            "device": self.device,
            "size": [args.size.width, args.size.height],
            "repeats": args.repeats,
            "has_timestamps": self.has_timestamps,
            "upload_ms": self.upload_ms,
            "memory_bytes": memory.collect::<serde_json::Map<String, Value>>(),
            "kinds": self.rows.iter().map(row).collect::<Vec<Value>>(),
        })
    }
}
