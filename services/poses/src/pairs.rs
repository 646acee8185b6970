//! The step `pairs`: which photos are compared.

use crate::PairChoice;

/// Each photo is compared with so many of the most similar ones.
pub(crate) const NEAREST: u64 = 50;
/// Up to so many photos all pairs are compared: with more, the nearest ones are fewer pairs.
const EXHAUSTIVE: usize = 2 * NEAREST as usize;
/// Each frame of a video is compared with so many that follow it, and with the powers of two farther on.
pub(crate) const FOLLOWING: u64 = 10;
/// Beside those, each is compared with so many of the most similar ones: the camera may come back.
pub(crate) const RETURNING: u64 = 10;
/// Photos per block of an exhaustive comparison. COLMAP keeps the pairs of whole blocks; with its own 50, a stop would lose an hour.
pub(crate) const BLOCK: u64 = 10;
/// Photos whose features the vocabulary tree is made of, and most words of it. COLMAP compares every feature with every word
/// (a tenth of a microsecond each, measured): its own 65,536 words of all photos would take hours.
pub(crate) const TREE_PHOTOS: usize = 64;
const MOST_WORDS: u64 = 4096;
/// Features per word: with fewer, the nearest photos were less often those that show the same.
const PER_WORD: u64 = 100;
/// Branches of each node of the tree, and rounds of clustering. COLMAP's 256 and 11 take several times as long for no better
/// neighbours.
pub(crate) const TREE_BRANCHES: u64 = 32;
pub(crate) const TREE_ROUNDS: u64 = 4;
/// Words among which COLMAP searches the nearest of a feature.
pub(crate) const TREE_CHECKS: u64 = 64;

/// Which pairs are compared of so many photos.
pub(crate) fn decided(choice: PairChoice, photos: usize, of_video: bool) -> PairChoice {
    match choice {
        PairChoice::Auto if photos <= EXHAUSTIVE => PairChoice::Exhaustive,
        PairChoice::Auto if of_video => PairChoice::Sequential,
        PairChoice::Auto => PairChoice::Nearest,
        named => named,
    }
}

/// Words of the vocabulary tree of so many features.
pub(crate) fn tree_words(features: u64) -> u64 {
    (features / PER_WORD).clamp(256, MOST_WORDS)
}

/// The choice in words.
pub(crate) fn in_words(choice: PairChoice, photos: usize) -> String {
    match choice {
        PairChoice::Nearest => format!("each of {photos} photos is compared with the {NEAREST} most similar"),
        PairChoice::Sequential => format!("each of {photos} photos is compared with those that follow it"),
        _ => format!("all {} pairs of {photos} photos are compared", photos * photos.saturating_sub(1) / 2),
    }
}

/// Blocks of an exhaustive comparison that are done, and all, after the line of block `[i/n, j/n]`.
pub(crate) fn blocks(numbers: &[u64]) -> Option<(u64, u64)> {
    let &[i, n, j, _] = numbers else { return None };
    Some((i.checked_sub(1)? * n + j, n * n))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_pairs_are_compared_while_the_nearest_would_be_no_fewer() {
        let auto = |photos, video| decided(PairChoice::Auto, photos, video);
        assert_eq!((auto(12, false), auto(100, true)), (PairChoice::Exhaustive, PairChoice::Exhaustive));
        assert_eq!((auto(101, false), auto(101, true)), (PairChoice::Nearest, PairChoice::Sequential));
        assert_eq!(decided(PairChoice::Exhaustive, 5000, false), PairChoice::Exhaustive);
    }

    #[test]
    fn blocks_are_counted_row_by_row() {
        assert_eq!(blocks(&[1, 3, 1, 3]), Some((1, 9)));
        assert_eq!(blocks(&[3, 3, 3, 3]), Some((9, 9)));
        assert_eq!(blocks(&[12, 40]), None);
        assert_eq!(blocks(&[0, 3, 1, 3]), None);
    }

    #[test]
    fn a_tree_has_no_more_words_than_features_can_fill() {
        assert_eq!((tree_words(100), tree_words(200_000), tree_words(10_000_000)), (256, 2_000, MOST_WORDS));
    }
}
