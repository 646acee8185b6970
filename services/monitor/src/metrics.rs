//! The view as Prometheus text. Every name is in [`Metric`]; dashboards and alert rules use no other.
//!
//! Seconds and bytes are base units, counters end in `_total`, and no photo's or folder's name is a label. A batch adds
//! up its scenes; their names become labels only on request. The workers of a farm are labels.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use crate::view::{FarmView, MonitorView, RunState, RunView, SceneState};

/// What kind of number it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MetricKind {
    /// Only grows, but for restarts of the process.
    Counter,
    /// Goes up and down.
    Gauge,
    /// Counts by size.
    Histogram,
}

/// How the numbers of several scenes become one.
#[derive(Clone, Copy)]
enum Fold {
    Sum,
    Max,
    Min,
    Mean,
}

macro_rules! metrics {
    ($($variant:ident = $name:literal, $kind:ident, $fold:ident, $help:literal;)+) => {
        /// Every metric there is.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Metric { $(#[doc = $help] $variant,)+ }

        impl Metric {
            /// Every metric, in the order in which they are shown.
            pub const ALL: &'static [Metric] = &[$(Metric::$variant,)+];

            /// Its name.
            pub fn name(self) -> &'static str {
                match self { $(Metric::$variant => $name,)+ }
            }

            /// What it says, in one sentence.
            pub fn help(self) -> &'static str {
                match self { $(Metric::$variant => $help,)+ }
            }

            /// What kind of number it is.
            pub fn kind(self) -> MetricKind {
                match self { $(Metric::$variant => MetricKind::$kind,)+ }
            }

            fn fold(self) -> Fold {
                match self { $(Metric::$variant => Fold::$fold,)+ }
            }
        }
    };
}

