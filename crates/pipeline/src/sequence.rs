//! Which files make up a sequence: what users of Houdini, Nuke and Blender type, turned into a list of frames, and
//! back into the name of an output file.
//!
//! Accepted are one file, a folder, a glob, and a name with a frame token: `smoke.####.vdb`, `smoke.%04d.vdb`,
//! `smoke.$F4.vdb`. Nothing here opens a file; reading grids belongs to `nuage-vdb`, writing files to
//! [`crate::output`].

use std::fs;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf, is_separator};
use std::str::FromStr;

use thiserror::Error;

/// The most frames that a [`FrameRange`] may ask for.
pub const MAX_RANGE_FRAMES: usize = 1_000_000;

/// The widest zero padding that a frame token may ask for, in digits.
const MAX_WIDTH: usize = 32;

/// Why no list of frames, or no name for an output, could be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SequenceError {
    /// The caller's frame range can't be read, or asks for too much.
    #[error(
        "`{text}` is not a range of frames: {what}; write `5`, `1-100` or `1-100x2`, or several with commas, as in \
         `1-10,20,30-40x5`"
    )]
    Range {
        /// The range as it was given.
        text: String,
        /// What is wrong with it.
        what: String,
    },
    /// The caller's pattern can't be read.
    #[error("the pattern `{pattern}` can't be read: {what}")]
    Pattern {
        /// The pattern as it was given.
        pattern: String,
        /// What is wrong with it and how to mend it.
        what: String,
    },
    /// No file fits what the caller asked for.
    #[error("no file matches `{pattern}`: {hint}")]
    NothingFound {
        /// The path or pattern as it was given.
        pattern: String,
        /// What lies there instead.
        hint: String,
    },
    /// Files fit the pattern, but the caller's range leaves out every one of them.
    #[error("`{pattern}` matches frames {first} to {last}, none of which is in the asked range")]
    NotInRange {
        /// The pattern as it was given.
        pattern: String,
        /// The first frame that is there.
        first: i64,
        /// The last frame that is there.
        last: i64,
    },
    /// The caller asked for a range of frames of what is one file.
    #[error("a range of frames was asked for, but `{}` is one file; {hint}", path.display())]
    RangeOfOneFile {
        /// The file.
        path: PathBuf,
        /// How to ask for its sequence.
        hint: String,
    },
    /// Two files claim the same frame.
    #[error(
        "frame {frame} is there twice: `{}` and `{}`; say where in the name the frame number stands, as in \
         `smoke.####.vdb`, or remove one of them",
        first.display(), second.display()
    )]
    SameFrame {
        /// The frame number.
        frame: i64,
        /// One file.
        first: PathBuf,
        /// The other file.
        second: PathBuf,
    },
    /// One of several files has no frame number, so that its place in time is unknown.
    #[error(
        "`{}` has no frame number, but is one of {count} files that match; name it alone, or write a pattern that \
         leaves it out, as in `smoke.####.vdb`",
        path.display()
    )]
    Unnumbered {
        /// The file without a number.
        path: PathBuf,
        /// How many files match.
        count: usize,
    },
    /// A folder holds more than one sequence.
    #[error("the folder `{}` holds more than one sequence: {}; name one of them", folder.display(), patterns.join(", "))]
    SeveralSequences {
        /// The folder.
        folder: PathBuf,
        /// A pattern for each of the first few sequences in it.
        patterns: Vec<String>,
    },
    /// Every frame of a sequence would be written to one file.
    #[error(
        "every frame would be written to the same file `{pattern}`; say where the frame number goes, as in `{mended}`"
    )]
    NoFrameToken {
        /// The output as it was given.
        pattern: String,
        /// The same with a frame token.
        mended: String,
    },
    /// The operating system refused to list files.
    #[error("can't look into `{}`: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// One file of a sequence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameFile {
    /// The frame number that its name carries; `None` only for a file that stands alone.
    pub frame: Option<i64>,
    /// Where it lies.
    pub path: PathBuf,
}

/// The frames that were found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// At least one file; ascending in frame number, each number once.
    pub frames: Vec<FrameFile>,
    /// The frames that the asked range names and that are not there, ascending. Without a range a hole between two
    /// frames is not missing: caches written on every second frame are common.
    pub missing: Vec<i64>,
}

/// The frames asked for with `--frames`: numbers, spans and spans with a step, such as `1-10,20,30-40x5`.
///
/// Numbers may be negative: `-5-10` runs from -5 to 10, `-10--5` from -10 to -5.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameRange {
    frames: Vec<i64>,
}

