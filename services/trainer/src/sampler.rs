//! Which photo comes next.

use segwild_scene::Random;
use wincode::{SchemaRead, SchemaWrite};

/// Every photo once, in random order, then again in another order.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct Sampler {
    views: Vec<u32>,
    cursor: u32,
}

impl Sampler {
    /// Over the views given.
    pub fn new(views: &[usize]) -> Sampler {
        Sampler { views: views.iter().map(|&v| v as u32).collect(), cursor: 0 }
    }

    /// The next view; `None` when every one was taken out.
    pub fn next(&mut self, random: &mut Random) -> Option<usize> {
        if self.cursor as usize >= self.views.len() {
            self.cursor = 0;
        }
        if self.cursor == 0 {
            random.shuffle(&mut self.views);
        }
        let view = self.views.get(self.cursor as usize).copied();
        self.cursor += 1;
        view.map(|v| v as usize)
    }

    /// The view that [`Sampler::next`] will give; `None` at the end of a round, whose successor has no order yet.
    pub fn upcoming(&self) -> Option<usize> {
        self.views.get(self.cursor as usize).map(|&view| view as usize)
    }

    /// Removes the view sampled last for good.
    pub fn drop_last(&mut self) {
        self.cursor -= 1;
        self.views.remove(self.cursor as usize);
        // The start of a round shuffles; being thrown back to it must not shuffle a round in progress away.
        if self.cursor == 0 && !self.views.is_empty() {
            self.cursor = self.views.len() as u32;
        }
    }

    /// Number of views that are still sampled.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// The views that are still sampled, in ascending order.
    pub fn views(&self) -> Vec<usize> {
        let mut views: Vec<usize> = self.views.iter().map(|&v| v as usize).collect();
        views.sort_unstable();
        views
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_view_once_per_round_and_dropped_ones_never_again() {
        let mut random = Random::new(1);
        let mut s = Sampler::new(&[2, 4, 6, 8]);
        for _ in 0..3 {
            let mut round = vec![s.next(&mut random).unwrap()];
            while let Some(upcoming) = s.upcoming() {
                round.push(upcoming);
                assert_eq!(s.next(&mut random), Some(upcoming));
            }
            round.sort_unstable();
            assert_eq!(round, [2, 4, 6, 8]);
        }
        let gone = s.next(&mut random).unwrap();
        s.drop_last();
        for _ in 0..20 {
            assert_ne!(s.next(&mut random), Some(gone));
        }
        for _ in 0..3 {
            s.next(&mut random);
            s.drop_last();
        }
        assert_eq!(s.next(&mut random), None);
    }
}
