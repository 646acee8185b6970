//! What happens, as bars for a person or as JSON lines for a program; and Ctrl-C.

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use segwild_flow::{Event, EventLevel, EventRecord, Events, Sink, Stopper};
use std::collections::BTreeMap;
use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use crate::failure::plain;
use crate::output::print_note;
pub use segwild_monitor::words::duration;

/// Shows the events of `events` until the sink is dropped.
pub fn show(events: &Events, json: bool) -> std::io::Result<Sink> {
    if json {
        return events.json_lines(std::io::stdout());
    }
    let bars = MultiProgress::new();
    let mut open: BTreeMap<String, ProgressBar> = BTreeMap::new();
    let terminal = std::io::stderr().is_terminal();
    events.sink("progress", move |record: &EventRecord| {
        let say = |line: String| {
            let line = plain(&line);
            // Nobody listening is no reason to stop working.
            let _ = if terminal { bars.println(&line) } else { writeln!(std::io::stderr(), "{line}") };
        };
        match &record.event {
            Event::StageStarted { stage, total } => {
                let bar = bars.add(ProgressBar::new(total.unwrap_or(0)));
                let style = ProgressStyle::with_template("{prefix:>9} {bar:32} {pos}/{len} {msg}");
                bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
                bar.set_prefix(stage.clone());
                open.insert(stage.clone(), bar);
            }
            Event::StageProgress { stage, part, done, total, rate, eta_s } => {
                if let Some(bar) = open.get(stage) {
                    if let Some(total) = total {
                        bar.set_length(*total);
                    }
                    bar.set_position(*done);
                    let left = eta_s.map_or(String::new(), |s| format!(", {} left", duration(s)));
                    let part = part.as_ref().map_or(String::new(), |part| format!("{part}, "));
                    bar.set_message(format!("{part}{rate:.1}/s{left}"));
                }
            }
            Event::StageFinished { stage, done, failed, cached, wall_s, .. } => {
                if let Some(bar) = open.remove(stage) {
                    bar.finish_and_clear();
                }
                let mut line = format!("{stage:>9} done in {}", duration(*wall_s));
                if *done > 0 {
                    line += &format!(", {done} done");
                }
                if *cached > 0 {
                    line += &format!(", {cached} of them found in the cache");
                }
                if *failed > 0 {
                    line += &format!(", {failed} failed");
                }
                say(line);
            }
            Event::StageSkipped { stage, .. } => say(format!("{stage:>9} was done before")),
            Event::StageFailed { stage, error } => say(format!("{stage:>9} failed: {error}")),
            Event::ViewFailed { stage, view, error, .. } => {
                say(format!("{stage:>9} photo {view} failed: {error}"))
            }
            Event::Warning { message, .. } => say(format!("  warning {message}")),
            Event::Message { level, stage, message } if *level > EventLevel::Detail => {
                say(format!("{:>9} {message}", stage.as_deref().unwrap_or("")));
            }
            Event::ActorRestarted { actor, cause, .. } => {
                say(format!("  warning {actor} was restarted: {cause}"))
            }
            Event::ActorFailed { actor, error } => say(format!("  warning {actor} failed: {error}")),
            Event::ActorStuck { actor, label, seconds, .. } => {
                say(format!("  warning {actor} has shown no progress on `{label}` for {seconds:.0} s"));
            }
            Event::ShutdownWaits { actors, left_s } => {
                say(format!("  waiting for {} ({left_s:.0} s at most)", actors.join(", ")));
            }
            _ => {}
        }
    })
}

/// Whether the run of this process is over, so that a stop leaves nothing to continue.
static RUN_IS_OVER: AtomicBool = AtomicBool::new(false);

/// Notes that the run is over, while its page stays.
pub fn run_is_over() {
    RUN_IS_OVER.store(true, Ordering::Relaxed);
}

/// How long a stop may take, the half minute that actors have included.
const LATEST: Duration = Duration::from_secs(45);

/// The first Ctrl-C (or SIGTERM) asks the run to stop where it can continue; the second ends the process at once,
/// which is safe as well: files are whole or not there.
pub fn stop_on_ctrl_c(stopper: &Stopper) -> std::io::Result<()> {
    let stopper = stopper.clone();
    on_ctrl_c(move |press| {
        if press > 1 {
            std::process::exit(crate::exit::INTERRUPTED.into());
        }
        if RUN_IS_OVER.load(Ordering::Relaxed) {
            print_note("closing the page");
        } else {
            print_note("stopping where the run can continue; once more to stop at once");
        }
        stopper.stop();
        // Actors that do not come to an end are left behind after half a minute; who conducts them may hang as well.
        let late = || {
            let (_never, next) = channel::<()>();
            let _ = next.recv_timeout(LATEST);
            print_note("it has not come to an end: stopped at once; the run can continue");
            std::process::exit(crate::exit::INTERRUPTED.into());
        };
        if std::thread::Builder::new().name("deadline".into()).spawn(late).is_err() {
            print_note("no thread is left to watch the end: press Ctrl-C again if it does not come");
        }
    })
}

/// Returns what receives the first Ctrl-C (or SIGTERM), for commands that an end at any time does not harm: the second ends the
/// process at once, and so does the first where nobody waits for it.
pub fn first_ctrl_c() -> std::io::Result<Receiver<()>> {
    let (stop, stopped) = channel();
    on_ctrl_c(move |press| {
        if press > 1 || stop.send(()).is_err() {
            std::process::exit(crate::exit::INTERRUPTED.into());
        }
    })?;
    Ok(stopped)
}

/// Calls a function at every Ctrl-C (or SIGTERM), with their number so far.
pub fn on_ctrl_c(pressed: impl Fn(u32) + Send + 'static) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // Listening begins here, before there is anything to lose.
    let mut signals = {
        let _inside = runtime.enter();
        Signals::new()?
    };
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        runtime.block_on(async {
            for press in 1.. {
                signals.next().await;
                pressed(press);
            }
        });
    })?;
    Ok(())
}

#[cfg(unix)]
struct Signals([tokio::signal::unix::Signal; 2]);

#[cfg(unix)]
impl Signals {
    fn new() -> std::io::Result<Signals> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Signals([signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?]))
    }

    async fn next(&mut self) {
        let [interrupt, terminate] = &mut self.0;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    }
}

#[cfg(not(unix))]
struct Signals;

#[cfg(not(unix))]
impl Signals {
    fn new() -> std::io::Result<Signals> {
        Ok(Signals)
    }

    async fn next(&mut self) {
        let _ = tokio::signal::ctrl_c().await;
    }
}
