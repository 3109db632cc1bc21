//! The time that a program was running, for benchmarks on machines that do other work too.

use std::sync::OnceLock;
use std::time::Instant;

/// Milliseconds for which threads of this program that are still there had a processor; where the system does not tell, those
/// since the first call. Linux tells them in steps of a few milliseconds.
pub fn processor_ms() -> f64 {
    static FIRST: OnceLock<Instant> = OnceLock::new();
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let nanoseconds = threads.filter_map(|thread| {
        let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    });
    let told = nanoseconds.reduce(|sum, of_thread| sum + of_thread);
    told.map_or_else(|| FIRST.get_or_init(Instant::now).elapsed().as_secs_f64() * 1e3, |sum| sum * 1e-6)
}
