//! `docs/reference/cli.md`: every command with its own flags, made from the definition of the command line.

use clap::{Arg, Command};
use std::fmt::Write as _;

/// The page of a program.
pub fn markdown(mut program: Command) -> String {
    program.build();
    let mut text = String::from(
        "# Commands\n\nEvery command with the flags of its own. Settings are flags as well, of `run`, `import`, `segment`, \
         `serve`, `vision serve` and the benchmarks that train: see [settings](settings.md) and [expert settings](expert-settings.md). `--help` of a command has examples. This page \
         is generated: `segwild doctor --commands`.\n",
    );
    program.get_subcommands().for_each(|command| section(command, "segwild", &mut text));
    text
}

/// The section of a command, and of those below it.
fn section(command: &Command, above: &str, text: &mut String) {
    if command.is_hide_set() {
        return;
    }
    let name = format!("{above} {}", command.get_name());
    let about = command.get_about().map(ToString::to_string).unwrap_or_default();
    let _ = write!(text, "\n## {name}\n\n{}\n", cell(&about));
    let shown: Vec<&Arg> = command.get_arguments().filter(|arg| is_own(arg)).collect();
    if !shown.is_empty() {
        text.push_str("\n| argument | meaning |\n|---|---|\n");
    }
    for arg in shown {
        let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
        let values: Vec<String> = arg
            .get_possible_values()
            .iter()
            .filter(|v| !v.is_hide_set())
            .map(|v| v.get_name().to_owned())
            .collect();
        let choices = match values.is_empty() || !arg.get_action().takes_values() {
            true => String::new(),
            false => format!(" ({})", values.join(", ")),
        };
        let defaults: Vec<String> =
            arg.get_default_values().iter().map(|v| v.to_string_lossy().into_owned()).collect();
        let default = match defaults.is_empty() || !arg.get_action().takes_values() {
            true => String::new(),
            false => format!(" [default: {}]", defaults.join(" ")),
        };
        let _ = writeln!(text, "| `{}` | {}{choices}{default} |", cell(&written(arg)), cell(&help));
    }
    command.get_subcommands().for_each(|inner| section(inner, &name, text));
}

/// Whether an argument is neither hidden, nor help, nor a setting.
fn is_own(arg: &Arg) -> bool {
    let id = arg.get_id().as_str();
    let help = ["help", "help-all", "version"].contains(&id);
    // Settings stand under the headings of their tables.
    !arg.is_hide_set() && !help && !arg.get_help_heading().is_some_and(|heading| heading.starts_with('['))
}

/// An argument as it is written.
fn written(arg: &Arg) -> String {
    let names = arg.get_value_names().unwrap_or_default();
    let names = names.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ");
    match arg.get_long() {
        Some(long) if arg.get_action().takes_values() => format!("--{long} {names}"),
        Some(long) => format!("--{long}"),
        None => names,
    }
}

/// A text in one cell of a table.
fn cell(text: &str) -> String {
    text.replace('\n', " ").replace('|', "\\|")
}
