//! What stands where: a head, the scenes of a batch, a run's stages and actors, why things wait, the last warnings.

use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use segwild_flow::WorkerState;

use crate::view::{
    ActorView, BatchView, Disk, FarmWorkerView, MonitorView, RunView, SceneState, SceneView, StageView,
};
use crate::words::{bytes, count, cut, duration};

/// What the page shows of a batch: the scene whose stages are listed.
#[derive(Clone, Copy, Debug, Default)]
pub struct ScreenPosition {
    /// Index of the chosen scene; `None`: the first that runs.
    pub scene: Option<usize>,
}

fn plain(text: impl Into<String>) -> Line<'static> {
    Line::from(text.into())
}

fn head(text: impl Into<String>) -> Line<'static> {
    Line::styled(text.into(), Style::new().add_modifier(Modifier::BOLD))
}

fn columns(text: impl Into<String>) -> Line<'static> {
    Line::styled(text.into(), Style::new().add_modifier(Modifier::DIM))
}

fn coloured(text: impl Into<String>, colour: Color) -> Line<'static> {
    Line::styled(text.into(), Style::new().fg(colour))
}

/// Colours are a help, never the only sign: every state is also a word.
fn state_colour(state: &str) -> Color {
    match state {
        "running" | "busy" | "starting" => Color::Green,
        "failed" | "dead" | "stuck" | "late" => Color::Red,
        "blocked" | "back_off" | "pending" | "stopped" => Color::Yellow,
        _ => Color::Reset,
    }
}

/// A row: its text with the word of its state coloured.
fn row(before: String, state: &str, width: usize, after: String) -> Line<'static> {
    let style = Style::new().fg(state_colour(state));
    Line::from(vec![
        Span::raw(before),
        Span::styled(format!("{:width$}", cut(state, width)), style),
        Span::raw(after),
    ])
}

fn bar(share: f64, width: usize) -> String {
    let full = (share * width as f64).floor().clamp(0.0, width as f64) as usize;
    format!("{}{}", "#".repeat(full), ".".repeat(width - full))
}

/// Seconds in at most six characters: `5.9s`, `2m45s`, `3h04m`.
fn short(seconds: f64) -> String {
    let whole = seconds.max(0.0).round() as u64;
    match whole {
        0..60 => format!("{:.1}s", seconds.max(0.0)),
        60..3600 => format!("{}m{:02}s", whole / 60, whole % 60),
        3600..360_000 => format!("{}h{:02}m", whole / 3600, whole % 3600 / 60),
        _ => format!("{}d", whole / 86_400),
    }
}

fn maybe<T>(value: Option<T>, show: impl FnOnce(T) -> String) -> String {
    value.map_or_else(|| "-".to_owned(), show)
}

/// The page, at most `height` lines; what does not fit is left out from the end, the head never.
pub fn lines(view: &MonitorView, position: ScreenPosition, width: u16, height: u16) -> Vec<Line<'static>> {
    let (width, height) = (usize::from(width), usize::from(height));
    let mut page = match view {
        MonitorView::Run(run) => {
            let mut page = vec![run_head(run)];
            page.extend(run_body(run, run_totals(run) + &disk(run.disk), width, height.saturating_sub(1)));
            page
        }
        MonitorView::Batch(batch) => batch_page(batch, position, width, height),
    };
    page.truncate(height);
    page
}

fn run_head(run: &RunView) -> Line<'static> {
    let mut text = format!("{}: {}", run.name, run.state.word());
    if let Some(owner) = &run.owner {
        text += &format!(" ({owner})");
    }
    if run.running {
        if let Some(began) = run.began {
            text += &format!(", for {}", duration((run.time - began).max(0.0)));
        }
        if let Some(left) = run.left_s {
            text += &format!(", at least {} left", duration(left));
        }
        if run.is_stale() {
            text += ", NOT SEEN";
            text += &maybe(run.age_s, |s| format!(" for {}", duration(s)));
        }
    }
    head(text)
}