impl FrameRange {
    /// The frames asked for, ascending, each once.
    pub fn frames(&self) -> &[i64] {
        &self.frames
    }

    /// Whether `frame` is asked for.
    pub fn contains(&self, frame: i64) -> bool {
        self.frames.binary_search(&frame).is_ok()
    }
}

impl FromStr for FrameRange {
    type Err = SequenceError;

    fn from_str(text: &str) -> Result<Self, SequenceError> {
        let error = |what| SequenceError::Range { text: text.to_owned(), what };
        let mut frames = Vec::new();
        for part in text.split(',') {
            let (first, last, step) = parse_span(part.trim()).map_err(error)?;
            let count = (i128::from(last) - i128::from(first)) / i128::from(step) + 1;
            if count + frames.len() as i128 > MAX_RANGE_FRAMES as i128 {
                return Err(error(format!("it asks for more than {MAX_RANGE_FRAMES} frames")));
            }
            let each = std::iter::successors(Some(first), |frame| frame.checked_add(step));
            frames.extend(each.take(count as usize));
        }
        frames.sort_unstable();
        frames.dedup();
        Ok(Self { frames })
    }
}

/// First frame, last frame and step of `5`, `1-100` or `1-100x2`.
fn parse_span(text: &str) -> Result<(i64, i64, i64), String> {
    let number =
        |text: &str| text.trim().parse::<i64>().map_err(|_| format!("`{text}` is not a whole number"));
    let (span, step) = match text.split_once('x') {
        Some((span, step)) => (span, number(step)?),
        None => (text, 1),
    };
    if step < 1 {
        return Err(format!("the step {step} is not above 0"));
    }
    // A minus in the first place is a sign; the next one separates.
    let dash = span.char_indices().skip(1).find(|&(_, c)| c == '-');
    let (first, last) = match dash.and_then(|(at, _)| span.split_at_checked(at)) {
        Some((first, rest)) => (number(first)?, number(rest.strip_prefix('-').unwrap_or(rest))?),
        None => (number(span)?, number(span)?),
    };
    if last < first {
        return Err(format!("it ends before it starts (frames run forward: write `{last}-{first}`)"));
    }
    Ok((first, last, step))
}

/// Finds the files that `input` names, and keeps those that `range` asks for.
///
/// `input` is read as the first of these that fits:
///
/// 1. the path of something that exists, whatever characters it has: a file is a sequence of one; a folder stands
///    for all its `.vdb` files (not those hidden by a leading dot), which must be one sequence;
/// 2. a file name with a frame token; its folder is taken literally. `####`, `%04d` and `$F4` stand for a number
///    padded with zeros to at least four digits; `#`, `%d` and `$F` for digits of any number. A negative number may
///    count its sign as one of the padded places, as `printf` does (`-005`), or not (`-0005`);
/// 3. a glob (`*`, `?`, `[...]`, and `**` for any folders).
///
/// In a plain file, a folder or a glob the frame number is the last run of digits before the extension. A minus in
/// front of it is a sign only at the start of the name or after `.` or `_`: `smoke.-0005.vdb` is frame -5, but
/// `shot-12.vdb` is frame 12.
///
/// # Errors
/// When the pattern can't be read, when nothing fits it, when two files claim one frame or one of several has no
/// frame number, when `range` leaves nothing or is asked of one file that is not exactly the frame asked for, or when
/// the system refuses to list a folder.
pub fn find_frames(input: &str, range: Option<&FrameRange>) -> Result<Sequence, SequenceError> {
    let path = Path::new(input);
    let files = match fs::metadata(path) {
        Ok(data) if data.is_dir() => files_in_folder(path)?,
        Ok(_) => return plain_file(path, range),
        Err(source) if source.kind() == io::ErrorKind::PermissionDenied => {
            return Err(SequenceError::Io { path: path.to_owned(), source });
        }
        Err(_) => {
            let (folder, name) = split_folder(input);
            match FramePattern::find(name).map_err(|what| pattern_error(input, what))? {
                Some(pattern) => files_like(Path::new(folder), &pattern)?,
                None if input.contains(['*', '?', '[']) => files_of_glob(input)?,
                None => Vec::new(),
            }
        }
    };
    if files.is_empty() {
        return Err(SequenceError::NothingFound { pattern: input.to_owned(), hint: what_lies_there(input) });
    }
    select(input, files, range)
}

