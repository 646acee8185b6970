//! The page: every curve, where it breaks, and what the program reports there.

use super::curve::{Amount, BREAKS, Curve, curves};
use super::stress::STRESSES;
use crate::page::{PageError, io};
use crate::plot::{Figure, Mark, Panel, PlotSeries, short};
use segwild_eval::metrics::Spread;
use segwild_eval::oracle::ORACLE;
use segwild_eval::record::{Record, Results, means};
use segwild_eval::stamp::{self, providers};
use segwild_flow::files;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

/// The page in Markdown.
pub fn markdown(results: &Results, figure: Option<&str>) -> String {
    let made = &results.made;
    let by = providers([results]);
    let mut text = format!(
        "# {}\n\n{} This page is generated. {}\n\nSynthetic sources; {}; IoU is the mean over objects, on the photos that were \
         not clicked. A curve breaks at the first amount at which IoU is under {BREAKS} of what it is without the stress; it is announced when the program reports \
         something there that it does not report without the stress.\n\n",
        stamp::title("Where it fails, and whether it reports that", &by),
        stamp::first_sentence(&by, &[]),
        stamp::stamp(made, &by),
        if by == [ORACLE] {
            "one click per object"
        } else {
            "a box and clicks on its larger parts per object, or one click where clicks are the stress"
        }
    );
    if let Some(figure) = figure {
        let _ = writeln!(text, "![curves]({figure})\n");
    }
    text +=
        "| stress | what is done | IoU (held-out PSNR) | breaks at | announced |\n|---|---|---|---:|---|\n";
    let all = curves(results);
    for curve in &all {
        let stress = STRESSES.iter().find(|s| s.name == curve.name);
        let along: Vec<String> = curve
            .amounts
            .iter()
            .map(|a| format!("{}: {:.3} ({:.1})", short(a.value), a.iou, a.psnr))
            .collect();
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} |",
            curve.name,
            stress.map_or("", |s| s.meaning),
            along.join("<br>"),
            curve.breaks.map_or("not here".into(), short),
            announced(curve)
        );
    }
    text += &clicks(results);
    text += &seeds(results);
    text += &bytes(results);
    text += &kernels(results);
    text
}

fn announced(curve: &Curve) -> String {
    match (curve.breaks, curve.announced.first(), curve.warned_from) {
        (Some(_), Some(first), _) => format!("yes: “{first}”"),
        (Some(_), None, _) => "**no**".into(),
        (None, _, Some(from)) => format!("a message from {} on", short(from)),
        (None, _, None) => String::new(),
    }
}

/// Ten clicks on each object: the worst counts.
fn clicks(results: &Results) -> String {
    let records: Vec<&Record> =
        results.records.iter().filter(|r| r.setting == "random clicks" && !r.target.is_empty()).collect();
    if records.is_empty() {
        return String::new();
    }
    let mut text = String::from(
        "\n## Ten random clicks per object\n\nAnywhere on the object, in any photo that shows it.\n\n| object | clicks | mean IoU | \
         median | worst | diagnostics of the worst |\n|---|---:|---:|---:|---:|---|\n",
    );
    let names: BTreeSet<(&str, &str)> =
        records.iter().map(|r| (r.scene.as_str(), r.target.as_str())).collect();
    for (scene, target) in names {
        let of: Vec<&&Record> = records.iter().filter(|r| r.target == target && r.scene == scene).collect();
        let mut values: Vec<f64> = of.iter().filter_map(|r| r.numbers.get("iou").copied()).collect();
        values.sort_by(f64::total_cmp);
        let Some(spread) = Spread::of(&values) else { continue };
        let worst = of.iter().find(|r| r.numbers.get("iou") == values.first());
        let message = worst.and_then(|r| r.notes.first()).map_or("none", String::as_str);
        let _ = writeln!(
            text,
            "| {scene}, {target} | {} | {:.3} | {:.3} | {:.3} | {message} |",
            spread.count,
            spread.mean,
            values[values.len() / 2],
            spread.least
        );
    }
    text
}

