//! The prompted decoder: points, boxes and earlier logits on an embedding to masks with scores.

use super::encoder::{Encoded, Encoder};
use super::logits::Logits;
use super::prompt::{CORNERS, Labelled};
use super::refused::refused;
use crate::VisionError;
use crate::model_file::TensorSpec;
use crate::onnx::{NetworkModel, NetworkOutput, floats};
use crate::sam_file_error::SamFileError;
use crate::sam_interface::{DecoderInterface, MOST_SIDE, SamKind};
use ort::session::SessionInputValue;
use ort::value::{Tensor, TensorElementType, TensorRef};
use std::sync::atomic::{AtomicBool, Ordering};

/// The decoder's label of a padding point.
const PADDING: f32 = -1.0;

/// Most masks per prompt.
const MOST_MASKS: usize = 16;

/// One query: points with labels, in the photo's pixels.
#[derive(Clone, Debug, Default)]
pub(super) struct Query<'a> {
    pub points: Vec<Labelled>,
    /// Logits of an earlier answer, to be refined.
    pub previous: Option<&'a Logits>,
}

impl Query<'_> {
    fn has_box(&self) -> bool {
        self.points.iter().any(|p| CORNERS.contains(&p.1))
    }
}

/// A loaded decoder.
pub(super) struct PromptDecoder {
    model: NetworkModel,
    interface: DecoderInterface,
    /// Side of an earlier answer's logits.
    mask_side: usize,
    /// Queries per run.
    batch: usize,
    /// The file leaves the number of queries open and yet takes only one.
    one_by_one: AtomicBool,
}

impl PromptDecoder {
    /// Reads the file's inputs and outputs, and checks that they fit the encoder's.
    pub fn new(model: NetworkModel, encoder: &Encoder, batch: usize) -> Result<PromptDecoder, VisionError> {
        let interface = DecoderInterface::of(&model.inputs, &model.outputs)
            .and_then(|found| found.fit(&encoder.interface, encoder.name()).map(|()| found))
            .map_err(|reason| refused(&model, reason))?;
        let declared = interface.previous.as_ref().and_then(|(mask, _)| mask.shape[2]);
        // Four times the embedding's, as in all of the family.
        let rows = interface.embedding.shape[2].or(encoder.interface.output.shape[2]);
        let mask_side = declared.or(rows.map(|n| 4 * n)).unwrap_or(256);
        Ok(PromptDecoder {
            interface,
            mask_side,
            batch: batch.max(1),
            one_by_one: AtomicBool::new(false),
            model,
        })
    }

    /// Hash of the file, short.
    pub fn key(&self) -> &str {
        self.model.key()
    }

    /// Whether its masks have the photo's size.
    pub fn full_size(&self) -> bool {
        self.interface.full_size
    }

    /// Whether boxes can be given.
    pub fn takes_boxes(&self) -> bool {
        self.interface.takes_boxes()
    }

    /// Whether it can be given an earlier answer; the side of its logits.
    pub fn takes_logits(&self) -> Option<usize> {
        let takes = self.interface.previous.is_some() && !self.interface.full_size;
        takes.then_some(self.mask_side)
    }

