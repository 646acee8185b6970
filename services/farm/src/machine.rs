//! What this machine has, or what of it this process may use.

use std::path::{Path, PathBuf};

use crate::job::Needs;

/// Where control groups are.
const GROUPS: &str = "/sys/fs/cgroup";

/// Cores and memory of this machine; where the system does not tell its memory (it does on Linux), 4 GiB.
pub(crate) fn whole() -> Needs {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    Needs { cores, memory_bytes: memory().unwrap_or(4 << 30), accelerators: 0 }
}

fn memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let machine = line.split_whitespace().next()?.parse::<u64>().ok()? << 10;
    let own = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let limit = |file: PathBuf| std::fs::read_to_string(file).ok()?.trim().parse::<u64>().ok();
    Some(limit_files(&own).into_iter().filter_map(limit).fold(machine, u64::min))
}

/// The files that limit the memory of a process with these control groups (`/proc/self/cgroup`). A container sees its own
/// limit at the root; a service of systemd has it in its group, or in one above.
fn limit_files(own: &str) -> Vec<PathBuf> {
    let group = own.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default();
    let groups = Path::new(group).ancestors().map(|above| Path::new(GROUPS).join(above).join("memory.max"));
    // Version 1 says it elsewhere.
    groups.chain([Path::new(GROUPS).join("memory/memory.limit_in_bytes")]).collect()
}

#[cfg(test)]
mod tests {
    use super::limit_files;

    #[test]
    fn a_limit_of_the_service_or_of_what_it_is_part_of_is_found() {
        let files = limit_files("1:name=x:/y\n0::/system.slice/segwild-batch@a.service\n");
        let files: Vec<_> = files.iter().map(|file| file.to_string_lossy()).collect();
        let expected = [
            "/sys/fs/cgroup/system.slice/segwild-batch@a.service/memory.max",
            "/sys/fs/cgroup/system.slice/memory.max",
            "/sys/fs/cgroup/memory.max",
            "/sys/fs/cgroup/memory/memory.limit_in_bytes",
        ];
        assert_eq!(files, expected);
        assert!(limit_files("").iter().any(|file| file.ends_with("cgroup/memory.max")));
    }
}
