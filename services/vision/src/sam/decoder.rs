//! The prompted decoder: points, boxes and earlier logits on an embedding to masks with scores.

use super::encoder::Encoded;
use super::logits::Logits;
use crate::VisionError;
use crate::onnx::{NetworkModel, NetworkOutput, TensorSpec};
use ort::session::SessionInputValue;
use ort::value::{Tensor, TensorElementType, TensorRef};
use std::sync::atomic::{AtomicBool, Ordering};

/// The decoder's label of a point outside the object.
pub(super) const OUTSIDE: f32 = 0.0;
/// The decoder's label of a point inside the object.
pub(super) const INSIDE: f32 = 1.0;
/// The decoder's labels of the first and second corner of a box.
pub(super) const CORNERS: [f32; 2] = [2.0, 3.0];
/// The decoder's label of a padding point.
const PADDING: f32 = -1.0;

/// Longest side of a decoder's masks.
const MOST_SIDE: usize = 4096;
/// Most queries, and points per query, that a file may fix.
const MOST_AT_ONCE: usize = 1024;
/// Most masks per prompt.
const MOST_MASKS: usize = 16;

/// One query: points with labels, in the photo's pixels.
#[derive(Clone, Debug, Default)]
pub(super) struct Query<'a> {
    pub points: Vec<([f32; 2], f32)>,
    /// Logits of an earlier answer, to be refined.
    pub previous: Option<&'a Logits>,
}

/// The interface of the file: names and shapes of its inputs.
enum Interface {
    /// SAM, MobileSAM: one query at a time, or several where the file leaves the number open.
    Sam { many: bool, mask_side: usize },
    /// EfficientSAM: `[1, Q, N, 2]`.
    Efficient { queries: Option<usize> },
}

/// A loaded decoder.
pub(super) struct PromptDecoder {
    model: NetworkModel,
    interface: Interface,
    /// Points per query, where the file fixes it.
    points: Option<usize>,
    /// Kind of `orig_im_size`.
    whole_numbers: bool,
    labels_whole: bool,
    masks: String,
    /// Whether the masks have the photo's size, because the file gives no small ones.
    pub full_size: bool,
    scores: String,
    /// Queries per run.
    batch: usize,
    /// The file leaves the number of queries open and yet takes only one.
    one_by_one: AtomicBool,
}

const SAM: [&str; 6] =
    ["image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"];
const EFFICIENT: [&str; 4] =
    ["image_embeddings", "batched_point_coords", "batched_point_labels", "orig_im_size"];

