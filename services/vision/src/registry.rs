//! The known network files: their names, families and licences.
//!
//! Segwild ships none of them. A licence here is the one that the published project states for its weights; whoever uses a file
//! is responsible for its origin.

use crate::VisionError;
use crate::model_file::{ModelFileError, inspect};
use std::path::{Path, PathBuf};

/// Where a network comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// Segment Anything (Kirillov et al. 2023).
    Sam,
    /// MobileSAM (Zhang et al. 2023).
    MobileSam,
    /// EfficientSAM (Xiong et al. 2023).
    EfficientSam,
    /// Learned boundaries.
    Edges,
    /// Sky as one probability.
    Sky,
    /// DeepLab over the classes of Cityscapes.
    Deeplab,
}

impl Family {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Family::Sam => "SAM",
            Family::MobileSam => "MobileSAM",
            Family::EfficientSam => "EfficientSAM",
            Family::Edges => "edge network",
            Family::Sky => "sky network",
            Family::Deeplab => "DeepLab over Cityscapes",
        }
    }

    /// The terms, as far as they are known.
    pub fn licence(self) -> &'static str {
        match self {
            Family::Sam | Family::MobileSam | Family::EfficientSam => "Apache-2.0 (code and weights)",
            Family::Edges => "research use (trained on BSDS500)",
            Family::Sky => "not stated: ask where the file came from",
            Family::Deeplab => "trained on Cityscapes, whose terms are non-commercial",
        }
    }
}

/// Pairs of networks by the stem of their names, in the order of search: those that a CPU can run come first.
const PAIRS: [(&str, Family); 13] = [
    ("mobile_sam", Family::MobileSam),
    ("mobilesam", Family::MobileSam),
    ("efficient_sam_vitt", Family::EfficientSam),
    ("efficientsam_ti", Family::EfficientSam),
    ("efficient_sam_vits", Family::EfficientSam),
    ("efficientsam_s", Family::EfficientSam),
    ("sam_vit_b", Family::Sam),
    ("sam_vit_b_01ec64", Family::Sam),
    ("sam_vit_l", Family::Sam),
    ("sam_vit_l_0b3195", Family::Sam),
    ("sam_vit_h", Family::Sam),
    ("sam_vit_h_4b8939", Family::Sam),
    ("sam", Family::Sam),
];

/// Networks of one file each.
pub(crate) const EDGES: &str = "edges_bsds.onnx";
/// See [`EDGES`].
pub(crate) const SKY: &str = "sky_small_384.onnx";
/// See [`EDGES`].
pub(crate) const DEEPLAB: &str = "deeplab_cityscapes_513.onnx";
const SINGLE: [(&str, Family, &str); 3] =
    [(EDGES, Family::Edges, "boundaries"), (SKY, Family::Sky, "sky"), (DEEPLAB, Family::Deeplab, "sky")];

/// Separators of the stem and the part.
const JOINTS: [&str; 3] = ["_", ".", "-"];
const PARTS: [&str; 2] = ["encoder", "decoder"];

/// An encoder and its decoder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ModelPair {
    pub stem: String,
    /// `None` under a name that the table does not know.
    pub family: Option<Family>,
    pub encoder: PathBuf,
    pub decoder: PathBuf,
}

/// The pairs in a folder, best first, and messages about incomplete pairs. `stem` requests one by name, known or not; empty: all.
pub(crate) fn pairs(folder: &Path, stem: &str) -> (Vec<ModelPair>, Vec<String>) {
    let named;
    let stems: &[(&str, Option<Family>)] = match stem {
        "" => &PAIRS.map(|(stem, family)| (stem, Some(family))),
        stem => {
            named = [(stem, family_of(stem))];
            &named
        }
    };
    let (mut found, mut wrong) = (Vec::new(), Vec::new());
    for &(stem, family) in stems {
        match PARTS.map(|part| part_of(folder, stem, part)) {
            [Some(encoder), Some(decoder)] => {
                found.push(ModelPair { stem: stem.to_owned(), family, encoder, decoder });
            }
            [Some(encoder), None] => wrong.push(half(stem, &encoder, "an encoder", "decoder")),
            [None, Some(decoder)] => wrong.push(half(stem, &decoder, "a decoder", "encoder")),
            [None, None] => {}
        }
    }
    (found, wrong)
}