/// Memory, cache, training: one line.
fn run_totals(run: &RunView) -> String {
    let (photos, steps) = run.rates();
    let mut parts = vec![format!("{photos:.1} photos/s"), format!("{steps:.1} steps/s")];
    match (run.rss_bytes, run.peak_rss_bytes) {
        (Some(now), Some(peak)) => parts.push(format!("{}, peak {}", bytes(now), bytes(peak))),
        (None, Some(peak)) => parts.push(format!("peak memory {}", bytes(peak))),
        _ => {}
    }
    let c = &run.cache;
    parts.push(format!("cache {} hit {} miss", c.hits, c.misses));
    if c.corrupt > 0 {
        parts.push(format!("{} CORRUPT", c.corrupt));
    }
    if let Some(psnr) = run.numbers.get("geometry.psnr_db") {
        parts.push(format!("{psnr:.1} dB"));
    }
    parts.join("  ")
}

fn disk(disk: Option<Disk>) -> String {
    disk.map_or(String::new(), |disk| format!("  disk {} free", bytes(disk.free_bytes)))
}

fn stage_row(stage: &StageView) -> Line<'static> {
    let of = match stage.total {
        Some(total) => format!("{}/{total}", stage.done),
        None => String::new(),
    };
    let rate = if stage.rate > 0.0 { format!("{:.1}/s", stage.rate) } else { "-".into() };
    let left = maybe(stage.eta_s.filter(|_| stage.state == "running"), short);
    let time = maybe(stage.wall_s, short);
    let after = format!(
        " {} {of:>11} {rate:>8} {left:>6} {time:>6} {:>6} {:>6}",
        bar(stage.share(), 10),
        stage.cached,
        stage.failed
    );
    row(format!("{:9} ", cut(&stage.name, 9)), &stage.state, 8, after)
}

/// The state of an actor in one word: the most telling of its workers', or how it ended.
fn actor_state(actor: &ActorView) -> (String, Option<&crate::view::WorkerView>) {
    if actor.exit != "running" {
        return (actor.exit.clone(), None);
    }
    let rank = |w: &&crate::view::WorkerView| match w.state {
        _ if w.stuck => 0,
        WorkerState::Busy => 1,
        WorkerState::Blocked => 2,
        WorkerState::BackOff => 3,
        WorkerState::Starting => 4,
        WorkerState::Waiting => 5,
        WorkerState::Ended => 6,
    };
    let Some(worker) = actor.workers.iter().min_by_key(rank) else { return ("-".into(), None) };
    let word = match worker.state {
        _ if worker.stuck => "stuck",
        WorkerState::Busy => "busy",
        WorkerState::Blocked => "blocked",
        WorkerState::BackOff => "back_off",
        WorkerState::Starting => "starting",
        WorkerState::Waiting => "waiting",
        WorkerState::Ended => "ended",
    };
    (word.into(), Some(worker))
}

fn actor_row(actor: &ActorView, run: &RunView, width: usize) -> Line<'static> {
    let (state, worker) = actor_state(actor);
    let mailbox = run.mailboxes.iter().find(|m| m.name == actor.name);
    let queue = maybe(mailbox, |m| format!("{}/{}", m.depth, m.capacity));
    let queued = maybe(mailbox, |m| bytes(m.bytes));
    let pressure = maybe(mailbox, |m| format!("{:.1}", m.back_pressure_s));
    let since = maybe(worker, |w| short(w.for_s));
    let item = worker.filter(|w| w.state == WorkerState::Busy).map_or("", |w| w.item.as_str());
    let after = format!(
        " {since:>6} {queue:>6} {queued:>8} {pressure:>6} {:>5} {:>4} {:>4} {}",
        actor.messages,
        actor.retries,
        actor.quarantined,
        cut(item, width.saturating_sub(66))
    );
    row(format!("{:9} ", cut(&actor.name, 9)), &state, 8, after)
}

/// Why things wait: a line per stage and per actor that does.
fn reasons(run: &RunView, width: usize) -> Vec<Line<'static>> {
    let stages = run.stages.iter().filter_map(|s| Some((s.name.clone(), s.why.clone()?, false)));
    let actors = run.actors.iter().flat_map(|a| {
        a.workers.iter().filter_map(|w| Some((a.name.clone(), w.why.clone()?, w.stuck))).take(1)
    });
    let line = |(name, why, stuck): (String, String, bool)| {
        let text = cut(&format!("{:9} {why}", cut(&name, 9)), width);
        if stuck { coloured(text, Color::Red) } else { plain(text) }
    };
    // Actors first: they are what a person can act on.
    actors.chain(stages).map(line).collect()
}

