//! The server: listens, guards, answers.

use crate::farm::{FarmSource, ServedFarm};
use crate::grpc::session;
use crate::guard::{Guard, guard};
use crate::rates::RequestRates;
use crate::routes::routes;
use crate::runs::ServedRuns;
use axum::extract::DefaultBodyLimit;
use axum::middleware::from_fn_with_state;
use segwild_monitor::connections::ConnectionLimits;
use segwild_monitor::{ServeError, Server, start};
use segwild_pipeline::Code;
use segwild_proto::Token;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Bytes of a request's body or message at most.
const MOST_BODY: usize = 1 << 20;

/// Threads that answer at a time.
const THREADS: usize = 8;

/// Connections of all viewers together.
const CONNECTIONS: ConnectionLimits =
    ConnectionLimits { most: 256, whole_time: None, keep_alive: true, http2: true };

/// Bytes that open sessions may take by default.
const MEMORY_BUDGET: usize = 2 << 30;

/// How a server is started.
#[derive(Clone, Debug)]
pub struct ServeOptions {
    /// Where it listens; port 0 takes a free one.
    pub address: SocketAddr,
    /// The token; `None` makes one.
    pub token: Option<Token>,
    /// Bytes that open sessions may take together: those that were used longest ago are closed.
    pub memory_budget: usize,
    /// The `segwild` program, to train a run again without its corrected transients; `None` where nobody may.
    pub program: Option<PathBuf>,
    /// The networks and services that clicks use, where runs were made with some.
    pub code: Code,
    /// The photos of a run that is about to start: shown until it has read them.
    pub photos: Option<PathBuf>,
    /// A farm that operators see as well.
    pub farm: Option<FarmSource>,
}

impl Default for ServeOptions {
    fn default() -> Self {
        ServeOptions {
            address: (Ipv4Addr::LOCALHOST, 0).into(),
            token: None,
            memory_budget: MEMORY_BUDGET,
            program: None,
            code: Code::given(&[]),
            photos: None,
            farm: None,
        }
    }
}

/// A running server; dropping it ends it.
pub struct StudioServer {
    server: Server,
    token: Token,
}

impl StudioServer {
    /// The address of the page, with the token.
    pub fn address(&self) -> String {
        format!("http://{}/?token={}", self.socket(), self.token.text())
    }

    /// Where it listens.
    pub fn socket(&self) -> SocketAddr {
        self.server.address()
    }

    /// The token.
    pub fn token(&self) -> &Token {
        &self.token
    }
}

/// Serves a run, or the runs of a folder, on threads of its own.
///
/// # Errors
/// When the address cannot be listened on, or no secret can be had.
pub fn serve(folder: &Path, options: ServeOptions) -> Result<StudioServer, ServeError> {
    started(Some(folder), options)
}

/// Serves the view of a farm, without runs of this machine, on threads of its own.
///
/// # Errors
/// As [`serve`].
pub fn serve_farm(farm: impl Into<FarmSource>, options: ServeOptions) -> Result<StudioServer, ServeError> {
    started(None, ServeOptions { farm: Some(farm.into()), ..options })
}

fn started(folder: Option<&Path>, options: ServeOptions) -> Result<StudioServer, ServeError> {
    let ServeOptions { address, token, memory_budget, program, code, photos, farm } = options;
    let token = token.map_or_else(Token::random, Ok).map_err(ServeError::Start)?;
    let server = start(address, CONNECTIONS, THREADS, |address| {
        let farm = farm.map(ServedFarm::new);
        let runs = Arc::new(ServedRuns::new(folder, farm, memory_budget, program, code, photos));
        runs.open_first();
        let loopback = address.ip().is_loopback();
        let rates = Arc::new(RequestRates::default());
        let guards = Guard { token: token.clone(), address, loopback, rates };
        let (calls, service) = session(runs.clone(), MOST_BODY);
        routes(runs)
            .route_service(&calls, service)
            .layer(DefaultBodyLimit::max(MOST_BODY))
            .layer(from_fn_with_state(Arc::new(guards), guard))
    })?;
    Ok(StudioServer { server, token })
}
