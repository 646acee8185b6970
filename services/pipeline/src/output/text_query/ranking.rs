//! Ranks the groups of a scene by a text.

use super::described::{DescribedGroup, DescribedGroups};
use super::prompts::prompt;
use crate::RunError;
use segwild_flow::Stopper;
use segwild_segmenter::SegmentError;
use segwild_segmenter::scene_tree::{GroupCandidate, SceneTree};
use segwild_vision::TextEmbedder;
use serde::Serialize;

/// Characters of a text at most; a model reads no more than some dozen words.
const MOST_CHARACTERS: usize = 300;
/// Before a text that means all objects of a sort: `all windows`.
const EVERY: &str = "all ";

/// CLIP's `exp(t)` at the end of its training (docs/method.md, section 13.1): what cosines are multiplied by before the softmax
/// (Radford et al. 2021, section 2.5).
const LOGIT_SCALE: f64 = 100.0;

/// Matches of a text at most. By choice.
const MOST_MATCHES: usize = 8;
/// IoU from which two groups are one match, of which the better one counts (section 13.1). By choice.
const ALIKE: f64 = 0.7;
/// Objects that a text which means all of them selects at most. By choice.
const MOST_OBJECTS: usize = 32;
/// How much lower than the best score those of all objects of a sort may be (section 13.1). By choice.
const MARGIN: f32 = 0.1;
/// Share of the smaller one that two objects of a sort may have in common (section 13.1). By choice, as for the scene's list.
const MAX_SHARED: f64 = 0.1;
/// Score `p_0` under which a group is likelier to be something else than what the text describes (section 13.1).
const MIN_SCORE: f32 = 0.5;
/// Photos in which all objects of a sort are prompted, at most (section 13.1): each costs a mask and its refinement. By choice.
const MOST_PROMPTED: usize = 4;

/// What a text may mean: a group of the scene tree, or all of a sort together.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TextMatch {
    /// Probability that the text describes it rather than any object, in [0, 1]; of several groups their mean.
    pub score: f32,
    /// Its share of the light that all photos see, in [0, 1].
    pub light: f32,
    /// Groups of the scene tree that it has.
    pub groups: usize,
    /// Its number in the scene's list of objects, if it is one of them.
    pub object: Option<usize>,
    /// The photo that shows it best.
    pub photo: String,
    /// Views in which it is outlined.
    #[serde(skip)]
    pub(crate) views: Vec<usize>,
    /// The groups.
    #[serde(skip)]
    pub(crate) meant: GroupCandidate,
}

/// What a text may mean, the likeliest first. [`alternative`](segwild_segmenter::SegmentSettings::alternative) selects one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TextRanking {
    /// The text.
    pub text: String,
    /// What it may mean; at least one.
    pub matches: Vec<TextMatch>,
}

/// A text of a query.
#[derive(Debug, PartialEq, Eq)]
struct TextQuery<'a> {
    /// Whether all objects of a sort are meant.
    every: bool,
    /// What they are.
    what: &'a str,
}

impl TextQuery<'_> {
    fn of(text: &str) -> Result<TextQuery<'_>, RunError> {
        let text = text.trim();
        if text.chars().count() > MOST_CHARACTERS {
            return Err(RunError::Request(format!(
                "the text has more than {MOST_CHARACTERS} characters: some words do, such as `the dome` or `all windows`"
            )));
        }
        let start = text.get(..EVERY.len()).filter(|start| start.eq_ignore_ascii_case(EVERY));
        let what = start.map_or(text, |start| text[start.len()..].trim_start());
        if what.is_empty() {
            return Err(RunError::Request(
                "the text is empty: give some words, such as `the dome` or `all windows`".into(),
            ));
        }
        Ok(TextQuery { every: start.is_some(), what })
    }
}

/// How well a text describes a group.
#[derive(Clone, Copy, Debug)]
struct GroupScore {
    /// Probability that it does rather than one of the texts that describe anything.
    score: f32,
    /// Cosine of the two: it orders groups whose probability is 1.
    cosine: f64,
}

/// Probability of the first among all, by their cosines.
fn first_share(cosines: &[f64]) -> f32 {
    let logits: Vec<f64> = cosines.iter().map(|cosine| LOGIT_SCALE * cosine).collect();
    let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = logits.iter().map(|logit| (logit - top).exp()).sum();
    logits.first().map_or(0.0, |first| ((first - top).exp() / sum) as f32)
}

