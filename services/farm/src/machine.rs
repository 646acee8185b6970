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
    // A container may have less than its machine.
    let limit = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok();
    let limit = limit.and_then(|text| text.trim().parse::<u64>().ok());
    Some(limit.map_or(machine, |limit| limit.min(machine)))
}
