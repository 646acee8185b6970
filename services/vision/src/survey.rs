//! What a folder of network files holds, and what becomes of each: `segwild doctor` lists it, and a run takes its pair from it.

use crate::VisionError;
use crate::clip_file_error::ClipFileError;
use crate::clip_files::{ClipFiles, TOKENIZER, scaling_of, tokenizer_of};
use crate::clip_interface::ClipInterface;
use crate::family::{Family, SINGLE, family_of, is_known, search_rank};
use crate::model_file::{GraphSignature, TensorSpec, signature};
use crate::model_name::{NamedPrecision, PartName, SamPart, clip_name, is_bare, part_name, usual_name};
use crate::sam_file_error::SamFileError;
use crate::sam_interface::{DecoderInterface, EncoderInterface, refuse_concept, refuse_unnamed};
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// An encoder and its decoder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ModelPair {
    pub stem: String,
    /// `None` under a name that the table does not know.
    pub family: Option<Family>,
    pub encoder: PathBuf,
    pub decoder: PathBuf,
}

/// What a run makes of a network file. The words follow the file's name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FileUse {
    /// It is one of the pair that a run takes.
    Taken,
    /// It is one of another pair.
    Choosable {
        /// The stem of the pair's names.
        stem: String,
    },
    /// Another file of the same part is better.
    Superseded {
        /// That file.
        by: String,
    },
    /// The other part is missing.
    Alone {
        /// What the file is.
        is: &'static str,
        /// What is missing.
        lacks: &'static str,
        /// The usual name of what is missing.
        put: String,
    },
    /// The other part is refused.
    Unpaired {
        /// That file.
        by: String,
    },
    /// It cannot be used.
    Refused(SamFileError),
    /// It is a network of one file, which settings ask for.
    Single,
    /// Queries by text use it.
    Texts,
    /// It is a file of CLIP that cannot be used.
    RefusedClip(ClipFileError),
    /// Its name is none that is known.
    Unnamed {
        /// Which member of the SAM family it is by its inputs and outputs, and which part.
        is: Option<String>,
    },
}

impl fmt::Display for FileUse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FileUse::Taken => f.write_str("is used"),
            FileUse::Choosable { stem } => write!(f, "is used only where `sam` is `{stem}`"),
            FileUse::Superseded { by } => write!(f, "is not used, because {by} is there"),
            FileUse::Alone { is, lacks, put } => {
                write!(f, "is {is} without its {lacks}: put `{put}` beside it")
            }
            FileUse::Unpaired { by } => write!(f, "is not used, because {by} cannot be"),
            FileUse::Refused(reason) => write!(f, "{reason}"),
            FileUse::Single => f.write_str("is used where a setting asks for it"),
            FileUse::Texts => f.write_str("is used where a text selects"),
            FileUse::RefusedClip(reason) => write!(f, "{reason}"),
            FileUse::Unnamed { is: None } => f.write_str("has a name that is not known, so it is not used"),
            FileUse::Unnamed { is: Some(is) } => write!(
                f,
                "has a name that is not known, so it is not used: it is {is}; name the two files of a pair \
                 `STEM_encoder.onnx` and `STEM_decoder.onnx`"
            ),
        }
    }
}

/// A recognised part.
#[derive(Debug)]
enum SamInterface {
    Encoder(EncoderInterface),
    Decoder(Box<DecoderInterface>),
}

impl SamInterface {
    fn name(&self) -> &'static str {
        match self {
            SamInterface::Encoder(found) => found.kind.name(),
            SamInterface::Decoder(found) => found.kind.name(),
        }
    }

    fn part(&self) -> SamPart {
        match self {
            SamInterface::Encoder(_) => SamPart::Encoder,
            SamInterface::Decoder(_) => SamPart::Decoder,
        }
    }
}

/// A file of CLIP.
#[derive(Debug)]
struct ClipFile {
    stem: String,
    precision: NamedPrecision,
    found: Result<ClipInterface, ClipFileError>,
}

impl ClipFile {
    /// Recognises a file by its inputs and outputs.
    fn of(path: &Path, name: &str) -> Option<ClipFile> {
        let GraphSignature { inputs, outputs } = signature(path)?;
        let found = ClipInterface::of(&inputs, &outputs)?;
        let (stem, precision) = clip_name(name);
        Some(ClipFile { stem, precision, found })
    }

