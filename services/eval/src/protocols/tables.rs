//! Results as tables that a person can read, the paper's figures beside ours.

use super::lego::{PLAIN, Perturbation};
use super::paper::{PAPER, targets};
use super::synthetic::SURFACES;
use crate::ablation::Variant;
use crate::baselines::{BASELINES, named_after, row};
use crate::metrics::Spread;
use crate::record::{LPIPS_COLUMNS, Record, Results};
use crate::stamp::{self, provider, providers};
use segwild_scene::statistics::quantile;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

/// A row of a table: a setting, and who made its masks.
type RowOf<'a> = (&'a str, &'a str);

/// The row that a record belongs to. Rows without masks have a dash for their provider.
fn row_of(record: &Record) -> RowOf<'_> {
    (&record.setting, provider(record).unwrap_or("–"))
}

/// The rows that were measured, in the order in which they first came.
fn rows_of<'a>(records: impl Iterator<Item = &'a Record>) -> Vec<RowOf<'a>> {
    let mut rows = Vec::new();
    for row in records.map(row_of) {
        if !rows.contains(&row) {
            rows.push(row);
        }
    }
    rows
}

/// The rows in which objects were selected.
fn measured(results: &Results) -> Vec<RowOf<'_>> {
    rows_of(results.records.iter().filter(|r| r.numbers.contains_key("iou")))
}

/// One number of the records that fit: the mean over each object's prompts, then over the objects of a seed, then the
/// spread over seeds; so that neither an object with more prompts nor a scene with more objects counts more.
pub fn over_seeds(results: &Results, number: &str, fits: impl Fn(&Record) -> bool) -> Option<Spread> {
    let mut seeds: BTreeMap<(&str, u64), BTreeMap<&str, Vec<f64>>> = BTreeMap::new();
    for r in results.records.iter().filter(|r| fits(r)) {
        if let Some(&value) = r.numbers.get(number) {
            let scene = if r.protocol == "synthetic" { "" } else { r.scene.as_str() };
            seeds.entry((scene, r.seed)).or_default().entry(&r.target).or_default().push(value);
        }
    }
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let of = |objects: BTreeMap<&str, Vec<f64>>| mean(&objects.values().map(|v| mean(v)).collect::<Vec<_>>());
    Spread::of(&seeds.into_values().map(of).collect::<Vec<_>>())
}

/// Mean over objects and seeds of the worst of an object's prompts; `None` where each had one.
fn worst_prompt(results: &Results, row: RowOf) -> Option<f64> {
    let mut worst: BTreeMap<(&str, u64, &str), (f64, usize)> = BTreeMap::new();
    for r in results.records.iter().filter(|r| row_of(r) == row) {
        if let Some(&iou) = r.numbers.get("iou") {
            let entry = worst.entry((&r.scene, r.seed, &r.target)).or_insert((f64::INFINITY, 0));
            *entry = (entry.0.min(iou), entry.1 + 1);
        }
    }
    let several = worst.values().any(|w| w.1 > 1);
    several.then(|| worst.values().map(|w| w.0).sum::<f64>() / worst.len() as f64)
}

/// Lower quartile, median and upper quartile of the IoU over all clicks of a row.
fn quartiles(results: &Results, row: RowOf) -> String {
    let of_row = results.records.iter().filter(|r| row_of(r) == row);
    let values: Vec<f64> = of_row.filter_map(|r| r.numbers.get("iou").copied()).collect();
    let at = |share: f64| quantile(values.clone(), share);
    let shown = [0.25, 0.5, 0.75].map(|share| at(share).map_or("–".into(), |v| format!("{v:.3}")));
    shown.join(" / ")
}

/// A number with its spread, or a dash. One seed has no spread.
fn cell(spread: Option<Spread>, digits: usize) -> String {
    match spread {
        None => "–".into(),
        Some(s) if s.count < 2 => format!("{:.digits$}", s.mean),
        Some(s) => format!("{:.digits$} ± {:.digits$}", s.mean, s.deviation),
    }
}

