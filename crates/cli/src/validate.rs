//! `nuage validate`: whether files are sound, and what is odd about them.
//!
//! What is looked at lives in [`nuage_vdb::validate`]; here it is put into lines and an exit code.

use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use nuage_vdb::validate::{Report, Severity, validate};
use serde_json::{Value, json};

use crate::error::Failure;
use crate::frames;
use crate::json::text;
use crate::source::{DiskFile, Memory};
use crate::text::{one_line, thousands};

/// Say whether VDB and NanoVDB files are sound, and what is wrong with those that are not.
///
/// Each file is read whole. Of a damaged one, one line says what is wrong and at which byte. Of others, findings follow:
/// errors (the file contradicts itself), warnings (likely a mistake of whoever wrote it) and notes (unusual). The
/// program fails if a file is damaged or has errors.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The files to look at
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    /// Fail on warnings too
    #[arg(long)]
    strict: bool,

    /// Print one JSON object per file, one per line: file, valid, error, grids, active_voxels, findings
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    memory: Memory,
}

/// Prints a verdict on each file.
///
/// # Errors
/// If one is not sound, after all have been looked at.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let mut out = BufWriter::new(io::stdout().lock());
    let mut all_sound = true;
    for path in &args.files {
        let outcome = look_at(path, args.memory);
        let sound = outcome.as_ref().is_ok_and(|report| is_sound(report, args.strict));
        all_sound &= sound;
        match args.json {
            true => writeln!(out, "{}", as_json(path, sound, &outcome))?,
            false => print(&mut out, path, sound, &outcome)?,
        }
    }
    out.flush()?;
    if all_sound { Ok(()) } else { Err(Failure::Reported) }
}

fn look_at(path: &Path, memory: Memory) -> Result<Report, String> {
    let words = |failure: Failure| match failure {
        Failure::File { what, .. } => what,
        other => other.to_string(),
    };
    if let Some((file, None)) = frames::packed(path) {
        // The frames behind the first one as well.
        frames::check(&file).map_err(words)?;
    }
    let disk = DiskFile::open(path).map_err(words)?;
    validate(&disk, memory.limits).map_err(|error| error.to_string())
}

fn is_sound(report: &Report, strict: bool) -> bool {
    report.count(Severity::Error) == 0 && !(strict && report.count(Severity::Warning) > 0)
}

fn print(out: &mut impl Write, path: &Path, sound: bool, outcome: &Result<Report, String>) -> io::Result<()> {
    let path = one_line(&path.display().to_string());
    let report = match outcome {
        Ok(report) => report,
        Err(error) => return writeln!(out, "{path}: {}", one_line(error)),
    };
    let plural = |count: usize, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
    let verdict = if sound { "valid" } else { "not valid" };
    let grids = plural(report.grids, "grid");
    let mut counts = vec![grids, format!("{} active voxels", thousands(report.active_voxels))];
    for severity in [Severity::Error, Severity::Warning] {
        let count = report.count(severity);
        if count > 0 {
            counts.push(plural(count, &severity.to_string()));
        }
    }
    writeln!(out, "{path}: {verdict} ({})", counts.join(", "))?;
    for finding in &report.findings {
        let grid = finding.grid.as_ref().map(|name| format!("grid '{name}': ")).unwrap_or_default();
        writeln!(out, "  {}: {}", finding.severity, one_line(&format!("{grid}{}", finding.what)))?;
    }
    Ok(())
}

fn as_json(path: &Path, sound: bool, outcome: &Result<Report, String>) -> Value {
    let path = text(path.as_os_str().as_encoded_bytes());
    match outcome {
        Err(error) => json!({ "file": path, "valid": false, "error": error }),
        Ok(report) => {
            let finding = |finding: &nuage_vdb::validate::Finding| {
                let grid = finding.grid.as_ref().map(|name| text(name.as_bytes()));
                json!({ "severity": finding.severity.to_string(), "grid": grid, "what": finding.what })
            };
            json!({
                "file": path,
                "valid": sound,
                "error": null,
                "grids": report.grids,
                "active_voxels": report.active_voxels,
                "findings": report.findings.iter().map(finding).collect::<Vec<Value>>(),
            })
        }
    }
}
