//! The page: measurements, slopes, and the large scene on paper.

use super::axes::{AXES, Fit, along, beyond};
use crate::page::{PageError, io};
use crate::plot::short;
use segwild_eval::record::Results;
use segwild_eval::stamp::{self, providers};
use segwild_flow::files;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

/// The scene that does not fit here.
const LARGE_PHOTOS: f64 = 10_000.0;
const LARGE_SPLATS: f64 = 10e6;
/// Steps of such a training: each photo is used three times.
const LARGE_STEPS: f64 = 30_000.0;

/// The page in Markdown.
pub fn markdown(results: &Results) -> String {
    let made = &results.made;
    let by = providers([results]);
    let mut text = format!(
        "# {}\n\n{} This page is generated. {}\n\nSlopes are of log-log fits: 1 is linear, 0 does not \
         grow; the last is between the two largest sizes, where fixed costs count least. Kernel passes are CPU milliseconds over \
         splats of 0.5 to 3 px (at a width of 400); whole runs are synthetic scenes, 16 photos of 128 \
         px and 300 steps unless that is what grows, caches of a fixed size, each in a process of its own. Of clicks, it is the photos \
         that grow: medians over two clicks anywhere on each object, of the seconds to the first and to the last answer, and of the \
         photos that were visited.\n",
        stamp::title("How it grows", &by),
        stamp::first_sentence(&by, &[]),
        stamp::stamp(made, &by)
    );
    for axis in AXES {
        let numbers: BTreeSet<&str> = results
            .records
            .iter()
            .filter(|r| r.setting == axis)
            .flat_map(|r| r.numbers.keys().map(String::as_str))
            .filter(|n| *n != "wall_s")
            .collect();
        if numbers.is_empty() {
            continue;
        }
        let names: Vec<&str> = numbers.into_iter().collect();
        let _ = writeln!(
            text,
            "\n## {axis}\n\n| {axis} | {} |\n|---:|{}",
            names.join(" | "),
            "---:|".repeat(names.len())
        );
        let mut sizes: Vec<f64> =
            results.records.iter().filter(|r| r.setting == axis).filter_map(|r| r.at).collect();
        sizes.sort_by(f64::total_cmp);
        for size in sizes {
            let cell = |name: &&str| {
                let points = along(results, axis, name);
                points.iter().find(|p| p.0 == size).map_or(String::new(), |p| figure(p.1))
            };
            let cells: Vec<String> = names.iter().map(cell).collect();
            let _ = writeln!(text, "| {} | {} |", short(size), cells.join(" | "));
        }
        let fits: Vec<Option<Fit>> = names.iter().map(|n| Fit::of(&along(results, axis, n))).collect();
        for (word, pick) in [("slope", (|f: &Fit| f.slope) as fn(&Fit) -> f64), ("last slope", |f| f.last)] {
            let cells: Vec<String> = fits
                .iter()
                .map(|f| f.as_ref().map_or(String::new(), |f| format!("{:.2}", pick(f))))
                .collect();
            let _ = writeln!(text, "| {word} | {} |", cells.join(" | "));
        }
    }
    text + &large(results)
}

fn figure(value: f64) -> String {
    if value >= 100.0 { format!("{value:.0}") } else { format!("{value:.2}") }
}

/// The large scene, from what was measured.
fn large(results: &Results) -> String {
    let pass = |name: &str| beyond(&along(results, "kernels splats", name), LARGE_SPLATS, 1.0);
    let (Some(project), Some(forward), Some(backward), Some(gather)) =
        (pass("project_ms"), pass("forward_ms"), pass("backward_ms"), pass("gather_ms"))
    else {
        return String::new();
    };
    let hours = |ms: f64| ms / 3.6e6;
    let mut parts = vec![
        (
            format!(
                "training, {} steps of {:.1} CPU-s (project {:.1}, forward {:.1}, backward {:.1})",
                short(LARGE_STEPS),
                (project + forward + backward) / 1e3,
                project / 1e3,
                forward / 1e3,
                backward / 1e3
            ),
            hours(LARGE_STEPS * (project + forward + backward)),
        ),
        (
            format!(
                "lifting and visibility, two passes over every photo at {:.1} CPU-s",
                (project + forward + gather) / 1e3
            ),
            hours(2.0 * LARGE_PHOTOS * (project + forward + gather)),
        ),
    ];
    // What a photo costs beside the steps: its sky, embedding, masks, transients.
    let photos = along(results, "photos", "cpu_s");
    if let [.., (fewer, less), (more, most)] = photos[..] {
        let each = ((most - less) / (more - fewer)).max(0.0);
        parts.push((
            format!(
                "sky, embedding, masks and transients of {} photos at {each:.2} CPU-s (at 128 px)",
                short(LARGE_PHOTOS)
            ),
            each * LARGE_PHOTOS / 3600.0,
        ));
    }
    let mut text = format!(
        "\n## On paper: {} photos, {} splats\n\nFrom the largest sizes measured, by the last slopes, but at least linear. No such scene \
         was run.\n\n| what | CPU hours |\n|---|---:|\n",
        short(LARGE_PHOTOS),
        short(LARGE_SPLATS)
    );
    parts.sort_by(|a, b| b.1.total_cmp(&a.1));
    for (what, hours) in &parts {
        let _ = writeln!(text, "| {what} | {hours:.1} |");
    }
    let whole: f64 = parts.iter().map(|p| p.1).sum();
    let (first, most) = &parts[0];
    let name = first.split(',').next().unwrap_or("");
    let _ = writeln!(
        text,
        "\nThe bottleneck of time is **{name}**: {:.0} % of {whole:.0} CPU hours. ",
        100.0 * most / whole
    );
    let memory = along(results, "splats", "peak_mib");
    let photos = along(results, "photos", "peak_mib");
    if let ([(_, less), .., (more, most)], Some(&(_, base))) = (&memory[..], memory.first()) {
        let reached = along(results, "splats", "splats");
        let (from, to) = match (reached.first(), reached.last()) {
            // Runs that did not keep the splats they were allowed say nothing of what a splat takes.
            (Some(first), Some(last)) if last.1 > 0.7 * more => (first.1, last.1),
            _ => {
                return text
                    + "\nMemory is not extrapolated: these runs did not keep the splats they were allowed, and so do not say what \
                       a splat takes.\n";
            }
        };
        let each = (most - less) / (to - from);
        let gib = each * LARGE_SPLATS / 1024.0;
        let grow = match photos[..] {
            [(few, a), .., (many, b)] => format!("; photos add {:.3} MiB each", (b - a) / (many - few)),
            _ => String::new(),
        };
        let _ = writeln!(
            text,
            "\nOf memory it is **the splats' state**: {:.1} KiB a splat between {} and {} of them (parameters, Adam's moments, gradients, \
             features and their copies while a checkpoint is written), {gib:.0} GiB for {}, beside {base:.0} MiB that a small run \
             takes{grow}.",
            1024.0 * each,
            short(from),
            short(to),
            short(LARGE_SPLATS)
        );
    }
    text
}

/// Writes the page to a file.
pub fn write(page: &Path, results: &Results) -> Result<(), PageError> {
    io(page, files::write_plain(page, markdown(results)))
}
