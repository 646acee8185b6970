//! Files that other programs write: one table, a row per kind of input.
//!
//! A report from a user becomes one row: how the input is made from a good scene, and what the program has to do with it.
//! Each row is opened as [`segwild_scene::Scene::open`] does, then every photo is loaded, as a run does.

mod base;
mod colmap_models;
mod masks;
mod photos;
mod points;
mod splits;
mod transforms;

use base::Files;
use segwild_scene::{Scene, SceneError, SceneSettings, View};

/// One kind of input.
pub struct FileCase {
    /// What a user would call it. Unique.
    pub name: &'static str,
    /// Changes a good scene of 12 photos (`photo00.png` .. `photo11.png`) into the input.
    pub make: fn(&Files),
    /// Settings that the user gives, as `(name, value)`.
    pub settings: &'static [(&'static str, &'static str)],
    /// What the program does with it.
    pub expect: Expect,
}

/// What the program does with an input.
pub enum Expect {
    /// The scene opens with this many usable photos; every photo loads, or is skipped; each of the words stands in the notes or
    /// in the reasons of the skipped photos.
    Reads {
        /// Usable photos.
        photos: usize,
        /// The messages that a user gets.
        words: &'static [&'static str],
    },
    /// As [`Expect::Reads`], and the scene passes a check of its own.
    Holds {
        /// Usable photos.
        photos: usize,
        /// Panics where the scene is not what the input says.
        check: fn(&Scene),
    },
    /// The scene is refused with an error that has each of these words.
    Refuses(&'static [&'static str]),
}

#[test]
fn every_kind_of_foreign_file_is_read_or_refused_in_words() {
    let tables =
        [colmap_models::ROWS, masks::ROWS, photos::ROWS, points::ROWS, splits::ROWS, transforms::ROWS];
    let rows: Vec<&FileCase> = tables.into_iter().flatten().collect();
    let mut names: Vec<&str> = rows.iter().map(|row| row.name).collect();
    names.sort_unstable();
    assert!(names.windows(2).all(|pair| pair[0] != pair[1]), "two rows have one name: {names:?}");
    let failed: Vec<String> =
        rows.iter().filter_map(|row| outcome(row).err().map(|why| format!("{}: {why}", row.name))).collect();
    assert!(failed.is_empty(), "{} of {} rows:\n{}", failed.len(), rows.len(), failed.join("\n"));
}

fn outcome(row: &FileCase) -> Result<(), String> {
    let dir = tempfile::tempdir().map_err(|e| e.to_string())?;
    let files = Files::new(dir.path());
    (row.make)(&files);
    let mut settings = SceneSettings::default();
    for (name, value) in row.settings {
        segwild_scene::settings::Group::set(&mut settings, name, value).map_err(|e| e.to_string())?;
    }
    let opened = Scene::open(&files.scene, &settings);
    match (&row.expect, opened) {
        (Expect::Refuses(words), Err(error)) => has(&error.to_string(), words),
        (Expect::Refuses(_), Ok(scene)) => Err(format!("was read: {} photos", scene.views.len())),
        (_, Err(error)) => Err(format!("was refused: {error}")),
        (Expect::Reads { photos, words }, Ok(scene)) => {
            usable(&scene, *photos)?;
            has(&messages(&scene), words)
        }
        (Expect::Holds { photos, check }, Ok(scene)) => {
            usable(&scene, *photos)?;
            std::panic::catch_unwind(|| check(&scene)).map_err(|_| "its check failed (see above)".to_owned())
        }
    }
}

fn usable(scene: &Scene, photos: usize) -> Result<(), String> {
    // As a run does, which leaves out what cannot be used.
    let usable: Vec<&View> = scene.views.iter().filter(|view| view.examine(640).is_ok()).collect();
    if usable.len() != photos {
        return Err(format!("{} photos are usable, not {photos}: {}", usable.len(), messages(scene)));
    }
    let load = |view: &&View| -> Result<(), SceneError> { view.load(32).map(drop) };
    usable.iter().try_for_each(load).map_err(|e| format!("does not load: {e}"))
}

/// All messages that a user gets about a scene.
fn messages(scene: &Scene) -> String {
    let skipped = scene.skipped.iter().map(|s| format!("{}: {}", s.name, s.reason));
    let examined = scene.views.iter().filter_map(|view| match view.examine(640) {
        Ok(odd) => odd.map(|odd| format!("{}: {odd}", view.name)),
        Err(error) => Some(error.to_string()),
    });
    scene.notes.iter().cloned().chain(skipped).chain(examined).collect::<Vec<_>>().join("\n")
}

fn has(text: &str, words: &[&str]) -> Result<(), String> {
    match words.iter().find(|word| !text.contains(**word)) {
        Some(word) => Err(format!("does not say `{word}`: {text}")),
        None => Ok(()),
    }
}
