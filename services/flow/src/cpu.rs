//! How much processor time and memory was used, where the operating system reports it (Linux).

use std::fs;

/// Most memory that the process has held at once so far, in bytes; `None` where the system does not report it.
///
/// ```
/// if let Some(bytes) = segwild_flow::cpu::peak_memory() {
///     assert!(bytes > 100_000);
/// }
/// ```
pub fn peak_memory() -> Option<u64> {
    kib(&fs::read_to_string("/proc/self/status").ok()?, "VmHWM:")
}

/// Memory of the machine that is free, or can be freed at once, in bytes; `None` where the system does not report it.
///
/// ```
/// if let Some(bytes) = segwild_flow::cpu::available_memory() {
///     assert!(bytes > 100_000);
/// }
/// ```
pub fn available_memory() -> Option<u64> {
    kib(&fs::read_to_string("/proc/meminfo").ok()?, "MemAvailable:")
}

/// Bytes of the line that starts with a word and gives KiB.
fn kib(text: &str, word: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(word))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib * 1024)
}

/// Processor seconds of the calling thread since it began; `None` where the system does not report it.
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

/// The cores that this process may run on, by number; empty where the system does not report it.
///
/// ```
/// let cores = segwild_flow::cpu::allowed();
/// assert!(cores.windows(2).all(|two| two[0] < two[1]));
/// ```
pub fn allowed() -> Vec<u32> {
    let text = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let list = text.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
    list.and_then(|list| read_list(list.trim())).unwrap_or_default()
}

/// Numbers and ranges with commas: `0-3,8`; `None` if it is something else.
///
/// ```
/// assert_eq!(segwild_flow::cpu::read_list("0-2,8"), Some(vec![0, 1, 2, 8]));
/// assert_eq!(segwild_flow::cpu::read_list("2-0"), None);
/// ```
pub fn read_list(text: &str) -> Option<Vec<u32>> {
    let mut cores = Vec::new();
    for part in text.split(',') {
        let (from, to) = part.split_once('-').unwrap_or((part, part));
        let (from, to): (u32, u32) = (from.parse().ok()?, to.parse().ok()?);
        if to < from || to >= 4096 {
            return None;
        }
        cores.extend(from..=to);
    }
    Some(cores)
}

/// Keeps the calling thread, and all that it starts from now on, to some cores.
///
/// # Errors
/// When the system refuses: none of them exists, or the process may use none of them.
pub fn keep_to(cores: &[u32]) -> std::io::Result<()> {
    #[cfg(target_os = "linux")]
    {
        let mut set = rustix::thread::CpuSet::new();
        let known = |&&core: &&u32| (core as usize) < rustix::thread::CpuSet::MAX_CPU;
        cores.iter().filter(known).for_each(|&core| set.set(core as usize));
        rustix::thread::sched_setaffinity(None, &set)?;
    }
    let _ = cores;
    Ok(())
}
