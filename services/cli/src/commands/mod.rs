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
