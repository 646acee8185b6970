//! How sure a selection is, by the agreement of photos, of the object's sides and of the levels of the scene tree (method, section
//! 6.8).

use crate::PhotoAgreement;
use crate::photo_agreement::{MeasuredPhoto, MeasuredPhotos};
use crate::sides::{ShownSide, SideAgreement, nearest_cosine, side_at};
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Expected IoU of a selection with what is meant: a linear combination of what agrees with it, clamped to [0, 1] (method, section
/// 6.8).
struct ConfidenceWeights {
    constant: f32,
    /// Of the expected IoU of the scene tree's group.
    expected_iou: f32,
    /// Of the mean agreement of all photos.
    agreement: f32,
    /// Of the agreement of the side that agrees least.
    worst_side: f32,
    /// Of the IoU with the next alternative of the scene tree.
    levels: f32,
}

/// From docs/experiments/2026-11-30-confidence.md: a linear regression of the IoU of random clicks and boxes, with [`UNKNOWN`] for
/// what is not known.
const CONFIDENCE: ConfidenceWeights = ConfidenceWeights {
    constant: -0.55,
    expected_iou: 0.17,
    agreement: 0.51,
    worst_side: 0.76,
    levels: 0.17,
};

/// Stands for a term that is not known, such as the expected IoU of a photo's own mask. Part of the fit.
const UNKNOWN: f32 = 0.5;

/// By how much less the far side may agree than the prompted one before the selection is lopsided (method, section 6.8). By choice.
const LOPSIDED_MARGIN: f32 = 0.15;

/// Photos of the far side without which nothing is known of it (method, section 6.8). By choice: one photo may be wrong.
const MIN_FAR_PHOTOS: usize = 2;

/// Agreement from which a click in a photo helps little (method, section 6.8). By choice: outlines differ by as much.
const HELPED_UNDER: f32 = 0.9;

/// Cosine of the angle to a prompted photo, as seen from the object, from which another photo shows nothing new: 20 degrees
/// (method, section 6.8). By choice.
const NEAR_COSINE: f32 = 0.94;

/// Photos that disagree which a sentence names, at most.
const NAMED_PHOTOS: usize = 5;

/// Why a selection may be good on the prompted side only.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lopsided {
    /// The photos of the far side agree much less.
    Disagrees,
    /// Too few photos of the far side were compared, although the scene has some.
    Unseen,
}

/// The scene tree's numbers for a selection.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct TreeOpinion {
    /// The expected IoU of its group; `None` where the photos' own masks answered.
    pub expected_iou: Option<f32>,
    /// IoU of the selection with the next alternative; `None` where there is none.
    pub levels_agreement: Option<f32>,
}

/// How sure a selection is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SelectionConfidence {
    /// The IoU with what is meant that is to be expected, in [0, 1].
    pub value: f32,
    /// Mean agreement of the photos, in [0, 1]; `None` where no photo has a mask.
    pub agreement: Option<f32>,
    /// Agreement of the side that agrees least, in [0, 1]; a far side of too few photos is left out.
    pub worst_side_agreement: Option<f32>,
    /// IoU of the selection with the next alternative of the scene tree, in [0, 1]: how little the answer depends on the level.
    /// `None` where there is no other.
    pub levels_agreement: Option<f32>,
    /// The side that was prompted.
    pub prompted_side: SideAgreement,
    /// The rest of the object.
    pub far_side: SideAgreement,
    /// Why the selection may be good on the prompted side only; `None` where both sides agree.
    pub lopsided: Option<Lopsided>,
    /// The photo in which one more click would help most; `None` where none would help much.
    pub next_click: Option<String>,
    /// The photos that have masks of their own: those that were prompted, then the others.
    pub photos: Vec<PhotoAgreement>,
}

