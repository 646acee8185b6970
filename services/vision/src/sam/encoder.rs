//! The image encoder: a photo to its embedding.

use super::frame::{PhotoFit, Range, SIDE, prepare};
use crate::VisionError;
use crate::builtin::Weighed;
use crate::onnx::{NetworkModel, TensorSpec};
use ort::session::SessionInputValue;
use ort::value::{Tensor, TensorElementType};
use segwild_scene::{Embedding, Image};

/// Cells along a side of the embedding are at most this many, and channels at most four times as many: SAM has 64 and 256.
const MOST_CELLS: usize = 256;

/// A photo's embedding, and where the photo lies in it.
pub(super) struct Encoded {
    pub fit: PhotoFit,
    /// Channels, rows and columns over the encoder's square.
    pub shape: [usize; 3],
    pub data: Vec<f32>,
}

impl Weighed for Encoded {
    fn bytes(&self) -> usize {
        4 * self.data.len()
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

/// How an encoder wants its photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum InputLayout {
    /// `[1, 3, h, w]`, standardised and padded.
    Planes,
    /// `[1, 3, h, w]` in [0, 1]; scaling and standardising are in the file (EfficientSAM).
    Whole,
    /// `[h, w, 3]` in [0, 255]; standardising and padding are in the file.
    Pixels,
}

/// A loaded encoder.
pub(super) struct Encoder {
    model: NetworkModel,
    layout: InputLayout,
    bytes: bool,
    /// Height and width that the file asks for.
    size: [Option<usize>; 2],
    output: String,
    /// Channels, rows and columns of the embedding, where the file says.
    pub shape: [Option<usize>; 3],
}

impl Encoder {
    /// Reads the file's input and output.
    pub fn new(model: NetworkModel) -> Result<Encoder, VisionError> {
        let [input] = &model.inputs[..] else {
            let names: Vec<&str> = model.inputs.iter().map(|i| i.name.as_str()).collect();
            return Err(model.wrong(format!(
                "takes {} inputs ({}); an image encoder takes one photo",
                names.len(),
                names.join(", ")
            )));
        };
        let (layout, size) = match input.shape[..] {
            [None | Some(1), None | Some(3), h, w] => match input.name.as_str() {
                "batched_images" => (InputLayout::Whole, [h, w]),
                _ => (InputLayout::Planes, [h, w]),
            },
            [h, w, Some(3)] => (InputLayout::Pixels, [h, w]),
            _ => return Err(unfit(&model, input)),
        };
        let bytes = match input.kind {
            Some(TensorElementType::Float32) => false,
            Some(TensorElementType::Uint8) if layout == InputLayout::Pixels => true,
            _ => return Err(unfit(&model, input)),
        };
        if let Some(n) = size.into_iter().flatten().find(|n| !(16..=4096).contains(n)) {
            return Err(model.wrong(format!(
                "its input `{}` is {}: a side of {n} pixels is none of an image encoder",
                input.name,
                input.words()
            )));
        }
        let is_embedding = |slot: &&TensorSpec| {
            slot.kind == Some(TensorElementType::Float32)
                && matches!(slot.shape[..], [None | Some(1), _, _, _])
        };
        let named = model.outputs.iter().find(|o| o.name == "image_embeddings");
        let Some(output) = named.or(model.outputs.first()).filter(is_embedding) else {
            let found: Vec<String> =
                model.outputs.iter().map(|o| format!("`{}` {}", o.name, o.words())).collect();
            return Err(model.wrong(format!(
                "answers {}; an image encoder answers float32 [1, 256, 64, 64]",
                if found.is_empty() { "nothing".into() } else { found.join(", ") }
            )));
        };
        let (output, shape) = (output.name.clone(), [output.shape[1], output.shape[2], output.shape[3]]);
        Ok(Encoder { layout, bytes, size, output, shape, model })
    }

    /// Hash of the file, short.
    pub fn key(&self) -> &str {
        self.model.key()
    }

    /// Whether it is one of EfficientSAM's.
    pub fn is_efficient(&self) -> bool {
        self.layout == InputLayout::Whole
    }

    /// The file's name, for messages.
    pub fn name(&self) -> &str {
        self.model.name()
    }

    /// Encodes a photo.
    pub fn encode(&self, image: &Image) -> Result<Encoded, VisionError> {
        let photo = [image.width, image.height];
        let target = [self.size[1].unwrap_or(SIDE), self.size[0].unwrap_or(SIDE)];
        let (fit, size, range) = match self.layout {
            InputLayout::Planes => (PhotoFit::into(photo, target), target, Range::Standard),
            InputLayout::Pixels => {
                let fit = PhotoFit::into(photo, target);
                // The file pads what it is given, where its size is open.
                let size = [
                    if self.size[1].is_some() { target[0] } else { fit.content[0] },
                    if self.size[0].is_some() { target[1] } else { fit.content[1] },
                ];
                (fit, size, Range::Byte)
            }
            InputLayout::Whole => {
                // Scaled by the file; a photo larger than what it scales to only costs memory.
                let shrunk = PhotoFit::into(photo, [SIDE.min(photo[0]), SIDE.min(photo[1])]).content;
                let size = [self.size[1].unwrap_or(shrunk[0]), self.size[0].unwrap_or(shrunk[1])];
                (PhotoFit::filling(photo), size, Range::Unit)
            }
        };
        let planes = prepare(image, &fit, size, range);
        let on = format!("a photo of {} x {}", photo[0], photo[1]);
        let input = self.tensor(planes).map_err(|e| self.model.wrong(format!("takes no photo: {e}")))?;
        let given = self.model.run(
            vec![(self.model.inputs[0].name.as_str(), input)],
            &[self.output.as_str()],
            &on,
        )?;
        let Some(answer) = given.into_iter().next() else { return Err(self.model.wrong("answered nothing")) };
        let shape = match answer.shape[..] {
            [1, c, h, w]
                if (1..=4 * MOST_CELLS).contains(&c)
                    && (1..=MOST_CELLS).contains(&h)
                    && h == w
                    && answer.data.len() == c * h * w =>
            {
                [c, h, w]
            }
            _ => {
                return Err(self
                    .model
                    .wrong(format!("answered {:?} on {on}; [1, 256, 64, 64] was expected", answer.shape)));
            }
        };
        match answer.data.iter().filter(|v| !v.is_finite()).count() {
            0 => Ok(Encoded { fit, shape, data: answer.data }),
            n => Err(self.model.wrong(format!("answered {n} values that are no numbers on {on}"))),
        }
    }

    fn tensor(&self, planes: Image) -> ort::Result<SessionInputValue<'static>> {
        let (w, h) = (planes.width, planes.height);
        if self.layout != InputLayout::Pixels {
            return Ok(Tensor::from_array(([1usize, 3, h, w], planes.data))?.into());
        }
        let n = w * h;
        let pixels = (0..3 * n).map(|i| planes.data[i % 3 * n + i / 3]);
        if self.bytes {
            let bytes: Vec<u8> = pixels.map(|v| v.round().clamp(0.0, 255.0) as u8).collect();
            return Ok(Tensor::from_array(([h, w, 3usize], bytes))?.into());
        }
        Ok(Tensor::from_array(([h, w, 3usize], pixels.collect::<Vec<f32>>()))?.into())
    }
}

fn unfit(model: &NetworkModel, input: &TensorSpec) -> VisionError {
    model.wrong(format!(
        "its input `{}` is {}; an image encoder takes float32 [1, 3, h, w], or [h, w, 3] in float32 or uint8",
        input.name,
        input.words()
    ))
}
