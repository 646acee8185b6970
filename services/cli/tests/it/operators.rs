//! Operators at work: looking at a run from another process, batches that are killed and go on, and every expression of
//! `deploy/` against a real Prometheus that scrapes a real batch.

use crate::common::*;
use crate::farm::nats_server::NatsServer;
use segwild_farm::{FarmAccess, Job, JobEngine, JobLease, NatsEngine, Needs, WorkerOffer};
use serde_json::Value;
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

/// A manifest of the small scene under several names.
fn manifest(dir: &Path, steps: u32, names: &[&str], more: &str) -> String {
    let mut text = format!(
        "[budget]\ncores = 2\n[defaults]\ncores = 1\nmemory = \"300 MiB\"\n\
         settings = {{ size = 96, steps = {steps}, refine_steps = 4, prompt_budget = 24, checkpoint_every = 1 }}\n"
    );
    for name in names {
        text += &format!("[[scene]]\nname = \"{name}\"\npath = \"{}\"\n", scene().display());
    }
    let file = dir.join("scenes.toml");
    std::fs::write(&file, text + more).expect("it writes");
    show(&file)
}

#[test]
fn status_reads_a_run_from_another_process() {
    let dir = folder();
    let run = show(&dir.path().join("run"));
    let mut child = in_background(&["run", &show(scene()), "--out", &run, "--size", "96", "--steps", "4000"]);
    let seen = until("a run that trains", || {
        let output = segwild(&["status", &run, "--json", "--once"]);
        let seen = output.status.success().then(|| json(&output.stdout))?;
        let trains =
            seen["stages"].as_array()?.iter().any(|s| s["name"] == "geometry" && s["state"] == "running");
        (trains && seen["actors"].as_array().is_some_and(|a| a.len() > 2)).then_some(seen)
    });
    assert_eq!(
        (&seen["kind"], &seen["running"], &seen["pid"]),
        (&"run".into(), &true.into(), &child.0.id().into())
    );
    let waits = |name: &str| {
        let stages = seen["stages"].as_array().expect("stages");
        stages.iter().find(|s| s["name"] == name).map(|s| s["why"].to_string()).unwrap_or_default()
    };
    assert!(waits("features").contains("waits for"), "{seen}");
    let page = text(&segwild(&["top", &run, "--once"]).stdout);
    assert!(
        page.contains("running (process") && page.contains("trainer") && page.contains("why it waits"),
        "{page}"
    );
    child.0.kill().expect("it can be killed");
    child.0.wait().expect("it ends");
    let after = json(&segwild(&["status", &run, "--json"]).stdout);
    assert_eq!((&after["state"], &after["running"]), (&"stopped".into(), &false.into()));
    assert_eq!(after["actors"].as_array().map(Vec::len), seen["actors"].as_array().map(Vec::len), "it stays");
    let stdout = text(&segwild(&["status", &run]).stdout);
    assert!(stdout.contains("no process is working on this run"), "{stdout}");
    let refused = segwild(&["top", &run]);
    assert_eq!(refused.status.code(), Some(2), "no terminal");
    assert!(text(&refused.stderr).contains("--once"));
}

