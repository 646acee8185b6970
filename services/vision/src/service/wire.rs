//! This crate's types as messages, and back. Sizes are checked before memory is taken.

use crate::clip_interface::MOST_DIMS;
use segwild_proto::v1::{self, ImageHeader, ImagePart, PixelFormat, image_part::Part};
use segwild_scene::{BoxPrompt, Embedding, Image, Mask, PointPrompt, Prompts, ScoredMask};
use std::sync::Arc;

/// Most pixels of an image.
const MOST_PIXELS: u64 = 1 << 24;
/// Most numbers of an image, or of descriptors: 64 million.
const MOST_NUMBERS: u64 = 1 << 26;
/// Bytes of a part of an image.
const PART: usize = 1 << 20;
/// Most points or boxes of a call.
const MOST_PROMPTS: usize = 1 << 16;
/// Most bytes of one message: the plane of what a mask leaves open is the largest.
pub(crate) const MOST_MESSAGE: usize = 1 << 27;

/// A message is not what it should be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub(crate) struct MessageError(pub &'static str);

type Read<T> = Result<T, MessageError>;

/// An image under its name, ready to be put.
pub(crate) struct NamedImage {
    header: ImageHeader,
    numbers: Vec<u8>,
}

impl NamedImage {
    /// Packs an image in a service's format.
    pub fn of(image: &Image, format: PixelFormat) -> NamedImage {
        let numbers = match format {
            PixelFormat::U8 => {
                let pixels = image.pixels();
                let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
                let pixel = |i: usize| (0..image.channels).map(move |c| byte(image.data[c * pixels + i]));
                (0..pixels).flat_map(pixel).collect()
            }
            _ => floats(&image.data),
        };
        let mut header = ImageHeader {
            hash: String::new(),
            width: image.width as u32,
            height: image.height as u32,
            channels: image.channels as u32,
            format: format.into(),
        };
        header.hash = hash(&header, &numbers);
        NamedImage { header, numbers }
    }

    /// Its name.
    pub fn hash(&self) -> &str {
        &self.header.hash
    }

    /// Its parts, in order. Each is made when it is requested.
    pub fn parts(self: Arc<NamedImage>) -> impl Iterator<Item = ImagePart> + Send + 'static {
        let header = ImagePart { part: Some(Part::Header(self.header.clone())) };
        let count = self.numbers.len().div_ceil(PART);
        let numbers = (0..count).map(move |i| {
            let until = self.numbers.len().min((i + 1) * PART);
            ImagePart { part: Some(Part::Numbers(self.numbers[i * PART..until].to_vec())) }
        });
        std::iter::once(header).chain(numbers)
    }
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn of_floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|four| f32::from_le_bytes(*four)).collect()
}

/// The name of an image.
fn hash(header: &ImageHeader, numbers: &[u8]) -> String {
    let mut hasher = blake3::Hasher::new();
    for number in [header.width, header.height, header.channels, header.format as u32] {
        hasher.update(&number.to_le_bytes());
    }
    hasher.update(numbers);
    hasher.finalize().to_hex().to_string()
}

/// Planes of numbers as the parts of an answer.
pub(crate) fn answer_parts(planes: &[f32], [width, height, channels]: [usize; 3]) -> Vec<ImagePart> {
    let header = ImageHeader {
        hash: String::new(),
        width: width as u32,
        height: height as u32,
        channels: channels as u32,
        format: PixelFormat::F32Planes.into(),
    };
    Arc::new(NamedImage { header, numbers: floats(planes) }).parts().collect()
}

/// An image whose parts are arriving.
#[derive(Default)]
pub(crate) struct Arriving {
    header: Option<ImageHeader>,
    size: usize,
    numbers: Vec<u8>,
}

impl Arriving {
    /// Takes the next part.
    pub fn push(&mut self, part: ImagePart) -> Read<()> {
        match (part.part, &self.header) {
            (Some(Part::Header(header)), None) => {
                let (pixels, channels) =
                    (u64::from(header.width) * u64::from(header.height), u64::from(header.channels));
                if pixels == 0 || pixels > MOST_PIXELS || channels == 0 {
                    return Err(MessageError("an image has 1 to 16777216 pixels and a number for each"));
                }
                let numbers = pixels.saturating_mul(channels);
                if numbers > MOST_NUMBERS {
                    return Err(MessageError("an image has at most 67108864 numbers"));
                }
                let bytes = match header.format() {
                    PixelFormat::U8 => 1,
                    PixelFormat::F32Planes => 4,
                    PixelFormat::Unspecified => return Err(MessageError("the image's format is none")),
                };
                self.size = numbers as usize * bytes;
                self.header = Some(header);
            }
            (Some(Part::Numbers(numbers)), Some(_)) => {
                if self.numbers.len() + numbers.len() > self.size {
                    return Err(MessageError("an image has more numbers than its header says"));
                }
                self.numbers.extend_from_slice(&numbers);
            }
            _ => return Err(MessageError("an image starts with its header, which comes once")),
        }
        Ok(())
    }

