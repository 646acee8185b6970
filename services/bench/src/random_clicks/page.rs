//! The page of random clicks.

use super::prompts::{BOX, BOX_MARGIN, INSET};
use super::reliability;
use super::worst::{image_of, worst};
use crate::page::{PageError, io};
use segwild_eval::metrics::Spread;
use segwild_eval::record::{Record, Results};
use segwild_eval::stamp;
use segwild_flow::files;
use segwild_pipeline::BOUNDARY;
use segwild_scene::statistics::interpolated_quantile;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// IoUs from which an answer has found the object: the levels of the measure NoC.
pub const FOUND: [f64; 2] = [0.85, 0.9];
/// Names of the numbers of clicks to them.
pub const CLICKS_TO: [&str; 2] = ["clicks_to_85", "clicks_to_90"];
/// Names of the stray light of an answer: its mean over the photos without prompts, and its worst photo.
pub const STRAY_LIGHT: [&str; 2] = ["stray_light", "worst_stray_light"];

/// Values of the setting `tree_boundaries` by which each click is measured as well, with the names of its IoUs.
pub const BOUNDARIES: [(&str, &str); 2] =
    [("photo", "iou_photo_boundaries"), ("geometry", "iou_geometry_boundaries")];

/// A row of the table: the mean, quartiles and shares of one object's prompts.
struct ClickRow {
    mean: f64,
    quartiles: [f64; 3],
    found: [f64; 2],
    best: Option<[f64; 2]>,
    clicks_to: Option<[f64; 2]>,
    stray_light: Option<[f64; 2]>,
    first_s: f64,
    select_s: f64,
}

impl ClickRow {
    fn of(records: &[&Record]) -> Option<ClickRow> {
        let all = |name: &str| -> Vec<f64> {
            records.iter().filter_map(|r| r.numbers.get(name).copied()).collect()
        };
        let mut ious = all("iou");
        ious.sort_by(f64::total_cmp);
        let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
        let share =
            |of: &[f64], least: f64| of.iter().filter(|x| **x >= least).count() as f64 / of.len() as f64;
        let quartile = |share: f64| interpolated_quantile(&ious, share).expect("there are prompts");
        let (best, clicks_to, stray) = (all("best_iou"), CLICKS_TO.map(all), STRAY_LIGHT.map(all));
        (!ious.is_empty()).then(|| ClickRow {
            mean: mean(&ious),
            quartiles: [0.25, 0.5, 0.75].map(quartile),
            found: FOUND.map(|least| share(&ious, least)),
            best: (!best.is_empty()).then(|| [mean(&best), share(&best, FOUND[0])]),
            clicks_to: (!clicks_to[0].is_empty()).then(|| clicks_to.map(|of| mean(&of))),
            stray_light: (!stray[0].is_empty()).then(|| stray.map(|of| mean(&of))),
            first_s: mean(&all("first_s")),
            select_s: mean(&all("select_s")),
        })
    }

    /// Means over rows: each object counts once.
    fn mean(rows: &[ClickRow]) -> Option<ClickRow> {
        let mean =
            |of: &dyn Fn(&ClickRow) -> f64| Some(Spread::of(&rows.iter().map(of).collect::<Vec<_>>())?.mean);
        // A column that some rows lack has the mean of the others.
        let pair = |of: fn(&ClickRow) -> Option<[f64; 2]>| {
            let pairs: Vec<[f64; 2]> = rows.iter().filter_map(of).collect();
            let mean = |i: usize| Some(Spread::of(&pairs.iter().map(|p| p[i]).collect::<Vec<_>>())?.mean);
            Some([mean(0)?, mean(1)?])
        };
        Some(ClickRow {
            mean: mean(&|r| r.mean)?,
            quartiles: [mean(&|r| r.quartiles[0])?, mean(&|r| r.quartiles[1])?, mean(&|r| r.quartiles[2])?],
            found: [mean(&|r| r.found[0])?, mean(&|r| r.found[1])?],
            best: pair(|r| r.best),
            clicks_to: pair(|r| r.clicks_to),
            stray_light: pair(|r| r.stray_light),
            first_s: mean(&|r| r.first_s)?,
            select_s: mean(&|r| r.select_s)?,
        })
    }

