//! `segwild serve`

use crate::args::{self, examples, flag, number, path_of, with_fields};
use crate::exit;
use crate::failure::Failure;
use crate::farm::{connect, engine_args, farm_to_reach, shown_farm};
use crate::output::print_line;
use crate::progress::{first_ctrl_c, run_is_over};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_flow::{Phase, Stopper};
use segwild_monitor::ServeError;
use segwild_pipeline::{Code, RunFolder};
use segwild_proto::Token;
use segwild_studio::{ServeOptions, StudioServer, has_runs, serve as serve_page, serve_farm};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The usual port of the page.
const PORT: u16 = 7777;

/// The command's arguments.
pub fn command() -> Command {
    let command =
        Command::new("serve").about("Open the page: see the photos, click an object, keep and export it");
    let command = with_fields(command, "vision", args::names_code);
    engine_args(command, "Show this farm to operators as well, or alone: nats://HOST:PORT/NAME")
        .arg(
            Arg::new("run")
                .required_unless_present("farm")
                .value_name("RUN|FOLDER")
                .value_parser(value_parser!(PathBuf))
                .help("Run folder, or a folder of runs"),
        )
        .arg(
            Arg::new("listen")
                .long("listen")
                .value_name("ADDR")
                .value_parser(value_parser!(SocketAddr))
                .help("Serve the page here [default: 127.0.0.1:7777, or a free port where that is taken]"),
        )
        .arg(args::token_file())
        .arg(
            number(
                "session-memory",
                "2048",
                "MiB that open runs may take: those used longest ago are closed",
            )
            .value_parser(value_parser!(u32).range(1..)),
        )
        .arg(flag("insecure", "Listen to other machines without a token file: a new token at every start"))
        .arg(flag("open", "Open the page in the browser"))
        .after_help(examples(
            "segwild serve runs/trevi --open",
            "segwild serve --farm nats://queue:4222/night --open",
        ))
}

/// A folder that has something to serve.
fn check(folder: &Path) -> Result<(), Failure> {
    if !folder.is_dir() {
        let message = format!(
            "{}: there is no such folder; `segwild run SCENE --out FOLDER` makes one",
            folder.display()
        );
        return Err(Failure { message, code: exit::FOLDER });
    }
    if !has_runs(folder) {
        let message = format!(
            "{}: there is no run in it; `segwild run SCENE --out FOLDER` makes one",
            folder.display()
        );
        return Err(Failure { message, code: exit::FOLDER });
    }
    if RunFolder::at(folder).ledger().is_file() {
        RunFolder::open(folder)?;
    }
    Ok(())
}

/// Serves the page until it is stopped.
pub fn serve(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = path_of(matches, "run");
    folder.as_deref().map_or(Ok(()), check)?;
    // The sessions are on disk: nothing is lost by an end at any time.
    let stopped = first_ctrl_c()?;
    let server = page(folder.as_deref(), matches.get_one("listen").copied(), matches)?;
    print_line(&format!("the page: {}", server.address()))?;
    if matches.get_flag("open") {
        open_browser(&server.address());
    }
    // The sender lives as long as the process.
    let _ = stopped.recv();
    Ok(())
}

/// Adds `--serve` to a command that trains.
pub fn serve_args(command: Command) -> Command {
    command
        .arg(flag("serve", "Open the page as well: it follows the training, and stays until Ctrl-C"))
        .arg(flag("open", "Open the page in the browser").requires("serve"))
}

/// The page of a run of photos that is about to start, if it is requested.
pub fn page_of_run(
    matches: &ArgMatches,
    photos: &Path,
    folder: &Path,
    json: bool,
) -> Result<Option<StudioServer>, Failure> {
    if !matches.get_flag("serve") {
        return Ok(None);
    }
    let code = Code::given(&args::given(matches));
    let (program, photos) = (own_program(), Some(photos.to_owned()));
    let options = ServeOptions { program, code, photos, ..ServeOptions::default() };
    let server = on_loopback(Some(folder), options)?;
    let line = format!("the page: {}", server.address());
    // With `--json` standard output has objects only.
    if json {
        eprintln!("{line}")
    } else {
        print_line(&line)?
    }
    if matches.get_flag("open") {
        open_browser(&server.address());
    }
    Ok(Some(server))
}

