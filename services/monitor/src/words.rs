//! Numbers and events in words.

use segwild_flow::Event;

/// Seconds in words: `80 ms`, `8.0 s`, `2 min 5 s`, `3 h 4 min`.
///
/// ```
/// use segwild_monitor::words::duration;
/// assert_eq!([0.08, 8.0, 125.0, 11_040.0].map(duration), ["80 ms", "8.0 s", "2 min 5 s", "3 h 4 min"]);
/// ```
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match seconds {
        s if s < 1.0 => format!("{:.0} ms", s * 1e3),
        s if s < 60.0 => format!("{s:.1} s"),
        s if s < 3600.0 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}

/// Bytes in words: `512 B`, `1.5 MiB`, `23 GiB`.
///
/// ```
/// use segwild_monitor::words::bytes;
/// assert_eq!([512, 3 << 19, 23 << 30].map(bytes), ["512 B", "1.5 MiB", "23 GiB"]);
/// ```
pub fn bytes(n: u64) -> String {
    const UNITS: [&str; 5] = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = n as f64;
    let mut unit = 0;
    while value >= 1000.0 && unit + 1 < UNITS.len() {
        value /= 1024.0;
        unit += 1;
    }
    if value >= 10.0 || unit == 0 {
        format!("{value:.0} {}", UNITS[unit])
    } else {
        format!("{value:.1} {}", UNITS[unit])
    }
}

/// So many of something: `1 core`, `3 cores`.
///
/// ```
/// use segwild_monitor::words::count;
/// assert_eq!((count(1, "core"), count(3, "core")), ("1 core".to_owned(), "3 cores".to_owned()));
/// ```
pub fn count(n: u32, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

/// An event of the ledger in words; what is no event's JSON is a sentence already.
pub fn event(message: &str) -> String {
    use Event::*;
    let Ok(event) = serde_json::from_str::<Event>(message) else { return message.to_owned() };
    match event {
        StageFailed { stage, error } => format!("{stage} failed: {error}"),
        ViewFailed { stage, view, error, attempts } => {
            format!("{stage}: photo {view} failed after {attempts} attempts: {error}")
        }
        GivenUp { actor, label, error, attempts } => {
            format!("{actor} gave up `{label}` after {attempts} attempts: {error}")
        }
        ActorRestarted { actor, cause, restarts, .. } => {
            format!("{actor} was restarted ({restarts}): {cause}")
        }
        ActorFailed { actor, error } => format!("{actor} failed: {error}"),
        ActorStuck { actor, label, seconds, .. } => {
            format!("{actor} has shown no progress on `{label}` for {}", duration(seconds))
        }
        ActorRecovered { actor, .. } => format!("{actor} moves again"),
        ShutdownWaits { actors, .. } => format!("stopping waits for {}", actors.join(", ")),
        Warning { message, .. } | Message { message, .. } => message,
        StageStarted { stage, .. } => format!("{stage} starts"),
        StageFinished { stage, .. } => format!("{stage} is done"),
        StageSkipped { stage, .. } => format!("{stage} was done before"),
        StageProgress { stage, done, .. } => format!("{stage}: {done} done"),
        Metric { name, value, .. } => format!("{name} {value}"),
    }
}

/// The first characters of a text that fit a width; a text that is cut ends in `…`.
///
/// ```
/// use segwild_monitor::words::cut;
/// assert_eq!((cut("masks", 5), cut("features", 5)), ("masks".to_owned(), "feat…".to_owned()));
/// ```
pub fn cut(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    let mut kept: String = text.chars().take(width.saturating_sub(1)).collect();
    if width > 0 {
        kept.push('…');
    }
    kept
}