    /// Numbers per image and per text, where the file says.
    fn dims(&self) -> [Option<usize>; 2] {
        let last = |spec: &TensorSpec| spec.shape.last().copied().flatten();
        let found = self.found.as_ref().ok();
        let images = found.and_then(|found| found.images.as_ref());
        let texts = found.and_then(|found| found.texts.as_ref());
        [images.and_then(|images| last(&images.output)), texts.and_then(|texts| last(&texts.output))]
    }
}

/// A network file of a folder.
#[derive(Debug)]
pub(crate) struct SurveyedFile {
    pub path: PathBuf,
    pub name: String,
    part: Option<PartName>,
    /// What it is of CLIP, by its inputs and outputs: its name does not count.
    clip: Option<ClipFile>,
    /// `None` where nothing of the family is recognised, and where the file cannot be read.
    found: Option<Result<SamInterface, SamFileError>>,
    pub usage: FileUse,
}

/// The network files of a folder.
#[derive(Debug, Default)]
pub(crate) struct ModelSurvey {
    /// Pairs that can be used as far as their inputs and outputs show, best first.
    pub pairs: Vec<ModelPair>,
    /// Pairs that are refused, in the same order.
    pub refused: Vec<ModelPair>,
    /// The model of queries by text, if there is one.
    pub texts: Option<ClipFiles>,
    /// All files, by name.
    pub files: Vec<SurveyedFile>,
}

impl SurveyedFile {
    fn single(&self) -> Option<(Family, &'static str)> {
        SINGLE.iter().find(|(known, ..)| *known == self.name).map(|(_, family, role)| (*family, *role))
    }

    /// Whether it is of CLIP.
    pub fn is_clip(&self) -> bool {
        self.clip.is_some()
    }

    /// Where it comes from, going by its name; CLIP by its inputs and outputs.
    pub fn family(&self) -> Option<Family> {
        let stem = || self.part.as_ref().and_then(|part| family_of(&part.stem));
        let clip = || self.clip.as_ref().map(|_| Family::Clip);
        self.single().map(|(family, _)| family).or_else(stem).or_else(clip)
    }

    /// What it is for, going by its name; a file of CLIP by its inputs and outputs.
    pub fn role(&self) -> Option<&'static str> {
        let part = || self.part.as_ref().map(|part| part.part.name());
        let clip = || Some(self.clip.as_ref()?.found.as_ref().map_or("encoder", ClipInterface::role));
        self.single().map(|(_, role)| role).or_else(part).or_else(clip)
    }

    /// Which member of the family it is, going by its inputs and outputs.
    pub fn interface(&self) -> Option<&'static str> {
        let clip = self.clip.as_ref().filter(|clip| clip.found.is_ok()).map(|_| Family::Clip.name());
        clip.or_else(|| self.found.as_ref()?.as_ref().ok().map(SamInterface::name))
    }

    fn refusal(&self) -> Option<&SamFileError> {
        self.found.as_ref()?.as_ref().err()
    }
}

/// Surveys a folder. `stem` requests a pair by name, known or not; empty: the first of a known name is taken.
pub(crate) fn survey(folder: &Path, stem: &str) -> Result<ModelSurvey, VisionError> {
    let unreadable =
        |e: std::io::Error| VisionError::Model(format!("{}: cannot be read: {e}", folder.display()));
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let Some(name) = path.file_name().map(|n| n.to_string_lossy().into_owned()) else { continue };
        if !name.ends_with(".onnx") {
            continue;
        }
        let mut file =
            SurveyedFile { path, name, part: None, clip: None, found: None, usage: FileUse::Single };
        if file.single().is_none() {
            file.clip = ClipFile::of(&file.path, &file.name);
            file.part = part_name(&file.name).filter(|_| file.path.is_file() && file.clip.is_none());
            file.usage = FileUse::Unnamed { is: None };
        }
        files.push(file);
    }
    files.sort_by(|a, b| a.name.cmp(&b.name));
    let mut stems: BTreeMap<String, Vec<usize>> = BTreeMap::new();
    for (i, file) in files.iter().enumerate() {
        if let Some(part) = &file.part {
            stems.entry(part.stem.clone()).or_default().push(i);
        }
    }
    let wanted = |known: &str| match stem {
        "" => is_known(known) || is_bare(known),
        stem => known == stem,
    };
    let mut survey = ModelSurvey { files, ..ModelSurvey::default() };
    let mut order: Vec<(String, Vec<usize>)> = stems.into_iter().collect();
    order.sort_by_key(|(stem, _)| search_rank(stem));
    for (stem, members) in &order {
        survey.pair(stem, members, wanted(stem));
    }
    survey.pair_clip(folder);
    survey.recognise_the_rest();
    Ok(survey)
}

