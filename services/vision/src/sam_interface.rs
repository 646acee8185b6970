//! The interfaces of the SAM family's files, by the names, types and shapes of their inputs and outputs: what
//! `segwild doctor` lists and what a run loads are decided here.
//!
//! | export | encoder answers | decoder takes |
//! |---|---|---|
//! | SAM, MobileSAM | `image_embeddings` | `point_coords`, `point_labels`, `mask_input`, .. |
//! | EfficientSAM | `image_embeddings` | `batched_point_coords`, `batched_point_labels` |
//! | SAM 2 by samexporter | `image_embed`, `high_res_feats_0`, `high_res_feats_1` | as SAM, and these three |
//! | SAM 2, SAM 3's tracker by Transformers | `image_embeddings.0`, `.1`, `.2` | `input_points`, `input_labels`, `input_boxes` |

use crate::model_file::TensorSpec;
use crate::sam_file_error::SamFileError;
use ort::value::TensorElementType;

/// Side of the square when the file leaves it open, in pixels.
pub(crate) const SIDE: usize = 1024;

/// Longest side of a decoder's masks.
pub(crate) const MOST_SIDE: usize = 4096;
/// Most queries, and points per query, that a file may fix.
const MOST_AT_ONCE: usize = 1024;
/// Side of the photo, and of the embedding, of SAM 3.
const SAM3_SIDES: [usize; 2] = [1008, 72];

/// The members of the family that are served.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SamKind {
    /// SAM and MobileSAM.
    Sam,
    /// EfficientSAM.
    Efficient,
    /// SAM 2 and 2.1.
    Sam2,
    /// SAM 3's tracker, which takes clicks and boxes as SAM 2 does.
    Tracker,
}

impl SamKind {
    pub fn name(self) -> &'static str {
        match self {
            SamKind::Sam => "SAM",
            SamKind::Efficient => "EfficientSAM",
            SamKind::Sam2 => "SAM 2",
            SamKind::Tracker => "SAM 3 (tracker)",
        }
    }
}

/// What an encoder may answer beside the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FeatureRole {
    /// Features of a quarter of the photo's side.
    Fine,
    /// Features of an eighth.
    Middle,
    /// Encodings of the cells' positions.
    Positions,
}

impl FeatureRole {
    pub const ALL: [FeatureRole; 3] = [FeatureRole::Fine, FeatureRole::Middle, FeatureRole::Positions];

    /// Its names, in the exports that there are.
    fn names(self) -> &'static [&'static str] {
        match self {
            FeatureRole::Fine => &[
                "high_res_feats_0",
                "high_res_features1",
                "image_features_0",
                "image_embeddings.0",
                "high_res_feat0",
            ],
            FeatureRole::Middle => &[
                "high_res_feats_1",
                "high_res_features2",
                "image_features_1",
                "image_embeddings.1",
                "high_res_feat1",
            ],
            FeatureRole::Positions => &["image_positional_embeddings"],
        }
    }
}

const EMBEDDING: &[&str] = &["image_embeddings", "image_embed", "image_embeddings.2", "vision_feats"];
const COORDS: &[&str] = &["point_coords", BATCHED, TRANSFORMERS];
const LABELS: &[&str] = &["point_labels", "batched_point_labels", "input_labels"];
const BOXES: &[&str] = &["input_boxes"];
const MASK: &[&str] = &["mask_input", "input_masks"];
const HAS_MASK: &[&str] = &["has_mask_input", "has_input_masks"];
const SIZE: &[&str] = &["orig_im_size", "original_image_size", "frame_size"];
const SCORES: &[&str] = &["iou_predictions", "predicted_iou", "iou_scores"];
const SMALL: &[&str] = &["low_res_masks", "low_res_logits", "pred_masks"];
const FULL: &[&str] = &["masks", "output_masks"];
/// EfficientSAM's name of the points.
const BATCHED: &str = "batched_point_coords";
/// The name of the points in exports of Hugging Face's Transformers.
const TRANSFORMERS: &str = "input_points";

fn find<'a>(specs: &'a [TensorSpec], names: &[&str]) -> Option<&'a TensorSpec> {
    names.iter().find_map(|name| specs.iter().find(|s| s.name == *name))
}

