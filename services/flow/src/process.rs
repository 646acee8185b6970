//! The process as the operating system sees it (Linux).

use std::fs;

/// What a process takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Usage {
    /// Resident memory in bytes.
    pub rss_bytes: u64,
    /// The most resident memory it ever had, in bytes.
    pub peak_rss_bytes: u64,
    /// Threads.
    pub threads: u64,
}

/// What this process takes now; `None` where the system does not tell.
///
/// ```
/// if let Some(usage) = segwild_flow::process::usage() {
///     assert!(usage.peak_rss_bytes >= usage.rss_bytes / 2 && usage.threads >= 1);
/// }
/// ```
pub fn usage() -> Option<Usage> {
    let text = fs::read_to_string("/proc/self/status").ok()?;
    let field = |name: &str| -> Option<u64> {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
        line.split_whitespace().next()?.parse().ok()
    };
    Some(Usage {
        rss_bytes: field("VmRSS")? << 10,
        peak_rss_bytes: field("VmHWM")? << 10,
        threads: field("Threads")?,
    })
}
