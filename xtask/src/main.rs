//! Chores of the repository: `cargo xtask tidy`, and with the feature `isa`
//! `xtask bench isa SHADER...`.
//!
//! Nothing that a user of nuage runs lives here.

#[cfg(feature = "isa")]
mod isa;
mod tidy;

use std::process::ExitCode;

const USAGE: &str =
    "usage: cargo xtask tidy | bench isa SHADER.wgsl|SHADER.spv... (the latter with --features isa)";

#[expect(clippy::print_stderr, reason = "a command line program reports here")]
fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    #[cfg(feature = "isa")]
    if let [bench, isa, shaders @ ..] = arguments.as_slice()
        && bench == "bench"
        && isa == "isa"
        && !shaders.is_empty()
    {
        return match isa::print(shaders) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("bench isa: {error}");
                ExitCode::FAILURE
            }
        };
    }
    if arguments != ["tidy"] {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    }
    match tidy::check_workspace() {
        Ok(findings) if findings.is_empty() => ExitCode::SUCCESS,
        Ok(findings) => {
            for finding in &findings {
                eprintln!("{finding}");
            }
            eprintln!("tidy: {} to mend", findings.len());
            ExitCode::FAILURE
        }
        Err(error) => {
            eprintln!("tidy: {error}");
            ExitCode::FAILURE
        }
    }
}
