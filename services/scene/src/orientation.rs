//! Whether a photo is turned by its EXIF orientation, where its size cannot tell.
//!
//! Some programs compute poses on the pixels as stored (COLMAP), others on the pixels turned by the EXIF orientation. Where both have
//! one size (orientations 2, 3 and 4, and all of a square photo) the points decide, for a point has the colour of the pixels that
//! show it.
//!
//! Model: at the keypoint of a point of colour `c`, the photo read the right way has the value `p = g c + noise` in each channel, with
//! one gain `g` for exposure and white balance. Read the wrong way, `p` is the value of another part of the photo. The gain cancels
//! where both are divided by their medians: the error of a keypoint is the sum of `|p / median(p) - c / median(c)|` over the channels.
//! (With `|p - g c|` a photo would fit best where it is black.) A reading is taken where two things hold:
//! - its median error is at most [`RATIO`] times that of the other: the difference matters;
//! - it has the smaller error at so many keypoints that a fair coin would be [`SURE`] standard deviations away (a sign test, which
//!   needs no noise level): the difference is no accident.

use crate::colourless::colourless;
use crate::decode::before_turn;
use crate::naming::first_named;
use crate::photo::{DEAR, sample};
use crate::statistics::upper_median;
use crate::{DARKEST, Image, NEAR, Point, View};
use image::metadata::Orientation;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Fewest keypoints with colours that decide.
const FEWEST: usize = 40;
/// Most that are compared, evenly over the points.
const MOST: usize = 4096;
/// Largest ratio of the median errors.
const RATIO: f32 = 0.8;
/// Least distance from a fair coin, in standard deviations.
const SURE: f32 = 4.0;
/// Long side at which a photo is compared.
const SIZE: u32 = 640;
/// Cells along a photo's long side, in each of which the nearest of the projected points counts.
const CELLS: f32 = 48.0;
/// Photos named one by one in a note; more of them are counted.
const NAMED: usize = 5;

/// Result of comparing a photo with the points' colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum OrientationVerdict {
    Turned,
    Stored,
    /// Too few points with colours lie in it.
    Few,
    /// The colours fit both ways alike.
    Alike,
    TooLarge,
    Unreadable,
}

/// A point in a photo.
#[derive(Clone, Copy, Debug)]
struct ColouredKeypoint {
    /// Position in shares of the photo's width and height, before undistortion.
    at: [f64; 2],
    /// The point's colour, sRGB in [0, 1].
    colour: [f32; 3],
}

/// Decides for each ambiguous photo (index of the view, EXIF orientation) whether it is turned, and sets
/// [`crate::Reading::turned`] of those that are. Returns notes for the user; none where no photo is ambiguous.
pub(crate) fn decide(
    views: &mut [View],
    points: &[Point],
    ambiguous: &[(usize, Orientation)],
) -> Vec<String> {
    if ambiguous.is_empty() {
        return Vec::new();
    }
    let keypoints = keypoints(views, points, ambiguous);
    let bytes: Vec<u64> = ambiguous.par_iter().map(|&(i, _)| views[i].decoding_bytes(SIZE)).collect();
    let verdict = |k: usize| {
        let (i, orientation) = ambiguous[k];
        if bytes[k] > DEAR {
            OrientationVerdict::TooLarge
        } else {
            verdict(&views[i], orientation, &keypoints[k])
        }
    };
    let verdicts: Vec<OrientationVerdict> = batches(&bytes)
        .into_iter()
        .flat_map(|batch| batch.into_par_iter().map(verdict).collect::<Vec<_>>())
        .collect();
    let mut groups: BTreeMap<(OrientationVerdict, u8), Vec<&str>> = BTreeMap::new();
    for (&(i, orientation), &verdict) in ambiguous.iter().zip(&verdicts) {
        views[i].photo.reading.turned = verdict == OrientationVerdict::Turned;
        groups.entry((verdict, orientation.to_exif())).or_default().push(&views[i].name);
    }
    groups.iter().map(|((verdict, exif), names)| in_words(*verdict, *exif, names)).collect()
}

/// Ranges of photos that are decoded together: no memory budget is set yet, so they take little.
fn batches(bytes: &[u64]) -> Vec<std::ops::Range<usize>> {
    let mut batches = Vec::new();
    let (mut start, mut sum) = (0, 0);
    for (k, &bytes) in bytes.iter().enumerate() {
        // What takes more is not decoded at all.
        let bytes = if bytes > DEAR { 0 } else { bytes };
        if sum + bytes > DEAR {
            batches.push(start..k);
            (start, sum) = (k, 0);
        }
        sum += bytes;
    }
    batches.push(start..bytes.len());
    batches
}