metrics! {
    BuildInfo = "segwild_build_info", Gauge, Max, "The program's version; always 1.";
    Scenes = "segwild_scenes", Gauge, Sum, "Scenes by state: waiting, running, done, dead.";
    DeadLetters = "segwild_dead_letters", Gauge, Sum, "Scenes that were given up.";
    SceneRetries = "segwild_scene_retries_total", Counter, Sum, "Attempts at a scene that failed and were followed by another.";
    LeaseExpired = "segwild_lease_expired_total", Counter, Sum, "Leases of scenes that ran out without a heartbeat.";
    FarmQueueDepth = "segwild_farm_queue_depth", Gauge, Sum, "Scenes of a farm that could start, by the accelerator that they want.";
    FarmOldestWaiting = "segwild_farm_oldest_waiting_seconds", Gauge, Max, "For how long the scene of a farm that has waited longest could have started.";
    FarmWorkerScenes = "segwild_farm_worker_scenes", Gauge, Sum, "Scenes that a worker of a farm holds.";
    FarmWorkerAttempts = "segwild_farm_worker_attempts_total", Counter, Sum, "Scenes that a worker of a farm had, by how that ended: done, failed, returned, silent.";
    FarmWorkerPaused = "segwild_farm_worker_paused", Gauge, Max, "Whether a worker of a farm takes no scenes for now, as on a full disk.";
    FarmHeartbeatAge = "segwild_farm_heartbeat_age_seconds", Gauge, Max, "Time since the last sign of life of a worker that holds scenes.";
    FarmLogRecords = "segwild_farm_log_records", Gauge, Max, "Records in a farm's log, since it was compacted.";
    FarmLogReadRecords = "segwild_farm_log_read_records_total", Counter, Sum, "Records of a farm's log that this process has folded into its table.";
    FarmLogReadTime = "segwild_farm_log_read_seconds_total", Counter, Sum, "Time that reading and folding these records took.";
    EngineConnected = "segwild_engine_connected", Gauge, Min, "Whether the batch's engine can be read.";
    BudgetCores = "segwild_budget_cores", Gauge, Sum, "Cores of the batch's budget: declared in all, used now.";
    BudgetMemory = "segwild_budget_memory_bytes", Gauge, Sum, "Memory of the batch's budget: declared in all, used now.";
    BudgetAccelerators = "segwild_budget_accelerators", Gauge, Sum, "Accelerators of the batch's budget: declared in all, used now.";
    StageViews = "segwild_stage_views_total", Counter, Sum, "Photos that a stage has dealt with, by outcome: made, cached, failed.";
    StageTaskDuration = "segwild_stage_task_duration_seconds", Histogram, Sum, "Time that a stage took for one photo.";
    StageQueueDepth = "segwild_stage_queue_depth", Gauge, Sum, "Units of work that a running stage still has to do: photos, or steps of geometry.";
    StageProgress = "segwild_stage_progress_ratio", Gauge, Mean, "The share of a stage's work that is done.";
    StageEta = "segwild_stage_eta_seconds", Gauge, Max, "Time that a running stage will still take, as far as is known.";
    StageInflight = "segwild_stage_inflight", Gauge, Sum, "Workers of an actor that are busy.";
    StageUtilization = "segwild_stage_utilization_ratio", Gauge, Mean, "The share of an actor's life spent working.";
    StageOldestTask = "segwild_stage_oldest_task_age_seconds", Gauge, Max, "For how long an actor's busiest worker has been at what it does.";
    ActorSeconds = "segwild_actor_seconds_total", Counter, Sum, "An actor's time, all its workers' together, by what it went to: starting, busy, waiting, blocked, back_off.";
    ActorStuck = "segwild_actor_stuck", Gauge, Sum, "Workers of an actor that the supervisor considers stuck.";
    ActorRestarts = "segwild_actor_restarts_total", Counter, Sum, "How often an actor was restarted.";
    TaskRetries = "segwild_task_retries_total", Counter, Sum, "Further attempts of an actor at a message.";
    Quarantined = "segwild_quarantined_total", Counter, Sum, "Messages that an actor gave up.";
    MailboxDepth = "segwild_mailbox_depth", Gauge, Sum, "Messages queued for an actor.";
    MailboxCapacity = "segwild_mailbox_capacity", Gauge, Sum, "Messages that an actor's mailbox may hold.";
    MailboxBytes = "segwild_mailbox_bytes", Gauge, Sum, "Bytes queued for an actor.";
    MailboxCapacityBytes = "segwild_mailbox_capacity_bytes", Gauge, Sum, "Bytes that an actor's mailbox may hold.";
    BackPressure = "segwild_backpressure_seconds_total", Counter, Sum, "Time that senders have waited for room in an actor's mailbox.";
    CacheRequests = "segwild_cache_requests_total", Counter, Sum, "Reads of the content cache, by result: hit, miss, corrupt.";
    CacheRead = "segwild_cache_read_bytes_total", Counter, Sum, "Bytes read from the content cache.";
    CacheWritten = "segwild_cache_written_bytes_total", Counter, Sum, "Bytes written to the content cache.";
    TrainIterations = "segwild_train_iterations_total", Counter, Sum, "Training steps done.";
    TrainGaussians = "segwild_train_gaussians", Gauge, Sum, "Splats of the scene in training.";
    TrainLoss = "segwild_train_loss", Gauge, Mean, "Training loss, lately.";
    TrainPsnr = "segwild_train_psnr_db", Gauge, Mean, "PSNR on the training photos, lately, in dB.";
    TrainStall = "segwild_train_stall_seconds_total", Counter, Sum, "Time that the training has stood still, by what for: sky.";
    CheckpointDuration = "segwild_checkpoint_duration_seconds", Gauge, Max, "Time that writing the last checkpoint took.";
    InteractiveLatency = "segwild_interactive_latency_seconds", Histogram, Sum, "Time from a person's prompts to the selected splats.";
    CheckpointTime = "segwild_checkpoint_last_success_timestamp_seconds", Gauge, Max, "When the last checkpoint was taken.";
    LastProgress = "segwild_last_progress_timestamp_seconds", Gauge, Min, "When anything last moved; of several running scenes, the one that has stood still longest.";
    SampleTime = "segwild_sample_timestamp_seconds", Gauge, Min, "When the run was last sampled.";
    Memory = "segwild_memory_resident_bytes", Gauge, Sum, "Memory of the processes that run scenes.";
    MemoryPeak = "segwild_memory_peak_bytes", Gauge, Max, "The most memory that the process of one scene ever had.";
    Cpu = "segwild_cpu_seconds_total", Counter, Sum, "Processor time of the processes that ran scenes.";
    DiskFree = "segwild_disk_free_bytes", Gauge, Min, "Bytes that may still be written on the disk of the runs.";
    DiskSize = "segwild_disk_size_bytes", Gauge, Min, "Size of the disk of the runs.";
}

