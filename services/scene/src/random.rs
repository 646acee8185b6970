//! Seeded random numbers: the same on every machine, and small enough to be part of a checkpoint.

use wincode::{SchemaRead, SchemaWrite};

/// SplitMix64 (Steele, Lea and Flood 2014): the next 64 random bits of a state, which it advances. Every state is as good as any
/// other, 0 included.
///
/// ```
/// use segwild_scene::split_mix;
/// let mut state = 0;
/// assert_eq!(split_mix(&mut state), 0xe220_a839_7b1d_cdaf);
/// assert_eq!(split_mix(&mut state), 0x6e78_9e6a_a1b9_65f4);
/// ```
#[inline]
pub fn split_mix(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// xoshiro256++ (Blackman and Vigna), seeded by [`split_mix`].
#[derive(Clone, Debug, PartialEq, Eq, SchemaRead, SchemaWrite)]
pub struct Random {
    state: [u64; 4],
}

impl Random {
    /// A stream that depends on nothing but the seed.
    pub fn new(seed: u64) -> Random {
        let mut x = seed;
        Random { state: std::array::from_fn(|_| split_mix(&mut x)) }
    }

    /// A stream of its own for a (seed, index) pair: its samples do not depend on those of other pairs.
    pub fn stream(seed: u64, index: u64) -> Random {
        Random::new(seed ^ index.wrapping_mul(0xd1b5_4a32_d192_ed03))
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        let s = &mut self.state;
        let out = s[0].wrapping_add(s[3]).rotate_left(23).wrapping_add(s[0]);
        let t = s[1] << 17;
        s[2] ^= s[0];
        s[3] ^= s[1];
        s[1] ^= s[2];
        s[0] ^= s[3];
        s[2] ^= t;
        s[3] = s[3].rotate_left(45);
        out
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 24) as f32
    }

    /// Uniform in `0..n`; `n` must not be 0.
    pub fn below(&mut self, n: usize) -> usize {
        // Multiply-shift; its bias, n / 2^64, is nothing here.
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }

    /// Standard normal (Box-Muller, one of the pair, so that the state is only the stream's).
    pub fn normal(&mut self) -> f32 {
        let u = 1.0 - self.uniform();
        let v = self.uniform();
        (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
    }

    /// Moves `count` elements, sampled without replacement, to the front, in random order.
    pub fn draw<T>(&mut self, items: &mut [T], count: usize) {
        for i in 0..count.min(items.len()) {
            let j = i + self.below(items.len() - i);
            items.swap(i, j);
        }
    }

    /// Shuffles in place (Fisher-Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i + 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_and_range() {
        let mut r = Random::new(7);
        let n = 20_000;
        let (mut s, mut s2, mut u) = (0.0f64, 0.0f64, 0.0f64);
        for _ in 0..n {
            let x = f64::from(r.normal());
            s += x;
            s2 += x * x;
            let y = r.uniform();
            assert!((0.0..1.0).contains(&y));
            u += f64::from(y);
            assert!(r.below(3) < 3);
        }
        let n = f64::from(n);
        assert!((s / n).abs() < 0.03 && (s2 / n - 1.0).abs() < 0.05 && (u / n - 0.5).abs() < 0.01);
        assert_ne!(Random::new(1).bits(), Random::new(2).bits());
    }
}