    /// The image and its name. With a name in the header, it is checked.
    pub fn finish(self) -> Read<(Image, String)> {
        let header = self.header.ok_or(MessageError("an image without a header"))?;
        if self.numbers.len() != self.size {
            return Err(MessageError("an image has fewer numbers than its header says"));
        }
        let name = hash(&header, &self.numbers);
        if !header.hash.is_empty() && header.hash != name {
            return Err(MessageError("the image's hash is not that of its numbers"));
        }
        let [width, height, channels] = [header.width, header.height, header.channels].map(|n| n as usize);
        let data = match header.format() {
            PixelFormat::U8 => {
                let pixel = |c: usize| self.numbers[c..].iter().step_by(channels);
                (0..channels).flat_map(|c| pixel(c).map(|byte| f32::from(*byte) / 255.0)).collect()
            }
            _ => of_floats(&self.numbers),
        };
        Ok((Image { width, height, channels, data }, name))
    }

    /// Descriptors of an answer.
    pub fn embedding(self) -> Read<Embedding> {
        let Image { width, height, channels, data } = self.finish()?.0;
        if !data.iter().all(|v| v.is_finite()) {
            return Err(MessageError("descriptors are not finite"));
        }
        Ok(Embedding { width, height, channels, data })
    }
}

/// A mask as a message.
pub(crate) fn mask(mask: &Mask) -> v1::Mask {
    let pixels = mask.width() as usize * mask.height() as usize;
    let (mut runs, mut inside, mut from) = (Vec::new(), false, 0);
    for i in 0..pixels {
        if mask.index(i) != inside {
            runs.push((i - from) as u32);
            (inside, from) = (!inside, i);
        }
    }
    runs.push((pixels - from) as u32);
    v1::Mask { width: mask.width(), height: mask.height(), runs }
}

/// A mask of an image of this size.
pub(crate) fn mask_of(message: Option<v1::Mask>, [width, height]: [usize; 2]) -> Read<Mask> {
    let message = message.ok_or(MessageError("there is no mask"))?;
    if (message.width as usize, message.height as usize) != (width, height) {
        return Err(MessageError("the mask has another size than its photo"));
    }
    let mut mask = Mask::empty(message.width, message.height);
    let (mut at, mut inside) = (0usize, false);
    for run in message.runs {
        let until = at + run as usize;
        if until > width * height {
            return Err(MessageError("the mask has more pixels than its photo"));
        }
        if inside {
            (at..until).for_each(|i| mask.set((i % width) as u32, (i / width) as u32, true));
        }
        (at, inside) = (until, !inside);
    }
    match at == width * height {
        true => Ok(mask),
        false => Err(MessageError("the mask has fewer pixels than its photo")),
    }
}

/// A mask with scores as a message.
pub(crate) fn scored(scored: &ScoredMask) -> v1::ScoredMask {
    let ScoredMask { mask: pixels, predicted_iou, stability } = scored;
    v1::ScoredMask { mask: Some(mask(pixels)), predicted_iou: *predicted_iou, stability: *stability }
}

/// A mask with scores of an image of this size.
pub(crate) fn scored_of(message: v1::ScoredMask, size: [usize; 2]) -> Read<ScoredMask> {
    let v1::ScoredMask { mask, predicted_iou, stability } = message;
    if ![predicted_iou, stability].iter().all(|score| (0.0..=1.0).contains(score)) {
        return Err(MessageError("a score is not between 0 and 1"));
    }
    Ok(ScoredMask { mask: mask_of(mask, size)?, predicted_iou, stability })
}

/// A plane of numbers, empty where all are 0, as a message.
pub(crate) fn plane(image: &Image) -> Vec<u8> {
    if image.data.iter().all(|v| *v == 0.0) { Vec::new() } else { floats(image.plane(0)) }
}