/// Upper bounds of the histogram's buckets, in seconds.
const BUCKETS: [f64; 10] = [0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0];

/// Labels, ready to be written: `stage="masks",outcome="made"`.
type Labels = String;

#[derive(Default)]
struct MetricValues {
    /// Sum, smallest, largest, count.
    numbers: BTreeMap<(Metric, Labels), (f64, f64, f64, u32)>,
    histograms: BTreeMap<(Metric, Labels), (Vec<u64>, f64)>,
}

fn labels(pairs: &[(&str, &str)]) -> Labels {
    let mut text = String::new();
    for (name, value) in pairs {
        let value = value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
        let _ = write!(text, "{}{name}=\"{value}\"", if text.is_empty() { "" } else { "," });
    }
    text
}

impl MetricValues {
    fn put(&mut self, metric: Metric, pairs: &[(&str, &str)], value: f64) {
        if !value.is_finite() {
            return;
        }
        let seen = (0.0, f64::INFINITY, f64::NEG_INFINITY, 0);
        let (sum, min, max, count) = self.numbers.entry((metric, labels(pairs))).or_insert(seen);
        (*sum, *min, *max, *count) = (*sum + value, min.min(value), max.max(value), *count + 1);
    }

    fn observe(&mut self, metric: Metric, pairs: &[(&str, &str)], value: f64) {
        let fresh = || (vec![0; BUCKETS.len() + 1], 0.0);
        let (counts, sum) = self.histograms.entry((metric, labels(pairs))).or_insert_with(fresh);
        let bucket = BUCKETS.iter().position(|&limit| value <= limit).unwrap_or(BUCKETS.len());
        counts[bucket] += 1;
        *sum += value;
    }

    fn text(&self) -> String {
        let mut text = String::new();
        for &metric in Metric::ALL {
            let kind = match metric.kind() {
                MetricKind::Counter => "counter",
                MetricKind::Gauge => "gauge",
                MetricKind::Histogram => "histogram",
            };
            let name = metric.name();
            let mut body = String::new();
            for ((_, labels), &(sum, min, max, count)) in
                self.numbers.iter().filter(|((m, _), _)| *m == metric)
            {
                let value = match metric.fold() {
                    Fold::Sum => sum,
                    Fold::Max => max,
                    Fold::Min => min,
                    Fold::Mean => sum / f64::from(count),
                };
                let _ = match labels.is_empty() {
                    true => writeln!(body, "{name} {value}"),
                    false => writeln!(body, "{name}{{{labels}}} {value}"),
                };
            }
            for ((_, labels), (counts, sum)) in self.histograms.iter().filter(|((m, _), _)| *m == metric) {
                let mut total = 0;
                let comma = if labels.is_empty() { "" } else { "," };
                for (i, count) in counts.iter().enumerate() {
                    total += count;
                    let limit = BUCKETS.get(i).map_or("+Inf".to_owned(), f64::to_string);
                    let _ = writeln!(body, "{name}_bucket{{{labels}{comma}le=\"{limit}\"}} {total}");
                }
                let of = if labels.is_empty() { String::new() } else { format!("{{{labels}}}") };
                let _ = writeln!(body, "{name}_sum{of} {sum}\n{name}_count{of} {total}");
            }
            if !body.is_empty() {
                let _ = write!(text, "# HELP {name} {}\n# TYPE {name} {kind}\n{body}", metric.help());
            }
        }
        text
    }
}

