//! The oracle's masks: of proposals, prompts, certainties and the sky.

use super::truth::{Oracle, RecognisedView, Thing};
use glam::Vec3;
use segwild_scene::{Image, Mask, Prompts, ScoredMask};
use segwild_synthetic::random::{Rng, noise};
use segwild_vision::{MaskProposer, PromptSegmenter, Prompted, SkyDetector, VisionError};
use std::collections::{BTreeMap, BTreeSet};

/// Mean certainty below which a thing is known to be outside, and above which it is known to be inside; between
/// them nothing is known of it.
const KNOWN: [f64; 2] = [0.4, 0.72];
/// Granularity below which a prompt means a part.
const FINE: f32 = 0.34;

impl Oracle {
    fn exact_mask(&self, sight: RecognisedView, image: &Image, things: &[Thing]) -> Mask {
        let known = &self.views[sight.view];
        Mask::from_fn(image.width as u32, image.height as u32, |x, y| {
            let i = self.under(known, image, x as f32 + 0.5, y as f32 + 0.5);
            things.iter().any(|&t| self.holds(sight, t, i))
        })
    }

    /// The mask with a boundary that wanders by up to `wobble` pixels, scored by what it lost.
    fn wandering(&self, sight: RecognisedView, image: &Image, things: &[Thing], rng: &mut Rng) -> ScoredMask {
        let exact = self.exact_mask(sight, image, things);
        let reach = self.options.wobble * rng.unit();
        let offset = rng.triple(0.0, 100.0);
        if reach <= 0.0 {
            return ScoredMask { mask: exact, predicted_iou: 1.0, stability: 1.0 };
        }
        let (w, h) = (exact.width() as f32, exact.height() as f32);
        let mask = Mask::from_fn(exact.width(), exact.height(), |x, y| {
            let p = Vec3::new(x as f32, y as f32, 0.0) / 11.0 + offset;
            let push = |q: Vec3| (noise(q) - 0.5) * 2.0 * reach;
            // An object cut off by the frame stays cut off by it.
            let u = (x as f32 + 0.5 + push(p)).clamp(0.0, w - 0.5);
            let v = (y as f32 + 0.5 + push(p + 31.0)).clamp(0.0, h - 0.5);
            exact.at(u, v)
        });
        let iou = mask.iou(&exact) as f32;
        ScoredMask { mask, predicted_iou: iou, stability: 0.5 + 0.5 * iou }
    }

    /// The thing that touches another most, among those of its kind.
    fn neighbour(&self, sight: RecognisedView, thing: Thing) -> Option<Thing> {
        let known = &self.views[sight.view];
        let (ids, id) = match thing {
            Thing::Instance(id) => (&known.instances, id),
            Thing::Part(id) => (&known.parts, id),
            Thing::Transient(_) => return None,
        };
        let mut contact: BTreeMap<u16, usize> = BTreeMap::new();
        let mut touch = |a: u16, b: u16| {
            if a == id && b != id && b != 0 {
                *contact.entry(b).or_default() += 1;
            }
        };
        for y in 0..known.height {
            for x in 0..known.width {
                let i = y * known.width + x;
                let right = (x + 1 < known.width).then_some(i + 1);
                let below = (y + 1 < known.height).then_some(i + known.width);
                for j in right.into_iter().chain(below) {
                    touch(ids[i], ids[j]);
                    touch(ids[j], ids[i]);
                }
            }
        }
        let most = contact.into_iter().max_by_key(|&(id, n)| (n, std::cmp::Reverse(id)))?;
        Some(if matches!(thing, Thing::Part(_)) { Thing::Part(most.0) } else { Thing::Instance(most.0) })
    }

    /// The faults of a thing's mask in a view: the same at every request.
    fn faults(&self, sight: RecognisedView, thing: Thing) -> Rng {
        let (kind, id) = match thing {
            Thing::Instance(id) => (1, u64::from(id)),
            Thing::Part(id) => (2, u64::from(id)),
            Thing::Transient(id) => (3, u64::from(id)),
        };
        Rng::new(self.options.seed, (sight.view as u64) << 40 | kind << 36 | id)
    }

    /// The thing whose seen extent fits a box best.
    fn boxed(
        &self,
        sight: RecognisedView,
        image: &Image,
        [x0, y0, x1, y1]: [f32; 4],
        fine: bool,
    ) -> Option<Thing> {
        let known = &self.views[sight.view];
        let mut extents: BTreeMap<Thing, [f32; 4]> = BTreeMap::new();
        for y in 0..image.height {
            for x in 0..image.width {
                let (u, v) = (x as f32, y as f32);
                let i = self.under(known, image, u + 0.5, v + 0.5);
                let thing =
                    if fine { Thing::Part(known.parts[i]) } else { Thing::Instance(known.instances[i]) };
                let e = extents.entry(thing).or_insert([u, v, u + 1.0, v + 1.0]);
                *e = [e[0].min(u), e[1].min(v), e[2].max(u + 1.0), e[3].max(v + 1.0)];
            }
        }
        let area = |e: [f32; 4]| (e[2] - e[0]).max(0.0) * (e[3] - e[1]).max(0.0);
        let fit = |e: [f32; 4]| {
            let both = area([e[0].max(x0), e[1].max(y0), e[2].min(x1), e[3].min(y1)]);
            both / (area(e) + area([x0, y0, x1, y1]) - both).max(1e-6)
        };
        let best = extents.into_iter().max_by(|a, b| fit(a.1).total_cmp(&fit(b.1)).then(b.0.cmp(&a.0)))?;
        (fit(best.1) > 0.0).then_some(best.0)
    }
}