#[test]
fn a_batch_that_was_killed_goes_on_to_the_same_bytes() {
    let dir = folder();
    let (batch, straight) = (dir.path().join("batch"), dir.path().join("straight"));
    let bad = "[[scene]]\nname = \"bad\"\npath = \"/nowhere/at/all\"\n";
    let file = manifest(dir.path(), 1500, &["one", "two"], bad);
    let args = ["batch", &file, "--out", &show(&batch)];
    let mut child = in_background(&args);
    until("the training of a scene", || {
        let history = batch.join("one/history.jsonl");
        std::fs::read_to_string(history).ok().filter(|t| !t.is_empty())
    });
    child.0.kill().expect("it can be killed");
    child.0.wait().expect("it ends");
    // Its scenes notice that they are alone, and stop where they can go on.
    until("the end of the orphans", || {
        let view = json(&segwild(&["status", &show(&batch), "--json"]).stdout);
        let scenes = view["scenes"].as_array().expect("scenes").clone();
        scenes.iter().all(|s| s["run"].is_null() || s["run"]["running"] == false).then_some(())
    });
    let view = json(&segwild(&["status", &show(&batch), "--json"]).stdout);
    assert!(view["owner"].is_null() && view["scenes"][0]["state"] == "waiting", "{view}");
    let output = segwild(&args);
    let (stdout, table) = (text(&output.stderr), text(&output.stdout));
    assert_eq!(output.status.code(), Some(4), "{stdout}");
    assert!(
        stdout.contains("bad was given up") && stdout.contains("1 of 3 scenes were given up"),
        "{stdout}"
    );
    assert!(table.contains("2 done, 1 given up, 0 waiting"), "{table}");
    let view = json(&segwild(&["status", &show(&batch), "--json"]).stdout);
    assert_eq!(view["scenes"][0]["failures"], 0, "a kill of the batch is no failure of its scenes");
    // As straight as can be.
    let settings = show(&batch.join("settings/one.toml"));
    let run = ["run", &show(scene()), "--out", &show(&straight), "--config", &settings, "--threads", "2"];
    assert_eq!(segwild(&run).status.code(), Some(0));
    for file in ["model.bin", "features.bin"] {
        let bytes = |folder: &Path| std::fs::read(folder.join(file)).expect("it is there");
        assert!(bytes(&straight) == bytes(&batch.join("one")), "{file} depends on the kill");
        assert!(bytes(&straight) == bytes(&batch.join("two")), "{file} depends on the kill");
    }
    // Nothing is left to do; who was given up stays so.
    let again = segwild(&args);
    assert_eq!(again.status.code(), Some(4));
    assert!(!text(&again.stderr).contains("begins"), "{}", text(&again.stderr));
}

#[cfg(target_os = "linux")]
#[test]
fn scenes_of_a_batch_keep_to_their_own_cores() {
    let cores = segwild_flow::cpu::allowed();
    if cores.len() < 2 {
        println!("skipped: scenes_of_a_batch_keep_to_their_own_cores: this machine has one core");
        return;
    }
    let dir = folder();
    let batch = show(&dir.path().join("batch"));
    let file = manifest(dir.path(), 4000, &["one", "two"], "");
    let mut child = in_background(&["batch", &file, "--out", &batch]);
    let threads = until("two processes at work", || {
        let output = segwild(&["status", &batch, "--json"]);
        let view = output.status.success().then(|| json(&output.stdout))?;
        let pids = view["scenes"].as_array()?.iter().filter(|s| s["run"]["running"] == true);
        let pids: Vec<u64> = pids.filter_map(|s| s["run"]["pid"].as_u64()).collect();
        let of = |pid: &u64| -> Vec<Vec<u32>> {
            let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
            let status = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("status")).ok());
            let list = |text: String| {
                let line = text.lines().find_map(|l| l.strip_prefix("Cpus_allowed_list:").map(str::to_owned));
                line.and_then(|l| segwild_flow::cpu::read_list(l.trim()))
            };
            status.filter_map(list).collect()
        };
        let threads: Vec<_> = pids.iter().map(of).collect();
        (threads.len() == 2 && threads.iter().all(|t| t.len() > 3)).then_some(threads)
    });
    child.0.kill().expect("it can be killed");
    let own: Vec<&Vec<u32>> = threads.iter().map(|t| &t[0]).collect();
    assert!(own[0].len() == 1 && own[1].len() == 1 && own[0] != own[1], "{own:?} of {cores:?}");
    for (own, threads) in own.iter().zip(&threads) {
        assert!(threads.iter().all(|t| t == *own), "a thread of it runs elsewhere: {threads:?}");
    }
}

