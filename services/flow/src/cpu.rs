//! How much processor time and memory was used, where the operating system tells (Linux).

use std::fs;

/// Most memory that the process has held at once so far, in bytes; `None` where the system does not tell.
///
/// ```
/// if let Some(bytes) = segwild_flow::cpu::peak_memory() {
///     assert!(bytes > 100_000);
/// }
/// ```
pub fn peak_memory() -> Option<u64> {
    let text = fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib * 1024)
}

/// Processor seconds of the calling thread since it began; `None` where the system does not tell.
///
/// ```
/// if let Some(seconds) = segwild_flow::cpu::thread_seconds() {
///     assert!(seconds >= 0.0);
/// }
/// ```
pub fn thread_seconds() -> Option<f64> {
    let text = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    let nanoseconds: u64 = text.split_whitespace().next()?.parse().ok()?;
    Some(nanoseconds as f64 * 1e-9)
}

/// Processor seconds of the whole process since it began, in steps of 10 ms; `None` where the system does not
/// tell. The difference over a stage is what the stage cost if nothing else ran.
///
/// ```
/// if let Some(seconds) = segwild_flow::cpu::process_seconds() {
///     assert!(seconds >= 0.0);
/// }
/// ```
pub fn process_seconds() -> Option<f64> {
    let text = fs::read_to_string("/proc/self/stat").ok()?;
    // The second field is the program's name in brackets and may hold blanks; utime and stime are the 14th
    // and 15th, in ticks of 1/100 s (the kernel's fixed USER_HZ).
    let after = &text[text.rfind(')')? + 1..];
    let mut fields = after.split_whitespace().skip(11);
    let user: u64 = fields.next()?.parse().ok()?;
    let system: u64 = fields.next()?.parse().ok()?;
    Some((user + system) as f64 / 100.0)
}
