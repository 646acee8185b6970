//! COLMAP as it stands on this machine: its version, and the options that it knows.

use crate::PosesError;
use segwild_flow::{ProgramError, find_program, program_output};
use std::path::{Path, PathBuf};

/// A COLMAP that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Colmap {
    program: PathBuf,
    /// As it names itself: `COLMAP 3.8`.
    pub version: String,
    /// Whether it computes on a GPU.
    pub has_cuda: bool,
    /// Whether it has GLOMAP within it, as `global_mapper`.
    pub(crate) has_global_mapper: bool,
    /// Whether it estimates focal lengths from pairs of photos, as `view_graph_calibrator`.
    pub(crate) has_calibrator: bool,
}

impl Colmap {
    /// The COLMAP on the `PATH`; `None` where there is none that answers.
    pub fn find() -> Option<Colmap> {
        let program = find_program("colmap")?;
        let text = program_output(&program, &["help"]).ok()?;
        Colmap::of_help(program, &text)
    }

    /// Reads version, GPU and commands from its help.
    pub(crate) fn of_help(program: PathBuf, text: &str) -> Option<Colmap> {
        let version = text.lines().next()?.split(" -- ").next()?.trim().to_owned();
        let has_cuda = text.lines().take(3).any(|line| line.contains("with CUDA"));
        let has = |command: &str| text.lines().any(|line| line.trim() == command);
        let (has_global_mapper, has_calibrator) = (has("global_mapper"), has("view_graph_calibrator"));
        let found = Colmap { program, version, has_cuda, has_global_mapper, has_calibrator };
        found.version.starts_with("COLMAP").then_some(found)
    }

    /// Its file.
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// A command of it, without options.
    ///
    /// # Errors
    /// It cannot be started.
    pub(crate) fn command(&self, name: &str) -> Result<ColmapCommand, PosesError> {
        ColmapCommand::of(&self.program, name)
    }
}

/// A command of COLMAP, or of a program that takes its options.
pub(crate) struct ColmapCommand {
    help: String,
    arguments: Vec<String>,
}

impl ColmapCommand {
    /// The command of a name, without options.
    ///
    /// # Errors
    /// The program cannot be started.
    pub fn of(program: &Path, name: &str) -> Result<ColmapCommand, PosesError> {
        let stem = program.file_stem().unwrap_or_default().to_string_lossy();
        let started = |source| ProgramError::Start { program: format!("{stem} {name}"), source };
        let help = program_output(program, &[name, "-h"]).map_err(started)?;
        Ok(ColmapCommand::with_help(name, help))
    }

    /// The command whose help is this one.
    pub fn with_help(name: &str, help: impl Into<String>) -> ColmapCommand {
        ColmapCommand { help: help.into(), arguments: vec![name.to_owned()] }
    }

    /// Whether this version knows an option.
    pub fn knows(&self, name: &str) -> bool {
        self.help.split_whitespace().any(|word| word.strip_prefix("--") == Some(name))
    }

    /// Adds an option by the first of its names that this version knows; names changed in version 3.13. An option that it
    /// does not know is left at what the version does without it.
    pub fn option(mut self, names: &[&str], value: impl ToString) -> ColmapCommand {
        match names.iter().find(|name| self.knows(name)) {
            Some(name) => self.arguments.extend([format!("--{name}"), value.to_string()]),
            None => tracing::warn!("colmap {} has no option {}", self.arguments[0], names.join(" or ")),
        }
        self
    }

    /// Adds an option that is a path.
    pub fn path(self, name: &str, path: &Path) -> ColmapCommand {
        self.option(&[name], path.display())
    }

    /// The arguments.
    pub fn arguments(self) -> Vec<String> {
        self.arguments
    }
}

/// The numbers in the last brackets of a line: `[3, 4]` of `Matching block [3/7, 4/7]`, with those after the slashes.
pub(crate) fn numbers_in(line: &str, open: char, close: char) -> Vec<u64> {
    let inner =
        line.rsplit_once(open).and_then(|(_, rest)| rest.split_once(close)).map_or("", |(inner, _)| inner);
    let digits = inner.split(|c: char| !c.is_ascii_digit()).filter(|part| !part.is_empty());
    digits.filter_map(|part| part.parse().ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_named_as_the_version_knows_them() {
        let command = |help: &str| ColmapCommand::with_help("extractor", help);
        let names = ["SiftExtraction.use_gpu", "FeatureExtraction.use_gpu"];
        let old = command("  --SiftExtraction.use_gpu arg (=1)").option(&names, 0).arguments();
        assert_eq!(old, ["extractor", "--SiftExtraction.use_gpu", "0"]);
        let new = command("  --FeatureExtraction.use_gpu arg (=1)").option(&names, 0).arguments();
        assert_eq!(new, ["extractor", "--FeatureExtraction.use_gpu", "0"]);
        assert_eq!(command("  --other arg").option(&names, 0).arguments(), ["extractor"]);
    }

    #[test]
    fn the_help_names_version_gpu_and_global_mapper() {
        let of = |text: &str| Colmap::of_help("colmap".into(), text);
        let old = "COLMAP 3.8 -- Structure-from-Motion\n  (Commit Unknown on Unknown without CUDA)\n\n\
                   Available commands:\n  help\n  hierarchical_mapper\n  mapper\n";
        let old = of(old).unwrap();
        assert_eq!((&*old.version, old.has_cuda, old.has_global_mapper), ("COLMAP 3.8", false, false));
        let new = "COLMAP 4.0.1 -- Structure-from-Motion\n  (Commit 1a2b on 2026-01-01 with CUDA)\n  global_mapper\n";
        let new = of(new).unwrap();
        assert_eq!((&*new.version, new.has_cuda, new.has_global_mapper), ("COLMAP 4.0.1", true, true));
        assert!(!new.has_calibrator);
        let newer = of("COLMAP 4.2.1 -- x\n  global_mapper\n  view_graph_calibrator\n").unwrap();
        assert!(newer.has_global_mapper && newer.has_calibrator);
        assert_eq!(of("another program"), None);
    }

    #[test]
    fn progress_is_read_off_lines_of_several_versions() {
        assert_eq!(numbers_in("Processed file [12/40]", '[', ']'), [12, 40]);
        assert_eq!(numbers_in("Matching block [3/7, 4/7] in 1.203s", '[', ']'), [3, 7, 4, 7]);
        assert_eq!(numbers_in("Registering image #7 (12)", '(', ')'), [12]);
        assert_eq!(numbers_in("Registering image #7 (num_reg_frames=12)", '(', ')'), [12]);
        assert_eq!(numbers_in("nothing", '[', ']'), [0; 0]);
    }
}
