//! Shapes of masks: distances, growing and shrinking, boundaries, components, holes.

use crate::{Mask, SceneError};
use std::path::Path;

impl Mask {
    /// Writes the mask as an 8-bit grey PNG: 255 inside, 0 outside.
    pub fn write_png(&self, path: &Path) -> Result<(), SceneError> {
        Ok(segwild_files::write_atomic(path, &self.png()?)?)
    }

    /// The bytes of that PNG.
    ///
    /// # Errors
    /// When the mask has no pixel.
    pub fn png(&self) -> Result<Vec<u8>, SceneError> {
        let n = self.width() as usize * self.height() as usize;
        let bytes: Vec<u8> = (0..n).map(|i| if self.index(i) { 255 } else { 0 }).collect();
        crate::image::png(&bytes, self.width(), self.height(), image::ExtendedColorType::L8)
            .map_err(|e| SceneError::invalid(Path::new("a mask"), "image", e))
    }

    /// Distance in pixels from each pixel's centre to that of the nearest pixel of the mask, row-major: 0 inside,
    /// infinite everywhere when the mask is empty. Exact (Felzenszwalb and Huttenlocher, Theory of Computing 2012).
    pub fn distances(&self) -> Vec<f32> {
        squared_distances(self)
            .iter()
            .map(|&d| if d == FAR { f32::INFINITY } else { d.sqrt() as f32 })
            .collect()
    }

    /// How deep each pixel lies in the mask, in pixels, row-major: distance to the nearest pixel outside of it, or to the first one
    /// beyond the frame, whichever is nearer; 0 outside.
    pub fn depths(&self) -> Vec<f32> {
        let (width, height) = (self.width(), self.height());
        let mut depths = self.not().distances();
        for (i, depth) in depths.iter_mut().enumerate() {
            let (x, y) = (i as u32 % width, i as u32 / width);
            *depth = depth.min((x + 1).min(width - x).min(y + 1).min(height - y) as f32);
        }
        depths
    }

    /// The pixels at most `radius` pixels away from the mask.
    pub fn dilated(&self, radius: f32) -> Mask {
        let reach = f64::from(radius) * f64::from(radius);
        self.where_squared(&squared_distances(self), |d| d <= reach)
    }

    /// The pixels of the mask farther than `radius` pixels from everything that is not of the mask. The frame's
    /// border is no edge: an object cut off by the frame does not shrink from there.
    pub fn eroded(&self, radius: f32) -> Mask {
        let reach = f64::from(radius) * f64::from(radius);
        self.where_squared(&squared_distances(&self.not()), |d| d > reach)
    }

    /// The pixels of the mask within `width` pixels of its outline, where the frame's border counts as outline:
    /// the band of Boundary IoU (Cheng et al. 2021, whose program takes away the mask eroded `width` times by
    /// 3 x 3 pixels).
    pub fn boundary(&self, width: u32) -> Mask {
        let (w, h) = (self.width() as usize, self.height() as usize);
        // Chessboard erosion is separable: first along rows, then along columns.
        let mut inside: Vec<bool> = (0..w * h).map(|i| self.index(i)).collect();
        let n = width as usize;
        let mut line = Vec::new();
        for y in 0..h {
            line.clear();
            line.extend_from_slice(&inside[y * w..(y + 1) * w]);
            erode_line(&line, n, |x, v| inside[y * w + x] = v);
        }
        for x in 0..w {
            line.clear();
            line.extend((0..h).map(|y| inside[y * w + x]));
            erode_line(&line, n, |y, v| inside[y * w + x] = v);
        }
        Mask::from_fn(self.width(), self.height(), |x, y| {
            self.get(x, y) && !inside[y as usize * w + x as usize]
        })
    }

    /// Boundary IoU: IoU of the two [`Mask::boundary`] bands whose width is `fraction` (0.02 in the literature) of
    /// the image diagonal, at least one pixel.
    pub fn boundary_iou(&self, other: &Mask, fraction: f32) -> f64 {
        let diagonal = f64::from(self.width()).hypot(f64::from(self.height()));
        let width = (diagonal * f64::from(fraction)).round().max(1.0) as u32;
        self.boundary(width).iou(&other.boundary(width))
    }