/// The name of the file that a frame is written to.
///
/// `pattern` takes the frame tokens of [`find_frames`] in its file name; without one it is the name itself. Negative
/// numbers are padded as `printf` does. A picture of one file without a frame number is frame 1, where Nuke and
/// Blender put a still.
///
/// # Errors
/// When the pattern can't be read; when `is_sequence` (more than one frame is written) and the pattern has no frame
/// token, or the frame no number.
pub fn output_path(pattern: &str, frame: Option<i64>, is_sequence: bool) -> Result<PathBuf, SequenceError> {
    let (folder, name) = split_folder(pattern);
    let token = FramePattern::find(name).map_err(|what| pattern_error(pattern, what))?;
    match (token, frame) {
        (Some(token), Some(frame)) => Ok(PathBuf::from(format!("{folder}{}", token.format(frame)))),
        (Some(token), None) if !is_sequence => Ok(PathBuf::from(format!("{folder}{}", token.format(1)))),
        (Some(_), None) => Err(pattern_error(
            pattern,
            "it takes a frame number, but this frame of the sequence has none".into(),
        )),
        (None, _) if is_sequence => {
            let (stem, extension) = split_extension(name);
            let mended = format!("{folder}{stem}.####{extension}");
            Err(SequenceError::NoFrameToken { pattern: pattern.to_owned(), mended })
        }
        (None, _) => Ok(PathBuf::from(pattern)),
    }
}

/// A file name with a frame token: what stands before it, the least number of digits, what stands after it.
#[derive(Debug, PartialEq, Eq)]
struct FramePattern<'a> {
    before: &'a str,
    width: usize,
    after: &'a str,
}

impl<'a> FramePattern<'a> {
    /// The one frame token of a file name, if it has any; an error says what is wrong.
    fn find(name: &'a str) -> Result<Option<Self>, String> {
        let mut found: Option<Self> = None;
        let mut at = 0;
        while let Some((before, rest)) = name.split_at_checked(at) {
            let Some(first) = rest.chars().next() else { break };
            let Some((length, width)) = token_at(rest) else {
                at += first.len_utf8();
                continue;
            };
            if width > MAX_WIDTH {
                return Err(format!("it pads the frame number to more than {MAX_WIDTH} digits"));
            }
            if found.is_some() {
                return Err("it has more than one frame token; keep one".to_owned());
            }
            at += length;
            found = Some(Self { before, width, after: name.get(at..).unwrap_or_default() });
        }
        Ok(found)
    }

    fn format(&self, frame: i64) -> String {
        format!("{}{frame:0width$}{}", self.before, self.after, width = self.width)
    }

    fn frame_of(&self, name: &str) -> Option<i64> {
        let number = name.strip_prefix(self.before)?.strip_suffix(self.after)?;
        read_padded(number, self.width)
    }
}

/// Length in bytes and width in digits of the frame token that `text` starts with.
fn token_at(text: &str) -> Option<(usize, usize)> {
    let count = |text: &str, wanted: fn(&u8) -> bool| text.bytes().take_while(wanted).count();
    if text.starts_with('#') {
        let hashes = count(text, |&c| c == b'#');
        return Some((hashes, hashes));
    }
    let (rest, is_printf) = match text.strip_prefix("$F") {
        Some(rest) => (rest, false),
        None => (text.strip_prefix('%')?, true),
    };
    let (digits, after) = rest.split_at_checked(count(rest, u8::is_ascii_digit))?;
    // `$FF`, `$FPS` and the like are other variables of Houdini.
    let ends_well = if is_printf {
        after.starts_with('d')
    } else {
        !after.starts_with(|c: char| c.is_ascii_alphabetic())
    };
    if !ends_well {
        return None;
    }
    // No digits mean no padding; digits too many for a number are refused by the caller as too wide.
    let width = if digits.is_empty() { 1 } else { digits.parse().unwrap_or(usize::MAX).max(1) };
    Some((text.len() - after.len() + usize::from(is_printf), width))
}

/// A frame number written with at least `width` digits: `None` if `text` is not one, or not one that would be
/// written so (`00012` is not padded to four). A width of 1 takes any digits.
fn read_padded(text: &str, width: usize) -> Option<i64> {
    let digits = text.strip_prefix('-').unwrap_or(text);
    let is_negative = digits.len() < text.len();
    let least = if is_negative { width.saturating_sub(1) } else { width };
    let is_padded_further = width > 1 && digits.len() > width && digits.starts_with('0');
    if !digits.bytes().all(|c| c.is_ascii_digit()) || digits.len() < least || is_padded_further {
        return None;
    }
    let frame = text.parse().ok()?;
    (frame != 0 || !is_negative).then_some(frame)
}

