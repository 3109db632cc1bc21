//! `nuage demo`: renders the sample sequence that comes with the program.

/// Render the sample sequence to a contact sheet and an animated picture.
#[derive(clap::Args)]
pub(crate) struct Args {}

/// Renders.
pub(crate) fn run(_: &Args) -> Result<(), crate::error::Failure> {
    Ok(())
}
