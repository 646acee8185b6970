//! Snapshots of COLMAP's mapper: from where a mapping that was stopped goes on.

use segwild_scene::colmap;
use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Photos after which the mapper leaves a snapshot: with a hundred and more, so many take minutes.
pub(crate) const EVERY: usize = 50;

/// A snapshot from which the mapper can go on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct MapperSnapshot {
    pub path: PathBuf,
    /// Photos with a pose.
    pub photos: usize,
}

/// The snapshot with most photos; `None` where there is none that is whole, and whose photos are all among `names`.
pub(crate) fn largest(folder: &Path, names: &BTreeSet<&str>) -> Option<MapperSnapshot> {
    let whole = folders(folder).into_iter().filter_map(|path| {
        // A mapper that was killed may leave a part of one; COLMAP writes the points last.
        let read = colmap::read(&path).ok().filter(|read| !read.points.is_empty())?;
        let known = read.images.iter().all(|image| names.contains(image.name.as_str()));
        known.then_some(MapperSnapshot { path, photos: read.images.len() })
    });
    whole.max_by_key(|snapshot| snapshot.photos)
}

/// Removes all snapshots but the one with the longest list of photos and the newest one, which may be half written: of
/// a thousand photos all of them would take gigabytes.
pub(crate) fn thin(folder: &Path) {
    let mut all: Vec<(SystemTime, u64, PathBuf)> = folders(folder)
        .into_iter()
        .map(|path| {
            let length = std::fs::metadata(path.join("images.bin")).map_or(0, |data| data.len());
            let changed = std::fs::metadata(&path).and_then(|data| data.modified());
            (changed.unwrap_or(SystemTime::UNIX_EPOCH), length, path)
        })
        .collect();
    all.sort_by_key(|(changed, ..)| Reverse(*changed));
    // The newest stays.
    let mut others = all.split_off(all.len().min(1));
    others.sort_by_key(|(_, length, _)| Reverse(*length));
    for (_, _, path) in others.into_iter().skip(1) {
        // One that stays takes space and does no harm.
        let _ = std::fs::remove_dir_all(path);
    }
}

/// The folders in a folder.
fn folders(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::colmap::{
        CameraModel, CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction,
    };
    use std::time::Duration;

    fn names<'a>(all: &[&'a str]) -> BTreeSet<&'a str> {
        all.iter().copied().collect()
    }

    fn write(folder: &Path, photos: &[&str]) {
        let camera = CameraRecord {
            id: 1,
            model: CameraModel::Pinhole,
            width: 40,
            height: 30,
            params: vec![50.0, 50.0, 20.0, 15.0],
        };
        let images = photos.iter().enumerate().map(|(i, name)| ImageRecord {
            id: i as u32 + 1,
            rotation: [1.0, 0.0, 0.0, 0.0],
            translation: [0.0; 3],
            camera_id: 1,
            name: (*name).to_owned(),
            keypoints: vec![Keypoint { pixel: [20.0, 15.0], point: Some(1) }],
        });
        let images: Vec<ImageRecord> = images.collect();
        let track = images.iter().map(|image| (image.id, 0)).collect();
        let point = PointRecord { id: 1, position: [0.0, 0.0, 4.0], colour: [9; 3], error: 0.5, track };
        let model =
            Reconstruction { cameras: vec![camera], unknown_cameras: vec![], images, points: vec![point] };
        colmap::write(folder, &model).unwrap();
    }

    #[test]
    fn the_largest_whole_snapshot_of_these_photos_is_taken() {
        let dir = tempfile::tempdir().unwrap();
        let all = names(&["a", "b", "c", "d"]);
        assert_eq!(largest(&dir.path().join("none"), &all), None);
        write(&dir.path().join("0000000007"), &["a", "b"]);
        write(&dir.path().join("0000000001"), &["a", "b", "c"]);
        // One that a kill cut short, and one of a photo that is gone.
        write(&dir.path().join("0000000009"), &["a", "b", "c", "d"]);
        std::fs::remove_file(dir.path().join("0000000009/points3D.bin")).unwrap();
        write(&dir.path().join("0000000010"), &["a", "b", "c", "gone"]);
        let found = largest(dir.path(), &all).unwrap();
        assert_eq!((found.photos, found.path), (3, dir.path().join("0000000001")));
        assert_eq!(largest(dir.path(), &names(&["a"])), None);
    }

    #[test]
    fn of_many_snapshots_the_largest_and_the_newest_stay() {
        let dir = tempfile::tempdir().unwrap();
        for (k, photos) in [&["a", "b"][..], &["a", "b", "c"], &["a"], &["d"]].into_iter().enumerate() {
            let folder = dir.path().join(k.to_string());
            write(&folder, photos);
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1000 * (k as u64 + 1));
            std::fs::File::open(&folder).unwrap().set_modified(time).unwrap();
        }
        thin(dir.path());
        let mut left: Vec<String> = folders(dir.path())
            .iter()
            .map(|path| path.file_name().unwrap().to_string_lossy().into())
            .collect();
        left.sort();
        assert_eq!(left, ["1", "3"]);
        thin(&dir.path().join("none"));
    }
}
