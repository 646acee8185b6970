//! Lines on standard output, safe to show on a terminal: text for a person, JSON for a program.

use crate::failure::{Failure, plain};
use segwild_flow::files::name::{one_line, shown};
use serde::Serialize;
use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::Write;

/// Prints a value as one line of JSON. A reader that has gone away is no error.
pub fn print_json<T: Serialize>(value: &T) -> Result<(), Failure> {
    let line = serde_json::to_string(value).map_err(std::io::Error::other)?;
    print_raw(&in_ascii_where_odd(&line))
}

/// JSON in which the signs that a terminal would obey are written as JSON writes them.
fn in_ascii_where_odd(json: &str) -> String {
    let mut out = String::with_capacity(json.len());
    let mut units = [0; 2];
    for c in json.chars() {
        match one_line(c.encode_utf8(&mut [0; 4])) {
            Cow::Borrowed(_) => out.push(c),
            // Outside of strings JSON has no such signs.
            Cow::Owned(_) => c.encode_utf16(&mut units).iter().for_each(|unit| {
                let _ = write!(out, "\\u{unit:04x}");
            }),
        }
    }
    out
}

/// Prints a line on standard output, as it is safe to show: it may hold names that somebody else gave. A reader that has gone
/// away is no error.
pub fn print_line(line: &str) -> Result<(), Failure> {
    print_raw(&shown(line))
}

/// Prints a line on standard error. A log that cannot be written, as on a full disk, is no reason to end: `eprintln!` would
/// panic.
pub fn print_note(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Prints a warning on standard error, as it is safe to show: it may hold names that somebody else gave.
pub fn print_warning(message: &str) {
    print_note(&format!("warning: {}", plain(message)));
}

fn print_raw(line: &str) -> Result<(), Failure> {
    match writeln!(std::io::stdout(), "{line}") {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn json_stays_json_and_sends_nothing_to_the_terminal() {
        let names = ["a\u{202e}b", "\u{9b}31m", "\u{e0041}", "\u{1b}[2J", "plain \u{e9}\u{1f5ff}"];
        let written = super::in_ascii_where_odd(&serde_json::to_string(&names).unwrap());
        assert!(!written.chars().any(|c| c.is_control()) && !written.contains('\u{202e}'), "{written:?}");
        assert_eq!(serde_json::from_str::<Vec<String>>(&written).unwrap(), names);
        assert!(written.contains("\u{e9}\u{1f5ff}"), "{written}");
    }
}
