//! Disks that are full or cannot be written: a sentence and an exit code, nothing lost.

use crate::common::*;
use crate::farm::nats_server::NatsServer;
use crate::farm::{batch, engine, manifest, worker_with_log};
use segwild_farm::{JobEngine, JobState};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

#[test]
fn a_full_disk_is_reported_and_loses_nothing() {
    let dir = folder();
    let run = dir.path().join("run");
    for point in
        ["full@file.write:8+", "full@ledger.commit:30+", "full@checkpoint.save", "full@file.write:5+"]
    {
        let output = output(&again(&run, &["--fault", point]));
        let stdout = text(&output.stderr);
        assert_eq!(output.status.code(), Some(6), "{point}: {stdout}");
        assert!(stdout.contains("error:") && stdout.contains("the disk is full"), "{point}: {stdout}");
        assert!(!stdout.contains("panicked"), "{stdout}");
    }
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

/// Runs a command with a full disk from the Nth file on, for N from 1 until it needs no more files: each writer of it is
/// struck once (`stride` 1). Returns about how many files it writes.
fn struck_at_every_file(what: &[&str], stride: usize, mut after: impl FnMut(usize)) -> usize {
    for n in (1..200).step_by(stride) {
        let fault = format!("full@file.write:{n}");
        let output = segwild(&[what, &["--fault", fault.as_str()]].concat());
        let stdout = text(&output.stderr);
        if output.status.code() == Some(0) {
            return n - 1;
        }
        assert_eq!(output.status.code(), Some(6), "{what:?} {fault}: {stdout}");
        assert!(
            stdout.contains("the disk is full") && !stdout.contains("panicked"),
            "{what:?} {fault}: {stdout}"
        );
        after(n);
    }
    panic!("{what:?} writes more than 200 files");
}

#[test]
fn a_full_disk_is_a_full_disk_whichever_file_is_written() {
    let dir = folder();
    let run = copied_run(&dir);
    // What a user may have beside ours, under the names that a writer might think of.
    let theirs =
        ["scene.ply.part", "model.bin.part", "report.html.tmp", ".scene.ply.tmp"].map(|name| run.join(name));
    theirs.iter().for_each(|file| std::fs::write(file, "mine").expect("it is written"));
    let mine = || theirs.iter().all(|file| std::fs::read_to_string(file).is_ok_and(|text| text == "mine"));
    let args = again(&run, &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let files = struck_at_every_file(&args, 1, |n| assert!(mine(), "file {n}"));
    assert!(files > 8, "settings, scene, networks, model, splats, report, traces: {files}");
    same_as_untouched(&run);
    let (_, clicked) = clearest();
    let (folder, at) = (show(&run), format!("{},{}", clicked.x, clicked.y));
    let (folder, photo) = (folder.as_str(), clicked.photo.as_str());
    let click = ["segment", folder, "--photo", photo, "--positive", at.as_str()];
    let selection = run.join("selections/object");
    let files = struck_at_every_file(&click, 7, |n| {
        // The trace and the report are beside the selection, before and after it.
        assert!(
            !selection.exists() || selection.join("summary.json").is_file(),
            "half a selection at file {n}"
        );
    });
    assert!(files > 2 * shared_run().manifest.photos.len(), "a mask of each kind for each photo: {files}");
    let ply = show(&dir.path().join("baked.ply"));
    assert_eq!(struck_at_every_file(&["bake", folder, "--out", ply.as_str()], 1, |_| {}), 1);
    let out = show(&dir.path().join("renders"));
    assert_eq!(
        struck_at_every_file(&["render", folder, "--photo", photo, "--out", out.as_str()], 1, |_| {}),
        1
    );
    assert!(mine());
}

/// A file system of our own, unmounted when dropped; `None` where mounting is not allowed.
struct Mounted(PathBuf);
impl Mounted {
    fn new(at: PathBuf, options: &str) -> Option<Mounted> {
        std::fs::create_dir_all(&at).expect("a folder");
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(&at).output();
        mount.is_ok_and(|o| o.status.success()).then_some(Mounted(at))
    }

    fn remount(&self, options: &str) {
        let options = format!("remount,{options}");
        let done = Command::new("mount").args(["-o", &options]).arg(&self.0).status();
        assert!(done.expect("`mount` is there").success());
    }
}
impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_really_full_and_a_really_read_only_disk_are_reported() {
    let dir = folder();
    let Some(disk) = Mounted::new(dir.path().join("disk"), "size=400k") else {
        eprintln!(
            "skipped: a_really_full_and_a_really_read_only_disk_are_reported: mounting is not allowed here"
        );
        return;
    };
    let args = again(&disk.0.join("run"), &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 6, &["error:", "disk is full"]);
    disk.remount("ro");
    refuses(&args, 6, &["error:", "read"]);
    works(&["status", &show(&disk.0.join("run"))]);
    disk.remount("rw,size=100m");
    works(&args);
    // All but the regions of the photo at which the disk was full: a click computes and keeps those that are not there.
    let mut expected = results(&shared_run().run);
    expected.retain(|file, _| !file.starts_with("cache/regions.d"));
    has_all_of(&disk.0.join("run"), &expected);
}

#[test]
fn a_read_only_folder_is_reported() {
    let dir = folder();
    let run = dir.path().join("run");
    for point in ["read-only@file.write", "read-only@ledger.commit:12+"] {
        let args = again(&run, &["--fault", point]);
        refuses(&args.iter().map(String::as_str).collect::<Vec<_>>(), 6, &["read-only file system"]);
    }
    let occupied = dir.path().join("occupied");
    std::fs::write(&occupied, "a file").expect("it is written");
    let args = again(&occupied, &[]);
    refuses(&args.iter().map(String::as_str).collect::<Vec<_>>(), 6, &["occupied"]);
}

#[test]
fn a_cache_that_cannot_be_written_stops_the_run_and_gives_no_photo_up() {
    let dir = folder();
    let expected = results(&shared_run().run);
    for kind in ["embedding", "sky", "masks", "visibility"] {
        let run = dir.path().join(kind);
        // A file where a folder is wanted refuses whoever writes, also a user who may do everything.
        let occupied = run.join(format!("cache/{kind}.d"));
        std::fs::create_dir_all(run.join("cache")).expect("a folder");
        std::fs::write(&occupied, "a file").expect("it is written");
        let output = output(&again(&run, &[]));
        let stdout = text(&output.stderr);
        assert_eq!(output.status.code(), Some(6), "{kind}: {stdout}");
        assert!(
            stdout.contains("stopped: cannot") && stdout.contains(&format!("{kind}.d")),
            "{kind}: {stdout}"
        );
        assert!(!stdout.contains(".png failed") && !stdout.contains(".jpg failed"), "{kind}: {stdout}");
        std::fs::remove_file(&occupied).expect("it goes");
        completes(&again(&run, &[]));
        has_all_of(&run, &expected);
    }
}

/// Bytes of a folder's files on a disk that gives out whole pages.
fn on_disk(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).expect("a folder").flatten();
    let bytes = |path: PathBuf| match path.is_dir() {
        true => on_disk(&path),
        false => std::fs::metadata(&path).expect("it is there").len().next_multiple_of(4096),
    };
    entries.map(|entry| bytes(entry.path())).sum()
}

#[test]
fn a_worker_on_a_full_disk_takes_no_scene_until_there_is_space() {
    let dir = folder();
    let path = dir.path();
    // Space for the photos, and hardly more.
    let size = format!("size={}k", on_disk(&shared_run().scene) / 1024 + 300);
    let Some(disk) = Mounted::new(path.join("small"), &size) else {
        eprintln!(
            "skipped: a_worker_on_a_full_disk_takes_no_scene_until_there_is_space: mounting is not allowed here"
        );
        return;
    };
    let Some(server) = NatsServer::start(path) else { return };
    let (farm, scenes) = (server.farm("f"), manifest(path, &["a", "b"]));
    let handed = batch(path, &farm, &scenes, &["--no-wait"]).wait_with_output().expect("it ends");
    assert!(handed.status.success(), "{}", text(&handed.stderr));
    let program = || Command::new(env!("CARGO_BIN_EXE_segwild"));
    // Its own log lies on the disk that is full: what it cannot write there is lost, and nothing else.
    let (file, arguments) = (disk.0.join("worker.log"), ["--least-free", "0"]);
    let _small = worker_with_log(program(), path, &farm, "small", &file, &arguments);
    let log = || std::fs::read_to_string(&file).unwrap_or_default();
    let jobs = engine(&farm);
    let paused = || jobs.tallies().expect("it answers").into_values().find_map(|tally| tally.paused);
    until("its full disk", paused);
    let states = || jobs.jobs().expect("it answers");
    let failed = states().remove(0);
    assert_eq!((failed.job.id.as_str(), failed.failures), ("night/a", 1), "{}", log());
    assert!(failed.error.as_ref().is_some_and(|error| error.contains("free some space")), "{failed:?}");
    let status = works(&["status", "--farm", &farm]);
    assert!(status.contains("takes no scene") && status.contains(&show(&disk.0)), "{status}");
    // By now it would have taken the other scene, and failed that as well.
    rest(Duration::from_millis(1500));
    assert_eq!(states()[1].attempt, 0, "{}", log());
    // The rest of the failed scene is over: another worker finishes it, though its log takes not a byte.
    jobs.pass(10.0).expect("the server answers");
    let _second = worker_with_log(program(), path, &farm, "second", Path::new("/dev/full"), &[]);
    let taken = || matches!(states()[0].state, JobState::Leased | JobState::Done).then_some(());
    until("the scene on another worker", taken);
    disk.remount("size=200m");
    until("the other scene", || log().contains("night/b begins").then_some(()));
    assert!(log().contains("takes scenes again"), "{}", log());
    let ended = batch(path, &farm, &scenes, &[]).wait_with_output().expect("it ends");
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    for scene in ["a", "b"] {
        same_as_untouched(&path.join("night").join(scene));
    }
    let failures: Vec<u32> = states().iter().map(|job| job.failures).collect();
    assert_eq!(failures, [1, 0], "one scene filled the disk");
    let status = works(&["status", "--farm", &farm]);
    assert!(!status.contains("takes no scene"), "{status}");
}
