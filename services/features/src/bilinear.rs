//! Bilinear resampling from the embedding's grid to the render's.

use segwild_scene::Image;

/// Bilinear interpolation between cell centres; beyond the outermost centres the border cell holds.
pub(crate) fn bilinear(image: &Image, width: usize, height: usize) -> Image {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let taps = |from: usize, to: usize| -> Vec<(usize, usize, f32)> {
        (0..to)
            .map(|i| {
                let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
                (at as usize, (at as usize + 1).min(from - 1), at.fract() as f32)
            })
            .collect()
    };
    let (columns, rows) = (taps(image.width, width), taps(image.height, height));
    let mut out = Image::zeros(width, height, image.channels);
    let mut row = vec![0.0; image.width];
    for c in 0..image.channels {
        let plane = image.plane(c);
        let line = |y: usize| &plane[y * image.width..(y + 1) * image.width];
        for (y, &(above, below, t)) in rows.iter().enumerate() {
            for (r, (a, b)) in row.iter_mut().zip(line(above).iter().zip(line(below))) {
                *r = a + t * (b - a);
            }
            let out = &mut out.plane_mut(c)[y * width..(y + 1) * width];
            for (out, &(left, right, t)) in out.iter_mut().zip(&columns) {
                *out = row[left] + t * (row[right] - row[left]);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bilinear_keeps_ramps_and_borders() {
        let ramp =
            Image { width: 4, height: 2, channels: 1, data: vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0] };
        let up = bilinear(&ramp, 8, 4);
        assert_eq!(up.data[..8], [0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.0]);
        assert_eq!(up.at(0, 0, 3), 4.0);
        assert_eq!(bilinear(&ramp, 4, 2), ramp);
        assert!(bilinear(&Image::filled(1, 1, 3, 2.0), 5, 7).data.iter().all(|&v| v == 2.0));
    }
}