#[cfg(unix)]
#[test]
fn ctrl_c_stops_a_batch_where_it_can_go_on() {
    let dir = folder();
    let batch = dir.path().join("batch");
    let file = manifest(dir.path(), 4000, &["one"], "");
    let mut child = Command::new(env!("CARGO_BIN_EXE_segwild"))
        .args(["batch", &file, "--out", &show(&batch)])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    until("the training of a scene", || {
        std::fs::read_to_string(batch.join("one/history.jsonl")).ok().filter(|t| !t.is_empty())
    });
    signal(&child, "-INT");
    let mut stdout = String::new();
    child.stderr.take().expect("a pipe").read_to_string(&mut stdout).expect("it speaks");
    assert_eq!(child.wait().expect("it ends").code(), Some(130), "{stdout}");
    assert!(stdout.contains("one stopped; it can go on"), "{stdout}");
    let view = json(&segwild(&["status", &show(&batch), "--json"]).stdout);
    assert_eq!((&view["scenes"][0]["state"], &view["scenes"][0]["failures"]), (&"waiting".into(), &0.into()));
}

#[test]
fn a_batch_that_stopped_half_way_on_request_goes_on_without_it() {
    let dir = folder();
    let batch = show(&dir.path().join("batch"));
    // One scene stops by the manifest, the other by nothing but the command line.
    let file = manifest(dir.path(), 60, &["one", "two"], "until = \"geometry\"\n");
    let state = |name: &str| {
        let view = json(&segwild(&["status", &batch, "--json"]).stdout);
        let scenes = view["scenes"].as_array().expect("scenes").clone();
        let scene = scenes.into_iter().find(|s| s["name"] == name).expect("a scene");
        let stages = scene["run"]["stages"].as_array().expect("stages").clone();
        let stage = |name: &str| stages.iter().find(|s| s["name"] == name).expect("a stage")["state"].clone();
        [scene["state"].clone(), scene["until"].clone(), stage("geometry"), stage("report")]
    };
    works(&["batch", &file, "--out", &batch, "--until", "30"]);
    assert_eq!(state("one"), ["done", "30", "pending", "waiting"]);
    assert_eq!(state("two"), ["done", "30", "pending", "waiting"], "the command line has the last word");
    works(&["batch", &file, "--out", &batch]);
    assert_eq!(state("one"), [Value::from("done"), Value::Null, "done".into(), "done".into()]);
    assert_eq!(state("two"), ["done", "geometry", "done", "waiting"]);
    let stdout = works(&["status", &batch]);
    assert!(stdout.contains("two: done (until geometry)"), "{stdout}");
}

#[test]
fn a_scene_whose_folder_is_in_use_is_shown_as_waiting_and_why() {
    let dir = folder();
    let (batch, file) = (dir.path().join("batch"), manifest(dir.path(), 60, &["one"], ""));
    let out = show(&batch.join("one"));
    let stalled = ["--size", "96", "--fault", "stall@masks.handle:3"];
    let mut holder = in_background(&[&["run", &show(scene()), "--out", &out][..], &stalled].concat());
    let pid = holder.0.id();
    until("the folder to be held", || {
        std::fs::read_to_string(batch.join("one/run.lock")).ok().filter(|t| t.trim() == pid.to_string())
    });
    let batch = show(&batch);
    let mut child = in_background(&["batch", &file, "--out", &batch]);
    let why = until("a scene that waits, and why", || {
        let output = segwild(&["status", &batch, "--json"]);
        let scene = output.status.success().then(|| json(&output.stdout)["scenes"][0].clone())?;
        assert_ne!(scene["state"], "done");
        let why = scene["why"].as_str()?.to_owned();
        (scene["state"] == "waiting" && why.contains("in use")).then_some(why)
    });
    assert!(why.contains(&format!("its run folder is in use by process {pid}")), "{why}");
    let stdout = works(&["status", &batch]);
    assert!(stdout.contains("one: waiting") && stdout.contains(&why), "{stdout}");
    let page = works(&["top", &batch, "--once"]);
    assert!(page.contains("1 waiting") && page.contains("in use by process"), "{page}");
    holder.0.kill().expect("it can be killed");
    holder.0.wait().expect("it ends");
    until("the scene to begin", || {
        let scene = json(&segwild(&["status", &batch, "--json"]).stdout)["scenes"][0].clone();
        (scene["state"] != "waiting").then_some(())
    });
    assert_eq!(child.0.wait().expect("it ends").code(), Some(0));
}

