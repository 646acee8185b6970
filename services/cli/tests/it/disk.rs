//! Disks that are full or cannot be written: a sentence and an exit code, nothing lost.

use crate::common::*;
use std::path::PathBuf;
use std::process::Command;

#[test]
fn a_full_disk_is_said_and_loses_nothing() {
    let dir = folder();
    let run = dir.path().join("run");
    for point in
        ["full@file.write:8+", "full@ledger.commit:30+", "full@checkpoint.save", "full@file.write:5+"]
    {
        let output = output(&again(&run, &["--fault", point]));
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(6), "{point}: {said}");
        assert!(said.contains("error:") && said.contains("the disk is full"), "{point}: {said}");
        assert!(!said.contains("panicked"), "{said}");
    }
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

/// A file system of our own, unmounted when dropped; `None` where mounting is not allowed.
struct Mounted(PathBuf);
impl Mounted {
    fn new(at: PathBuf, options: &str) -> Option<Mounted> {
        std::fs::create_dir_all(&at).expect("a folder");
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(&at).output();
        mount.is_ok_and(|o| o.status.success()).then_some(Mounted(at))
    }
}
impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_really_full_and_a_really_read_only_disk_are_said() {
    let dir = folder();
    let Some(disk) = Mounted::new(dir.path().join("disk"), "size=400k") else {
        eprintln!(
            "skipped: a_really_full_and_a_really_read_only_disk_are_said: mounting is not allowed here"
        );
        return;
    };
    let args = again(&disk.0.join("run"), &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 6, &["error:", "disk is full"]);
    let remount = |options: &str| {
        let done = Command::new("mount").args(["-o", options]).arg(&disk.0).status();
        assert!(done.expect("`mount` is there").success());
    };
    remount("remount,ro");
    refuses(&args, 6, &["error:", "read"]);
    works(&["status", &show(&disk.0.join("run"))]);
    remount("remount,rw,size=100m");
    works(&args);
    same_as_untouched(&disk.0.join("run"));
}

#[test]
fn a_read_only_folder_is_said() {
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
    let expected = results(&place().run);
    for kind in ["embedding", "sky", "masks", "visibility"] {
        let run = dir.path().join(kind);
        // A file where a folder is wanted refuses whoever writes, also a user who may do everything.
        let occupied = run.join(format!("cache/{kind}.d"));
        std::fs::create_dir_all(run.join("cache")).expect("a folder");
        std::fs::write(&occupied, "a file").expect("it is written");
        let output = output(&again(&run, &[]));
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(6), "{kind}: {said}");
        assert!(said.contains("stopped: cannot") && said.contains(&format!("{kind}.d")), "{kind}: {said}");
        assert!(!said.contains(".png failed") && !said.contains(".jpg failed"), "{kind}: {said}");
        std::fs::remove_file(&occupied).expect("it goes");
        completes(&again(&run, &[]));
        has_all_of(&run, &expected);
    }
}