impl PromptDecoder {
    /// Reads the file's inputs and outputs, and checks that they fit the encoder's embedding.
    pub fn new(
        model: NetworkModel,
        encoder: (&str, [Option<usize>; 3], bool),
        batch: usize,
    ) -> Result<PromptDecoder, VisionError> {
        let (encoder, embedding, efficient) = encoder;
        let has = |name: &str| model.inputs.iter().any(|i| i.name == name);
        let ours_is_efficient = has(EFFICIENT[1]);
        let expected: &[&str] = if ours_is_efficient { &EFFICIENT } else { &SAM };
        let names: Vec<&str> = model.inputs.iter().map(|i| i.name.as_str()).collect();
        let missing: Vec<&str> = expected.iter().copied().filter(|&e| !has(e)).collect();
        let surplus: Vec<&str> = names.iter().copied().filter(|n| !expected.contains(n)).collect();
        if !missing.is_empty() || !surplus.is_empty() {
            return Err(model.wrong(format!(
                "takes {}; a prompted decoder takes {}",
                if names.is_empty() { "nothing".into() } else { names.join(", ") },
                expected.join(", ")
            )));
        }
        if ours_is_efficient != efficient {
            let family = |efficient| if efficient { "EfficientSAM" } else { "SAM" };
            return Err(model.wrong(format!(
                "is a decoder of {}'s kind, and {encoder} an encoder of {}'s: they do not fit each other",
                family(ours_is_efficient),
                family(efficient)
            )));
        }
        let check = |name: &str,
                     words: &str,
                     fits: &dyn Fn(&TensorSpec) -> bool|
         -> Result<TensorSpec, VisionError> {
            match model.inputs.iter().find(|i| i.name == name) {
                Some(slot) if fits(slot) => Ok(slot.clone()),
                Some(slot) => {
                    Err(model.wrong(format!("its input `{name}` is {}; {words} was expected", slot.words())))
                }
                None => Err(model.wrong(format!("takes no `{name}`"))),
            }
        };
        let float = |s: &TensorSpec| s.kind == Some(TensorElementType::Float32);
        let whole = |s: &TensorSpec| s.kind == Some(TensorElementType::Int64);
        let fixed = |n: Option<usize>, to: usize| n.is_none_or(|n| n == to);
        let agrees = |s: &TensorSpec| {
            s.shape.len() == 4
                && fixed(s.shape[0], 1)
                && (0..3).all(|i| s.shape[i + 1].zip(embedding[i]).is_none_or(|(a, b)| a == b))
        };
        let sizes: Vec<String> = embedding.iter().map(|n| n.map_or("?".into(), |n| n.to_string())).collect();
        let answers = format!("float32 [1, {}], which {encoder} answers,", sizes.join(", "));
        check(expected[0], &answers, &|s| float(s) && agrees(s))?;
        let size = check("orig_im_size", "float32 or int64 [2]", &|s| {
            (float(s) || whole(s)) && s.shape.len() == 1 && fixed(s.shape[0], 2)
        })?;
        let (interface, points, labels) = if ours_is_efficient {
            let coords = check(EFFICIENT[1], "float32 [1, Q, N, 2]", &|s| {
                float(s) && s.shape.len() == 4 && fixed(s.shape[0], 1) && fixed(s.shape[3], 2)
            })?;
            let labels = check(EFFICIENT[2], "float32 or int64 [1, Q, N]", &|s| {
                (float(s) || whole(s)) && s.shape.len() == 3
            })?;
            (Interface::Efficient { queries: coords.shape[1] }, coords.shape[2], labels)
        } else {
            let coords = check(SAM[1], "float32 [1, N, 2]", &|s| {
                float(s) && s.shape.len() == 3 && fixed(s.shape[0], 1) && fixed(s.shape[2], 2)
            })?;
            let labels =
                check(SAM[2], "float32 or int64 [1, N]", &|s| (float(s) || whole(s)) && s.shape.len() == 2)?;
            let mask = check(SAM[3], "float32 [1, 1, s, s]", &|s| {
                float(s)
                    && s.shape.len() == 4
                    && s.shape[2] == s.shape[3]
                    && s.shape[2].is_none_or(|n| n <= MOST_SIDE)
            })?;
            check(SAM[4], "float32 [1]", &|s| float(s) && s.shape.len() == 1)?;
            // Four times the embedding's, as in all of the family.
            let mask_side = mask.shape[2].or(embedding[1].map(|n| 4 * n)).unwrap_or(256);
            (Interface::Sam { many: coords.shape[0].is_none(), mask_side }, coords.shape[1], labels)
        };
        let queries = if let Interface::Efficient { queries } = interface { queries } else { None };
        if let Some(n) = [points, queries].into_iter().flatten().find(|&n| n > MOST_AT_ONCE) {
            return Err(
                model.wrong(format!("takes {n} prompts at a time; more than {MOST_AT_ONCE} are not given"))
            );
        }
        let (masks, full_size, scores) = outputs(&model, usize::from(ours_is_efficient))?;
        Ok(PromptDecoder {
            interface,
            points,
            whole_numbers: whole(&size),
            labels_whole: whole(&labels),
            masks,
            full_size,
            scores,
            batch: batch.max(1),
            one_by_one: AtomicBool::new(false),
            model,
        })
    }

    /// Hash of the file, short.
    pub fn key(&self) -> &str {
        self.model.key()
    }

    /// Whether it can be given an earlier answer; the side of its logits.
    pub fn takes_logits(&self) -> Option<usize> {
        match self.interface {
            Interface::Sam { mask_side, .. } if !self.full_size => Some(mask_side),
            Interface::Sam { .. } | Interface::Efficient { .. } => None,
        }
    }