impl ModelSurvey {
    /// Decides about the files of one stem. A stem that is not wanted, and whose parts are not both there, is left alone.
    fn pair(&mut self, stem: &str, members: &[usize], wanted: bool) {
        let best = |part: SamPart| {
            let key = |&&i: &&usize| self.files[i].part.as_ref().map(|p| (p.precision, p.style));
            let is = |i: &&usize| self.files[**i].part.as_ref().is_some_and(|p| p.part == part);
            members.iter().filter(is).min_by_key(key).copied()
        };
        let (encoder, decoder) = (best(SamPart::Encoder), best(SamPart::Decoder));
        if !wanted && (encoder.is_none() || decoder.is_none()) && !is_known(stem) && !is_bare(stem) {
            return;
        }
        for &i in members {
            let Some(part) = self.files[i].part.as_ref().map(|p| p.part) else { continue };
            self.files[i].found = signature(&self.files[i].path).map(|s| recognise(&s, part));
            let taken = if part == SamPart::Encoder { encoder } else { decoder };
            self.files[i].usage = match (self.files[i].refusal(), taken) {
                (Some(reason), _) => FileUse::Refused(reason.clone()),
                (None, Some(k)) if k != i => FileUse::Superseded { by: self.files[k].name.clone() },
                (None, _) => alone(stem, part),
            };
        }
        let (Some(encoder), Some(decoder)) = (encoder, decoder) else { return };
        if let (Some(Ok(SamInterface::Encoder(e))), Some(Ok(SamInterface::Decoder(d)))) =
            (&self.files[encoder].found, &self.files[decoder].found)
            && let Err(reason) = d.fit(e, &self.files[encoder].path.display().to_string())
        {
            self.files[decoder].usage = FileUse::Refused(reason);
        }
        let pair = ModelPair {
            stem: stem.to_owned(),
            family: family_of(stem),
            encoder: self.files[encoder].path.clone(),
            decoder: self.files[decoder].path.clone(),
        };
        let is_refused = |i: usize| matches!(self.files[i].usage, FileUse::Refused(_));
        match (is_refused(encoder), is_refused(decoder)) {
            (false, false) => {
                let first = wanted && self.pairs.is_empty();
                let usage = if first { FileUse::Taken } else { FileUse::Choosable { stem: stem.to_owned() } };
                [encoder, decoder].iter().for_each(|&i| self.files[i].usage = usage.clone());
                if wanted {
                    self.pairs.push(pair);
                }
            }
            (one, two) => {
                if !one {
                    self.files[encoder].usage = FileUse::Unpaired { by: self.files[decoder].name.clone() };
                }
                if !two {
                    self.files[decoder].usage = FileUse::Unpaired { by: self.files[encoder].name.clone() };
                }
                if wanted {
                    self.refused.push(pair);
                }
            }
        }
    }

    /// Decides about the files of CLIP: the first stem with both encoders and a tokenizer is taken.
    fn pair_clip(&mut self, folder: &Path) {
        let mut stems: BTreeMap<String, Vec<usize>> = BTreeMap::new();
        for (i, file) in self.files.iter_mut().enumerate() {
            let Some(clip) = &file.clip else { continue };
            match &clip.found {
                Ok(_) => stems.entry(clip.stem.clone()).or_default().push(i),
                Err(reason) => file.usage = FileUse::RefusedClip(reason.clone()),
            }
        }
        for (stem, members) in &stems {
            self.pair_clip_of(folder, stem, members);
        }
    }

