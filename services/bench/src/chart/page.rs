//! The chart as files: figures, tables, data, and one page that holds them all.

use super::points::{CHEAPER, COSTS, ChartPoint, DefaultVerdict, MEASURES, cost_words, pace_words, point};
use super::sweeps::{DEFAULT, SWEEPS, Sweep};
use crate::page::{PageError, io};
use crate::plot::{Figure, Mark, Panel, PlotSeries, escaped, front};
use segwild_eval::record::Results;
use segwild_eval::stamp::{self, providers};
use segwild_flow::files;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

/// A chart that is ready to be written.
pub struct ChartPage {
    results: Results,
    points: Vec<ChartPoint>,
    title: String,
}

impl ChartPage {
    /// Of some results; `about` says what scenes they are of.
    pub fn new(results: &Results, about: &str) -> ChartPage {
        let keys: Vec<(&str, Option<f64>)> = results.records.iter().fold(Vec::new(), |mut keys, r| {
            let key = (r.setting.as_str(), r.at);
            if !keys.contains(&key) {
                keys.push(key);
            }
            keys
        });
        let mut points: Vec<ChartPoint> = keys.iter().map(|key| point(results, *key)).collect();
        let order = |p: &ChartPoint| {
            let sweep = p.sweep.and_then(|s| SWEEPS.iter().position(|o| o.name == s.name));
            let value = p.sweep.and_then(|s| s.values.iter().position(|v| *v == p.value));
            (sweep, value)
        };
        points.sort_by_key(order);
        let title =
            stamp::title(&format!("Accuracy against time and memory: {about}"), &providers([results]));
        ChartPage { results: results.clone(), points, title }
    }

    fn default(&self) -> Option<&ChartPoint> {
        self.points.iter().find(|p| p.chosen)
    }

    /// How the default stands.
    pub fn verdicts(&self) -> Vec<DefaultVerdict> {
        let Some(default) = self.default() else { return Vec::new() };
        let mut verdicts = Vec::new();
        for (worth, _, least) in MEASURES {
            for cost in COSTS {
                let (Some(here), Some(paid)) = (default.numbers.get(worth), default.mean(cost)) else {
                    continue;
                };
                let noise = least.max(here.deviation);
                let mut verdict = DefaultVerdict { worth, cost, better: Vec::new(), cheaper: Vec::new() };
                for p in self.points.iter().filter(|p| !p.chosen && comparable(p, worth)) {
                    let (Some(w), Some(c)) = (p.mean(worth), p.mean(cost)) else { continue };
                    let words = format!("{} ({} at {:.2} of the cost)", p.name(), shown(worth, w), c / paid);
                    if w > here.mean + noise && c <= paid {
                        verdict.better.push(words);
                    } else if w > here.mean - noise && c < CHEAPER * paid {
                        verdict.cheaper.push(words);
                    }
                }
                verdicts.push(verdict);
            }
        }
        verdicts
    }

    /// Worth against cost.
    pub fn figure(&self) -> Figure {
        let mut panels = Vec::new();
        for (worth, words, _) in MEASURES {
            for cost in COSTS {
                if let Some(panel) = self.panel(worth, words, cost) {
                    panels.push(panel);
                }
            }
        }
        Figure { title: self.title.clone(), panels, columns: 2, panel: [560, 420] }
    }