/// A row per setting: means over objects, with their deviation over seeds.
pub fn summary(results: &Results) -> String {
    const COLUMNS: [(&str, &str, usize); 9] = [
        ("iou", "IoU", 3),
        ("boundary_iou", "Boundary IoU", 3),
        ("accuracy", "accuracy", 4),
        ("amodal_iou", "amodal IoU", 3),
        ("amodal_boundary_iou", "amodal Boundary IoU", 3),
        ("label_iou", "IoU in 3D", 3),
        ("occluded_leak", "leak behind an occluder", 4),
        ("worst", "worst photo", 3),
        ("select_s", "s per click", 1),
    ];
    let has = |number: &str| results.records.iter().any(|r| r.numbers.contains_key(number));
    let columns: Vec<_> = COLUMNS.into_iter().filter(|c| has(c.0)).collect();
    let rows = measured(results);
    let prompts = rows.iter().any(|r| worst_prompt(results, *r).is_some());
    let mut text = String::from("| row | provider | what it is |");
    columns.iter().for_each(|c| text += &format!(" {} |", c.1));
    text += if prompts { " worst prompt |" } else { "" };
    text += " quartiles of the clicks' IoU | worst object |\n|---|---|---|";
    text += &"---:|".repeat(columns.len() + usize::from(prompts));
    text += "---:|---:|\n";
    for key in rows {
        let (name, provider) = key;
        let of = |r: &Record| row_of(r) == key;
        let meaning = row(name).map_or("", |v: &Variant| v.meaning);
        let _ = write!(text, "| {name} | {provider} | {meaning} |");
        for &(number, _, digits) in &columns {
            let spread = over_seeds(results, number, of);
            // What leaks is the worst that any click did.
            let spread = match (number, results.spread(number, of)) {
                ("occluded_leak", Some(all)) => Some(Spread { mean: all.most, count: 1, ..all }),
                _ => spread,
            };
            let _ = write!(text, " {} |", cell(spread, digits));
        }
        if prompts {
            let _ = write!(text, " {:.3} |", worst_prompt(results, key).unwrap_or(f64::NAN));
        }
        let _ = write!(text, " {} |", quartiles(results, key));
        let iou = |r: &Record| r.numbers.get("iou").copied().unwrap_or(1.0);
        let worst = results.records.iter().filter(|r| of(r)).min_by(|a, b| iou(a).total_cmp(&iou(b)));
        let _ = writeln!(text, " {} |", worst.map_or("–".into(), |r| format!("{} {:.3}", r.target, iou(r))));
    }
    text
}

/// Each object of a row, over seeds and prompts.
fn objects(results: &Results, key: RowOf) -> String {
    let (setting, provider) = key;
    let mut text = format!(
        "Each object, `{setting}`, by the masks of {provider}:\n\n| scene | object | prompts | IoU | least | Boundary IoU | accuracy | worst photo |\n\
         |---|---|---:|---:|---:|---:|---:|---:|\n"
    );
    let chosen = |r: &&Record| row_of(r) == key && r.numbers.contains_key("iou");
    let all: BTreeSet<(&str, &str)> =
        results.records.iter().filter(chosen).map(|r| (r.scene.as_str(), r.target.as_str())).collect();
    for (scene, target) in all {
        let fits = |r: &Record| row_of(r) == key && r.scene == scene && r.target == target;
        let spread = |number| results.spread(number, fits);
        let (Some(iou), Some(worst)) = (spread("iou"), spread("worst")) else { continue };
        let _ = writeln!(
            text,
            "| {scene} | {target} | {} | {} | {:.3} | {} | {} | {:.3} |",
            iou.count,
            cell(Some(iou), 3),
            iou.least,
            cell(spread("boundary_iou"), 3),
            cell(spread("accuracy"), 4),
            worst.least
        );
    }
    text
}

