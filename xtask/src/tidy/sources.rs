//! The rules for source files.
//!
//! A search for words in the text without its comments and strings, not a parser: simple, and strict enough to
//! catch a slip. What needs types is left to clippy.

use super::Finding;

const MAX_LINES: usize = 900;

/// Where the file system may be used; see also [`is_test_file`].
const FILE_SYSTEM: &[&str] = &[
    "crates/cli/",
    "crates/viewer/",
    "crates/python/",
    "crates/testkit/",
    "crates/pipeline/src/sequence.rs",
    "crates/pipeline/src/output.rs",
    "crates/pipeline/src/pack/work.rs",
    "xtask/",
];

/// Folders without any `unsafe`.
const SAFE: &[&str] = &["crates/vdb/"];

/// The modules of `nuage-volume` in layers, lowest first: a module names none of a higher layer.
const VOLUME_LAYERS: &[&[&str]] =
    &[&["space"], &["brick"], &["tree"], &["accessor", "sample"], &["codec"], &["format"]];

/// Macros that stand for code which is not there yet, or for a look at code that is.
const LEFTOVERS: [&str; 3] = ["todo", "unimplemented", "dbg"];

/// Folders of one person's machine. In two parts, so that this file passes its own check.
const MACHINE_PATHS: &[&str] = &[concat!("/ho", "me/"), concat!("/ro", "ot/"), concat!("/Us", "ers/")];

/// Checks one file; `path` is from the root of the repository, with `/`.
pub(super) fn check(path: &str, text: &str) -> Vec<Finding> {
    let code = without_comments_and_strings(text);
    let mut findings = Vec::new();
    let mut report = |line, message: String| findings.push(Finding::new(path, line, message));

    if path.contains("src/") && !text.trim_start().starts_with("//!") {
        report(
            1,
            "a module opens with a `//!` paragraph: say what lives here and what deliberately does not"
                .into(),
        );
    }
    if text.lines().count() > MAX_LINES {
        report(
            MAX_LINES + 1,
            format!("the file has more than {MAX_LINES} lines: split it by what its parts do"),
        );
    }
    for (line, text) in (1..).zip(text.lines()) {
        for machine in MACHINE_PATHS.iter().filter(|machine| text.contains(**machine)) {
            report(
                line,
                format!(
                    "`{machine}` is a path of one machine: use a relative path or an environment variable"
                ),
            );
        }
    }
    for (line, code) in (1..).zip(code.lines()) {
        for leftover in LEFTOVERS {
            if words(code).any(|(at, word)| word == leftover && code[at + word.len()..].starts_with('!')) {
                report(line, format!("`{leftover}!` is left over: finish the code or return an error"));
            }
        }
        if SAFE.iter().any(|folder| path.starts_with(folder)) && words(code).any(|(_, word)| word == "unsafe")
        {
            report(line, "no unsafe code in this crate: it reads hostile bytes".into());
        }
    }
    for line in allowances_without_reason(&code) {
        report(line, "a lint is silenced without a reason: add `reason = \"...\"`".into());
    }
    if !is_test_file(path) && !FILE_SYSTEM.iter().any(|allowed| path.starts_with(allowed)) {
        for line in file_system_uses(before_tests(&code)) {
            report(
                line,
                "the file system stays in front ends and in sequence.rs, output.rs and pack/work.rs of the pipeline: \
                 take bytes or a reader here"
                    .into(),
            );
        }
    }
    if let Some(file) = path.strip_prefix("crates/volume/src/") {
        for (line, message) in volume_layer_breaks(file, before_tests(&code)) {
            report(line, message);
        }
    }
    findings
}

/// Whether the file is a test, a benchmark or an example of its own.
fn is_test_file(path: &str) -> bool {
    path.split('/').any(|part| ["tests", "tests.rs", "benches", "examples"].contains(&part))
}

/// What stands before the tests inside a module. Tests may use what the code may not.
fn before_tests(code: &str) -> &str {
    code.split_once("#[cfg(test)]\nmod ").map_or(code, |(before, _)| before)
}

/// The identifiers and numbers of `code`, each with its place.
fn words(code: &str) -> impl Iterator<Item = (usize, &str)> {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    code.split(move |c| !is_part(c)).filter(|word| !word.is_empty()).map(|word| (offset_in(code, word), word))
}

/// Where `part` starts in `whole`, of which it is a slice.
fn offset_in(whole: &str, part: &str) -> usize {
    part.as_ptr() as usize - whole.as_ptr() as usize
}

