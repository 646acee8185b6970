//! The view of operators as messages of gRPC. Every field is named, so that none is forgotten.

use segwild_farm::{FarmLogState, Needs};
use segwild_flow::ledger::PastSample;
use segwild_flow::{CacheCounters, WorkerState};
use segwild_monitor::MonitorView;
use segwild_monitor::view::{
    ActorView, BatchView, Disk, FarmSample, FarmView, FarmWorkerView, LoggedEvent, MailboxView, PhotoFailure,
    RunView, SceneView, SelectionView, StageView, WorkerView,
};
use segwild_proto::v1::{self, monitor_view};

/// A run or a batch.
pub(super) fn view(view: MonitorView) -> v1::MonitorView {
    use monitor_view::Kind;
    let kind = match view {
        MonitorView::Run(view) => Kind::Run(run(*view)),
        MonitorView::Batch(view) => Kind::Batch(batch(*view)),
    };
    v1::MonitorView { kind: Some(kind) }
}

fn run(run: RunView) -> v1::RunView {
    let RunView {
        name,
        folder,
        time,
        state,
        running,
        owner,
        age_s,
        still_s,
        began,
        left_s,
        pid,
        rss_bytes,
        peak_rss_bytes,
        threads,
        cores,
        cpu_s,
        stages,
        actors,
        mailboxes,
        cache: counters,
        numbers,
        step,
        checkpoint,
        disk: space,
        failures,
        selections,
        events,
        past,
        seconds: _,
    } = run;
    v1::RunView {
        name,
        folder: folder.display().to_string(),
        time,
        state: state.word().into(),
        running,
        owner,
        age_s,
        still_s,
        began,
        left_s,
        pid,
        rss_bytes,
        peak_rss_bytes,
        threads,
        cores,
        cpu_s,
        stages: stages.into_iter().map(stage).collect(),
        actors: actors.into_iter().map(actor).collect(),
        mailboxes: mailboxes.into_iter().map(mailbox).collect(),
        cache: Some(cache(counters)),
        numbers: numbers.into_iter().collect(),
        step,
        checkpoint,
        disk: space.map(disk),
        failures: failures.into_iter().map(failure).collect(),
        selections: selections.into_iter().map(selection).collect(),
        events: events.into_iter().map(event).collect(),
        past: past.into_iter().map(sample).collect(),
    }
}

fn stage(stage: StageView) -> v1::StageView {
    let StageView {
        name,
        state,
        part,
        done,
        total,
        rate,
        eta_s,
        made,
        cached,
        failed,
        started,
        wall_s,
        cpu_s,
        runs,
        error,
        why,
    } = stage;
    v1::StageView {
        name,
        state,
        done,
        total,
        rate,
        eta_s,
        made,
        cached,
        failed,
        started,
        wall_s,
        cpu_s,
        runs,
        error,
        why,
        part,
    }
}

fn worker(worker: WorkerView) -> v1::WorkerView {
    let WorkerView { state, item, for_s, stuck, why } = worker;
    let state = match state {
        WorkerState::Starting => "starting",
        WorkerState::Waiting => "waiting",
        WorkerState::Busy => "busy",
        WorkerState::Blocked => "blocked",
        WorkerState::BackOff => "back_off",
        WorkerState::Ended => "ended",
    };
    v1::WorkerView { state: state.into(), item, for_s, stuck, why }
}

fn actor(actor: ActorView) -> v1::ActorView {
    let ActorView {
        name,
        exit,
        error,
        workers,
        messages,
        retries,
        restarts,
        quarantined,
        last_error,
        seconds,
        cpu_s,
        utilization,
    } = actor;
    v1::ActorView {
        name,
        exit,
        error,
        workers: workers.into_iter().map(worker).collect(),
        messages,
        retries,
        restarts,
        quarantined,
        last_error,
        seconds: seconds.into_iter().collect(),
        cpu_s,
        utilization,
    }
}

fn mailbox(mailbox: MailboxView) -> v1::MailboxView {
    let MailboxView {
        name,
        depth,
        bytes,
        capacity,
        capacity_bytes,
        high_water,
        high_water_bytes,
        sent,
        received,
        held_back,
        waiting_senders,
        back_pressure_s,
        closed,
    } = mailbox;
    v1::MailboxView {
        name,
        depth,
        bytes,
        capacity,
        capacity_bytes,
        high_water,
        high_water_bytes,
        sent,
        received,
        held_back,
        waiting_senders,
        back_pressure_s,
        closed,
    }
}

