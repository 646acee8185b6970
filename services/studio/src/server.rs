//! The server: listens, guards, answers.

use crate::guard::{Guard, Token, guard};
use crate::routes::routes;
use crate::runs::ServedRuns;
use axum::extract::DefaultBodyLimit;
use axum::middleware::from_fn_with_state;
use segwild_monitor::connections::{ConnectionLimits, answer};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use tokio::sync::oneshot;

/// Bytes of a request's body at most.
const MOST_BODY: usize = 1 << 20;

/// Threads that answer at a time.
const THREADS: usize = 8;

/// Connections of all viewers together.
const CONNECTIONS: ConnectionLimits = ConnectionLimits { most: 256, whole_time: None, keep_alive: true };

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
}

impl Default for ServeOptions {
    fn default() -> Self {
        ServeOptions {
            address: (Ipv4Addr::LOCALHOST, 0).into(),
            token: None,
            memory_budget: MEMORY_BUDGET,
            program: None,
        }
    }
}

/// Why nothing is served.
#[derive(Debug, thiserror::Error)]
pub enum StudioServeError {
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
    /// No thread or no secret can be had.
    #[error("cannot start the server: {0}")]
    Start(std::io::Error),
}

/// A running server; dropping it ends it.
pub struct StudioServer {
    address: SocketAddr,
    token: Token,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl StudioServer {
    /// The address of the page, with the token.
    pub fn address(&self) -> String {
        format!("http://{}/?token={}", self.address, self.token.text())
    }

    /// Where it listens.
    pub fn socket(&self) -> SocketAddr {
        self.address
    }

    /// The token.
    pub fn token(&self) -> &Token {
        &self.token
    }

    /// Waits until the server ends.
    pub fn wait(mut self) {
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Drop for StudioServer {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // A server that panicked has written that to stderr already.
            let _ = thread.join();
        }
    }
}

/// Serves a run, or the runs of a folder, on threads of its own.
///
/// # Errors
/// When the address cannot be listened on.
pub fn serve(folder: &Path, options: ServeOptions) -> Result<StudioServer, StudioServeError> {
    let ServeOptions { address, token, memory_budget, program } = options;
    let token = match token {
        Some(token) => token,
        None => Token::random().map_err(StudioServeError::Start)?,
    };
    let listener = std::net::TcpListener::bind(address)
        .and_then(|listener| listener.set_nonblocking(true).map(|()| listener))
        .map_err(|source| StudioServeError::Listen { address, source })?;
    let address = listener.local_addr().map_err(StudioServeError::Start)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(THREADS)
        .build()
        .map_err(StudioServeError::Start)?;
    let (stop, stopped) = oneshot::channel::<()>();
    let runs = Arc::new(ServedRuns::new(folder, memory_budget, program));
    runs.open_first();
    let guards = Arc::new(Guard { token: token.clone(), address, loopback: address.ip().is_loopback() });
    let routes =
        routes(runs).layer(DefaultBodyLimit::max(MOST_BODY)).layer(from_fn_with_state(guards, guard));
    let body = move || {
        runtime.block_on(async {
            let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
            tokio::select! {
                () = answer(listener, routes, CONNECTIONS) => {}
                _ = stopped => {}
            }
        });
        runtime.shutdown_background();
    };
    let thread =
        std::thread::Builder::new().name("studio".into()).spawn(body).map_err(StudioServeError::Start)?;
    Ok(StudioServer { address, token, stop: Some(stop), thread: Some(thread) })
}
