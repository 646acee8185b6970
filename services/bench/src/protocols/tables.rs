//! Results as tables that a person can read, the paper's figures beside ours.

use super::lego::{PLAIN, Perturbation};
use super::paper::{PAPER, targets};
use crate::ablation::Variant;
use crate::metrics::Spread;
use crate::record::{Record, Results};
use crate::rivals::{RIVALS, row};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

/// The rows that were measured, in the order in which they first came.
fn settings(results: &Results) -> Vec<&str> {
    let mut names: Vec<&str> = Vec::new();
    for r in results.records.iter().filter(|r| r.numbers.contains_key("iou")) {
        if !names.contains(&r.setting.as_str()) {
            names.push(&r.setting);
        }
    }
    names
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
fn worst_prompt(results: &Results, setting: &str) -> Option<f64> {
    let mut worst: BTreeMap<(&str, u64, &str), (f64, usize)> = BTreeMap::new();
    for r in results.records.iter().filter(|r| r.setting == setting) {
        if let Some(&iou) = r.numbers.get("iou") {
            let entry = worst.entry((&r.scene, r.seed, &r.target)).or_insert((f64::INFINITY, 0));
            *entry = (entry.0.min(iou), entry.1 + 1);
        }
    }
    let several = worst.values().any(|w| w.1 > 1);
    several.then(|| worst.values().map(|w| w.0).sum::<f64>() / worst.len() as f64)
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
        ("hidden", "hidden wall", 4),
        ("worst", "worst photo", 3),
        ("select_s", "s per click", 1),
    ];
    let has = |number: &str| results.records.iter().any(|r| r.numbers.contains_key(number));
    let columns: Vec<_> = COLUMNS.into_iter().filter(|c| has(c.0)).collect();
    let rows = settings(results);
    let prompts = rows.iter().any(|r| worst_prompt(results, r).is_some());
    let mut text = String::from("| row | what it is |");
    columns.iter().for_each(|c| text += &format!(" {} |", c.1));
    text += if prompts { " worst prompt | worst object |\n" } else { " worst object |\n" };
    text += "|---|---|";
    text += &"---:|".repeat(columns.len() + usize::from(prompts));
    text += "---:|\n";
    for name in rows {
        let of = |r: &Record| r.setting == name;
        let meaning = row(name).map_or("", |v: &Variant| v.meaning);
        let _ = write!(text, "| {name} | {meaning} |");
        for &(number, _, digits) in &columns {
            let spread = over_seeds(results, number, of);
            // What leaks is the worst that any click did.
            let spread = match (number, results.spread(number, of)) {
                ("hidden", Some(all)) => Some(Spread { mean: all.most, count: 1, ..all }),
                _ => spread,
            };
            let _ = write!(text, " {} |", cell(spread, digits));
        }
        if prompts {
            let _ = write!(text, " {:.3} |", worst_prompt(results, name).unwrap_or(f64::NAN));
        }
        let iou = |r: &Record| r.numbers.get("iou").copied().unwrap_or(1.0);
        let worst = results.records.iter().filter(|r| of(r)).min_by(|a, b| iou(a).total_cmp(&iou(b)));
        let _ = writeln!(text, " {} |", worst.map_or("–".into(), |r| format!("{} {:.3}", r.target, iou(r))));
    }
    text
}

