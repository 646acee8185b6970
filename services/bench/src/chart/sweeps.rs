//! What the chart varies: one setting at a time, everything else as the default has it.

use segwild_pipeline::{Settings, SettingsError};

/// The setting under which the default is recorded.
pub const DEFAULT: &str = "default";

/// One setting and the values it is given.
#[derive(Clone, Copy, Debug)]
pub struct Sweep {
    /// Its name.
    pub name: &'static str,
    /// What it asks, in words.
    pub meaning: &'static str,
    /// The setting.
    pub setting: &'static str,
    /// Its values.
    pub values: &'static [&'static str],
    /// What is set beside it, for all values.
    pub common: &'static [(&'static str, &'static str)],
}

const fn sweep(
    name: &'static str,
    meaning: &'static str,
    setting: &'static str,
    values: &'static [&'static str],
) -> Sweep {
    Sweep { name, meaning, setting, values, common: &[] }
}

/// The sweeps, in the order of the legend.
pub const SWEEPS: &[Sweep] = &[
    sweep("preset", "all settings at once", "preset", &["draft", "standard", "best"]),
    sweep(
        "steps",
        "training steps, as a multiple of what the number of photos asks for",
        "effort",
        &["0.125", "0.25", "0.5", "1", "2", "4", "8"],
    ),
    sweep("splats", "most splats allowed", "splats", &["1000", "2500", "5000", "10000", "20000", "40000"]),
    sweep("channels", "numbers per splat that describe it", "channels", &["4", "8", "16", "32", "64"]),
    sweep(
        "size",
        "long side of the photos trained on, in pixels",
        "size",
        &["80", "120", "160", "240", "320", "480"],
    ),
    sweep(
        "appearance_model",
        "how much each photo may differ in light",
        "appearance_model",
        &["none", "affine", "embed", "gsw"],
    ),
    sweep(
        "refine",
        "steps that refine the lifted features; 0 is lifting alone",
        "refine_steps",
        &["0", "20", "60", "150", "300", "1000"],
    ),
    sweep("prompts", "mask prompts per photo", "prompt_budget", &["4", "16", "64", "128", "256", "1024"]),
    Sweep {
        name: "density",
        meaning: "how splats are added, all with the same splat budget and none stopping early",
        setting: "density",
        values: &["budget", "gradient", "mcmc"],
        common: &[("splats", "5000"), ("grow_gain", "0")],
    },
    sweep("budget", "who decides how much the scene gets", "budget", &["auto"]),
];

impl Sweep {
    /// The settings of a value, over a base given by names and values.
    pub fn settings(&self, base: &[(String, String)], value: &str) -> Vec<(String, String)> {
        let mut pairs = base.to_vec();
        if self.setting == "preset" {
            // A preset is a choice of steps, degree, prompts and refinement: the base's values of those yield.
            pairs.retain(|(name, _)| !PRESET.contains(&name.as_str()));
        }
        let more = self.common.iter().copied().chain([(self.setting, value)]);
        pairs.extend(more.map(|(name, value)| (name.to_owned(), value.to_owned())));
        pairs
    }

    /// Whether a value leaves everything as the base has it.
    pub fn is_base(&self, base: &[(String, String)], value: &str) -> Result<bool, SettingsError> {
        Ok(Settings::layered(None, base)? == Settings::layered(None, &self.settings(base, value))?)
    }

    /// What a record calls a value: numbers lie on an axis, words are part of the name.
    pub fn setting_of(&self, value: &str) -> (String, Option<f64>) {
        match value.parse() {
            Ok(number) => (self.name.to_owned(), Some(number)),
            Err(_) => (format!("{} {value}", self.name), None),
        }
    }
}

/// The settings that a preset decides.
const PRESET: &[&str] = &["preset", "steps", "effort", "sh_degree", "refine_steps", "prompt_budget"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_a_setting_and_the_default_is_found_again() {
        let base = vec![("preset".to_owned(), "draft".to_owned())];
        for sweep in SWEEPS {
            for value in sweep.values {
                Settings::layered(None, &sweep.settings(&base, value)).unwrap();
            }
        }
        let found = |name: &str| -> Vec<&str> {
            let sweep = SWEEPS.iter().find(|s| s.name == name).unwrap();
            sweep.values.iter().copied().filter(|v| sweep.is_base(&base, v).unwrap()).collect()
        };
        assert_eq!(found("steps"), ["0.5"]);
        assert_eq!(found("preset"), ["draft"]);
        assert_eq!(found("refine"), ["60"]);
        assert!(found("density").is_empty(), "it has another number of splats");
    }
}