/// Table 1 in the paper's layout: a row per method, a column per target, IoU and accuracy. Each method's own figures as
/// the paper gives them stand above ours; on synthetic scenes, ours are of the objects that stand for the targets.
pub fn paper_targets(results: &Results) -> String {
    let mut text = String::from("| method | figures | provider |");
    targets().for_each(|(scene, target)| text += &format!(" {} {} |", scene.short, target.name));
    text += " mean |\n|---|---|---|";
    text += &"---:|".repeat(targets().count() + 1);
    text.push('\n');
    let measured = measured(results);
    for variant in BASELINES.iter().filter(|v| measured.iter().any(|m| m.0 == v.name)) {
        // The paper's own method stands above both our setting of it and ours.
        let published = if variant.name == "paper" { "full" } else { variant.name };
        let theirs: Vec<f64> = targets().filter_map(|(_, t)| t.iou.get(published).copied()).collect();
        if !theirs.is_empty() && variant.name != "full" {
            let name = if published == "full" { "Seg-Wild" } else { variant.name };
            let _ = write!(text, "| {name} | paper | – |");
            for (_, target) in targets() {
                let _ = match published {
                    "full" => write!(text, " {:.3} / {:.3} |", target.iou["full"], target.accuracy),
                    name => write!(text, " {:.3} |", target.iou[name]),
                };
            }
            let _ = writeln!(text, " {:.3} |", theirs.iter().sum::<f64>() / theirs.len() as f64);
        }
        for key in measured.iter().copied().filter(|m| m.0 == variant.name) {
            let _ = write!(text, "| {} | here | {} |", variant.name, key.1);
            for (_, target) in targets() {
                let fits =
                    |r: &Record| row_of(r) == key && (r.target == target.name || r.target == target.like);
                let (iou, accuracy) =
                    (over_seeds(results, "iou", fits), over_seeds(results, "accuracy", fits));
                let _ = match (iou, accuracy) {
                    (Some(iou), Some(accuracy)) => write!(text, " {:.3} / {:.3} |", iou.mean, accuracy.mean),
                    _ => write!(text, " – |"),
                };
            }
            let mean = over_seeds(results, "iou", |r| row_of(r) == key);
            let _ = writeln!(text, " {} |", cell(mean, 3));
        }
    }
    text
}

/// Table 2 in the paper's layout: mean IoU per scene, as published, under the paper's query here, and under ours.
pub fn paper_ablation(results: &Results) -> String {
    let shorts: Vec<&str> = PAPER.scenes.iter().map(|s| s.short.as_str()).collect();
    let mut text = String::from("| row | provider |");
    for group in ["paper", "the paper's query here", "ours"] {
        shorts.iter().for_each(|short| text += &format!(" {group} {short} |"));
    }
    text += "\n|---|---|";
    text += &"---:|".repeat(3 * shorts.len());
    text.push('\n');
    let here = |key: (&str, &str), short: &str| {
        let of_scene = |r: &Record| {
            targets().any(|(s, t)| s.short == short && (r.target == t.like || r.target == t.name))
        };
        cell(over_seeds(results, "iou", |r| row_of(r) == key && of_scene(r)), 3)
    };
    let by = providers([results]);
    for published in &PAPER.ablation {
        let paper = match published.row.as_str() {
            "full" => "paper".to_owned(),
            "no-sgc" | "no-lcom" | "no-sasm" | "no-sky-prompts" | "tau-0.3" | "tau-0.7" | "channels-32"
            | "channels-128" => format!("paper-{}", published.row),
            other => other.to_owned(),
        };
        for &by in &by {
            let _ = write!(text, "| {} | {by} |", published.name);
            for short in &shorts {
                let theirs = published.iou.get(*short).map_or("–".into(), |v| format!("{v:.3}"));
                let _ = write!(text, " {theirs} |");
            }
            for setting in [paper.as_str(), published.row.as_str()] {
                shorts.iter().for_each(|short| text += &format!(" {} |", here((setting, by), short)));
            }
            text.push('\n');
        }
    }
    text
}