fn cache(counters: CacheCounters) -> v1::CacheCounters {
    let CacheCounters { hits, misses, corrupt, bytes_read, bytes_written } = counters;
    v1::CacheCounters { hits, misses, corrupt, bytes_read, bytes_written }
}

fn disk(disk: Disk) -> v1::Disk {
    let Disk { free_bytes, size_bytes } = disk;
    v1::Disk { free_bytes, size_bytes }
}

fn failure(failure: PhotoFailure) -> v1::PhotoFailure {
    let PhotoFailure { stage, photo, error } = failure;
    v1::PhotoFailure { stage, photo, error }
}

fn selection(selection: SelectionView) -> v1::SelectionView {
    let SelectionView { name, answered_s } = selection;
    v1::SelectionView { name, answered_s }
}

fn event(event: LoggedEvent) -> v1::LoggedEvent {
    let LoggedEvent { time, level, stage, message } = event;
    v1::LoggedEvent { time, level, stage, message }
}

fn sample(sample: PastSample) -> v1::PastSample {
    let PastSample { time, rss_bytes, cpu_s, done, rate, depth, back_pressure_s } = sample;
    v1::PastSample { time, rss_bytes, cpu_s, done, rate, depth, back_pressure_s }
}

fn needs(needs: Needs) -> v1::Needs {
    let Needs { cores, memory_bytes, accelerators } = needs;
    v1::Needs { cores, memory_bytes, accelerators }
}

fn scene(scene: SceneView) -> v1::SceneView {
    let SceneView {
        name,
        state,
        priority,
        needs: wanted,
        attempt,
        failures,
        attempts,
        error,
        rests_s,
        started,
        wall_s,
        worker,
        why,
        until,
        out,
        run: of_scene,
    } = scene;
    v1::SceneView {
        name,
        state: state.word().into(),
        priority,
        needs: Some(needs(wanted)),
        attempt,
        failures,
        attempts,
        error,
        rests_s,
        started,
        wall_s,
        worker,
        why,
        until,
        out: out.display().to_string(),
        run: of_scene.map(|view| run(*view)),
    }
}

fn farm_worker(worker: FarmWorkerView) -> v1::FarmWorkerView {
    let FarmWorkerView {
        name,
        held,
        done,
        failed,
        returned,
        silent,
        paused,
        seen_s,
        whole,
        used,
        accelerator,
        done_per_hour,
    } = worker;
    v1::FarmWorkerView {
        name,
        held,
        done,
        failed,
        returned,
        silent,
        paused,
        seen_s,
        whole: whole.map(needs),
        used: Some(needs(used)),
        accelerator,
        done_per_hour,
    }
}

fn farm_sample(sample: FarmSample) -> v1::FarmSample {
    let FarmSample { time, seconds, done, retried, dead } = sample;
    v1::FarmSample { time, seconds, done, retried, dead }
}

fn farm_log(log: FarmLogState) -> v1::FarmLogState {
    let FarmLogState { records, read_records, read_s, void_records } = log;
    v1::FarmLogState { records, read_records, read_s, void_records }
}

fn farm(farm: FarmView) -> v1::FarmView {
    let FarmView { queue, oldest_waiting_s, workers, log, done_per_hour, left_s, past } = farm;
    v1::FarmView {
        queue: queue.into_iter().collect(),
        oldest_waiting_s,
        workers: workers.into_iter().map(farm_worker).collect(),
        log: log.map(farm_log),
        done_per_hour,
        left_s,
        past: past.into_iter().map(farm_sample).collect(),
    }
}

/// A batch or a farm.
pub(super) fn batch(batch: BatchView) -> v1::BatchView {
    let BatchView {
        name,
        folder,
        time,
        owner,
        began,
        budget,
        used,
        scenes,
        leases_expired,
        retries,
        disk: space,
        farm: of_farm,
    } = batch;
    v1::BatchView {
        name,
        folder: folder.display().to_string(),
        time,
        owner,
        began,
        budget: Some(needs(budget)),
        used: Some(needs(used)),
        scenes: scenes.into_iter().map(scene).collect(),
        leases_expired,
        retries,
        disk: space.map(disk),
        farm: of_farm.map(farm),
    }
}
