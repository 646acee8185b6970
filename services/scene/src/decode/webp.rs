//! WEBPs: how large their chunks and their frame are. Their decoder allocates memory for both before it compares them with the
//! file and with the canvas.

use super::DecodeError;
use std::io::{Read, Seek, SeekFrom};

/// Most bytes of EXIF data, of a colour profile, or of XMP data.
const MOST_METADATA: u64 = 16 << 20;
/// Most chunks of a file; each frame of an animation is one.
const MOST_CHUNKS: u32 = 65_536;
/// Bytes of a chunk's head: its kind and its length.
const HEAD: u64 = 8;
/// Bytes of an animation's frame before the chunks within it.
const FRAME_HEAD: u64 = 16;

const TOO_LONG: &str =
    "the WEBP claims more than 16 MiB of EXIF data, a profile or XMP data: it is damaged; copy it again";
const CUT_SHORT: &str =
    "a chunk of the WEBP is longer than the file: it is cut short or damaged; copy it again";
const OTHER_SIZE: &str =
    "the frame of the WEBP has another size than its canvas: it is damaged; copy it again";
const TOO_MANY: &str = "the WEBP has more than 65,536 chunks: it is damaged; copy it again";

/// A chunk as its head claims it.
struct RiffChunk {
    kind: [u8; 4],
    /// Where its data start.
    start: u64,
    /// Bytes of its data.
    length: u64,
}

impl RiffChunk {
    fn end(&self) -> u64 {
        self.start + self.length
    }

    /// Bytes of its data with the one that may fill them up to an even number, as the decoder counts them.
    fn filled(&self) -> u64 {
        (self.length + self.length % 2).min(u64::from(u32::MAX))
    }

    /// Where the next chunk is.
    fn next(&self) -> u64 {
        self.start + self.filled()
    }

    /// What is wrong where it is metadata, which are read whole, and too long.
    fn too_long(&self) -> Option<&'static str> {
        let metadata = matches!(&self.kind, b"EXIF" | b"ICCP" | b"XMP ");
        (metadata && self.length > MOST_METADATA).then_some(TOO_LONG)
    }
}

/// Chunks of a file, and sizes within them.
struct WebpReader<R> {
    file: R,
}

impl<R: Read + Seek> WebpReader<R> {
    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes).ok()?;
        Some(bytes)
    }

    /// Reads the head of the chunk at a position; its data are next.
    fn chunk(&mut self, at: u64) -> Option<RiffChunk> {
        self.file.seek(SeekFrom::Start(at)).ok()?;
        let kind = self.bytes::<4>()?;
        let length = u64::from(u32::from_le_bytes(self.bytes::<4>()?));
        Some(RiffChunk { kind, start: at + HEAD, length })
    }

    /// Width and height of the canvas, from the data of `VP8X`.
    fn canvas(&mut self) -> Option<(u32, u32)> {
        let [_, _, _, _, w0, w1, w2, h0, h1, h2] = self.bytes::<10>()?;
        let side = |a: u8, b: u8, c: u8| u32::from_le_bytes([a, b, c, 0]) + 1;
        Some((side(w0, w1, w2), side(h0, h1, h2)))
    }

    /// Width and height of the frame whose data are next; `None` where there is none, or none that the decoder takes.
    fn frame(&mut self, kind: [u8; 4]) -> Option<(u32, u32)> {
        match &kind {
            b"VP8 " => {
                let [_, _, _, 0x9d, 0x01, 0x2a, w0, w1, h0, h1] = self.bytes::<10>()? else { return None };
                let side = |low: u8, high: u8| u32::from(u16::from_le_bytes([low, high]) & 0x3fff);
                Some((side(w0, w1), side(h0, h1)))
            }
            b"VP8L" => {
                let [0x2f, a, b, c, d] = self.bytes::<5>()? else { return None };
                let sides = u32::from_le_bytes([a, b, c, d]);
                Some(((sides & 0x3fff) + 1, ((sides >> 14) & 0x3fff) + 1))
            }
            _ => None,
        }
    }

    /// The first two chunks within an animation's frame are known to the decoder, too.
    fn too_long_within(&mut self, frame: &RiffChunk) -> Option<&'static str> {
        let first = self.chunk(frame.start + FRAME_HEAD)?;
        first.too_long().or_else(|| self.chunk(first.next())?.too_long())
    }

    /// Looks for what is wrong in a file of `length` bytes. What ends too soon is left to the decoder.
    fn damage(&mut self, length: u64) -> Option<&'static str> {
        let file = self.chunk(0)?;
        let mut chunk = self.chunk(file.start + 4)?;
        let canvas = if &chunk.kind == b"VP8X" { Some(self.canvas()?) } else { None };
        // The decoder reads chunks up to here. What follows the file's own end is perhaps none.
        let end = file.end() + chunk.filled();
        for _ in 0..MOST_CHUNKS {
            if let Some(reason) = chunk.too_long() {
                return Some(reason);
            }
            if chunk.start <= file.end() && chunk.end() > length {
                return Some(CUT_SHORT);
            }
            // The data of `VP8X` are read already; it is no frame.
            let frame = self.frame(chunk.kind);
            if canvas.is_some() && frame.is_some() && frame != canvas {
                return Some(OTHER_SIZE);
            }
            if &chunk.kind == b"ANMF"
                && let Some(reason) = self.too_long_within(&chunk)
            {
                return Some(reason);
            }
            // Without a canvas the decoder reads this chunk alone.
            if canvas.is_none() || chunk.next() >= end {
                return None;
            }
            chunk = self.chunk(chunk.next())?;
        }
        Some(TOO_MANY)
    }
}

