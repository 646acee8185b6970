//! What each part of the method is worth: the same scenes and clicks with one part changed at a time (paper,
//! Table 2).

use crate::oracle::OracleOptions;
use crate::synthetic::SyntheticOptions;
use crate::trial::{ObjectScore, ProviderKind, Trial, TrialError};
use segwild_pipeline::{RunError, Settings, SettingsError};
use serde::Serialize;
use std::fmt::Write as _;
use std::path::Path;

/// A row of the table: its name, and the settings that differ from the full method.
#[derive(Clone, Copy, Debug)]
pub struct Variant {
    /// Name of the row.
    pub name: &'static str,
    /// What it changes, in words.
    pub meaning: &'static str,
    /// Whether it starts from the paper's query ([`PAPER`]) instead of ours.
    pub paper: bool,
    /// Settings that differ.
    pub changes: &'static [(&'static str, &'static str)],
}

/// The paper's query: the clicked photo alone, splats by their projected centres, every one of them gated by
/// resemblance, spikes shrunk in all directions.
pub const PAPER: &[(&str, &str)] = &[
    ("propagate", "0"),
    ("evidence_mode", "centre"),
    ("similarity_use", "gate"),
    ("click_temperature", "1"),
    ("spikes", "isotropic"),
    ("cut_by", "prompts"),
];

const fn ours(name: &'static str, meaning: &'static str, changes: Changes) -> Variant {
    Variant { name, meaning, paper: false, changes }
}

const fn paper(name: &'static str, meaning: &'static str, changes: Changes) -> Variant {
    Variant { name, meaning, paper: true, changes }
}

type Changes = &'static [(&'static str, &'static str)];

/// The rows. Geometry is trained once per scene (`no-sky` trains it anew: the sky takes part in training), and what
/// a row does not change comes from the content cache.
pub const VARIANTS: &[Variant] = &[
    ours("full", "the defaults", &[]),
    ours("no-lcom", "features without the compactness loss", &[("compactness", "false")]),
    ours("no-sasm", "mask prompts on a uniform grid", &[("sasm", "false")]),
    ours("no-sky-prompts", "prompts that do not know the sky", &[("sky_prompts", "false")]),
    ours("no-sky", "no sky anywhere, geometry included", &[("sky", "none")]),
    ours("no-sgc", "spikes stay", &[("spikes", "off")]),
    ours("prompts-sgc", "spikes cut by the clicked photo alone", &[("cut_by", "prompts")]),
    ours("isotropic-sgc", "spikes shrunk in all directions", &[("spikes", "isotropic")]),
    ours("tau-0.3", "resemblance from 0.3", &[("tau", "0.3")]),
    ours("tau-0.7", "resemblance from 0.7", &[("tau", "0.7")]),
    ours("channels-16", "16 numbers per splat", &[("channels", "16")]),
    ours("channels-32", "32 numbers per splat", &[("channels", "32")]),
    ours("no-features", "resemblance takes no part", &[("similarity_use", "off")]),
    ours("one-photo", "the clicked photo alone", &[("propagate", "0")]),
    paper("paper", "the paper's query", &[]),
    paper("paper-no-lcom", "features without the compactness loss", &[("compactness", "false")]),
    paper("paper-no-sasm", "mask prompts on a uniform grid", &[("sasm", "false")]),
    paper("paper-no-sky-prompts", "prompts that do not know the sky", &[("sky_prompts", "false")]),
    paper("paper-no-sgc", "spikes stay", &[("spikes", "off")]),
    paper("paper-axis-sgc", "spikes shrunk along the cut only", &[("spikes", "axis")]),
    paper("paper-tau-0.3", "resemblance from 0.3", &[("tau", "0.3")]),
    paper("paper-tau-0.7", "resemblance from 0.7", &[("tau", "0.7")]),
    paper("paper-channels-16", "16 numbers per splat", &[("channels", "16")]),
    paper("paper-channels-32", "32 numbers per splat", &[("channels", "32")]),
    paper("paper-no-features", "the projected centre alone", &[("similarity_use", "off")]),
    paper("paper-coverage", "splats by their visible light", &[("evidence_mode", "coverage")]),
];

/// What the table is made of.
#[derive(Clone, Debug)]
pub struct AblationOptions {
    /// Seeds of the scenes.
    pub seeds: Vec<u64>,
    /// Rows to compute; all if empty.
    pub only: Vec<String>,
    /// Who looks at the photos.
    pub providers: ProviderKind,
    /// How the oracle errs.
    pub faults: OracleOptions,
    /// The scenes, but for their seeds.
    pub scene: SyntheticOptions,
    /// What all rows have in common.
    pub settings: Settings,
}

