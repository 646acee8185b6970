//! Walks through the scans of a JPEG, block by block.

use super::bits::{BitReader, HuffmanTable, ScanFault};
use super::block::{BlockSink, CoefficientBlock, ZIGZAG};
use super::head::{Coding, JpegFrame, is_frame};
use super::progressive::Coefficients;

/// Scans of one image; encoders write ten or so, and each goes through the whole image.
const MOST_SCANS: u32 = 100;

/// The result of a walk through the scans.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ScanResult {
    /// What is wrong with the data.
    pub short: bool,
    /// The data hold what cannot be.
    pub broken: bool,
    /// Share of the image that comes before that, in [0, 1].
    pub good: f64,
    /// Bytes of data that no block has used.
    pub left: u64,
}

/// One component of a scan.
#[derive(Clone, Copy)]
struct ScanPart {
    component: usize,
    dc: usize,
    ac: usize,
}

/// A scan's header.
struct Scan {
    parts: Vec<ScanPart>,
    /// First and last coefficient.
    band: (usize, usize),
    /// The bit before and the bit that this scan brings.
    high: u32,
    low: u32,
}

/// Tables and state between segments.
struct ScanWalk<'a> {
    bytes: &'a [u8],
    frame: &'a JpegFrame,
    dc: [Option<HuffmanTable>; 4],
    ac: [Option<HuffmanTable>; 4],
    tables: [[u16; 64]; 4],
    interval: usize,
    coefficients: Option<Coefficients>,
    /// Per component, the coefficients whose last bit is there, a bit each.
    complete: Vec<u64>,
    found: ScanResult,
}

/// Decodes the scans of a JPEG whose frame is known; `None` where it is coded in a way not known here.
pub(super) fn walk(bytes: &[u8], frame: &JpegFrame, sink: &mut impl BlockSink) -> Option<ScanResult> {
    if frame.coding == Coding::Other || frame.components.is_empty() || frame.components.len() > 4 {
        return None;
    }
    let progressive = frame.coding == Coding::Progressive;
    let wanted: Vec<(usize, usize)> = (0..frame.components.len()).map(|c| sink.wanted(c)).collect();
    let mut walk = ScanWalk {
        bytes,
        frame,
        dc: [const { None }; 4],
        ac: [const { None }; 4],
        tables: [[1; 64]; 4],
        interval: 0,
        coefficients: progressive.then(|| Coefficients::new(frame, &wanted)),
        complete: vec![0; frame.components.len()],
        found: ScanResult::default(),
    };
    if let Err(fault) = walk.segments(sink) {
        (walk.found.short, walk.found.broken) = (fault == ScanFault::Short, fault == ScanFault::Broken);
    }
    if let Some(coefficients) = &walk.coefficients {
        coefficients.emit(frame, &walk.tables, sink);
    }
    Some(walk.found)
}

