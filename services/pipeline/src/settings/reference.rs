//! The pages of the reference on settings.

use super::composed::Settings;
use segwild_scene::settings::{Field, Value};
use segwild_trainer::Preset;
use std::fmt::Write as _;

impl Settings {
    /// A page of the reference, one table per group: the settings that a user needs, or those for experts.
    pub fn to_markdown(expert: bool) -> String {
        let mut text = String::from(if expert { EXPERT_PAGE } else { USER_PAGE });
        for (table, doc, fields) in Settings::catalogue() {
            let rows: Vec<String> = fields.iter().filter(|f| f.expert == expert).map(row).collect();
            if !rows.is_empty() {
                let head = "| flag | default | meaning |\n|---|---|---|\n";
                let _ = write!(text, "\n## `[{table}]`\n\n{doc}\n\n{head}{}", rows.concat());
            }
        }
        if !expert {
            text += &presets();
        }
        text
    }
}

/// The section of the reference on what each preset sets: the settings that are not the same under all of them.
fn presets() -> String {
    let words = Preset::CHOICES;
    let defaults: Vec<Settings> =
        words.iter().filter_map(|word| Preset::read(word).ok()).map(Settings::preset).collect();
    let mut text = format!(
        "\n## Presets\n\nWhat `--preset` sets. The defaults of all other settings do not depend on it.\n\n| flag | {} |\n|---|{}\n",
        words.join(" | "),
        "---:|".repeat(words.len())
    );
    for field in Settings::catalogue().into_iter().flat_map(|(_, _, fields)| fields) {
        let values: Vec<String> = defaults.iter().filter_map(|settings| settings.get(field.name)).collect();
        if field.name != "preset" && values.iter().any(|value| *value != values[0]) {
            let _ = writeln!(text, "| `--{}` | {} |", field.name.replace('_', "-"), values.join(" | "));
        }
    }
    text
}

/// Head of the reference's first page.
const USER_PAGE: &str = "# Settings\n\nThese are the settings that a user needs; [all others](expert-settings.md) are for \
    experts. Every setting is a flag (`--name value`) and a line of `segwild.toml`. Flags win over the file, the file wins over \
    the preset. This page is generated: `segwild doctor --settings user`.\n";

/// Head of its second page.
const EXPERT_PAGE: &str = "# Expert settings\n\nFew scenes need these; [the others](settings.md) come first. `--help-all` \
    lists them beside the flags of a command. This page is generated: `segwild doctor --settings expert`.\n";

/// The row of a setting on a page of the reference. Each word of a choice has a line of its own.
fn row(field: &Field) -> String {
    let explained: String =
        field.explained_choices().map(|(word, doc)| format!("<br>`{word}`: {doc}")).collect();
    let choices = match field.range {
        Some(range) => format!(" ({})", range()),
        None if field.choices.is_empty() || !explained.is_empty() => explained,
        None => format!(" ({})", field.choices.join(", ")),
    };
    let default = match Settings::default().get(field.name).unwrap_or_default() {
        none if none.is_empty() => "*none*".to_owned(),
        default => format!("`{default}`"),
    };
    format!("| `--{}` | {default} | {}{choices} |\n", field.name.replace('_', "-"), field.doc)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_of_a_choice_is_explained() {
        for field in Settings::catalogue().into_iter().flat_map(|(_, _, fields)| fields) {
            if field.choices != bool::CHOICES {
                assert_eq!(field.choices.len(), field.choice_docs.len(), "{}", field.name);
            }
            let one_line = |doc: &&str| doc.ends_with('.') && !doc.contains(['|', '\n']);
            assert!(field.choice_docs.iter().all(one_line), "{}: {:?}", field.name, field.choice_docs);
        }
        let page = Settings::to_markdown(false);
        assert!(page.contains("How spikes are cut.<br>`axis`: Shrunk along the direction"), "{page}");
        assert!(Settings::default().to_toml().contains("#   off: Not cut.\nspikes = \"axis\"\n"));
    }

    #[test]
    fn the_reference_names_what_each_preset_sets() {
        let page = Settings::to_markdown(false);
        let (_, section) = page.split_once("## Presets").unwrap();
        assert!(section.contains("| flag | draft | standard | best | paper |"), "{section}");
        for row in [
            "| `--effort` | 0.5 | 1 | 1.5 | 1 |",
            "| `--sh-degree` | 1 | 2 | 3 | 3 |",
            "| `--spikes` | axis | axis | axis | isotropic |",
        ] {
            assert!(section.contains(row), "{section}");
        }
        assert!(!section.contains("`--seed`"), "{section}");
    }
}