impl MaskProposer for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let sight = self.recognise(image)?;
        let mut things = BTreeSet::new();
        for &[x, y] in points {
            let inside = x >= 0.0 && y >= 0.0 && x < image.width as f32 && y < image.height as f32;
            if inside {
                things.insert(self.thing_at(sight, image, x, y, false));
                things.insert(self.thing_at(sight, image, x, y, true));
            }
        }
        let mut masks: Vec<ScoredMask> = Vec::new();
        for thing in things {
            let mut rng = self.faults(sight, thing);
            let (dropped, merged) = (rng.chance(self.options.drop), rng.chance(self.options.merge));
            if dropped {
                continue;
            }
            let mut together = vec![thing];
            if merged {
                together.extend(self.neighbour(sight, thing));
            }
            let mask = self.wandering(sight, image, &together, &mut rng);
            if !mask.mask.is_empty() {
                masks.push(mask);
            }
        }
        Ok(masks)
    }
}

impl PromptSegmenter for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        let sight = self.recognise(image)?;
        let fine = prompts.granularity.is_some_and(|g| g < FINE);
        let known = &self.views[sight.view];
        let at = |x: f32, y: f32| self.under(known, image, x, y);
        let mut things = BTreeSet::new();
        for p in prompts.points.iter().filter(|p| p.inside) {
            things.insert(self.thing_at(sight, image, p.x, p.y, fine));
        }
        for b in &prompts.boxes {
            let (x0, x1) = (b.x0.min(b.x1), b.x0.max(b.x1));
            let (y0, y1) = (b.y0.min(b.y1), b.y0.max(b.y1));
            things.extend(self.boxed(sight, image, [x0, y0, x1, y1], fine));
        }
        if things.is_empty() {
            return Err(VisionError::Image(
                "the prompts name nothing: give a click inside the object or a box".into(),
            ));
        }
        let things: Vec<Thing> = things.into_iter().collect();
        let mut rng = self.faults(sight, things[0]);
        let mut found = self.wandering(sight, image, &things, &mut rng);
        // What a negative click lies on goes: its part if a positive click keeps the instance, all of it otherwise.
        for p in prompts.points.iter().filter(|p| !p.inside) {
            let i = at(p.x, p.y);
            let whole = self.thing_at(sight, image, p.x, p.y, false);
            let shared = prompts.points.iter().any(|q| q.inside && self.holds(sight, whole, at(q.x, q.y)));
            let out = if shared { Thing::Part(known.parts[i]) } else { whole };
            found.mask = found.mask.minus(&self.exact_mask(sight, image, &[out]));
        }
        Ok(Prompted::sure(found))
    }

    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        let sight = self.recognise(image)?;
        if (certainty.width, certainty.height, certainty.channels) != (image.width, image.height, 1) {
            return Err(VisionError::Image(format!(
                "the certainty is {}x{} with {} planes, the image {}x{}",
                certainty.width, certainty.height, certainty.channels, image.width, image.height
            )));
        }
        let known = &self.views[sight.view];
        let mut parts: BTreeMap<u16, (f64, usize)> = BTreeMap::new();
        for y in 0..image.height {
            for x in 0..image.width {
                let i = self.under(known, image, x as f32 + 0.5, y as f32 + 0.5);
                if known.transients[i] != 0 && sight.transients {
                    continue; // they hide what the certainty is about
                }
                let c = certainty.at(0, x, y);
                let entry = parts.entry(known.parts[i]).or_default();
                entry.0 += if c.is_finite() { f64::from(c) } else { 0.5 };
                entry.1 += 1;
            }
        }
        let mut wholes: BTreeMap<u16, (f64, usize)> = BTreeMap::new();
        for (&part, &(sum, n)) in &parts {
            let entry = wholes.entry(self.instance_of[usize::from(part)]).or_default();
            (entry.0, entry.1) = (entry.0 + sum, entry.1 + n);
        }
        // A part that is known decides for itself; one that is open goes with what is known of its whole.
        let mean = |(sum, n): (f64, usize)| sum / n as f64;
        let things: Vec<Thing> = parts
            .iter()
            .filter(|(id, part)| {
                let whole = wholes[&self.instance_of[usize::from(**id)]];
                let (part, whole) = (mean(**part), mean(whole));
                part > KNOWN[1] || (part > KNOWN[0] && whole > KNOWN[1])
            })
            .map(|(&id, _)| Thing::Part(id))
            .collect();
        if things.is_empty() {
            return Err(VisionError::Image("nothing in this image is known to belong to the object".into()));
        }
        let mut rng = self.faults(sight, things[0]);
        Ok(self.wandering(sight, image, &things, &mut rng))
    }
}

impl SkyDetector for Oracle {
    fn key(&self) -> String {
        self.key.clone()
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        let sight = self.recognise(image)?;
        Ok(self.exact_mask(sight, image, &[Thing::Instance(0)]))
    }
}