fn seeds(results: &Results) -> String {
    let mut text = String::new();
    let seeds: BTreeSet<u64> =
        results.records.iter().filter(|r| r.setting == "seeds").map(|r| r.seed).collect();
    for (number, words) in [("iou", "IoU"), ("psnr", "held-out PSNR")] {
        let of = |seed: &u64| {
            let own: Vec<&Record> =
                results.records.iter().filter(|r| r.setting == "seeds" && r.seed == *seed).collect();
            means(&own).get(number).copied()
        };
        let values: Vec<f64> = seeds.iter().filter_map(of).collect();
        if let Some(spread) = Spread::of(&values) {
            let _ =
                writeln!(text, "- {words} of {} trainings that differ by their seed: {spread}", spread.count);
        }
    }
    if text.is_empty() {
        text
    } else {
        format!("\n## Seeds\n\nMean ± standard deviation [least, most].\n\n{text}")
    }
}

fn bytes(results: &Results) -> String {
    let Some(record) = results.records.iter().find(|r| r.setting == "bytes") else { return String::new() };
    let words = if record.numbers.get("same") == Some(&1.0) { "the same bytes" } else { "**other bytes**" };
    format!(
        "\n## The same bytes\n\nThe same training and selections on 1, 2, 4 and again 1 threads: {words} ({}).\n",
        record.notes.join("; ")
    )
}

fn kernels(results: &Results) -> String {
    let records: Vec<&Record> = results.records.iter().filter(|r| r.setting == "kernels").collect();
    if records.is_empty() {
        return String::new();
    }
    let mut text = String::from(
        "\n## Splats of any size\n\nThe CPU engine against the f64 reference.\n\n| standard deviation, px | largest difference of the \
         image | all finite, gradients too | mean opacity |\n|---:|---:|---|---:|\n",
    );
    for r in records {
        let number = |name: &str| r.numbers.get(name).copied().unwrap_or(f64::NAN);
        let finite = if number("finite") == 1.0 { "yes" } else { "**no**" };
        let size = r.at.unwrap_or(0.0);
        let _ = writeln!(text, "| {size:e} | {:.1e} | {finite} | {:.3} |", number("off"), number("light"));
    }
    text
}

/// The curves as one figure.
pub fn figure(results: &Results) -> Figure {
    let panel = |curve: &Curve| {
        let stress = STRESSES.iter().find(|s| s.name == curve.name)?;
        if curve.amounts.len() < 2 {
            return None;
        }
        let mark = |y: f64, a: &Amount| Mark {
            x: a.value,
            y,
            note: format!(
                "{} {}: IoU {:.3}, worst {:.3}, {:.2} dB\n{}",
                curve.name,
                short(a.value),
                a.iou,
                a.worst,
                a.psnr,
                a.messages.join("\n")
            ),
            ..Mark::default()
        };
        let of = |name: &str, pick: fn(&Amount) -> f64| PlotSeries {
            name: name.into(),
            marks: curve.amounts.iter().map(|a| mark(pick(a), a)).collect(),
            line: true,
        };
        Some(Panel {
            title: curve.name.into(),
            x: stress.axis.into(),
            y: "IoU".into(),
            log_x: stress.log,
            series: vec![of("mean of the objects", |a| a.iou), of("the worst object", |a| a.worst)],
            y_from_zero: true,
            ..Panel::default()
        })
    };
    let panels = curves(results).iter().filter_map(panel).collect();
    Figure {
        title: stamp::title("Quality against stress", &providers([results])),
        panels,
        columns: 4,
        panel: [310, 250],
    }
}

/// Writes the page to a file, with its figure beside it as SVG and PNG.
pub fn write(page: &Path, results: &Results) -> Result<(), PageError> {
    let put = |path: &Path, bytes: &[u8]| io(path, files::write_plain(path, bytes));
    let figure = figure(results);
    let (svg, png) = (page.with_extension("svg"), page.with_extension("png"));
    let shown = png.file_name().map(|n| n.to_string_lossy().into_owned());
    let any = !figure.panels.is_empty();
    if any {
        put(&svg, figure.svg()?.as_bytes())?;
        put(&png, &figure.png()?)?;
    }
    put(page, markdown(results, shown.as_deref().filter(|_| any)).as_bytes())
}