/// The text of a view; without one, the program's version is all there is.
pub fn render(view: Option<&MonitorView>, per_scene: bool) -> String {
    let mut values = MetricValues::default();
    values.put(Metric::BuildInfo, &[("version", env!("CARGO_PKG_VERSION"))], 1.0);
    match view {
        None => {}
        Some(MonitorView::Run(run)) => {
            let state = match run.state {
                RunState::Running => SceneState::Running,
                RunState::Done => SceneState::Done,
                RunState::Failed => SceneState::Dead,
                RunState::Stopped => SceneState::Waiting,
            };
            for each in SceneState::ALL {
                values.put(Metric::Scenes, &[("state", each.word())], f64::from(u8::from(each == state)));
            }
            values.put(Metric::DeadLetters, &[], f64::from(u8::from(state == SceneState::Dead)));
            one_run(&mut values, run, None);
            disk(&mut values, run.disk);
        }
        Some(MonitorView::Batch(batch)) => {
            for each in SceneState::ALL {
                values.put(Metric::Scenes, &[("state", each.word())], batch.count(each) as f64);
            }
            values.put(Metric::DeadLetters, &[], batch.count(SceneState::Dead) as f64);
            values.put(Metric::SceneRetries, &[], batch.retries as f64);
            values.put(Metric::LeaseExpired, &[], batch.leases_expired as f64);
            values.put(Metric::EngineConnected, &[], 1.0);
            for (word, part) in [("declared", &batch.budget), ("used", &batch.used)] {
                values.put(Metric::BudgetCores, &[("part", word)], f64::from(part.cores));
                values.put(Metric::BudgetMemory, &[("part", word)], part.memory_bytes as f64);
                values.put(Metric::BudgetAccelerators, &[("part", word)], f64::from(part.accelerators));
            }
            for scene in &batch.scenes {
                if let Some(run) = &scene.run {
                    one_run(&mut values, run, per_scene.then_some(&scene.name));
                }
            }
            disk(&mut values, batch.disk);
            if let Some(farm) = &batch.farm {
                of_farm(&mut values, farm);
            }
        }
    }
    values.text()
}

/// What only a farm has. Workers are labels: a machine has one name, however often it is started in its folder.
fn of_farm(values: &mut MetricValues, farm: &FarmView) {
    for (accelerator, scenes) in &farm.queue {
        values.put(Metric::FarmQueueDepth, &[("accelerator", accelerator)], *scenes as f64);
    }
    values.put(Metric::FarmOldestWaiting, &[], farm.oldest_waiting_s);
    for worker in &farm.workers {
        let own = ("worker", worker.name.as_str());
        values.put(Metric::FarmWorkerScenes, &[own], worker.held as f64);
        for (outcome, count) in [
            ("done", worker.done),
            ("failed", worker.failed),
            ("returned", worker.returned),
            ("silent", worker.silent),
        ] {
            values.put(Metric::FarmWorkerAttempts, &[own, ("outcome", outcome)], count as f64);
        }
        values.put(Metric::FarmWorkerPaused, &[own], f64::from(u8::from(worker.paused.is_some())));
        if worker.held > 0 {
            values.put(Metric::FarmHeartbeatAge, &[own], worker.seen_s);
        }
    }
    if let Some(log) = &farm.log {
        values.put(Metric::FarmLogRecords, &[], log.records as f64);
        values.put(Metric::FarmLogReadRecords, &[], log.read_records as f64);
        values.put(Metric::FarmLogReadTime, &[], log.read_s);
    }
}

fn disk(values: &mut MetricValues, disk: Option<crate::view::Disk>) {
    if let Some(disk) = disk {
        values.put(Metric::DiskFree, &[], disk.free_bytes as f64);
        values.put(Metric::DiskSize, &[], disk.size_bytes as f64);
    }
}