    fn cells(&self) -> String {
        let [low, middle, high] = self.quartiles;
        let [found, well] = self.found;
        let best = self.best.map_or("- | -".into(), |[mean, found]| format!("{mean:.3} | {found:.2}"));
        let clicks =
            self.clicks_to.map_or("- | -".into(), |[first, second]| format!("{first:.1} | {second:.1}"));
        let stray =
            self.stray_light.map_or("- | -".into(), |[mean, worst]| format!("{mean:.3} | {worst:.3}"));
        format!(
            "{:.3} | {low:.2} / {middle:.2} / {high:.2} | {found:.2} | {well:.2} | {best} | {clicks} | {stray} | {:.2} | {:.1}",
            self.mean, self.first_s, self.select_s
        )
    }
}

/// The page in Markdown, with the images of which `is_there` returns true.
fn markdown(results: &Results, is_there: &dyn Fn(&str) -> bool) -> String {
    let by = stamp::providers([results]);
    let boxes = results.records.iter().any(|r| r.setting == BOX);
    let (what, how) = match boxes {
        true => (
            "boxes",
            format!(
                "A box is drawn around each object on random photos, one at a time, wider than the true mask by at most {:.0} % of the photo's \
                 diagonal on each side.",
                100.0 * BOX_MARGIN
            ),
        ),
        false => (
            "clicks",
            format!(
                "Each object is clicked at random pixels of random photos, one click at a time, at least {:.0} % of the photo's diagonal inside \
                 of its outline.",
                100.0 * INSET
            ),
        ),
    };
    let corrected = match results.records.iter().any(|r| r.numbers.contains_key(CLICKS_TO[0])) {
        false => String::new(),
        true => format!(
            " `prompts to` is the measure NoC of interactive segmentation: the next click is where the answer is most wrong, on whichever photo, \
             until the mean IoU is {} or {}. One that does not get there counts as all that were allowed.",
            FOUND[0], FOUND[1]
        ),
    };
    let haze = match results.records.iter().any(|r| r.numbers.contains_key(STRAY_LIGHT[0])) {
        false => String::new(),
        true => format!(
            " Stray light is the share of the light of the object alone that is farther from the true mask than {:.0} % of the diagonal: its \
             mean over the photos with a true mask but the prompted one, and its worst of them. An answer that selects nothing has none.",
            100.0 * BOUNDARY
        ),
    };
    let mut text = format!(
        "# {}\n\nThis page is generated. {}\n\n{how} IoU is the mean over all photos with a true mask, the prompted one too. `best of` is \
         the best of the answer and the alternatives that it lists.{corrected}{haze} Runs train on all photos. Seconds are of the resident session, to \
         the first answer that it publishes and to the last.\n",
        stamp::title(&format!("Single {what}"), &by),
        stamp::stamp(&results.made, &by),
    );
    let mut sizes: Vec<f64> = results.records.iter().filter_map(|r| r.at).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.dedup();
    for size in sizes {
        let of_size: Vec<&Record> = results.records.iter().filter(|r| r.at == Some(size)).collect();
        let mut names: Vec<(&str, &str)> = Vec::new();
        for r in &of_size {
            if !names.contains(&(r.scene.as_str(), r.target.as_str())) {
                names.push((&r.scene, &r.target));
            }
        }
        let [found, well] = FOUND;
        let _ = write!(
            text,
            "\n## {size} px\n\n| scene | object | {what} | mean IoU | quartiles | share >= {found} | share >= {well} | best of: mean | share >= {found} | prompts to {found} | to {well} | stray light | in the worst photo | s to the first answer | to the last |\n\
             |---|---|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n"
        );
        let mut rows = Vec::new();
        for (scene, target) in names {
            let clicks: Vec<&Record> =
                of_size.iter().copied().filter(|r| r.scene == scene && r.target == target).collect();
            if let Some(row) = ClickRow::of(&clicks) {
                let _ = writeln!(text, "| {scene} | {target} | {} | {} |", clicks.len(), row.cells());
                rows.push(row);
            }
        }
        if let Some(mean) = ClickRow::mean(&rows) {
            let _ = writeln!(text, "| **mean** | {} objects | | {} |", rows.len(), mean.cells());
        }
        text.push_str(&worst_prompts(&of_size, size, is_there));
    }
    text.push_str(&boundaries(&results.records));
    text.push_str(&reliability::section(&results.records));
    for what in &results.missing {
        let _ = writeln!(text, "\nNot measured: {what}.");
    }
    text
}

