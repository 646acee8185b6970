//! Settings of the C library's allocator.

/// Blocks from this size on, in bytes, come from the system one by one and go back when they are freed. The C library's own bound
/// grows with the largest block that was freed, up to 32 MiB: images then stay in the heaps. From 256 KiB on, the system takes twice
/// the time, and a run 7 % more.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGE_BLOCK: libc::c_int = 1 << 20;

/// Bounds what the heaps keep of freed memory (docs/experiments/2026-11-29-memory-of-many-photos.md).
///
/// The C library gives each thread a heap of its own, up to eight per core, and hardly any of what is freed in one comes back to
/// the system: the actors' threads then hold twice the memory that they use. Two heaps are as fast on two cores.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub fn bound_heaps() {
    let chosen = |name: &str| std::env::var_os(name).is_some();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let heaps = (cores / 4).clamp(2, 16) as libc::c_int;
    // A person's own choice stands.
    // SAFETY: each call only sets a number. Where one is refused, nothing has changed.
    unsafe {
        if !chosen("MALLOC_ARENA_MAX") {
            libc::mallopt(libc::M_ARENA_MAX, heaps);
        }
        if !chosen("MALLOC_MMAP_THRESHOLD_") {
            libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BLOCK);
        }
    }
}

/// Other allocators share their memory among threads by themselves.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn bound_heaps() {}
