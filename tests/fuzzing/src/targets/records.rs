//! Binary records: what a run folder that somebody sent may hold, with right checksums.

use crate::seeds::{run, run_for};
use crate::yard::{folder, put, take};
use crate::{FuzzTarget, seal};
use segwild_flow::codec::{self, Decode};
use segwild_flow::{Cache, Key, Stopper};
use segwild_pipeline::{RenderRequest, RunFolder, Selected};
use segwild_scene::{Embedding, MaskSet};
use segwild_trainer::Checkpoint;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Draws one photo of a run, which needs everything that its records say.
fn draw(run: &Path) {
    let request = RenderRequest {
        photos: vec!["photo0.png".into()],
        width: Some(16),
        out: Some(run.join("drawn")),
        ..RenderRequest::default()
    };
    let _ = segwild_pipeline::render(&RunFolder::at(run), &request, &Stopper::new());
}

macro_rules! run_record {
    ($name:ident, $target:literal, $file:literal, $seeds:expr) => {
        pub(super) const $name: FuzzTarget = FuzzTarget {
            name: $target,
            seeds: $seeds,
            words: &[],
            seal: seal::record,
            read: |bytes| {
                static RUN: OnceLock<PathBuf> = OnceLock::new();
                let run = RUN.get_or_init(|| run_for($target));
                put(&run.join($file), bytes);
                draw(run);
            },
        };
    };
}

run_record!(MODEL, "model_bin", "model.bin", || vec![take(&run().join("model.bin"))]);
run_record!(FEATURES, "features_bin", "features.bin", feature_seeds);

/// The run's feature field, and the same as earlier versions wrote it: with numbers of 32 bits and no unit.
fn feature_seeds() -> Vec<Vec<u8>> {
    let loaded = RunFolder::at(run()).load().unwrap_or_else(|e| panic!("{e}"));
    let field = loaded.field.unwrap_or_else(|| panic!("the run has no features"));
    let wide = (field.channels(), field.values(), field.pca, field.decoder);
    let wide = codec::encode("features", &wide).unwrap_or_else(|e| panic!("{e}"));
    vec![take(&run().join("features.bin")), wide]
}

pub(super) const SELECTION: FuzzTarget = FuzzTarget {
    name: "selection_bin",
    seeds: || {
        let splats = splats();
        let labels = (0..splats).map(|i| i % 3 == 0).collect();
        let selected = Selected { labels, changed: vec![] };
        let bytes = codec::encode("selection", &selected).unwrap_or_else(|e| panic!("{e}"));
        let mut changed = codec::encode("selection", &(selected.labels, vec![(1u32, [0.0f32; 10])]))
            .unwrap_or_else(|e| panic!("{e}"));
        seal::record(&mut changed);
        vec![bytes, changed]
    },
    words: &[],
    seal: seal::record,
    read: |bytes| {
        static RUN: OnceLock<(PathBuf, RunFolder)> = OnceLock::new();
        let (file, run) = RUN.get_or_init(|| {
            let run = run_for("selection_bin");
            let own = run.join("selections/thing");
            std::fs::create_dir_all(&own).unwrap_or_else(|e| panic!("{e}"));
            put(&own.join("prompts.json"), b"[]");
            (own.join("selection.bin"), RunFolder::at(&run))
        });
        put(file, bytes);
        if let Ok(selected) = Selected::read(run, "thing", splats()) {
            static MODEL: OnceLock<std::sync::Arc<segwild_scene::Splats>> = OnceLock::new();
            let model = MODEL.get_or_init(|| run.load().unwrap_or_else(|e| panic!("{e}")).model.splats);
            let cut = selected.cut_scene(model);
            assert_eq!(cut.len(), model.len());
        }
    },
};

/// Splats of the run.
fn splats() -> usize {
    static COUNT: OnceLock<usize> = OnceLock::new();
    *COUNT.get_or_init(|| RunFolder::at(run()).load().unwrap_or_else(|e| panic!("{e}")).model.splats.len())
}

/// The files below a folder, smallest first.
fn files_in(folder: &Path) -> Vec<Vec<u8>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        match entry.path().is_dir() {
            true => found.extend(files_in(&entry.path())),
            false => found.push(take(&entry.path())),
        }
    }
    found.sort_by_key(Vec::len);
    found
}

pub(super) const CHECKPOINT: FuzzTarget = FuzzTarget {
    name: "checkpoint_bin",
    seeds: || files_in(&run().join("checkpoints")),
    words: &[],
    seal: seal::record,
    read: |bytes| drop(codec::decode::<Checkpoint>("checkpoint", bytes)),
};

/// Bytes of the cache's own header: magic, length, hash.
const CACHED: usize = 8 + 8 + 32;

fn seal_cached(bytes: &mut [u8]) {
    let Some((head, inner)) = bytes.split_at_mut_checked(CACHED) else { return };
    seal::record(inner);
    head[8..16].copy_from_slice(&(inner.len() as u64).to_le_bytes());
    head[16..].copy_from_slice(blake3::hash(inner).as_bytes());
}

/// The kind of the run's own artefacts in a folder of its cache.
fn kind_in(domain: &str) -> String {
    let whole = files_in(&run().join("cache").join(domain)).into_iter().next().unwrap_or_default();
    let record = whole.get(CACHED..).unwrap_or_default();
    let (kind, _) = codec::open(record).unwrap_or_else(|e| panic!("{domain}: {e}"));
    kind.to_owned()
}

/// Reads an artefact of a kind from the cache.
fn cached<T: Decode>(target: &str, kind: &str, bytes: &[u8]) -> Option<T> {
    let cache = Cache::at(folder(target));
    let key = Key::of("fuzz").finish();
    let file = cache.path(&key);
    std::fs::create_dir_all(file.parent()?).unwrap_or_else(|e| panic!("{e}"));
    put(&file, bytes);
    let found = cache.get_typed(&key, kind).unwrap_or_else(|e| panic!("{e}"));
    // What is damaged is moved aside, where it would pile up.
    let _ = std::fs::remove_dir_all(cache.root().join("corrupt"));
    found
}

pub(super) const CACHED_MASKS: FuzzTarget = FuzzTarget {
    name: "cached_masks",
    seeds: || files_in(&run().join("cache/masks.d")),
    words: &[],
    seal: seal_cached,
    read: |bytes| {
        static KIND: OnceLock<String> = OnceLock::new();
        let kind = KIND.get_or_init(|| kind_in("masks.d"));
        let Some(set) = cached::<MaskSet>("cached_masks", kind, bytes) else { return };
        for scored in &set.masks {
            let mask = &scored.mask;
            let (w, h) = (mask.width(), mask.height());
            let _ = (mask.count(), mask.and(&mask.not()), w > 0 && h > 0 && mask.get(w - 1, h - 1));
        }
    },
};

pub(super) const CACHED_EMBEDDING: FuzzTarget = FuzzTarget {
    name: "cached_embedding",
    seeds: || files_in(&run().join("cache/embedding.d")),
    words: &[],
    seal: seal_cached,
    read: |bytes| {
        static KIND: OnceLock<String> = OnceLock::new();
        let kind = KIND.get_or_init(|| kind_in("embedding.d"));
        let Some(found) = cached::<Embedding>("cached_embedding", kind, bytes) else { return };
        let cells = found.width.checked_mul(found.height).and_then(|n| n.checked_mul(found.channels));
        assert_eq!(Some(found.data.len()), cells, "the numbers do not fill the grid");
    },
};