fn run_body(run: &RunView, totals: String, width: usize, height: usize) -> Vec<Line<'static>> {
    let mut page = vec![plain(cut(&totals, width))];
    page.push(columns(format!(
        "{:9} {:8} {:10} {:>11} {:>8} {:>6} {:>6} {:>6} {:>6}",
        "stage", "state", "", "done", "rate", "left", "time", "cached", "failed"
    )));
    // Where the lines do not suffice, what is over is left out first, and what has not started is only counted as waiting.
    let waiting = run.stages.iter().filter(|s| s.why.is_some()).count();
    let needed = run.stages.len() + waiting + 2 * run.actors.len() + 5;
    let all = height >= needed;
    let stages = run.stages.iter().filter(|s| all || s.state != "done" && s.why.is_none() || !run.running);
    page.extend(stages.map(stage_row));
    let actors: Vec<&ActorView> = run
        .actors
        .iter()
        .filter(|a| a.exit == "running" || all && run.running || a.error.is_some())
        .collect();
    if !actors.is_empty() {
        page.push(columns(format!(
            "{:9} {:8} {:>6} {:>6} {:>8} {:>6} {:>5} {:>4} {:>4} {}",
            "actor", "state", "since", "queue", "bytes", "held s", "done", "retr", "quar", "on"
        )));
        page.extend(actors.into_iter().map(|a| actor_row(a, run, width)));
    }
    let why = if run.running { reasons(run, width) } else { Vec::new() };
    let errors = run.stages.iter().filter_map(|s| Some((s.name.clone(), s.error.clone()?)));
    let mut last: Vec<Line<'static>> = errors
        .map(|(stage, error)| coloured(cut(&format!("{stage} failed: {error}"), width), Color::Red))
        .collect();
    if let Some(event) = run.events.last() {
        let about = event.stage.as_deref().unwrap_or("run");
        last.push(coloured(
            cut(&format!("{}: {about}: {}", event.level, event.message), width),
            Color::Yellow,
        ));
    }
    if !why.is_empty() {
        page.push(columns("why it waits"));
        let lines_left = height.saturating_sub(page.len() + last.len());
        page.extend(why.into_iter().take(lines_left));
    }
    page.extend(last);
    page
}

/// Columns of a scene's row without its bar and its stages.
const WITHOUT_BAR: usize = 66;

/// A bar where there is space for one: how far it is stands beside it as a number, which stages run stands nowhere else.
fn scene_bar(share: f64, width: usize) -> String {
    if width < WITHOUT_BAR + 30 { String::new() } else { format!(" {}", bar(share, 6)) }
}

fn scene_row(scene: &SceneView, chosen: bool, width: usize) -> Line<'static> {
    let run = scene.run.as_deref();
    let going = scene.state == SceneState::Running;
    let stages = run.map_or(&[][..], |r| &r.stages);
    let stage: Vec<&str> =
        stages.iter().filter(|s| going && s.state == "running").map(|s| s.name.as_str()).collect();
    let (photos, steps) = run.filter(|_| going).map(|r| r.rates()).unzip();
    let depth = run.filter(|_| going).map(|r| r.mailboxes.iter().map(|m| m.depth).sum::<u64>());
    let memory = run.and_then(|r| r.rss_bytes.or(r.peak_rss_bytes));
    let left = run.filter(|_| going).and_then(|r| r.left_s);
    let share = if scene.state == SceneState::Done { 1.0 } else { run.map_or(0.0, RunView::share) };
    let after = format!(
        "{} {:>3.0}% {:>5} {:>6} {:>5} {:>8} {:>6} {:>2}/{} {}",
        scene_bar(share, width),
        share * 100.0,
        maybe(photos, |n| format!("{n:.1}")),
        maybe(steps, |n| format!("{n:.1}")),
        maybe(depth, |n| n.to_string()),
        maybe(memory, bytes),
        maybe(left, short),
        scene.failures,
        scene.attempts,
        cut(&stage.join("+"), width.saturating_sub(WITHOUT_BAR))
    );
    let mark = if chosen { '>' } else { ' ' };
    row(format!("{mark}{:11} ", cut(&scene.name, 11)), scene.state.word(), 7, after)
}

/// A machine of a farm: what it holds, or why it takes no scenes.
fn machine_row(worker: &FarmWorkerView, width: usize) -> Line<'static> {
    let whole = worker.whole.map_or(String::new(), |whole| format!(" of {}", whole.cores));
    let mut text = format!(
        " {:24} {}, {}{whole} cores, seen {} ago",
        cut(&worker.name, 24),
        count(worker.held as u32, "scene"),
        worker.used.cores,
        short(worker.seen_s)
    );
    let Some(reason) = &worker.paused else { return plain(cut(&text, width)) };
    text += &format!(", takes no scenes: {reason}");
    coloured(cut(&text, width), Color::Yellow)
}

