//! The record of a selection.

use crate::artifacts::intact::Intact;
use crate::{RunError, RunFolder};
use segwild_flow::{CodecError, codec};
use segwild_scene::Splats;
use segwild_segmenter::{SpikeCut, SplatGeometry};
use wincode::{SchemaRead, SchemaWrite};

/// Kind of the record in `selection.bin`.
const SELECTION: &str = "selection";

/// `selection.bin`: a selection that can be rendered again.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Selected {
    /// Per splat of the scene, whether it belongs to the object, after the cut.
    pub labels: Vec<bool>,
    /// Splats that the cut changes, and what they become.
    pub changed: Vec<Shortened>,
}

/// A splat after the spike cut.
#[derive(Clone, Copy, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Shortened {
    /// Which splat of the scene.
    pub splat: u32,
    /// Its centre.
    pub mean: [f32; 3],
    /// Logarithms of its standard deviations.
    pub log_scales: [f32; 3],
    /// Its rotation (w, x, y, z).
    pub rotation: [f32; 4],
}

/// Why bytes are no selection of a scene.
#[derive(Debug, thiserror::Error)]
pub enum SelectedError {
    /// They are no record of a selection.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// The scene has another number of splats.
    #[error("it is of another scene: {splats} splats instead of {wanted}")]
    OtherScene {
        /// Splats of the selection's scene.
        splats: usize,
        /// Splats of this one.
        wanted: usize,
    },
    /// It changes more splats than there are.
    #[error("it is damaged: {changed} splats of {splats} are shortened")]
    TooManyChanged {
        /// Splats that the spike cut changes.
        changed: usize,
        /// Splats of the scene.
        splats: usize,
    },
    /// A splat that it changes does not exist, or becomes none.
    #[error("it is damaged: the shape of splat {splat} of {splats} is none")]
    NoShape {
        /// The splat.
        splat: u32,
        /// Splats of the scene.
        splats: usize,
    },
}

impl Selected {
    /// The labels and what a cut changes.
    pub(crate) fn new(labels: &[bool], cut: &SpikeCut) -> Selected {
        let mut labels = labels.to_vec();
        cut.trim(&mut labels);
        let after = |&(splat, _, SplatGeometry { mean, log_scales, rotation }): &(
            u32,
            SplatGeometry,
            SplatGeometry,
        )| { Shortened { splat, mean, log_scales, rotation } };
        Selected { labels, changed: cut.changed.iter().map(after).collect() }
    }

    /// Refuses a record that no cut can have written: it may come from another program.
    fn check(&self) -> Result<(), SelectedError> {
        let splats = self.labels.len();
        let sound = |s: &Shortened| {
            let numbers = || s.mean.iter().chain(&s.log_scales).chain(&s.rotation);
            (s.splat as usize) < splats && numbers().all(|x| x.is_finite())
        };
        match self.changed.iter().find(|s| !sound(s)) {
            _ if self.changed.len() > splats => {
                Err(SelectedError::TooManyChanged { changed: self.changed.len(), splats })
            }
            Some(s) => Err(SelectedError::NoShape { splat: s.splat, splats }),
            None => Ok(()),
        }
    }

    /// The bytes of `selection.bin`.
    ///
    /// # Panics
    /// Never: memory takes every byte.
    pub fn to_bytes(&self) -> Vec<u8> {
        codec::encode(SELECTION, self).expect("memory takes every byte")
    }

    /// Reads the bytes of a `selection.bin` of a scene of so many splats.
    ///
    /// # Errors
    /// Why they are none.
    pub fn from_bytes(bytes: &[u8], splats: usize) -> Result<Selected, SelectedError> {
        let selected: Selected = codec::decode(SELECTION, bytes)?;
        if selected.labels.len() != splats {
            return Err(SelectedError::OtherScene { splats: selected.labels.len(), wanted: splats });
        }
        selected.check()?;
        Ok(selected)
    }

    /// A selection without a spike cut.
    pub fn of_labels(labels: Vec<bool>) -> Selected {
        Selected { labels, changed: Vec::new() }
    }

    /// The indexes of its splats.
    pub(crate) fn splats(&self) -> Vec<usize> {
        (0..self.labels.len()).filter(|&i| self.labels[i]).collect()
    }

    /// The scene with the cut applied.
    pub fn cut_scene(&self, splats: &Splats) -> Splats {
        let mut splats = splats.clone();
        for s in &self.changed {
            let i = s.splat as usize;
            (splats.means[i], splats.log_scales[i], splats.rotations[i]) = (s.mean, s.log_scales, s.rotation);
        }
        splats
    }

    /// Reads a run's selection by name. `splats` is the number of splats of the trained scene.
    ///
    /// # Errors
    /// When there is no such selection, it is damaged, or the scene has been trained again since.
    pub fn read(folder: &RunFolder, name: &str, splats: usize) -> Result<Selected, RunError> {
        folder.has_selection(name)?;
        let path = folder.selection(name);
        Intact::of(folder, name)?.check(&path.join("selection.bin"))?;
        let selected: Selected =
            folder.read_record(&format!("selections/{name}/selection.bin"), SELECTION)?;
        if selected.labels.len() != splats {
            let reason =
                "the scene has been trained again since; segment again (`--prompts` replays the clicks)";
            return Err(RunError::Folder { path, reason: reason.into() });
        }
        selected.check().map_err(|error| RunError::Folder {
            path: path.join("selection.bin"),
            reason: error.to_string(),
        })?;
        Ok(selected)
    }
}
