//! The command line: the program, what its commands share, and flags made from the settings structs.

use crate::commands::{
    bake, batch, bench, cache, completions, demo, doctor, eval, objects, render, run, segment, serve, status,
    top,
};
use clap::builder::PossibleValuesParser;
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_pipeline::Settings;
use segwild_scene::settings::Field;
use std::path::PathBuf;

/// The whole program.
pub fn program() -> Command {
    let program = Command::new("segwild")
        .version(env!("CARGO_PKG_VERSION"))
        .about("From a pile of tourist photos to a 3D scene whose objects you can click")
        .subcommand_required(true)
        .arg_required_else_help(true)
        .after_help(crate::exit::HELP)
        .arg(
            // For tests: what goes wrong where, as `segwild_flow::fault` reads it.
            Arg::new("fault").long("fault").global(true).hide(true).action(ArgAction::Append),
        )
        .subcommands([
            run::command(),
            serve::command(),
            segment::command(),
            objects::command(),
            render::command(),
            bake::command(),
            eval::command(),
            batch::command(),
            status::command(),
            top::command(),
            cache::command(),
            demo::command(),
            doctor::command(),
            bench::command(),
            completions::command(),
            completions::man_command(),
        ]);
    with_help(program)
}

/// Gives a command and those below it two helps: `--help` fits a screen, `--help-all` has the expert settings and every word
/// on each flag.
fn with_help(command: Command) -> Command {
    let help = Arg::new("help").short('h').long("help").action(ArgAction::HelpShort).help("Print help");
    let all = Arg::new("help-all")
        .long("help-all")
        .action(ArgAction::HelpLong)
        .help("Print help with all settings, those for experts included");
    command
        .disable_help_flag(true)
        .disable_help_subcommand(true)
        .arg(help)
        .arg(all)
        .mut_subcommands(with_help)
}

/// Two examples at the end of a command's help.
pub fn examples(first: &str, second: &str) -> String {
    format!("Examples:\n  {first}\n  {second}")
}

/// Flags of earlier versions that are no settings: the command, the flag, and what it is called now.
const RENAMED: [(&str, &str, &str); 13] = [
    ("segment", "in", "positive"),
    ("segment", "out", "negative"),
    ("segment", "not", "negative"),
    ("render", "look", "appearance"),
    ("render", "object-look", "object-appearance"),
    ("render", "between", "interpolate"),
    ("bake", "look", "appearance"),
    ("bake", "object-look", "object-appearance"),
    ("bake", "between", "interpolate"),
    ("eval", "strangers", "transient-truth"),
    ("demo", "seed", "scene-seed"),
    ("bench", "places", "scene-seeds"),
    ("bench", "prompts", "clicks"),
];

/// What a flag of an earlier version of a command is called now, without its dashes; `None` where the command has neither.
pub fn renamed(command: &str, flag: &str) -> Option<String> {
    let flag = flag.trim_start_matches('-').split('=').next().unwrap_or_default();
    let own = RENAMED.iter().find(|(of, before, _)| *of == command && *before == flag);
    let now = match own {
        Some((_, _, now)) => (*now).to_owned(),
        None => segwild_pipeline::renamed(flag)?.replace('_', "-"),
    };
    let has = |command: &Command| command.get_arguments().any(|arg| arg.get_long() == Some(&now));
    let program = program();
    let command = program.find_subcommand(command)?;
    (has(command) || command.get_subcommands().any(has)).then_some(now)
}

/// The run folder.
pub fn run() -> Arg {
    Arg::new("run").required(true).value_parser(value_parser!(PathBuf)).help("Run folder")
}

/// A flag that takes a number.
pub fn number(name: &'static str, default: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("N").default_value(default).help(help)
}

/// `--until`.
pub fn until(help: &'static str) -> Arg {
    Arg::new("until")
        .long("until")
        .value_name("STAGE|N")
        .value_parser(str::parse::<segwild_pipeline::Until>)
        .help(help)
}

/// `--json`.
pub fn json() -> Arg {
    flag("json", "Print one JSON object per line instead of text")
}