impl ScanWalk<'_> {
    fn segments(&mut self, sink: &mut impl BlockSink) -> Result<(), ScanFault> {
        let (mut at, mut scans) = (2, 0);
        loop {
            let Some(marker) = self.next_marker(&mut at) else { return self.end(true) };
            if marker == 0xd9 {
                return self.end(false);
            }
            let Some(length) = self.bytes.get(at..at + 2) else { return self.end(true) };
            let length = usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
            let Some(data) = self.bytes.get(at + 2..at + length) else { return self.end(true) };
            at += length;
            match marker {
                0xc4 => self.huffman(data)?,
                0xdb => self.quantisation(data)?,
                0xdd => self.interval = data.first_chunk::<2>().map_or(0, |b| u16::from_be_bytes(*b).into()),
                0xda if scans == MOST_SCANS => return Err(ScanFault::Broken),
                0xda => {
                    scans += 1;
                    at = self.scan(data, at, sink)?;
                }
                // A second frame is a hierarchical file's.
                m if is_frame(m) && self.complete.iter().any(|&c| c != 0) => return Err(ScanFault::Broken),
                _ => {}
            }
        }
    }

    /// The next marker; bytes that are none are passed over, as other programs do.
    fn next_marker(&mut self, at: &mut usize) -> Option<u8> {
        loop {
            match (self.bytes.get(*at)?, self.bytes.get(*at + 1)?) {
                (0xff, 0x00 | 0x01 | 0xd0..=0xd8) => *at += 2,
                (0xff, 0xff) => *at += 1,
                (0xff, marker) => {
                    *at += 2;
                    return Some(*marker);
                }
                _ => *at += 1,
            }
        }
    }

    /// Whether every block of every component has come; `cut`: the file has no end.
    fn end(&mut self, cut: bool) -> Result<(), ScanFault> {
        let wanted = if cut { u64::MAX } else { 1 };
        let there = self.complete.iter().filter(|&&c| c & wanted == wanted).count();
        if there == self.complete.len() {
            return Ok(());
        }
        self.found.good = there as f64 / self.complete.len() as f64;
        Err(if cut { ScanFault::Short } else { ScanFault::Broken })
    }

    fn huffman(&mut self, mut data: &[u8]) -> Result<(), ScanFault> {
        while let [which, rest @ ..] = data {
            let counts = rest.first_chunk::<16>().ok_or(ScanFault::Broken)?;
            let n: usize = counts.iter().map(|&c| usize::from(c)).sum();
            let symbols = rest.get(16..16 + n).ok_or(ScanFault::Broken)?;
            let table = HuffmanTable::new(counts, symbols).ok_or(ScanFault::Broken)?;
            let position = usize::from(which & 3);
            match which >> 4 {
                0 => self.dc[position] = Some(table),
                _ => self.ac[position] = Some(table),
            }
            data = &rest[16 + n..];
        }
        Ok(())
    }

    fn quantisation(&mut self, mut data: &[u8]) -> Result<(), ScanFault> {
        while let [which, rest @ ..] = data {
            let wide = which >> 4 > 0;
            let n = if wide { 128 } else { 64 };
            let values = rest.get(..n).ok_or(ScanFault::Broken)?;
            let table = &mut self.tables[usize::from(which & 3)];
            for (k, &position) in ZIGZAG.iter().enumerate() {
                table[usize::from(position)] = match wide {
                    true => u16::from_be_bytes([values[2 * k], values[2 * k + 1]]),
                    false => u16::from(values[k]),
                };
            }
            data = &rest[n..];
        }
        Ok(())
    }

    fn scan_header(&self, data: &[u8]) -> Option<Scan> {
        let [n, rest @ ..] = data else { return None };
        let n = usize::from(*n);
        let part = |c: &[u8]| {
            let component = self.frame.components.iter().position(|known| known.id == c[0])?;
            Some(ScanPart { component, dc: usize::from(c[1] >> 4 & 3), ac: usize::from(c[1] & 3) })
        };
        let parts: Vec<ScanPart> = rest.get(..2 * n)?.chunks_exact(2).map(part).collect::<Option<_>>()?;
        let &[first, last, bits] = rest.get(2 * n..2 * n + 3)? else { return None };
        let (band, high, low) = match self.frame.coding {
            Coding::Baseline => ((0, 63), 0, 0),
            _ => ((usize::from(first), usize::from(last)), u32::from(bits >> 4), u32::from(bits & 15)),
        };
        let sane = !parts.is_empty() && band.0 <= band.1 && band.1 < 64 && low < 14;
        let alone = band.0 == 0 || parts.len() == 1;
        let dc_alone = self.frame.coding == Coding::Baseline || band.0 > 0 || band.1 == 0;
        (sane && alone && dc_alone).then_some(Scan { parts, band, high, low })
    }

    /// Goes through the data of a scan, which begin at `at`; where they end.
    fn scan(&mut self, header: &[u8], at: usize, sink: &mut impl BlockSink) -> Result<usize, ScanFault> {
        let scan = self.scan_header(header).ok_or(ScanFault::Broken)?;
        self.has_tables(&scan)?;
        let (units_x, units_y) = self.frame.units();
        let (most_h, most_v) = self.frame.most();
        // A component alone comes block by block, without those that only fill the last units.
        let alone = (scan.parts.len() == 1).then(|| {
            let c = self.frame.components[scan.parts[0].component];
            let size = |pixels: usize, own: usize, most: usize| (pixels * own).div_ceil(most).div_ceil(8);
            (size(self.frame.width, c.h, most_h), size(self.frame.height, c.v, most_v))
        });
        let (across, down) = alone.unwrap_or((units_x, units_y));
        let mut bits = BitReader::new(self.bytes, at);
        let (mut last_dc, mut run) = ([0i32; 4], 0u32);
        for unit in 0..across * down {
            if self.interval > 0 && unit > 0 && unit % self.interval == 0 {
                bits.restart((unit / self.interval - 1) as u32)
                    .map_err(|f| self.at_unit(f, unit, across * down))?;
                (last_dc, run) = ([0; 4], 0);
            }
            let position = (unit % across, unit / across);
            let done = self.unit(&scan, alone.is_some(), position, &mut bits, &mut last_dc, &mut run, sink);
            done.and_then(|()| bits.check()).map_err(|f| self.at_unit(f, unit, across * down))?;
        }
        let bit = |k: usize| if scan.low == 0 { 1u64 << k } else { 0 };
        let brought: u64 = (scan.band.0..=scan.band.1).map(bit).sum();
        for part in &scan.parts {
            // The first scan of the lowest coefficient brings an image, if a coarse one.
            self.complete[part.component] |= brought | u64::from(scan.band.0 == 0);
        }
        self.found.left += bits.leave() as u64;
        Ok(bits.at)
    }

    /// Notes how far a scan came.
    fn at_unit(&mut self, fault: ScanFault, unit: usize, of: usize) -> ScanFault {
        self.found.good = unit as f64 / of.max(1) as f64;
        fault
    }

    fn has_tables(&self, scan: &Scan) -> Result<(), ScanFault> {
        let dc = scan.band.0 == 0 && scan.high == 0;
        let ac = scan.band.1 > 0;
        let has = |p: &ScanPart| (!dc || self.dc[p.dc].is_some()) && (!ac || self.ac[p.ac].is_some());
        if scan.parts.iter().all(has) { Ok(()) } else { Err(ScanFault::Broken) }
    }

    /// The blocks of one unit.
    fn unit(
        &mut self,
        scan: &Scan,
        alone: bool,
        (x, y): (usize, usize),
        bits: &mut BitReader,
        last_dc: &mut [i32; 4],
        run: &mut u32,
        sink: &mut impl BlockSink,
    ) -> Result<(), ScanFault> {
        for part in &scan.parts {
            let c = self.frame.components[part.component];
            let (h, v) = if alone { (1, 1) } else { (c.h, c.v) };
            for k in 0..h * v {
                let at = (x * h + k % h, y * v + k / h);
                let last = &mut last_dc[part.component];
                let (dc, ac) = (self.dc[part.dc].as_ref(), self.ac[part.ac].as_ref());
                match &mut self.coefficients {
                    None => {
                        let (Some(dc), Some(ac)) = (dc, ac) else { return Err(ScanFault::Broken) };
                        let table = &self.tables[c.table];
                        let block = baseline(bits, dc, ac, last)?;
                        in_range(block[0].into(), table)?;
                        sink.block(part.component, at, &block, table);
                    }
                    Some(coefficients) => {
                        let mut block = coefficients.at(part.component, at);
                        let (first, end) = scan.band;
                        match (first, scan.high) {
                            (0, 0) => {
                                block.first_dc(bits, dc.ok_or(ScanFault::Broken)?, last, scan.low)?;
                                in_range(last.wrapping_shl(scan.low), &self.tables[c.table])?;
                            }
                            (0, _) => block.refine_dc(bits, scan.low),
                            (_, 0) => {
                                block.first_ac(
                                    bits,
                                    ac.ok_or(ScanFault::Broken)?,
                                    first..end + 1,
                                    scan.low,
                                    run,
                                )?;
                            }
                            _ => block.refine_ac(
                                bits,
                                ac.ok_or(ScanFault::Broken)?,
                                first..end + 1,
                                scan.low,
                                run,
                            )?,
                        }
                    }
                }
            }
        }
        Ok(())
    }
}

