//! What this machine has.

use crate::job::Needs;

/// Cores and memory of this machine; where the system does not tell its memory (it does on Linux), 4 GiB.
pub(crate) fn whole() -> Needs {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    Needs { cores, memory_bytes: memory().unwrap_or(4 << 30), accelerators: 0 }
}

fn memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let machine = line.split_whitespace().next()?.parse::<u64>().ok()? << 10;
    // A container may have less than its machine; versions 2 and 1 of control groups say so in different places.
    let files = ["/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"];
    let limits =
        files.iter().filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse::<u64>().ok());
    Some(limits.fold(machine, u64::min))
}
