//! Settings from a file and from flags, and as a file.

use super::composed::Settings;
use super::former::{is_removed, renamed};
use super::whole_run::RunSettings;
use segwild_flow::files;
use segwild_scene::settings::{Group, SettingError};
use segwild_vision::VisionSettings;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Why settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The file cannot be read.
    #[error("{file}: cannot be read: {source}")]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("{file}: {reason}")]
    File {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: String,
    },
    /// A value or a name does not fit.
    #[error(transparent)]
    Setting(#[from] SettingError),
}

impl Settings {
    /// Defaults of the preset, then the file, then the flags: later wins. Flags are `(name, value)` pairs. A flag that
    /// names another preset or budget than the file also replaces the values that the file has from its own preset or
    /// budget.
    pub fn layered(file: Option<&Path>, flags: &[(String, String)]) -> Result<Settings, SettingsError> {
        let values = match file {
            // A person may name a pipe: `--config <(..)`.
            Some(file) => read_pairs(file, std::fs::read(file))?,
            None => Vec::new(),
        };
        Settings::layered_over(&values, file, flags)
    }

    /// As [`Settings::layered`], from the file of a run folder. The folder may come from somebody else: its paths of code
    /// ([`VisionSettings::CODE`]) are passed over.
    pub fn recorded(file: &Path, flags: &[(String, String)]) -> Result<Settings, SettingsError> {
        let mut values = read_pairs(file, files::read_plain(file))?;
        values.retain(|(name, _)| !VisionSettings::CODE.contains(&name.as_str()));
        Settings::layered_over(&values, Some(file), flags)
    }

    /// As [`Settings::recorded`] without flags, but with the paths of code: to show them, never to load what they name.
    pub(crate) fn recorded_with_code(file: &Path) -> Result<Settings, SettingsError> {
        let values = read_pairs(file, files::read_plain(file))?;
        Settings::layered_over(&values, Some(file), &[])
    }

    fn layered_over(
        values: &[(String, String)],
        file: Option<&Path>,
        flags: &[(String, String)],
    ) -> Result<Settings, SettingsError> {
        let in_file = |e: SettingError| SettingsError::File {
            file: file.map(Path::to_path_buf).unwrap_or_default(),
            reason: e.to_string(),
        };
        let mut chosen = RunSettings::default();
        let above = |name: &str| name == "preset" || name == "budget";
        for (name, value) in values.iter().filter(|(name, _)| above(name)) {
            chosen.set(name, value).map_err(in_file)?;
        }
        let filed = Settings::defaults(chosen.preset, chosen.budget);
        for (name, value) in flags.iter().filter(|(name, _)| above(name)) {
            chosen.set(name, value)?;
        }
        let mut settings = Settings::defaults(chosen.preset, chosen.budget);
        let as_filed = (chosen.preset, chosen.budget) == (filed.run.preset, filed.run.budget);
        for (name, value) in values {
            let mut probe = filed.clone();
            probe.set(name, value).map_err(in_file)?;
            if as_filed || probe != filed {
                settings.set(name, value).map_err(in_file)?;
            }
        }
        for (name, value) in flags {
            settings.set(name, value)?;
        }
        Ok(settings)
    }

    /// As `segwild.toml`, each setting with its documentation above it.
    pub fn to_toml(&self) -> String {
        let mut text = String::new();
        for (table, doc, fields) in Settings::catalogue() {
            let _ = write!(text, "# {doc}\n[{table}]\n");
            for field in fields {
                let value = self.get(field.name).unwrap_or_default();
                let quoted = if field.kind == "N" || field.kind == "X" || field.choices == ["true", "false"] {
                    value
                } else {
                    toml::Value::String(value).to_string()
                };
                let _ = writeln!(text, "# {}", field.doc);
                for (word, doc) in field.explained_choices() {
                    let _ = writeln!(text, "#   {word}: {doc}");
                }
                let _ = writeln!(text, "{} = {quoted}", field.name);
            }
            text.push('\n');
        }
        text
    }
}