/// PSNR and SSIM of held-out photos, per scene and row, with what others publish for the scene.
pub fn held_out(results: &Results) -> String {
    // LPIPS has a column where it was measured, one per network.
    let has = |name: &str| results.records.iter().any(|r| r.numbers.contains_key(name));
    let lpips: Vec<(&str, &str)> = LPIPS_COLUMNS.into_iter().filter(|(name, _)| has(name)).collect();
    let mut text = String::from("| scene | row | provider | PSNR | SSIM |");
    lpips.iter().for_each(|(_, words)| text += &format!(" {words} |"));
    text += "\n|---|---|---|---:|---:|";
    text += &"---:|".repeat(lpips.len());
    text.push('\n');
    let mut seen = BTreeSet::new();
    for r in results.records.iter().filter(|r| r.numbers.contains_key("psnr")) {
        let key = (r.scene.as_str(), row_of(r), r.target.as_str());
        if !seen.insert(key) {
            continue;
        }
        let fits = |o: &Record| (o.scene.as_str(), row_of(o), o.target.as_str()) == key;
        let (psnr, ssim) = (over_seeds(results, "psnr", fits), over_seeds(results, "ssim", fits));
        let _ = write!(
            text,
            "| {} | {} | {} | {} | {} |",
            r.scene,
            r.setting,
            row_of(r).1,
            cell(psnr, 2),
            cell(ssim, 3)
        );
        for (name, _) in &lpips {
            let _ = write!(text, " {} |", cell(over_seeds(results, name, fits), 3));
        }
        text.push('\n');
    }
    for scene in PAPER.scenes.iter().filter(|s| seen.iter().any(|k| k.0 == s.name)) {
        for (name, [psnr, ssim]) in &scene.published {
            let _ = write!(text, "| {} | {name}, published | – | {psnr:.2} | {ssim:.3} |", scene.name);
            text += &" – |".repeat(lpips.len());
            text.push('\n');
        }
    }
    text
}

/// The perturbation experiment: PSNR of each row under each perturbation, and what it lost against the clean run.
pub fn perturbations(results: &Results) -> String {
    let names = Perturbation::ALL.map(Perturbation::name);
    let mut text = String::from("| row | provider |");
    names.iter().for_each(|n| text += &format!(" {n}: PSNR, SSIM | gap in dB |"));
    text += "\n|---|---|";
    text += &"---:|---:|".repeat(names.len());
    text.push('\n');
    let rows = rows_of(results.records.iter());
    for &key in &rows {
        let _ = write!(text, "| {} | {} |", key.0, key.1);
        for name in names {
            let of = |number| over_seeds(results, number, |r| row_of(r) == key && r.target == name);
            let (psnr, ssim) = (cell(of("psnr"), 2), cell(of("ssim"), 3));
            let _ = write!(text, " {psnr}, {ssim} | {} |", cell(of("gap_db"), 2));
        }
        text.push('\n');
    }
    let others: Vec<RowOf> = rows.iter().copied().filter(|row| row.0 != PLAIN).collect();
    if others.len() < rows.len() && !others.is_empty() {
        text += &closed(results, &others);
    }
    text
}

/// How much of what a perturbation costs plain splats the other rows win back.
fn closed(results: &Results, rows: &[RowOf]) -> String {
    let [clean, perturbed @ ..] = Perturbation::ALL.map(Perturbation::name);
    let mean = |key: (&str, &str), name: &str, number: &str| {
        over_seeds(results, number, |r| row_of(r) == key && r.target == name).map(|s| s.mean)
    };
    let share = |x: Option<f64>| x.map_or("–".into(), |x| format!("{:.0} %", 100.0 * x));
    let mut text = format!(
        "\nHow much of the gap that a perturbation opens is closed: each row's gap beside that of `{PLAIN}`; and, after \
         the comma, how far the row comes from the perturbed `{PLAIN}` to its own clean photos.\n\n| row | provider |"
    );
    perturbed.iter().for_each(|n| text += &format!(" {n} |"));
    text += &format!("\n|---|---|{}\n", "---:|".repeat(perturbed.len()));
    for &row in rows {
        let plain = (PLAIN, row.1);
        let _ = write!(text, "| {} | {} |", row.0, row.1);
        for name in perturbed {
            let of_gaps = || Some(1.0 - mean(row, name, "gap_db")? / mean(plain, name, "gap_db")?);
            let of_the_way = || {
                let from = mean(plain, name, "psnr")?;
                Some((mean(row, name, "psnr")? - from) / (mean(row, clean, "psnr")? - from))
            };
            let _ = write!(text, " {}, {} |", share(of_gaps()), share(of_the_way()));
        }
        text.push('\n');
    }
    text
}