/// A run's numbers. Gauges are of runs that are being worked on; counters stay.
fn one_run(values: &mut MetricValues, run: &RunView, scene: Option<&String>) {
    let own: Vec<(&str, &str)> = scene.map(|s| ("scene", s.as_str())).into_iter().collect();
    let with = |pairs: &[(&'static str, &str)]| -> Vec<(String, String)> {
        let all = own.iter().chain(pairs);
        all.map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
    };
    let mut put = |metric: Metric, pairs: &[(&'static str, &str)], value: f64| {
        let all = with(pairs);
        let all: Vec<(&str, &str)> = all.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
        values.put(metric, &all, value);
    };
    for stage in &run.stages {
        let name = stage.name.as_str();
        if stage.made + stage.cached + stage.failed > 0 || ["sky", "embed", "masks"].contains(&name) {
            for (outcome, n) in [("made", stage.made), ("cached", stage.cached), ("failed", stage.failed)] {
                put(Metric::StageViews, &[("stage", name), ("outcome", outcome)], n as f64);
            }
        }
        put(Metric::StageProgress, &[("stage", name)], stage.share());
        let going = stage.state == "running";
        let open = stage.total.filter(|_| going).map_or(0, |total| total.saturating_sub(stage.done));
        put(Metric::StageQueueDepth, &[("stage", name)], open as f64);
        if let Some(eta) = stage.eta_s.filter(|_| going) {
            put(Metric::StageEta, &[("stage", name)], eta);
        }
    }
    for actor in &run.actors {
        let name = [("actor", actor.name.as_str())];
        for (state, seconds) in &actor.seconds {
            put(Metric::ActorSeconds, &[name[0], ("state", state)], *seconds);
        }
        put(Metric::ActorRestarts, &name, actor.restarts as f64);
        put(Metric::TaskRetries, &name, actor.retries as f64);
        put(Metric::Quarantined, &name, actor.quarantined as f64);
        put(Metric::StageUtilization, &name, actor.utilization);
        let busy =
            || actor.workers.iter().filter(|w| run.running && w.state == segwild_flow::WorkerState::Busy);
        put(Metric::StageInflight, &name, busy().count() as f64);
        put(Metric::StageOldestTask, &name, busy().map(|w| w.for_s).fold(0.0, f64::max));
        let stuck = actor.workers.iter().filter(|w| run.running && w.stuck).count();
        put(Metric::ActorStuck, &name, stuck as f64);
    }
    for mailbox in &run.mailboxes {
        let name = [("actor", mailbox.name.as_str())];
        let now = |n: u64| if run.running { n as f64 } else { 0.0 };
        put(Metric::MailboxDepth, &name, now(mailbox.depth));
        put(Metric::MailboxCapacity, &name, mailbox.capacity as f64);
        put(Metric::MailboxBytes, &name, now(mailbox.bytes));
        put(Metric::MailboxCapacityBytes, &name, mailbox.capacity_bytes as f64);
        put(Metric::BackPressure, &name, mailbox.back_pressure_s);
    }
    let c = &run.cache;
    for (result, n) in [("hit", c.hits), ("miss", c.misses.saturating_sub(c.corrupt)), ("corrupt", c.corrupt)]
    {
        put(Metric::CacheRequests, &[("result", result)], n as f64);
    }
    put(Metric::CacheRead, &[], c.bytes_read as f64);
    put(Metric::CacheWritten, &[], c.bytes_written as f64);
    put(Metric::TrainIterations, &[], run.step.unwrap_or(0) as f64);
    for (metric, name) in [
        (Metric::TrainGaussians, "geometry.splats"),
        (Metric::TrainLoss, "geometry.loss"),
        (Metric::TrainPsnr, "geometry.psnr_db"),
        (Metric::TrainStall, "geometry.stall_s"),
        (Metric::CheckpointDuration, "geometry.checkpoint_s"),
    ] {
        if let Some(value) = run.numbers.get(name) {
            let cause: &[_] = if metric == Metric::TrainStall { &[("cause", "sky")] } else { &[] };
            put(metric, cause, *value);
        }
    }
    let maybe = [
        (Metric::CheckpointTime, run.checkpoint),
        (Metric::LastProgress, run.still_s.map(|s| run.time - s)),
        (Metric::SampleTime, run.age_s.filter(|_| run.running).map(|s| run.time - s)),
        (Metric::Memory, run.rss_bytes.map(|n| n as f64)),
        (Metric::MemoryPeak, run.peak_rss_bytes.map(|n| n as f64)),
        (Metric::Cpu, run.cpu_s),
    ];
    for (metric, value) in maybe {
        if let Some(value) = value {
            put(metric, &[], value);
        }
    }
    let mut observe = |metric: Metric, pairs: &[(&'static str, &str)], seconds: f64| {
        let all = with(pairs);
        let all: Vec<(&str, &str)> = all.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
        values.observe(metric, &all, seconds);
    };
    for (stage, seconds) in &run.seconds {
        observe(Metric::StageTaskDuration, &[("stage", stage)], *seconds);
    }
    for seconds in run.selections.iter().filter_map(|s| s.answered_s) {
        observe(Metric::InteractiveLatency, &[], seconds);
    }
}