    fn panel(&self, worth: &'static str, words: &str, cost: &str) -> Option<Panel> {
        let default = self.default()?;
        let (whole, _) = (default.mean(cost)?, default.mean(worth)?);
        let usable: Vec<&ChartPoint> = self
            .points
            .iter()
            .filter(|p| comparable(p, worth) && p.mean(worth).is_some() && p.mean(cost).is_some())
            .collect();
        let corners = |p: &&ChartPoint| (p.mean(cost).unwrap_or(0.0) / whole, p.mean(worth).unwrap_or(0.0));
        let front = front(&usable.iter().map(corners).collect::<Vec<_>>());
        let mark = |p: &ChartPoint| {
            let (x, y) = corners(&p);
            let spread = |number: &str| p.numbers.get(number).map_or(0.0, |s| s.deviation);
            let on_front = front.contains(&(x, y));
            Mark {
                x,
                y,
                error: [spread(cost) / whole, spread(worth)],
                label: if on_front && !p.chosen { p.name() } else { String::new() },
                note: self.note(p),
                chosen: p.chosen,
            }
        };
        let mut series: Vec<PlotSeries> = SWEEPS
            .iter()
            .map(|s| PlotSeries {
                name: s.name.into(),
                marks: usable
                    .iter()
                    .filter(|p| !p.chosen && p.sweep.is_some_and(|w| w.name == s.name))
                    .map(|p| mark(p))
                    .collect(),
                line: false,
            })
            .filter(|s| !s.marks.is_empty())
            .collect();
        // Drawn last, over the others, and named in the legend as the default.
        if let Some(last) = series.last_mut() {
            last.marks.push(mark(default));
        } else {
            series.push(PlotSeries { name: DEFAULT.into(), marks: vec![mark(default)], line: false });
        }
        let costs = || usable.iter().map(|p| corners(p).0);
        let range = costs().fold(0.0, f64::max) / costs().fold(f64::INFINITY, f64::min);
        let unit = if cost == "cpu_s" { format!("{whole:.1} CPU-s") } else { format!("{whole:.0} MiB") };
        Some(Panel {
            title: format!("{words} against {}", cost_words(cost)),
            x: format!("{}, default = 1 ({unit})", cost_words(cost)),
            y: words.into(),
            log_x: range > 2.0,
            series,
            front,
            ..Panel::default()
        })
    }

    /// Each sweep by itself: worth and cost along its values.
    pub fn sweeps(&self) -> Figure {
        let mut panels = Vec::new();
        let default = self.default();
        for sweep in SWEEPS {
            let mut along: Vec<&ChartPoint> =
                self.points.iter().filter(|p| p.sweep.is_some_and(|s| s.name == sweep.name)).collect();
            if along.is_empty() {
                continue;
            }
            let own = sweep.values.iter().find(|v| along.iter().all(|p| p.value != **v));
            let own = own.filter(|_| sweep.common.is_empty()).zip(default);
            let position = |value: &str| match value.parse::<f64>() {
                Ok(v) => v,
                Err(_) => sweep.values.iter().position(|v| *v == value).unwrap_or(0) as f64,
            };
            let numeric = sweep.values.iter().all(|v| v.parse::<f64>().is_ok());
            let zero = sweep.values.contains(&"0");
            let at = |value: &str| if numeric && zero { position(value) + 10.0 } else { position(value) };
            along.sort_by(|a, b| position(&a.value).total_cmp(&position(&b.value)));
            for (worth, words, _) in MEASURES {
                if sweep.name == "size" && worth == "psnr" {
                    continue; // pixels of another size are another question
                }
                let mark = |p: &ChartPoint, value: &str, chosen: bool| {
                    let s = p.numbers.get(worth)?;
                    let error = [0.0, s.deviation];
                    Some(Mark {
                        x: at(value),
                        y: s.mean,
                        error,
                        note: self.note(p),
                        chosen,
                        ..Mark::default()
                    })
                };
                let mut marks: Vec<Mark> = along.iter().filter_map(|p| mark(p, &p.value, false)).collect();
                if let Some((value, p)) = own {
                    marks.extend(mark(p, value, true));
                    marks.sort_by(|a, b| a.x.total_cmp(&b.x));
                }
                if marks.is_empty() {
                    continue;
                }
                let names =
                    if numeric { Vec::new() } else { sweep.values.iter().map(|v| (*v).into()).collect() };
                panels.push(Panel {
                    title: format!("{}: {words}", sweep.name),
                    x: if zero { format!("{} + 10", sweep.setting) } else { sweep.setting.into() },
                    y: words.into(),
                    log_x: numeric,
                    names,
                    series: vec![PlotSeries { name: words.into(), marks, line: numeric }],
                    ..Panel::default()
                });
            }
        }
        let columns = 4;
        Figure { title: format!("{}, setting by setting", self.title), panels, columns, panel: [330, 270] }
    }

    /// What a point says when it is pointed at.
    fn note(&self, p: &ChartPoint) -> String {
        let mut text = p.name();
        for (name, words) in COLUMNS {
            if let Some(s) = p.numbers.get(*name) {
                let _ = write!(text, "\n{words} {}", shown(name, s.mean));
                if s.count > 1 {
                    let _ = write!(text, " ± {}", shown(name, s.deviation));
                }
            }
        }
        text
    }