/// The worst prompt of each object of one size, and its image where it is there.
fn worst_prompts(records: &[&Record], size: f64, is_there: &dyn Fn(&str) -> bool) -> String {
    let mut text = String::from(
        "\nThe worst prompt of each object:\n\n| scene | object | mean IoU | prompt |\n|---|---|---:|---|\n",
    );
    let worst = worst(records);
    for r in &worst {
        let iou = r.numbers.get("iou").copied().unwrap_or(0.0);
        let prompt = r.notes.first().map_or("", String::as_str);
        let _ = writeln!(text, "| {} | {} | {iou:.3} | {prompt} |", r.scene, r.target);
    }
    for r in &worst {
        let image = image_of(&r.scene, &r.target, size);
        if is_there(&image) {
            let what = format!("{}, {}: true masks, each beside the answer", r.scene, r.target);
            // A name may have spaces.
            let _ = write!(text, "\n![{what}](<{image}>)\n");
        }
    }
    text
}

/// The table of what each kind of boundary is worth; empty where it was not measured.
fn boundaries(records: &[Record]) -> String {
    let mut objects: Vec<(Option<f64>, &str, &str)> = Vec::new();
    for r in records.iter().filter(|r| r.numbers.contains_key(BOUNDARIES[0].1)) {
        let object = (r.at, r.scene.as_str(), r.target.as_str());
        if !objects.contains(&object) {
            objects.push(object);
        }
    }
    if objects.is_empty() {
        return String::new();
    }
    let mut text = String::from(
        "\n## What each kind of boundary is worth\n\nMean IoU of the same clicks, answered by the trees that the photos' boundaries or the \
         geometry's grow alone (`--tree-boundaries`), and by all trees, the default. The run is the same.\n\n\
         | px | scene | object | clicks | photo | geometry | photo and geometry |\n|---:|---|---|---:|---:|---:|---:|\n",
    );
    let [photo, geometry] = BOUNDARIES.map(|(_, name)| name);
    let mut sums = [0.0; 3];
    for (at, scene, target) in &objects {
        let of: Vec<&Record> =
            records.iter().filter(|r| r.at == *at && r.scene == *scene && r.target == *target).collect();
        let mean = |name: &str| {
            let ious: Vec<f64> = of.iter().filter_map(|r| r.numbers.get(name).copied()).collect();
            ious.iter().sum::<f64>() / ious.len().max(1) as f64
        };
        let means = [photo, geometry, "iou"].map(mean);
        sums.iter_mut().zip(means).for_each(|(sum, mean)| *sum += mean);
        let [photo, geometry, all] = means;
        let at = at.map_or_else(|| "-".into(), |at| format!("{at}"));
        let _ = writeln!(
            text,
            "| {at} | {scene} | {target} | {} | {photo:.3} | {geometry:.3} | {all:.3} |",
            of.len()
        );
    }
    let [photo, geometry, all] = sums.map(|sum| sum / objects.len() as f64);
    let _ = writeln!(
        text,
        "| | **mean** | {} objects | | {photo:.3} | {geometry:.3} | {all:.3} |",
        objects.len()
    );
    text
}