/// A plane of probabilities of this size.
pub(crate) fn plane_of(bytes: &[u8], [width, height]: [usize; 2]) -> Read<Image> {
    let mut plane = Image::zeros(width, height, 1);
    if bytes.is_empty() {
        return Ok(plane);
    }
    let values = of_floats(bytes);
    if bytes.len() != 4 * width * height || !values.iter().all(|v| (0.0..=1.0).contains(v)) {
        return Err(MessageError("what a mask leaves open is no plane of probabilities of the photo's size"));
    }
    plane.data = values;
    Ok(plane)
}

/// A position as a message.
pub(crate) fn position([x, y]: [f32; 2]) -> v1::Position {
    v1::Position { x, y }
}

/// Texts or crops of one call, at most.
pub(crate) const MOST_EMBEDDED: usize = 64;
/// Characters of a text at most.
const MOST_CHARACTERS: usize = 1024;

/// Refuses more texts or crops than one call may have.
pub(crate) fn few_embedded(count: usize) -> Read<()> {
    match count <= MOST_EMBEDDED {
        true => Ok(()),
        false => Err(MessageError("there are more than 64 texts or crops in one call")),
    }
}

/// Texts of a message.
pub(crate) fn texts(texts: Vec<String>) -> Read<Vec<String>> {
    few_embedded(texts.len())?;
    match texts.iter().any(|text| text.chars().count() > MOST_CHARACTERS) {
        true => Err(MessageError("a text has more than 1024 characters")),
        false => Ok(texts),
    }
}

/// Embeddings as messages.
pub(crate) fn vectors(vectors: Vec<Vec<f32>>) -> Vec<v1::EmbeddingVector> {
    vectors.into_iter().map(|numbers| v1::EmbeddingVector { numbers }).collect()
}

/// So many embeddings of a message, unit vectors of one length.
pub(crate) fn vectors_of(messages: Vec<v1::EmbeddingVector>, count: usize) -> Read<Vec<Vec<f32>>> {
    let dims = messages.first().map_or(0, |first| first.numbers.len());
    let is_unit = |vector: &v1::EmbeddingVector| {
        let length: f32 = vector.numbers.iter().map(|v| v * v).sum();
        vector.numbers.len() == dims && (0.9..=1.1).contains(&length)
    };
    if messages.len() != count || dims > MOST_DIMS || !messages.iter().all(is_unit) {
        return Err(MessageError("the embeddings are no unit vectors of one length, one each"));
    }
    Ok(messages.into_iter().map(|vector| vector.numbers).collect())
}

/// Positions of a message.
pub(crate) fn positions(messages: &[v1::Position]) -> Read<Vec<[f32; 2]>> {
    bounded(messages.len())?;
    let points: Vec<[f32; 2]> = messages.iter().map(|p| [p.x, p.y]).collect();
    if !points.iter().flatten().all(|v| v.is_finite()) {
        return Err(MessageError("a position is not finite"));
    }
    Ok(points)
}

fn bounded(count: usize) -> Read<()> {
    if count > MOST_PROMPTS { Err(MessageError("there are more than 65536 prompts")) } else { Ok(()) }
}

/// Prompts as a message.
pub(crate) fn prompts(image: String, prompts: &Prompts) -> v1::SegmentPromptsRequest {
    let Prompts { points, boxes, granularity } = prompts;
    v1::SegmentPromptsRequest {
        image,
        points: points
            .iter()
            .map(|p| v1::PointPrompt { at: Some(position([p.x, p.y])), positive: p.inside })
            .collect(),
        boxes: boxes
            .iter()
            .map(|b| v1::BoxPrompt {
                corner: Some(position([b.x0, b.y0])),
                opposite: Some(position([b.x1, b.y1])),
            })
            .collect(),
        granularity: *granularity,
    }
}

