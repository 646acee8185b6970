//! What each part of the method is worth: the same scenes and clicks with one part changed at a time (paper,
//! Table 2).

use segwild_pipeline::{RunError, Settings, SettingsError};

/// A row of a table: its name, and the settings that differ from the defaults.
#[derive(Clone, Copy, Debug)]
pub struct Variant {
    /// Name of the row.
    pub name: &'static str,
    /// What it changes, in words.
    pub meaning: &'static str,
    /// Settings that it has in common with other rows, such as [`PAPER`].
    pub common: Changes,
    /// Settings that differ from those.
    pub changes: Changes,
}

/// Settings by name, and their values.
pub type Changes = &'static [(&'static str, &'static str)];

/// The paper's query: the clicked photo alone, splats by their projected centres, every one of them gated by
/// resemblance, spikes shrunk in all directions. Resemblance alone decides what the clicked photo cannot, so it gets the
/// features' steps that served it best by the oracle's masks: 300, for .73 IoU of things that resemble each other, where the default's 60
/// give .64.
pub const PAPER: &[(&str, &str)] = &[
    ("first_answer", "photo"),
    ("propagate", "0"),
    ("evidence_mode", "centre"),
    ("similarity_use", "gate"),
    ("click_temperature", "1"),
    ("spikes", "isotropic"),
    ("cut_by", "prompts"),
    ("refine_steps", "300"),
];

const fn ours(name: &'static str, meaning: &'static str, changes: Changes) -> Variant {
    Variant { name, meaning, common: &[], changes }
}

const fn paper(name: &'static str, meaning: &'static str, changes: Changes) -> Variant {
    Variant { name, meaning, common: PAPER, changes }
}

/// The program as it is.
pub const FULL: Variant = ours("full", "the defaults", &[]);

/// The paper's query on the same scene.
pub const AS_PUBLISHED: Variant = paper("paper", "the paper's query", &[]);

/// The rows. Geometry is trained once per scene (`no-sky` trains it again: the sky takes part in training), and what
/// a row does not change comes from the content cache.
pub const VARIANTS: &[Variant] = &[
    FULL,
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
    ours("channels-128", "128 numbers per splat, if the embedding has as many", &[("channels", "128")]),
    ours("no-features", "resemblance takes no part", &[("similarity_use", "off")]),
    ours("one-photo", "the clicked photo alone", &[("propagate", "0")]),
    AS_PUBLISHED,
    paper("paper-no-lcom", "features without the compactness loss", &[("compactness", "false")]),
    paper("paper-no-sasm", "mask prompts on a uniform grid", &[("sasm", "false")]),
    paper("paper-no-sky-prompts", "prompts that do not know the sky", &[("sky_prompts", "false")]),
    paper("paper-no-sgc", "spikes stay", &[("spikes", "off")]),
    paper("paper-axis-sgc", "spikes shrunk along the cut only", &[("spikes", "axis")]),
    paper("paper-tau-0.3", "resemblance from 0.3", &[("tau", "0.3")]),
    paper("paper-tau-0.7", "resemblance from 0.7", &[("tau", "0.7")]),
    paper("paper-channels-16", "16 numbers per splat", &[("channels", "16")]),
    paper("paper-channels-32", "32 numbers per splat", &[("channels", "32")]),
    paper(
        "paper-channels-128",
        "128 numbers per splat, if the embedding has as many",
        &[("channels", "128")],
    ),
    paper("paper-no-features", "the projected centre alone", &[("similarity_use", "off")]),
    paper("paper-coverage", "splats by their visible light", &[("evidence_mode", "coverage")]),
];

impl Variant {
    /// The row's settings.
    pub fn settings(&self, base: &Settings) -> Result<Settings, RunError> {
        let mut settings = base.clone();
        for (name, value) in self.common.iter().chain(self.changes) {
            settings.set(name, value).map_err(SettingsError::from)?;
        }
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_pipeline::Preset;

    #[test]
    fn the_preset_of_the_paper_has_the_query_of_its_rows() {
        let preset = Settings::preset(Preset::Paper);
        for (name, value) in PAPER {
            assert_eq!(preset.get(name).as_deref(), Some(*value), "{name}");
        }
    }
}
