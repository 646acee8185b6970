//! The view by HTTP: `/metrics`, `/livez`, `/readyz`, `/api/v1/status`.

use std::fmt::Write as _;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use segwild_flow::lock;
use tokio::sync::oneshot;

use crate::connections::{ConnectionLimits, answer};
use crate::metrics;
use crate::ready::ready;
use crate::view::{MonitorTarget, MonitorView, Runs, ViewError};

/// Why nothing is served.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// The server's thread cannot be started.
    #[error("cannot start the HTTP server: {0}")]
    Start(std::io::Error),
}

/// What a server shows.
#[derive(Clone, Debug)]
pub enum MonitorSource {
    /// A folder, which may not be there yet.
    Folder(PathBuf),
    /// What is known already.
    Target(MonitorTarget),
}

impl From<PathBuf> for MonitorSource {
    fn from(folder: PathBuf) -> Self {
        Self::Folder(folder)
    }
}

impl From<MonitorTarget> for MonitorSource {
    fn from(target: MonitorTarget) -> Self {
        Self::Target(target)
    }
}

/// How a server answers.
struct Served {
    source: MonitorSource,
    per_scene: bool,
    /// The runs as the requests before read them.
    runs: Mutex<Runs>,
}

impl Served {
    /// A folder is searched at every request.
    fn view(&self) -> Result<MonitorView, ViewError> {
        // A panic elsewhere leaves views that are whole.
        let mut runs = lock(&self.runs);
        match &self.source {
            MonitorSource::Folder(folder) => MonitorTarget::at(folder)?.read(&mut runs),
            MonitorSource::Target(target) => target.read(&mut runs),
        }
    }
}

/// A running server; dropping it ends it.
pub struct Server {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Where it listens; the port that was chosen when 0 was requested.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // A server that panicked has written that to stderr already.
            let _ = thread.join();
        }
    }
}

/// Serves the view of a run, a batch or a farm on a thread of its own. With `per_scene`, the metrics of a batch
/// carry the scene's name: one time series per scene, which many scenes make many of.
///
/// # Errors
/// When the address cannot be listened on.
pub fn serve(
    address: SocketAddr,
    source: impl Into<MonitorSource>,
    per_scene: bool,
) -> Result<Server, ServeError> {
    let source = source.into();
    let routes = Router::new()
        .route("/", get(index))
        .route("/livez", get(async || "ok\n"))
        .route("/metrics", get(metrics_text))
        .route("/readyz", get(readiness))
        .route("/api/v1/status", get(status))
        .with_state(Arc::new(Served { source, per_scene, runs: Mutex::default() }));
    // Reading a ledger is short, and few requests come at once.
    start(address, ConnectionLimits::ONE_REQUEST, 2, |_| routes)
}

/// Listens on an address and answers on a thread of its own, with so many threads for what blocks. `routes` are made once the
/// port is known.
///
/// # Errors
/// When the address cannot be listened on.
pub fn start(
    address: SocketAddr,
    limits: ConnectionLimits,
    threads: usize,
    routes: impl FnOnce(SocketAddr) -> Router,
) -> Result<Server, ServeError> {
    let listener = std::net::TcpListener::bind(address)
        .and_then(|listener| listener.set_nonblocking(true).map(|()| listener))
        .map_err(|source| ServeError::Listen { address, source })?;
    let address = listener.local_addr().map_err(ServeError::Start)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(threads)
        .build()
        .map_err(ServeError::Start)?;
    let (stop, stopped) = oneshot::channel::<()>();
    let routes = routes(address);
    let body = move || {
        runtime.block_on(async {
            let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
            // Open connections are not waited for: the work is over.
            tokio::select! {
                () = answer(listener, routes, limits) => {}
                _ = stopped => {}
            }
        });
        runtime.shutdown_background();
    };
    let thread = std::thread::Builder::new().name("http".into()).spawn(body).map_err(ServeError::Start)?;
    Ok(Server { address, stop: Some(stop), thread: Some(thread) })
}

async fn index() -> Response {
    let page = "segwild\n\n/metrics         for Prometheus\n/livez           the process answers\n\
                /readyz          each check, and whether it holds\n/api/v1/status   everything, as JSON\n";
    page.into_response()
}

/// The view, read off the server's own thread.
async fn read<T: Send + 'static>(
    served: Arc<Served>,
    show: impl FnOnce(Result<&MonitorView, &ViewError>, &Served) -> T + Send + 'static,
) -> Result<T, Response> {
    let seen = tokio::task::spawn_blocking(move || {
        let view = served.view();
        show(view.as_ref(), &served)
    });
    seen.await
        .map_err(|_| (StatusCode::INTERNAL_SERVER_ERROR, "the view could not be made\n").into_response())
}

async fn metrics_text(State(served): State<Arc<Served>>) -> Result<Response, Response> {
    let text = read(served, |view, served| metrics::render(view.ok(), served.per_scene)).await?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
}

async fn readiness(State(served): State<Arc<Served>>) -> Result<Response, Response> {
    let checks = read(served, |view, _| ready(view)).await?;
    let mut text = String::new();
    for check in &checks {
        let _ = writeln!(text, "[{}] {}: {}", if check.ok { '+' } else { '-' }, check.name, check.says);
    }
    let code = if checks.iter().all(|c| c.ok) { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    Ok((code, text).into_response())
}

async fn status(State(served): State<Arc<Served>>) -> Result<Response, Response> {
    let json = |view: Result<&MonitorView, &ViewError>, _: &Served| match view {
        Ok(view) => (StatusCode::OK, serde_json::to_string(view).unwrap_or_default()),
        Err(error) => {
            (StatusCode::SERVICE_UNAVAILABLE, serde_json::json!({ "error": error.to_string() }).to_string())
        }
    };
    let (code, text) = read(served, json).await?;
    Ok((code, [(header::CONTENT_TYPE, "application/json")], text).into_response())
}