#[test]
fn a_clock_that_jumps_in_a_rest_is_reported_once_and_changes_nothing() {
    let dir = folder();
    // A folder that cannot be made is worth another attempt.
    std::fs::write(dir.path().join("file"), "no folder").expect("it writes");
    for (fault, words) in
        [("jump", "the clock was set back by 24 h 0 min"), ("leap", "the clock went ahead by 24 h 0 min")]
    {
        // Which reading of the clock falls into the rest of five seconds depends on how busy the machine is.
        let in_rest = [12, 16, 8].into_iter().find_map(|reading| {
            let at = format!("{fault}{reading}");
            let file = manifest(dir.path(), 60, &["one"], "attempts = 2\nout = \"file/one\"\n");
            let batch = show(&dir.path().join(&at));
            let output =
                segwild(&["batch", &file, "--out", &batch, "--fault", &format!("{fault}@clock:{reading}+")]);
            let stdout = text(&output.stderr);
            assert_eq!(output.status.code(), Some(4), "{stdout}");
            let shared_run = |words: &str| stdout.find(words);
            let rest = shared_run("tries again in 5.0 s")..shared_run("was given up");
            (shared_run(words).is_some() && rest.contains(&shared_run(words))).then_some((output, stdout))
        });
        let (output, stdout) = in_rest.expect("one reading falls into the rest");
        assert_eq!(stdout.matches("the clock").count(), 1, "{stdout}");
        let table = text(&output.stdout);
        let row: Vec<&str> = table.lines().nth(1).expect("a row").split_whitespace().collect();
        assert_eq!(row[..3], ["one", "dead", "2"], "{table}");
    }
}

#[test]
fn a_scene_that_does_not_fit_the_memory_is_refused_before_anything_starts() {
    let dir = folder();
    let (batch, file) = (dir.path().join("batch"), dir.path().join("scenes.toml"));
    let scene = format!("[[scene]]\nname = \"small\"\npath = \"{}\"\n", scene().display());
    let large = scene.replace("small", "large") + "settings = { splats = 4000000 }\n";
    for (budget, more, words) in [
        (
            "",
            "memory = \"40 MiB\"\n",
            &["scene `small`: it needs about", "its `memory` is 40 MiB", "`size`"][..],
        ),
        (
            "memory = \"600 MiB\"\n",
            "",
            &["scene `large`: it needs about", "4000000 splats", "the budget is 600 MiB"],
        ),
    ] {
        let text = format!("[budget]\n{budget}[defaults]\nsettings = {{ size = 96 }}\n{scene}{more}{large}");
        std::fs::write(&file, text).expect("it writes");
        refuses(&["batch", &show(&file), "--out", &show(&batch)], 2, words);
        assert!(!batch.exists(), "nothing has begun");
    }
    // What it is given is a budget that the run keeps to.
    let file = manifest(dir.path(), 20, &["small"], "memory = \"220 MiB\"\n");
    works(&["batch", &file, "--out", &show(&batch)]);
    let kept = std::fs::read_to_string(batch.join("small/segwild.toml")).expect("its settings");
    assert!(kept.contains("memory_budget = 220"), "{kept}");
}

