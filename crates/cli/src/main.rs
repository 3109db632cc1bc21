//! The program `nuage`: reads the command line, hands over to one module per subcommand and turns the outcome
//! into an exit code.
//!
//! A subcommand takes its arguments and returns; it never ends the process itself. What it computes lives in
//! the libraries, what it prints in modules of its own.

mod bench;
mod convert;
mod demo;
mod denoise;
mod device;
mod diff;
mod error;
mod eval;
mod frames;
mod grid;
mod info;
mod json;
mod look;
mod pack;
mod plan;
mod probe;
mod progress;
mod render;
mod sample;
mod scene_file;
mod shot;
mod source;
mod text;
mod texture;
mod trace;
mod validate;
mod values;
mod verify;

use std::process::ExitCode;

use clap::error::ErrorKind;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::error::Failure;
use crate::plan::Given;

const AFTER_HELP: &str = "Exit codes: 0 done, 1 failed, 2 wrong usage.";

/// Look into OpenVDB files and render them.
#[derive(Parser)]
#[command(name = "nuage", version, about, after_help = AFTER_HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Info(info::Args),
    Probe(probe::Args),
    Render(Box<render::Args>),
    Bench(bench::Args),
    Demo(demo::Args),
    Diff(Box<diff::Args>),
    Validate(validate::Args),
    Convert(Box<convert::Args>),
    Texture(texture::Args),
    Eval(eval::Args),
}

fn main() -> ExitCode {
    let matches = Cli::command().get_matches();
    let command = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit()).command;
    let outcome = match command {
        Command::Info(args) => info::run(&args),
        Command::Probe(args) => probe::run(&args),
        Command::Render(args) => {
            let given = matches.subcommand_matches("render").map(Given::of).unwrap_or_default();
            render::run(&args, &given)
        }
        Command::Bench(args) => bench::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Diff(args) => diff::run(&args),
        Command::Validate(args) => validate::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Texture(args) => texture::run(&args),
        Command::Eval(args) => eval::run(&args),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever reads our output has seen enough: `nuage info x | head -1`.
        Err(Failure::Output(error)) if error.kind() == std::io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(Failure::Usage(message)) => Cli::command().error(ErrorKind::ValueValidation, message).exit(),
        Err(failure) => {
            failure.report();
            ExitCode::FAILURE
        }
    }
}
