//! Scenes of a batch go through the workers of a farm, whatever happens to them and to the server.

#[path = "../../../../tests/support/nats_server.rs"]
pub mod nats_server;

use crate::common::*;
use nats_server::NatsServer;
use segwild_farm::{FarmAccess, NatsEngine};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// A manifest of scenes that are all the shared run's.
pub fn manifest(dir: &Path, scenes: &[&str]) -> PathBuf {
    let settings: Vec<String> = QUICK
        .chunks(2)
        .map(|flag| {
            let (name, value) = (flag[0].trim_start_matches("--").replace('-', "_"), flag[1]);
            let number = value.parse::<u32>().is_ok();
            if number { format!("{name} = {value}") } else { format!("{name} = \"{value}\"") }
        })
        .collect();
    let mut text = format!("[defaults]\nsettings = {{ {} }}\n", settings.join(", "));
    for name in scenes {
        text += &format!("[[scene]]\npath = \"{}\"\nname = \"{name}\"\n", show(&shared_run().scene));
    }
    let file = dir.join("scenes.toml");
    std::fs::write(&file, text).expect("a manifest");
    file
}

/// A worker with a folder of its own and one core, with what it writes into a file.
pub fn worker(dir: &Path, farm: &str, name: &str, more: &[&str]) -> Guarded {
    worker_by(Command::new(env!("CARGO_BIN_EXE_segwild")), dir, farm, name, more)
}

/// The same, started by a command that ends in the program.
pub fn worker_by(program: Command, dir: &Path, farm: &str, name: &str, more: &[&str]) -> Guarded {
    worker_with_log(program, dir, farm, name, &dir.join(format!("{name}.log")), more)
}

/// The same, with what it writes into this file.
pub fn worker_with_log(
    mut program: Command,
    dir: &Path,
    farm: &str,
    name: &str,
    log: &Path,
    more: &[&str],
) -> Guarded {
    let log = std::fs::File::options().create(true).append(true).open(log);
    let child = program
        .args(["worker", "--farm", farm, "--needs", "cores=1,memory=2", "--store-every", "1", "--work"])
        .arg(dir.join(name))
        .args(more)
        .stdout(Stdio::null())
        .stderr(log.expect("a log"))
        .spawn()
        .expect("the program starts");
    Guarded(child)
}

pub fn batch(dir: &Path, farm: &str, manifest: &Path, more: &[&str]) -> Child {
    let args = ["batch", &show(manifest), "--out", &show(&dir.join("night")), "--farm", farm];
    start(&[&args[..], more].concat().iter().map(|s| (*s).to_owned()).collect::<Vec<_>>())
}

/// What a worker wrote.
pub fn log(dir: &Path, name: &str) -> String {
    std::fs::read_to_string(dir.join(format!("{name}.log"))).unwrap_or_default()
}

/// A handle of the farm, which lets time pass and reads what became of its jobs.
pub fn engine(farm: &str) -> NatsEngine {
    let (address, access) = (farm.parse().expect("an address"), FarmAccess::default());
    NatsEngine::connect(&address, &access, "test", Duration::from_secs(20)).expect("a farm")
}

#[test]
fn scenes_whose_workers_and_server_are_killed_end_in_the_bytes_of_one_machine() {
    let dir = folder();
    let path = dir.path();
    let Some(mut server) = NatsServer::start(path) else { return };
    let (farm, scenes) = (server.farm("f"), ["a", "b", "c"]);
    let watching = batch(path, &farm, &manifest(path, &scenes), &[]);
    let mut first = worker(path, &farm, "first", &[]);
    // As soon as a state is stored, its worker dies, and another one takes the scene over.
    until("a stored state", || log(path, "first").contains("is stored").then_some(()));
    first.0.kill().expect("it was running");
    first.0.wait().expect("it has ended");
    let _second = worker(path, &farm, "second", &[]);
    until("a scene on the second worker", || log(path, "second").contains("begins").then_some(()));
    server.kill();
    rest(Duration::from_millis(500));
    server.restart();
    // The first one comes back under its name, and what it held is free at once.
    let _again = worker(path, &farm, "first", &[]);
    let ended = watching.wait_with_output().expect("it ends");
    let (out, error) = (text(&ended.stdout), text(&ended.stderr));
    let logs = || format!("{error}\n-- first\n{}\n-- second\n{}", log(path, "first"), log(path, "second"));
    assert_eq!(ended.status.code(), Some(0), "{}", logs());
    assert!(out.contains("3 done"), "{out}");
    for scene in scenes {
        same_as_untouched(&path.join("night").join(scene));
    }
    let all = log(path, "first") + &log(path, "second");
    assert!(all.contains("to continue what another attempt stored"), "{}", logs());
    // The same command again finds everything done, and nothing is worked.
    let again =
        batch(path, &farm, &path.join("scenes.toml"), &["--json"]).wait_with_output().expect("it ends");
    let last = lines(&text(&again.stdout)).pop().expect("a summary");
    assert_eq!((again.status.code(), &last["summary"]["interrupted"]), (Some(0), &serde_json::json!(false)));
}

