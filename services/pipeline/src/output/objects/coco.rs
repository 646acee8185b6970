//! COCO instance annotations with compressed run lengths, as pycocotools reads them.

use crate::{ExportProvenance, ObjectProvenance};
use segwild_scene::Mask;
use serde::Serialize;

/// A whole annotation file.
#[derive(Debug, Serialize)]
pub(super) struct CocoFile {
    pub info: CocoInfo,
    pub images: Vec<CocoImage>,
    pub categories: Vec<CocoCategory>,
    pub annotations: Vec<CocoAnnotation>,
}

/// Who wrote the file.
#[derive(Debug, Serialize)]
pub(super) struct CocoInfo {
    pub description: &'static str,
    pub version: &'static str,
    pub provenance: ExportProvenance,
}

impl CocoFile {
    /// A file without photos; its categories are the objects of `provenance`, numbered from 1.
    pub fn of(provenance: ExportProvenance) -> CocoFile {
        let category = |(object, id): (&ObjectProvenance, usize)| CocoCategory {
            id,
            name: object.name.clone(),
            supercategory: "object",
        };
        let categories = provenance.objects.iter().zip(1..).map(category).collect();
        let description = "objects of a splat scene, by segwild";
        let info = CocoInfo { description, version: env!("CARGO_PKG_VERSION"), provenance };
        CocoFile { info, images: Vec::new(), categories, annotations: Vec::new() }
    }
}

/// A photo.
#[derive(Debug, Serialize)]
pub(super) struct CocoImage {
    pub id: usize,
    pub file_name: String,
    pub width: u32,
    pub height: u32,
}

/// An object of the scene: it is one category, so that its masks on all photos belong together.
#[derive(Debug, Serialize)]
pub(super) struct CocoCategory {
    pub id: usize,
    pub name: String,
    pub supercategory: &'static str,
}

/// An object's mask on a photo.
#[derive(Debug, Serialize)]
pub(super) struct CocoAnnotation {
    pub id: usize,
    pub image_id: usize,
    pub category_id: usize,
    /// x, y, width, height.
    pub bbox: [u32; 4],
    /// Pixels.
    pub area: usize,
    pub segmentation: CocoRle,
    pub iscrowd: u8,
}

/// A mask as runs down the columns: outside first, then inside, and so on.
#[derive(Debug, PartialEq, Serialize)]
pub(super) struct CocoRle {
    /// Height, width.
    pub size: [u32; 2],
    pub counts: String,
}

impl CocoRle {
    pub fn of(mask: &Mask) -> CocoRle {
        let (width, height) = (mask.width(), mask.height());
        let mut columns = vec![(u32::MAX, 0u32); width as usize];
        for (x, y) in mask.pixels() {
            let (low, high) = &mut columns[x as usize];
            (*low, *high) = ((*low).min(y), (*high).max(y + 1));
        }
        let (mut counts, mut run, mut inside) = (Vec::new(), 0u64, false);
        for (x, &(low, high)) in columns.iter().enumerate() {
            // Above and below its pixels a column is outside.
            let (low, high) = if low < high { (low, high) } else { (height, height) };
            let mut put = |pixels: u32, is: bool| {
                if pixels > 0 && is != inside {
                    counts.push(run);
                    (run, inside) = (0, is);
                }
                run += u64::from(pixels);
            };
            put(low, false);
            (low..high).for_each(|y| put(1, mask.get(x as u32, y)));
            put(height - high, false);
        }
        counts.push(run);
        CocoRle { size: [height, width], counts: compressed(&counts) }
    }
}

/// Runs as pycocotools writes them: from the third on the difference to the one before the last, in groups of five bits from the
/// lowest, the sixth bit set where another follows, as characters from `0` on.
fn compressed(counts: &[u64]) -> String {
    let mut text = String::new();
    for (i, &count) in counts.iter().enumerate() {
        let before = if i > 2 { counts[i - 2] as i64 } else { 0 };
        let mut x = count as i64 - before;
        loop {
            let mut group = x & 0x1f;
            x >>= 5;
            let more = if group & 0x10 != 0 { x != -1 } else { x != 0 };
            if more {
                group |= 0x20;
            }
            text.push(char::from(48 + group as u8));
            if !more {
                break;
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of pycocotools 2.0.11, `mask.encode(np.asfortranarray(m))`.
    #[test]
    fn run_lengths_are_those_of_pycocotools() {
        let block = Mask::from_fn(7, 5, |x, y| (2..5).contains(&x) && (1..4).contains(&y));
        assert_eq!(CocoRle::of(&block), CocoRle { size: [5, 7], counts: BLOCK.into() });
        let ring = Mask::from_fn(200, 100, |x, y| {
            let r = (i64::from(x) - 90).pow(2) + (i64::from(y) - 40).pow(2);
            (400..1600).contains(&r)
        });
        assert_eq!(CocoRle::of(&ring).counts, RING);
        let corner = Mask::from_fn(4, 3, |x, y| x == 0 && y == 0 || x == 3);
        assert_eq!(CocoRle::of(&corner).counts, CORNER);
        assert_eq!(CocoRle::of(&Mask::empty(4, 3)).counts, NOTHING);
    }

    const BLOCK: &str = ";320009";
    const RING: &str = "\\P5a0_28I6K4L4L4M2N2M4M2N2N2N2N2N2O0O2N2N2O0OhN_O0`0ND0;OI06OL03O10NO40LO60I170HO:0FO<0D0<0C0?0@0`00@Ob00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O0b00^O1`00@0`00A0=0D0<0D1:0F180IO70J140L120O1M041J071E0<2@0a0X1101N2N2N101N2N2N2N2N2N3L3N2N3L4L4L5J7Hli6";
    const CORNER: &str = "0182";
    const NOTHING: &str = "<";
}
