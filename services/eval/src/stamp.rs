//! The head of a generated page: who made its masks, the command, the commit and the machine, and what a reader must know
//! before any figure.

use crate::oracle::ORACLE;
use crate::record::{Provenance, Record, Results};

/// What stands for the provider where results do not say it.
pub const UNKNOWN: &str = "not recorded";

/// Who made the masks of a record; `None` where no masks take part.
pub fn provider(record: &Record) -> Option<&str> {
    match record.provider.as_str() {
        "" => record.numbers.keys().any(|name| name.ends_with("iou")).then_some(UNKNOWN),
        name => Some(name),
    }
}

/// The providers of results, in the order in which they first come.
pub fn providers<'a>(sets: impl IntoIterator<Item = &'a Results>) -> Vec<&'a str> {
    let mut names: Vec<&str> = Vec::new();
    for name in sets.into_iter().flat_map(|s| &s.records).filter_map(provider) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// A page's title with the providers of its figures, as in `Synthetic scenes (oracle)`.
pub fn title(words: &str, providers: &[&str]) -> String {
    if providers.is_empty() { words.to_owned() } else { format!("{words} ({})", providers.join(", ")) }
}

/// The first sentence of a page: which rows are settings of this program although they bear the names of others, and
/// whose masks these are.
pub fn first_sentence(providers: &[&str], baselines: &[&str]) -> String {
    let masks = masks(providers);
    if baselines.is_empty() {
        return match masks.strip_prefix("all") {
            Some(rest) => format!("All{rest}."),
            None => format!("{}{}.", masks[..1].to_uppercase(), &masks[1..]),
        };
    }
    format!(
        "The rows named after {} are settings of this program, not those programs, and {masks}.",
        listed(baselines)
    )
}

/// Whose masks the figures of a page are of.
fn masks(providers: &[&str]) -> String {
    const ONLY_TRUTH: &str = "the truth with faults, which tests the 3D part alone and which no user has";
    let others: Vec<&str> = providers.iter().copied().filter(|p| *p != ORACLE).collect();
    match (providers.contains(&ORACLE), others.as_slice()) {
        (true, []) => format!("all masks are those of the oracle: {ONLY_TRUTH}"),
        (true, others) => {
            format!(
                "masks are those of {} and, where it is named, of the oracle: {ONLY_TRUTH}",
                listed(others)
            )
        }
        (false, []) => "no masks take part in these figures".into(),
        (false, [UNKNOWN]) => "nothing says who made the masks of these figures".into(),
        (false, others) => format!("all masks are those of the provider {}", listed(others)),
    }
}

/// `a`, `a and b`, `a, b and c`.
fn listed(words: &[&str]) -> String {
    match words {
        [] => String::new(),
        [one] => (*one).to_owned(),
        [most @ .., last] => format!("{} and {last}", most.join(", ")),
    }
}

/// What made a page, in one line: provider, command, commit, machine.
pub fn stamp(made: &Provenance, providers: &[&str]) -> String {
    let provider = if providers.is_empty() { "none".to_owned() } else { providers.join(", ") };
    format!(
        "Provider: {provider}. Command: `{}`. Commit: {}. Machine: {}.",
        made.command,
        commit(made),
        made.machine
    )
}

/// The commit of the program, and its version.
fn commit(made: &Provenance) -> String {
    let within =
        made.version.split_once(" (").and_then(|(version, rest)| Some((version, rest.strip_suffix(')')?)));
    match within {
        Some((version, commit)) => format!("{commit} (segwild {version})"),
        None => format!("unknown (segwild {})", made.version),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_says_first_whose_masks_and_whose_settings_its_figures_are_of() {
        let message = first_sentence(&[ORACLE], &["SAGA", "GS-W"]);
        assert!(
            message.starts_with("The rows named after SAGA and GS-W are settings of this program"),
            "{message}"
        );
        assert!(message.contains("oracle") && message.matches(". ").count() == 0, "{message}");
        let message = first_sentence(&["built-in"], &[]);
        assert_eq!(message, "All masks are those of the provider built-in.");
        let message = first_sentence(&["built-in", ORACLE], &[]);
        assert!(
            message.starts_with("Masks are those of built-in and") && message.contains("oracle"),
            "{message}"
        );
        assert_eq!(title("Scenes", &[ORACLE]), "Scenes (oracle)");
    }

    #[test]
    fn figures_of_before_providers_were_kept_are_not_passed_off_as_anyones() {
        let numbers = [("iou".to_owned(), 0.9)].into();
        let old = Results { records: vec![Record { numbers, ..Record::default() }], ..Results::default() };
        assert_eq!(providers([&old]), [UNKNOWN]);
        assert!(first_sentence(&[UNKNOWN], &[]).starts_with("Nothing says who"));
        let kernels = [("forward_ms".to_owned(), 1.0)].into();
        let kernels = Record { numbers: kernels, ..Record::default() };
        assert_eq!(provider(&kernels), None);
    }

    #[test]
    fn a_stamp_names_provider_command_commit_and_machine() {
        let made = Provenance {
            command: "segwild bench".into(),
            version: "0.1.0 (abc)".into(),
            machine: "m".into(),
        };
        let message = stamp(&made, &["built-in"]);
        assert_eq!(
            message,
            "Provider: built-in. Command: `segwild bench`. Commit: abc (segwild 0.1.0). Machine: m."
        );
    }
}