#[test]
fn a_worker_that_is_stopped_stores_its_scene_and_hands_it_back() {
    let dir = folder();
    let path = dir.path();
    let Some(server) = NatsServer::start(path) else { return };
    let farm = server.farm("f");
    let shared = show(&path.join("shared"));
    let store = ["--artefacts", &*shared];
    let handed = batch(path, &farm, &manifest(path, &["a"]), &[&store[..], &["--no-wait"]].concat());
    let handed = handed.wait_with_output().expect("it ends");
    assert_eq!(handed.status.code(), Some(0), "{}", text(&handed.stderr));
    let mut first = worker(path, &farm, "first", &store);
    until("its beginning", || log(path, "first").contains("begins").then_some(()));
    rest(Duration::from_millis(300));
    signal(&first.0, "-TERM");
    assert!(first.0.wait().expect("it ends").success(), "{}", log(path, "first"));
    assert!(log(path, "first").contains("other workers continue"), "{}", log(path, "first"));
    // One that drains ends when nothing is left.
    let mut second = worker(path, &farm, "second", &[&store[..], &["--drain"]].concat());
    assert!(second.0.wait().expect("it ends").success(), "{}", log(path, "second"));
    let watched = batch(path, &farm, &path.join("scenes.toml"), &store).wait_with_output().expect("it ends");
    assert_eq!(watched.status.code(), Some(0), "{}", text(&watched.stderr));
    same_as_untouched(&path.join("night/a"));
    // The scene's photos and result are in use, and what was stored on the way is young.
    let sweep = ["cache", "farm-gc", "--farm", &*farm, "--dry-run", "--json", "--artefacts"];
    let swept = lines(&works(&[&sweep[..], &[&*shared]].concat())).pop().expect("a summary");
    assert_eq!(swept["dry_run"], serde_json::json!(true), "{swept}");
    let summary = &swept["summary"];
    assert_eq!((summary["removed"]["artefacts"].as_u64(), summary["missing"].as_u64()), (Some(0), Some(0)));
    assert!(summary["young"]["artefacts"].as_u64().is_some_and(|young| young > 2), "{swept}");
    let other = show(&path.join("other"));
    refuses(&[&sweep[..], &[&*other]].concat(), 2, &["another farm's store", "--artefacts"]);
    std::fs::write(path.join("key"), "another farm's").expect("it writes");
    let key = show(&path.join("key"));
    refuses(&[&sweep[..], &[&*shared, "--farm-key", &*key]].concat(), 2, &[&*farm, "--farm-key"]);
    // What is done needs no room on the worker.
    assert!(
        !path.join("second/runs/night/a").exists()
            && !path.join("second/inputs").read_dir().is_ok_and(|mut d| d.next().is_some())
    );
}

#[test]
fn what_is_wrong_with_a_farm_is_named_in_words() {
    let dir = folder();
    let path = dir.path();
    let file = show(&manifest(path, &["a"]));
    refuses(&["worker"], 2, &["--farm"]);
    refuses(&["worker", "--farm", "http://x/y"], 2, &["no farm", "nats://HOST:PORT/NAME"]);
    refuses(&["status", "--farm", "nats://x:4222"], 2, &["no farm", "nats://HOST:PORT/NAME"]);
    for command in ["worker", "serve"] {
        let output = segwild(&[command, "--farm", "nats://me:hunter2@x/y"]);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains("credentials file") && !error.contains("hunter2"), "{error}");
    }
    refuses(&["worker", "--farm", "nats://x/y", "--needs", "disk=3"], 2, &["`disk=3`", "cores=N"]);
    refuses(&["batch", &file, "--artefacts", "/tmp/x"], 2, &["--farm"]);
    let Some(server) = NatsServer::start(path) else { return };
    let farm = server.farm("f");
    let empty = text(&segwild(&["status", "--farm", &farm]).stdout);
    assert!(empty.contains("no scenes and no workers") && !empty.contains("run by"), "{empty}");
    let (out, missing) = (show(&path.join("o")), show(&path.join("none")));
    refuses(
        &["batch", &file, "--farm", &farm, "--out", &out, "--farm-key", &missing],
        2,
        &["--farm-key", "none"],
    );
    refuses(&["batch", &file, "--farm", &farm, "--out", &out, "--artefacts", "ftp://x"], 2, &["ftp://x"]);
    std::fs::write(
        path.join("code.toml"),
        "[[scene]]\npath = \".\"\nname = \"a\"\nsettings = { models = \"/m\" }\n",
    )
    .expect("a manifest");
    let code = show(&path.join("code.toml"));
    refuses(
        &["batch", &code, "--farm", &farm, "--out", &out],
        2,
        &["`models`", "where the workers are started"],
    );
}