fn names_of(specs: &[TensorSpec]) -> String {
    let names: Vec<&str> = specs.iter().map(|s| s.name.as_str()).collect();
    if names.is_empty() { "nothing".into() } else { names.join(", ") }
}

fn words_of(specs: &[TensorSpec]) -> String {
    let found: Vec<String> = specs.iter().map(|s| format!("`{}` {}", s.name, s.words())).collect();
    if found.is_empty() { "nothing".into() } else { found.join(", ") }
}

fn is_float(spec: &TensorSpec) -> bool {
    matches!(spec.kind, Some(TensorElementType::Float32 | TensorElementType::Float16))
}

fn is_whole(spec: &TensorSpec) -> bool {
    matches!(spec.kind, Some(TensorElementType::Int64 | TensorElementType::Int32))
}

/// Names of SAM 3's maps of several sizes.
const PYRAMID: &[&str] = &["backbone_fpn", "fpn_feat", "fpn_hidden_state", "vision_pos_enc"];

/// As [`refuse_concept`], for a file under a name that does not say that it is of the family: other networks take text as well, so
/// that SAM 3's maps must be there.
pub(crate) fn refuse_unnamed(inputs: &[TensorSpec], outputs: &[TensorSpec]) -> Result<(), SamFileError> {
    let is_map = |spec: &TensorSpec| PYRAMID.iter().any(|start| spec.name.starts_with(start));
    match inputs.iter().chain(outputs).any(is_map) {
        true => refuse_concept(inputs, outputs),
        false => Ok(()),
    }
}

/// The error about a file of SAM 3's model of text and exemplars; `Ok` of other files.
pub(crate) fn refuse_concept(inputs: &[TensorSpec], outputs: &[TensorSpec]) -> Result<(), SamFileError> {
    const TEXT: &[&str] = &["language_", "text_", "prompt_features", "prompt_mask", "box_labels", "exemplar"];
    const TOKENS: &[&str] = &["input_ids", "tokens"];
    const EXEMPLARS: &[&str] = &["input_boxes_labels"];
    let parts = [
        (inputs, TEXT, "decoder of text and exemplars"),
        (inputs, TOKENS, "text encoder"),
        (inputs, EXEMPLARS, "encoder of exemplars"),
        (outputs, PYRAMID, "image encoder for text and exemplars"),
    ];
    for (specs, starts, part) in parts {
        let shown: Vec<&str> = specs
            .iter()
            .map(|s| s.name.as_str())
            .filter(|name| starts.iter().any(|start| name.starts_with(start)))
            .collect();
        if !shown.is_empty() {
            return Err(SamFileError::Concept { part, names: shown.join(", ") });
        }
    }
    Ok(())
}

/// How an encoder wants its photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum InputLayout {
    /// `[1, 3, h, w]`, standardised and padded.
    Planes,
    /// `[1, 3, h, w]`, standardised, stretched over the whole square (SAM 2).
    Stretched,
    /// As [`InputLayout::Stretched`], but in [-1, 1] (SAM 3).
    Centred,
    /// `[1, 3, h, w]` in [0, 1]; scaling and standardising are in the file (EfficientSAM).
    Whole,
    /// `[h, w, 3]` in [0, 255]; standardising and padding are in the file.
    Pixels,
}

/// What an image encoder takes and answers.
#[derive(Clone, Debug)]
pub(crate) struct EncoderInterface {
    pub kind: SamKind,
    pub(crate) layout: InputLayout,
    pub(crate) input: TensorSpec,
    /// Height and width that the file asks for.
    pub(crate) size: [Option<usize>; 2],
    pub(crate) output: TensorSpec,
    pub(crate) features: Vec<(FeatureRole, TensorSpec)>,
}