/// The keypoints with colours of each ambiguous photo. A point that names no photo is projected.
fn keypoints(
    views: &[View],
    points: &[Point],
    ambiguous: &[(usize, Orientation)],
) -> Vec<Vec<ColouredKeypoint>> {
    let none = colourless(points);
    let coloured = || points.iter().filter(|point| Some(point.colour) != none);
    let mut found: BTreeMap<u32, Vec<ColouredKeypoint>> =
        ambiguous.iter().map(|(i, _)| (*i as u32, Vec::new())).collect();
    for point in coloured() {
        for sighting in &point.track {
            if let Some(found) = found.get_mut(&sighting.view) {
                found.extend(keypoint(&views[sighting.view as usize], sighting.pixel, point.colour));
            }
        }
    }
    let untracked: Vec<&Point> = coloured().filter(|point| point.track.is_empty()).collect();
    let of_view = |(i, mut found): (u32, Vec<ColouredKeypoint>)| {
        if found.len() < FEWEST {
            found.extend(projected(&views[i as usize], &untracked));
        }
        thinned(found)
    };
    // In the order of the views, as the ambiguous photos are.
    found.into_iter().collect::<Vec<_>>().into_par_iter().map(of_view).collect()
}

fn thinned(keypoints: Vec<ColouredKeypoint>) -> Vec<ColouredKeypoint> {
    let every = keypoints.len().div_ceil(MOST).max(1);
    keypoints.into_iter().step_by(every).collect()
}

/// Points that name no photo, in a photo: the nearest in each cell, for it hides those behind it.
fn projected(view: &View, points: &[&Point]) -> Vec<ColouredKeypoint> {
    let cell = view.camera.width.max(view.camera.height) as f32 / CELLS;
    let mut nearest: BTreeMap<[u32; 2], (f32, ColouredKeypoint)> = BTreeMap::new();
    for point in points {
        let at = view.pose.to_camera(point.position);
        let pixel = view.camera.pixel(at);
        if at.z <= NEAR || !view.camera.contains(pixel) {
            continue;
        }
        let Some(found) = keypoint(view, pixel.into(), point.colour) else { continue };
        let kept = nearest.entry([pixel.x, pixel.y].map(|p| (p / cell) as u32)).or_insert((at.z, found));
        if at.z < kept.0 {
            *kept = (at.z, found);
        }
    }
    nearest.into_values().map(|(_, keypoint)| keypoint).collect()
}

fn keypoint(view: &View, pixel: [f32; 2], colour: [f32; 3]) -> Option<ColouredKeypoint> {
    let taken = view.to_taken(pixel)?;
    let share = |at: f32, size: u32| f64::from(at) / f64::from(size);
    let at = [share(taken[0], view.camera.width), share(taken[1], view.camera.height)];
    at.iter().all(|share| (0.0..=1.0).contains(share)).then_some(ColouredKeypoint { at, colour })
}

fn verdict(view: &View, orientation: Orientation, keypoints: &[ColouredKeypoint]) -> OrientationVerdict {
    if keypoints.len() < FEWEST {
        return OrientationVerdict::Few;
    }
    match view.stored_pixels(SIZE) {
        Ok(photo) => compare(&photo, orientation, keypoints),
        Err(_) => OrientationVerdict::Unreadable,
    }
}

/// Compares the colours with the photo's pixels, as stored and as turned.
fn compare(photo: &Image, orientation: Orientation, keypoints: &[ColouredKeypoint]) -> OrientationVerdict {
    let stored = errors(photo, Orientation::NoTransforms, keypoints);
    let turned = errors(photo, orientation, keypoints);
    let count = |wins: fn(&f32, &f32) -> bool| {
        stored.iter().zip(&turned).filter(|(stored, turned)| wins(stored, turned)).count() as f32
    };
    let (for_stored, for_turned) = (count(f32::lt), count(f32::gt));
    let sigmas = (for_stored - for_turned) / (for_stored + for_turned).max(1.0).sqrt();
    let [stored, turned] = [stored, turned].map(|errors| upper_median(errors).unwrap_or(0.0));
    if sigmas >= SURE && stored <= RATIO * turned {
        OrientationVerdict::Stored
    } else if sigmas <= -SURE && turned <= RATIO * stored {
        OrientationVerdict::Turned
    } else {
        OrientationVerdict::Alike
    }
}

/// The error of each keypoint in the photo turned so.
fn errors(photo: &Image, orientation: Orientation, keypoints: &[ColouredKeypoint]) -> Vec<f32> {
    let pixel = |keypoint: &ColouredKeypoint| {
        let [u, v] = before_turn(keypoint.at, orientation);
        let mut pixel = [0.0; 3];
        sample(photo, [u * photo.width as f64, v * photo.height as f64], |c, value| pixel[c] = value);
        pixel
    };
    let pixels: Vec<[f32; 3]> = keypoints.iter().map(pixel).collect();
    let colours: Vec<[f32; 3]> = keypoints.iter().map(|keypoint| keypoint.colour).collect();
    let (pixels, colours) = (relative(pixels), relative(colours));
    let error = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|c| (a[c] - b[c]).abs()).sum();
    pixels.iter().zip(&colours).map(error).collect()
}