/// Prompts of a message.
pub(crate) fn prompts_of(message: &v1::SegmentPromptsRequest) -> Read<Prompts> {
    bounded(message.points.len().max(message.boxes.len()))?;
    let at = |position: Option<v1::Position>| {
        let v1::Position { x, y } = position.ok_or(MessageError("a prompt without a position"))?;
        if x.is_finite() && y.is_finite() {
            Ok([x, y])
        } else {
            Err(MessageError("a position is not finite"))
        }
    };
    let points = message.points.iter().map(|p| {
        let [x, y] = at(p.at)?;
        Ok(PointPrompt { x, y, inside: p.positive })
    });
    let boxes = message.boxes.iter().map(|b| {
        let ([x0, y0], [x1, y1]) = (at(b.corner)?, at(b.opposite)?);
        Ok(BoxPrompt { x0, y0, x1, y1 })
    });
    if message.granularity.is_some_and(|g| !(0.0..=1.0).contains(&g)) {
        return Err(MessageError("the granularity is not between 0 and 1"));
    }
    Ok(Prompts {
        points: points.collect::<Read<_>>()?,
        boxes: boxes.collect::<Read<_>>()?,
        granularity: message.granularity,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn image(width: usize, height: usize, channels: usize) -> Image {
        let data = (0..width * height * channels).map(|i| (i * 37 % 256) as f32 / 255.0).collect();
        Image { width, height, channels, data }
    }

    fn arrived(parts: impl Iterator<Item = ImagePart>) -> Read<(Image, String)> {
        let mut arriving = Arriving::default();
        for part in parts {
            arriving.push(part)?;
        }
        arriving.finish()
    }

    #[test]
    fn an_image_arrives_as_it_was_sent_in_parts_and_under_its_name() {
        for format in [PixelFormat::U8, PixelFormat::F32Planes] {
            let sent = image(700, 500, 3);
            let named = Arc::new(NamedImage::of(&sent, format));
            assert!(named.clone().parts().count() > 1);
            let (got, name) = arrived(named.clone().parts()).unwrap();
            assert_eq!((&got, name.as_str()), (&sent, named.hash()));
        }
    }

    #[test]
    fn an_image_that_is_not_what_its_header_says_is_refused_before_memory_is_taken() {
        let parts =
            || Arc::new(NamedImage::of(&image(40, 30, 3), PixelFormat::U8)).parts().collect::<Vec<_>>();
        let header = |change: fn(&mut ImageHeader)| {
            let mut parts = parts();
            if let Some(Part::Header(header)) = &mut parts[0].part {
                change(header);
            }
            arrived(parts.into_iter()).unwrap_err().to_string()
        };
        assert!(header(|h| h.width = u32::MAX).contains("16777216 pixels"));
        assert!(header(|h| h.channels = u32::MAX).contains("67108864 numbers"));
        assert!(header(|h| h.format = 9).contains("format is none"));
        assert!(header(|h| h.height += 1).contains("fewer numbers"));
        assert!(header(|h| h.height -= 1).contains("more numbers"));
        assert!(header(|h| h.hash = "0".into()).contains("hash"));
        assert!(arrived(parts().into_iter().skip(1)).is_err() && arrived(std::iter::empty()).is_err());
        assert!(arrived(parts().into_iter().chain(parts())).is_err());
    }

    proptest! {
        #[test]
        fn masks_and_planes_come_back(bits in proptest::collection::vec(any::<bool>(), 35)) {
            let sent = Mask::from_fn(7, 5, |x, y| bits[(y * 7 + x) as usize]);
            prop_assert_eq!(&mask_of(Some(mask(&sent)), [7, 5]).unwrap(), &sent);
            prop_assert!(mask_of(Some(mask(&sent)), [5, 7]).is_err());
            let open = Image { width: 7, height: 5, channels: 1, data: bits.iter().map(|b| f32::from(*b)).collect() };
            prop_assert_eq!(plane_of(&plane(&open), [7, 5]).unwrap(), open);
        }

        #[test]
        fn a_mask_of_any_runs_is_read_or_refused(runs in proptest::collection::vec(any::<u32>(), 0..6)) {
            let whole = runs.iter().map(|r| u64::from(*r)).sum::<u64>() == 35;
            let read = mask_of(Some(v1::Mask { width: 7, height: 5, runs }), [7, 5]);
            prop_assert_eq!(read.is_ok(), whole);
        }
    }

    #[test]
    fn prompts_come_back_and_numbers_that_are_none_are_refused() {
        let sent = Prompts {
            points: vec![PointPrompt { x: 1.5, y: 2.0, inside: false }],
            boxes: vec![BoxPrompt { x0: 0.0, y0: 1.0, x1: 2.0, y1: 3.0 }],
            granularity: Some(0.5),
        };
        let message = prompts("image".into(), &sent);
        assert_eq!(prompts_of(&message).unwrap(), sent);
        let mut wrong = message.clone();
        wrong.points[0].at = None;
        assert!(prompts_of(&wrong).is_err());
        let mut wrong = message.clone();
        wrong.boxes[0].opposite = Some(position([f32::NAN, 0.0]));
        assert!(prompts_of(&wrong).is_err());
        assert!(prompts_of(&v1::SegmentPromptsRequest { granularity: Some(2.0), ..message }).is_err());
        assert!(positions(&[position([f32::INFINITY, 0.0])]).is_err());
        let score = v1::ScoredMask { mask: None, predicted_iou: f32::NAN, stability: 0.0 };
        assert!(scored_of(score, [1, 1]).is_err());
    }
}