impl EncoderInterface {
    /// Recognises an encoder.
    pub fn of(inputs: &[TensorSpec], outputs: &[TensorSpec]) -> Result<EncoderInterface, SamFileError> {
        refuse_concept(inputs, outputs)?;
        let [input] = inputs else {
            return Err(SamFileError::EncoderInputs { count: inputs.len(), names: names_of(inputs) });
        };
        let photo = || SamFileError::Photo { name: input.name.clone(), found: input.words() };
        let features: Vec<(FeatureRole, TensorSpec)> = FeatureRole::ALL
            .into_iter()
            .filter_map(|role| Some((role, find(outputs, role.names())?.clone())))
            .collect();
        let has = |role: FeatureRole| features.iter().any(|(known, _)| *known == role);
        let detailed = has(FeatureRole::Fine) && has(FeatureRole::Middle);
        let is_embedding = |s: &&TensorSpec| is_float(s) && matches!(s.shape[..], [None | Some(1), _, _, _]);
        let output = find(outputs, EMBEDDING).or(outputs.first()).filter(is_embedding);
        let unanswered = || SamFileError::EncoderOutputs { found: words_of(outputs) };
        let (kind, layout, size) = match input.shape[..] {
            [None | Some(1), None | Some(3), h, w] => {
                let tracker = [h, w].contains(&Some(SAM3_SIDES[0]))
                    || output.is_some_and(|o| o.shape[2] == Some(SAM3_SIDES[1]));
                let (kind, layout) = match input.name.as_str() {
                    "batched_images" => (SamKind::Efficient, InputLayout::Whole),
                    _ if detailed && tracker => (SamKind::Tracker, InputLayout::Centred),
                    _ if detailed => (SamKind::Sam2, InputLayout::Stretched),
                    _ => (SamKind::Sam, InputLayout::Planes),
                };
                (kind, layout, [h, w])
            }
            [h, w, Some(3)] if !detailed => (SamKind::Sam, InputLayout::Pixels, [h, w]),
            _ => return Err(photo()),
        };
        let bytes = input.kind == Some(TensorElementType::Uint8) && layout == InputLayout::Pixels;
        if !bytes && !is_float(input) {
            return Err(photo());
        }
        if let Some(&side) = size.iter().flatten().find(|n| !(16..=4096).contains(*n)) {
            return Err(SamFileError::Side { name: input.name.clone(), found: input.words(), side });
        }
        let output = output.ok_or_else(unanswered)?.clone();
        Ok(EncoderInterface { kind, layout, input: input.clone(), size, output, features })
    }

    /// Whether the embedding has a name by which it is known.
    pub fn is_named(&self) -> bool {
        EMBEDDING.contains(&self.output.name.as_str())
    }

    /// Channels, rows and columns of the embedding, where the file says.
    fn shape(&self) -> [Option<usize>; 3] {
        [self.output.shape[1], self.output.shape[2], self.output.shape[3]]
    }

    /// Side of a photo where the file leaves it open.
    pub(crate) fn open_side(&self) -> usize {
        if self.kind == SamKind::Tracker { SAM3_SIDES[0] } else { SIDE }
    }
}

/// What a prompted decoder takes and answers.
#[derive(Clone, Debug)]
pub(crate) struct DecoderInterface {
    pub kind: SamKind,
    pub(crate) embedding: TensorSpec,
    pub(crate) features: Vec<(FeatureRole, TensorSpec)>,
    /// `[Q, N, 2]`, or `[1, Q, N, 2]`.
    pub(crate) coords: TensorSpec,
    pub(crate) labels: TensorSpec,
    /// `[1, Q, 4]`, where boxes are no points.
    pub(crate) boxes: Option<TensorSpec>,
    /// Logits of an earlier answer, and whether there are any.
    pub(crate) previous: Option<(TensorSpec, TensorSpec)>,
    /// Height and width of the photo.
    pub(crate) size: Option<TensorSpec>,
    pub(crate) masks: String,
    /// Whether the masks have the photo's size, because the file gives no small ones.
    pub(crate) full_size: bool,
    pub(crate) scores: String,
}