    /// The masks of each query, in the file's order, with the IoU that the network predicts.
    pub fn ask(&self, encoded: &Encoded, queries: &[Query]) -> Result<Vec<Vec<(Logits, f32)>>, VisionError> {
        let boxed = queries.iter().any(Query::has_box);
        if boxed && !self.takes_boxes() {
            return Err(refused(&self.model, SamFileError::NoBoxes));
        }
        let fixed = self.interface.queries();
        let alone = (boxed && self.interface.boxes.is_some()) || queries.iter().any(|q| q.previous.is_some());
        let at_once = if alone { 1 } else { fixed.unwrap_or(self.batch) };
        let at_once = if self.one_by_one.load(Ordering::Relaxed) { 1 } else { at_once.max(1) };
        let mut answers = Vec::with_capacity(queries.len());
        for some in queries.chunks(at_once) {
            match self.ask_at_once(encoded, some) {
                Ok(given) => answers.extend(given),
                Err(error) if some.len() > 1 && self.interface.kind != SamKind::Efficient => {
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
        // Where the file fixes the number of queries, the last one is repeated.
        let count = self.interface.queries().map_or(queries.len(), |fixed| fixed.max(queries.len()));
        let repeated = std::iter::repeat_n(&queries[queries.len() - 1], count - queries.len());
        let all: Vec<&Query> = queries.iter().chain(repeated).collect();
        let failed = |e: ort::Error| self.model.wrong(format!("takes no prompts: {e}"));
        let mut inputs = self.encoded_inputs(encoded).map_err(failed)?;
        inputs.extend(self.prompt_inputs(encoded, &all)?);
        if let Some(size) = &self.interface.size {
            let [width, height] = encoded.fit.photo;
            let value = numbers(size.kind, &[2], &[height as f32, width as f32]).map_err(failed)?;
            inputs.push((size.name.as_str(), value));
        }
        if let Some((mask, has)) = &self.interface.previous {
            let side = self.mask_side;
            let previous = queries[0].previous.filter(|p| p.is(side, side));
            let plane = previous.map_or_else(|| vec![0.0; side * side], |p| p.data.clone());
            // SAM takes one for all queries. SAM 2 takes one each, and its first size is open then.
            let each = if mask.shape[0].is_none() && self.interface.kind != SamKind::Sam { count } else { 1 };
            let value = floats(mask.kind, &[each, 1, side, side], plane.repeat(each)).map_err(failed)?;
            inputs.push((mask.name.as_str(), value));
            let given = vec![f32::from(u8::from(previous.is_some()))];
            inputs.push((has.name.as_str(), floats(has.kind, &[1], given).map_err(failed)?));
        }
        let outputs = [self.interface.masks.as_str(), self.interface.scores.as_str()];
        let mut given = self.model.run(inputs, &outputs, &on)?.into_iter();
        let (Some(masks), Some(scores)) = (given.next(), given.next()) else {
            return Err(self.model.wrong("answered nothing"));
        };
        let mut answers = self.read(count, encoded.fit.photo, &masks, &scores, &on)?;
        answers.truncate(queries.len());
        Ok(answers)
    }

    /// The embedding and the further maps, as the encoder answered them.
    fn encoded_inputs<'a>(
        &'a self,
        encoded: &'a Encoded,
    ) -> ort::Result<Vec<(&'a str, SessionInputValue<'a>)>> {
        let spec = &self.interface.embedding;
        let mut inputs = vec![(spec.name.as_str(), map_input(spec, encoded.shape, &encoded.data)?)];
        for (role, spec) in &self.interface.features {
            if let Some(map) = encoded.features.iter().find(|map| map.role == *role) {
                inputs.push((spec.name.as_str(), map_input(spec, map.shape, &map.data)?));
            }
        }
        Ok(inputs)
    }

    /// Points, labels and boxes.
    fn prompt_inputs(
        &self,
        encoded: &Encoded,
        queries: &[&Query],
    ) -> Result<Vec<(&str, SessionInputValue<'static>)>, VisionError> {
        let DecoderInterface { coords, labels, boxes, .. } = &self.interface;
        let count = queries.len();
        let is_corner = |p: &&Labelled| boxes.is_some() && CORNERS.contains(&p.1);
        let points: Vec<Vec<Labelled>> =
            queries.iter().map(|q| q.points.iter().filter(|p| !is_corner(p)).copied().collect()).collect();
        let needs = points.iter().map(Vec::len).max().unwrap_or(0);
        let pads = self.interface.wants_padding() && queries.iter().any(|q| !q.has_box());
        let n = match self.interface.points() {
            None => needs + usize::from(pads),
            Some(n) if needs <= n => n,
            Some(n) => {
                return Err(self
                    .model
                    .wrong(format!("takes {n} points at a time, and {needs} were given: leave some out")));
            }
        };
        let (mut at, mut kinds) = (Vec::with_capacity(count * n * 2), Vec::with_capacity(count * n));
        for query in &points {
            for k in 0..n {
                let (point, label) = query.get(k).copied().unwrap_or(([0.0; 2], PADDING));
                at.extend(if label == PADDING { point } else { encoded.fit.point(point) });
                kinds.push(label);
            }
        }
        let failed = |e: ort::Error| self.model.wrong(format!("takes no prompts: {e}"));
        let mut shape = vec![1; self.interface.more()];
        shape.extend([count, n]);
        let value = numbers(labels.kind, &shape, &kinds).map_err(failed)?;
        let mut inputs = vec![(labels.name.as_str(), value)];
        shape.push(2);
        inputs.push((coords.name.as_str(), floats(coords.kind, &shape, at).map_err(failed)?));
        if let Some(boxes) = boxes {
            let corners: Vec<f32> = queries
                .iter()
                .flat_map(|q| q.points.iter().filter(is_corner))
                .flat_map(|p| encoded.fit.point(p.0))
                .collect();
            let shape = [1, corners.len() / 4, 4];
            inputs.push((boxes.name.as_str(), floats(boxes.kind, &shape, corners).map_err(failed)?));
        }
        Ok(inputs)
    }

    /// `[Q, M, h, w]` and `[Q, M]`, with a 1 before them where the points have it.
    fn read(
        &self,
        count: usize,
        photo: [usize; 2],
        masks: &NetworkOutput,
        scores: &NetworkOutput,
        on: &str,
    ) -> Result<Vec<Vec<(Logits, f32)>>, VisionError> {
        let skip = self.interface.more();
        let full_size = self.interface.full_size;
        let fits = |shape: &[usize]| match *shape.get(skip..).unwrap_or_default() {
            [q, m, height, width]
                if q == count
                    && (1..=MOST_MASKS).contains(&m)
                    && (1..=MOST_SIDE).contains(&width)
                    && (if full_size { [width, height] == photo } else { width == height }) =>
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
                if full_size { format!("{}, {}", photo[1], photo[0]) } else { "s, s".into() }
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

/// A map of the encoder as an input; its numbers are not copied where the file takes them as they are.
fn map_input<'a>(
    spec: &TensorSpec,
    [c, h, w]: [usize; 3],
    data: &'a [f32],
) -> ort::Result<SessionInputValue<'a>> {
    match spec.kind {
        Some(TensorElementType::Float16) => floats(spec.kind, &[1, c, h, w], data.to_vec()),
        _ => Ok(TensorRef::from_array_view(([1, c, h, w], data))?.into()),
    }
}

/// Whole numbers as the file declares them: labels, or a photo's size.
fn numbers(
    kind: Option<TensorElementType>,
    shape: &[usize],
    values: &[f32],
) -> ort::Result<SessionInputValue<'static>> {
    Ok(match kind {
        Some(TensorElementType::Int64) => {
            let whole: Vec<i64> = values.iter().map(|&v| v as i64).collect();
            Tensor::from_array((shape, whole))?.into()
        }
        Some(TensorElementType::Int32) => {
            let whole: Vec<i32> = values.iter().map(|&v| v as i32).collect();
            Tensor::from_array((shape, whole))?.into()
        }
        _ => return floats(kind, shape, values.to_vec()),
    })
}
