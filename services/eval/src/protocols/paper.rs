//! The paper's targets and figures, as `data/photo_tourism.json` keeps them (method, section 10).

use serde::Deserialize;
use std::collections::BTreeMap;
use std::sync::LazyLock;

/// The file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Paper {
    /// The three scenes, in the order of Table 1.
    pub scenes: Vec<PaperScene>,
    /// Table 2.
    pub ablation: Vec<PaperRow>,
}

/// One scene.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperScene {
    /// Its name.
    pub name: String,
    /// As tables head it.
    pub short: String,
    /// Its folder in the user's copy of Photo Tourism.
    pub folder: String,
    /// NeRF-W's split file.
    pub split: String,
    /// PSNR in dB and SSIM of other methods on its test photos by the official protocol.
    pub published: BTreeMap<String, [f64; 2]>,
    /// What is clicked.
    pub targets: Vec<PaperTarget>,
}

/// One target.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperTarget {
    /// Its name.
    pub name: String,
    /// Folder of its true masks.
    pub folder: String,
    /// The synthetic object that stands for it.
    pub like: String,
    /// Stem of the photo that is clicked.
    pub reference: String,
    /// Stems of the photos that are scored.
    pub truth: Vec<String>,
    /// The paper's IoU by our name of the row; `full` is the paper's own method.
    pub iou: BTreeMap<String, f64>,
    /// The paper's accuracy of its own method.
    pub accuracy: f64,
}

/// A row of Table 2.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperRow {
    /// Our name of it.
    pub row: String,
    /// The paper's.
    pub name: String,
    /// IoU by short name of the scene.
    pub iou: BTreeMap<String, f64>,
}

/// The paper.
pub static PAPER: LazyLock<Paper> = LazyLock::new(|| {
    // Part of the program, and read by its tests.
    serde_json::from_str(include_str!("../../data/photo_tourism.json")).expect("the file fits its form")
});

/// The nine targets, each with its scene.
pub fn targets() -> impl Iterator<Item = (&'static PaperScene, &'static PaperTarget)> {
    PAPER.scenes.iter().flat_map(|s| s.targets.iter().map(move |t| (s, t)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manifest_gives_the_papers_scene_means() {
        assert_eq!(targets().count(), 9);
        let mean = |short: &str, of: &dyn Fn(&PaperTarget) -> f64| {
            let scene = PAPER.scenes.iter().find(|s| s.short == short).unwrap();
            scene.targets.iter().map(of).sum::<f64>() / scene.targets.len() as f64
        };
        // Table 1's last column: rounded there to three digits, in scenes of already rounded numbers.
        for (short, iou, accuracy) in [("BG", 0.930, 0.968), ("TM", 0.846, 0.920), ("TF", 0.827, 0.924)] {
            assert!((mean(short, &|t| t.iou["full"]) - iou).abs() < 0.002, "{short}");
            assert!((mean(short, &|t| t.accuracy) - accuracy).abs() < 0.002, "{short}");
        }
        for (scene, target) in targets() {
            assert_eq!(target.truth.len(), 3, "{} {}", scene.name, target.name);
            assert!(
                !target.truth.contains(&target.reference),
                "{} is scored where it is clicked",
                target.name
            );
            // Ours is the best row of every target in the paper.
            let best = target.iou.values().copied().fold(0.0, f64::max);
            assert_eq!(best, target.iou["full"], "{}", target.name);
            let digits = |stem: &String| stem.chars().all(|c| c.is_ascii_digit() || c == '_');
            assert!(target.truth.iter().chain([&target.reference]).all(digits));
        }
        for row in &PAPER.ablation {
            assert!(crate::baselines::row(&row.row).is_some(), "there is no row {}", row.row);
            assert_eq!(row.iou.len(), 3, "{}", row.name);
        }
    }
}