/// Refuses a file of `length` bytes with a chunk that these cannot hold or that is far too long, or with a frame of another size
/// than the canvas. The frames of an animation may be smaller.
pub(crate) fn check_chunks(file: impl Read + Seek, length: u64) -> Result<(), DecodeError> {
    WebpReader { file }.damage(length).map_or(Ok(()), |reason| Err(DecodeError::Malformed(reason)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Kind, claimed length, data.
    type Claim<'a> = (&'a [u8; 4], u32, &'a [u8]);

    const CANVAS: Claim<'static> = (b"VP8X", 10, &[0, 0, 0, 0, 9, 0, 0, 9, 0, 0]);
    const LARGE: Claim<'static> = (b"VP8 ", 10, &[0, 0, 0, 0x9d, 0x01, 0x2a, 0xff, 0x3f, 0xff, 0x3f]);

    /// The message about a file of such chunks with so many bytes of holes behind them.
    fn check(chunks: &[Claim<'_>], holes: u64) -> String {
        let mut file = b"RIFF\0\0\x01\0WEBP".to_vec();
        for (kind, length, data) in chunks {
            file.extend_from_slice(&kind[..]);
            file.extend(length.to_le_bytes());
            file.extend_from_slice(data);
        }
        let length = file.len() as u64 + holes;
        check_chunks(std::io::Cursor::new(file), length).map_or_else(|e| e.to_string(), |()| String::new())
    }

    #[test]
    fn a_webp_whose_frame_is_larger_than_its_canvas_is_refused() {
        let lossless: Claim<'_> = (b"VP8L", 5, &[0x2f, 0xff, 0xff, 0xff, 0x0f, 0]);
        for frame in [LARGE, lossless] {
            assert!(check(&[CANVAS, frame], 0).contains("another size than its canvas"));
            assert_eq!(check(&[frame], 0), "");
        }
        let lossy: Claim<'_> = (b"VP8 ", 10, &[0, 0, 0, 0x9d, 0x01, 0x2a, 10, 0, 10, 0]);
        let lossless: Claim<'_> = (b"VP8L", 5, &[0x2f, 0x09, 0x40, 0x02, 0, 0]);
        assert_eq!(check(&[CANVAS, lossy, lossless], 0), "");
        // Within the frame of an animation.
        let data = [&[0u8; 16][..], b"VP8 \x0a\0\0\0", LARGE.2].concat();
        assert_eq!(check(&[CANVAS, (b"ANMF", 34, &data)], 0), "");
    }

    #[test]
    fn a_webp_that_claims_4_gib_of_exif_data_is_refused_before_they_are_read() {
        let exif: Claim<'_> = (b"EXIF", u32::MAX, b"");
        assert!(check(&[CANVAS, exif], 8 << 30).contains("more than 16 MiB of EXIF data"));
        let data = [&[0u8; 16][..], b"EXIF\xff\xff\xff\xff"].concat();
        assert!(check(&[CANVAS, (b"ANMF", 24, &data)], 8 << 30).contains("more than 16 MiB of EXIF data"));
        assert!(check(&[CANVAS, (b"EXIF", 100, b"cut")], 0).contains("longer than the file"));
    }
}