/// Clicks on the ground and on walls: what they found, and what they took along.
fn surfaces(results: &Results) -> String {
    let mut text = String::from(
        "Clicks on the ground and on walls, and what they take along of other objects:\n\n\
         | scene | row | provider | clicked | IoU | other objects among what was selected | worst photo |\n\
         |---|---|---|---|---:|---:|---:|\n",
    );
    for r in &results.records {
        let number = |name: &str| r.numbers.get(name).map_or("–".into(), |v| format!("{v:.3}"));
        let (row, by) = row_of(r);
        let _ = writeln!(
            text,
            "| {} | {row} | {by} | {} | {} | {} | {} |",
            r.scene,
            r.target,
            number("iou"),
            number("standing"),
            number("worst")
        );
    }
    text
}

/// What should have been measured and was not.
fn missing(results: &Results) -> String {
    let lines: Vec<String> = results.missing.iter().map(|m| format!("- {m}\n")).collect();
    format!("Not measured, for want of data:\n\n{}", lines.concat())
}

/// All tables that results of the protocols have something to say in.
pub fn all(results: &Results) -> Vec<String> {
    let (on_surfaces, on_objects): (Vec<Record>, Vec<Record>) =
        results.records.iter().cloned().partition(|r| r.protocol == SURFACES);
    let of = |records| Results { made: results.made.clone(), records, missing: Vec::new() };
    let mut tables = of_objects(&of(on_objects));
    if !on_surfaces.is_empty() {
        tables.push(surfaces(&of(on_surfaces)));
    }
    if !results.missing.is_empty() {
        tables.push(missing(results));
    }
    tables
}

fn of_objects(results: &Results) -> Vec<String> {
    let measured = measured(results);
    let is_baseline =
        |(name, _): &(&str, &str)| row(name).is_some() && BASELINES.iter().any(|v| v.name == *name);
    let is_part = |(name, _): &(&str, &str)| PAPER.ablation.iter().any(|p| p.row == *name && p.row != "full");
    let known = |r: &Record| targets().any(|(_, t)| r.target == t.name || r.target == t.like);
    let objects_of_the_paper = results.records.iter().any(known);
    let mut tables = Vec::new();
    if !measured.is_empty() {
        tables.push(summary(results));
    }
    if objects_of_the_paper && measured.iter().any(is_baseline) {
        let words = "In the layout of the paper's Table 1 (IoU / accuracy; the paper's figures are of its own photos):";
        tables.push(format!("{words}\n\n{}", paper_targets(results)));
    }
    if objects_of_the_paper && measured.iter().any(is_part) {
        let words = "In the layout of the paper's Table 2 (IoU; the paper's figures are of its own photos):";
        tables.push(format!("{words}\n\n{}", paper_ablation(results)));
    }
    if results.records.iter().any(|r| r.numbers.contains_key("gap_db")) {
        tables.push(perturbations(results));
    } else if results.records.iter().any(|r| r.numbers.contains_key("psnr")) {
        tables.push(held_out(results));
    }
    let full: Vec<RowOf> = measured.iter().copied().filter(|key| key.0 == "full").collect();
    let shown = if full.is_empty() { measured.into_iter().take(1).collect() } else { full };
    tables.extend(shown.into_iter().map(|key| objects(results, key)));
    tables
}