/// Writes the page with its images into the folder, and without them to `page`, if that is given: images show photos, which may
/// not be passed on.
///
/// # Errors
/// When a file cannot be written.
pub fn write(out: &Path, page: Option<&Path>, results: &Results) -> Result<PathBuf, PageError> {
    let file = out.join("clicks.md");
    let put = |file: &Path, is_there: &dyn Fn(&str) -> bool| {
        io(file, files::write_plain(file, markdown(results, is_there)).map_err(std::io::Error::other))
    };
    put(&file, &|image: &str| out.join(image).is_file())?;
    page.map_or(Ok(()), |page| put(page, &|_: &str| false))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_gives_each_object_the_same_weight() {
        let record = |target: &str, prompt: u32, iou: f64| Record {
            protocol: "clicks".into(),
            scene: "square".into(),
            provider: "built-in".into(),
            at: Some(320.0),
            target: target.into(),
            prompt,
            numbers: [
                ("iou".to_owned(), iou),
                ("best_iou".to_owned(), iou.max(0.5)),
                (CLICKS_TO[0].to_owned(), 2.0),
                (CLICKS_TO[1].to_owned(), 4.0),
                (STRAY_LIGHT[0].to_owned(), 1.0 - iou),
                (STRAY_LIGHT[1].to_owned(), 1.0 - 0.5 * iou),
                ("select_s".to_owned(), 1.0),
                ("first_s".to_owned(), 0.1),
            ]
            .into(),
            ..Record::default()
        };
        let records =
            vec![record("a", 0, 1.0), record("a", 1, 0.8), record("a", 2, 0.9), record("b", 0, 0.1)];
        let page = markdown(&Results { records, ..Results::default() }, &|image: &str| image.contains("-a-"));
        assert!(
            page.contains(
                "| square | a | 3 | 0.900 | 0.85 / 0.90 / 0.95 | 0.67 | 0.67 | 0.900 | 0.67 | 2.0 | 4.0 | 0.100 | 0.550 | 0.10 | 1.0 |"
            ),
            "{page}"
        );
        assert!(page.contains("| **mean** | 2 objects | | 0.500 |"), "{page}");
        assert!(page.contains("| 2.0 | 4.0 | 0.500 | 0.750 | 0.10 | 1.0 |\n"), "{page}");
        assert!(page.contains("Stray light is") && page.contains("than 2 % of the diagonal"), "{page}");
        assert!(page.contains("built-in"), "{page}");
        assert!(
            page.contains("| square | a | 0.800 |") && page.contains("(<worst-square-a-320.png>)"),
            "{page}"
        );
        assert!(!page.contains("worst-square-b"), "it is not there: {page}");
    }

    #[test]
    fn the_table_of_boundaries_has_a_row_for_each_object_and_their_mean() {
        let record = |target: &str, prompt: u32, [photo, geometry, all]: [f64; 3]| Record {
            scene: "square".into(),
            at: Some(320.0),
            target: target.into(),
            prompt,
            numbers: [
                ("iou".to_owned(), all),
                (BOUNDARIES[0].1.to_owned(), photo),
                (BOUNDARIES[1].1.to_owned(), geometry),
            ]
            .into(),
            ..Record::default()
        };
        let records = [
            record("a", 0, [0.2, 0.4, 0.8]),
            record("a", 1, [0.4, 0.6, 1.0]),
            record("b", 0, [0.9, 0.1, 0.5]),
        ];
        let table = boundaries(&records);
        assert!(table.contains("| 320 | square | a | 2 | 0.300 | 0.500 | 0.900 |"), "{table}");
        assert!(table.contains("| | **mean** | 2 objects | | 0.600 | 0.300 | 0.700 |"), "{table}");
        assert_eq!(boundaries(&[Record::default()]), "", "it was not measured");
    }

    #[test]
    fn records_without_stray_light_have_an_empty_column() {
        let numbers = [("iou".to_owned(), 0.5), ("select_s".to_owned(), 1.0), ("first_s".to_owned(), 0.1)];
        let record =
            Record { at: Some(320.0), target: "a".into(), numbers: numbers.into(), ..Record::default() };
        let page = markdown(&Results { records: vec![record], ..Results::default() }, &|_: &str| false);
        assert!(page.contains("| - | - | - | - | - | - | 0.10 | 1.0 |\n"), "{page}");
        assert!(!page.contains("Stray light is") && !page.contains(".png"), "{page}");
    }
}
