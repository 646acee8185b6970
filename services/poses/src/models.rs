//! The models that COLMAP made: the largest is used, and photos that it does not hold get a reason.

use crate::PosesError;
use crate::database::{BestPair, Database, ImageRow};
use crate::record::ModelSize;
use segwild_scene::{Skipped, colmap};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::Path;

/// A photo with fewer features fixes no pose: COLMAP wants 30 of them to agree (`Mapper.abs_pose_min_num_inliers`).
const FEW_FEATURES: u64 = 100;
/// Matches that agree in a pair with which COLMAP tries a pose (`Mapper.min_num_matches`).
const FEW_MATCHES: u64 = 15;

/// A model and the photos in it.
pub(crate) struct PoseModel {
    pub size: ModelSize,
    photos: HashSet<String>,
}

/// The models in a folder, the largest first.
pub(crate) fn read_models(folder: &Path) -> Result<Vec<PoseModel>, PosesError> {
    let mut models = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let Some(number) = entry.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
        let read = colmap::read(&entry.path())?;
        let photos: HashSet<String> = read.images.into_iter().map(|image| image.name).collect();
        let size = ModelSize { number, photos: photos.len(), points: read.points.len() };
        models.push(PoseModel { size, photos });
    }
    models.sort_by_key(|model| {
        std::cmp::Reverse((model.size.photos, model.size.points, u32::MAX - model.size.number))
    });
    Ok(models)
}

/// What is known of photos without a pose.
pub(crate) struct PhotoFacts {
    images: BTreeMap<String, ImageRow>,
    best: HashMap<String, BestPair>,
}

impl PhotoFacts {
    /// Reads them.
    pub fn of(database: Option<Database>) -> Result<PhotoFacts, PosesError> {
        let Some(database) = database else {
            return Ok(PhotoFacts { images: BTreeMap::new(), best: HashMap::new() });
        };
        let images = database.images()?;
        let best = database.best_pairs(&images)?;
        Ok(PhotoFacts { images, best })
    }

    /// The photos that the first model does not hold, and why.
    pub fn unposed<'a>(&self, photos: impl Iterator<Item = &'a str>, models: &[PoseModel]) -> Vec<Skipped> {
        let left = photos.filter(|name| models.first().is_none_or(|model| !model.photos.contains(*name)));
        left.map(|name| Skipped { name: name.to_owned(), reason: self.reason(name, models) }).collect()
    }

    fn reason(&self, name: &str, models: &[PoseModel]) -> String {
        let other = models.iter().skip(1).find(|model| model.photos.contains(name));
        if let (Some(other), Some(first)) = (other, models.first()) {
            return format!(
                "it has a pose in another part of the photos, of {}, which shares too little with that of {}",
                other.size.photos, first.size.photos
            );
        }
        let features = self.images.get(name).and_then(|image| image.features);
        match (features, self.best.get(name)) {
            (None, _) => "COLMAP could not read it".into(),
            (Some(features), _) if features < FEW_FEATURES => {
                format!("it has no pose: it shows too little to recognise ({features} features)")
            }
            (_, Some(BestPair { other, matches })) if *matches >= FEW_MATCHES => {
                format!("it has no pose: {matches} points of it are seen in {other}, too few to fix one")
            }
            _ => "it has no pose: no other photo shows the same".into(),
        }
    }

    /// Why there is no model at all, and what to do.
    pub fn nothing(&self, photos: usize) -> String {
        let pairs = self.best.values().filter(|best| best.matches >= FEW_MATCHES).count();
        match pairs {
            0 => {
                "no two of them show the same: give photos that overlap, taken from several positions".into()
            }
            n => format!(
                "{n} of the {photos} share points with another, but none was taken from far enough beside another: give photos \
                 from more positions (turning on the spot is not enough)"
            ),
        }
    }
}

/// The models beside the one that is used, in words; `None` where there is one alone.
pub(crate) fn others_in_words(models: &[ModelSize]) -> Option<String> {
    let (first, others) = models.split_first().filter(|(_, others)| !others.is_empty())?;
    let sizes: Vec<String> = others.iter().map(|model| model.photos.to_string()).collect();
    Some(format!(
        "the photos fall into {} parts that share too little: the largest, of {} photos, is used; the others have {}",
        models.len(),
        first.photos,
        sizes.join(", ")
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(number: u32, photos: &[&str]) -> PoseModel {
        let size = ModelSize { number, photos: photos.len(), points: 9 };
        PoseModel { size, photos: photos.iter().map(|name| (*name).to_owned()).collect() }
    }

    #[test]
    fn a_photo_without_a_pose_gets_the_reason_that_the_database_knows() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("colmap.db");
        rusqlite::Connection::open(&path)
            .unwrap()
            .execute_batch(
                "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
                 CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER);
                 CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER);
                 CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);
                 INSERT INTO images VALUES (1, 'a', 1), (2, 'dark', 1), (3, 'alone', 1), (4, 'far', 1), (5, 'part', 1);
                 INSERT INTO keypoints VALUES (1, 900), (2, 12), (3, 900), (4, 900), (5, 900);
                 INSERT INTO descriptors VALUES (1, 900), (2, 12), (3, 900), (4, 900), (5, 900);
                 INSERT INTO two_view_geometries VALUES (2147483647 + 4, 22), (2147483647 + 3, 4);",
            )
            .unwrap();
        let facts = PhotoFacts::of(Database::open(&path).unwrap()).unwrap();
        let models = [model(0, &["a", "b", "c"]), model(1, &["part", "x"])];
        let names = ["a", "alone", "dark", "far", "part", "unread"];
        let unposed = facts.unposed(names.into_iter(), &models);
        let reasons: Vec<(&str, &str)> =
            unposed.iter().map(|photo| (photo.name.as_str(), photo.reason.as_str())).collect();
        assert_eq!(
            reasons,
            [
                ("alone", "it has no pose: no other photo shows the same"),
                ("dark", "it has no pose: it shows too little to recognise (12 features)"),
                ("far", "it has no pose: 22 points of it are seen in a, too few to fix one"),
                (
                    "part",
                    "it has a pose in another part of the photos, of 2, which shares too little with that of 3"
                ),
                ("unread", "COLMAP could not read it"),
            ]
        );
        assert!(facts.nothing(6).starts_with("2 of the 6 share points"));
    }

    #[test]
    fn the_models_that_are_not_used_are_named() {
        let sizes = [model(1, &["a", "b", "c"]).size, model(0, &["d", "e"]).size];
        assert_eq!(others_in_words(&sizes[..1]), None);
        let words = others_in_words(&sizes).unwrap();
        assert!(
            words.contains("2 parts") && words.contains("of 3 photos") && words.ends_with("have 2"),
            "{words}"
        );
    }
}
