//! Runs through a store, while they are written.

use segwild_farm::{
    ArtefactDigest, ArtefactError, ArtefactSession, ArtefactStore, FolderEntry, FolderManifest,
    ObjectArtefacts,
};
use segwild_flow::ledger::{CheckpointRow, State};
use segwild_flow::{Cache, Key, Ledger, files};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

fn store(dir: &Path) -> Arc<ObjectArtefacts> {
    Arc::new(ObjectArtefacts::open(&dir.join("shared").display().to_string()).unwrap())
}

fn key() -> Key {
    Key::of("geometry").value("steps", 3000).finish()
}

/// Works as a training does: a checkpoint, its row, the one before goes; lines that grow; artefacts in the cache.
fn work(run: &Path, stop: &AtomicBool) {
    let ledger = Ledger::open(run.join("run.sqlite")).unwrap();
    let cache = Cache::open(run.join("cache")).unwrap();
    ledger.start_stage("geometry", &key()).unwrap();
    let mut kept: Vec<CheckpointRow> = Vec::new();
    let (_never, pause) = mpsc::channel::<()>();
    for step in 1u64.. {
        // Still a thousand times as often as a training.
        let _ = pause.recv_timeout(Duration::from_millis(30));
        let bytes = step.to_le_bytes().repeat(20_000);
        let row = CheckpointRow::new("geometry", &key(), step, &format!("geometry-{step:08}.bin"), &bytes);
        files::write_atomic(&run.join("checkpoints").join(&row.file), &bytes).unwrap();
        files::append_line(&run.join("history.jsonl"), &format!("{{\"step\":{step}}}")).unwrap();
        files::write_atomic(&run.join("scene.ply"), &bytes).unwrap();
        cache.put(&Key::of("masks").value("photo", step % 40).finish(), b"masks").unwrap();
        ledger.record_checkpoint(&row).unwrap();
        kept.push(row);
        if kept.len() > 2 {
            let old = kept.remove(0);
            std::fs::remove_file(run.join("checkpoints").join(&old.file)).unwrap();
            ledger.forget_checkpoint(&old).unwrap();
        }
        if stop.load(Ordering::Relaxed) {
            // Dies here: the stage stays as it is.
            return;
        }
    }
}

#[test]
fn every_copy_of_a_run_that_is_written_has_the_checkpoint_that_its_ledger_names() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let session = ArtefactSession::new(store(dir.path()));
    let stop = AtomicBool::new(false);
    let copies: Vec<ArtefactDigest> = std::thread::scope(|scope| {
        scope.spawn(|| work(&run, &stop));
        while !run.join("scene.ply").is_file() || !run.join("history.jsonl").is_file() {
            std::thread::yield_now();
        }
        let copies = (0..12).map(|_| session.store_run(&run)).collect::<Result<_, _>>();
        stop.store(true, Ordering::Relaxed);
        copies.unwrap()
    });
    let mut whole = 0;
    for (i, digest) in copies.iter().enumerate() {
        let into = dir.path().join(format!("copy{i}"));
        session.fetch_run(digest, &into).unwrap();
        let ledger = Ledger::open_read_only(into.join("run.sqlite")).unwrap();
        assert!(ledger.owner().is_none(), "the process that wrote it is none of this machine");
        assert_eq!(ledger.stages().unwrap()[0].state, State::Running);
        let fits = |row: &CheckpointRow| {
            std::fs::read(into.join("checkpoints").join(&row.file)).is_ok_and(|bytes| row.fits(&bytes))
        };
        whole += usize::from(ledger.checkpoints("geometry", &key()).unwrap().iter().all(fits));
        drop(ledger);
        let history = std::fs::read_to_string(into.join("history.jsonl")).unwrap();
        assert!(history.lines().count() > 0);
        for name in ["run.sqlite-wal", "run.sqlite-shm", "cache/tmp"] {
            assert!(!into.join(name).exists(), "{name}");
        }
        let continued = Ledger::open(into.join("run.sqlite")).unwrap();
        assert_eq!(continued.stages().unwrap()[0].state, State::Pending);
        assert_eq!(continued.owner().and_then(|owner| owner.pid), Some(std::process::id()));
    }
    assert_eq!(whole, copies.len(), "whatever came and went meanwhile");
    let litter = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    assert_eq!(std::fs::read_dir(&run).unwrap().flatten().filter(litter).count(), 0);
}

#[test]
fn a_run_in_use_is_not_replaced_and_an_old_log_is_not_merged() {
    let dir = tempfile::tempdir().unwrap();
    let (run, into) = (dir.path().join("run"), dir.path().join("into"));
    let session = ArtefactSession::new(store(dir.path()));
    work(&run, &AtomicBool::new(true));
    let digest = session.store_run(&run).unwrap();
    let other = Ledger::open(into.join("run.sqlite")).unwrap();
    other.start_stage("masks", &key()).unwrap();
    let error = session.fetch_run(&digest, &into).unwrap_err();
    assert!(
        matches!(&error, ArtefactError::Busy { owner, .. } if owner.pid == Some(std::process::id())),
        "{error}"
    );
    // As after a kill: the log is left.
    let log = std::fs::read(into.join("run.sqlite-wal")).unwrap();
    drop(other);
    std::fs::write(into.join("run.sqlite-wal"), log).unwrap();
    session.fetch_run(&digest, &into).unwrap();
    let stages = Ledger::open_read_only(into.join("run.sqlite")).unwrap().stages().unwrap();
    assert_eq!(stages.iter().map(|stage| stage.name.as_str()).collect::<Vec<_>>(), ["geometry"]);
    assert!(session.store_run(&dir.path().join("nothing")).is_err());
}

#[test]
fn a_folder_that_is_no_run_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path());
    let session = ArtefactSession::new(store.clone());
    let file = dir.path().join("file");
    std::fs::write(&file, "x").unwrap();
    let bytes = ArtefactDigest::of(b"x");
    store.put(&bytes, &file).unwrap();
    for (paths, reason) in [
        (&["scene.ply"][..], "no ledger"),
        (&["run.sqlite", "run.sqlite-wal"], "run.sqlite-wal"),
        (&["run.sqlite", "run.lock"], "run.lock"),
        (&["run.sqlite", "run.sqlite/x"], "lies in a file"),
        (&["run.sqlite", "cache/tmp/x"], "cache/tmp/x"),
        (&["run.sqlite", "poses/colmap.db"], "poses/colmap.db"),
        (&["run.sqlite"], "not a run ledger"),
    ] {
        let entry = |path: &&str| FolderEntry { path: (*path).into(), digest: bytes, bytes: 1 };
        let json = FolderManifest::new(paths.iter().map(entry).collect()).to_json();
        let manifest = ArtefactDigest::of(&json);
        std::fs::write(&file, &json).unwrap();
        store.put(&manifest, &file).unwrap();
        let error = session.fetch_run(&manifest, &dir.path().join("into")).unwrap_err().to_string();
        assert!(error.contains(reason), "{paths:?}: {error}");
    }
}