fn half(stem: &str, file: &Path, is: &str, lacks: &str) -> String {
    format!("{} is {is} without its {lacks}: put `{stem}_{lacks}.onnx` beside it", file.display())
}

fn family_of(stem: &str) -> Option<Family> {
    PAIRS.iter().find(|(known, _)| *known == stem).map(|(_, family)| *family)
}

fn part_of(folder: &Path, stem: &str, part: &str) -> Option<PathBuf> {
    JOINTS.iter().map(|joint| folder.join(format!("{stem}{joint}{part}.onnx"))).find(|path| path.is_file())
}

/// A network file that was found.
#[derive(Debug)]
pub struct ModelFile {
    /// Its name.
    pub name: String,
    /// Bytes, without those of weights kept beside it.
    pub bytes: u64,
    /// BLAKE3 of the file, and of the files with its weights; or why it cannot be used.
    pub hash: Result<String, ModelFileError>,
    /// Where it comes from, going by its name.
    pub family: Option<Family>,
    /// What it is for, going by its name.
    pub role: Option<&'static str>,
}

/// The network files of a folder, by name. Reads all of each.
pub fn models_in(folder: &Path) -> Result<Vec<ModelFile>, VisionError> {
    let unreadable =
        |e: std::io::Error| VisionError::Model(format!("{}: cannot be read: {e}", folder.display()));
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let Some(name) = path.file_name().map(|n| n.to_string_lossy().into_owned()) else { continue };
        let Some(stem) = name.strip_suffix(".onnx") else { continue };
        let single = SINGLE.iter().find(|(known, ..)| *known == name).map(|s| (Some(s.1), s.2));
        let part = || {
            let part = PARTS.iter().find(|part| stem.ends_with(**part))?;
            let stem = stem.strip_suffix(part)?;
            let stem = JOINTS.iter().find_map(|joint| stem.strip_suffix(joint))?;
            Some((family_of(stem), *part))
        };
        let (family, role) = single.or_else(part).map_or((None, None), |(f, r)| (f, Some(r)));
        let bytes = std::fs::metadata(&path).map_or(0, |m| m.len());
        found.push(ModelFile { hash: inspect(&path).map(|file| file.hash), name, bytes, family, role });
    }
    found.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_found_by_name_and_half_ones_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let touch = |name: &str| std::fs::write(folder.path().join(name), b"x").unwrap();
        assert_eq!(pairs(folder.path(), ""), (vec![], vec![]));
        touch("sam_vit_b_encoder.onnx");
        let (found, wrong) = pairs(folder.path(), "");
        assert!(found.is_empty());
        assert!(
            wrong[0].contains("an encoder without its decoder")
                && wrong[0].contains("sam_vit_b_decoder.onnx")
        );
        touch("sam_vit_b.decoder.onnx");
        touch("mobile_sam-encoder.onnx");
        touch("mobile_sam-decoder.onnx");
        touch("own_encoder.onnx");
        touch("own_decoder.onnx");
        touch("efficientsam_s_decoder.onnx");
        let (found, wrong) = pairs(folder.path(), "");
        let stems: Vec<(&str, Option<Family>)> = found.iter().map(|p| (p.stem.as_str(), p.family)).collect();
        let expected = [("mobile_sam", Some(Family::MobileSam)), ("sam_vit_b", Some(Family::Sam))];
        assert_eq!(stems, expected, "the lighter one first; unknown names only when requested");
        assert!(wrong[0].contains("is a decoder without its encoder"), "{wrong:?}");
        let (named, _) = pairs(folder.path(), "own");
        assert_eq!((named[0].stem.as_str(), named[0].family), ("own", None));
        // The list of `segwild doctor`.
        let listed = models_in(folder.path()).unwrap();
        let seen: Vec<_> = listed.iter().map(|m| (m.name.as_str(), m.family, m.role)).collect();
        assert_eq!(seen[1], ("mobile_sam-decoder.onnx", Some(Family::MobileSam), Some("decoder")));
        assert_eq!(seen[3], ("own_decoder.onnx", None, Some("decoder")));
        assert!(listed.iter().all(|m| m.hash.is_err() && m.bytes == 1));
    }
}
