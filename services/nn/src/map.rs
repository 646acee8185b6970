//! Planes of numbers.

use rayon::prelude::*;

/// Numbers on a grid: `channels` planes of `height` rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Number of planes.
    pub channels: usize,
    /// Rows of a plane.
    pub height: usize,
    /// Numbers in a row.
    pub width: usize,
    /// The numbers, plane after plane, row after row.
    pub data: Vec<f32>,
}

impl Map {
    /// All 0.
    pub fn zeros(channels: usize, height: usize, width: usize) -> Map {
        Map { channels, height, width, data: vec![0.0; channels * height * width] }
    }

    /// Numbers in a plane.
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// One plane.
    pub fn plane(&self, channel: usize) -> &[f32] {
        let n = self.pixels();
        &self.data[channel * n..(channel + 1) * n]
    }

    /// The planes of one after those of the other.
    ///
    /// # Panics
    /// If the sizes differ.
    pub fn concat(&self, other: &Map) -> Map {
        assert_eq!((self.height, self.width), (other.height, other.width), "sizes");
        let data = [self.data.as_slice(), &other.data].concat();
        Map { channels: self.channels + other.channels, height: self.height, width: self.width, data }
    }

    /// The first `channels` planes, and the others.
    pub fn split(self, channels: usize) -> (Map, Map) {
        let (height, width) = (self.height, self.width);
        let mut first = self.data;
        let second = first.split_off(channels * height * width);
        let rest = self.channels - channels;
        (Map { channels, height, width, data: first }, Map { channels: rest, height, width, data: second })
    }

    /// Adds another of the same size.
    pub fn add(&mut self, other: &Map) {
        assert_eq!(self.data.len(), other.data.len(), "sizes");
        self.data.iter_mut().zip(&other.data).for_each(|(a, b)| *a += b);
    }

    /// Sets values below 0 to 0.
    pub fn relu(mut self) -> Map {
        self.data.par_chunks_mut(1 << 14).for_each(|piece| piece.iter_mut().for_each(|v| *v = v.max(0.0)));
        self
    }

    /// The gradient before [`Map::relu`], from that after it and its result.
    pub fn relu_backward(mut self, result: &Map) -> Map {
        self.data.iter_mut().zip(&result.data).for_each(|(g, v)| *g = if *v > 0.0 { *g } else { 0.0 });
        self
    }
}