/// One object under one variant.
#[derive(Clone, Debug, Serialize)]
pub struct Cell {
    /// Seed of the scene.
    pub seed: u64,
    /// Name of the row.
    pub variant: String,
    /// How the object fared.
    #[serde(flatten)]
    pub score: ObjectScore,
}

impl Variant {
    /// The row's settings.
    pub fn settings(&self, base: &Settings) -> Result<Settings, RunError> {
        let mut settings = base.clone();
        let common = if self.paper { PAPER } else { &[] };
        for (name, value) in common.iter().chain(self.changes) {
            settings.set(name, value).map_err(SettingsError::from)?;
        }
        Ok(settings)
    }
}

/// Makes the table: one click per object in the photo that shows most of it. `told` hears of every cell.
pub fn ablation(
    out: &Path,
    options: &AblationOptions,
    mut told: impl FnMut(&Cell),
) -> Result<Vec<Cell>, TrialError> {
    let only = &options.only;
    if let Some(odd) = only.iter().find(|o| VARIANTS.iter().all(|v| v.name != o.as_str())) {
        return Err(TrialError::Row(odd.clone()));
    }
    let mut cells = Vec::new();
    for &seed in &options.seeds {
        let scene = SyntheticOptions { seed, ..options.scene.clone() };
        let trial =
            Trial::new(&out.join(format!("seed-{seed}")), &scene, options.providers, &options.faults)?;
        for variant in VARIANTS.iter().filter(|v| only.is_empty() || only.iter().any(|o| o == v.name)) {
            let settings = variant.settings(&options.settings)?;
            trial.train(&settings)?;
            let of = |score: &ObjectScore| Cell { seed, variant: variant.name.into(), score: score.clone() };
            let scores = trial.objects(&settings, |score| told(&of(score)))?;
            cells.extend(scores.iter().map(of));
        }
    }
    Ok(cells)
}

fn mean(cells: &[&Cell], pick: impl Fn(&ObjectScore) -> f64) -> f64 {
    cells.iter().map(|c| pick(&c.score)).sum::<f64>() / cells.len().max(1) as f64
}

/// The table in Markdown: a row per variant, means over all objects and seeds; then each object under `full`.
pub fn markdown(cells: &[Cell]) -> String {
    let mut text = String::from(
        "| row | what changes | IoU | Boundary IoU | accuracy | amodal IoU | amodal Boundary IoU | IoU in 3D | hidden wall | worst object |\n\
         |---|---|---:|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    for variant in VARIANTS {
        let rows: Vec<&Cell> = cells.iter().filter(|c| c.variant == variant.name).collect();
        let Some(worst) = rows.iter().min_by(|a, b| a.score.iou.total_cmp(&b.score.iou)) else { continue };
        let _ = writeln!(
            text,
            "| {} | {} | {:.3} | {:.3} | {:.4} | {:.3} | {:.3} | {:.3} | {:.4} | {} {:.3} |",
            variant.name,
            variant.meaning,
            mean(&rows, |s| s.iou),
            mean(&rows, |s| s.boundary_iou),
            mean(&rows, |s| s.accuracy),
            mean(&rows, |s| s.amodal_iou),
            mean(&rows, |s| s.amodal_boundary_iou),
            mean(&rows, |s| s.label_iou),
            rows.iter().map(|c| c.score.hidden).fold(0.0, f64::max),
            worst.score.object,
            worst.score.iou
        );
    }
    let first = VARIANTS.iter().find(|v| cells.iter().any(|c| c.variant == v.name));
    let Some(first) = first else { return text };
    let _ = write!(
        text,
        "\nEach object, `{}`:\n\n| seed | object | photos | IoU | worst photo | amodal IoU | Boundary IoU | IoU in 3D | hidden wall |\n\
         |---:|---|---:|---:|---:|---:|---:|---:|---:|\n",
        first.name
    );
    for Cell { seed, score: s, .. } in cells.iter().filter(|c| c.variant == first.name) {
        let _ = writeln!(
            text,
            "| {seed} | {} | {} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {:.4} |",
            s.object, s.photos, s.iou, s.worst, s.amodal_iou, s.boundary_iou, s.label_iou, s.hidden
        );
    }
    text
}
