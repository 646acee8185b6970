//! `segwild vision`

use super::serve::token_for;
use crate::args::{self, examples, flag, number, with_fields};
use crate::exit;
use crate::failure::Failure;
use crate::output::print_line;
use crate::progress::first_ctrl_c;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_pipeline::{Code, Settings, SettingsError};
use segwild_vision::{Providers, ServiceIdentity, VisionServiceOptions, serve_vision};
use std::net::{Ipv4Addr, SocketAddr};

/// The usual port of the service.
const PORT: u16 = 50051;

/// The command's arguments.
pub fn command() -> Command {
    let serve = Command::new("serve").about("Serve this machine's 2D models to runs on other machines");
    // A service of services would only add a hop.
    let serve = with_fields(serve, "vision", |name| !name.starts_with("vision_") || name == "vision_memory")
        .arg(
            Arg::new("listen")
                .long("listen")
                .value_name("ADDR")
                .value_parser(value_parser!(SocketAddr))
                .help("Serve the models here [default: 127.0.0.1:50051]"),
        )
        .arg(args::token_file())
        .arg(
            args::path("tls-cert", "Certificate of the service (PEM): clients connect by grpcs://")
                .requires("tls-key"),
        )
        .arg(args::path("tls-key", "Private key of that certificate (PEM)").requires("tls-cert"))
        .arg(flag("insecure", "Listen to other machines without a token file: everybody is let in"))
        .arg(
            number("parallel", "1", "Calls that are computed at the same time")
                .value_parser(value_parser!(u16).range(1..=256)),
        )
        .arg(
            number("image-memory", "512", "MiB of photos that are kept for calls")
                .value_parser(value_parser!(u32).range(1..)),
        )
        .after_help(examples(
            "segwild vision serve --models models",
            "segwild vision serve --listen 0.0.0.0:50051 --token-file vision.token --parallel 2",
        ));
    Command::new("vision")
        .about("Models as a service for runs on other machines (`--vision-service`)")
        .subcommand_required(true)
        .arg_required_else_help(true)
        .subcommand(serve)
        .after_help(examples(
            "segwild vision serve --models models",
            "segwild run photos --out runs/trevi --masks grpc://gpu1:50051,grpc://gpu2:50051",
        ))
}

/// Serves models.
pub fn vision(matches: &ArgMatches) -> Result<(), Failure> {
    match matches.subcommand() {
        Some(("serve", matches)) => serve(matches),
        _ => unreachable!("clap requires it"),
    }
}

fn serve(matches: &ArgMatches) -> Result<(), Failure> {
    let flags = args::given(matches);
    let mut settings = Settings::default();
    for (name, value) in &flags {
        settings.set(name, value).map_err(SettingsError::from)?;
    }
    Code::given(&flags).tell(&mut settings.vision);
    settings.vision.vision_service.clear();
    let usual = SocketAddr::from((Ipv4Addr::LOCALHOST, PORT));
    let address = matches.get_one("listen").copied().unwrap_or(usual);
    let token = token_for(address, matches, "to let in everybody; what is sent is not encrypted")?;
    let parallel = usize::from(*matches.get_one::<u16>("parallel").expect("it has a default"));
    let memory = (*matches.get_one::<u32>("image-memory").expect("it has a default") as usize) << 20;
    let failed = |message: String| Failure { message, code: exit::INPUT };
    let tls = match (args::path_of(matches, "tls-cert"), args::path_of(matches, "tls-key")) {
        (Some(certificate), Some(key)) => {
            Some(ServiceIdentity::read(&certificate, &key).map_err(|e| failed(e.to_string()))?)
        }
        _ => None,
    };
    let scheme = if tls.is_some() { "grpcs" } else { "grpc" };
    let providers = Providers::from_settings(&settings.vision).map_err(|e| failed(e.to_string()))?;
    for note in &providers.notes {
        print_line(note)?;
    }
    // Clients ask again: nothing is lost by an end at any time.
    let stopped = first_ctrl_c()?;
    let options = VisionServiceOptions { address, token, memory, parallel, tls };
    let server = serve_vision(providers, options)
        .map_err(|e| failed(format!("the service cannot listen on {address}: {e}")))?;
    print_line(&format!("the service: {scheme}://{}", server.address()))?;
    // The sender lives as long as the process.
    let _ = stopped.recv();
    eprintln!("{} calls were computed", server.computed());
    Ok(())
}