fn line_at(code: &str, offset: usize) -> usize {
    1 + code.bytes().take(offset).filter(|&c| c == b'\n').count()
}

/// The lines with an attribute `allow` or `expect` that has no `reason`.
fn allowances_without_reason(code: &str) -> Vec<usize> {
    let mut lines = Vec::new();
    for opening in ["#[allow(", "#![allow(", "#[expect(", "#![expect("] {
        for (at, _) in code.match_indices(opening) {
            let attribute = code[at..].split(']').next().unwrap_or_default();
            if !words(attribute).any(|(_, word)| word == "reason") {
                lines.push(line_at(code, at));
            }
        }
    }
    lines
}

/// The lines that name `std::fs` (also inside a list `std::{...}`) or a crate for memory maps.
fn file_system_uses(code: &str) -> Vec<usize> {
    let mut lines: Vec<usize> = Vec::new();
    for (at, name) in names_under(code, "std::") {
        if name == "fs" {
            lines.push(line_at(code, at));
        }
    }
    let maps = words(code).filter(|(_, word)| word.starts_with("memmap"));
    lines.extend(maps.map(|(at, _)| line_at(code, at)));
    lines
}

/// The first names after each `prefix`, with their places: `a` and `b` of `prefix::{a::{c, d}, b}`.
fn names_under<'a>(code: &'a str, prefix: &str) -> Vec<(usize, &'a str)> {
    let mut names = Vec::new();
    for (at, _) in code.match_indices(prefix) {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':') {
            continue;
        }
        let rest = &code[at + prefix.len()..];
        let Some(list) = rest.strip_prefix('{') else {
            names.extend(words(rest).next().filter(|&(at, _)| at == 0).map(|(_, name)| name));
            continue;
        };
        let (mut depth, mut is_first) = (0, true);
        for (at, c) in list.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => is_first = true,
                c if is_first && !c.is_whitespace() => {
                    is_first = false;
                    names.extend(words(&list[at..]).next().map(|(_, name)| name));
                }
                _ => {}
            }
        }
    }
    names.into_iter().map(|name| (offset_in(code, name), name)).collect()
}

/// Where a module of `nuage-volume` names one of a higher layer. `file` is the path inside `src`.
fn volume_layer_breaks(file: &str, code: &str) -> Vec<(usize, String)> {
    let layer_of = |module: &str| VOLUME_LAYERS.iter().position(|layer| layer.contains(&module));
    let module = file.split('/').next().unwrap_or_default().trim_end_matches(".rs");
    if module == "lib" {
        return Vec::new();
    }
    let mut names = names_under(code, "crate::");
    if !file.contains('/') || file.ends_with("/mod.rs") && file.matches('/').count() == 1 {
        names.extend(names_under(code, "super::"));
    }
    let mut breaks = Vec::new();
    for (at, name) in names {
        // Types and constants that lib.rs hands on begin with a capital.
        let is_module = name.starts_with(|c: char| c.is_ascii_lowercase());
        let complaint = match (layer_of(module), layer_of(name)) {
            (Some(own), Some(other)) if other > own => {
                format!(
                    "`{module}` names `{name}`, which is a layer above it: move the code up, or what it needs down"
                )
            }
            (None, None) if is_module && name != module => format!(
                "neither `{module}` nor `{name}` has a layer: add one to the table in xtask/src/tidy/sources.rs"
            ),
            _ => continue,
        };
        breaks.push((line_at(code, at), complaint));
    }
    breaks
}

/// `text` with every comment and the inside of every string and character blanked, line by line in place.
fn without_comments_and_strings(text: &str) -> String {
    let mut code = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let before = code.chars().next_back();
        let blank = match first {
            '/' if rest.starts_with("//") => rest.find('\n').unwrap_or(rest.len()),
            '/' if rest.starts_with("/*") => block_comment_length(rest),
            '"' => string_length(rest),
            'r' | 'b' | 'c' if !before.is_some_and(|c| c.is_alphanumeric() || c == '_') => {
                raw_string_length(rest)
            }
            '\'' => character_length(rest),
            _ => 0,
        };
        let length = if blank > 0 { blank } else { first.len_utf8() };
        let (taken, remaining) = rest.split_at(length);
        if blank > 0 {
            code.extend(taken.chars().map(|c| if c == '\n' { '\n' } else { ' ' }));
        } else {
            code.push_str(taken);
        }
        rest = remaining;
    }
    code
}

