//! The coefficients of a progressive JPEG, of which only those are kept that a smaller image needs.

use super::bits::{BitReader, HuffmanTable, ScanFault};
use super::block::{BlockSink, CoefficientBlock, ZIGZAG};
use super::head::JpegFrame;
use std::ops::Range;

/// Those of one component.
struct CoefficientPlane {
    /// Blocks across.
    across: usize,
    /// Coefficients kept per block, across and down.
    kept: (usize, usize),
    values: Vec<i16>,
    /// Per block, which coefficients are not zero, in the order in which they are written: later scans depend on all of them.
    filled: Vec<u64>,
}

/// Those of an image.
pub(super) struct Coefficients(Vec<CoefficientPlane>);

/// One block of them.
pub(super) struct BlockSlot<'a> {
    kept: (usize, usize),
    values: &'a mut [i16],
    filled: &'a mut u64,
}

/// Bytes that [`Coefficients`] take where so many of each block are kept.
pub(super) fn bytes(frame: &JpegFrame, kept: &[(usize, usize)]) -> u64 {
    let (x, y) = frame.units();
    let blocks = |c: usize| (x * frame.components[c].h * y * frame.components[c].v) as u64;
    kept.iter().enumerate().map(|(c, k)| blocks(c) * (8 + 2 * (k.0 * k.1) as u64)).sum()
}

impl Coefficients {
    /// All zero.
    pub fn new(frame: &JpegFrame, kept: &[(usize, usize)]) -> Coefficients {
        let (x, y) = frame.units();
        let plane = |(c, &kept): (&super::head::Component, &(usize, usize))| {
            let blocks = x * c.h * y * c.v;
            let values = vec![0; blocks * kept.0 * kept.1];
            CoefficientPlane { across: x * c.h, kept, values, filled: vec![0; blocks] }
        };
        Coefficients(frame.components.iter().zip(kept).map(plane).collect())
    }

    /// The block at an index of a component.
    pub fn at(&mut self, component: usize, (x, y): (usize, usize)) -> BlockSlot<'_> {
        let plane = &mut self.0[component];
        let (i, n) = (y * plane.across + x, plane.kept.0 * plane.kept.1);
        BlockSlot {
            kept: plane.kept,
            values: &mut plane.values[i * n..(i + 1) * n],
            filled: &mut plane.filled[i],
        }
    }

    /// Hands every block on.
    pub fn emit(&self, frame: &JpegFrame, tables: &[[u16; 64]; 4], sink: &mut impl BlockSink) {
        for (c, plane) in self.0.iter().enumerate() {
            let (w, h) = plane.kept;
            if w * h == 0 {
                continue;
            }
            for (i, values) in plane.values.chunks_exact(w * h).enumerate() {
                let mut block: CoefficientBlock = [0; 64];
                for (row, line) in values.chunks_exact(w).enumerate() {
                    block[8 * row..8 * row + w].copy_from_slice(line);
                }
                sink.block(
                    c,
                    (i % plane.across, i / plane.across),
                    &block,
                    &tables[frame.components[c].table],
                );
            }
        }
    }
}

impl BlockSlot<'_> {
    /// The coefficient written as the `k`-th, if it is kept.
    fn value(&mut self, k: usize) -> Option<&mut i16> {
        let position = usize::from(ZIGZAG[k]);
        let (x, y) = (position % 8, position / 8);
        (x < self.kept.0 && y < self.kept.1).then(|| &mut self.values[y * self.kept.0 + x])
    }

    fn put(&mut self, k: usize, value: i32) {
        *self.filled |= u64::from(value != 0) << k;
        if let Some(position) = self.value(k) {
            *position = value as i16;
        }
    }

    pub fn first_dc(
        &mut self,
        bits: &mut BitReader,
        table: &HuffmanTable,
        last: &mut i32,
        low: u32,
    ) -> Result<(), ScanFault> {
        let size = table.next(bits)?;
        if size > 16 {
            return Err(ScanFault::Broken);
        }
        *last = last.wrapping_add(bits.signed(u32::from(size)));
        self.put(0, last.wrapping_shl(low));
        Ok(())
    }

    pub fn refine_dc(&mut self, bits: &mut BitReader, low: u32) {
        let bit = (bits.take(1) << low) as i16;
        if let Some(value) = self.value(0) {
            *value |= bit;
        }
    }

    pub fn first_ac(
        &mut self,
        bits: &mut BitReader,
        table: &HuffmanTable,
        band: Range<usize>,
        low: u32,
        run: &mut u32,
    ) -> Result<(), ScanFault> {
        if *run > 0 {
            *run -= 1;
            return Ok(());
        }
        let mut k = band.start;
        while k < band.end {
            let symbol = table.next(bits)?;
            let (zeros, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            match (zeros, size) {
                (15, 0) => k += 16,
                (_, 0) => {
                    *run = (1 << zeros) - 1 + bits.take(zeros);
                    return Ok(());
                }
                _ => {
                    k += zeros as usize;
                    if k >= band.end {
                        return Err(ScanFault::Broken);
                    }
                    let value = bits.signed(size) << low;
                    self.put(k, value);
                    k += 1;
                }
            }
        }
        if k > band.end { Err(ScanFault::Broken) } else { Ok(()) }
    }

    pub fn refine_ac(
        &mut self,
        bits: &mut BitReader,
        table: &HuffmanTable,
        band: Range<usize>,
        low: u32,
        run: &mut u32,
    ) -> Result<(), ScanFault> {
        let mut k = band.start;
        if *run == 0 {
            while k < band.end {
                let symbol = table.next(bits)?;
                let (zeros, size) = (u32::from(symbol >> 4), symbol & 15);
                let new = match size {
                    0 if zeros < 15 => {
                        *run = (1 << zeros) + bits.take(zeros);
                        break;
                    }
                    0 => 0,
                    1 => (2 * bits.take(1) as i32 - 1) << low,
                    _ => return Err(ScanFault::Broken),
                };
                k = self.refine(bits, k..band.end, zeros, low);
                if k < band.end {
                    self.put(k, new);
                    k += 1;
                } else if new != 0 {
                    return Err(ScanFault::Broken);
                }
            }
        }
        if *run > 0 {
            self.refine(bits, k..band.end, u32::MAX, low);
            *run -= 1;
        }
        Ok(())
    }

    /// Gives a bit to each coefficient that is not zero, up to the one that follows `zeros` that are; where that is.
    fn refine(&mut self, bits: &mut BitReader, band: Range<usize>, mut zeros: u32, low: u32) -> usize {
        for k in band.clone() {
            if *self.filled >> k & 1 == 0 {
                if zeros == 0 {
                    return k;
                }
                zeros -= 1;
            } else if bits.take(1) == 1
                && let Some(value) = self.value(k)
                && *value & (1 << low) == 0
            {
                let bit = 1i16 << low;
                *value = value.saturating_add(if *value > 0 { bit } else { -bit });
            }
        }
        band.end
    }
}