    /// What the bars and ± are over.
    fn spread_words(&self) -> &'static str {
        let seeds: BTreeSet<u64> = self.results.records.iter().map(|r| r.seed).collect();
        if seeds.len() > 1 {
            "± and bars are the standard deviation over training seeds."
        } else {
            "There is one training seed, and so no telling how large the noise is."
        }
    }

    /// The tables, one per sweep, in Markdown.
    pub fn markdown(&self, figures: &[&str]) -> String {
        let made = &self.results.made;
        let by = providers([&self.results]);
        let mut text = format!(
            "# {}\n\n{} This page is generated. {}\n\nOne setting is varied at a time around the default; every \
             point is a training of its own in a process of its own. {} CPU \
             time and memory are of the run up to the held-out scores; memory is without what the process held before.{}\n\n",
            self.title,
            stamp::first_sentence(&by, &[]),
            stamp::stamp(made, &by),
            self.spread_words(),
            pace_words(&self.results)
        );
        for figure in figures {
            let _ = writeln!(text, "![{figure}]({figure})\n");
        }
        for verdict in self.verdicts() {
            let _ = writeln!(text, "- {}", verdict.words());
        }
        for (heading, meaning, rows) in self.tables() {
            let _ = writeln!(text, "\n## {heading}\n\n{meaning}; masks: {}\n", by.join(", "));
            let shown: Vec<&(&str, &str)> = self.columns();
            let heads: Vec<&str> = shown.iter().map(|c| c.1).collect();
            let _ = writeln!(text, "| value | {} |\n|---|{}", heads.join(" | "), "---:|".repeat(heads.len()));
            for p in rows {
                let _ = writeln!(text, "| {} | {} |", label(p), self.cells(p).join(" | "));
            }
        }
        text
    }

    /// The page: figures, tables and data in one file that needs nothing else.
    pub fn html(&self) -> Result<String, PageError> {
        let made = &self.results.made;
        let by = providers([&self.results]);
        let mut text = format!(
            "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\n\
             <title>{title}</title>\n<style>{STYLE}</style>\n<h1>{title}</h1>\n<p>{} {}</p>\n<p>One \
             setting is varied at a time around the default; every point is a training of its own in a process of its own. \
             {} Point at a mark to read its numbers.</p>\n",
            escaped(&stamp::first_sentence(&by, &[])),
            escaped(&stamp::stamp(made, &by)),
            self.spread_words(),
            title = escaped(&self.title),
        );
        text += "<ul>\n";
        for verdict in self.verdicts() {
            let class = if verdict.on_front() { "good" } else { "bad" };
            let _ = writeln!(text, "<li class=\"{class}\">{}</li>", escaped(&verdict.words()));
        }
        let _ = writeln!(
            text,
            "</ul>\n<figure>{}</figure>\n<figure>{}</figure>",
            self.figure().svg()?,
            self.sweeps().svg()?
        );
        for (heading, meaning, rows) in self.tables() {
            let heads: String = self.columns().iter().map(|c| format!("<th>{}</th>", escaped(c.1))).collect();
            let _ = writeln!(
                text,
                "<h2>{}</h2>\n<p>{}; masks: {}</p>\n<table><tr><th>value</th>{heads}</tr>",
                escaped(heading),
                escaped(meaning),
                escaped(&by.join(", "))
            );
            for p in rows {
                let cells: String =
                    self.cells(p).iter().map(|c| format!("<td>{}</td>", escaped(c))).collect();
                let class = if p.chosen { " class=\"default\"" } else { "" };
                let _ = writeln!(text, "<tr{class}><th>{}</th>{cells}</tr>", escaped(&label(p)));
            }
            text += "</table>\n";
        }
        let json = serde_json::to_string(&self.results).unwrap_or_default();
        let _ = writeln!(
            text,
            "<p>Data: <a download=\"results.csv\" href=\"data:text/csv,{}\">CSV</a>, <a download=\"results.json\" \
             href=\"data:application/json,{}\">JSON</a>.</p></html>",
            percent(&self.results.csv()),
            percent(&json)
        );
        Ok(text)
    }

    /// Heading, meaning and rows of each table.
    fn tables(&self) -> Vec<(&'static str, &'static str, Vec<&ChartPoint>)> {
        let default: Vec<&ChartPoint> = self.default().into_iter().collect();
        let of = |s: &'static Sweep| {
            let own = self.points.iter().filter(|p| p.sweep.is_some_and(|w| w.name == s.name));
            let mut rows = default.clone();
            rows.extend(own);
            (s.name, s.meaning, rows)
        };
        SWEEPS.iter().map(of).filter(|(_, _, rows)| rows.len() > default.len()).collect()
    }

    /// The columns that any point has a number for.
    fn columns(&self) -> Vec<&'static (&'static str, &'static str)> {
        let known: BTreeSet<&str> =
            self.points.iter().flat_map(|p| p.numbers.keys().map(String::as_str)).collect();
        COLUMNS.iter().filter(|(name, _)| known.contains(name)).collect()
    }

    fn cells(&self, p: &ChartPoint) -> Vec<String> {
        let default = self.default();
        let cell = |(name, _): &&(&str, &str)| {
            let Some(s) = p.numbers.get(*name) else { return String::new() };
            let mut text = shown(name, s.mean);
            if s.count > 1 {
                let _ = write!(text, " ± {}", shown(name, s.deviation));
            }
            let whole = default.and_then(|d| d.mean(name)).filter(|_| COSTS.contains(name) && !p.chosen);
            if let Some(whole) = whole {
                let _ = write!(text, " ({:.2})", s.mean / whole);
            }
            text
        };
        self.columns().iter().map(cell).collect()
    }
}