#[test]
fn mistakes_of_operators_are_answered_in_words() {
    let dir = folder();
    let file = dir.path().join("scenes.toml");
    std::fs::write(&file, "[[scene]]\npath = \"a\"\nsettings = { stpes = 3 }\n").expect("it writes");
    let cases: [(&[&str], i32, &str); 5] = [
        (&["batch", &show(&file), "--out", &show(&dir.path().join("b"))], 2, "stpes"),
        (&["batch", "/nowhere.toml"], 2, "/nowhere.toml"),
        (&["top", &show(dir.path()), "--once"], 6, "no batch folder"),
        (&["run", &show(scene()), "--metrics-listen", "here"], 2, "--metrics-listen"),
        (&["status", &show(dir.path()), "--once", "--follow"], 2, "cannot be used with"),
    ];
    for (args, code, word) in cases {
        let output = segwild(args);
        let stdout = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {stdout}");
        assert!(stdout.contains(word), "{args:?} does not say `{word}`: {stdout}");
    }
}

fn deploy(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy").join(file)
}

fn installed(program: &str) -> bool {
    Command::new(program).arg("--version").output().is_ok_and(|o| o.status.success())
}

#[test]
fn the_alert_rules_fire_when_they_should() {
    if !installed("promtool") {
        println!(
            "skipped: the_alert_rules_fire_when_they_should: promtool is missing (apt-get install prometheus)"
        );
        return;
    }
    let folder = deploy("prometheus");
    for args in [
        &["check", "rules", "alerts.yml"][..],
        &["test", "rules", "alerts.test.yml"],
        &["check", "config", "prometheus.yml"],
    ] {
        let output = Command::new("promtool").args(args).current_dir(&folder).output().expect("it runs");
        assert!(output.status.success(), "{args:?}: {}{}", text(&output.stdout), text(&output.stderr));
    }
    // Every alert has a test of its own, and a paragraph for who is woken by it.
    let read = |file: PathBuf| std::fs::read_to_string(file).expect("it is there");
    let (rules, tests) = (read(folder.join("alerts.yml")), read(folder.join("alerts.test.yml")));
    let page = read(deploy("../docs/guide/operate.md"));
    for alert in rules.lines().filter_map(|l| l.trim().strip_prefix("- alert: ")) {
        assert!(tests.contains(&format!("alertname: {alert}")), "{alert} is not tested");
        assert!(page.contains(&format!("`{alert}`")), "{alert} is not explained");
    }
}

fn get(address: SocketAddr, path: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).ok()?;
    // HTTP/1.0: the answer comes in one piece.
    write!(stream, "GET {path} HTTP/1.0\r\nHost: x\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    answer.split_once("\r\n\r\n").map(|(_, body)| body.to_owned())
}

fn escaped(query: &str) -> String {
    query
        .bytes()
        .map(|b| if b.is_ascii_alphanumeric() { (b as char).to_string() } else { format!("%{b:02X}") })
        .collect()
}

/// Two ports that nobody listens on, not the same.
fn free_ports() -> (SocketAddr, SocketAddr) {
    let held = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("a port"));
    let [one, other] = held.each_ref().map(|l| l.local_addr().expect("its address"));
    (one, other)
}

/// The expressions of a dashboard's panels, with their titles.
fn panels(dashboard: &str) -> Vec<(String, String)> {
    let file = deploy("grafana/dashboards").join(dashboard);
    let dashboard = json(&std::fs::read(file).expect("a dashboard"));
    let mut found = Vec::new();
    for panel in dashboard["panels"].as_array().expect("panels") {
        for target in panel["targets"].as_array().expect("targets") {
            let part = |v: &Value| v.as_str().expect("a text").to_owned();
            found.push((part(&panel["title"]), part(&target["expr"])));
        }
    }
    found
}

/// The metric names that an expression asks for.
fn names_in(expression: &str) -> BTreeSet<&str> {
    let word = |c: char| !(c.is_ascii_alphanumeric() || c == '_');
    expression.split(word).filter(|w| w.starts_with("segwild_")).collect()
}

/// A farm of which a worker holds one scene and one waits, and the process that shows it.
struct ShownFarm {
    address: SocketAddr,
    engine: NatsEngine,
    lease: JobLease,
    _monitor: Guarded,
    _server: NatsServer,
}

