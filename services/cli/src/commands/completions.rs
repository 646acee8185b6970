//! `segwild completions` and `segwild man`: made from the definition of the command line.

use crate::args::{self, examples, path_of};
use crate::failure::Failure;
use crate::output::print_line;
use clap::{Arg, ArgMatches, Command, value_parser};
use clap_complete::Shell;
use std::path::Path;

/// The arguments of `segwild completions`.
pub fn command() -> Command {
    Command::new("completions")
        .about("Print the completions of a shell")
        .arg(
            Arg::new("shell")
                .required(true)
                .value_name("SHELL")
                .value_parser(value_parser!(Shell))
                .help("The shell"),
        )
        .after_help(examples(
            "segwild completions bash > ~/.local/share/bash-completion/completions/segwild",
            "segwild completions zsh > ~/.zfunc/_segwild",
        ))
}

/// The arguments of `segwild man`.
pub fn man_command() -> Command {
    Command::new("man")
        .about("Write the man pages: one for the program, one for each command")
        .arg(args::path("out", "Folder for the pages [default: man]"))
        .after_help(examples("segwild man", "segwild man --out ~/.local/share/man/man1"))
}

/// Prints the completions of the program for a shell.
pub fn completions(matches: &ArgMatches, mut program: Command) -> Result<(), Failure> {
    let shell = *matches.get_one::<Shell>("shell").expect("clap requires it");
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut program, "segwild", &mut script);
    print_line(String::from_utf8_lossy(&script).trim_end())
}

/// Writes the program's man pages into a folder.
pub fn man(matches: &ArgMatches, mut program: Command) -> Result<(), Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| "man".into());
    std::fs::create_dir_all(&out)?;
    program.build();
    write_pages(&program, &out)
}

/// The page of a command, and of those below it. `build` has given each its whole name, as in `segwild-cache-ls`.
fn write_pages(command: &Command, out: &Path) -> Result<(), Failure> {
    if command.is_hide_set() {
        return Ok(());
    }
    let name = command.get_display_name().unwrap_or_else(|| command.get_name()).to_owned();
    let mut page = Vec::new();
    clap_mangen::Man::new(command.clone()).title(&name).render(&mut page)?;
    let file = out.join(format!("{name}.1"));
    segwild_flow::files::write_plain(&file, &page)?;
    print_line(&file.display().to_string())?;
    command.get_subcommands().try_for_each(|inner| write_pages(inner, out))
}
