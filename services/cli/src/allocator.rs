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
    // SAFETY: it only sets a number. Where it is refused, nothing has changed.
    unsafe { libc::mallopt(libc::M_ARENA_MAX, heaps() as libc::c_int) };
}

/// Their number.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn heaps() -> usize {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    (cores / 4).clamp(2, 16)
}

/// Other allocators share their memory among threads by themselves.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn share_heaps() {}

/// Images of the size of a run that a heap keeps when they are freed. A step of the training makes and frees some twenty of them; each
/// that went back to the system would come again page by page, which is a quarter of a step at 1600 px
/// (docs/experiments/2026-12-01-steps-on-large-photos.md).
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const KEPT_IMAGES: u64 = 12;
/// Share of the memory budget that all heaps keep at most.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const OF_BUDGET: u64 = 16;

/// Keeps freed images of a run whose photos have such a long side, within its memory budget in MiB (0: none).
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub fn keep_images(long_side: u32, budget_mib: u32) {
    let own = ["MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"];
    if own.iter().any(|name| std::env::var_os(name).is_some()) {
        return;
    }
    // Three planes of numbers, 4 to 3.
    let image = u64::from(long_side).pow(2) * 3 / 4 * 12;
    let most = if budget_mib == 0 { u64::MAX } else { (u64::from(budget_mib) << 20) / OF_BUDGET };
    let kept = (KEPT_IMAGES * image).max(2 * LARGEST_OF_A_HEAP).min(most / heaps() as u64);
    let bytes = |bytes: u64| libc::c_int::try_from(bytes).unwrap_or(libc::c_int::MAX);
    // SAFETY: they only set numbers. Where one is refused, nothing has changed.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, bytes(LARGEST_OF_A_HEAP));
        libc::mallopt(libc::M_TRIM_THRESHOLD, bytes(kept));
    }
}

/// What is larger never comes from a heap. The C library lets both thresholds rise up to this, and to its double, with what a program
/// frees, unless one of them is set.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGEST_OF_A_HEAP: u64 = 32 << 20;

/// Other allocators decide by themselves.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn keep_images(_long_side: u32, _budget_mib: u32) {}