impl DecoderInterface {
    /// Recognises a decoder.
    pub fn of(inputs: &[TensorSpec], outputs: &[TensorSpec]) -> Result<DecoderInterface, SamFileError> {
        refuse_concept(inputs, &[])?;
        let features: Vec<(FeatureRole, TensorSpec)> = FeatureRole::ALL
            .into_iter()
            .filter_map(|role| Some((role, find(inputs, role.names())?.clone())))
            .collect();
        let roles = [EMBEDDING, COORDS, LABELS, BOXES, MASK, HAS_MASK, SIZE];
        let known = roles.map(|names| find(inputs, names).cloned());
        let used = features.len() + known.iter().flatten().count();
        let [embedding, coords, labels, boxes, mask, has_mask, size] = known;
        let previous = mask.clone().zip(has_mask.clone());
        let (Some(embedding), Some(coords), Some(labels)) = (embedding, coords, labels) else {
            return Err(strange_inputs(inputs));
        };
        let efficient = coords.name == BATCHED;
        if used != inputs.len() || mask.is_some() != has_mask.is_some() || (efficient && size.is_none()) {
            return Err(strange_inputs(inputs));
        }
        let detailed = features.iter().any(|(role, _)| *role == FeatureRole::Fine);
        let kind = match (efficient, detailed) {
            (true, _) => SamKind::Efficient,
            (false, true) => SamKind::Sam2,
            (false, false) => SamKind::Sam,
        };
        let more = usize::from(coords.name == BATCHED || coords.name == TRANSFORMERS);
        let (masks, full_size, scores) = answers(outputs, more, size.is_some())?;
        let found = DecoderInterface {
            kind,
            embedding,
            features,
            coords,
            labels,
            boxes,
            previous,
            size,
            masks,
            full_size,
            scores,
        };
        found.check()?;
        Ok(found)
    }

    /// Checks types and shapes of the inputs, except those that the encoder decides.
    fn check(&self) -> Result<(), SamFileError> {
        let fixed = |n: Option<usize>, to: usize| n.is_none_or(|n| n == to);
        let must = |spec: &TensorSpec, expected: &str, fits: bool| match fits {
            true => Ok(()),
            false => Err(wrong_input(spec, expected.to_owned())),
        };
        let more = self.more();
        let (coords, labels) = (&self.coords, &self.labels);
        let [one, dims] = match more {
            0 => ["float32 [1, N, 2]", "float32, int32 or int64 [1, N]"],
            _ => ["float32 [1, Q, N, 2]", "float32, int32 or int64 [1, Q, N]"],
        };
        let rank = 3 + more;
        let fits = is_float(coords)
            && coords.shape.len() == rank
            && fixed(coords.shape[0], 1)
            && fixed(coords.shape[rank - 1], 2);
        must(coords, one, fits)?;
        must(labels, dims, (is_float(labels) || is_whole(labels)) && labels.shape.len() == rank - 1)?;
        if let Some(boxes) = &self.boxes {
            let fits = is_float(boxes) && boxes.shape.len() == 3 && fixed(boxes.shape[2], 4);
            must(boxes, "float32 [1, Q, 4]", fits)?;
        }
        if let Some((mask, has)) = &self.previous {
            let fits = is_float(mask)
                && mask.shape.len() == 4
                && mask.shape[2] == mask.shape[3]
                && mask.shape[2].is_none_or(|n| n <= MOST_SIDE);
            must(mask, "float32 [1, 1, s, s]", fits)?;
            must(has, "float32 [1]", is_float(has) && has.shape.len() == 1)?;
        }
        if let Some(size) = &self.size {
            let fits = (size.kind == Some(TensorElementType::Float32) || is_whole(size))
                && size.shape.len() == 1
                && fixed(size.shape[0], 2);
            must(size, "float32, int32 or int64 [2]", fits)?;
        }
        match [self.points(), self.queries()].into_iter().flatten().find(|&n| n > MOST_AT_ONCE) {
            Some(count) => Err(SamFileError::TooMany { count, most: MOST_AT_ONCE }),
            None => Ok(()),
        }
    }

    /// Whether the decoder belongs to an encoder, whose file is named in the error.
    pub fn fit(&self, encoder: &EncoderInterface, file: &str) -> Result<(), SamFileError> {
        let same =
            self.kind == encoder.kind || (self.kind == SamKind::Sam2 && encoder.kind == SamKind::Tracker);
        let of = |role: FeatureRole| encoder.features.iter().find(|(known, _)| *known == role);
        if !same || self.features.iter().any(|(role, _)| of(*role).is_none()) {
            return Err(SamFileError::Pair {
                decoder: self.kind.name(),
                file: file.to_owned(),
                encoder: encoder.kind.name(),
            });
        }
        agree(&self.embedding, encoder.shape(), file)?;
        for (role, spec) in &self.features {
            let answered = of(*role).map(|(_, answered)| &answered.shape[..]);
            if let Some(&[_, c, h, w]) = answered {
                agree(spec, [c, h, w], file)?;
            }
        }
        Ok(())
    }

    /// Dimensions before the queries': 1 in EfficientSAM's and in those of Transformers.
    pub(crate) fn more(&self) -> usize {
        usize::from(self.coords.name == BATCHED || self.coords.name == TRANSFORMERS)
    }