/// The frame number in a file name of unknown pattern, and where it stands (sign included): see [`find_frames`].
fn number_in_name(name: &str) -> Option<(Range<usize>, i64)> {
    let (stem, _) = split_extension(name);
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let head = stem.get(..end)?.trim_end_matches(|c: char| c.is_ascii_digit());
    let is_signed = head.strip_suffix('-').is_some_and(|rest| rest.is_empty() || rest.ends_with(['.', '_']));
    let start = head.len() - usize::from(is_signed);
    Some((start..end, stem.get(start..end)?.parse().ok()?))
}

/// The pattern of the sequence that a file of this name belongs to; the name itself where it has no number.
fn pattern_of(name: &str) -> String {
    let Some((place, _)) = number_in_name(name) else { return name.to_owned() };
    let (before, number, after) = (&name[..place.start], &name[place.clone()], &name[place.end..]);
    format!("{before}{}{after}", "#".repeat(number.trim_start_matches('-').len()))
}

/// Splits after the last separator: `sim/a.vdb` into `sim/` and `a.vdb`.
fn split_folder(path: &str) -> (&str, &str) {
    path.split_at(path.rfind(is_separator).map_or(0, |at| at + 1))
}

/// Splits before the last dot: `a.0001.vdb` into `a.0001` and `.vdb`. A dot in the first place hides a file.
fn split_extension(name: &str) -> (&str, &str) {
    name.split_at(name.rfind('.').filter(|&at| at > 0).unwrap_or(name.len()))
}

fn pattern_error(pattern: &str, what: String) -> SequenceError {
    SequenceError::Pattern { pattern: pattern.to_owned(), what }
}