impl ShownFarm {
    /// `None` where no nats-server is installed.
    fn start(dir: &Path) -> Option<ShownFarm> {
        let server = NatsServer::start(dir)?;
        let farm = server.farm("night");
        let (at, access) = (farm.parse().expect("an address"), FarmAccess::default());
        let engine = NatsEngine::connect(&at, &access, "test", Duration::from_secs(20)).expect("a farm");
        for name in ["night/held", "night/waits"] {
            engine.publish(&Job::new(name, "{}", Needs::default())).expect("it is handed in");
        }
        let offer = WorkerOffer::all("w", Needs::default(), 600.0);
        let lease = engine.claim(&offer).expect("it answers").expect("a lease");
        let monitor = Command::new(env!("CARGO_BIN_EXE_segwild"))
            .args(["status", "--farm", &farm, "--metrics-listen", "127.0.0.1:0"])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        let mut monitor = Guarded(monitor.expect("the program starts"));
        let mut lines = BufReader::new(monitor.0.stderr.take().expect("a pipe")).lines();
        let first = lines.next().expect("a line").expect("it speaks");
        let address = first.strip_prefix("listening on http://").and_then(|address| address.parse().ok());
        let address = address.unwrap_or_else(|| panic!("{first}"));
        Some(ShownFarm { address, engine, lease, _monitor: monitor, _server: server })
    }
}