    /// Connected components, diagonal neighbours included: per pixel 0 outside and 1.. inside, and their number.
    /// Components are numbered by their first pixel, row by row.
    pub fn components(&self) -> (Vec<u32>, usize) {
        self.labelled(true)
    }

    /// The mask with its holes of at most `max_area` pixels filled; what touches the frame's border is no hole.
    pub fn fill_holes(&self, max_area: usize) -> Mask {
        let (w, h) = (self.width() as usize, self.height() as usize);
        // Outside is connected by edges only, since the mask is connected across corners.
        let (labels, count) = self.not().labelled(false);
        let mut area = vec![0usize; count + 1];
        for (i, &l) in labels.iter().enumerate() {
            let (x, y) = (i % w, i / w);
            let border = x == 0 || y == 0 || x + 1 == w || y + 1 == h;
            area[l as usize] = if border { usize::MAX } else { area[l as usize].saturating_add(1) };
        }
        Mask::from_fn(self.width(), self.height(), |x, y| {
            let l = labels[y as usize * w + x as usize];
            l == 0 || area[l as usize] <= max_area
        })
    }

    fn where_squared(&self, squared: &[f64], keep: impl Fn(f64) -> bool) -> Mask {
        Mask::from_fn(self.width(), self.height(), |x, y| {
            keep(squared[y as usize * self.width() as usize + x as usize])
        })
    }
}

/// Stands for infinity where there is no mask at all; larger than any squared distance in an image.
const FAR: f64 = 1e18;

fn erode_line(line: &[bool], n: usize, mut put: impl FnMut(usize, bool)) {
    // Inside stays what has n inside on either side, the frame's border being outside.
    let mut run = 0;
    for (i, &v) in line.iter().enumerate() {
        run = if v { run + 1 } else { 0 };
        if i >= n {
            put(i - n, run > 2 * n);
        }
    }
    for i in line.len().saturating_sub(n)..line.len() {
        put(i, false);
    }
}

fn squared_distances(mask: &Mask) -> Vec<f64> {
    let (w, h) = (mask.width() as usize, mask.height() as usize);
    let mut d: Vec<f64> = (0..w * h).map(|i| if mask.index(i) { 0.0 } else { FAR }).collect();
    let mut envelope = Envelope::default();
    for x in 0..w {
        envelope.line.clear();
        envelope.line.extend((0..h).map(|y| d[y * w + x]));
        envelope.lower(|y, v| d[y * w + x] = v);
    }
    for row in d.chunks_mut(w.max(1)) {
        envelope.line.clear();
        envelope.line.extend_from_slice(row);
        envelope.lower(|x, v| row[x] = v);
    }
    d
}

/// Lower envelope of the parabolas `line[q] + (p - q)^2`.
#[derive(Default)]
struct Envelope {
    line: Vec<f64>,
    /// The parabolas of the envelope and where each begins.
    apex: Vec<usize>,
    starts: Vec<f64>,
}

impl Envelope {
    fn lower(&mut self, mut put: impl FnMut(usize, f64)) {
        self.apex.clear();
        self.starts.clear();
        for q in (0..self.line.len()).filter(|&q| self.line[q] < FAR) {
            let height = |q: usize| self.line[q] + (q * q) as f64;
            let mut start = f64::NEG_INFINITY;
            while let (Some(&last), Some(&starts)) = (self.apex.last(), self.starts.last()) {
                start = (height(q) - height(last)) / (2.0 * (q - last) as f64);
                if start > starts {
                    break;
                }
                self.apex.pop();
                self.starts.pop();
                start = f64::NEG_INFINITY;
            }
            self.apex.push(q);
            self.starts.push(start);
        }
        if self.apex.is_empty() {
            return;
        }
        let mut k = 0;
        for p in 0..self.line.len() {
            while k + 1 < self.apex.len() && self.starts[k + 1] <= p as f64 {
                k += 1;
            }
            let q = self.apex[k];
            let step = p.abs_diff(q) as f64;
            put(p, self.line[q] + step * step);
        }
    }
}