impl SelectionConfidence {
    /// Of the photos that have masks. One disagrees that agrees by less than `gate`.
    pub(crate) fn of(
        MeasuredPhotos { photos: measured, facing }: &MeasuredPhotos,
        tree: TreeOpinion,
        gate: f32,
    ) -> SelectionConfidence {
        let prompted: Vec<Vec3> = measured.iter().filter(|p| p.prompted).map(|p| p.direction).collect();
        let to_prompted = |p: &MeasuredPhoto| match p.prompted {
            true => 1.0,
            false => nearest_cosine(p.direction, &prompted),
        };
        let cosines: Vec<f32> = measured.iter().map(to_prompted).collect();
        let is_far = |direction: &&Vec3| side_at(nearest_cosine(**direction, &prompted)) == ShownSide::Far;
        let far_views = facing.iter().filter(is_far).count();
        let side = |of: ShownSide| {
            let shows = measured.iter().zip(&cosines).filter(|(_, cosine)| side_at(**cosine) == of);
            SideAgreement::of(&shows.map(|(photo, _)| photo.agreement).collect::<Vec<_>>())
        };
        let (prompted_side, far_side) = (side(ShownSide::Prompted), side(ShownSide::Far));
        let agreement =
            SideAgreement::of(&measured.iter().map(|p| p.agreement).collect::<Vec<_>>()).agreement;
        let far = far_side.agreement.filter(|_| far_side.photos >= MIN_FAR_PHOTOS);
        let worst_side_agreement = [prompted_side.agreement, far].into_iter().flatten().reduce(f32::min);
        let lopsided = lopsided(prompted_side.agreement, far, far_views);
        let photos = measured.iter().zip(&cosines).map(|(photo, &cosine)| PhotoAgreement {
            photo: photo.photo.clone(),
            prompted: photo.prompted,
            side: side_at(cosine),
            agreement: photo.agreement,
            shown: photo.shown,
            disagrees: photo.agreement < gate,
        });
        SelectionConfidence {
            value: combined(tree, agreement, worst_side_agreement),
            agreement,
            worst_side_agreement,
            levels_agreement: tree.levels_agreement,
            prompted_side,
            far_side,
            lopsided,
            next_click: next_click(measured, &cosines, lopsided),
            photos: photos.collect(),
        }
    }

    /// The photos that disagree, those first that agree least.
    pub fn disagreeing(&self) -> Vec<&PhotoAgreement> {
        let mut photos: Vec<&PhotoAgreement> = self.photos.iter().filter(|photo| photo.disagrees).collect();
        photos.sort_by(|a, b| a.agreement.total_cmp(&b.agreement));
        photos
    }