#[test]
fn a_real_prometheus_answers_every_panel_and_every_rule() {
    let name = "a_real_prometheus_answers_every_panel_and_every_rule";
    if !installed("prometheus") {
        println!("skipped: {name}: prometheus is missing (apt-get install prometheus)");
        return;
    }
    let dir = folder();
    let batch = dir.path().join("batch");
    // One scene is done, and somebody has clicked in it; the other one is still to come.
    let file = manifest(dir.path(), 1500, &["one"], "");
    works(&["batch", &file, "--out", &show(&batch), "--until", "features"]);
    // So small a scene is not sharp everywhere: one of the objects will do.
    let clicks: Vec<_> = shared_run().manifest.objects.iter().flat_map(|o| &o.clicks).collect();
    let hit = clicks.iter().any(|c| {
        let at = format!("{},{}", c.x, c.y);
        segwild(&["segment", &show(&batch.join("one")), "--photo", &c.photo, "--positive", &at])
            .status
            .success()
    });
    assert!(hit, "none of {} clicks selects anything", clicks.len());
    let file = manifest(dir.path(), 1500, &["one", "two"], "");
    // Prometheus waits for the batch, not the other way round: on a fast machine its start takes as long as the batch.
    let (prometheus, target) = free_ports();
    let farm = ShownFarm::start(&dir.path().join("queue"));
    let targets: Vec<String> =
        [target].into_iter().chain(farm.as_ref().map(|farm| farm.address)).map(|a| a.to_string()).collect();
    // The rules as they are shipped, looked at so often that the shortest stage is seen.
    let config = std::fs::read_to_string(deploy("prometheus/prometheus.yml"))
        .expect("it is there")
        .replace("segwild:9464", &targets.join("\", \""))
        .replace("alerts.yml", &show(&deploy("prometheus/alerts.yml").canonicalize().expect("it is there")))
        .replace("scrape_interval: 5s", "scrape_interval: 100ms")
        .replace("evaluation_interval: 15s", "evaluation_interval: 200ms");
    let config_file = dir.path().join("prometheus.yml");
    std::fs::write(&config_file, config).expect("it writes");
    let _prometheus = Guarded(
        Command::new("prometheus")
            .arg(format!("--config.file={}", config_file.display()))
            .arg(format!("--storage.tsdb.path={}", dir.path().join("tsdb").display()))
            .arg(format!("--web.listen-address={prometheus}"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("prometheus starts"),
    );
    let now = || {
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        since.expect("a clock").as_secs_f64()
    };
    let start = now();
    let ask = |expression: &str| -> Value {
        // Over the whole time of the batch, as Grafana asks.
        let path = format!(
            "/api/v1/query_range?query={}&start={start}&end={}&step=100ms",
            escaped(expression),
            now().min(start + 1000.0)
        );
        json(get(prometheus, &path).expect("it answers").as_bytes())
    };
    until("prometheus", || get(prometheus, "/-/ready").filter(|t| t.contains("Ready")));
    until("its first look", || {
        ask("up")["data"]["result"].as_array().filter(|r| !r.is_empty()).map(Vec::len)
    });
    // What was there at any time: at the end nothing is running any more.
    let mut scraped = BTreeSet::new();
    if let Some(farm) = &farm {
        until("the farm in Prometheus", || {
            let seen = ask("segwild_farm_heartbeat_age_seconds{worker=\"w\"}");
            seen["data"]["result"].as_array().filter(|r| !r.is_empty()).map(Vec::len)
        });
        let body = get(farm.address, "/metrics").expect("it answers");
        assert!(body.contains("segwild_farm_queue_depth{accelerator=\"any\"} 1\n"), "{body}");
        scraped.extend(body.lines().flat_map(names_in).map(str::to_owned));
        farm.engine.complete(&farm.lease, "{}").expect("it is held");
    }
    let mut child = Guarded(
        Command::new(env!("CARGO_BIN_EXE_segwild"))
            .args(["batch", &file, "--out", &show(&batch), "--metrics-listen", &target.to_string()])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts"),
    );
    let mut lines = BufReader::new(child.0.stderr.take().expect("a pipe")).lines();
    let first = lines.next().expect("a line").expect("it speaks");
    assert_eq!(first, format!("listening on http://{target}"));
    let speaks = std::thread::spawn(move || lines.map_while(Result::ok).collect::<Vec<_>>().join("\n"));
    let code = until("the end of the batch", || {
        if let Some(body) = get(target, "/metrics").filter(|t| t.contains("segwild_scenes")) {
            scraped.extend(body.lines().flat_map(names_in).map(str::to_owned));
        }
        child.0.try_wait().expect("a child")
    });
    let stdout = speaks.join().unwrap_or_default();
    assert_eq!(code.code(), Some(0), "{stdout}");
    let (mut shown, of_farm) = (panels("segwild.json"), panels("farm.json"));
    assert!(shown.len() > 20 && of_farm.len() > 15, "a dashboard has lost its panels");
    // Without a queue there is no farm.
    shown.extend(of_farm.into_iter().filter(|_| farm.is_some()));
    for (title, expression) in &shown {
        let answer = ask(expression);
        assert_eq!(answer["status"], "success", "panel `{title}`: {answer}");
        let series = answer["data"]["result"].as_array().expect("a result");
        assert!(!series.is_empty(), "panel `{title}` shows nothing: {expression}");
    }
    let rules = json(get(prometheus, "/api/v1/rules").expect("it answers").as_bytes());
    let groups = rules["data"]["groups"].as_array().expect("groups");
    // Without a queue there is no farm whose metrics could be there.
    let shown = groups.iter().filter(|group| farm.is_some() || group["name"] != "segwild-farm");
    let rules: Vec<&Value> =
        shown.flat_map(|group| group["rules"].as_array().expect("rules").iter()).collect();
    assert!(rules.len() >= if farm.is_some() { 12 } else { 8 }, "{rules:?}");
    for rule in rules {
        assert_eq!(rule["health"], "ok", "{rule}");
        let expression = rule["query"].as_str().expect("an expression");
        for name in names_in(expression) {
            assert!(scraped.contains(name), "`{name}` of {} was never there", rule["name"]);
        }
    }
    // The batch is done; nothing of it was an alarm.
    let firing = ask("sum(ALERTS{alertstate=\"firing\", alertname!=\"SegwildDown\"})");
    assert_eq!(firing["data"]["result"].as_array().map(Vec::len), Some(0), "{firing}");
}
