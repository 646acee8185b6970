//! Compute threads that belong to one actor.
//!
//! Kernels split their work with rayon, which puts it into the pool of the thread that calls it. A worker therefore
//! lives inside a pool of its own: what an actor computes runs on threads that bear its name, never on those of
//! another actor, of the process's global pool or of an async runtime, and a long kernel of one actor is never queued in
//! front of a short one of another. Between the pools of the actors that are busy the operating system decides.

use std::thread;

/// How many threads a pool gets when 0 are requested: one per core.
pub fn all_cores() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

/// Runs a worker's whole life inside a pool of `threads` threads, named after it; the worker takes one of them.
/// A machine that refuses so many threads still gives the one that this is called on.
pub(crate) fn within<T: Send>(
    name: &str,
    threads: usize,
    stack: usize,
    life: impl FnOnce() -> T + Send,
) -> T {
    let threads = if threads == 0 { all_cores() } else { threads };
    let named = name.to_owned();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .stack_size(stack)
        .thread_name(move |i| format!("{named}/{i}"))
        .build();
    match pool {
        Ok(pool) => pool.install(life),
        Err(error) => {
            tracing::warn!("{name} computes in the common pool: {error}");
            life()
        }
    }
}
