//! The image encoder: a photo to its embedding.

use super::frame::{PhotoFit, Range, prepare};
use super::refused::refused;
use crate::VisionError;
use crate::builtin::Weighed;
use crate::onnx::{NetworkModel, NetworkOutput, floats};
use crate::sam_interface::{EncoderInterface, FeatureRole, InputLayout, SIDE};
use ort::session::SessionInputValue;
use ort::value::{Tensor, TensorElementType};
use segwild_scene::{Embedding, Image};

/// Cells along a side of the embedding are at most this many, and channels at most four times as many: SAM has 64 and 256.
/// Finer features have four times as many cells.
const MOST_CELLS: usize = 256;

/// What an encoder answers beside the embedding.
pub(super) struct FeatureMap {
    pub role: FeatureRole,
    /// Channels, rows and columns.
    pub shape: [usize; 3],
    pub data: Vec<f32>,
}

/// A photo's embedding, and where the photo lies in it.
pub(super) struct Encoded {
    pub fit: PhotoFit,
    /// Channels, rows and columns over the encoder's square.
    pub shape: [usize; 3],
    pub data: Vec<f32>,
    /// Further maps, which the decoder takes as they are.
    pub features: Vec<FeatureMap>,
}

impl Weighed for Encoded {
    fn bytes(&self) -> usize {
        4 * (self.data.len() + self.features.iter().map(|map| map.data.len()).sum::<usize>())
    }
}

impl Encoded {
    /// The cells that the photo covers.
    pub fn cropped(&self) -> Embedding {
        let [channels, rows, columns] = self.shape;
        let [width, height] = self.fit.cells(columns, rows);
        let mut data = Vec::with_capacity(channels * width * height);
        for plane in self.data.chunks_exact(rows * columns) {
            for row in plane.chunks_exact(columns).take(height) {
                data.extend_from_slice(&row[..width]);
            }
        }
        Embedding { width, height, channels, data }
    }
}

/// A loaded encoder.
pub(super) struct Encoder {
    model: NetworkModel,
    pub interface: EncoderInterface,
}

impl Encoder {
    /// Reads the file's input and outputs.
    pub fn new(model: NetworkModel) -> Result<Encoder, VisionError> {
        let interface =
            EncoderInterface::of(&model.inputs, &model.outputs).map_err(|reason| refused(&model, reason))?;
        Ok(Encoder { model, interface })
    }

    /// Hash of the file, short.
    pub fn key(&self) -> &str {
        self.model.key()
    }

    /// The file's name, for messages.
    pub fn name(&self) -> &str {
        self.model.name()
    }

    /// Encodes a photo.
    pub fn encode(&self, image: &Image) -> Result<Encoded, VisionError> {
        let photo = [image.width, image.height];
        let fixed = self.interface.size;
        let open = self.interface.open_side();
        let target = [fixed[1].unwrap_or(open), fixed[0].unwrap_or(open)];
        let (fit, size, range) = match self.interface.layout {
            InputLayout::Planes => (PhotoFit::into(photo, target), target, Range::Standard),
            InputLayout::Stretched => (PhotoFit::stretched(photo, target), target, Range::Standard),
            InputLayout::Centred => (PhotoFit::stretched(photo, target), target, Range::Centred),
            InputLayout::Pixels => {
                let fit = PhotoFit::into(photo, target);
                // The file pads what it is given, where its size is open.
                let size = [
                    if fixed[1].is_some() { target[0] } else { fit.content[0] },
                    if fixed[0].is_some() { target[1] } else { fit.content[1] },
                ];
                (fit, size, Range::Byte)
            }
            InputLayout::Whole => {
                // Scaled by the file; a photo larger than what it scales to only costs memory.
                let shrunk = PhotoFit::into(photo, [SIDE.min(photo[0]), SIDE.min(photo[1])]).content;
                let size = [fixed[1].unwrap_or(shrunk[0]), fixed[0].unwrap_or(shrunk[1])];
                (PhotoFit::filling(photo), size, Range::Unit)
            }
        };
        let planes = prepare(image, &fit, size, range);
        let on = format!("a photo of {} x {}", photo[0], photo[1]);
        let input = self.tensor(planes).map_err(|e| self.model.wrong(format!("takes no photo: {e}")))?;
        let mut outputs = vec![self.interface.output.name.as_str()];
        outputs.extend(self.interface.features.iter().map(|(_, spec)| spec.name.as_str()));
        let given = self.model.run(vec![(self.interface.input.name.as_str(), input)], &outputs, &on)?;
        let mut given = given.into_iter();
        let Some(answer) = given.next() else { return Err(self.model.wrong("answered nothing")) };
        let (shape, data) = self.map(answer, "[1, 256, 64, 64]", MOST_CELLS, &on)?;
        let mut features = Vec::with_capacity(self.interface.features.len());
        for ((role, spec), answer) in self.interface.features.iter().zip(given) {
            let expected = format!("[1, c, n, n] of `{}`", spec.name);
            let (shape, data) = self.map(answer, &expected, 4 * MOST_CELLS, &on)?;
            features.push(FeatureMap { role: *role, shape, data });
        }
        Ok(Encoded { fit, shape, data, features })
    }

    /// Checks a square map that the network answered.
    fn map(
        &self,
        answer: NetworkOutput,
        expected: &str,
        most: usize,
        on: &str,
    ) -> Result<([usize; 3], Vec<f32>), VisionError> {
        let NetworkOutput { shape, data } = answer;
        let sizes = match shape[..] {
            [1, c, h, w]
                if (1..=4 * MOST_CELLS).contains(&c)
                    && (1..=most).contains(&h)
                    && h == w
                    && data.len() == c * h * w =>
            {
                [c, h, w]
            }
            _ => {
                return Err(self.model.wrong(format!("answered {shape:?} on {on}; {expected} was expected")));
            }
        };
        match data.iter().filter(|v| !v.is_finite()).count() {
            0 => Ok((sizes, data)),
            n => Err(self.model.wrong(format!("answered {n} values that are no numbers on {on}"))),
        }
    }

    fn tensor(&self, planes: Image) -> ort::Result<SessionInputValue<'static>> {
        let (w, h) = (planes.width, planes.height);
        let kind = self.interface.input.kind;
        if self.interface.layout != InputLayout::Pixels {
            return floats(kind, &[1, 3, h, w], planes.data);
        }
        let n = w * h;
        let pixels = (0..3 * n).map(|i| planes.data[i % 3 * n + i / 3]);
        if kind == Some(TensorElementType::Uint8) {
            let bytes: Vec<u8> = pixels.map(|v| v.round().clamp(0.0, 255.0) as u8).collect();
            return Ok(Tensor::from_array(([h, w, 3usize], bytes))?.into());
        }
        floats(kind, &[h, w, 3], pixels.collect())
    }
}
