//! The progress bar: on a terminal only, on standard error.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar over `steps` pictures, each counted in thousandths. Hidden where standard error is no terminal.
pub(crate) fn bar(pictures: usize) -> ProgressBar {
    // Standard error is asked for by name: indicatif hides a bar that is not on a terminal.
    let bar = ProgressBar::with_draw_target(Some(pictures as u64 * 1000), ProgressDrawTarget::stderr());
    let style = ProgressStyle::with_template("{msg} {wide_bar} {percent}% {eta}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

/// Shows how far picture number `picture` has come.
pub(crate) fn show(bar: &ProgressBar, picture: usize, done: u32, total: u32) {
    let thousandths = u64::from(done) * 1000 / u64::from(total.max(1));
    bar.set_position(picture as u64 * 1000 + thousandths);
}