fn cosine(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

impl TextRanking {
    /// Refuses a text that no query can have, before anything is computed.
    ///
    /// # Errors
    /// When it is empty or too long.
    pub fn check(text: &str) -> Result<(), RunError> {
        TextQuery::of(text).map(drop)
    }

    /// Ranks the groups of a scene. `photos`: the names of its photos.
    ///
    /// # Errors
    /// When the text cannot be used, the model fails, no group shows in a photo, or `stopper` stops it.
    pub(crate) fn of(
        text: &str,
        described: &DescribedGroups,
        tree: &SceneTree,
        photos: &[&str],
        embedder: &dyn TextEmbedder,
        stopper: &Stopper,
    ) -> Result<TextRanking, RunError> {
        let query = TextQuery::of(text)?;
        let embedded = embedder.embed_texts(&[prompt(query.what)])?;
        described.fit_texts(&embedded)?;
        let texts = || embedded.iter().chain(&described.negatives);
        let score = |group: &DescribedGroup| {
            let cosines: Vec<f64> = texts().map(|text| cosine(&group.embedding, text)).collect();
            GroupScore { score: first_share(&cosines), cosine: cosines.first().copied().unwrap_or(0.0) }
        };
        let groups = &described.groups;
        let scores: Vec<GroupScore> = groups.iter().map(score).collect();
        let found = best(tree, groups, &scores, query.every, stopper)?;
        let photo = |view: u32| photos.get(view as usize).map_or_else(String::new, |name| (*name).to_owned());
        let single = |&i: &usize| TextMatch {
            score: scores[i].score,
            light: groups[i].area,
            groups: 1,
            object: (groups[i].object > 0).then_some(groups[i].object as usize),
            photo: photo(groups[i].views[0]),
            views: vec![groups[i].views[0] as usize],
            meant: groups[i].candidate(),
        };
        let mut matches: Vec<TextMatch> = found.iter().map(single).collect();
        if query.every && matches.len() > 1 {
            matches.insert(0, together(&matches));
        }
        matches.truncate(MOST_OBJECTS);
        if matches.is_empty() {
            return Err(
                SegmentError::NothingSelected { reason: "no group of the scene shows in a photo" }.into()
            );
        }
        Ok(TextRanking { text: text.trim().to_owned(), matches })
    }

    /// The match that a setting selects: the last one where there are fewer.
    pub fn selected(&self, alternative: u32) -> Option<&TextMatch> {
        self.matches.get(alternative as usize).or(self.matches.last())
    }

    /// A warning where the text hardly describes the match that a setting selects.
    pub(crate) fn warning(&self, alternative: u32) -> Option<String> {
        let score = self.selected(alternative)?.score;
        (score < MIN_SCORE).then(|| {
            format!(
                "what `{}` selects has a score of {score:.2}: under {MIN_SCORE} it is likelier to be something else, and what the \
                 text describes may not be in the scene",
                self.text
            )
        })
    }
}

/// All matches as one.
fn together(matches: &[TextMatch]) -> TextMatch {
    let mean = |of: fn(&TextMatch) -> f32| matches.iter().map(of).sum::<f32>() / matches.len().max(1) as f32;
    let mut views: Vec<usize> = Vec::new();
    for view in matches.iter().flat_map(|found| &found.views) {
        if !views.contains(view) {
            views.push(*view);
        }
    }
    views.truncate(MOST_PROMPTED);
    let light = matches.iter().map(|found| found.light).sum();
    TextMatch {
        score: mean(|found| found.score),
        light,
        groups: matches.len(),
        object: None,
        photo: matches.first().map(|found| found.photo.clone()).unwrap_or_default(),
        views,
        meant: GroupCandidate {
            nodes: matches.iter().flat_map(|found| found.meant.nodes.clone()).collect(),
            score: mean(|found| found.meant.score),
            area: light,
        },
    }
}

/// The groups with the highest scores, each once: those that have most in common with a better one are left out. `every`: those
/// that have hardly anything in common, as long as the score is near the best and no lower than [`MIN_SCORE`]; the best one in any
/// case.
fn best(
    tree: &SceneTree,
    groups: &[DescribedGroup],
    scores: &[GroupScore],
    every: bool,
    stopper: &Stopper,
) -> Result<Vec<usize>, RunError> {
    let areas: Vec<f64> = tree.leaf_light().map(f64::from).collect();
    let mut order: Vec<usize> = (0..groups.len()).collect();
    order.sort_by(|&a, &b| {
        let (of_a, of_b) = (scores[a], scores[b]);
        of_b.score.total_cmp(&of_a.score).then(of_b.cosine.total_cmp(&of_a.cosine)).then(a.cmp(&b))
    });
    let most = if every { MOST_OBJECTS } else { MOST_MATCHES };
    let least = order.first().map_or(0.0, |&first| (scores[first].score - MARGIN).max(MIN_SCORE));
    let mut kept: Vec<(usize, Vec<bool>, f64)> = Vec::new();
    for i in order {
        RunError::unless_running(stopper)?;
        if kept.len() == most || (every && !kept.is_empty() && scores[i].score < least) {
            break;
        }
        let inside = tree.leaves_of(&groups[i].candidate());
        let own = areas.iter().zip(&inside).enumerate().filter(|(_, (_, inside))| **inside);
        let own: Vec<(usize, f64)> = own.map(|(leaf, (area, _))| (leaf, *area)).collect();
        let area: f64 = own.iter().map(|(_, area)| area).sum();
        let apart = kept.iter().all(|(_, other, of_other)| {
            let shared: f64 = own.iter().filter(|(leaf, _)| other[*leaf]).map(|(_, area)| area).sum();
            match every {
                true => shared <= MAX_SHARED * area.min(*of_other),
                false => shared < ALIKE * (area + of_other - shared),
            }
        });
        if apart {
            kept.push((i, inside, area));
        }
    }
    Ok(kept.into_iter().map(|(i, ..)| i).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::text_query::prompts::negatives;
    use segwild_scene::Image;
    use segwild_segmenter::scene_tree::{GroupTree, MergeTree, SplatGroup};
    use segwild_vision::VisionError;
    use std::sync::Mutex;

    #[test]
    fn a_text_is_one_thing_or_all_of_a_sort() {
        let of = |text: &'static str| TextQuery::of(text).map_err(|e| e.to_string());
        assert_eq!(of(" the dome "), Ok(TextQuery { every: false, what: "the dome" }));
        assert_eq!(of("All  windows"), Ok(TextQuery { every: true, what: "windows" }));
        assert_eq!(of("allotment"), Ok(TextQuery { every: false, what: "allotment" }));
        assert_eq!(of("全部の窓"), Ok(TextQuery { every: false, what: "全部の窓" }));
        for empty in ["", "  \t"] {
            assert!(of(empty).unwrap_err().contains("the dome"), "{empty}");
        }
        let long = "x".repeat(MOST_CHARACTERS + 1);
        assert!(TextRanking::check(&long).unwrap_err().to_string().contains("300 characters"));
    }

    /// Words are axes: a text is near to the groups of its word.
    struct WordAxes(Mutex<Vec<String>>);

    const AXES: [&str; 3] = ["red", "green", "blue"];

    impl TextEmbedder for WordAxes {
        fn key(&self) -> Result<String, VisionError> {
            Ok("axes".into())
        }
        fn embed_images(&self, _: &[Image]) -> Result<Vec<Vec<f32>>, VisionError> {
            Err(VisionError::Image("it is not called".into()))
        }
        fn embed_texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>, VisionError> {
            self.0.lock().unwrap().extend(texts.iter().cloned());
            let axis = |text: &String| -> Vec<f32> {
                let at = AXES.iter().position(|word| text.ends_with(*word)).unwrap_or(AXES.len());
                (0..=AXES.len()).map(|i| f32::from(u8::from(i == at))).collect()
            };
            Ok(texts.iter().map(axis).collect())
        }
    }

    /// Leaves 0 to 3 of equal light; 4 holds 0 and 1, 5 holds 2 and 3, 6 all.
    fn tree() -> SceneTree {
        let merges = MergeTree {
            leaves: 4,
            parent: vec![4, 4, 5, 5, 6, 6, 6],
            height: vec![0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0],
        };
        let groups = [0.25, 0.25, 0.25, 0.25, 0.5, 0.5, 1.0];
        let groups = groups.map(|area| SplatGroup { area, ..SplatGroup::default() }).to_vec();
        SceneTree {
            leaf: vec![0, 1, 2, 3],
            trees: vec![GroupTree { merges, groups }; 5],
            surfaces: Vec::new(),
            shown_by: vec![2; 4],
        }
    }

    fn group(tree: u32, node: u32, object: u32, embedding: [f32; 4]) -> DescribedGroup {
        let length = embedding.iter().map(|v| v * v).sum::<f32>().sqrt();
        DescribedGroup {
            tree,
            node,
            score: 0.5,
            area: if node < 4 { 0.25 } else { 0.5 },
            object,
            views: vec![object % 2],
            embedding: embedding.iter().map(|v| v / length).collect(),
        }
    }

    fn described() -> DescribedGroups {
        let groups = vec![
            group(0, 0, 1, [1.0, 0.0, 0.0, 0.1]),
            group(0, 1, 2, [0.0, 1.0, 0.0, 0.1]),
            group(0, 3, 3, [0.98, 0.1, 0.0, 0.1]),
            // The first once more, by another tree, and what holds it.
            group(1, 0, 0, [0.99, 0.05, 0.0, 0.1]),
            group(0, 4, 0, [0.8, 0.7, 0.0, 0.1]),
        ];
        let negatives = WordAxes(Mutex::default()).embed_texts(&negatives()).unwrap();
        DescribedGroups { groups, negatives }
    }

    fn ranked_of(
        text: &str,
        described: &DescribedGroups,
        stopper: &Stopper,
    ) -> Result<TextRanking, RunError> {
        let axes = WordAxes(Mutex::default());
        let ranking = TextRanking::of(text, described, &tree(), &["a.jpg", "b.jpg"], &axes, stopper);
        let texts = axes.0.into_inner().unwrap();
        assert!(texts.len() == 1 && texts[0].starts_with("a photo of "), "{texts:?}");
        ranking
    }

    fn ranked(text: &str) -> TextRanking {
        ranked_of(text, &described(), &Stopper::new()).unwrap()
    }

    #[test]
    fn embeddings_of_two_lengths_are_refused_and_a_stopped_query_ends() {
        let mut other = described();
        other.groups[2].embedding.truncate(3);
        let refused = ranked_of("red", &other, &Stopper::new()).unwrap_err().to_string();
        assert!(refused.contains("a text as 4 numbers and an image as 3"), "{refused}");
        let stopper = Stopper::new();
        stopper.stop();
        assert!(matches!(ranked_of("red", &described(), &stopper), Err(RunError::Interrupted)));
    }

    #[test]
    fn the_group_that_the_text_describes_comes_first_and_none_twice() {
        let ranking = ranked("red");
        let found: Vec<_> = ranking.matches.iter().map(|m| m.meant.nodes[0]).collect();
        assert_eq!(found[..3], [(0, 0), (0, 3), (0, 4)], "{ranking:?}");
        assert!(!found.contains(&(1, 0)), "the same leaves as the first");
        let first = &ranking.matches[0];
        assert!(first.score > 0.9 && (first.object, first.groups, &*first.photo) == (Some(1), 1, "b.jpg"));
        assert!(ranking.matches.windows(2).all(|pair| pair[0].score >= pair[1].score));
        assert_eq!(ranked("green").matches[0].meant.nodes, [(0, 1)]);
        // Nothing is blue.
        let blue = ranked("blue");
        assert!(blue.matches[0].score < MIN_SCORE);
        assert!(blue.warning(0).unwrap().contains("`blue`") && ranking.warning(0).is_none());
        assert_eq!(ranked("all blue").matches.len(), 1, "the best one alone");
        assert_eq!(ranking.selected(1).unwrap().meant.nodes, [(0, 3)]);
        assert_eq!(ranking.selected(99), ranking.matches.last());
    }

    #[test]
    fn all_of_a_sort_are_selected_together_and_can_be_had_alone() {
        let ranking = ranked("all red");
        let all = &ranking.matches[0];
        assert_eq!(all.meant.nodes, [(0, 0), (0, 3)], "{ranking:?}");
        assert_eq!((all.groups, all.light, &all.views[..]), (2, 0.5, &[1][..]));
        let alone: Vec<_> = ranking.matches[1..].iter().map(|m| m.meant.nodes.clone()).collect();
        assert_eq!(alone, [[(0, 0)], [(0, 3)]]);
        // Of one alone there is no other.
        assert_eq!(ranked("all green").matches[0].groups, 1);
    }
}
