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
}

impl Colmap {
    /// The COLMAP on the `PATH`; `None` where there is none that answers.
    pub fn find() -> Option<Colmap> {
        let program = find_program("colmap")?;
        let text = program_output(&program, &["help"]).ok()?;
        let version = text.lines().next()?.split(" -- ").next()?.trim().to_owned();
        let has_cuda = text.lines().take(3).any(|line| line.contains("with CUDA"));
        version.starts_with("COLMAP").then_some(Colmap { program, version, has_cuda })
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
        let started = |source| ProgramError::Start { program: format!("colmap {name}"), source };
        let help = program_output(&self.program, &[name, "-h"]).map_err(started)?;
        Ok(ColmapCommand { help, arguments: vec![name.to_owned()] })
    }
}

/// A command of COLMAP and its options.
pub(crate) struct ColmapCommand {
    help: String,
    arguments: Vec<String>,
}

impl ColmapCommand {
    /// Adds an option by the first of its names that this version knows; names changed in version 3.13. An option that it
    /// does not know is left at what the version does without it.
    pub fn option(mut self, names: &[&str], value: impl ToString) -> ColmapCommand {
        let knows = |name: &&&str| {
            let mut words = self.help.split_whitespace();
            words.any(|word| word.strip_prefix("--") == Some(name))
        };
        match names.iter().find(knows) {
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
        let command = |help: &str| ColmapCommand { help: help.into(), arguments: vec!["extractor".into()] };
        let names = ["SiftExtraction.use_gpu", "FeatureExtraction.use_gpu"];
        let old = command("  --SiftExtraction.use_gpu arg (=1)").option(&names, 0).arguments();
        assert_eq!(old, ["extractor", "--SiftExtraction.use_gpu", "0"]);
        let new = command("  --FeatureExtraction.use_gpu arg (=1)").option(&names, 0).arguments();
        assert_eq!(new, ["extractor", "--FeatureExtraction.use_gpu", "0"]);
        assert_eq!(command("  --other arg").option(&names, 0).arguments(), ["extractor"]);
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
