//! What EXIF data say about the camera: its size, and what distinguishes it from others.

/// The tags of EXIF data that are read here.
struct Tags<'a> {
    exif: &'a [u8],
    big: bool,
}

/// Of the directory of the image itself.
const MAKE: u32 = 0x010f;
const MODEL: u32 = 0x0110;
const SUB_DIRECTORY: u32 = 0x8769;
/// Of the directory of the exposure.
const FOCAL_LENGTH: u32 = 0x920a;
const WIDTH: u32 = 0xa002;
const HEIGHT: u32 = 0xa003;
/// Types of values: text, 16 bits, a quotient of two numbers of 32 bits.
const ASCII: u32 = 2;
const SHORT: u32 = 3;
const RATIONAL: u32 = 5;
/// A maker's or a model's name is no longer.
const LONGEST_NAME: usize = 64;

impl<'a> Tags<'a> {
    fn of(exif: &'a [u8]) -> Option<Tags<'a>> {
        let big = match exif.get(..4)? {
            b"II*\0" => false,
            b"MM\0*" => true,
            _ => return None,
        };
        Some(Tags { exif, big })
    }

    fn two(&self, at: usize) -> Option<u32> {
        let b = self.exif.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(u32::from(if self.big { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) }))
    }

    fn four(&self, at: usize) -> Option<u32> {
        let b = self.exif.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(if self.big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    }

    /// The entry of a tag in the directory at an offset.
    fn entry(&self, directory: u32, tag: u32) -> Option<usize> {
        let at = directory as usize;
        let mut entries = (0..self.two(at)? as usize).map(|k| at + 2 + 12 * k);
        entries.find(|&entry| self.two(entry) == Some(tag))
    }

    /// The value of a tag that is one whole number.
    fn number(&self, directory: u32, tag: u32) -> Option<u32> {
        let entry = self.entry(directory, tag)?;
        if self.two(entry + 2)? == SHORT { self.two(entry + 8) } else { self.four(entry + 8) }
    }

    fn quotient(&self, directory: u32, tag: u32) -> Option<f64> {
        let entry = self.entry(directory, tag).filter(|&entry| self.two(entry + 2) == Some(RATIONAL))?;
        let at = self.four(entry + 8)? as usize;
        let value = f64::from(self.four(at)?) / f64::from(self.four(at.checked_add(4)?)?);
        value.is_finite().then_some(value)
    }

    fn name(&self, directory: u32, tag: u32) -> Option<String> {
        let entry = self.entry(directory, tag).filter(|&entry| self.two(entry + 2) == Some(ASCII))?;
        let length = self.four(entry + 4)? as usize;
        // Up to four bytes stand in the entry itself.
        let at = if length <= 4 { entry + 8 } else { self.four(entry + 8)? as usize };
        let bytes = self.exif.get(at..at.checked_add(length.min(LONGEST_NAME))?)?;
        let text: String = bytes.iter().take_while(|b| **b != 0).map(|b| char::from(*b)).collect();
        let text = text.trim();
        (!text.is_empty()).then(|| text.to_owned())
    }

    fn first(&self) -> Option<u32> {
        self.four(4)
    }

    /// The directory of the exposure.
    fn exposure(&self) -> Option<u32> {
        self.number(self.first()?, SUB_DIRECTORY)
    }
}

/// Width and height that the camera wrote into them.
fn size(exif: &[u8]) -> Option<(u32, u32)> {
    let tags = Tags::of(exif)?;
    let exposure = tags.exposure()?;
    Some((tags.number(exposure, WIDTH)?, tags.number(exposure, HEIGHT)?))
}

/// Whether the data are of a landscape image while this one is portrait, or the other way round.
pub(super) fn lies_otherwise(exif: &[u8], width: u32, height: u32) -> bool {
    size(exif)
        .is_some_and(|(w, h)| w > 0 && h > 0 && (w > h) != (width > height) && w != h && width != height)
}

/// The camera that took a photo, and the focal length at which it did: photos that agree in both, and in their size, share the
/// parameters of one lens.
#[derive(Clone, Debug, PartialEq)]
pub struct ExifCamera {
    /// The maker, as the file writes it; empty where it names none.
    pub make: String,
    /// The model.
    pub model: String,
    /// Focal length in millimetres, above 0.
    pub focal_mm: f64,
}

impl ExifCamera {
    /// The camera that EXIF data name; `None` where they name no model or no focal length.
    pub(super) fn of(exif: &[u8]) -> Option<ExifCamera> {
        let tags = Tags::of(exif)?;
        let (first, exposure) = (tags.first()?, tags.exposure()?);
        let focal_mm = tags.quotient(exposure, FOCAL_LENGTH).filter(|mm| *mm > 0.0)?;
        let make = tags.name(first, MAKE).unwrap_or_default();
        Some(ExifCamera { make, model: tags.name(first, MODEL)?, focal_mm })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// EXIF data of a camera in one order of bytes: directories, then what lies outside of them.
    fn exif(big: bool, model: &str, focal: (u32, u32)) -> Vec<u8> {
        let two = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() };
        let four = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
        let mut text = model.as_bytes().to_vec();
        text.push(0);
        let (exposure, outside) = (8 + 2 + 2 * 12 + 4, 8 + 2 + 2 * 12 + 4 + 2 + 12 + 4);
        let mut bytes = if big { b"MM\0*".to_vec() } else { b"II*\0".to_vec() };
        bytes.extend(four(8));
        bytes.extend(two(2));
        let mut entry = |tag: u32, kind: u32, count: u32, value: [u8; 4]| {
            bytes.extend(two(tag as u16));
            bytes.extend(two(kind as u16));
            bytes.extend(four(count));
            bytes.extend(value);
        };
        let inline = text.len() <= 4;
        let mut short = [0; 4];
        if inline {
            short[..text.len()].copy_from_slice(&text);
        }
        entry(MODEL, ASCII, text.len() as u32, if inline { short } else { four(outside + 8) });
        entry(SUB_DIRECTORY, 4, 1, four(exposure));
        bytes.extend(four(0));
        bytes.extend(two(1));
        bytes.extend(two(FOCAL_LENGTH as u16));
        bytes.extend(two(RATIONAL as u16));
        bytes.extend(four(1));
        bytes.extend(four(outside));
        bytes.extend(four(0));
        bytes.extend(four(focal.0));
        bytes.extend(four(focal.1));
        if !inline {
            bytes.extend(&text);
        }
        bytes
    }

    #[test]
    fn the_camera_and_its_focal_length_are_read_in_both_orders_of_bytes() {
        for (big, model) in [(false, "PENTAX K-5"), (true, "PENTAX K-5"), (false, "X1"), (true, "X1")] {
            let camera = ExifCamera::of(&exif(big, model, (315, 10))).expect("a camera");
            assert_eq!((camera.model.as_str(), camera.focal_mm), (model, 31.5));
        }
    }

    #[test]
    fn a_focal_length_of_nothing_is_none() {
        for focal in [(0, 10), (31, 0), (0, 0)] {
            assert_eq!(ExifCamera::of(&exif(false, "a camera", focal)), None, "{focal:?}");
        }
        let whole = exif(true, "a camera", (31, 1));
        for length in 0..whole.len() {
            assert_eq!(ExifCamera::of(&whole[..length]), None, "cut after {length} bytes");
        }
    }
}