/// A page: whose masks and whose settings its figures are of; then of each set of results what made it, and its tables.
pub fn page(title: &str, sets: &[Results]) -> String {
    let by = providers(sets);
    let rows: Vec<&str> = sets.iter().flat_map(|s| &s.records).map(|r| r.setting.as_str()).collect();
    let first = stamp::first_sentence(&by, &named_after(&rows));
    let mut text = format!("# {}\n\n{first} This page is generated.\n", stamp::title(title, &by));
    for results in sets {
        let stamp = stamp::stamp(&results.made, &providers([results]));
        let _ = write!(text, "\n## `{}`\n\n{stamp}\n", results.made.command);
        for table in all(results) {
            let _ = write!(text, "\n{}\n", table.trim_end());
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(setting: &str, seed: u64, target: &str, prompt: u32, iou: f64) -> Record {
        let numbers = [("iou", iou), ("accuracy", 0.9), ("worst", iou - 0.1), ("occluded_leak", 1.0 - iou)];
        Record {
            protocol: "synthetic".into(),
            scene: format!("seed {seed}"),
            setting: setting.into(),
            provider: "oracle".into(),
            target: target.into(),
            seed,
            prompt,
            numbers: numbers.map(|(name, value)| (name.to_owned(), value)).into(),
            ..Record::default()
        }
    }

    fn results() -> Results {
        let mut results = Results::default();
        for r in [
            record("full", 1, "lintel", 0, 0.8),
            record("full", 1, "lintel", 1, 0.6),
            record("full", 1, "dome", 0, 0.9),
            record("full", 2, "lintel", 0, 1.0),
            record("saga", 1, "lintel", 0, 0.25),
        ] {
            results.put(r);
        }
        results
    }

    #[test]
    fn an_object_counts_once_however_many_prompts_it_had_and_a_seed_once_however_many_objects() {
        let spread = over_seeds(&results(), "iou", |r| r.setting == "full").unwrap();
        assert_eq!(spread.count, 2);
        // Seed 1: lintel .7 and dome .9; seed 2: 1.
        assert!((spread.mean - 0.9).abs() < 1e-12, "{spread}");
        let table = summary(&results());
        let full = table.lines().find(|l| l.starts_with("| full |")).unwrap();
        // The worst of an object's prompts, the most that leaked, and the worst object.
        assert!(
            full.contains("| 0.833 |") && full.contains("| 0.4000 |") && full.contains("lintel 0.600"),
            "{full}"
        );
    }

    #[test]
    fn tables_in_the_papers_layout_have_its_figures_beside_ours() {
        let table = paper_targets(&results());
        let row =
            |start: &str| table.lines().find(|l| l.starts_with(start)).unwrap_or_else(|| panic!("{table}"));
        assert!(row("| saga | paper | – |").contains(" 0.913 | 0.840 |"));
        assert!(row("| saga | here | oracle | 0.250 / 0.900 | – |").ends_with("| 0.250 |"));
        // Clicked twice with .7 on average on seed 1, and once with 1 on seed 2.
        assert!(row("| full | here | oracle | 0.850 / 0.900 |").contains("0.900 ±"));
        let table = paper_ablation(&results());
        let full = table.lines().find(|l| l.contains("0.930 | 0.827 | 0.846 |")).unwrap();
        assert!(full.contains("– | – | – |"), "the paper's query was not measured: {full}");
    }

    #[test]
    fn every_table_names_whose_masks_its_figures_are_of_and_mixes_none() {
        let mut both = results();
        both.put(Record { provider: "built-in".into(), ..record("full", 1, "lintel", 0, 0.1) });
        let text = page("Synthetic scenes", &[both.clone()]);
        assert!(
            text.starts_with(
                "# Synthetic scenes (oracle, built-in)\n\nThe rows named after SAGA are settings"
            )
        );
        assert!(text.contains("| full | oracle |") && text.contains("| full | built-in |"), "{text}");
        assert!(text.contains("Provider: oracle, built-in. Command: "), "{text}");
        let full = summary(&both).lines().find(|l| l.starts_with("| full | built-in |")).unwrap().to_owned();
        assert!(full.contains("| 0.100 |"), "{full}");
        let oracle = summary(&both).lines().find(|l| l.starts_with("| full | oracle |")).unwrap().to_owned();
        // Of the clicks .6, .8, .9 and 1.
        assert!(oracle.contains("| 0.800 / 0.900 / 0.900 |"), "{oracle}");
        for table in all(&both) {
            assert!(table.contains("oracle") || table.contains("built-in"), "{table}");
        }
    }

    #[test]
    fn what_is_missing_stands_below_the_tables() {
        let mut results = results();
        results.miss(["Trevi Fountain, left triton: the photo 1.jpg".to_owned()]);
        let text = page("Photo Tourism", &[results]);
        assert!(text.contains("Not measured, for want of data:\n\n- Trevi Fountain, left triton"), "{text}");
    }
}