/// This program, which trains again what a person corrects on the page.
fn own_program() -> Option<PathBuf> {
    std::env::current_exe().ok()
}

/// Keeps a page until Ctrl-C.
pub fn stay(server: Option<StudioServer>, stopper: &Stopper) {
    let Some(server) = server else { return };
    run_is_over();
    eprintln!("the page stays until Ctrl-C: {}", server.address());
    while stopper.phase() == Phase::Running {
        std::thread::park_timeout(Duration::from_millis(200));
    }
}

/// Serves on the usual port, or on a free one where that is taken.
fn on_loopback(folder: Option<&Path>, options: ServeOptions) -> Result<StudioServer, ServeError> {
    let at = |port| ServeOptions { address: (Ipv4Addr::LOCALHOST, port).into(), ..options.clone() };
    served(folder, at(PORT)).or_else(|_| served(folder, at(0)))
}

/// Serves a folder; without one, the farm of the options alone.
fn served(folder: Option<&Path>, options: ServeOptions) -> Result<StudioServer, ServeError> {
    match folder {
        Some(folder) => serve_page(folder, options),
        None => serve_farm(options.farm.clone().expect("clap requires a run or a farm"), options),
    }
}

/// Starts the server that the arguments describe.
fn page(
    folder: Option<&Path>,
    listen: Option<SocketAddr>,
    matches: &ArgMatches,
) -> Result<StudioServer, Failure> {
    let usual = SocketAddr::from((Ipv4Addr::LOCALHOST, PORT));
    let address = listen.unwrap_or(usual);
    let token =
        token_for(address, matches, "for a token that only this terminal shows; HTTP is not encrypted")?;
    let code = Code::given(&args::given(matches));
    let mib = *matches.get_one::<u32>("session-memory").expect("it has a default") as usize;
    let (memory_budget, program) = (mib << 20, own_program());
    let farm = match folder {
        // A queue that does not answer is no reason not to show the run.
        Some(_) => farm_to_reach(matches, "studio")?,
        None => connect(matches, "studio")?.map(|engine| shown_farm(&engine).into()),
    };
    let options = ServeOptions { address, token, memory_budget, program, code, photos: None, farm };
    Ok(if listen.is_some() { served(folder, options)? } else { on_loopback(folder, options)? })
}

/// The token of `--token-file`, if it is given. An address that other machines reach wants it, or `--insecure`; `insecure` says
/// what that does.
pub fn token_for(
    address: SocketAddr,
    matches: &ArgMatches,
    insecure: &str,
) -> Result<Option<Token>, Failure> {
    let token_file = path_of(matches, "token-file");
    if !address.ip().is_loopback() && token_file.is_none() && !matches.get_flag("insecure") {
        return Err(Failure::usage(format!(
            "--listen {address} lets other machines in: give --token-file FILE, or --insecure {insecure}"
        )));
    }
    token_file.map(|file| token_of(&file)).transpose()
}

/// The token of a file; a new one is written where the file is missing.
fn token_of(file: &Path) -> Result<Token, Failure> {
    let failed = |message: String| Failure { message, code: exit::FOLDER };
    match segwild_flow::files::read_within(file, 1024) {
        Ok(bytes) => String::from_utf8(bytes).ok().and_then(|text| Token::of(&text)).ok_or_else(|| {
            Failure::usage(format!(
                "{}: a token has 16 letters, digits, dashes or underscores at least; \
                 delete the file and run again: a new one is made",
                file.display()
            ))
        }),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            let token = Token::random().map_err(|e| failed(format!("no token can be made: {e}")))?;
            segwild_flow::files::write_private(file, format!("{}\n", token.text()).as_bytes())
                .map_err(|e| failed(e.to_string()))?;
            Ok(token)
        }
        Err(error) => Err(failed(format!("cannot read {}: {error}", file.display()))),
    }
}

/// Opens an address in the browser; where there is none, the printed address has to do.
fn open_browser(address: &str) {
    let program = if cfg!(target_os = "macos") {
        "open"
    } else if cfg!(windows) {
        "explorer"
    } else {
        "xdg-open"
    };
    let opened = std::process::Command::new(program)
        .arg(address)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn();
    if opened.is_err() {
        eprintln!("no browser can be opened here: open the address by hand");
    }
}