/// Length of the comment, with those inside it, that `text` starts with.
fn block_comment_length(text: &str) -> usize {
    let mut depth = 0;
    let mut at = 0;
    while let Some(rest) = text.get(at..) {
        if rest.is_empty() {
            break;
        }
        if rest.starts_with("/*") {
            depth += 1;
            at += 2;
        } else if rest.starts_with("*/") {
            depth -= 1;
            at += 2;
            if depth == 0 {
                break;
            }
        } else {
            at += rest.chars().next().map_or(1, char::len_utf8);
        }
    }
    at
}

/// Length of the string that `text` starts with.
fn string_length(text: &str) -> usize {
    let mut is_escaped = false;
    for (at, c) in text.char_indices().skip(1) {
        match c {
            _ if is_escaped => is_escaped = false,
            '\\' => is_escaped = true,
            '"' => return at + 1,
            _ => {}
        }
    }
    text.len()
}

/// Length of the raw string that `text` starts with, with its `r`, `br` or `cr`; 0 if it starts with none.
fn raw_string_length(text: &str) -> usize {
    let start = text.trim_start_matches(['b', 'c']);
    let Some(rest) = start.strip_prefix('r').filter(|_| text.len() - start.len() <= 1) else { return 0 };
    let inside = rest.trim_start_matches('#');
    if !inside.starts_with('"') {
        return 0;
    }
    let end = format!("\"{}", "#".repeat(rest.len() - inside.len()));
    let head = text.len() - inside.len() + 1;
    text[head..].find(&end).map_or(text.len(), |at| head + at + end.len())
}