/// A flag that takes a path.
pub fn path(name: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("PATH").value_parser(value_parser!(PathBuf)).help(help)
}

/// `--photo`; it may be repeated.
pub fn photos(help: &'static str) -> Arg {
    Arg::new("photo").long("photo").value_name("NAME").action(ArgAction::Append).help(help)
}

/// A flag that takes positions in a photo; it may be repeated.
pub fn positions(id: &'static str, form: &'static str, help: &'static str) -> Arg {
    Arg::new(id).long(id).value_name(form).action(ArgAction::Append).allow_hyphen_values(true).help(help)
}

/// Which appearance, for the scene and for the selection.
pub fn appearances(default: &str) -> [Arg; 5] {
    let appearance = |id: &'static str, help: String| {
        Arg::new(id).long(id).value_name("PHOTO").action(ArgAction::Append).help(help)
    };
    let strength = |id: &'static str, help| {
        Arg::new(id).long(id).value_name("X").value_parser(value_parser!(f32)).default_value("1").help(help)
    };
    [
        appearance(
            "appearance",
            format!(
                "Use this photo's appearance; `none` is the scene's own; repeat to interpolate [default: the {default}]"
            ),
        ),
        appearance(
            "object-appearance",
            "Give the selected object another appearance, in the same way".into(),
        ),
        strength("strength", "Strength of the appearance: 0 is the scene's own, 1 the photo's, at most 2"),
        strength("object-strength", "The same for the object's appearance"),
        Arg::new("interpolate")
            .long("interpolate")
            .value_name("T")
            .value_parser(value_parser!(f32))
            .help("Interpolate the appearances given: 0 is the first, 1 the last"),
    ]
}

/// `--selection` of commands that show or write one.
pub fn selection(help: &'static str) -> Arg {
    Arg::new("selection").long("selection").value_name("NAME").help(help)
}

/// A flag that takes a word out of a few.
pub fn choice<const N: usize>(name: &'static str, words: [&'static str; N], help: &'static str) -> Arg {
    Arg::new(name).long(name).value_parser(words).help(help)
}

/// A flag without a value.
pub fn flag(name: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).action(ArgAction::SetTrue).help(help)
}

/// Adds a flag for every setting of every table.
pub fn with_settings(mut command: Command) -> Command {
    for (table, _, _) in Settings::catalogue() {
        command = with_table(command, table);
    }
    command
}

/// The same, with none of them in the short help: for commands whose own flags come first.
pub fn with_settings_in_long_help(command: Command) -> Command {
    with_settings(command).mut_args(|arg| match Settings::default().get(arg.get_id().as_str()) {
        Some(_) => arg.hide_short_help(true),
        None => arg,
    })
}

/// Adds a flag for every setting of one table, under its own heading in the help.
pub fn with_table(command: Command, table: &str) -> Command {
    with_fields(command, table, |_| true)
}

/// The same for some of its settings.
pub fn with_fields(mut command: Command, table: &str, wanted: fn(&str) -> bool) -> Command {
    for (name, doc, fields) in Settings::catalogue() {
        if name != table {
            continue;
        }
        for field in fields.iter().filter(|field| wanted(field.name)) {
            command = command.arg(setting(field, heading(table, doc)));
        }
    }
    command
}

/// The heading of a table's flags: its name in the settings file, and what it is about.
fn heading(table: &str, doc: &str) -> String {
    format!("[{table}] {}", doc.split(". ").next().unwrap_or(doc).trim_end_matches('.'))
}

/// The flag of a setting. The short help has the first sentence of what it does, the long one all of it.
fn setting(field: &'static Field, heading: String) -> Arg {
    let flag = field.name.replace('_', "-");
    let default = Settings::default().get(field.name).filter(|text| !text.is_empty());
    let with_default = |text: &str| match &default {
        Some(default) => format!("{} [default: {default}]", text.trim_end_matches('.')),
        None => text.trim_end_matches('.').to_owned(),
    };
    let first = field.doc.split(". ").next().unwrap_or(field.doc);
    let arg = Arg::new(field.name)
        .long(flag)
        .value_name(value_name(field))
        .allow_hyphen_values(true)
        .help_heading(heading)
        .hide_short_help(field.expert)
        .help(with_default(first))
        .long_help(with_default(field.doc));
    match field.choices {
        [] => arg,
        choices => arg.value_parser(PossibleValuesParser::new(choices)),
    }
}

