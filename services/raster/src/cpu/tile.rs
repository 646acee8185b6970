//! The walk that all kernels share: a tile's splats front to back, each over the pixels it reaches.
//!
//! A tile keeps its pixels in rows of [`STRIDE`] numbers. Blocks of eight pixels start wherever a splat's row
//! starts; the columns beyond the tile have T = 0, so a block that hangs over does nothing there.

use super::bin::{Bins, HEIGHT, TileEntry, WIDTH};
use super::project::{ALPHA_MAX, ALPHA_MIN, LOG2_ALPHA_MIN, SLACK, SplatFootprint, T_MIN};
use super::simd::{LANES, Simd};

/// Numbers per row of a tile.
pub(crate) const STRIDE: usize = WIDTH + LANES;
/// Numbers per plane of a tile.
pub(crate) const PLANE: usize = HEIGHT * STRIDE;
/// Splats after which transmittance of the rows is checked again.
const CHECK: usize = 8;

/// How many splats ahead memory is prefetched.
const AHEAD: usize = 6;

/// A tile's part of one plane.
#[derive(Clone, Copy)]
#[repr(align(32))]
pub(crate) struct TilePlane(pub [f32; PLANE]);

impl TilePlane {
    pub const ZERO: TilePlane = TilePlane([0.0; PLANE]);
}

/// Where a tile lies.
#[derive(Clone, Copy)]
pub(crate) struct TileExtent {
    pub x: usize,
    pub y: usize,
    /// Pixels of the tile inside the frame.
    pub width: usize,
    pub height: usize,
}

impl TileExtent {
    pub fn of(bins: &Bins, tile: usize, width: usize, height: usize) -> TileExtent {
        let (x, y) = (tile % bins.columns * WIDTH, tile / bins.columns * HEIGHT);
        TileExtent { x, y, width: WIDTH.min(width - x), height: HEIGHT.min(height - y) }
    }

    /// Copies the tile's part of an image plane.
    #[inline(always)]
    pub fn read(&self, plane: &[f32], width: usize, into: &mut TilePlane) {
        for row in 0..self.height {
            let from = (self.y + row) * width + self.x;
            let to = &mut into.0[row * STRIDE..row * STRIDE + self.width];
            copy_row(to, &plane[from..from + self.width]);
        }
    }
}

/// Copies a row of a tile. Most are whole, and a copy of known size is a few registers instead of a call.
#[inline(always)]
pub(crate) fn copy_row(to: &mut [f32], from: &[f32]) {
    match (<&mut [f32; WIDTH]>::try_from(&mut *to), <&[f32; WIDTH]>::try_from(from)) {
        (Ok(to), Ok(from)) => *to = *from,
        _ => to.copy_from_slice(from),
    }
}

/// Eight pixels of one row under one splat.
pub(crate) struct PixelBlock<S: Simd> {
    /// Index of the first pixel in a [`TilePlane`]; eight numbers from here on are inside it.
    pub at: usize,
    /// `dx - slope dy` per pixel.
    pub u: S::F,
    /// Opacity at the pixel, at most [`ALPHA_MAX`]; meaningless where not `hit`.
    pub alpha: S::F,
    /// Whether alpha is below [`ALPHA_MAX`], so that it follows the splat's parameters.
    pub free: S::M,
    /// Where the splat is blended.
    pub hit: S::M,
    /// `alpha T`; 0 where nothing is blended.
    pub weight: S::F,
}

/// Callbacks of a kernel on the walk. Implementations are `#[inline(always)]`.
pub(crate) trait TileVisitor<S: Simd> {
    /// A splat will come soon.
    fn prepare(&mut self, _s: S, _entry: &TileEntry) {}
    /// A splat starts.
    fn start_splat(&mut self, s: S, entry: &TileEntry);
    /// A row of the splat starts, `dy` below its centre.
    fn row(&mut self, _s: S, _dy: f32) {}
    /// Eight pixels, left to right.
    fn block(&mut self, s: S, footprint: &SplatFootprint, block: &PixelBlock<S>);
    /// The row ends.
    fn row_end(&mut self, _s: S) {}
    /// The splat ends.
    fn end(&mut self, _s: S, _footprint: &SplatFootprint, _entry: &TileEntry) {}
    /// No transmittance is left for this splat.
    fn skip(&mut self, _s: S, _entry: &TileEntry) {}
}

/// Rows of pixels that one vector covers.
const BANDS: usize = HEIGHT / LANES;

/// Where a splat's rows start and end in a tile.
struct SplatRows {
    from: [[i32; LANES]; BANDS],
    to: [[i32; LANES]; BANDS],
    /// Column of the splat's centre line, relative to the first pixel's centre.
    centre: [[f32; LANES]; BANDS],
    /// Base-2 logarithm of alpha on the centre line.
    peak: [[f32; LANES]; BANDS],
    dy: [[f32; LANES]; BANDS],
}