/// Each channel divided by its median.
fn relative(mut colours: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    for c in 0..3 {
        let values: Vec<f32> = colours.iter().map(|colour| colour[c]).collect();
        let middle = upper_median(values).unwrap_or(0.0).max(DARKEST);
        colours.iter_mut().for_each(|colour| colour[c] /= middle);
    }
    colours
}

fn in_words(verdict: OrientationVerdict, exif: u8, names: &[&str]) -> String {
    let (photos, one) = (listed(names), names.len() == 1);
    let (are, their) = if one { ("is", "its") } else { ("are", "their") };
    let unchecked = |why: &str| {
        let they = if one { "it is" } else { "they are" };
        format!(
            "{photos}: {their} EXIF orientation {exif} could not be checked against the points ({why}); {they} read as stored"
        )
    };
    match verdict {
        OrientationVerdict::Turned => format!(
            "{photos} {are} turned by {their} EXIF orientation {exif}: the colours of the points fit the pixels so, and not as they \
             are stored"
        ),
        OrientationVerdict::Stored => format!(
            "{photos} {are} read as stored, without {their} EXIF orientation {exif}: the colours of the points fit the pixels so, \
             and not turned"
        ),
        OrientationVerdict::Few => unchecked("too few points with colours lie there"),
        OrientationVerdict::Alike => unchecked("their colours fit both ways alike"),
        OrientationVerdict::TooLarge => unchecked("decoding takes too much memory here"),
        OrientationVerdict::Unreadable => unchecked("decoding failed"),
    }
}

fn listed(names: &[&str]) -> String {
    match names.len() {
        1 => format!("photo {}", names[0]),
        2..=NAMED => format!("photos {}", names.join(", ")),
        n => format!("{n} photos ({})", first_named(names)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photo of 48 x 48 pixels that differs everywhere, and a keypoint in the middle of each third pixel.
    fn photo_with_keypoints() -> (Image, Vec<ColouredKeypoint>) {
        let mut photo = Image::zeros(48, 48, 3);
        let mut random = crate::Random::new(7);
        photo.data.iter_mut().for_each(|value| *value = random.uniform());
        let cells = (0..16 * 16).map(|k| [3 * (k % 16), 3 * (k / 16)]);
        let keypoint = |[x, y]: [usize; 2]| ColouredKeypoint {
            at: [x, y].map(|at| (at as f64 + 0.5) / 48.0),
            colour: [0, 1, 2].map(|c| photo.at(c, x, y)),
        };
        let keypoints = cells.map(keypoint).collect();
        (photo, keypoints)
    }

    #[test]
    fn exposure_and_white_balance_do_not_hide_which_way_a_photo_lies() {
        let (photo, mut keypoints) = photo_with_keypoints();
        for keypoint in &mut keypoints {
            keypoint.colour = [0.3 * keypoint.colour[0], 0.5 * keypoint.colour[1], 0.9 * keypoint.colour[2]];
        }
        assert_eq!(compare(&photo, Orientation::Rotate180, &keypoints), OrientationVerdict::Stored);
    }

    #[test]
    fn a_photo_is_not_turned_because_its_points_fall_on_black_then() {
        let (mut photo, keypoints) = photo_with_keypoints();
        let kept: Vec<ColouredKeypoint> =
            keypoints.into_iter().filter(|keypoint| keypoint.at[0] < 0.5).collect();
        for i in 0..photo.data.len() {
            if i % 48 >= 24 {
                photo.data[i] = 0.0;
            }
        }
        assert_eq!(compare(&photo, Orientation::FlipHorizontal, &kept), OrientationVerdict::Stored);
    }

    #[test]
    fn colours_of_another_photo_decide_nothing() {
        let (photo, mut keypoints) = photo_with_keypoints();
        let colours: Vec<[f32; 3]> = keypoints.iter().map(|keypoint| keypoint.colour).collect();
        for shift in 1..100 {
            for (k, keypoint) in keypoints.iter_mut().enumerate() {
                keypoint.colour = colours[(k + shift) % colours.len()];
            }
            for exif in [2, 3, 6] {
                let orientation = Orientation::from_exif(exif).expect("an orientation");
                assert_eq!(
                    compare(&photo, orientation, &keypoints),
                    OrientationVerdict::Alike,
                    "{shift}, {exif}"
                );
            }
        }
    }

    #[test]
    fn photos_are_decoded_together_as_far_as_they_take_little() {
        let (some, most) = (DEAR / 2, DEAR);
        assert_eq!(batches(&[some, some, some, most, 9 * most, some]), [0..2, 2..3, 3..5, 5..6]);
    }
}