/// A script of `deploy/slurm/` as Slurm starts it. `scontrol` is a stand-in that writes down how it is called, to `scontrol.log`,
/// and ends the script, as Slurm does with a job that it requeues; what the script prints goes to `slurm.log`.
fn under_slurm(dir: &Path, script: &str) -> Command {
    let tools = dir.join("bin");
    if !tools.exists() {
        std::fs::create_dir(&tools).expect("a folder");
        std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_segwild"), tools.join("segwild")).expect("a link");
        let log = show(&dir.join("scontrol.log"));
        let stand_in = format!("#!/bin/sh\necho \"$@\" >> {log}\nkill -KILL $PPID\n");
        std::fs::write(tools.join("scontrol"), stand_in).expect("it writes");
        let made = Command::new("chmod").arg("+x").arg(tools.join("scontrol")).status();
        assert!(made.expect("`chmod` is there").success());
    }
    let log = std::fs::File::create(dir.join("slurm.log")).expect("a log");
    let paths = format!("{}:{}", show(&tools), std::env::var("PATH").unwrap_or_default());
    let mut command = Command::new("bash");
    command
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/slurm").join(script))
        .env("PATH", paths)
        .envs([("SLURM_JOB_ID", "7"), ("SLURM_CPUS_PER_TASK", "1")])
        .stdout(Stdio::null())
        .stderr(log);
    command
}

/// How `scontrol` was called.
fn scontrol_calls(dir: &Path) -> String {
    std::fs::read_to_string(dir.join("scontrol.log")).unwrap_or_default().trim().to_owned()
}

/// What Slurm does with deploy/slurm/worker.sbatch: it runs it, and sends SIGTERM to it before its time is over.
#[test]
fn a_worker_under_slurm_hands_its_scene_back_when_its_time_is_over_and_is_requeued() {
    let dir = folder();
    let path = dir.path();
    let Some(server) = NatsServer::start(path) else { return };
    let farm = server.farm("f");
    let handed =
        batch(path, &farm, &manifest(path, &["a"]), &["--no-wait"]).wait_with_output().expect("it ends");
    assert!(handed.status.success(), "{}", text(&handed.stderr));
    let child = under_slurm(path, "worker.sbatch")
        .envs([
            ("SEGWILD_FARM", &*farm),
            ("SLURM_MEM_PER_NODE", "2048"),
            ("SEGWILD_FLAGS", "--store-every 1"),
        ])
        .env("SLURM_TMPDIR", path.join("node"))
        .spawn()
        .expect("bash starts");
    let mut child = Guarded(child);
    until("its beginning", || log_of(path).contains("begins").then_some(()));
    signal(&child.0, "-TERM");
    assert_eq!(child.0.wait().expect("it ends").code(), None, "{}", log_of(path));
    assert!(log_of(path).contains("other workers continue"), "{}", log_of(path));
    assert_eq!(scontrol_calls(path), "requeue 7", "{}", log_of(path));
    let left = std::fs::read_dir(path.join("node")).map(|files| files.count()).unwrap_or_default();
    assert_eq!(left, 0, "its folder is removed");
    let status = works(&["status", "--farm", &farm]);
    assert!(status.contains("night/a: waiting"), "{status}");
}

#[test]
fn a_scene_under_slurm_fails_with_bad_photos_and_is_requeued_when_its_time_is_over() {
    let dir = folder();
    let path = dir.path();
    let list = path.join("scenes.txt");
    std::fs::write(&list, format!("/nowhere/at/all\n{}\n", show(scene()))).expect("it writes");
    let element = |task: &str, flags: &str| {
        let mut command = under_slurm(path, "scenes.sbatch");
        command.arg(&list).env("SEGWILD_RUNS", path.join("runs"));
        Guarded(
            command
                .envs([("SLURM_ARRAY_TASK_ID", task), ("SEGWILD_FLAGS", flags)])
                .spawn()
                .expect("bash starts"),
        )
    };
    let failed = element("1", "").0.wait().expect("it ends");
    assert_eq!((failed.code(), scontrol_calls(path)), (Some(3), String::new()), "{}", log_of(path));
    let mut stopped = element("2", "--size 96 --steps 4000");
    let run = path.join("runs").join(scene().file_name().expect("a name"));
    until("its beginning", || run.join("run.lock").exists().then_some(()));
    signal(&stopped.0, "-TERM");
    assert_eq!(stopped.0.wait().expect("it ends").code(), None, "{}", log_of(path));
    assert_eq!(scontrol_calls(path), "requeue 7", "{}", log_of(path));
}

fn log_of(dir: &Path) -> String {
    log(dir, "slurm")
}
