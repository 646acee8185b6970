//! What operators of a run decide: what the process may use, `--metrics-listen`, and stopping with the parent.

use crate::exit;
use crate::failure::Failure;
use crate::output::print_note;
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_flow::{Stopper, shortage};
use segwild_monitor::{MonitorSource, Server, serve};
use std::io::Read;
use std::net::SocketAddr;

/// `--metrics-listen`.
pub fn metrics_listen() -> Arg {
    Arg::new("metrics-listen")
        .long("metrics-listen")
        .value_name("ADDR")
        .value_parser(value_parser!(SocketAddr))
        .help("Serve /metrics, /livez, /readyz, /api/v1/status here, as 127.0.0.1:9464")
}

/// Adds what a batch tells its children.
pub fn child_args(command: Command) -> Command {
    let cpus = Arg::new("cpus").long("cpus").value_name("LIST").hide(true);
    command
        .arg(Arg::new("stop-with-parent").long("stop-with-parent").action(ArgAction::SetTrue).hide(true))
        .arg(cpus)
}

/// Serves the view of a folder or a farm if that is wanted.
pub fn listen(
    matches: &ArgMatches,
    source: impl Into<MonitorSource>,
    per_scene: bool,
) -> Result<Option<Server>, Failure> {
    let Some(address) = matches.get_one::<SocketAddr>("metrics-listen") else { return Ok(None) };
    let server = serve(*address, source, per_scene)?;
    print_note(&format!("listening on http://{}", server.address()));
    Ok(Some(server))
}

/// Stops where the run can continue when standard input ends: whoever began this process has gone, or wants it.
pub fn stop_with_parent(matches: &ArgMatches, stopper: &Stopper) -> std::io::Result<()> {
    if !matches.get_flag("stop-with-parent") {
        return Ok(());
    }
    let stopper = stopper.clone();
    std::thread::Builder::new().name("parent".into()).spawn(move || {
        // Whatever comes is of no interest, only that nothing comes any more.
        let mut buffer = [0; 64];
        while matches!(std::io::stdin().read(&mut buffer), Ok(n) if n > 0) {}
        stopper.stop();
    })?;
    Ok(())
}

/// Sees to it that this process may open as many files as a run needs, however few a shell or a service lets it open at
/// first; to be called before any work begins.
pub fn have_files_to_open() -> Result<(), Failure> {
    match shortage::raise_open_files() {
        Some(limit) if limit < shortage::FILES_NEEDED => Err(Failure {
            message: format!(
                "this process may have only {limit} files open and needs {}: raise the limit \
                 (`ulimit -n 1024`, `LimitNOFILE=` of a service) and run again",
                shortage::FILES_NEEDED
            ),
            code: exit::SHORTAGE,
        }),
        _ => Ok(()),
    }
}

/// Keeps the process to the cores that a batch gave it (`--cpus 0,1`); to be called before it has other threads.
pub fn keep_to_cores(matches: &ArgMatches) -> Result<(), Failure> {
    let Some(list) = matches.get_one::<String>("cpus") else { return Ok(()) };
    let cores = segwild_flow::cpu::read_list(list)
        .ok_or_else(|| Failure::usage(format!("--cpus {list}: expected numbers with commas")))?;
    segwild_flow::cpu::keep_to(&cores).map_err(|e| Failure::usage(format!("--cpus {list}: {e}")))
}

/// Uses so many compute threads; 0 for all cores.
pub fn use_threads(threads: u32) {
    // Refused only when the pool is there already, and then it serves.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(threads as usize).build_global();
}
