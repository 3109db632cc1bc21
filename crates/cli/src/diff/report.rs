//! What differs between two files, or two sequences, in lines and as JSON.

use std::io::{self, Write};

use nuage_vdb::diff::{Disagreement, Errors, VoxelDifference};
use serde_json::{Map, Value, json};

use super::{Args, Compared, ComparedFiles, Frames, Total};
use crate::json::{number as json_number, text};
use crate::text::{number, one_line, thousands};

const AXES: [&str; 3] = ["x", "y", "z"];

/// Prints how two files differ, with notes of what does not count if `with_notes` is set.
pub(super) fn print_files(
    out: &mut impl Write,
    files: &ComparedFiles,
    args: &Args,
    with_notes: bool,
) -> io::Result<()> {
    for (side, names) in ["A", "B"].iter().zip(&files.only) {
        for name in names {
            writeln!(out, "{}: only in {side}", one_line(name))?;
        }
    }
    let counts = |d: &Disagreement| d.counts && !args.values_only;
    if files.of_files.iter().any(|d| with_notes || counts(d)) {
        writeln!(out, "the files:")?;
        print_disagreements(out, &files.of_files, args, with_notes)?;
    }
    files.grids.iter().try_for_each(|grid| print_grid(out, grid, args, with_notes))
}

/// Prints how two sequences differ, frame by frame and then on the whole.
pub(super) fn print_sequence(
    out: &mut impl Write,
    frames: &Frames,
    compared: &[ComparedFiles],
    totals: &[Total],
    args: &Args,
) -> io::Result<()> {
    for (pair, files) in frames.both.iter().zip(compared) {
        let number = pair.number.unwrap_or_default();
        match files.equal {
            true => writeln!(out, "frame {number}: equal")?,
            false => {
                writeln!(out, "frame {number}: different")?;
                print_files(out, files, args, false)?;
            }
        }
    }
    writeln!(out, "all {} frames:", compared.len())?;
    for total in totals {
        writeln!(out, "{}:", one_line(&total.name))?;
        print_counts(out, &total.voxels, args)?;
        let frame = total.worst.map_or(String::new(), |frame| format!(" of frame {frame}"));
        print_errors(out, &total.voxels, total.components, total.is_level_set, &frame)?;
    }
    for (side, only) in ["A", "B"].iter().zip(&frames.only) {
        if !only.is_empty() {
            let numbers: Vec<String> = only.iter().map(i64::to_string).collect();
            writeln!(out, "frames only in {side}: {}", numbers.join(", "))?;
        }
    }
    Ok(())
}

fn print_grid(out: &mut impl Write, compared: &Compared, args: &Args, with_notes: bool) -> io::Result<()> {
    let Compared { name, difference, .. } = compared;
    let verdict = if compared.equal { "equal" } else { "different" };
    writeln!(out, "{}: {verdict}", one_line(name))?;
    print_disagreements(out, &difference.disagreements, args, with_notes)?;
    let Some(found) = &difference.voxels else {
        return writeln!(
            out,
            "  voxels: not compared, since the types or the shapes of the trees do not match"
        );
    };
    print_counts(out, found, args)?;
    print_errors(out, found, compared.components, compared.is_level_set, "")?;
    if with_notes && found.nodes_only_in_a + found.nodes_only_in_b > 0 {
        let [a, b] = [found.nodes_only_in_a, found.nodes_only_in_b].map(thousands);
        writeln!(out, "  (note) topology: {a} nodes and leaves only in A, {b} only in B")?;
    }
    for [ijk, a, b] in &compared.voxels {
        writeln!(out, "  {ijk}: {a} | {b}")?;
    }
    Ok(())
}

/// Prints how many voxels differ.
fn print_counts(out: &mut impl Write, found: &VoxelDifference, args: &Args) -> io::Result<()> {
    let active = thousands(found.active);
    let beyond = match args.tolerance > 0.0 {
        true => format!(" by more than {}", number(args.tolerance)),
        false => String::new(),
    };
    if found.differing_values > 0 {
        let count = thousands(found.differing_values);
        writeln!(out, "  values: {count} of {active} active voxels differ{beyond}")?;
    }
    if found.differing_inactive_values > 0 {
        let count = thousands(found.differing_inactive_values);
        writeln!(out, "  values: {count} voxels that are inactive in both differ{beyond}")?;
    }
    if found.differing_states > 0 {
        writeln!(out, "  states: {} voxels are active in one alone", thousands(found.differing_states))?;
    }
    if found.not_finite > 0 {
        writeln!(out, "  values: {} voxels are NaN or infinite in one alone", thousands(found.not_finite))?;
    }
    Ok(())
}