fn name_of(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

/// The folder that `""` means.
fn or_current(folder: &Path) -> &Path {
    if folder.as_os_str().is_empty() { Path::new(".") } else { folder }
}

/// The names in a folder, sorted; none if there is no such folder. Names that are not Unicode are left out: nothing
/// that a user can type here fits them.
fn names_in(folder: &Path) -> Result<Vec<String>, SequenceError> {
    let error = |source| SequenceError::Io { path: folder.to_owned(), source };
    let entries = match fs::read_dir(or_current(folder)) {
        Ok(entries) => entries,
        Err(source) if matches!(source.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok(Vec::new());
        }
        Err(source) => return Err(error(source)),
    };
    let mut names = Vec::new();
    for entry in entries {
        names.extend(entry.map_err(error)?.file_name().into_string().ok());
    }
    names.sort_unstable();
    Ok(names)
}

fn plain_file(path: &Path, range: Option<&FrameRange>) -> Result<Sequence, SequenceError> {
    let name = name_of(path);
    let frame = number_in_name(name).map(|(_, frame)| frame);
    if range.is_some_and(|range| frame.is_none_or(|frame| range.frames() != [frame])) {
        let hint = match frame {
            Some(_) => format!("for the sequence it belongs to write `{}`", pattern_of(name)),
            None => "leave out the range".to_owned(),
        };
        return Err(SequenceError::RangeOfOneFile { path: path.to_owned(), hint });
    }
    Ok(Sequence { frames: vec![FrameFile { frame, path: path.to_owned() }], missing: Vec::new() })
}

fn files_in_folder(folder: &Path) -> Result<Vec<FrameFile>, SequenceError> {
    let mut names = names_in(folder)?;
    names.retain(|name| {
        !name.starts_with('.')
            && split_extension(name).1.eq_ignore_ascii_case(".vdb")
            && folder.join(name).is_file()
    });
    // Two names belong together if they differ in nothing but the number, however it is padded.
    let mut sequences: Vec<(String, String)> = Vec::new();
    for name in &names {
        let around =
            number_in_name(name).map(|(place, _)| name[..place.start].to_owned() + "#" + &name[place.end..]);
        let key = around.unwrap_or_else(|| name.clone());
        if !sequences.iter().any(|(known, _)| *known == key) {
            sequences.push((key, pattern_of(name)));
        }
        if sequences.len() > 4 {
            break;
        }
    }
    if sequences.len() > 1 {
        let patterns = sequences.into_iter().map(|(_, pattern)| format!("`{pattern}`")).collect();
        return Err(SequenceError::SeveralSequences { folder: folder.to_owned(), patterns });
    }
    let numbered = |name: String| FrameFile {
        frame: number_in_name(&name).map(|(_, frame)| frame),
        path: folder.join(name),
    };
    Ok(names.into_iter().map(numbered).collect())
}

fn files_like(folder: &Path, pattern: &FramePattern) -> Result<Vec<FrameFile>, SequenceError> {
    let mut files = Vec::new();
    for name in names_in(folder)? {
        if let Some(frame) = pattern.frame_of(&name) {
            files.push(FrameFile { frame: Some(frame), path: folder.join(name) });
        }
    }
    files.retain(|file| file.path.is_file());
    Ok(files)
}

fn files_of_glob(input: &str) -> Result<Vec<FrameFile>, SequenceError> {
    // A folder that exists is meant literally, even where its name has brackets.
    let (folder, name) = split_folder(input);
    let pattern =
        if Path::new(folder).is_dir() { glob::Pattern::escape(folder) + name } else { input.to_owned() };
    let options = glob::MatchOptions { require_literal_leading_dot: true, ..glob::MatchOptions::new() };
    let paths = glob::glob_with(&pattern, options)
        .map_err(|error| pattern_error(input, format!("{} at character {}", error.msg, error.pos)))?;
    let mut files = Vec::new();
    for path in paths {
        let path = path.map_err(|error| {
            let path = error.path().to_owned();
            SequenceError::Io { path, source: error.into() }
        })?;
        if path.is_file() {
            files.push(FrameFile { frame: number_in_name(name_of(&path)).map(|(_, frame)| frame), path });
        }
    }
    Ok(files)
}

/// Orders the files that match `input` and keeps those of the range.
fn select(input: &str, files: Vec<FrameFile>, range: Option<&FrameRange>) -> Result<Sequence, SequenceError> {
    let count = files.len();
    if let Some(file) = files.iter().find(|file| file.frame.is_none()) {
        return if count == 1 {
            plain_file(&file.path, range)
        } else {
            Err(SequenceError::Unnumbered { path: file.path.clone(), count })
        };
    }
    let mut frames = files;
    frames.sort_by_key(|file| file.frame);
    for pair in frames.windows(2) {
        if let [first, second] = pair
            && let (Some(frame), true) = (first.frame, first.frame == second.frame)
        {
            let (first, second) = (first.path.clone(), second.path.clone());
            return Err(SequenceError::SameFrame { frame, first, second });
        }
    }
    let Some(range) = range else { return Ok(Sequence { frames, missing: Vec::new() }) };

    let there: Vec<i64> = frames.iter().filter_map(|file| file.frame).collect();
    frames.retain(|file| file.frame.is_some_and(|frame| range.contains(frame)));
    if let (true, Some(&first), Some(&last)) = (frames.is_empty(), there.first(), there.last()) {
        return Err(SequenceError::NotInRange { pattern: input.to_owned(), first, last });
    }
    let missing =
        range.frames().iter().copied().filter(|frame| there.binary_search(frame).is_err()).collect();
    Ok(Sequence { frames, missing })
}

/// What to say of a pattern that nothing fits: the files that come closest.
fn what_lies_there(input: &str) -> String {
    if Path::new(input).is_dir() {
        return "the folder has no .vdb files".to_owned();
    }
    let (folder, name) = split_folder(input);
    let folder_path = or_current(Path::new(folder));
    if !folder_path.is_dir() {
        let literal = if folder.contains(['#', '%', '*', '?', '$']) {
            " (a frame token may stand in the file name only, and not beside a glob)"
        } else {
            ""
        };
        return format!("there is no folder `{folder}`{literal}");
    }
    let mut names = names_in(folder_path).unwrap_or_default();
    names.retain(|name| !name.starts_with('.'));
    if names.is_empty() {
        return format!("the folder `{}` is empty", folder_path.display());
    }
    let alike = |a: &str| {
        let same = |pair: &(char, char)| pair.0 == pair.1;
        a.chars().zip(name.chars()).take_while(same).count()
            + a.chars().rev().zip(name.chars().rev()).take_while(same).count()
    };
    names.sort_by_key(|name| std::cmp::Reverse(alike(name)));
    let shown: Vec<String> = names.iter().take(3).map(|name| format!("`{name}`")).collect();
    let mut hint = format!("closest in `{}`: {}", folder_path.display(), shown.join(", "));
    if let Some(pattern) =
        names.first().map(|name| pattern_of(name)).filter(|it| it != name && it.contains('#'))
    {
        hint += &format!("; try `{folder}{pattern}`");
    }
    if name.contains("..") || name.contains("_.") {
        hint += " (a shell replaces $F unless the pattern stands in single quotes)";
    }
    hint
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with empty files of these names.
    fn folder_with(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, b"").unwrap();
        }
        folder
    }

    fn find(folder: &tempfile::TempDir, input: &str, range: &str) -> Result<Sequence, SequenceError> {
        let range: Option<FrameRange> = (!range.is_empty()).then(|| range.parse().unwrap());
        find_frames(&folder.path().join(input).to_string_lossy(), range.as_ref())
    }

    fn numbers(sequence: &Sequence) -> Vec<i64> {
        sequence.frames.iter().map(|file| file.frame.unwrap()).collect()
    }

    /// Frame numbers of every size and sign: powers of ten and of two, their neighbours, the ends of the range.
    fn many_frames() -> impl Iterator<Item = i64> {
        let tens = (0..19).map(|n| 10_i64.pow(n));
        let twos = (0..63).map(|n| 1_i64 << n);
        let around = tens.chain(twos).flat_map(|n| [n - 1, n, n + 1, -n - 1, -n, 1 - n]);
        around.chain([i64::MIN, i64::MAX]).chain(-1200..1200)
    }

    #[test]
    fn what_a_pattern_writes_it_reads_back() {
        for width in 1..=MAX_WIDTH {
            let hashes = format!("a_{}.vdb", "#".repeat(width));
            let forms = [hashes, format!("a_%0{width}d.vdb"), format!("a_$F{width}.vdb")];
            for form in &forms {
                let pattern = FramePattern::find(form).unwrap().unwrap();
                assert_eq!(pattern, FramePattern { before: "a_", width, after: ".vdb" });
            }
            let pattern = FramePattern::find(&forms[0]).unwrap().unwrap();
            for frame in many_frames() {
                let name = pattern.format(frame);
                assert_eq!(pattern.frame_of(&name), Some(frame), "{name}");
                assert_eq!(number_in_name(&name).map(|(_, frame)| frame), Some(frame), "{name}");
                assert_eq!(output_path(&forms[1], Some(frame), true).unwrap(), Path::new(&name));
            }
        }
    }

    #[test]
    fn negative_numbers_are_read_as_either_program_pads_them() {
        let pattern = FramePattern::find("%04d").unwrap().unwrap();
        assert_eq!(pattern.frame_of("-005"), Some(-5));
        assert_eq!(pattern.frame_of("-0005"), Some(-5));
        for wrong in ["-05", "-00005", "-0000", "005", "00005", "", "-", "+0005", "0x05", "٠٠٠٥"] {
            assert_eq!(pattern.frame_of(wrong), None, "{wrong}");
        }
        assert_eq!(pattern.frame_of("12345"), Some(12345));
    }

    #[test]
    fn an_unpadded_token_takes_any_digits() {
        for form in ["a.#.vdb", "a.%d.vdb", "a.$F.vdb"] {
            let pattern = FramePattern::find(form).unwrap().unwrap();
            assert_eq!(pattern.frame_of("a.7.vdb"), Some(7));
            assert_eq!(pattern.frame_of("a.0007.vdb"), Some(7));
            assert_eq!(pattern.frame_of("a.-7.vdb"), Some(-7));
            assert_eq!(pattern.frame_of("a..vdb"), None);
            assert_eq!(pattern.format(-12), "a.-12.vdb");
        }
    }

    #[test]
    fn only_frame_tokens_are_tokens() {
        for name in
            ["a.vdb", "100%.vdb", "%s.vdb", "%04x.vdb", "$FF.vdb", "$FPS.vdb", "$HIP.vdb", "%", "$F4x", "é"]
        {
            assert_eq!(FramePattern::find(name), Ok(None), "{name}");
        }
        for name in ["a#.##.vdb", "$F_%d.vdb", "%099999999999999999999d.vdb", "$F33.vdb"] {
            assert!(FramePattern::find(name).is_err(), "{name}");
        }
    }

    #[test]
    fn the_number_in_a_name_is_its_last_run_of_digits() {
        for (name, frame) in [
            ("smoke.0005.vdb", Some(5)),
            ("smoke.-0005.vdb", Some(-5)),
            ("smoke_-5.vdb", Some(-5)),
            ("-5.vdb", Some(-5)),
            ("shot-12.vdb", Some(12)),
            ("v2_smoke_0100_fine.vdb", Some(100)),
            ("5", Some(5)),
            ("é٣7é.vdb", Some(7)),
            ("smoke.vdb", None),
            ("smoke.mp4", None),
            ("", None),
            ("smoke.99999999999999999999.vdb", None),
        ] {
            assert_eq!(number_in_name(name).map(|(_, frame)| frame), frame, "{name}");
        }
        assert_eq!(pattern_of("smoke.-0005.vdb"), "smoke.####.vdb");
    }

    #[test]
    fn ranges_hold_the_frames_they_name() {
        for (text, frames) in [
            ("5", vec![5]),
            ("-5", vec![-5]),
            ("1-7x2", vec![1, 3, 5, 7]),
            ("1-6x4", vec![1, 5]),
            ("-2-1", vec![-2, -1, 0, 1]),
            ("-10--8", vec![-10, -9, -8]),
            ("20, 1-3 ,2-4", vec![1, 2, 3, 4, 20]),
            ("9223372036854775806-9223372036854775807", vec![i64::MAX - 1, i64::MAX]),
            (
                "-9223372036854775808-9223372036854775807x9223372036854775807",
                vec![i64::MIN, -1, i64::MAX - 1],
            ),
        ] {
            let range: FrameRange = text.parse().unwrap();
            assert_eq!(range.frames(), frames, "{text}");
            assert!(frames.iter().all(|&frame| range.contains(frame)));
            assert!(!range.contains(1000));
        }
    }

    #[test]
    fn bad_ranges_say_what_is_wrong() {
        for (text, what) in [
            ("", "`` is not a whole number"),
            ("1-", "`` is not a whole number"),
            ("1,,2", "`` is not a whole number"),
            ("one", "`one` is not a whole number"),
            ("é-5", "`é` is not a whole number"),
            ("1-5x0", "the step 0 is not above 0"),
            ("1-5x-1", "the step -1 is not above 0"),
            ("10-1", "write `1-10`"),
            ("99999999999999999999", "is not a whole number"),
            ("1-9223372036854775807", "more than 1000000 frames"),
            ("-9223372036854775808-9223372036854775807", "more than 1000000 frames"),
            ("1-600000,1-600000", "more than 1000000 frames"),
        ] {
            let message = text.parse::<FrameRange>().unwrap_err().to_string();
            assert!(message.contains(what) && message.contains("1-100x2"), "{text}: {message}");
        }
    }

    #[test]
    fn every_form_of_input_finds_the_same_frames() {
        let folder = folder_with(&[
            "smoke.0010.vdb",
            "smoke.0002.vdb",
            "smoke.-001.vdb",
            "smoke.json",
            ".smoke.0003.vdb",
        ]);
        for input in [
            "smoke.####.vdb",
            "smoke.%04d.vdb",
            "smoke.$F4.vdb",
            "smoke.#.vdb",
            "smoke*.vdb",
            "",
            "smoke.%d.vdb",
        ] {
            let sequence = find(&folder, input, "").unwrap();
            assert_eq!(numbers(&sequence), [-1, 2, 10], "{input}");
            assert!(sequence.missing.is_empty());
            assert!(sequence.frames[1].path.ends_with("smoke.0002.vdb"));
        }
    }

    #[test]
    fn a_glob_may_cross_folders() {
        let folder = folder_with(&["sim/a/x.0001.vdb", "sim/b/x.0002.vdb", "sim/b/y.0003.vdb"]);
        assert_eq!(numbers(&find(&folder, "sim/*/x.????.vdb", "").unwrap()), [1, 2]);
        assert_eq!(numbers(&find(&folder, "**/*.vdb", "1-3").unwrap()), [1, 2, 3]);
    }

    #[test]
    fn a_path_that_exists_is_meant_literally() {
        let names =
            ["a.####.vdb", "a.0001.vdb", "b[1].vdb", "b1.vdb", "v2.vdb", "d[1]/c.1.vdb", "d[1]/c.2.vdb"];
        let folder = folder_with(&names);
        for name in ["a.####.vdb", "b[1].vdb", "v2.vdb"] {
            let sequence = find(&folder, name, "").unwrap();
            assert_eq!(sequence.frames.len(), 1);
            assert!(sequence.frames[0].path.ends_with(name));
        }
        for input in ["d[1]", "d[1]/c.#.vdb", "d[1]/c.*.vdb"] {
            assert_eq!(numbers(&find(&folder, input, "").unwrap()), [1, 2], "{input}");
        }
    }

    #[test]
    fn a_range_selects_and_reports_what_is_missing() {
        let folder = folder_with(&["a.1.vdb", "a.3.vdb", "a.5.vdb", "a.9.vdb"]);
        let sequence = find(&folder, "a.#.vdb", "1-5").unwrap();
        assert_eq!(numbers(&sequence), [1, 3, 5]);
        assert_eq!(sequence.missing, [2, 4]);
        let error = find(&folder, "a.#.vdb", "20-30").unwrap_err();
        assert!(matches!(error, SequenceError::NotInRange { first: 1, last: 9, .. }), "{error}");
    }

    #[test]
    fn a_range_of_one_file_must_be_that_file() {
        let folder = folder_with(&["a.0003.vdb", "b.vdb"]);
        assert_eq!(numbers(&find(&folder, "a.0003.vdb", "3").unwrap()), [3]);
        let message = find(&folder, "a.0003.vdb", "1-5").unwrap_err().to_string();
        assert!(message.contains("`a.####.vdb`"), "{message}");
        assert!(matches!(find(&folder, "b.vdb", "1"), Err(SequenceError::RangeOfOneFile { .. })));
        assert!(matches!(find(&folder, "b*.vdb", "1"), Err(SequenceError::RangeOfOneFile { .. })));
        assert_eq!(find(&folder, "b*.vdb", "").unwrap().frames[0].frame, None);
    }

    #[test]
    fn two_files_of_one_frame_are_named() {
        let folder = folder_with(&["a.0001.vdb", "a.001.vdb", "a.2.vdb"]);
        for input in ["a.*.vdb", "a.#.vdb", ""] {
            let message = find(&folder, input, "").unwrap_err().to_string();
            assert!(message.contains("a.0001.vdb") && message.contains("a.001.vdb"), "{input}: {message}");
        }
        assert_eq!(numbers(&find(&folder, "a.%04d.vdb", "").unwrap()), [1]);
    }

    #[test]
    fn mixed_folders_and_globs_are_refused() {
        let folder = folder_with(&["fire.0001.vdb", "smoke.0002.vdb", "smoke.vdb"]);
        let message = find(&folder, "", "").unwrap_err().to_string();
        assert!(message.contains("`fire.####.vdb`, `smoke.####.vdb`, `smoke.vdb`"), "{message}");
        let error = find(&folder, "smoke*", "").unwrap_err();
        assert!(matches!(error, SequenceError::Unnumbered { count: 2, .. }), "{error}");
    }

    #[test]
    fn finding_nothing_shows_what_comes_closest() {
        let folder = folder_with(&["smoke.00001.vdb", "smoke.00002.vdb", "notes.txt", "empty/.hidden"]);
        let message = |input| find(&folder, input, "").unwrap_err().to_string();
        for input in ["smoke.####.vdb", "smoke.0001.vdb", "smoke*.nvdb", "smok.$F.vdb"] {
            let message = message(input);
            assert!(message.contains("`smoke.00001.vdb`"), "{message}");
            assert!(message.contains("smoke.#####.vdb`"), "{message}");
        }
        assert!(message("smoke..vdb").contains("single quotes"));
        assert!(message("no/such/a.####.vdb").contains("there is no folder"));
        assert!(message("####/a.vdb").contains("in the file name only"));
        assert!(message("empty").contains("no .vdb files"));
        assert!(message("empty/a.vdb").contains("is empty"));
        assert!(message("a[.vdb").contains("can't be read"));
    }

    #[test]
    fn outputs_are_named_after_their_frame() {
        let path = |pattern, frame, is_sequence| output_path(pattern, frame, is_sequence).unwrap();
        assert_eq!(path("out/a.####.png", Some(-5), true), Path::new("out/a.-005.png"));
        assert_eq!(path("out#1/a.$F.png", Some(7), false), Path::new("out#1/a.7.png"));
        assert_eq!(path("a.png", Some(7), false), Path::new("a.png"));
        assert_eq!(path("a.####.png", None, false), Path::new("a.0001.png"));
    }

    #[test]
    fn a_sequence_needs_a_place_for_its_numbers() {
        let message = output_path("out.d/a.png", Some(1), true).unwrap_err().to_string();
        assert!(message.contains("`out.d/a.####.png`"), "{message}");
        let message = output_path("out.d/a", Some(1), true).unwrap_err().to_string();
        assert!(message.contains("`out.d/a.####`"), "{message}");
        assert!(matches!(output_path("a.#.png", None, true), Err(SequenceError::Pattern { .. })));
        assert!(matches!(output_path("a.#.#.png", Some(1), true), Err(SequenceError::Pattern { .. })));
    }
}