fn label(p: &ChartPoint) -> String {
    if p.chosen { "the default".into() } else { p.value.clone() }
}

/// Whether a point's worth can be set beside the default's: PSNR at another size of the photos cannot.
fn comparable(p: &ChartPoint, worth: &str) -> bool {
    !(worth == "psnr" && p.sweep.is_some_and(|s| s.name == "size"))
}

/// The columns of the tables: name of the number, words.
const COLUMNS: &[(&str, &str)] = &[
    ("iou", "IoU"),
    ("boundary_iou", "Boundary IoU"),
    ("psnr", "held-out PSNR"),
    ("ssim", "SSIM"),
    ("lpips_vgg", "LPIPS (vgg)"),
    ("lpips_alex", "LPIPS (alex)"),
    ("cpu_s", "CPU s"),
    ("wall_s", "wall s"),
    ("peak_mib", "MiB"),
    ("splats", "splats"),
    ("click_s", "s a click"),
];

fn shown(number: &str, value: f64) -> String {
    match number {
        "psnr" => format!("{value:.2}"),
        "cpu_s" | "wall_s" => format!("{value:.1}"),
        "peak_mib" | "splats" => format!("{value:.0}"),
        "click_s" => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

/// Text inside a data URI.
fn percent(text: &str) -> String {
    let mut out = String::new();
    for b in text.bytes() {
        match b {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b',' | b':' => out.push(b as char),
            _ => {
                let _ = write!(out, "%{b:02X}");
            }
        }
    }
    out
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1340px;margin:2rem auto;padding:0 1rem;color:#262626}\
 h1{font-size:1.5rem}h2{font-size:1.15rem;margin:2rem 0 0}p{margin:.4rem 0}code{background:#f2f2f2;padding:.1em .3em}\
 figure{margin:1rem 0;overflow-x:auto}svg{max-width:100%;height:auto}table{border-collapse:collapse;font-size:.9rem;margin:.5rem 0}\
 th,td{padding:.2rem .7rem;text-align:right;border-bottom:1px solid #e1e1e1;font-variant-numeric:tabular-nums}\
 th:first-child{text-align:left;font-weight:500}.default{background:#fff6df}li.good::marker{content:'✓ ';color:#009e73}\
 li.bad::marker{content:'✗ ';color:#d55e00}";

/// Writes the chart to a folder: `index.html`, `README.md`, `chart` and `sweeps` as SVG and PNG, `results` as JSON and CSV.
pub fn write(folder: &Path, results: &Results, about: &str) -> Result<Vec<DefaultVerdict>, PageError> {
    let page = ChartPage::new(results, about);
    io(folder, std::fs::create_dir_all(folder))?;
    let put = |name: &str, bytes: &[u8]| io(&folder.join(name), files::write_plain(folder.join(name), bytes));
    for (name, figure) in [("chart", page.figure()), ("sweeps", page.sweeps())] {
        put(&format!("{name}.svg"), figure.svg()?.as_bytes())?;
        put(&format!("{name}.png"), &figure.png()?)?;
    }
    put("index.html", page.html()?.as_bytes())?;
    put("README.md", page.markdown(&["chart.png", "sweeps.png"]).as_bytes())?;
    put("results.csv", results.csv().as_bytes())?;
    results.write(&folder.join("results.json"))?;
    Ok(page.verdicts())
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_eval::record::Record;

    fn record(setting: &str, at: Option<f64>, seed: u64, target: &str, numbers: &[(&str, f64)]) -> Record {
        let numbers = numbers.iter().map(|(n, v)| ((*n).to_owned(), *v)).collect();
        Record {
            protocol: "chart".into(),
            scene: "seed 1".into(),
            setting: setting.into(),
            provider: "oracle".into(),
            at,
            target: target.into(),
            seed,
            numbers,
            ..Record::default()
        }
    }

    /// The default and two other numbers of steps; a point is worth `iou` for `cpu`.
    fn results(points: &[(&str, Option<f64>, f64, f64)]) -> Results {
        let mut results = Results::default();
        for &(setting, at, iou, cpu) in points {
            for seed in [1, 2] {
                let jitter = if seed == 1 { -0.01 } else { 0.01 };
                results.put(record(setting, at, seed, "", &[("cpu_s", cpu), ("peak_mib", 100.0)]));
                results.put(record(setting, at, seed, "dome", &[("iou", iou + jitter)]));
                results.put(record(setting, at, seed, "lintel", &[("iou", iou + jitter + 0.1)]));
            }
        }
        results
    }

    #[test]
    fn the_default_loses_when_another_point_is_better_or_as_good_for_less() {
        let of = |points: &[(&str, Option<f64>, f64, f64)]| {
            let verdicts = ChartPage::new(&results(points), "a test").verdicts();
            verdicts.into_iter().find(|v| v.cost == "cpu_s").unwrap()
        };
        let front = of(&[
            (DEFAULT, None, 0.8, 10.0),
            ("steps", Some(500.0), 0.7, 5.0),
            ("steps", Some(8000.0), 0.9, 40.0),
        ]);
        assert!(front.on_front(), "{front:?}");
        let better = of(&[(DEFAULT, None, 0.8, 10.0), ("appearance_model embed", None, 0.85, 9.0)]);
        assert_eq!(better.better, ["appearance_model embed (0.900 at 0.90 of the cost)"]);
        let cheaper = of(&[(DEFAULT, None, 0.8, 10.0), ("steps", Some(500.0), 0.795, 5.0)]);
        assert_eq!(cheaper.cheaper, ["steps 500 (0.845 at 0.50 of the cost)"]);
        assert!(cheaper.words().contains("behind the front"));
    }

    #[test]
    fn the_page_needs_nothing_from_elsewhere_and_holds_its_data() {
        let results = results(&[
            (DEFAULT, None, 0.8, 10.0),
            ("steps", Some(500.0), 0.7, 5.0),
            ("appearance_model embed", None, 0.9, 12.0),
        ]);
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), &results, "a test").unwrap();
        let html = std::fs::read_to_string(folder.path().join("index.html")).unwrap();
        for outside in ["src=\"", "<script", "<link", "@import", "url("] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert_eq!(html.matches("http").count(), html.matches("http://www.w3.org/2000/svg").count());
        assert!(html.contains("<td>0.850 ± 0.014</td>") && html.contains("data:text/csv,"));
        assert!(html.contains("<h1>Accuracy against time and memory: a test (oracle)</h1>"), "{html}");
        assert!(html.contains("Provider: oracle.") && html.contains("masks: oracle"), "{html}");
        let kept = Results::read(&folder.path().join("results.json")).unwrap();
        assert_eq!(kept, results);
        let text = std::fs::read_to_string(folder.path().join("README.md")).unwrap();
        assert!(text.contains("| 500 | 0.750 ± 0.014 | 5.0 ± 0.0 (0.50) | 100 ± 0 (1.00) |"), "{text}");
        assert!(text.starts_with(
            "# Accuracy against time and memory: a test (oracle)\n\nAll masks are those of the oracle"
        ));
        for name in ["chart.svg", "sweeps.svg"] {
            let svg = std::fs::read_to_string(folder.path().join(name)).unwrap();
            assert!(svg.contains("(oracle)"), "{name}");
        }
        for name in ["chart.svg", "chart.png", "sweeps.svg", "sweeps.png", "results.csv"] {
            assert!(folder.path().join(name).metadata().unwrap().len() > 100, "{name}");
        }
    }
}