/// What the help calls a setting's value.
fn value_name(field: &Field) -> &'static str {
    match field.name {
        "images" | "ignore" | "keep_masks" | "transient_masks" | "split" | "models" | "transient_network"
        | "onnxruntime" => "PATH",
        "object_appearance" => "PHOTO",
        _ => field.kind,
    }
}

/// The settings given as flags, as `(name, value)` pairs.
pub fn given(matches: &ArgMatches) -> Vec<(String, String)> {
    let mut pairs = Vec::new();
    for (_, _, fields) in Settings::catalogue() {
        for field in fields {
            if let Ok(Some(value)) = matches.try_get_one::<String>(field.name) {
                pairs.push((field.name.to_owned(), value.clone()));
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn the_command_line_is_consistent() {
        program().debug_assert();
    }

    /// Every command with its path, those without commands below them.
    fn commands(command: &Command, path: &str, all: &mut Vec<(String, Command)>) {
        let path = format!("{path} {}", command.get_name());
        if command.has_subcommands() {
            command.get_subcommands().for_each(|inner| commands(inner, &path, all));
        }
        all.push((path, command.clone()));
    }

    fn all_commands() -> Vec<(String, Command)> {
        let mut all = Vec::new();
        commands(&program(), "", &mut all);
        all
    }

    #[test]
    fn the_help_of_every_command_fits_a_screen_and_ends_with_two_examples() {
        for (path, command) in all_commands() {
            if command.is_hide_set() || path == " segwild" {
                continue;
            }
            let help = command.term_width(120).render_help().to_string();
            let lines = help.lines().count();
            assert!(lines <= 60, "{path}: {lines} lines\n{help}");
            let (_, examples) = help.split_once("Examples:\n").unwrap_or_else(|| panic!("{path}: {help}"));
            let commands = examples.lines().map(str::trim).filter(|line| line.starts_with("segwild "));
            let commands: Vec<&str> = commands.map(|line| line.split(" > ").next().unwrap_or(line)).collect();
            assert!(commands.len() >= 2, "{path}: {examples}");
            for command in commands {
                let parsed = program().try_get_matches_from(command.split(' '));
                assert!(
                    parsed.is_ok(),
                    "{path}: `{command}`: {}",
                    parsed.err().map_or_else(String::new, |e| e.to_string())
                );
            }
        }
    }

    #[test]
    fn a_flag_has_one_meaning_whichever_command_has_it() {
        let mut forms: BTreeMap<String, String> = BTreeMap::new();
        let mut twice = Vec::new();
        for (path, command) in all_commands() {
            for arg in command.get_arguments().filter(|arg| arg.get_long().is_some() && !arg.is_hide_set()) {
                let form = arg.get_value_names().map_or(String::new(), |names| names.join(" "));
                // A benchmark measures at each number of a list.
                let form = if form == "LIST" { "N".to_owned() } else { form };
                let long = arg.get_long().unwrap_or_default().to_owned();
                let first = forms.entry(long.clone()).or_insert_with(|| form.clone());
                if *first != form {
                    twice.push(format!("--{long} takes {first} and, in{path}, {form}"));
                }
            }
        }
        assert!(twice.is_empty(), "{twice:#?}");
        assert!(forms.len() > 100, "{}", forms.len());
    }

    #[test]
    fn the_short_help_leaves_expert_settings_to_the_long_one() {
        let (_, mut run) =
            all_commands().into_iter().find(|(path, _)| path == " segwild run").expect("it is there");
        let (short, long) = (run.render_help().to_string(), run.render_long_help().to_string());
        for (_, _, fields) in Settings::catalogue() {
            for field in fields {
                let flag = format!("--{} ", field.name.replace('_', "-"));
                assert!(long.contains(&flag), "{flag}");
                assert_eq!(short.contains(&flag), !field.expert, "{flag}");
            }
        }
    }
}