    /// Queries that the file fixes.
    pub(crate) fn queries(&self) -> Option<usize> {
        self.coords.shape[self.more()]
    }

    /// Points per query that the file fixes.
    pub(crate) fn points(&self) -> Option<usize> {
        self.coords.shape[self.more() + 1]
    }

    /// Whether it takes boxes: SAM by Transformers knows clicks alone.
    pub(crate) fn takes_boxes(&self) -> bool {
        self.boxes.is_some() || self.kind != SamKind::Sam || self.more() == 0
    }

    /// Whether the caller adds a padding point to prompts without a box. SAM was trained with it, and its exports leave it to the
    /// caller; those of the others add it themselves.
    pub(crate) fn wants_padding(&self) -> bool {
        self.kind == SamKind::Sam && self.more() == 0
    }
}

fn wrong_input(spec: &TensorSpec, expected: String) -> SamFileError {
    SamFileError::Input { name: spec.name.clone(), found: spec.words(), expected }
}

/// Checks that an input takes what the encoder answers.
fn agree(spec: &TensorSpec, answered: [Option<usize>; 3], file: &str) -> Result<(), SamFileError> {
    let fits = is_float(spec)
        && spec.shape.len() == 4
        && spec.shape[0].is_none_or(|n| n == 1)
        && (0..3).all(|i| spec.shape[i + 1].zip(answered[i]).is_none_or(|(a, b)| a == b));
    match fits {
        true => Ok(()),
        false => {
            let sizes: Vec<String> =
                answered.iter().map(|n| n.map_or("?".into(), |n| n.to_string())).collect();
            Err(wrong_input(spec, format!("float32 [1, {}], which {file} answers,", sizes.join(", "))))
        }
    }
}

/// The error about inputs that are those of no decoder, with the names of the most similar one.
fn strange_inputs(inputs: &[TensorSpec]) -> SamFileError {
    let has = |name: &str| inputs.iter().any(|i| i.name == name);
    let detailed = find(inputs, FeatureRole::Fine.names()).is_some();
    let expected = if has(BATCHED) {
        "image_embeddings, batched_point_coords, batched_point_labels, orig_im_size"
    } else if has(TRANSFORMERS) {
        "input_points, input_labels, input_boxes, image_embeddings.0, image_embeddings.1, image_embeddings.2"
    } else if detailed {
        "image_embed, high_res_feats_0, high_res_feats_1, point_coords, point_labels, mask_input, has_mask_input"
    } else {
        "image_embeddings, point_coords, point_labels, mask_input, has_mask_input, orig_im_size"
    };
    SamFileError::DecoderInputs { found: names_of(inputs), expected: expected.to_owned() }
}

/// The outputs with the masks, whether they have the photo's size, and with the scores. The small masks serve if there
/// are any, for they can be given back and take less memory; exports of EfficientSAM leave them without a name.
/// `more` dimensions come before the usual ones. A file that does not take the photo's size has small masks alone.
fn answers(outputs: &[TensorSpec], more: usize, sized: bool) -> Result<(String, bool, String), SamFileError> {
    const VIDEO: &[&str] = &["obj_ptr", "mask_for_mem", "maskmem_features"];
    let rank = |spec: &TensorSpec, rank: usize| spec.shape.is_empty() || spec.shape.len() == rank + more;
    let scores = find(outputs, SCORES);
    if scores.is_none() && find(outputs, VIDEO).is_some() {
        return Err(SamFileError::Video { found: names_of(outputs) });
    }
    let other = |s: &&TensorSpec| {
        !FULL.contains(&s.name.as_str()) && !SCORES.contains(&s.name.as_str()) && rank(s, 4)
    };
    let small = find(outputs, SMALL).or_else(|| outputs.iter().find(other));
    let masks = small.map(|s| (s, false)).or(find(outputs, FULL).map(|s| (s, sized)));
    match (masks.filter(|(s, _)| rank(s, 4)), scores.filter(|s| rank(s, 2))) {
        (Some((masks, full)), Some(scores)) => Ok((masks.name.clone(), full, scores.name.clone())),
        _ => Err(SamFileError::DecoderOutputs {
            found: words_of(outputs),
            dims: if more == 1 { "1, Q" } else { "1" },
        }),
    }
}
