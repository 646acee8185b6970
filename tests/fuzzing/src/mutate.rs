//! Changes of good inputs: bits, lengths, numbers, words, cuts, splices. The same seed gives the same inputs.

/// SplitMix64.
#[derive(Clone, Debug)]
pub struct FuzzDice(u64);

impl FuzzDice {
    /// Dice of a seed and a name.
    pub fn new(seed: u64, name: &str) -> FuzzDice {
        let hash = blake3::hash(name.as_bytes());
        let mut first = [0; 8];
        first.copy_from_slice(&hash.as_bytes()[..8]);
        FuzzDice(seed ^ u64::from_le_bytes(first))
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `n`; 0 where there is none.
    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % (n.max(1) as u64)) as usize
    }

    /// One of several things, if there is one.
    pub fn one_of<'a, T>(&mut self, things: &'a [T]) -> Option<&'a T> {
        things.get(self.below(things.len()))
    }
}

/// Inputs grow no longer than this, in bytes.
pub const LONGEST: usize = 1 << 18;
/// Values at which lengths, counts and sizes go wrong.
const NUMBERS: [u64; 16] = [
    0,
    1,
    2,
    3,
    7,
    127,
    255,
    65_535,
    65_536,
    1 << 20,
    (1 << 31) - 1,
    1 << 31,
    u32::MAX as u64,
    1 << 40,
    i64::MAX as u64,
    u64::MAX,
];
/// What a text may have instead of a number.
const WORDS: [&str; 14] = [
    "0",
    "-1",
    "1e308",
    "-1e-320",
    "nan",
    "inf",
    "99999999999999999999",
    "4294967296",
    "1e400",
    "",
    "\"",
    "{",
    "[[",
    "null",
];

/// A change of one of the good inputs, of one to six steps.
pub fn change(dice: &mut FuzzDice, seeds: &[Vec<u8>], words: &[&str]) -> Vec<u8> {
    let mut bytes = dice.one_of(seeds).cloned().unwrap_or_default();
    for _ in 0..=dice.below(6) {
        step(dice, &mut bytes, seeds, words);
    }
    bytes.truncate(LONGEST);
    bytes
}

fn step(dice: &mut FuzzDice, bytes: &mut Vec<u8>, seeds: &[Vec<u8>], words: &[&str]) {
    let at = dice.below(bytes.len());
    match dice.below(14) {
        0 | 1 => flip(dice, bytes, at),
        2 => put_at(bytes, at, &[dice.next() as u8]),
        3..=5 => number(dice, bytes, at),
        6 => bytes.truncate(at),
        7 => drop(bytes.drain(at..(at + 1 + dice.below(32)).min(bytes.len()))),
        8 => repeat(dice, bytes, at),
        9 => splice(dice, bytes, at, seeds),
        10 | 11 => digits(dice, bytes, at),
        12 => insert(bytes, at, dice.one_of(words).copied().unwrap_or_default().as_bytes()),
        _ => put_at(bytes, at, dice.one_of(words).copied().unwrap_or_default().as_bytes()),
    }
}

fn flip(dice: &mut FuzzDice, bytes: &mut [u8], at: usize) {
    if let Some(byte) = bytes.get_mut(at) {
        *byte ^= 1 << dice.below(8);
    }
}

fn put_at(bytes: &mut Vec<u8>, at: usize, with: &[u8]) {
    let end = (at + with.len()).min(bytes.len());
    bytes.splice(at.min(end)..end, with.iter().copied());
}

fn insert(bytes: &mut Vec<u8>, at: usize, with: &[u8]) {
    let at = at.min(bytes.len());
    bytes.splice(at..at, with.iter().copied());
}

/// Puts a number that is a bad length, of 1 to 8 bytes and either order, in the place of what is there. Most of the time
/// where binary formats keep theirs: at the start, or aligned.
fn number(dice: &mut FuzzDice, bytes: &mut Vec<u8>, at: usize) {
    let at = match dice.below(3) {
        0 => at % 64,
        1 => at / 4 * 4,
        _ => at,
    };
    let near = (bytes.len() as u64).wrapping_add(dice.below(5) as u64).wrapping_sub(2);
    let value = if dice.below(8) == 0 { near } else { NUMBERS[dice.below(NUMBERS.len())] };
    let width = [1, 2, 4, 8][dice.below(4)];
    let little = value.to_le_bytes();
    let mut wanted = little[..width].to_vec();
    if dice.below(2) == 0 {
        wanted.reverse();
    }
    put_at(bytes, at, &wanted);
}

fn repeat(dice: &mut FuzzDice, bytes: &mut Vec<u8>, at: usize) {
    let part = bytes[at.min(bytes.len())..(at + 1 + dice.below(64)).min(bytes.len())].to_vec();
    let most = if dice.below(16) == 0 { 1000 } else { 4 };
    let times = 1 + dice.below(most);
    insert(bytes, at, &part.repeat(times.min(LONGEST / part.len().max(1))));
}

fn splice(dice: &mut FuzzDice, bytes: &mut Vec<u8>, at: usize, seeds: &[Vec<u8>]) {
    if let Some(other) = dice.one_of(seeds) {
        bytes.truncate(at);
        bytes.extend_from_slice(&other[dice.below(other.len())..]);
    }
}

/// Puts a word in the place of the next number in a text.
fn digits(dice: &mut FuzzDice, bytes: &mut Vec<u8>, at: usize) {
    let is_part = |b: &u8| b.is_ascii_digit() || b"+-.eE".contains(b);
    let Some(start) = bytes.iter().skip(at).position(u8::is_ascii_digit).map(|i| at + i) else { return };
    let end = bytes[start..].iter().position(|b| !is_part(b)).map_or(bytes.len(), |i| start + i);
    let word = WORDS[dice.below(WORDS.len())];
    bytes.splice(start..end, word.bytes());
}