/// Largest mean of a block, times eight, that an encoder writes: of eight bits it is 1,024, and some overshoot it on purpose.
const BRIGHTEST: i32 = 1536;

/// Refuses a block that is brighter than white, or darker than black, by far: the sum of differences has gone astray.
fn in_range(mean: i32, table: &[u16; 64]) -> Result<(), ScanFault> {
    let step = i32::from(table[0]);
    if mean.saturating_mul(step).unsigned_abs() > (BRIGHTEST + step).unsigned_abs() {
        Err(ScanFault::Broken)
    } else {
        Ok(())
    }
}

/// A block of a baseline scan.
#[inline]
fn baseline(
    bits: &mut BitReader,
    dc: &HuffmanTable,
    ac: &HuffmanTable,
    last: &mut i32,
) -> Result<CoefficientBlock, ScanFault> {
    let mut block = [0i16; 64];
    let size = dc.next(bits)?;
    if size > 16 {
        return Err(ScanFault::Broken);
    }
    *last = last.wrapping_add(bits.signed(u32::from(size)));
    block[0] = *last as i16;
    let mut k = 1;
    while k < 64 {
        let symbol = ac.next(bits)?;
        let (zeros, size) = (usize::from(symbol >> 4), u32::from(symbol & 15));
        if size == 0 {
            if zeros < 15 {
                break;
            }
            k += 16;
            continue;
        }
        k += zeros;
        if k > 63 {
            return Err(ScanFault::Broken);
        }
        block[usize::from(ZIGZAG[k])] = bits.signed(size) as i16;
        k += 1;
    }
    // A run of 16 zeros that goes past the end of the block is no encoder's.
    if k > 64 { Err(ScanFault::Broken) } else { Ok(block) }
}
