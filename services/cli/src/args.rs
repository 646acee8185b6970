//! Arguments that commands share, what they were given, and flags made from the settings structs.

use crate::failure::Failure;
use clap::builder::PossibleValuesParser;
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_pipeline::Settings;
use segwild_scene::settings::Field;
use segwild_vision::VisionSettings;
use std::path::PathBuf;
use std::str::FromStr;

/// Two examples at the end of a command's help.
pub fn examples(first: &str, second: &str) -> String {
    format!("Examples:\n  {first}\n  {second}")
}

/// The run folder.
pub fn run() -> Arg {
    Arg::new("run").required(true).value_name("RUN").value_parser(value_parser!(PathBuf)).help("Run folder")
}

/// A flag that takes a number.
pub fn number(name: &'static str, default: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("N").default_value(default).help(help)
}

/// `--photo-count` of synthetic scenes.
pub fn photo_count(default: &'static str) -> Arg {
    number("photo-count", default, "Training photos of each synthetic scene").value_parser(value_parser!(u32))
}

/// `--pixels` of synthetic scenes.
pub fn pixels(default: &'static str) -> Arg {
    number("pixels", default, "Long side of a synthetic scene's photos, in pixels")
        .value_parser(value_parser!(u32).range(16..=4096))
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

/// `--out` and `--config` of commands that make a run.
pub fn run_files() -> [Arg; 2] {
    [
        path("out", "Run folder [default: runs/NAME]"),
        path("config", "Settings file [default: segwild.toml in the run folder, if there]"),
    ]
}

/// `--token-file` of servers.
pub fn token_file() -> Arg {
    path("token-file", "Read the token that clients need from this file; it is made where it is missing")
}

/// `--photo`; it may be repeated.
pub fn photos(help: &'static str) -> Arg {
    Arg::new("photo").long("photo").value_name("NAME").action(ArgAction::Append).help(help)
}

/// A flag that takes positions in a photo; it may be repeated.
pub fn positions(id: &'static str, form: &'static str, help: &'static str) -> Arg {
    Arg::new(id).long(id).value_name(form).action(ArgAction::Append).allow_hyphen_values(true).help(help)
}

/// Which appearance, for the scene and for the selection, under a heading of their own.
pub fn appearances(default: &str) -> [Arg; 6] {
    let appearance = |id: &'static str, help: String| {
        Arg::new(id).long(id).value_name("PHOTO").action(ArgAction::Append).help(help)
    };
    let strength = |id: &'static str, help| {
        Arg::new(id).long(id).value_name("X").value_parser(value_parser!(f32)).default_value("1").help(help)
    };
    let all = [
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
        path("appearance-from", "Use the appearance of a photo that is not in the scene: a file"),
        strength("strength", "Strength of the appearance: 0 is the scene's own, 1 the photo's, at most 2"),
        strength("object-strength", "The same for the object's appearance"),
        Arg::new("interpolate")
            .long("interpolate")
            .value_name("T")
            .value_parser(value_parser!(f32))
            .help("Interpolate the appearances given: 0 is the first, 1 the last"),
    ];
    under("Appearance", all)
}

/// Arguments under one heading of the help.
pub fn under<const N: usize>(heading: &'static str, args: [Arg; N]) -> [Arg; N] {
    args.map(|arg| arg.help_heading(heading))
}

/// `--selection` of commands that render, write or score one.
pub fn selection(help: &'static str) -> Arg {
    Arg::new("selection").long("selection").value_name("NAME").help(help)
}

/// A flag that takes a word out of a few.
pub fn choice<const N: usize>(name: &'static str, words: [&'static str; N], help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("WORD").value_parser(words).help(help)
}

/// A flag without a value.
pub fn flag(name: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).action(ArgAction::SetTrue).help(help)
}

/// What a flag of a path was given.
pub fn path_of(matches: &ArgMatches, name: &str) -> Option<PathBuf> {
    matches.get_one::<PathBuf>(name).cloned()
}

/// The words of a flag that takes several, with commas between them.
pub fn list(matches: &ArgMatches, name: &str) -> Vec<String> {
    let text = matches.get_one::<String>(name).map_or("", String::as_str);
    text.split(',').map(str::trim).filter(|t| !t.is_empty()).map(str::to_owned).collect()
}

/// The whole numbers of a flag that takes several, with commas between them.
pub fn numbers<T: FromStr>(matches: &ArgMatches, name: &str) -> Result<Vec<T>, Failure> {
    let read = |text: String| {
        text.parse()
            .map_err(|_| Failure::usage(format!("--{name} {text}: expected whole numbers with commas")))
    };
    list(matches, name).into_iter().map(read).collect()
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

/// The flag of a setting. The short help has the first sentence of what it does and the words of a choice, the long one all of
/// it and what each word does.
fn setting(field: &'static Field, heading: String) -> Arg {
    let flag = field.name.replace('_', "-");
    let default = Settings::default().get(field.name).filter(|text| !text.is_empty());
    let with_default = |text: &str| match &default {
        Some(default) => format!("{text} [default: {default}]"),
        None => text.to_owned(),
    };
    let first = field.doc.split(". ").next().unwrap_or(field.doc).trim_end_matches('.');
    let explained = !field.choice_docs.is_empty();
    let short = match explained {
        true => with_default(&format!("{first}: {}", field.choices.join(", "))),
        false => with_default(first),
    };
    let mut long = with_default(field.doc.trim_end_matches('.'));
    for (word, doc) in field.explained_choices() {
        long += &format!("\n- {word}: {doc}");
    }
    let arg = Arg::new(field.name)
        .long(flag)
        .value_name(value_name(field))
        .allow_hyphen_values(true)
        .help_heading(heading)
        .hide_short_help(field.expert)
        .hide_possible_values(explained)
        .help(short)
        .long_help(long);
    match field.choices {
        [] => arg,
        // An address is meant as well.
        _ if field.name == "masks" => arg.value_name("WORD|ADDRESS"),
        choices => arg.value_parser(PossibleValuesParser::new(choices)),
    }
}

/// What the help calls a setting's value.
fn value_name(field: &Field) -> &'static str {
    match field.name {
        "images"
        | "ignore"
        | "keep_masks"
        | "transient_masks"
        | "split"
        | "imported_splats"
        | "imported_frame"
        | "models"
        | "transient_network"
        | "onnxruntime"
        | "vision_token_file"
        | "vision_certificates"
        | "lpips_weights" => "PATH",
        "vision_service" => "ADDRESS",
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
    VisionSettings::with_services(&pairs)
}

/// The names of settings that say where networks and services are, for commands that click.
pub fn names_code(name: &str) -> bool {
    name != "transient_network" && VisionSettings::CODE.contains(&name)
}