    /// How sure the selection is, in words: sentences without a full stop.
    pub fn sentences(&self) -> Vec<String> {
        let of_side = |side: SideAgreement, name: &str| {
            let agreement = side.agreement?;
            Some(format!("{agreement:.2} in {} of the {name} side", counted(side.photos)))
        };
        let sides = [of_side(self.prompted_side, "prompted"), of_side(self.far_side, "other")];
        let sides: Vec<String> = sides.into_iter().flatten().collect();
        let compared = match sides.is_empty() {
            true => "no photo was compared with the selection".into(),
            false => format!("agreement {}", sides.join(", ")),
        };
        let mut words = vec![format!("confidence {:.2}: {compared}", self.value)];
        match (self.lopsided, self.far_side.photos) {
            (Some(Lopsided::Disagrees), _) => words.push(
                "the answer is lopsided: it fits the prompted side, and the other side much less".into(),
            ),
            (Some(Lopsided::Unseen), 0) => words.push("its other side was checked in no photo".into()),
            (Some(Lopsided::Unseen), few) => {
                words.push(format!("its other side was checked in {} only", counted(few)));
            }
            (None, _) => {}
        }
        let disagreeing = self.disagreeing();
        if !disagreeing.is_empty() {
            let named = disagreeing.iter().take(NAMED_PHOTOS);
            let named: Vec<String> = named.map(|p| format!("{} ({:.2})", p.photo, p.agreement)).collect();
            let more = match disagreeing.len().saturating_sub(NAMED_PHOTOS) {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            words.push(format!("the selection differs from the own masks of {}{more}", named.join(", ")));
        }
        if let Some(photo) = &self.next_click {
            words.push(format!("one more click would help most in {photo}"));
        }
        words
    }
}

/// A number of photos, in words.
pub fn counted(photos: usize) -> String {
    if photos == 1 { "1 photo".into() } else { format!("{photos} photos") }
}

/// The value of [`CONFIDENCE`].
fn combined(tree: TreeOpinion, agreement: Option<f32>, worst_side: Option<f32>) -> f32 {
    let known = |term: Option<f32>| term.unwrap_or(UNKNOWN);
    let sum = CONFIDENCE.constant
        + CONFIDENCE.expected_iou * known(tree.expected_iou)
        + CONFIDENCE.agreement * known(agreement)
        + CONFIDENCE.worst_side * known(worst_side)
        + CONFIDENCE.levels * known(tree.levels_agreement);
    if sum.is_nan() { 0.0 } else { sum.clamp(0.0, 1.0) }
}

/// Whether a selection is lopsided, by the agreement of its sides: that of the far one is `None` where too few photos of it were
/// compared, of the `far_views` that the scene has.
fn lopsided(prompted: Option<f32>, far: Option<f32>, far_views: usize) -> Option<Lopsided> {
    match (prompted?, far) {
        (_, None) => (far_views >= MIN_FAR_PHOTOS).then_some(Lopsided::Unseen),
        (prompted, Some(far)) => (far < prompted - LOPSIDED_MARGIN).then_some(Lopsided::Disagrees),
    }
}

/// The photo in which one more click would help most: it disagrees, shows much of the object, and is not near a prompted one. Of a
/// selection that is wrong on its far side, a photo of that side.
fn next_click(measured: &[MeasuredPhoto], cosines: &[f32], lopsided: Option<Lopsided>) -> Option<String> {
    let most = measured.iter().map(|photo| photo.shown).fold(0.0, f32::max);
    let open = |photo: &MeasuredPhoto, cosine: f32| {
        let fits = lopsided != Some(Lopsided::Disagrees) || side_at(cosine) == ShownSide::Far;
        fits && !photo.prompted && cosine < NEAR_COSINE && photo.agreement < HELPED_UNDER && photo.shown > 0.0
    };
    let mut best: Option<(f32, &MeasuredPhoto)> = None;
    for (photo, _) in measured.iter().zip(cosines).filter(|(photo, cosine)| open(photo, **cosine)) {
        // Lengths count, not areas: half as large is half as easy to click.
        let worth = (1.0 - photo.agreement) * (photo.shown / most).sqrt();
        if best.is_none_or(|(most, _)| worth > most) {
            best = Some((worth, photo));
        }
    }
    best.map(|(_, photo)| photo.photo.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photo at some degrees around the object.
    fn photo(name: &str, degrees: f32, agreement: f32, shown: f32) -> MeasuredPhoto {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let direction = Vec3::new(cos, 0.0, sin);
        MeasuredPhoto { photo: name.into(), prompted: name == "clicked", direction, agreement, shown }
    }

    fn facing(photos: &[MeasuredPhoto], facing: &[Vec3]) -> SelectionConfidence {
        let measured = MeasuredPhotos { photos: photos.to_vec(), facing: facing.to_vec() };
        SelectionConfidence::of(&measured, TreeOpinion::default(), 0.6)
    }

    /// Of a scene whose photos were all compared.
    fn of(photos: &[MeasuredPhoto]) -> SelectionConfidence {
        facing(photos, &photos.iter().map(|photo| photo.direction).collect::<Vec<_>>())
    }

    #[test]
    fn an_answer_that_is_good_on_the_clicked_side_only_is_lopsided() {
        let far = |agreement: f32| {
            of(&[
                photo("clicked", 0.0, 0.95, 0.2),
                photo("beside", 40.0, 0.85, 0.2),
                photo("back", 170.0, agreement, 0.2),
                photo("left", 250.0, agreement, 0.1),
            ])
        };
        let good = far(0.8);
        assert_eq!((good.lopsided, good.far_side.photos, good.prompted_side.photos), (None, 2, 2));
        let bad = far(0.4);
        assert_eq!(bad.lopsided, Some(Lopsided::Disagrees));
        assert!((bad.worst_side_agreement.unwrap() - 0.4).abs() < 1e-6);
        assert!((bad.agreement.unwrap() - 0.65).abs() < 1e-6);
        assert!(bad.value < good.value - 0.1, "{} {}", bad.value, good.value);
        assert_eq!(bad.photos.iter().filter(|photo| photo.disagrees).count(), 2);
        let words = bad.sentences();
        assert!(
            words[0].contains(
                "agreement 0.90 in 2 photos of the prompted side, 0.40 in 2 photos of the other side"
            )
        );
        assert!(words[1].contains("lopsided") && words[2].contains("back (0.40), left (0.40)"), "{words:?}");
        assert!(!good.sentences().iter().any(|words| words.contains("lopsided")));
    }

    #[test]
    fn a_far_side_of_one_photo_is_unknown_and_counts_for_nothing() {
        let photos = [photo("clicked", 0.0, 0.9, 0.2), photo("back", 180.0, 0.1, 0.2)];
        let few = facing(&photos, &[Vec3::X, -Vec3::X, -Vec3::X]);
        assert_eq!((few.lopsided, few.far_side.photos), (Some(Lopsided::Unseen), 1));
        assert_eq!(few.worst_side_agreement, Some(0.9));
        assert!(few.sentences()[1].contains("checked in 1 photo only"), "{:?}", few.sentences());
        let none = facing(&photos[..1], &[Vec3::X, -Vec3::X, -Vec3::X]);
        assert!(none.sentences()[1].contains("checked in no photo"));
    }

    #[test]
    fn a_facade_without_views_of_its_back_is_not_called_unchecked() {
        let front = of(&[photo("clicked", 0.0, 0.9, 0.2), photo("beside", 40.0, 0.9, 0.2)]);
        assert_eq!(front.lopsided, None);
        // Nor is an object with clicks all around it.
        let mut around = [photo("clicked", 0.0, 0.9, 0.2), photo("back", 180.0, 0.9, 0.2)];
        around[1].prompted = true;
        assert_eq!(of(&around).lopsided, None);
    }

    #[test]
    fn one_more_click_helps_in_a_photo_that_disagrees_shows_much_and_is_not_near() {
        let mut photos = vec![
            photo("clicked", 0.0, 0.9, 0.2),
            // Worse than all others, but from where the clicked photo was taken.
            photo("near", 10.0, 0.1, 0.2),
            photo("beside", 50.0, 0.6, 0.2),
            // Worse, but the object is a speck in it.
            photo("speck", 55.0, 0.4, 0.0002),
            photo("back", 180.0, 0.75, 0.2),
            photo("other back", 190.0, 0.8, 0.2),
        ];
        let next = |photos: &[MeasuredPhoto]| of(photos).next_click;
        assert_eq!(next(&photos).as_deref(), Some("beside"));
        // Lopsided: a photo of the far side, whatever the others are.
        (photos[1].agreement, photos[4].agreement, photos[5].agreement) = (0.9, 0.3, 0.35);
        photos[2].agreement = 0.2;
        photos.push(photo("clicked side", -50.0, 0.95, 0.2));
        assert_eq!(of(&photos).lopsided, Some(Lopsided::Disagrees));
        assert_eq!(next(&photos).as_deref(), Some("back"));
        photos.iter_mut().for_each(|photo| photo.agreement = 0.95);
        assert_eq!(next(&photos), None, "no click would help much");
    }

    #[test]
    fn confidence_grows_with_each_term_and_stays_a_share() {
        let value = |expected_iou: f32, levels: f32, agreement: f32| {
            let tree = TreeOpinion { expected_iou: Some(expected_iou), levels_agreement: Some(levels) };
            combined(tree, Some(agreement), Some(agreement))
        };
        let base = value(0.5, 0.5, 0.5);
        assert!(value(0.9, 0.5, 0.5) > base && value(0.5, 0.9, 0.5) > base && value(0.5, 0.5, 0.9) > base);
        assert_eq!(combined(TreeOpinion::default(), None, None), base, "what is not known is one half");
        assert_eq!((value(5.0, 5.0, 5.0), value(-5.0, -5.0, -5.0)), (1.0, 0.0));
        assert_eq!(value(f32::NAN, 0.5, 0.5), 0.0);
        let nothing = of(&[]);
        assert!(nothing.lopsided.is_none() && nothing.next_click.is_none() && nothing.agreement.is_none());
    }
}