    /// Decides about the files of CLIP with one stem, all of which can be used as far as their inputs and outputs show.
    fn pair_clip_of(&mut self, folder: &Path, stem: &str, members: &[usize]) {
        let best = |role: &str| {
            let is = |i: &&usize| self.files[**i].role() == Some(role);
            let precision = |i: &&usize| self.files[**i].clip.as_ref().map(|clip| clip.precision);
            members.iter().filter(is).min_by_key(precision).copied()
        };
        let (images, texts) = (best("image encoder"), best("text encoder"));
        let both = best("image and text encoder");
        // Two files take less memory than one that computes the other half in vain.
        let pair = images.zip(texts).or(both.map(|both| (both, both)));
        let tokenizer = tokenizer_of(folder, stem);
        let name = |part: &str| match stem {
            "" => part.to_owned(),
            stem => format!("{stem}_{part}"),
        };
        let Some((images, texts)) = pair else {
            let (is, lacks, put) = match images {
                Some(_) => ("an image encoder of CLIP", "text encoder", name("text_model.onnx")),
                None => ("a text encoder of CLIP", "image encoder", name("vision_model.onnx")),
            };
            let usage = FileUse::Alone { is, lacks, put };
            members.iter().for_each(|&i| self.files[i].usage = usage.clone());
            return;
        };
        let dims = |i: usize| self.files[i].clip.as_ref().map_or([None; 2], ClipFile::dims);
        let usage = match (&self.texts, dims(images)[0].zip(dims(texts)[1]), &tokenizer) {
            (_, Some((of_images, of_texts)), _) if of_images != of_texts => {
                let file = self.files[images].name.clone();
                FileUse::RefusedClip(ClipFileError::Pair { texts: of_texts, file, images: of_images })
            }
            (_, _, None) => {
                FileUse::Alone { is: "a part of CLIP", lacks: "tokenizer", put: TOKENIZER.to_owned() }
            }
            (Some(taken), ..) => {
                let by = taken.images.file_name().unwrap_or_default().to_string_lossy().into_owned();
                FileUse::Superseded { by }
            }
            (None, _, Some(_)) => FileUse::Texts,
        };
        for &i in members {
            let better = if self.files[i].role() == Some("text encoder") { texts } else { images };
            self.files[i].usage = match i == images || i == texts {
                true => usage.clone(),
                false => FileUse::Superseded { by: self.files[better].name.clone() },
            };
        }
        // The image encoder is sound by itself where the two do not fit.
        if images != texts && matches!(usage, FileUse::RefusedClip(_)) {
            self.files[images].usage = FileUse::Unpaired { by: self.files[texts].name.clone() };
        }
        if let (FileUse::Texts, Some(tokenizer)) = (usage, tokenizer) {
            self.texts = Some(ClipFiles {
                stem: stem.to_owned(),
                images: self.files[images].path.clone(),
                texts: self.files[texts].path.clone(),
                tokenizer,
                scaling: scaling_of(folder, stem),
            });
        }
    }

    /// Recognises files of unknown names, so that none goes unmentioned.
    fn recognise_the_rest(&mut self) {
        let unnamed =
            |file: &&mut SurveyedFile| matches!(file.usage, FileUse::Unnamed { .. }) && !file.is_clip();
        for file in self.files.iter_mut().filter(unnamed) {
            let Some(GraphSignature { inputs, outputs }) = signature(&file.path) else { continue };
            if let Err(reason) = refuse_unnamed(&inputs, &outputs) {
                file.usage = FileUse::Refused(reason.clone());
                file.found = Some(Err(reason));
                continue;
            }
            let decoder =
                DecoderInterface::of(&inputs, &outputs).ok().map(|d| SamInterface::Decoder(Box::new(d)));
            // Other networks take a photo and answer four dimensions as well: the name of the answer decides.
            let encoder = || EncoderInterface::of(&inputs, &outputs).ok().filter(|e| e.is_named());
            let Some(found) = decoder.or_else(|| encoder().map(SamInterface::Encoder)) else { continue };
            file.usage =
                FileUse::Unnamed { is: Some(format!("the {} of {}", found.part().name(), found.name())) };
            file.found = Some(Ok(found));
        }
    }
}

fn recognise(found: &GraphSignature, part: SamPart) -> Result<SamInterface, SamFileError> {
    let GraphSignature { inputs, outputs } = found;
    refuse_concept(inputs, outputs)?;
    match part {
        SamPart::Encoder => EncoderInterface::of(inputs, outputs).map(SamInterface::Encoder),
        SamPart::Decoder => {
            DecoderInterface::of(inputs, outputs).map(|found| SamInterface::Decoder(Box::new(found)))
        }
    }
}

