//! Memory does not grow with the photos.

use super::row::{FlowError, FlowOptions, Row, io};
use super::scene::{fresh, write_scene};
use std::path::Path;
use std::process::Command;

/// MiB given to each run.
const BUDGET: u32 = 200;

/// Runs a scene in a process of its own; the most memory it held, in bytes, and its splats.
fn peak(program: &Path, scene: &Path, run: &Path) -> Result<(f64, u64), FlowError> {
    let mut command = Command::new(program);
    command.arg("run").arg(scene).arg("--out").arg(run).args([
        "--json",
        "--preset",
        "draft",
        "--size",
        "128",
        "--steps",
        "1200",
        "--splats",
        "6000",
        "--refine-steps",
        "100",
        "--prompt-budget",
        "16",
        // Caches of a fixed size, full in both.
        "--photo-cache-mib",
        "4",
        "--feature-memory",
        "8",
        "--vision-memory",
        "16",
        "--memory-budget",
    ]);
    let output = io("start segwild", command.arg(BUDGET.to_string()).output())?;
    let text = String::from_utf8_lossy(&output.stdout);
    let last: serde_json::Value =
        text.lines().last().and_then(|l| serde_json::from_str(l).ok()).unwrap_or_default();
    let bytes = last["summary"]["peak_bytes"].as_f64();
    let splats = last["summary"]["splats"].as_u64();
    bytes.zip(splats).ok_or_else(|| {
        let error = String::from_utf8_lossy(&output.stderr);
        FlowError::Child(format!("{} ended with {}: {}", scene.display(), output.status, error.trim()))
    })
}

/// The most memory that a run of many photos holds, over that of a run of few, at the same number of splats.
pub fn memory(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("memory"))?;
    let mut peaks = Vec::new();
    for photos in options.photos {
        let scene = dir.join(format!("scene-{photos}"));
        write_scene(&scene, photos, 128)?;
        peaks.push(peak(&options.program, &scene, &dir.join(format!("run-{photos}")))?);
    }
    let mib = |bytes: f64| bytes / f64::from(1 << 20);
    let [few, many] = options.photos;
    let largest = mib(peaks[1].0);
    Ok(vec![
        Row {
            name: "memory".into(),
            what: "peak memory with many photos over that with few".into(),
            value: peaks[1].0 / peaks[0].0,
            bar: 1.2,
            from: format!(
                "{few} photos {:.0} MiB ({} splats), {many} photos {largest:.0} MiB ({} splats)",
                mib(peaks[0].0),
                peaks[0].1,
                peaks[1].1
            ),
            load: None,
        },
        Row {
            name: "memory, budget".into(),
            what: "peak memory over `--memory-budget`".into(),
            value: largest / f64::from(BUDGET),
            bar: 1.0,
            from: format!("{largest:.0} of {BUDGET} MiB"),
            load: None,
        },
    ])
}
