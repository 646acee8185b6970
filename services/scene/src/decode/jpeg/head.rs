//! The segments before and between the scans of a JPEG.

use crate::decode::DecodeError;
use std::io::{BufRead, Read};

/// One plane of the image as the frame declares it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Component {
    pub id: u8,
    /// Samples across and down per unit of the frame, 1 to 4.
    pub h: usize,
    pub v: usize,
    /// Quantisation table.
    pub table: usize,
}

/// How the frame is coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Coding {
    /// Each block in one piece.
    Baseline,
    /// Coefficients come in several scans.
    Progressive,
    /// Arithmetic, lossless, hierarchical, 12 bits: not known here.
    Other,
}

/// The frame's header.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct JpegFrame {
    pub width: usize,
    pub height: usize,
    pub coding: Coding,
    pub components: Vec<Component>,
}

/// The result of a pass over the file.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct JpegHead {
    pub frame: JpegFrame,
    /// The EXIF data, without their name.
    pub exif: Option<Vec<u8>>,
    /// Bytes up to and with the end marker, or of the file where there is none.
    pub bytes: u64,
    /// Whether there is an end marker.
    pub ended: bool,
}

impl JpegFrame {
    /// Reads a start-of-frame segment, its length left out.
    pub fn parse(marker: u8, data: &[u8]) -> Option<JpegFrame> {
        let [bits, h1, h0, w1, w0, n, rest @ ..] = data else { return None };
        let component = |c: &[u8]| Component {
            id: c[0],
            h: usize::from(c[1] >> 4),
            v: usize::from(c[1] & 15),
            table: usize::from(c[2]),
        };
        let components: Vec<Component> = rest.chunks_exact(3).take(usize::from(*n)).map(component).collect();
        let sane = |c: &Component| (1..=4).contains(&c.h) && (1..=4).contains(&c.v) && c.table < 4;
        let known = *bits == 8 && components.len() == usize::from(*n) && components.iter().all(sane);
        let coding = match marker {
            0xc0 | 0xc1 if known => Coding::Baseline,
            0xc2 if known => Coding::Progressive,
            _ => Coding::Other,
        };
        let two = |a: u8, b: u8| usize::from(u16::from_be_bytes([a, b]));
        Some(JpegFrame { width: two(*w1, *w0), height: two(*h1, *h0), coding, components })
    }

    /// Samples of the component that is sampled most, across and down.
    pub fn most(&self) -> (usize, usize) {
        let most = |of: fn(&Component) -> usize| self.components.iter().map(of).max().unwrap_or(1).max(1);
        (most(|c| c.h), most(|c| c.v))
    }

    /// Units of interleaved scans, across and down.
    pub fn units(&self) -> (usize, usize) {
        let (h, v) = self.most();
        (self.width.div_ceil(8 * h), self.height.div_ceil(8 * v))
    }

    /// Samples of all planes, padded to whole units.
    pub fn samples(&self) -> u64 {
        let (x, y) = self.units();
        self.components.iter().map(|c| 64 * (x * c.h * y * c.v) as u64).sum()
    }
}

/// The markers that begin a frame.
pub(super) fn is_frame(marker: u8) -> bool {
    matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc)
}

const EXIF: &[u8] = b"Exif\0\0";

/// A reader that counts.
struct CountingReader<R> {
    inner: R,
    at: u64,
}

impl<R: BufRead> CountingReader<R> {
    fn byte(&mut self) -> std::io::Result<Option<u8>> {
        let byte = self.inner.fill_buf()?.first().copied();
        self.skip(usize::from(byte.is_some()));
        Ok(byte)
    }

    fn skip(&mut self, n: usize) {
        self.inner.consume(n);
        self.at += n as u64;
    }

    /// Goes on to the next byte of value 255; whether there is one.
    fn find_marker(&mut self) -> std::io::Result<bool> {
        loop {
            let buffer = self.inner.fill_buf()?;
            if buffer.is_empty() {
                return Ok(false);
            }
            let found = buffer.iter().position(|&b| b == 0xff);
            let n = found.unwrap_or(buffer.len());
            self.skip(n);
            if found.is_some() {
                return Ok(true);
            }
        }
    }

    /// Takes what is there of the next `n` bytes.
    fn take(&mut self, n: usize) -> std::io::Result<Vec<u8>> {
        let mut data = Vec::new();
        self.at += self.inner.by_ref().take(n as u64).read_to_end(&mut data)? as u64;
        Ok(data)
    }
}

/// Walks from segment to segment up to the end marker of the first image: thumbnails inside of segments have ends of their own,
/// and what follows it (a second image, a trailer) is no part of it.
///
/// # Errors
/// There is no frame, or the system refuses.
pub(crate) fn read(reader: impl BufRead) -> Result<JpegHead, DecodeError> {
    let mut reader = CountingReader { inner: reader, at: 0 };
    let (mut frame, mut exif) = (None, None);
    let mut ended = false;
    reader.take(2)?;
    while reader.find_marker()? {
        reader.skip(1);
        let mut marker = reader.byte()?;
        while marker == Some(0xff) {
            marker = reader.byte()?;
        }
        match marker {
            None => break,
            Some(0xd9) => {
                ended = true;
                break;
            }
            // Stuffed bytes of the entropy-coded data, restart markers.
            Some(0x00 | 0x01 | 0xd0..=0xd8) => {}
            Some(marker) => {
                let length = reader.take(2)?;
                let Ok(length) = <[u8; 2]>::try_from(length) else { break };
                let wanted = usize::from(u16::from_be_bytes(length)).saturating_sub(2);
                let data = reader.take(wanted)?;
                if is_frame(marker) && frame.is_none() {
                    frame = JpegFrame::parse(marker, &data);
                }
                if marker == 0xe1 && exif.is_none() && data.starts_with(EXIF) {
                    exif = Some(data[EXIF.len()..].to_vec());
                }
            }
        }
    }
    match frame {
        Some(frame) => Ok(JpegHead { frame, exif, bytes: reader.at, ended }),
        None if ended => Err(DecodeError::Malformed("the JPEG has no frame")),
        None => Err(DecodeError::NoFrame),
    }
}
