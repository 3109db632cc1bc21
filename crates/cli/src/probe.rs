//! `nuage probe`: value, active state and depth at index coordinates of one grid.

use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::PathBuf;

use nuage_vdb::{AnyTree, Value, Voxel, format_g, with_tree};

use crate::error::Failure;
use crate::grid::find_grid;
use crate::json;
use crate::source::{DiskFile, Memory};

/// Print value, active state and depth at index coordinates of a grid.
///
/// One line per coordinate: I J K, the value in enough digits to be exact, `active` or `inactive`, and the depth
/// at which the value is stored: -1 background, 0 tile of the root, 1 and 2 tiles of inner nodes, 3 leaf.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The file to read
    file: PathBuf,

    /// The grid to probe [default: the file's only grid]
    #[arg(long, value_name = "NAME")]
    grid: Option<String>,

    /// Index coordinates in threes; without any, one `I J K` per line is read from standard input
    ///
    /// On standard input, blanks or commas separate numbers; empty lines and lines that begin with # are skipped.
    #[arg(value_name = "I J K", allow_negative_numbers = true)]
    coordinates: Vec<i32>,

    /// Print one JSON object per coordinate, one per line: ijk, v, on, depth
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    memory: Memory,
}

/// Longer lines are no coordinates, and must not fill the memory.
const MAX_LINE_BYTES: u64 = 4096;

/// Prints what the grid says at each coordinate.
///
/// # Errors
/// If the grid cannot be read, or a line of standard input is no coordinate.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let (triples, rest) = args.coordinates.as_chunks::<3>();
    if !rest.is_empty() {
        return Err(Failure::Usage(format!(
            "{} index coordinates are not a multiple of three: give I J K for each voxel",
            args.coordinates.len()
        )));
    }
    let disk = DiskFile::open(&args.file)?;
    let file = disk.any(args.memory)?;
    let index = find_grid(&file, args.grid.as_deref()).map_err(|what| Failure::file(disk.path(), what))?;
    let tree = file.read_grid(index).map_err(|error| Failure::vdb(disk.path(), &error))?.tree;
    let mut out = BufWriter::new(io::stdout().lock());
    if triples.is_empty() {
        probe_lines(io::stdin().lock(), &mut out, &tree, args.json)?;
    }
    for ijk in triples {
        with_tree!(&*tree, tree => print(&mut out, *ijk, tree.voxel(*ijk), args.json))?;
    }
    Ok(out.flush()?)
}

fn print<V: Value>(out: &mut impl Write, ijk: [i32; 3], voxel: Voxel<V>, as_json: bool) -> io::Result<()> {
    if as_json {
        return writeln!(out, "{}", json::probe(ijk, voxel));
    }
    let [i, j, k] = ijk;
    let state = if voxel.active { "active" } else { "inactive" };
    writeln!(out, "{i} {j} {k}  {}  {state}  {}", spelled(voxel.value), voxel.depth)
}

/// A value in enough digits to be exact; the numbers of a vector with commas between them.
pub(crate) fn spelled<V: Value>(value: V) -> String {
    let digits = if matches!(V::NAME, "float" | "vec3s" | "half") { 9 } else { 17 };
    match V::NAME {
        "int64" => json::exact(value).to_string(),
        _ => {
            let numbers: Vec<String> =
                (0..V::COMPONENTS).map(|i| format_g(value.component(i), digits)).collect();
            numbers.join(",")
        }
    }
}

fn probe_lines(input: impl Read, out: &mut impl Write, tree: &AnyTree, as_json: bool) -> Result<(), Failure> {
    let mut input = BufReader::new(input);
    let mut bytes = Vec::new();
    for line in 1.. {
        // Whoever asks line by line gets each answer before the next question.
        if input.buffer().is_empty() {
            out.flush()?;
        }
        bytes.clear();
        let wrong = |what: String| Failure::Input { line, what };
        let read = input.by_ref().take(MAX_LINE_BYTES).read_until(b'\n', &mut bytes);
        let len = read.map_err(|error| wrong(format!("cannot read: {error}")))?;
        if len == 0 {
            break;
        }
        let text = String::from_utf8_lossy(&bytes);
        let ijk = coordinates(&text).and_then(|ijk| match ijk {
            Some(_) if len as u64 == MAX_LINE_BYTES => Err("the line is too long".to_owned()),
            ijk => Ok(ijk),
        });
        match ijk {
            Ok(Some(ijk)) => with_tree!(tree, tree => print(out, ijk, tree.voxel(ijk), as_json))?,
            Ok(None) => {}
            Err(what) => {
                out.flush()?;
                return Err(wrong(what));
            }
        }
    }
    Ok(())
}

/// The index coordinate on a line, if there is one.
fn coordinates(line: &str) -> Result<Option<[i32; 3]>, String> {
    let line = line.trim();
    if line.is_empty() || line.starts_with('#') {
        return Ok(None);
    }
    let separator = |c: char| c == ',' || c.is_whitespace();
    let numbers: Result<Vec<i32>, _> =
        line.split(separator).filter(|word| !word.is_empty()).map(str::parse).collect();
    numbers.ok().and_then(|numbers| numbers.try_into().ok()).map(Some).ok_or_else(|| {
        let shown: String = line.chars().take(40).collect();
        format!("'{shown}' is not an index coordinate; write three whole numbers, as in 1 -2 3")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_a_coordinate_or_nothing_or_wrong() {
        for line in ["1 -2 3", " 1,-2,3\r\n", "1, -2, 3", "1\t-2\t3\n"] {
            assert_eq!(coordinates(line), Ok(Some([1, -2, 3])), "{line}");
        }
        assert_eq!(coordinates("-2147483648 2147483647 0"), Ok(Some([i32::MIN, i32::MAX, 0])));
        for line in ["", " \n", "# 1 2 3", "  #"] {
            assert_eq!(coordinates(line), Ok(None), "{line}");
        }
        for line in ["1 2", "1 2 3 4", "1 2 x", "1.5 2 3", "2147483648 0 0", "1 2 3 # three"] {
            assert!(coordinates(line).unwrap_err().contains("three whole numbers"), "{line}");
        }
    }
}
