//! Small islands out, small holes in.

use segwild_scene::Mask;

/// The mask without islands of fewer than `least` pixels (8-connected) and with holes of fewer than `least`
/// pixels (4-connected) filled. If every island is that small, the mask becomes empty.
pub fn without_specks(mask: &Mask, least: usize) -> Mask {
    let (w, h) = (mask.width() as usize, mask.height() as usize);
    let mut inside = vec![false; w * h];
    for (x, y) in mask.pixels() {
        inside[y as usize * w + x as usize] = true;
    }
    flip_small(&mut inside, w, h, true, least);
    if inside.iter().any(|&i| i) {
        flip_small(&mut inside, w, h, false, least);
    }
    Mask::from_fn(mask.width(), mask.height(), |x, y| inside[y as usize * w + x as usize])
}

/// Flips every connected region of `value` that has fewer than `least` pixels.
fn flip_small(grid: &mut [bool], w: usize, h: usize, value: bool, least: usize) {
    let mut seen = vec![false; grid.len()];
    let mut region = Vec::new();
    for start in 0..grid.len() {
        if seen[start] || grid[start] != value {
            continue;
        }
        seen[start] = true;
        region.clear();
        region.push(start);
        let mut next = 0;
        while let Some(&i) = region.get(next) {
            next += 1;
            let (x, y) = (i % w, i / w);
            for ny in y.saturating_sub(1)..(y + 2).min(h) {
                for nx in x.saturating_sub(1)..(x + 2).min(w) {
                    let n = ny * w + nx;
                    let diagonal = nx != x && ny != y;
                    // Islands connect over corners, so holes must not.
                    if (value || !diagonal) && !seen[n] && grid[n] == value {
                        seen[n] = true;
                        region.push(n);
                    }
                }
            }
        }
        if region.len() < least {
            region.iter().for_each(|&i| grid[i] = !value);
        }
    }
}
