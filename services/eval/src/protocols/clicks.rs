//! From masks and scribbles to the clicks that a person would make.

use segwild_scene::{Mask, PointPrompt, Random};

/// Distance in pixels that a random click keeps from the outline, where the mask is wide enough.
const MARGIN: f32 = 2.0;

/// How far each pixel of a mask is from the nearest pixel outside it, the frame's border being outside; 0 outside.
fn depths(mask: &Mask) -> Vec<f32> {
    let (w, h) = (mask.width(), mask.height());
    let mut depth = mask.not().distances();
    for (i, d) in depth.iter_mut().enumerate() {
        let (x, y) = (i as u32 % w, i as u32 / w);
        let border = (x + 1).min(y + 1).min(w - x).min(h - y) as f32;
        *d = if mask.index(i) { d.min(border) } else { 0.0 };
    }
    depth
}

fn point((x, y): (u32, u32), inside: bool) -> PointPrompt {
    PointPrompt { x: x as f32 + 0.5, y: y as f32 + 0.5, inside }
}

/// Clicks as a person scenes them who wants the whole of a mask: the first where the mask is deepest (farthest from its
/// outline and the frame); each further one where what is left is deepest, after a disc of twice the depth around each
/// earlier click was removed. Fewer than `count` where nothing is left.
pub fn inside(mask: &Mask, count: usize) -> Vec<PointPrompt> {
    let depth = depths(mask);
    let width = mask.width();
    let at = |(x, y): (u32, u32)| depth[(y * width + x) as usize];
    let mut taken: Vec<((u32, u32), f32)> = Vec::new();
    while taken.len() < count {
        let free = |&(x, y): &(u32, u32)| {
            taken.iter().all(|&((u, v), d)| {
                let (dx, dy) = (x as f32 - u as f32, y as f32 - v as f32);
                dx * dx + dy * dy > 4.0 * d * d
            })
        };
        // Of equally deep pixels the first in reading order.
        let deepest = mask.pixels().filter(free).fold(None, |best: Option<(u32, u32)>, p| match best {
            Some(b) if at(b) >= at(p) => Some(b),
            _ => Some(p),
        });
        let Some(deepest) = deepest else { break };
        taken.push((deepest, at(deepest)));
    }
    taken.into_iter().map(|(p, _)| point(p, true)).collect()
}

/// A click deep inside each of the parts into which horizontal lines at `rows` divide a mask; a part that holds no
/// pixel gets none.
pub fn parts(mask: &Mask, rows: &[u32]) -> Vec<PointPrompt> {
    let mut ends: Vec<u32> = rows.to_vec();
    ends.sort_unstable();
    ends.push(mask.height());
    let mut clicks = Vec::new();
    let mut top = 0;
    for end in ends {
        let part =
            Mask::from_fn(mask.width(), mask.height(), |x, y| (top..end).contains(&y) && mask.get(x, y));
        clicks.extend(inside(&part, 1));
        top = end;
    }
    clicks
}

/// Clicks anywhere in a mask, but not on its very outline if it is wide enough: as hasty as people are. The same seed and
/// stream give the same clicks.
pub fn random(mask: &Mask, count: usize, seed: u64, stream: u64) -> Vec<PointPrompt> {
    let depth = depths(mask);
    let width = mask.width();
    let deep = |least: f32| -> Vec<(u32, u32)> {
        mask.pixels().filter(|&(x, y)| depth[(y * width + x) as usize] >= least).collect()
    };
    let mut pixels = deep(MARGIN);
    if pixels.is_empty() {
        pixels = deep(0.0);
    }
    let mut random = Random::stream(seed, stream);
    let count = count.min(pixels.len());
    random.draw(&mut pixels, count);
    pixels.truncate(count);
    pixels.into_iter().map(|p| point(p, true)).collect()
}

/// At most `count` clicks spread evenly over a scribble: the first on its deepest pixel, each further one on the pixel
/// farthest from all before it.
pub fn scribble(scribble: &Mask, count: usize, inside: bool) -> Vec<PointPrompt> {
    let Some(first) = self::inside(scribble, 1).first().copied() else { return Vec::new() };
    let pixels: Vec<(u32, u32)> = scribble.pixels().collect();
    let distance = |p: (u32, u32), q: &PointPrompt| {
        let (dx, dy) = (p.0 as f32 + 0.5 - q.x, p.1 as f32 + 0.5 - q.y);
        dx * dx + dy * dy
    };
    let mut clicks = vec![PointPrompt { inside, ..first }];
    let mut nearest: Vec<f32> = pixels.iter().map(|&p| distance(p, &first)).collect();
    while clicks.len() < count {
        let far = (0..pixels.len()).fold(0, |best, i| if nearest[i] > nearest[best] { i } else { best });
        if nearest[far] < 1.0 {
            break;
        }
        let next = point(pixels[far], inside);
        for (d, &p) in nearest.iter_mut().zip(&pixels) {
            *d = d.min(distance(p, &next));
        }
        clicks.push(next);
    }
    clicks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clicks_lie_deep_inside_and_apart() {
        // A wide block over a narrow one.
        let mask = Mask::from_fn(60, 90, |x, y| {
            ((5..55).contains(&x) && (5..45).contains(&y)) || ((25..35).contains(&x) && (45..85).contains(&y))
        });
        let clicks = inside(&mask, 2);
        assert!((clicks[0].y - 25.0).abs() < 2.0, "{clicks:?}");
        assert!(clicks[1].y > 50.0 || (clicks[1].x - clicks[0].x).abs() > 20.0, "{clicks:?}");
        let split = parts(&mask, &[45]);
        assert!(split.len() == 2 && split[1].y > 45.0 && (split[1].x - 30.0).abs() < 2.0, "{split:?}");
        assert_eq!(parts(&mask, &[2, 45]).len(), 2, "nothing of it lies above row 2");
        assert!(inside(&Mask::empty(9, 9), 3).is_empty());
        for p in random(&mask, 40, 7, 1) {
            assert!(mask.at(p.x, p.y) && mask.at(p.x - 1.0, p.y) && mask.at(p.x + 1.0, p.y), "{p:?}");
        }
        assert_eq!(random(&mask, 5, 7, 1), random(&mask, 5, 7, 1));
        assert_ne!(random(&mask, 5, 7, 1), random(&mask, 5, 7, 2));
    }

    #[test]
    fn a_scribble_becomes_points_along_its_whole_length() {
        // An L of strokes three pixels wide.
        let stroke = Mask::from_fn(100, 100, |x, y| {
            ((10..13).contains(&x) && (10..90).contains(&y))
                || ((10..90).contains(&x) && (87..90).contains(&y))
        });
        let points = scribble(&stroke, 5, false);
        assert_eq!(points.len(), 5);
        assert!(points.iter().all(|p| !p.inside && stroke.at(p.x, p.y)));
        let near = |x: f32, y: f32| points.iter().any(|p| (p.x - x).hypot(p.y - y) < 12.0);
        assert!(near(11.0, 11.0) && near(89.0, 89.0), "{points:?}");
        assert!(scribble(&Mask::empty(9, 9), 5, true).is_empty());
        let dot = Mask::from_fn(9, 9, |x, y| (x, y) == (4, 4));
        assert_eq!(scribble(&dot, 5, true).len(), 1);
    }
}