    /// The masks of each query, in the file's order, with the IoU that the network predicts.
    pub fn ask(&self, encoded: &Encoded, queries: &[Query]) -> Result<Vec<Vec<(Logits, f32)>>, VisionError> {
        let at_once = match self.interface {
            Interface::Efficient { queries } => queries.unwrap_or(self.batch),
            Interface::Sam { many: true, .. } if queries.iter().all(|q| q.previous.is_none()) => self.batch,
            Interface::Sam { .. } => 1,
        };
        let at_once = if self.one_by_one.load(Ordering::Relaxed) { 1 } else { at_once };
        let mut answers = Vec::with_capacity(queries.len());
        for some in queries.chunks(at_once) {
            match self.ask_at_once(encoded, some) {
                Ok(given) => answers.extend(given),
                Err(error) if some.len() > 1 && matches!(self.interface, Interface::Sam { .. }) => {
                    for one in some.chunks(1) {
                        answers.extend(self.ask_at_once(encoded, one)?);
                    }
                    tracing::warn!("{error}; it takes one prompt at a time");
                    self.one_by_one.store(true, Ordering::Relaxed);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(answers)
    }

    fn ask_at_once(
        &self,
        encoded: &Encoded,
        queries: &[Query],
    ) -> Result<Vec<Vec<(Logits, f32)>>, VisionError> {
        let on = format!(
            "{} prompts on a photo of {} x {}",
            queries.len(),
            encoded.fit.photo[0],
            encoded.fit.photo[1]
        );
        let needs = queries.iter().map(|q| q.points.len()).max().unwrap_or(0);
        // Without a box SAM was trained with a padding point at the end; the published exports leave it to the caller.
        // EfficientSAM adds its own.
        let own = match self.interface {
            Interface::Sam { .. } => {
                usize::from(queries.iter().any(|q| q.points.iter().all(|p| !CORNERS.contains(&p.1))))
            }
            Interface::Efficient { .. } => 0,
        };
        let n = match self.points {
            None => needs + own,
            Some(n) if needs <= n => n,
            Some(n) => {
                return Err(self
                    .model
                    .wrong(format!("takes {n} points at a time, and {needs} were given: leave some out")));
            }
        };
        // Where the file fixes the number of queries, the last one is repeated.
        let count = match self.interface {
            Interface::Efficient { queries: Some(fixed) } => fixed,
            _ => queries.len(),
        };
        let (mut coords, mut labels) = (Vec::with_capacity(count * n * 2), Vec::with_capacity(count * n));
        for q in queries.iter().chain(std::iter::repeat_n(&queries[queries.len() - 1], count - queries.len()))
        {
            for k in 0..n {
                let (at, label) = q.points.get(k).copied().unwrap_or(([0.0; 2], PADDING));
                coords.extend(if label == PADDING { at } else { encoded.fit.point(at) });
                labels.push(label);
            }
        }
        let failed = |e: ort::Error| self.model.wrong(format!("takes no prompts: {e}"));
        let [c, h, w] = encoded.shape;
        let embedding = TensorRef::from_array_view(([1usize, c, h, w], &encoded.data[..])).map_err(failed)?;
        let mut inputs: Vec<(&str, SessionInputValue)> = vec![(SAM[0], embedding.into())];
        let [width, height] = encoded.fit.photo;
        inputs.push((
            "orig_im_size",
            match self.whole_numbers {
                true => {
                    Tensor::from_array(([2usize], vec![height as i64, width as i64])).map_err(failed)?.into()
                }
                false => {
                    Tensor::from_array(([2usize], vec![height as f32, width as f32])).map_err(failed)?.into()
                }
            },
        ));
        let labels_of = |shape: Vec<usize>| -> Result<SessionInputValue, VisionError> {
            Ok(match self.labels_whole {
                true => {
                    let whole: Vec<i64> = labels.iter().map(|&l| l as i64).collect();
                    Tensor::from_array((shape, whole)).map_err(failed)?.into()
                }
                false => Tensor::from_array((shape, labels.clone())).map_err(failed)?.into(),
            })
        };
        match self.interface {
            Interface::Efficient { .. } => {
                let coords = Tensor::from_array(([1, count, n, 2], coords)).map_err(failed)?;
                inputs.push((EFFICIENT[1], coords.into()));
                inputs.push((EFFICIENT[2], labels_of(vec![1, count, n])?));
            }
            Interface::Sam { mask_side, .. } => {
                let coords = Tensor::from_array(([count, n, 2], coords)).map_err(failed)?;
                inputs.push((SAM[1], coords.into()));
                inputs.push((SAM[2], labels_of(vec![count, n])?));
                let previous = queries[0].previous.filter(|p| p.is(mask_side, mask_side));
                let mask = previous.map_or_else(|| vec![0.0; mask_side * mask_side], |p| p.data.clone());
                let mask = Tensor::from_array(([1usize, 1, mask_side, mask_side], mask)).map_err(failed)?;
                inputs.push((SAM[3], mask.into()));
                let has = vec![f32::from(u8::from(previous.is_some()))];
                inputs.push((SAM[4], Tensor::from_array(([1usize], has)).map_err(failed)?.into()));
            }
        }
        let mut given =
            self.model.run(inputs, &[self.masks.as_str(), self.scores.as_str()], &on)?.into_iter();
        let (Some(masks), Some(scores)) = (given.next(), given.next()) else {
            return Err(self.model.wrong("answered nothing"));
        };
        let mut answers = self.read(count, encoded.fit.photo, &masks, &scores, &on)?;
        answers.truncate(queries.len());
        Ok(answers)
    }

    /// `[Q, M, h, w]` and `[Q, M]`, with a 1 before them in EfficientSAM's.
    fn read(
        &self,
        count: usize,
        photo: [usize; 2],
        masks: &NetworkOutput,
        scores: &NetworkOutput,
        on: &str,
    ) -> Result<Vec<Vec<(Logits, f32)>>, VisionError> {
        let skip = usize::from(matches!(self.interface, Interface::Efficient { .. }));
        let fits = |shape: &[usize]| match *shape.get(skip..).unwrap_or_default() {
            [q, m, height, width]
                if q == count
                    && (1..=MOST_MASKS).contains(&m)
                    && (1..=MOST_SIDE).contains(&width)
                    && (if self.full_size { [width, height] == photo } else { width == height }) =>
            {
                Some((m, width, height))
            }
            _ => None,
        };
        let Some((m, width, height)) = fits(&masks.shape).filter(|&(m, width, height)| {
            scores.shape.get(skip..) == Some(&[count, m])
                && scores.data.len() == count * m
                && masks.data.len() == count * m * width * height
        }) else {
            return Err(self.model.wrong(format!(
                "answered masks of {:?} and scores of {:?} on {on}; [.., {count}, M, {}] and [.., {count}, M] were expected",
                masks.shape,
                scores.shape,
                if self.full_size { format!("{}, {}", photo[1], photo[0]) } else { "s, s".into() }
            )));
        };
        let strange = |data: &[f32]| data.iter().filter(|v| !v.is_finite()).count();
        match strange(&masks.data) + strange(&scores.data) {
            0 => {}
            n => {
                return Err(self.model.wrong(format!("answered {n} values that are no numbers on {on}")));
            }
        }
        let planes =
            masks.data.chunks_exact(width * height).map(|p| Logits { width, height, data: p.to_vec() });
        let mut all = planes.zip(scores.data.iter().copied());
        Ok((0..count).map(|_| all.by_ref().take(m).collect()).collect())
    }
}

/// The outputs with the masks, whether they have the photo's size, and with the scores. The small masks serve if there
/// are any, for they can be given back and take less memory; exports of EfficientSAM leave them without a name.
/// `more` dimensions come before the usual ones.
fn outputs(model: &NetworkModel, more: usize) -> Result<(String, bool, String), VisionError> {
    const SCORES: [&str; 2] = ["iou_predictions", "predicted_iou"];
    const FULL: [&str; 2] = ["masks", "output_masks"];
    let rank = |slot: &TensorSpec, rank: usize| slot.shape.is_empty() || slot.shape.len() == rank + more;
    let named = |names: &[&str]| model.outputs.iter().find(|o| names.contains(&o.name.as_str()));
    let scores = named(&SCORES);
    let other = |o: &&TensorSpec| {
        !FULL.contains(&o.name.as_str()) && !SCORES.contains(&o.name.as_str()) && rank(o, 4)
    };
    let small = named(&["low_res_masks", "low_res_logits"]).or(model.outputs.iter().find(other));
    let masks = small.map(|s| (s, false)).or(named(&FULL).map(|s| (s, true)));
    match (masks.filter(|(s, _)| rank(s, 4)), scores.filter(|s| rank(s, 2))) {
        (Some((masks, full)), Some(scores)) => Ok((masks.name.clone(), full, scores.name.clone())),
        _ => {
            let found: Vec<String> =
                model.outputs.iter().map(|o| format!("`{}` {}", o.name, o.words())).collect();
            let dims = if more == 1 { "1, Q" } else { "1" };
            Err(model.wrong(format!(
                "answers {}; `low_res_masks` [{dims}, M, s, s] and `iou_predictions` [{dims}, M] were expected",
                if found.is_empty() { "nothing".into() } else { found.join(", ") }
            )))
        }
    }
}
