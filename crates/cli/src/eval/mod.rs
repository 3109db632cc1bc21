//! `nuage eval`: the tables of a master's thesis on rendering VDB files, for any models, and ours beside them.
//!
//! The options and the order of work live here; the tables' rows in [`tables`], the models in [`model`], the pictures
//! in [`picture`], and what the tables look like in [`table`]. The schemes themselves are the pipeline's.

mod model;
mod picture;
mod table;
mod tables;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use nuage_pipeline::output::write_whole;

use crate::convert::check_absent;
use crate::error::Failure;
use crate::eval::model::names;
use crate::eval::table::Table;
use crate::eval::tables::Tables;
use crate::progress;

/// Hold ways to store volumes against each other: sizes, errors and what is seen of them
///
/// For each channel of each model: the size of its tree, the errors of its bricks in several formats and in packed files,
/// what clustering saves, and how node sizes matter. The tables are those of R. de Winther's thesis, Volumetric data
/// structures for real-time ray tracing (2023), with its schemes and ours side by side.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The models: .vdb files, or frames of packed files
    #[arg(required = true, value_name = "MODELS")]
    models: Vec<PathBuf>,

    /// Where to write the tables as Markdown [default: standard output]
    #[arg(short, long, value_name = "FILE.md")]
    output: Option<PathBuf>,

    /// Where to write the tables as CSV as well: one FILE.csv, or a folder that gets a file for each
    #[arg(long, value_name = "FILE.csv|FOLDER")]
    csv: Option<PathBuf>,

    /// Width and height of the pictures that are compared, in pixels
    #[arg(long, value_name = "W", default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=8192))]
    size: u32,

    /// The tables to make [default: all]
    #[arg(long = "table", value_name = "TABLE")]
    tables: Vec<Wanted>,

    /// Replace files that are there
    #[arg(long)]
    force: bool,
}

/// A table that can be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Wanted {
    /// Sizes of trees: the thesis' table 3
    Trees,
    /// Formats of bricks: the thesis' table 18g
    Formats,
    /// Bricks that share their values: the thesis' table 19e
    Clusters,
    /// Node sizes
    Topology,
}

/// Evaluates.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let csv_files = csv_files(args);
    for path in args.output.iter().chain(csv_files.iter().map(|(path, _)| path)) {
        check_absent(path, args.force)?;
    }
    let is_wanted = |table| args.tables.is_empty() || args.tables.contains(&table);
    let mut tables = Tables::new(args.size, &is_wanted);
    let bar = progress::bar(args.models.len());
    let mut outcome = Ok(());
    for (i, (path, name)) in args.models.iter().zip(names(&args.models)).enumerate() {
        bar.set_message(name.clone());
        let count = model::channels(path, &name, &mut |model| tables.add(&model));
        outcome = count.and_then(|count| match count {
            0 => Err(Failure::file(path, "there is no grid of numbers with bricks to evaluate")),
            _ => Ok(()),
        });
        if outcome.is_err() {
            break;
        }
        progress::show(&bar, i, 1, 1);
    }
    bar.finish_and_clear();
    outcome?;
    write(args, &tables.finish(), &csv_files)
}

/// The files that get tables as CSV, and the table of each; `None` for all.
fn csv_files(args: &Args) -> Vec<(PathBuf, Option<Wanted>)> {
    let all = [Wanted::Trees, Wanted::Formats, Wanted::Clusters, Wanted::Topology];
    match &args.csv {
        None => Vec::new(),
        Some(path) if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv")) && !path.is_dir() => {
            vec![(path.clone(), None)]
        }
        Some(folder) => {
            let wanted =
                all.into_iter().filter(|table| args.tables.is_empty() || args.tables.contains(table));
            wanted.map(|table| (folder.join(format!("{}.csv", table.name())), Some(table))).collect()
        }
    }
}

impl Wanted {
    /// The name of the table in files.
    fn name(self) -> &'static str {
        match self {
            Wanted::Trees => "trees",
            Wanted::Formats => "formats",
            Wanted::Clusters => "clusters",
            Wanted::Topology => "topology",
        }
    }
}

/// Writes the tables.
fn write(args: &Args, tables: &[Table], csv_files: &[(PathBuf, Option<Wanted>)]) -> Result<(), Failure> {
    let whole = |path: &Path, text: &str| {
        write_whole(path, text.as_bytes(), args.force).map_err(|error| Failure::file(path, error.to_string()))
    };
    let markdown = tables.iter().map(Table::markdown).collect::<Vec<_>>().join("\n");
    match &args.output {
        Some(path) => whole(path, &markdown)?,
        None => io::stdout().lock().write_all(markdown.as_bytes())?,
    }
    for (path, wanted) in csv_files {
        let text = match wanted {
            None => tables.iter().map(|table| table.csv(true)).collect::<Vec<_>>().join("\n"),
            Some(wanted) => {
                if let Some(folder) = path.parent() {
                    let made = std::fs::create_dir_all(folder);
                    made.map_err(|error| Failure::file(folder, format!("cannot make the folder: {error}")))?;
                }
                let table = tables.iter().find(|table| table.name == wanted.name());
                table.map(|table| table.csv(false)).unwrap_or_default()
            }
        };
        whole(path, &text)?;
    }
    Ok(())
}
