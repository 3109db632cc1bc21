//! Chores of the repository: `cargo xtask tidy` and `cargo xtask bench isa SHADER...`.
//!
//! Nothing that a user of nuage runs lives here.

#[cfg(feature = "isa")]
mod isa;
mod tidy;

use std::error::Error;
use std::process::ExitCode;

const USAGE: &str = "usage: cargo xtask tidy | bench isa SHADER.wgsl|SHADER.spv...";

#[cfg(feature = "isa")]
fn bench_isa(shaders: &[String]) -> Result<(), Box<dyn Error>> {
    isa::print(shaders)
}

/// Once more by a program that has what this takes, for which `tidy` need not wait.
#[cfg(not(feature = "isa"))]
fn bench_isa(shaders: &[String]) -> Result<(), Box<dyn Error>> {
    let features = ["run", "--quiet", "--package", "xtask", "--features", "isa", "--", "bench", "isa"];
    let status = std::process::Command::new(env!("CARGO")).args(features).args(shaders).status()?;
    if status.success() { Ok(()) } else { Err("it failed".into()) }
}

#[expect(clippy::print_stderr, reason = "a command line program reports here")]
fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [bench, isa, shaders @ ..] = arguments.as_slice()
        && bench == "bench"
        && isa == "isa"
        && !shaders.is_empty()
    {
        return match bench_isa(shaders) {
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
