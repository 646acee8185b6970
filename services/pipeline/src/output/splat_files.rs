//! Files of splats in every format: what segwild writes itself, and what splat-transform makes of a `.ply`.

use crate::RunError;
use segwild_flow::{ProgramError, ProgramRunner, Stopper, files, find_program, program_output};
use segwild_scene::settings::Value;
use segwild_scene::{Export, SplatFormat, Splats, choice};
use std::fmt;
use std::path::{Path, PathBuf};

choice! {
    /// A format that splat-transform writes.
    pub enum ConvertedFormat {
        /// PlayCanvas' packed `.ply`, about a quarter as large.
        CompressedPly = "compressed.ply",
        /// PlayCanvas' images of splats, about a twentieth as large.
        Sog = "sog",
        /// A page that shows the splats in any browser, with all that it needs.
        Html = "html",
    }
}

/// A format of exported splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExportFormat {
    /// One that segwild writes.
    Own(SplatFormat),
    /// One that takes splat-transform.
    Converted(ConvertedFormat),
}

impl fmt::Display for ExportFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ExportFormat::Own(format) => format.fmt(f),
            ExportFormat::Converted(format) => format.fmt(f),
        }
    }
}

impl ExportFormat {
    /// All formats' words.
    pub fn choices() -> impl Iterator<Item = &'static str> {
        SplatFormat::CHOICES.iter().chain(ConvertedFormat::CHOICES).copied()
    }

    /// The format of a word.
    pub fn read(word: &str) -> Option<ExportFormat> {
        let own = SplatFormat::read(word).map(ExportFormat::Own);
        own.or_else(|_| ConvertedFormat::read(word).map(ExportFormat::Converted)).ok()
    }

    /// The format that a file's ending names.
    ///
    /// ```
    /// use segwild_pipeline::{ConvertedFormat, ExportFormat};
    /// let of = |name: &str| ExportFormat::of(name.as_ref()).unwrap();
    /// assert_eq!(of("statue.compressed.ply"), ExportFormat::Converted(ConvertedFormat::CompressedPly));
    /// assert_eq!(of("statue.v2.PLY").to_string(), "ply");
    /// assert!(ExportFormat::of("statue.obj".as_ref()).is_err());
    /// ```
    ///
    /// # Errors
    /// When it names none.
    pub fn of(path: &Path) -> Result<ExportFormat, RunError> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let ends = |word: &&str| name.strip_suffix(word).is_some_and(|stem| stem.ends_with('.'));
        // `.compressed.ply` ends in `.ply` as well.
        let longest = Self::choices().filter(ends).max_by_key(|word| word.len());
        longest.and_then(ExportFormat::read).ok_or_else(|| {
            let words: Vec<String> = Self::choices().map(|word| format!(".{word}")).collect();
            RunError::Request(format!(
                "{}: its ending names no format; splats are written as {}",
                path.display(),
                words.join(", ")
            ))
        })
    }

    /// How files of this format are made on this machine.
    ///
    /// # Errors
    /// When it takes splat-transform, and there is none.
    pub(crate) fn writer(self) -> Result<SplatFileWriter, RunError> {
        let converter = match self {
            ExportFormat::Own(_) => None,
            ExportFormat::Converted(format) => Some(SplatTransform::find().ok_or_else(|| missing(format))?),
        };
        Ok(SplatFileWriter { converter })
    }
}

fn missing(format: ConvertedFormat) -> RunError {
    RunError::NoProgram {
        purpose: format!(".{format} files are made by splat-transform"),
        program: "splat-transform",
        install: "npm install -g @playcanvas/splat-transform",
    }
}

/// A splat-transform that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SplatTransform {
    program: PathBuf,
    /// As it names itself: `splat-transform v2.7.1`.
    pub version: String,
}

impl SplatTransform {
    /// The splat-transform on the `PATH`; `None` where there is none that answers.
    pub fn find() -> Option<SplatTransform> {
        let program = find_program("splat-transform")?;
        let text = program_output(&program, &["--version"]).ok()?;
        let line = text.lines().find(|line| line.trim_start().starts_with("splat-transform"))?;
        let version: Vec<&str> = line.split_whitespace().take(2).collect();
        Some(SplatTransform { program, version: version.join(" ") })
    }

    /// Makes a file of a `.ply`; its ending names the format. The colour tables of `.sog` are computed on a GPU, or on the CPU where
    /// splat-transform can use none.
    fn convert(&self, from: &Path, to: &Path, stopper: &Stopper) -> Result<(), RunError> {
        let run = |device: &[&str]| -> Result<(), ProgramError> {
            let arguments = ["--quiet", "--overwrite"].iter().chain(device).map(|&word| word.to_owned());
            let arguments: Vec<String> = arguments.chain([from, to].map(absolute)).collect();
            // The line that names the cause: a trace and the time follow it.
            let mut cause = None;
            let done = ProgramRunner { log: None, stopper }.run(&self.program, &arguments, |line| {
                cause =
                    cause.take().or_else(|| line.split_once("Error: ").map(|(_, words)| words.to_owned()));
            });
            done.map_err(|error| match (error, cause) {
                (ProgramError::Failed { program, log, .. }, Some(last)) => {
                    ProgramError::Failed { program, last, log }
                }
                (error, _) => error,
            })
        };
        match run(&[]) {
            Err(ProgramError::Failed { .. }) => Ok(run(&["--gpu", "cpu"])?),
            done => Ok(done?),
        }
    }
}

/// Writes files of one format.
pub(crate) struct SplatFileWriter {
    converter: Option<SplatTransform>,
}

impl SplatFileWriter {
    /// Writes splats of the normalised frame to a file of this format, whole or not at all, and the offset beside it.
    ///
    /// # Errors
    /// When the disk fails, splat-transform does, or `stopper` stops it.
    pub fn write(
        &self,
        export: &Export<'_>,
        path: &Path,
        splats: &Splats,
        stopper: &Stopper,
    ) -> Result<(), RunError> {
        let Some(converter) = &self.converter else {
            return Ok(export.write(path, splats)?);
        };
        files::write_by_folder(path, |aside| -> Result<(), RunError> {
            let plain = aside.join("splats.ply");
            export.write(&plain, splats)?;
            let out = aside.join(path.file_name().unwrap_or_default());
            converter.convert(&plain, &out, stopper)
        })?;
        Ok(export.note_offset(path)?)
    }
}

/// A path that no program takes for an option or an address.
pub(crate) fn absolute(path: &Path) -> String {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned()).display().to_string()
}