fn alone(stem: &str, part: SamPart) -> FileUse {
    let is = match part {
        SamPart::Encoder => "an encoder",
        SamPart::Decoder => "a decoder",
    };
    FileUse::Alone { is, lacks: part.other().name(), put: usual_name(stem, part.other()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models_in;

    #[test]
    fn pairs_are_found_by_name_and_half_ones_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let touch = |name: &str| std::fs::write(folder.path().join(name), b"x").unwrap();
        let of = |stem: &str| survey(folder.path(), stem).unwrap();
        let words = |survey: &ModelSurvey, name: &str| {
            survey.files.iter().find(|file| file.name == name).unwrap().usage.to_string()
        };
        assert!(of("").pairs.is_empty() && of("").files.is_empty());
        touch("sam_vit_b_encoder.onnx");
        assert!(of("").pairs.is_empty());
        let half = words(&of(""), "sam_vit_b_encoder.onnx");
        assert!(half.contains("an encoder without its decoder") && half.contains("sam_vit_b_decoder.onnx"));
        touch("sam_vit_b.decoder.onnx");
        touch("mobile_sam-encoder.onnx");
        touch("mobile_sam-decoder.onnx");
        touch("own_encoder.onnx");
        touch("own_decoder.onnx");
        touch("efficientsam_s_decoder.onnx");
        touch("lonely_decoder.onnx");
        let found = of("");
        let stems: Vec<(&str, Option<Family>)> =
            found.pairs.iter().map(|p| (p.stem.as_str(), p.family)).collect();
        let expected = [("mobile_sam", Some(Family::MobileSam)), ("sam_vit_b", Some(Family::Sam))];
        assert_eq!(stems, expected, "the lighter one first; unknown names only when requested");
        assert!(words(&found, "efficientsam_s_decoder.onnx").contains("is a decoder without its encoder"));
        assert!(words(&found, "own_decoder.onnx").contains("only where `sam` is `own`"));
        assert!(words(&found, "lonely_decoder.onnx").contains("a name that is not known"));
        let named = of("own");
        assert_eq!((named.pairs[0].stem.as_str(), named.pairs[0].family), ("own", None));
        assert_eq!(words(&named, "own_encoder.onnx"), "is used");
        assert_eq!(words(&named, "mobile_sam-encoder.onnx"), "is used only where `sam` is `mobile_sam`");
        assert!(words(&of("lonely"), "lonely_decoder.onnx").contains("a decoder without its encoder"));
        // The list of `segwild doctor`.
        let listed = models_in(folder.path()).unwrap();
        let seen: Vec<_> = listed.iter().map(|m| (m.name.as_str(), m.family, m.role)).collect();
        assert_eq!(seen[2], ("mobile_sam-decoder.onnx", Some(Family::MobileSam), Some("decoder")));
        assert_eq!(seen[4], ("own_decoder.onnx", None, Some("decoder")));
        assert!(listed.iter().all(|m| m.hash.is_err() && m.bytes == 1));
    }

    #[test]
    fn a_part_of_full_precision_is_taken_before_a_quantised_one() {
        let folder = tempfile::tempdir().unwrap();
        let touch = |name: &str| std::fs::write(folder.path().join(name), b"x").unwrap();
        for name in [
            "sam2.1_hiera_tiny.encoder.int8.onnx",
            "sam2.1_hiera_tiny.encoder.fp16.onnx",
            "sam2.1_hiera_tiny.decoder.onnx",
            "sam2.1_hiera_tiny.decoder_quantized.onnx",
        ] {
            touch(name);
        }
        let taken = || {
            let pair = survey(folder.path(), "").unwrap().pairs[0].clone();
            let name = |path: &Path| path.file_name().unwrap().to_string_lossy().into_owned();
            (name(&pair.encoder), name(&pair.decoder))
        };
        let decoder = "sam2.1_hiera_tiny.decoder.onnx".to_owned();
        assert_eq!(taken(), ("sam2.1_hiera_tiny.encoder.fp16.onnx".to_owned(), decoder.clone()));
        touch("sam2.1_hiera_tiny_encoder.onnx");
        assert_eq!(taken(), ("sam2.1_hiera_tiny_encoder.onnx".to_owned(), decoder));
        let found = survey(folder.path(), "").unwrap();
        let other = found.files.iter().find(|f| f.name.contains("int8")).unwrap();
        assert_eq!(other.usage.to_string(), "is not used, because sam2.1_hiera_tiny_encoder.onnx is there");
    }
}