/// A settings file as `(name, value)` pairs; the table of each must be the one it belongs to.
fn read_pairs(file: &Path, read: std::io::Result<Vec<u8>>) -> Result<Vec<(String, String)>, SettingsError> {
    let wrong = |reason: String| SettingsError::File { file: file.to_path_buf(), reason };
    let bytes = read.map_err(|source| SettingsError::Read { file: file.to_path_buf(), source })?;
    let text = segwild_scene::text::decode(bytes).map_err(|e| wrong(e.to_string()))?;
    let tables: toml::Table = text.parse().map_err(|e: toml::de::Error| wrong(e.to_string()))?;
    let catalogue = Settings::catalogue();
    let mut pairs = Vec::new();
    for (table, content) in &tables {
        let Some((_, _, fields)) = catalogue.iter().find(|(name, _, _)| name == table) else {
            return Err(wrong(format!("there is no table [{table}]")));
        };
        let Some(content) = content.as_table() else {
            return Err(wrong(format!("`{table}` must be a table: [{table}]")));
        };
        for (name, value) in content {
            let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            if is_removed(name, &value) {
                continue;
            }
            if !fields.iter().any(|f| f.name == name) {
                let now = renamed(name).map_or(String::new(), |now| format!("; it is now `{now}`"));
                return Err(wrong(format!("[{table}] has no setting `{name}`{now}")));
            }
            pairs.push((name.clone(), value));
        }
    }
    Ok(pairs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_trainer::Preset;

    #[test]
    fn file_and_flags_are_layered_over_the_preset() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        std::fs::write(&file, "[run]\npreset = \"draft\"\n[segment]\ntau = 0.4\n").unwrap();
        let flags = [("tau".to_owned(), "0.3".to_owned())];
        let settings = Settings::layered(Some(&file), &flags).unwrap();
        assert_eq!(settings.run.preset, Preset::Draft);
        assert_eq!(settings.train, Settings::preset(Preset::Draft).train);
        assert_eq!(settings.segment.tau, 0.3);
    }

    #[test]
    fn a_settings_file_that_a_windows_editor_saved_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        std::fs::write(&file, "\u{feff}[segment]\r\ntau = 0.4\r\n").unwrap();
        assert_eq!(Settings::layered(Some(&file), &[]).unwrap().segment.tau, 0.4);
        std::fs::write(&file, b"[\0s\0]\0").unwrap();
        let refused = Settings::layered(Some(&file), &[]).unwrap_err().to_string();
        assert!(refused.contains("segwild.toml") && refused.contains("UTF-16"), "{refused}");
    }

    #[test]
    fn another_preset_is_obeyed_in_a_folder_that_remembers_all_settings() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        let mut draft = Settings::preset(Preset::Draft);
        draft.set("tau", "0.4").unwrap();
        std::fs::write(&file, draft.to_toml()).unwrap();
        let flags = [("preset".to_owned(), "best".to_owned())];
        let mut best = Settings::preset(Preset::Best);
        best.set("tau", "0.4").unwrap();
        assert_eq!(Settings::layered(Some(&file), &flags).unwrap(), best);
        assert_eq!(Settings::layered(Some(&file), &[]).unwrap(), draft);
    }

    #[test]
    fn a_run_folder_names_no_code() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        let mut sent = Settings::default();
        for name in VisionSettings::CODE {
            sent.set(name, "/tmp/theirs").unwrap();
        }
        sent.set("tau", "0.4").unwrap();
        std::fs::write(&file, sent.to_toml()).unwrap();
        let settings = Settings::recorded(&file, &[]).unwrap();
        assert!(!settings.to_toml().contains("/tmp/theirs"));
        assert_eq!(settings.segment.tau, 0.4);
        let flags = [("models".to_owned(), "/mine".to_owned())];
        assert_eq!(Settings::recorded(&file, &flags).unwrap().vision.models, "/mine");
    }

    #[test]
    fn what_is_written_reads_back_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        for preset in [Preset::Draft, Preset::Standard, Preset::Best, Preset::Paper] {
            let settings = Settings::preset(preset);
            std::fs::write(&file, settings.to_toml()).unwrap();
            assert_eq!(Settings::layered(Some(&file), &[]).unwrap(), settings);
        }
    }

    #[test]
    fn the_settings_of_a_run_from_before_some_of_them_were_removed_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        std::fs::write(
            &file,
            "[segment]\nseen = 0\ncentre_visible = false\ngraph_cut_smoothness = 1.0\ntau = 0.4\n",
        )
        .unwrap();
        assert_eq!(Settings::layered(Some(&file), &[]).unwrap().segment.tau, 0.4);
        std::fs::write(&file, "[segment]\nseen = 0.1\n").unwrap();
        let refused = Settings::layered(Some(&file), &[]).unwrap_err().to_string();
        assert!(refused.contains("has no setting `seen`"), "{refused}");
    }

    #[test]
    fn mistakes_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        for (text, words) in [
            ("[segment]\ntua = 0.4\n", "[segment] has no setting `tua`"),
            ("[sgement]\n", "there is no table [sgement]"),
            ("[segment]\ntau = \"much\"\n", "`much` does not fit `tau`"),
            ("[train]\neffort = 0\n", "expected 0.01 to 100"),
            ("[segment]\ntau = 7\n", "expected -1 to 1"),
            ("[segment\n", "segwild.toml"),
        ] {
            std::fs::write(&file, text).unwrap();
            let message = Settings::layered(Some(&file), &[]).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }
}
