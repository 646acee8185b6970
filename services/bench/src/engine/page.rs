//! The page: every pass of every target.

use super::record::KERNEL;
use super::speed::STEP;
use crate::page::{PageError, io};
use segwild_eval::record::{Record, Results};
use segwild_eval::stamp::{self, providers};
use segwild_flow::files;
use std::fmt::Write as _;
use std::path::Path;

/// So many kernels of a pass are named on the page, if they take such a share of it.
const NAMED: usize = 3;
const WORTH_NAMING: f64 = 0.05;

/// The page in Markdown.
pub fn markdown(results: &Results) -> String {
    let made = &results.made;
    let by = providers([results]);
    let mut text = format!(
        "# The accelerator engine's speed\n\n{} This page is generated. {}\n\nEach pass is repeated and waited \
         for once; its floor is the longer of its arrays, each moved once, at the bandwidth of a copy, and its operations, at \
         every pixel of every tile that a splat touches, at the rate of a kernel that only multiplies and adds (where \
         light runs out early, less is done). The CPU's milliseconds are of wall clock on all its cores; those of kernels are by the device's own clock, all \
         runs of a kernel in the pass together.\n",
        stamp::first_sentence(&by, &[]),
        stamp::stamp(made, &by)
    );
    let number = |record: &Record, name: &str| record.numbers.get(name).copied();
    let mut targets: Vec<&str> = Vec::new();
    for record in &results.records {
        if record.setting == "reach" {
            let giga = |name| number(record, name).unwrap_or(0.0) / 1e9;
            let _ = writeln!(
                text,
                "\nA copy moves {:.1} GB/s, a multiply-add chain does {:.1} GFLOP/s.",
                giga("bytes_per_s"),
                giga("operations_per_s")
            );
            for note in &record.notes {
                let _ = writeln!(text, "\n**{note}.**");
            }
        } else if !targets.contains(&record.target.as_str()) {
            targets.push(&record.target);
        }
    }
    for target in targets {
        let _ = writeln!(text, "\n## {target}\n");
        let rows: Vec<&Record> = results.records.iter().filter(|r| r.target == target).collect();
        if let Some(refused) = rows.iter().find(|r| r.setting == "refused") {
            let _ = writeln!(text, "Refused: {}.", refused.notes.join("; "));
            continue;
        }
        if rows.iter().any(|r| r.setting.starts_with("training")) {
            trained(&mut text, &rows);
            continue;
        }
        text.push_str(
            "| pass | ms | floor, ms | share of the floor | CPU, ms | CPU / this | slowest kernels, ms |\n\
             |---|---:|---:|---:|---:|---:|---|\n",
        );
        for row in &rows {
            let cell = |name: &str, decimals: usize| {
                number(row, name).map_or(String::new(), |v| format!("{v:.decimals$}"))
            };
            let share = number(row, "share").map_or(String::new(), |v| format!("{:.1} %", 100.0 * v));
            let cells = [cell("ms", 3), cell("floor_ms", 3), share, cell("cpu_ms", 2), cell("ratio", 2)];
            let _ = writeln!(text, "| {} | {} | {} |", row.setting, cells.join(" | "), slowest(row));
        }
        let mut far: Vec<(f64, &str)> =
            rows.iter().filter_map(|r| Some((number(r, "share")?, r.setting.as_str()))).collect();
        far.sort_by(|a, b| a.0.total_cmp(&b.0));
        let far: Vec<&str> = far.iter().take(3).map(|f| f.1).collect();
        let _ = writeln!(text, "\nFurthest from their floors: {}.", far.join("; "));
        if let Some(ms) = rows.iter().find(|r| r.setting == STEP).and_then(|r| number(r, "ms")) {
            let splats =
                target.split_once(' ').and_then(|(count, _)| count.parse::<f64>().ok()).unwrap_or(0.0);
            let (steps, millions) = (1e3 / ms, 1e-3 * splats / ms);
            let _ = writeln!(text, "{steps:.1} steps a second: {millions:.3} million splats a second.");
        }
        counted(&mut text, &rows);
    }
    text
}

/// What each pass gives the device to do.
fn counted(text: &mut String, rows: &[&Record]) {
    if rows.iter().all(|row| !row.numbers.contains_key("launches")) {
        return;
    }
    text.push_str(
        "\nCounted, the same on every device: kernels launched (each waits for the one before, by a barrier), compute passes that hold \
         them, copies and clears, submissions, waits of the host, what crosses between host and device, and the arrays of all \
         launches, beside the pass's arrays counted once.\n\n\
         | pass | launches | compute passes | copies | submissions | waits | host, KB | arrays of launches, MB | once, MB |\n\
         |---|---:|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    for row in rows {
        let number = |name: &str| row.numbers.get(name).copied().unwrap_or(0.0);
        let counts = ["launches", "passes", "copies", "submissions", "waits"]
            .map(|name| format!("{:.0}", number(name)));
        let _ = writeln!(
            text,
            "| {} | {} | {:.1} | {:.2} | {:.2} |",
            row.setting,
            counts.join(" | "),
            number("host_bytes") / 1e3,
            number("bound_bytes") / 1e6,
            number("floor_bytes") / 1e6
        );
    }
}

/// A pass's slowest kernels.
fn slowest(row: &Record) -> String {
    let least = WORTH_NAMING * row.numbers.get("ms").copied().unwrap_or(0.0);
    let kernels = row.numbers.iter().filter_map(|(name, &ms)| Some((name.strip_prefix(KERNEL)?, ms)));
    let mut kernels: Vec<(&str, f64)> = kernels.filter(|&(_, ms)| ms >= least).collect();
    kernels.sort_by(|a, b| b.1.total_cmp(&a.1));
    let named = kernels.iter().take(NAMED).map(|(name, ms)| format!("{name} {ms:.3}"));
    named.collect::<Vec<_>>().join(", ")
}

/// How long trainings took.
fn trained(text: &mut String, rows: &[&Record]) {
    text.push_str("| engine | seconds | steps | splats at the end | best, dB |\n|---|---:|---:|---:|---:|\n");
    for row in rows {
        let cell = |name: &str, decimals: usize| {
            row.numbers.get(name).map_or("not reached".into(), |v| format!("{v:.decimals$}"))
        };
        let cells = [cell("seconds", 1), cell("steps", 0), cell("splats", 0), cell("db", 2)];
        let engine = row.setting.trim_start_matches("training, ");
        let _ = writeln!(text, "| {engine} | {} |", cells.join(" | "));
    }
    text.push_str(
        "\nThe mean PSNR of the photos over 100 steps; one light, no transients, the default steps.\n",
    );
}

/// Writes the page.
pub fn write(page: &Path, results: &Results) -> Result<(), PageError> {
    io(page, files::write_plain(page, markdown(results)))
}