/// The machines of a farm: how many, and as many as fit into the lines, first those that take no scenes.
fn machines(workers: &[FarmWorkerView], width: usize, lines: usize) -> Vec<Line<'static>> {
    let mut shown: Vec<&FarmWorkerView> = workers.iter().collect();
    shown.sort_by_key(|worker| worker.paused.is_none());
    let mut heading = format!("machines {}", workers.len());
    match workers.iter().filter(|worker| worker.paused.is_some()).count() {
        0 => {}
        1 => heading += ", 1 takes no scenes",
        n => heading += &format!(", {n} take no scenes"),
    }
    let rows = shown.into_iter().take(lines).map(|worker| machine_row(worker, width));
    std::iter::once(columns(cut(&heading, width))).chain(rows).collect()
}

fn batch_page(
    batch: &BatchView,
    position: ScreenPosition,
    width: usize,
    height: usize,
) -> Vec<Line<'static>> {
    let counts: Vec<String> = SceneState::ALL
        .iter()
        .filter(|s| batch.count(**s) > 0)
        .map(|s| format!("{} {}", batch.count(*s), s.word()))
        .collect();
    let who = batch.owner.as_deref().map_or("not running".to_owned(), |o| format!("run by {o}"));
    let mut page = vec![head(cut(&format!("{}: {}, {who}", batch.name, counts.join(", ")), width))];
    let (used, budget) = (&batch.used, &batch.budget);
    let mut totals = format!(
        "cores {} of {}  memory {} of {}",
        used.cores,
        budget.cores,
        bytes(used.memory_bytes),
        bytes(budget.memory_bytes),
    );
    if budget.accelerators > 0 {
        totals += &format!("  accelerators {} of {}", used.accelerators, budget.accelerators);
    }
    if batch.retries > 0 {
        totals += &format!("  retries {}", batch.retries);
    }
    if batch.leases_expired > 0 {
        totals += &format!("  leases lost {}", batch.leases_expired);
    }
    page.push(plain(cut(&(totals + &disk(batch.disk)), width)));
    if let Some(farm) = &batch.farm {
        page.extend(machines(&farm.workers, width, (height / 6).max(2)));
    }
    page.push(columns(format!(
        " {:11} {:7}{} {:>4} {:>5} {:>6} {:>5} {:>8} {:>6} {:>4} {}",
        "scene",
        "state",
        " ".repeat(scene_bar(0.0, width).len()),
        "",
        "ph/s",
        "step/s",
        "queue",
        "memory",
        "left",
        "fail",
        "stages"
    )));
    let chosen = position
        .scene
        .filter(|&i| i < batch.scenes.len())
        .or_else(|| batch.scenes.iter().position(|s| s.state == SceneState::Running));
    let run = chosen.and_then(|i| batch.scenes[i].run.as_deref());
    // A third of the page is for the scenes, all but the reasons where no run is shown; those around the chosen one
    // are shown.
    let waits = batch.scenes.iter().filter_map(|s| Some((s, s.why.as_deref()?)));
    let waits: Vec<Line<'static>> = waits
        .map(|(s, why)| {
            let text = cut(&format!(" {:11} {why}", cut(&s.name, 11)), width);
            if s.state == SceneState::Dead { coloured(text, Color::Red) } else { plain(text) }
        })
        .collect();
    let reasons = waits.len().min((height / 6).max(2));
    let left = height.saturating_sub(page.len());
    let lines_left = match run {
        Some(_) => (height / 3).max(4).min(left),
        None => left.saturating_sub(reasons),
    };
    let first =
        chosen.unwrap_or(0).saturating_sub(lines_left / 2).min(batch.scenes.len().saturating_sub(lines_left));
    for (i, scene) in batch.scenes.iter().enumerate().skip(first).take(lines_left) {
        page.push(scene_row(scene, chosen == Some(i), width));
    }
    page.extend(waits.into_iter().take(reasons));
    if let Some(run) = run {
        page.push(run_head(run));
        page.extend(run_body(run, run_totals(run), width, height.saturating_sub(page.len())));
    }
    page
}
