//! Settings of the C library's allocator.

/// Heaps that threads of the program share. The C library gives each thread a heap of its own, up to eight per core, and hardly
/// any of what is freed in one comes back to the system: the actors' threads then hold twice the memory that they use. Two are
/// as fast on two cores (docs/experiments/2026-11-29-memory-of-many-photos.md).
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub fn share_heaps() {
    // A person's own choice stands.
    if std::env::var_os("MALLOC_ARENA_MAX").is_some() {
        return;
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let heaps = (cores / 4).clamp(2, 16) as libc::c_int;
    // SAFETY: it only sets a number. Where it is refused, nothing has changed.
    unsafe { libc::mallopt(libc::M_ARENA_MAX, heaps) };
}

/// Other allocators share their memory among threads by themselves.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn share_heaps() {}