#[inline(always)]
fn rows<S: Simd>(
    s: S,
    f: &SplatFootprint,
    extent: &TileExtent,
    first: usize,
    last: usize,
    out: &mut SplatRows,
) {
    let (x, y) = (f.x - (extent.x as f32 + 0.5), extent.y as f32 + 0.5 - f.y);
    for band in first / LANES..=(last / LANES).min(BANDS - 1) {
        let dy = s.add(s.iota(), s.splat(y + (band * LANES) as f32));
        let peak = s.sub(s.splat(f.lo), s.mul(s.splat(f.e), s.mul(dy, dy)));
        let above = s.max(s.sub(peak, s.splat(LOG2_ALPHA_MIN)), s.splat(0.0));
        // Rounding `left + 1/2` up to a half is the ceiling; the slack keeps pixels on the edge.
        let reach = s.sub(s.sqrt(s.mul(above, s.splat(f.inv_a))), s.splat(0.5 - SLACK));
        let centre = s.add(s.mul(s.splat(f.slope), dy), s.splat(x));
        let edge = s.splat(WIDTH as f32);
        let from = s.min(s.max(s.sub(centre, reach), s.splat(0.0)), edge);
        let to = s.min(s.max(s.add(centre, reach), s.splat(-1.0)), s.splat(extent.width as f32 - 1.0));
        s.round(from, &mut out.from[band]);
        s.round(to, &mut out.to[band]);
        // SAFETY: each array has eight numbers.
        unsafe {
            s.store(out.centre[band].as_mut_ptr(), centre);
            s.store(out.peak[band].as_mut_ptr(), peak);
            s.store(out.dy[band].as_mut_ptr(), dy);
        }
    }
}

/// One bit per row with a pixel that is not finished ([`T_MIN`]).
#[inline(always)]
fn unfinished_rows<S: Simd>(s: S, transmittance: &TilePlane) -> u32 {
    let mut rows = 0;
    for row in 0..HEIGHT {
        let mut most = s.splat(0.0);
        for block in 0..WIDTH / LANES {
            // SAFETY: a row has WIDTH numbers and the padding.
            let t = unsafe { s.load(transmittance.0.as_ptr().add(row * STRIDE + block * LANES)) };
            most = s.max(most, t);
        }
        if s.bits(s.ge(most, s.splat(T_MIN))) != 0 {
            rows |= 1 << row;
        }
    }
    rows
}

/// Walks over a tile; returns nothing, as the visitor keeps what it wants.
#[inline(always)]
pub(crate) fn walk<S: Simd, V: TileVisitor<S>>(
    s: S,
    footprints: &[SplatFootprint],
    entries: &[TileEntry],
    extent: &TileExtent,
    visitor: &mut V,
) {
    let mut transmittance = TilePlane::ZERO;
    for row in 0..extent.height {
        transmittance.0[row * STRIDE..row * STRIDE + extent.width].fill(1.0);
    }
    let mut spans = SplatRows {
        from: [[0; LANES]; BANDS],
        to: [[0; LANES]; BANDS],
        centre: [[0.0; LANES]; BANDS],
        peak: [[0.0; LANES]; BANDS],
        dy: [[0.0; LANES]; BANDS],
    };
    let mut alive = (1u32 << extent.height) - 1;
    for (k, entry) in entries.iter().enumerate() {
        if k % CHECK == CHECK - 1 {
            alive = unfinished_rows(s, &transmittance);
            if alive == 0 {
                for entry in &entries[k..] {
                    visitor.skip(s, entry);
                }
                return;
            }
        }
        if let Some(soon) = entries.get(k + AHEAD) {
            visitor.prepare(s, soon);
            s.prefetch(&footprints[soon.splat as usize]);
        }
        let f = &footprints[entry.splat as usize];
        let y = f.y - (extent.y as f32 + 0.5);
        // The ceiling, or one row above it where the fraction is tiny.
        let first = (y - f.reach + 0.999).max(0.0) as i32 as usize;
        let last = ((y + f.reach).max(0.0) as i32 as usize).min(extent.height - 1);
        visitor.start_splat(s, entry);
        if first <= last {
            rows(s, f, extent, first, last, &mut spans);
        }
        for row in first..last + 1 {
            let (from, to) = (spans.from.as_flattened()[row], spans.to.as_flattened()[row]);
            if from > to || alive & (1 << row) == 0 {
                continue;
            }
            visitor.row(s, spans.dy.as_flattened()[row]);
            let (peak, a) = (s.splat(spans.peak.as_flattened()[row]), s.splat(f.a));
            let mut x = from.max(0);
            let to = to.min(WIDTH as i32 - 1);
            let offset = spans.centre.as_flattened()[row];
            while x <= to {
                let at = row * STRIDE + x as usize;
                // SAFETY: row < HEIGHT and 0 <= x < WIDTH, so eight numbers from `at` on end inside the row's padding.
                let t = unsafe { s.load(transmittance.0.as_ptr().add(at)) };
                let u = s.add(s.iota(), s.splat(x as f32 - offset));
                let power = s.sub(peak, s.mul(a, s.mul(u, u)));
                let raw = s.exp2(s.max(power, s.splat(-64.0)));
                let alpha = s.min(raw, s.splat(ALPHA_MAX));
                let hit = s.both(s.ge(raw, s.splat(ALPHA_MIN)), s.ge(t, s.splat(T_MIN)));
                let weight = s.keep(s.mul(alpha, t), hit);
                // SAFETY: as for the load.
                unsafe { s.store(transmittance.0.as_mut_ptr().add(at), s.sub(t, weight)) };
                let free = s.lt(raw, s.splat(ALPHA_MAX));
                visitor.block(s, f, &PixelBlock { at, u, alpha, free, hit, weight });
                x += LANES as i32;
            }
            visitor.row_end(s);
        }
        visitor.end(s, f, entry);
    }
}