/// Each object of the first row, over seeds and prompts.
pub fn objects(results: &Results, setting: &str) -> String {
    let mut text = format!(
        "Each object, `{setting}`:\n\n| scene | object | prompts | IoU | least | Boundary IoU | accuracy | worst photo |\n\
         |---|---|---:|---:|---:|---:|---:|---:|\n"
    );
    let chosen = |r: &&Record| r.setting == setting && r.numbers.contains_key("iou");
    let all: BTreeSet<(&str, &str)> =
        results.records.iter().filter(chosen).map(|r| (r.scene.as_str(), r.target.as_str())).collect();
    for (scene, target) in all {
        let fits = |r: &Record| r.setting == setting && r.scene == scene && r.target == target;
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
/// the paper gives them stand above ours; on synthetic places, ours are of the objects that stand for the targets.
pub fn paper_targets(results: &Results) -> String {
    let mut text = String::from("| method | figures |");
    targets().for_each(|(scene, target)| text += &format!(" {} {} |", scene.short, target.name));
    text += " mean |\n|---|---|";
    text += &"---:|".repeat(targets().count() + 1);
    text.push('\n');
    let measured = settings(results);
    for variant in RIVALS.iter().filter(|v| measured.contains(&v.name)) {
        // The paper's own method stands above both our setting of it and ours.
        let published = if variant.name == "paper" { "full" } else { variant.name };
        let theirs: Vec<f64> = targets().filter_map(|(_, t)| t.iou.get(published).copied()).collect();
        if !theirs.is_empty() && variant.name != "full" {
            let name = if published == "full" { "Seg-Wild" } else { variant.name };
            let _ = write!(text, "| {name} | paper |");
            for (_, target) in targets() {
                let _ = match published {
                    "full" => write!(text, " {:.3} / {:.3} |", target.iou["full"], target.accuracy),
                    name => write!(text, " {:.3} |", target.iou[name]),
                };
            }
            let _ = writeln!(text, " {:.3} |", theirs.iter().sum::<f64>() / theirs.len() as f64);
        }
        let _ = write!(text, "| {} | here |", variant.name);
        for (_, target) in targets() {
            let fits = |r: &Record| {
                r.setting == variant.name && (r.target == target.name || r.target == target.like)
            };
            let (iou, accuracy) = (over_seeds(results, "iou", fits), over_seeds(results, "accuracy", fits));
            let _ = match (iou, accuracy) {
                (Some(iou), Some(accuracy)) => write!(text, " {:.3} / {:.3} |", iou.mean, accuracy.mean),
                _ => write!(text, " – |"),
            };
        }
        let mean = over_seeds(results, "iou", |r| r.setting == variant.name);
        let _ = writeln!(text, " {} |", cell(mean, 3));
    }
    text
}

/// Table 2 in the paper's layout: mean IoU per place, as published, under the paper's query here, and under ours.
pub fn paper_ablation(results: &Results) -> String {
    let shorts: Vec<&str> = PAPER.scenes.iter().map(|s| s.short.as_str()).collect();
    let mut text = String::from("| row |");
    for group in ["paper", "the paper's query here", "ours"] {
        shorts.iter().for_each(|short| text += &format!(" {group} {short} |"));
    }
    text += "\n|---|";
    text += &"---:|".repeat(3 * shorts.len());
    text.push('\n');
    let here = |setting: &str, short: &str| {
        let of_scene = |r: &Record| {
            targets().any(|(s, t)| s.short == short && (r.target == t.like || r.target == t.name))
        };
        cell(over_seeds(results, "iou", |r| r.setting == setting && of_scene(r)), 3)
    };
    for published in &PAPER.ablation {
        let paper = match published.row.as_str() {
            "full" => "paper".to_owned(),
            "no-sgc" | "no-lcom" | "no-sasm" | "no-sky-prompts" | "tau-0.3" | "tau-0.7" | "channels-32"
            | "channels-128" => format!("paper-{}", published.row),
            other => other.to_owned(),
        };
        let _ = write!(text, "| {} |", published.name);
        for short in &shorts {
            let _ =
                write!(text, " {} |", published.iou.get(*short).map_or("–".into(), |v| format!("{v:.3}")));
        }
        for setting in [paper.as_str(), published.row.as_str()] {
            shorts.iter().for_each(|short| text += &format!(" {} |", here(setting, short)));
        }
        text.push('\n');
    }
    text
}

/// PSNR and SSIM of held-out photos, per scene and row, with what others publish for the scene.
pub fn held_out(results: &Results) -> String {
    let mut text = String::from("| scene | row | PSNR | SSIM |\n|---|---|---:|---:|\n");
    let mut seen = BTreeSet::new();
    for r in results.records.iter().filter(|r| r.numbers.contains_key("psnr")) {
        let key = (r.scene.as_str(), r.setting.as_str(), r.target.as_str());
        if !seen.insert(key) {
            continue;
        }
        let fits = |o: &Record| (o.scene.as_str(), o.setting.as_str(), o.target.as_str()) == key;
        let (psnr, ssim) = (over_seeds(results, "psnr", fits), over_seeds(results, "ssim", fits));
        let _ = writeln!(text, "| {} | {} | {} | {} |", r.scene, r.setting, cell(psnr, 2), cell(ssim, 3));
    }
    for scene in PAPER.scenes.iter().filter(|s| seen.iter().any(|k| k.0 == s.name)) {
        for (name, [psnr, ssim]) in &scene.published {
            let _ = writeln!(text, "| {} | {name}, published | {psnr:.2} | {ssim:.3} |", scene.name);
        }
    }
    text
}

/// The perturbation experiment: PSNR of each row under each perturbation, and what it lost against the clean run.
pub fn perturbations(results: &Results) -> String {
    let names = Perturbation::ALL.map(Perturbation::name);
    let mut text = String::from("| row |");
    names.iter().for_each(|n| text += &format!(" {n}: PSNR, SSIM | gap in dB |"));
    text += "\n|---|";
    text += &"---:|---:|".repeat(names.len());
    text.push('\n');
    let mut rows: Vec<&str> = Vec::new();
    for r in &results.records {
        if !rows.contains(&r.setting.as_str()) {
            rows.push(&r.setting);
        }
    }
    for &setting in &rows {
        let _ = write!(text, "| {setting} |");
        for name in names {
            let of = |number| over_seeds(results, number, |r| r.setting == setting && r.target == name);
            let (psnr, ssim) = (cell(of("psnr"), 2), cell(of("ssim"), 3));
            let _ = write!(text, " {psnr}, {ssim} | {} |", cell(of("gap_db"), 2));
        }
        text.push('\n');
    }
    let others: Vec<&str> = rows.iter().copied().filter(|row| *row != PLAIN).collect();
    if others.len() < rows.len() && !others.is_empty() {
        text += &closed(results, &others);
    }
    text
}

/// How much of what a perturbation costs plain splats the other rows win back.
fn closed(results: &Results, rows: &[&str]) -> String {
    let [clean, perturbed @ ..] = Perturbation::ALL.map(Perturbation::name);
    let mean = |setting: &str, name: &str, number: &str| {
        over_seeds(results, number, |r| r.setting == setting && r.target == name).map(|s| s.mean)
    };
    let share = |x: Option<f64>| x.map_or("–".into(), |x| format!("{:.0} %", 100.0 * x));
    let mut text = format!(
        "\nHow much of the gap that a perturbation opens is closed: each row's gap beside that of `{PLAIN}`; and, after \
         the comma, how far the row comes from the perturbed `{PLAIN}` to its own clean photos.\n\n| row |"
    );
    perturbed.iter().for_each(|n| text += &format!(" {n} |"));
    text += &format!("\n|---|{}\n", "---:|".repeat(perturbed.len()));
    for &row in rows {
        let _ = write!(text, "| {row} |");
        for name in perturbed {
            let of_gaps = || Some(1.0 - mean(row, name, "gap_db")? / mean(PLAIN, name, "gap_db")?);
            let of_the_way = || {
                let from = mean(PLAIN, name, "psnr")?;
                Some((mean(row, name, "psnr")? - from) / (mean(row, clean, "psnr")? - from))
            };
            let _ = write!(text, " {}, {} |", share(of_gaps()), share(of_the_way()));
        }
        text.push('\n');
    }
    text
}

/// All tables that results of the protocols have something to say in.
pub fn all(results: &Results) -> Vec<String> {
    let measured = settings(results);
    let is_rival = |name: &&str| row(name).is_some() && RIVALS.iter().any(|v| v.name == *name);
    let is_part = |name: &&str| PAPER.ablation.iter().any(|p| p.row == *name && p.row != "full");
    let known = |r: &Record| targets().any(|(_, t)| r.target == t.name || r.target == t.like);
    let objects_of_the_paper = results.records.iter().any(known);
    let mut tables = Vec::new();
    if !measured.is_empty() {
        tables.push(summary(results));
    }
    if objects_of_the_paper && measured.iter().any(is_rival) {
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
    let shown = measured.iter().find(|name| **name == "full").or(measured.first());
    tables.extend(shown.map(|name| objects(results, name)));
    tables
}

/// A page: of each set of results what made it, then its tables.
pub fn page(title: &str, sets: &[Results]) -> String {
    let mut text = format!("# {title}\n\nThis page is generated.\n");
    for results in sets {
        let made = &results.made;
        let _ = write!(text, "\n## `{}`\n\nsegwild {}, on {}.\n", made.command, made.version, made.machine);
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
        let numbers = [("iou", iou), ("accuracy", 0.9), ("worst", iou - 0.1), ("hidden", 1.0 - iou)];
        Record {
            protocol: "synthetic".into(),
            scene: format!("seed {seed}"),
            setting: setting.into(),
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
            |begins: &str| table.lines().find(|l| l.starts_with(begins)).unwrap_or_else(|| panic!("{table}"));
        assert!(row("| saga | paper |").contains(" 0.913 | 0.840 |"));
        assert!(row("| saga | here | 0.250 / 0.900 | – |").ends_with("| 0.250 |"));
        // Clicked twice with .7 on average on seed 1, and once with 1 on seed 2.
        assert!(row("| full | here | 0.850 / 0.900 |").contains("0.900 ±"));
        let table = paper_ablation(&results());
        let full = table.lines().find(|l| l.contains("0.930 | 0.827 | 0.846 |")).unwrap();
        assert!(full.contains("– | – | – |"), "the paper's query was not measured: {full}");
    }
}
