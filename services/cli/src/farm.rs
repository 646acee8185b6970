//! What commands need to reach a farm: its address, who connects, and where artefacts are.

use crate::args::{self, path_of};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command};
use segwild_farm::{
    ArtefactSession, ArtefactStore, EngineError, FarmAccess, FarmAddress, FarmKey, NatsEngine,
    ObjectArtefacts, USUAL_PATIENCE,
};
use segwild_monitor::MonitorTarget;
use segwild_monitor::view::FarmTarget;
use segwild_studio::FarmSource;
use std::sync::Arc;

/// Adds the flags of who reads or writes a farm's jobs.
pub fn engine_args(command: Command, help: &'static str) -> Command {
    command
        .arg(
            Arg::new("farm")
                .long("farm")
                .value_name("FARM")
                .value_parser(str::parse::<FarmAddress>)
                .help(help),
        )
        .arg(args::path("credentials", "NATS credentials file").requires("farm"))
        .arg(
            args::path("certificates", "Certificates of who signed the farm's servers (tls://)")
                .requires("farm"),
        )
        .arg(args::path("farm-key", "File with the key that all of the farm share").requires("farm"))
}

/// Adds the flags of who also moves photos and results.
pub fn farm_args(command: Command, help: &'static str) -> Command {
    engine_args(command, help).arg(
        Arg::new("artefacts")
            .long("artefacts")
            .value_name("STORE")
            .requires("farm")
            .help("Shared folder or s3://BUCKET/PREFIX for photos and results [default: the farm's server]"),
    )
}

/// A farm that was reached.
pub struct ReachedFarm {
    /// Its jobs.
    pub engine: Arc<NatsEngine>,
    /// Its artefacts.
    pub artefacts: ArtefactSession,
}

/// Connects to the farm of the flags; `None` where there is none. `writer` is who appends to its log, for people.
pub fn connect(matches: &ArgMatches, writer: &str) -> Result<Option<Arc<NatsEngine>>, Failure> {
    matches.get_one::<FarmAddress>("farm").map(|address| connect_to(address, matches, writer)).transpose()
}

/// Connects to a farm, as who the flags say.
pub fn connect_to(
    address: &FarmAddress,
    matches: &ArgMatches,
    writer: &str,
) -> Result<Arc<NatsEngine>, Failure> {
    let access = access_of(matches)?;
    Ok(Arc::new(NatsEngine::connect(address, &access, writer, USUAL_PATIENCE)?))
}

/// The farm of the flags, connected to by who shows it; `None` where there is none.
pub fn farm_to_reach(matches: &ArgMatches, writer: &'static str) -> Result<Option<FarmSource>, Failure> {
    let Some(address) = matches.get_one::<FarmAddress>("farm").cloned() else { return Ok(None) };
    let access = access_of(matches)?;
    // It is connected to later, when only viewers read what is wrong.
    for (flag, file) in [("credentials", &access.credentials), ("certificates", &access.certificates)] {
        let Some(file) = file else { continue };
        std::fs::read(file)
            .map_err(|e| Failure::usage(format!("--{flag}: cannot read {}: {e}", file.display())))?;
    }
    Ok(Some(FarmSource::new(address.to_string(), move || {
        let engine = NatsEngine::connect(&address, &access, writer, USUAL_PATIENCE);
        Ok(shown_farm(&Arc::new(engine.map_err(|error| without_files(error, &access))?)))
    })))
}

/// An error without the paths of this machine's files, for viewers.
fn without_files(error: EngineError, access: &FarmAccess) -> EngineError {
    let EngineError::Server { server, reason } = error else { return error };
    let mut words = reason.to_string();
    for (flag, file) in [("credentials", &access.credentials), ("certificates", &access.certificates)] {
        if let Some(file) = file {
            words = words.replace(&format!(" {}: ", file.display()), &format!(" of --{flag}: "));
        }
    }
    EngineError::Server { server, reason: words.into() }
}

/// Who connects to a farm, as the flags say.
fn access_of(matches: &ArgMatches) -> Result<FarmAccess, Failure> {
    let key = path_of(matches, "farm-key").map(|file| {
        let secret = std::fs::read_to_string(&file)
            .map_err(|e| Failure::usage(format!("--farm-key: cannot read {}: {e}", file.display())))?;
        match secret.trim().is_empty() {
            true => Err(Failure::usage(format!("--farm-key: {} is empty", file.display()))),
            false => Ok(FarmKey::of(&secret)),
        }
    });
    Ok(FarmAccess {
        credentials: path_of(matches, "credentials"),
        certificates: path_of(matches, "certificates"),
        key: key.transpose()?,
    })
}

/// Reaches the farm of the flags and its artefacts; `None` where there is none.
pub fn reach(matches: &ArgMatches, writer: &str) -> Result<Option<ReachedFarm>, Failure> {
    let Some(engine) = connect(matches, writer)? else { return Ok(None) };
    let store: Arc<dyn ArtefactStore> = match matches.get_one::<String>("artefacts") {
        Some(store) => Arc::new(ObjectArtefacts::open(store)?),
        None => Arc::new(engine.artefacts()?),
    };
    Ok(Some(ReachedFarm { engine, artefacts: ArtefactSession::new(store) }))
}

/// A farm as `status`, `top` and `/metrics` show it.
pub fn shown(engine: &Arc<NatsEngine>) -> MonitorTarget {
    MonitorTarget::Farm(shown_farm(engine))
}

/// A farm as the page shows it, under its address.
pub fn shown_farm(engine: &Arc<NatsEngine>) -> FarmTarget {
    FarmTarget::new(engine.address().to_string(), engine.clone())
}

/// What a command shows: the farm of `--farm`, or the folder of a run or a batch.
pub fn target(matches: &ArgMatches) -> Result<MonitorTarget, Failure> {
    match connect(matches, "status")? {
        Some(engine) => Ok(shown(&engine)),
        None => Ok(MonitorTarget::at(&path_of(matches, "run").expect("clap requires it or --farm"))?),
    }
}

/// Adds what a command shows: a run folder, or `--farm`.
pub fn target_args(command: Command) -> Command {
    engine_args(
        command.arg(args::run().required(false).required_unless_present("farm").conflicts_with("farm")),
        "Show this farm: nats://HOST:PORT/NAME",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viewers_of_a_farm_read_no_path_of_this_machine() {
        let file = std::path::PathBuf::from("/home/me/night.creds");
        let reason = format!("cannot read the credentials {}: permission denied", file.display());
        let error = EngineError::Server { server: "nats://queue/night".into(), reason: reason.into() };
        let access = FarmAccess { credentials: Some(file), certificates: None, key: None };
        let words = without_files(error, &access).to_string();
        assert_eq!(
            words,
            "nats://queue/night: cannot read the credentials of --credentials: permission denied"
        );
    }
}
