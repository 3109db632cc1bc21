//! Work on numbered tasks whose results keep their order: in parallel with the feature `parallel`, else one
//! by one.

/// The results of `run` for all tasks. Each thread makes its own `scratch`.
#[cfg(feature = "parallel")]
pub(super) fn in_order<S, T: Send>(
    tasks: usize,
    scratch: impl Fn() -> S + Send + Sync,
    run: impl Fn(&mut S, usize) -> T + Send + Sync,
) -> Vec<T> {
    use rayon::prelude::*;
    (0..tasks).into_par_iter().map_init(scratch, run).collect()
}

/// The results of `run` for all tasks.
#[cfg(not(feature = "parallel"))]
pub(super) fn in_order<S, T>(
    tasks: usize,
    scratch: impl Fn() -> S,
    run: impl Fn(&mut S, usize) -> T,
) -> Vec<T> {
    let mut scratch = scratch();
    (0..tasks).map(|task| run(&mut scratch, task)).collect()
}