/// Length of the character literal that `text` starts with; 0 if its quote begins a lifetime.
fn character_length(text: &str) -> usize {
    let mut chars = text.char_indices().skip(1);
    match (chars.next(), chars.next()) {
        (Some((_, '\\')), Some(_)) => chars.find(|&(_, c)| c == '\'').map_or(0, |(at, _)| at + 1),
        (Some(_), Some((at, '\''))) => at + 1,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lines of what is found in `code` as the file `path`, under a module comment in line 1.
    fn lines(path: &str, code: &str) -> Vec<usize> {
        check(path, &format!("//! About.\n{code}")).iter().map(|finding| finding.line).collect()
    }

    const LIBRARY: &str = "crates/render/src/film.rs";

    #[test]
    fn a_module_without_its_paragraph_fails() {
        assert_eq!(check(LIBRARY, "use std::fmt;\n").len(), 1);
        assert_eq!(check(LIBRARY, "").len(), 1);
        assert_eq!(check(LIBRARY, "//! About.\n").len(), 0);
        assert_eq!(check("crates/render/tests/slab.rs", "use std::fmt;\n").len(), 0);
    }

    #[test]
    fn a_long_file_fails() {
        assert_eq!(lines(LIBRARY, &"\n".repeat(MAX_LINES - 1)), [0; 0]);
        assert_eq!(lines(LIBRARY, &"\n".repeat(MAX_LINES)), [MAX_LINES + 1]);
    }

    #[test]
    fn paths_of_a_machine_fail_even_in_comments() {
        for machine in MACHINE_PATHS {
            assert_eq!(
                lines(LIBRARY, &format!("\n// see {machine}x\nconst A: &str = \"{machine}\";")),
                [3, 4]
            );
        }
    }

    #[test]
    fn leftovers_fail() {
        let found = |code: &str| lines(LIBRARY, &format!("fn f() {{\n{code}\n}}"));
        for name in LEFTOVERS {
            for code in [format!("{name}!(\"x\")"), format!("let a = {name}!(b);"), format!("std::{name}!()")]
            {
                assert_eq!(found(&code), [3], "{code}");
            }
            for code in [
                format!("// {name}!()"),
                format!("\"{name}!()\""),
                format!("r#\"{name}!(\"\"#"),
                format!("my_{name}!(1)"),
                format!("let {name} = !x;"),
            ] {
                assert_eq!(found(&code), [0; 0], "{code}");
            }
        }
    }

    #[test]
    fn unsafe_code_in_the_reader_fails() {
        let code = "fn f() { unsafe { g() } }";
        assert_eq!(lines("crates/vdb/src/tree.rs", code), [2]);
        assert_eq!(lines("crates/gpu/src/upload.rs", code), [0; 0]);
        assert_eq!(lines("crates/vdb/src/lib.rs", "#![forbid(unsafe_code)] // no unsafe"), [0; 0]);
    }

    #[test]
    fn lints_silenced_without_a_reason_fail() {
        assert_eq!(lines(LIBRARY, "#[allow(dead_code)]\nfn f() {}"), [2]);
        assert_eq!(lines(LIBRARY, "fn g() {}\n#[expect(\n    dead_code\n)]\nfn f() {}"), [3]);
        assert_eq!(lines(LIBRARY, "#![allow(dead_code)] // reason: none"), [2]);
        assert_eq!(lines(LIBRARY, "#[allow(\n    dead_code,\n    reason = \"x]\"\n)]\nfn f() {}"), [0; 0]);
        assert_eq!(lines(LIBRARY, "fn f() { a.expect(\"x\") }"), [0; 0]);
    }

    #[test]
    fn the_file_system_outside_its_places_fails() {
        for code in [
            "use std::fs;",
            "use std::fs::File;",
            "use std::{fmt, fs::{self, File}};",
            "use std::{io::{self, Read}, fs};",
            "fn f() { std::fs::read(p); }",
            "use memmap2::Mmap;",
        ] {
            assert_eq!(lines(LIBRARY, code), [2], "{code}");
            assert_eq!(lines("crates/pipeline/src/encode.rs", code), [2], "{code}");
            for allowed in [
                "crates/cli/src/main.rs",
                "crates/pipeline/src/output.rs",
                "crates/pipeline/src/pack/work.rs",
                "crates/vdb/tests/files.rs",
                "crates/render/benches/march.rs",
                "crates/render/examples/cloud.rs",
            ] {
                assert_eq!(lines(allowed, code), [0; 0], "{allowed}: {code}");
            }
            assert_eq!(lines(LIBRARY, &format!("#[cfg(test)]\nmod tests {{\n{code}\n}}")), [0; 0]);
        }
        for code in ["use std::{io::{fs, x}};", "use crate::fs;", "// std::fs", "use std::fmt;"] {
            assert_eq!(lines(LIBRARY, code), [0; 0], "{code}");
        }
    }

    #[test]
    fn a_module_of_volume_that_names_a_higher_one_fails() {
        let breaks = |file: &str, code: &str| lines(&format!("crates/volume/src/{file}"), code);
        assert_eq!(breaks("space.rs", "use crate::brick::Brick;"), [2]);
        assert_eq!(breaks("tree.rs", "use crate::{\n    brick::Brick,\n    codec::{space, Codec},\n};"), [4]);
        assert_eq!(breaks("codec/bc4.rs", "fn f() { crate::format::g() }"), [2]);
        assert_eq!(breaks("brick.rs", "use super::tree;"), [2]);
        assert_eq!(breaks("tree.rs", "use crate::sample::trilinear;"), [2]);
        assert_eq!(breaks("error.rs", "use crate::colour::Curve;"), [2]);

        assert_eq!(breaks("format.rs", "use crate::{brick::Brick, codec};\nuse super::tree::Tree;"), [0; 0]);
        assert_eq!(breaks("sample.rs", "use crate::accessor::Accessor;"), [0; 0]);
        assert_eq!(breaks("codec/bc4.rs", "use super::format;"), [0; 0]);
        assert_eq!(breaks("error.rs", "use crate::space::Box3;\nuse crate::Error;"), [0; 0]);
        assert_eq!(breaks("lib.rs", "pub use crate::format::Container;"), [0; 0]);
        assert_eq!(breaks("space.rs", "#[cfg(test)]\nmod tests {\n    use crate::format;\n}"), [0; 0]);
    }

    #[test]
    fn comments_and_strings_are_blanked_and_nothing_else() {
        for (text, code) in [
            ("a // b\nc", "a     \nc"),
            ("a /* b /* c */\n d */ e", "a             \n      e"),
            ("f(\"a\\\"b\") + 'x' + '\\'' + g", "f(      ) +     +      + g"),
            ("r#\"a\"b\"# c", "         c"),
            ("br\"\\\" c", "      c"),
            ("for<'a> &'a str", "for<'a> &'a str"),
            ("bar(r)", "bar(r)"),
            ("\"open", "     "),
            ("/* open é", "         "),
            ("'é'", "   "),
        ] {
            assert_eq!(without_comments_and_strings(text), code, "{text}");
        }
    }
}