/// Prints how large the errors are, of vectors also those of each component.
fn print_errors(
    out: &mut impl Write,
    found: &VoxelDifference,
    components: usize,
    is_level_set: bool,
    frame: &str,
) -> io::Result<()> {
    let all = found.errors();
    let Some(ijk) = all.max_at else { return Ok(()) };
    let line = |errors: &Errors| {
        let [largest, mean, rms, psnr] = [errors.max, errors.mean(), errors.rms(), errors.psnr()].map(number);
        let [a, b] = errors.max_values.map(number);
        let at = errors.max_at.map_or(String::new(), |ijk| format!(" at {ijk:?} ({a} | {b})"));
        format!("at most {largest}{at}, mean {mean}, RMS {rms}, PSNR {psnr} dB")
    };
    if components == 1 {
        let place = format!(" at {ijk:?}");
        writeln!(out, "  error: {}", line(&all).replacen(&place, &format!("{place}{frame}"), 1))?;
    } else {
        let [largest, mean, rms, psnr] = [all.max, all.mean(), all.rms(), all.psnr()].map(number);
        writeln!(
            out,
            "  error: at most {largest} at {ijk:?}{frame}, mean {mean}, RMS {rms}, PSNR {psnr} dB"
        )?;
        for (axis, errors) in AXES.iter().zip(&found.components).take(components) {
            writeln!(out, "  error of {axis}: {}", line(errors))?;
        }
    }
    if let Some(ijk) = all.fog_at {
        writeln!(out, "  fog: at most {} from the background, at {ijk:?}", number(all.fog))?;
    }
    if is_level_set && all.sign_changes > 0 {
        writeln!(out, "  signs: {} voxels are inside in one alone", thousands(all.sign_changes))?;
    }
    Ok(())
}

fn print_disagreements(
    out: &mut impl Write,
    disagreements: &[Disagreement],
    args: &Args,
    with_notes: bool,
) -> io::Result<()> {
    for Disagreement { what, a, b, counts } in disagreements {
        let counts = *counts && !args.values_only;
        if !counts && !with_notes {
            continue;
        }
        let mark = if counts { "" } else { "(note) " };
        let [a, b] = [a, b].map(|side| one_line(side.as_deref().unwrap_or("nothing")));
        writeln!(out, "  {mark}{}: {a} | {b}", one_line(what))?;
    }
    Ok(())
}

/// How two files differ, as an object.
pub(super) fn files_json(files: &ComparedFiles) -> Value {
    let [only_a, only_b] =
        files.only.each_ref().map(|names| names.iter().map(|n| text(n.as_bytes())).collect::<Vec<_>>());
    json!({
        "equal": files.equal,
        "only_a": only_a,
        "only_b": only_b,
        "file": disagreements_json(&files.of_files),
        "grids": files.grids.iter().map(grid_json).collect::<Vec<_>>(),
    })
}

/// How two sequences differ, as an object.
pub(super) fn sequence_json(frames: &Frames, compared: &[ComparedFiles], totals: &[Total]) -> Value {
    let frame = |(pair, files): (&super::Pair, &ComparedFiles)| {
        let mut object = files_json(files);
        object["frame"] = json!(pair.number);
        object
    };
    let total = |total: &Total| {
        let mut voxels = voxels_json(&total.voxels, total.components);
        voxels.insert("worst_frame".into(), json!(total.worst));
        json!({ "name": text(total.name.as_bytes()), "voxels": voxels })
    };
    json!({
        "frames": frames.both.iter().zip(compared).map(frame).collect::<Vec<_>>(),
        "frames_only_a": frames.only[0],
        "frames_only_b": frames.only[1],
        "total": totals.iter().map(total).collect::<Vec<_>>(),
    })
}

fn disagreements_json(disagreements: &[Disagreement]) -> Vec<Value> {
    let one = |Disagreement { what, a, b, counts }: &Disagreement| json!({ "what": what, "a": a, "b": b, "counts": counts });
    disagreements.iter().map(one).collect()
}

fn grid_json(compared: &Compared) -> Value {
    let voxels = compared.difference.voxels.as_ref().map(|found| {
        let mut voxels = voxels_json(found, compared.components);
        voxels.insert("nodes_only_in_a".into(), json!(found.nodes_only_in_a));
        voxels.insert("nodes_only_in_b".into(), json!(found.nodes_only_in_b));
        voxels.insert("first".into(), json!(compared.voxels_json));
        voxels
    });
    json!({
        "name": text(compared.name.as_bytes()),
        "equal": compared.equal,
        "disagreements": disagreements_json(&compared.difference.disagreements),
        "voxels": voxels,
    })
}

/// The counts, the errors, and of vectors those of each component.
fn voxels_json(found: &VoxelDifference, components: usize) -> Map<String, Value> {
    let mut object = Map::new();
    for (name, count) in [
        ("active", found.active),
        ("differing_values", found.differing_values),
        ("differing_inactive_values", found.differing_inactive_values),
        ("differing_states", found.differing_states),
        ("not_finite", found.not_finite),
    ] {
        object.insert(name.into(), json!(count));
    }
    object.extend(errors_json(&found.errors()));
    if components > 1 {
        let each = found.components.iter().take(components).map(|errors| Value::Object(errors_json(errors)));
        object.insert("components".into(), each.collect());
    }
    object
}

fn errors_json(errors: &Errors) -> Map<String, Value> {
    let values = errors.max_at.map(|_| errors.max_values.map(json_number));
    let entries = [
        ("max_error", json_number(errors.max)),
        ("max_error_at", json!(errors.max_at)),
        ("max_error_values", json!(values)),
        ("mean_error", json_number(errors.mean())),
        ("rms_error", json_number(errors.rms())),
        ("peak", json_number(errors.peak)),
        ("psnr", json_number(errors.psnr())),
        ("fog", json_number(errors.fog)),
        ("fog_at", json!(errors.fog_at)),
        ("sign_changes", json!(errors.sign_changes)),
    ];
    entries.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}
