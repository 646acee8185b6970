//! The program as the list of its commands. Each has a module: its arguments, a pipeline call, words out.

mod bake;
mod batch;
mod bench;
mod cache;
mod completions;
mod demo;
mod doctor;
mod eval;
mod import;
mod objects;
mod reference;
mod render;
mod run;
mod segment;
mod serve;
mod status;
mod top;
mod vision;
mod worker;

use crate::failure::Failure;
use clap::{Arg, ArgAction, ArgMatches, Command};
use std::fmt::Write as _;

/// The commands under the headings of `segwild --help`.
fn groups() -> [(&'static str, Vec<Command>); 5] {
    [
        (
            "A scene",
            vec![
                demo::command(),
                run::command(),
                import::command(),
                serve::command(),
                render::command(),
                bake::command(),
            ],
        ),
        ("Objects", vec![segment::command(), objects::command()]),
        (
            "Many scenes, and what they are doing",
            vec![batch::command(), worker::command(), status::command(), top::command()],
        ),
        ("Measure", vec![eval::command(), bench::command()]),
        (
            "Other",
            vec![
                doctor::command(),
                cache::command(),
                vision::command(),
                completions::command(),
                completions::man_command(),
            ],
        ),
    ]
}

/// The whole program.
pub fn program() -> Command {
    let groups = groups();
    let program = Command::new("segwild")
        .version(env!("CARGO_PKG_VERSION"))
        .about("From a pile of tourist photos to a 3D scene whose objects you can click")
        .subcommand_required(true)
        .arg_required_else_help(true)
        .help_template(template(&groups))
        .after_help(format!(
            "{}\n\n{}",
            crate::exit::HELP,
            crate::args::examples(
                "segwild run photos/trevi --out runs/trevi --serve --open",
                "segwild segment runs/trevi --photo a.jpg --positive 640,420 --name oceanus",
            )
        ))
        .arg(
            // For tests: what goes wrong where, as `segwild_flow::fault` reads it.
            Arg::new("fault").long("fault").global(true).hide(true).action(ArgAction::Append),
        )
        .subcommands(groups.into_iter().flat_map(|(_, commands)| commands));
    with_help(program)
}

/// The template of `segwild --help`: clap knows one list of commands only, this one is in groups.
fn template(groups: &[(&str, Vec<Command>)]) -> String {
    let mut text = String::from("{about-with-newline}\n{usage-heading} {usage}\n\n");
    for (heading, commands) in groups {
        let _ = writeln!(text, "{heading}:");
        for command in commands {
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(text, "  {:11}  {about}", command.get_name());
        }
        text.push('\n');
    }
    text + "Options:\n{options}{after-help}"
}

/// Gives a command and those below it two helps: `--help` fits a screen, `--help-all` has the expert settings and every word
/// on each flag. Where both are the same, `--help-all` is not offered.
fn with_help(command: Command) -> Command {
    let help = Arg::new("help").short('h').long("help").action(ArgAction::HelpShort).help("Print help");
    let all = Arg::new("help-all")
        .long("help-all")
        .action(ArgAction::HelpLong)
        .hide(!has_more(&command))
        .help("Print help with all settings, those for experts included");
    command
        .disable_help_flag(true)
        .disable_help_subcommand(true)
        .arg(help)
        .arg(all)
        .mut_subcommands(with_help)
}

/// Whether the long help of a command has more than the short one.
fn has_more(command: &Command) -> bool {
    command.get_arguments().filter(|arg| !arg.is_hide_set()).any(|arg| {
        let text = |help: Option<&clap::builder::StyledStr>| help.map(ToString::to_string);
        let longer = arg.get_long_help().is_some() && text(arg.get_long_help()) != text(arg.get_help());
        longer
            || arg.is_hide_short_help_set()
            || arg.get_possible_values().iter().any(|v| v.get_help().is_some())
    })
}

/// Runs the command that a command line names.
pub fn run(matches: &ArgMatches) -> Result<(), Failure> {
    match matches.subcommand() {
        Some(("run", m)) => run::run(m),
        Some(("import", m)) => import::import(m),
        Some(("serve", m)) => serve::serve(m),
        Some(("segment", m)) => segment::segment(m),
        Some(("objects", m)) => objects::objects(m),
        Some(("render", m)) => render::render(m),
        Some(("bake", m)) => bake::bake(m),
        Some(("eval", m)) => eval::eval(m),
        Some(("batch", m)) => batch::batch(m),
        Some(("worker", m)) => worker::worker(m),
        Some(("top", m)) => top::top(m),
        Some(("status", m)) => status::status(m),
        Some(("cache", m)) => cache::cache(m),
        Some(("vision", m)) => vision::vision(m),
        Some(("demo", m)) => demo::demo(m),
        Some(("doctor", m)) => doctor::doctor(m, program()),
        Some(("bench", m)) => bench::bench(m),
        Some(("completions", m)) => completions::completions(m, program()),
        Some(("man", m)) => completions::man(m, program()),
        _ => unreachable!("clap requires one of the commands"),
    }
}

/// Flags of earlier versions that are no settings: the command (and those below it), the flag, and what it is called now.
const RENAMED: [(&str, &str, &str); 36] = [
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
    ("run", "listen", "metrics-listen"),
    ("batch", "listen", "metrics-listen"),
    ("serve", "memory-budget", "session-memory"),
    ("batch", "engine", "farm"),
    ("worker", "engine", "farm"),
    ("status", "engine", "farm"),
    ("top", "engine", "farm"),
    ("bench", "places", "scene-seeds"),
    ("bench", "photos", "photo-count"),
    ("bench", "photos", "photo-counts"),
    ("bench flow", "photo-count", "photo-counts"),
    ("bench scale", "photo-count", "photo-counts"),
    ("bench scale", "splats", "splat-counts"),
    ("bench scale", "pixels", "sizes"),
    ("bench engine", "splats", "splat-counts"),
    ("bench engine", "sizes", "frame-sizes"),
    ("bench engine", "channels", "channel-counts"),
    ("bench engine", "size", "pixels"),
    ("bench farm", "scenes", "scene-count"),
    ("bench chart", "page", "page-folder"),
    ("bench nvos", "clicks", "scribble-clicks"),
    ("bench", "clicks", "clicks-per-object"),
    ("bench", "prompts", "clicks-per-object"),
    ("bench", "prompts", "clicks"),
    ("bench", "kinship", "embedding-similarity"),
];

/// Values of earlier versions: the command (and those below it), the flag, the value or the name in a `NAME=VALUE`, and what
/// it is called now.
const RENAMED_VALUES: [(&str, &str, &str, &str); 3] = [
    ("bench", "table", "rivals", "baselines"),
    ("bench chart", "only", "look", "appearance_model"),
    ("bench lego", "only", "told", "true-transients"),
];

/// The command that the words of a command line name, and its path below the program: `bench chart`.
fn named(words: &[String]) -> (Command, String) {
    let (mut command, mut path) = (program(), Vec::new());
    for word in words {
        let Some(inner) = command.find_subcommand(word).cloned() else { break };
        command = inner;
        path.push(word.as_str());
    }
    (command, path.join(" "))
}

/// Whether a command is another one, or below it.
fn is_of(path: &str, command: &str) -> bool {
    path.strip_prefix(command).is_some_and(|rest| rest.is_empty() || rest.starts_with(' '))
}

/// What is wrong with a flag that a command line's command does not have, where an earlier version had it: the sentence names
/// the present one. `None` where the command has neither.
pub fn renamed(words: &[String], flag: &str) -> Option<String> {
    let before = flag.trim_start_matches('-').split('=').next().unwrap_or_default();
    let (command, path) = named(words);
    if path.is_empty() {
        return None;
    }
    let has = |now: &str| {
        let has = |command: &Command| command.get_arguments().any(|arg| arg.get_long() == Some(now));
        has(&command) || command.get_subcommands().any(has)
    };
    let own = RENAMED.iter().filter(|(of, flag, _)| is_of(&path, of) && *flag == before);
    let own = own.map(|(_, _, now)| (*now).to_owned()).find(|now| has(now));
    let setting =
        || segwild_pipeline::renamed(before).map(|now| now.replace('_', "-")).filter(|now| has(now));
    let now = own.or_else(setting)?;
    Some(format!("`{path}` has no --{before}; it is now --{now}"))
}

/// What is wrong with a command line that has a value of an earlier version: the sentence names the present one.
pub fn renamed_value(words: &[String]) -> Option<String> {
    RENAMED_VALUES.iter().find_map(|(of, flag, before, now)| {
        let mut given = words.iter().enumerate().filter_map(|(i, word)| {
            let rest = word.strip_prefix("--")?.strip_prefix(*flag)?;
            if rest.is_empty() { words.get(i + 1).map(String::as_str) } else { rest.strip_prefix('=') }
        });
        let is_before = |part: &str| part.split('=').next().is_some_and(|name| name.trim() == *before);
        let old = given.any(|value| value.split(',').any(is_before)) && is_of(&named(words).1, of);
        old.then(|| format!("--{flag} has no `{before}`; it is now `{now}`"))
    })
}

#[cfg(test)]
mod deployed;

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_pipeline::Settings;
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
            if command.is_hide_set() {
                continue;
            }
            // As wide as clap makes it where there is no terminal.
            let help = command.term_width(100).render_help().to_string();
            let lines = help.lines().count();
            assert!(lines <= 60, "{path}: {lines} lines\n{help}");
            assert!(path != " segwild" || help.lines().all(|line| line.len() <= 100), "{help}");
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
    fn the_help_of_the_program_lists_every_command_once() {
        let help = program().render_help().to_string();
        for command in program().get_subcommands() {
            let line = format!("\n  {:11}  ", command.get_name());
            assert_eq!(help.matches(&line).count(), 1, "{}: {help}", command.get_name());
        }
        assert!(help.contains("\nMeasure:\n") && help.contains("Exit codes:\n"), "{help}");
    }

    #[test]
    fn the_long_help_is_offered_where_it_has_more() {
        let offers = |command: &str| {
            let words: Vec<String> = command.split(' ').map(str::to_owned).collect();
            named(&words).0.render_help().to_string().contains("--help-all")
        };
        for command in ["run", "import", "segment", "serve", "vision serve", "bench chart"] {
            assert!(offers(command), "{command}");
        }
        for command in ["", "render", "bake", "demo", "status", "cache gc", "bench", "bench scale"] {
            assert!(!offers(command), "{command}");
        }
    }

    #[test]
    fn placeholders_are_in_capitals() {
        for (path, command) in all_commands() {
            for arg in command.get_arguments().filter(|arg| arg.get_action().takes_values()) {
                let id = arg.get_id();
                let unlisted = arg.is_hide_set() && arg.get_value_names().is_none();
                let names = arg.get_value_names().unwrap_or_default();
                assert!(unlisted || !names.is_empty(), "{path}: {id}");
                assert!(
                    names.iter().all(|name| !name.contains(char::is_lowercase)),
                    "{path}: {id}: {names:?}"
                );
            }
        }
    }

    /// Flags of which each command says in words of its own what they do there, and the one meaning that all of these have.
    const SHARED_TEXTS: [(&str, &str); 21] = [
        ("adapter", "part of the accelerator's name"),
        ("appearance", "the photo whose appearance is used"),
        ("clicks-per-object", "clicks on each object, each measured by itself"),
        ("farm", "the address of a farm"),
        ("insecure", "listen to other machines without a token file"),
        ("kills", "how many processes a benchmark kills"),
        ("listen", "the address that the command's server listens on"),
        ("mode", "which part of the scene beside the selection"),
        ("models", "a folder of network files"),
        ("object-appearance", "the photo whose appearance the selected object has"),
        ("once", "one sample, and no more"),
        ("only", "the rows, axes or sweeps of a benchmark that are measured"),
        ("out", "where the command writes"),
        ("page", "the file that the page is written to"),
        ("photo", "a photo of the scene"),
        ("photo-counts", "numbers of photos, of which each is measured"),
        ("scenes", "the scenes of a benchmark, by their names"),
        ("seeds", "the seeds of a benchmark, of which each is measured"),
        ("selection", "the selection that the command is about"),
        ("splat-counts", "numbers of splats, of which each is measured"),
        ("until", "the stage or step after which runs stop"),
    ];

    #[test]
    fn a_flag_has_one_meaning_whichever_command_has_it() {
        let mut forms: BTreeMap<String, String> = BTreeMap::new();
        let mut texts: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
        let mut wrong = Vec::new();
        for (path, command) in all_commands() {
            for arg in command.get_arguments().filter(|arg| arg.get_long().is_some() && !arg.is_hide_set()) {
                let form = arg.get_value_names().map_or(String::new(), |names| names.join(" "));
                let long = arg.get_long().unwrap_or_default().to_owned();
                let first = forms.entry(long.clone()).or_insert_with(|| form.clone());
                if *first != form {
                    wrong.push(format!("--{long} takes {first} and, in{path}, {form}"));
                }
                let text = arg.get_help().map(ToString::to_string).unwrap_or_default();
                let text = text.split(" [default").next().unwrap_or_default().to_owned();
                texts.entry(long).or_default().entry(text).or_insert_with(|| path.clone());
            }
        }
        for (long, texts) in &texts {
            let listed = SHARED_TEXTS.iter().any(|(flag, _)| flag == long);
            if listed != (texts.len() > 1) {
                wrong.push(format!("--{long}, on the list: {listed}, has the texts {texts:#?}"));
            }
        }
        assert!(wrong.is_empty(), "{wrong:#?}");
        assert!(SHARED_TEXTS.iter().all(|(flag, _)| texts.contains_key(*flag)));
        assert!(forms.len() > 100, "{}", forms.len());
    }

    #[test]
    fn a_flag_of_an_earlier_version_names_the_present_one() {
        let all: Vec<(String, Command)> = all_commands()
            .into_iter()
            .map(|(path, command)| (path.trim_start_matches(" segwild").trim().to_owned(), command))
            .collect();
        for (of, before, now) in RENAMED {
            let refuses = |(path, command): &(String, Command)| {
                // The program is built for each sentence: only of the flag's own commands.
                is_of(path, of) && command.get_arguments().all(|arg| arg.get_long() != Some(before)) && {
                    let words: Vec<String> = path.split(' ').map(str::to_owned).collect();
                    let sentence = renamed(&words, &format!("--{before}"));
                    sentence.is_some_and(|s| s.ends_with(&format!("is now --{now}")))
                }
            };
            assert!(all.iter().any(refuses), "{of} --{before}: --{now}");
        }
        let words = ["bench", "scale", "--photos", "10,100"].map(str::to_owned);
        let sentence = renamed(&words, "--photos");
        assert_eq!(sentence.as_deref(), Some("`bench scale` has no --photos; it is now --photo-counts"));
        assert_eq!(renamed(&words, "--strange"), None);
    }

    #[test]
    fn a_value_of_an_earlier_version_names_the_present_one() {
        let refused = |line: &str| {
            let words: Vec<String> = line.split(' ').map(str::to_owned).collect();
            renamed_value(&words)
        };
        for (line, now) in [
            ("bench --table rivals", "baselines"),
            ("bench folder photos --table=rivals", "baselines"),
            ("bench chart --only steps=1,look=none", "appearance_model"),
            ("bench chart --only look", "appearance_model"),
            ("bench lego --only told,full", "true-transients"),
        ] {
            let sentence = refused(line).unwrap_or_else(|| panic!("{line}"));
            assert!(sentence.ends_with(&format!("it is now `{now}`")), "{sentence}");
        }
        for line in [
            "bench chart --only appearance_model=none",
            "bench --table baselines",
            "bench folder photos --only told",
            "bench chart --only",
        ] {
            assert_eq!(refused(line), None, "{line}");
        }
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
