//! The connections of an HTTP server: a bounded number at a time, none for long without a request.
//!
//! The server shares its file descriptors with a run or a batch, which fails without them. So however many clients
//! connect, and whatever they send or leave out, it holds at most [`ConnectionLimits::most`] sockets and one that is being
//! admitted.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::extract::ConnectInfo;
use axum::http::{HeaderValue, Request, StatusCode, header};
use axum::response::Response;
use hyper::body::Incoming;
use hyper::server::conn::{http1, http2};
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::AbortHandle;

use crate::slow::{AnswerExecutor, CountedBody, OpenRequest, TimedBody, TimedStream, idle};

/// What a server allows its clients.
#[derive(Clone, Copy, Debug)]
pub struct ConnectionLimits {
    /// Connections at a time. A further one takes the slot of the oldest that has sent no whole request yet.
    pub most: usize,
    /// A connection ends after this time, whatever it waits for.
    pub whole_time: Option<Duration>,
    /// Whether a connection may send further requests.
    pub keep_alive: bool,
    /// Whether a connection may start with HTTP/2, as clients of gRPC do. It may then send further requests.
    pub http2: bool,
}

impl ConnectionLimits {
    /// For clients that ask once, such as Prometheus.
    pub const ONE_REQUEST: ConnectionLimits = ConnectionLimits {
        most: MOST,
        whole_time: Some(Duration::from_secs(20)),
        keep_alive: false,
        http2: false,
    };
}

/// Connections at a time of a server for operators.
pub const MOST: usize = 32;
/// A request's head must be there after this time.
pub const HEAD_TIME: Duration = Duration::from_secs(5);
/// A request's head may have so many bytes.
pub const HEAD_BYTES: usize = 16 << 10;
/// A request's body must be there after this time: a mebibyte over a slow line takes as long.
const BODY_TIME: Duration = Duration::from_secs(20);
/// A client whose connection takes no bytes for so long is dropped, also one that follows events. By HTTP/2 an answer
/// of which its client takes nothing for so long is given up as well, whatever it reads of others.
const WRITE_TIME: Duration = Duration::from_secs(30);
/// A connection by HTTP/2 without a request ends after this time; clients connect again by themselves. One by HTTP/1 has
/// [`HEAD_TIME`] for its next request.
const IDLE_TIME: Duration = Duration::from_secs(300);
/// Requests of one connection by HTTP/2 that are answered at a time.
const MOST_STREAMS: u32 = 64;
/// How every connection by HTTP/2 starts, and none by HTTP/1.
const HTTP2_START: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Time between two checks whether more of a connection's start is there.
const START_CHECK: Duration = Duration::from_millis(10);
/// Time between two signs of life on a connection by HTTP/2: one without an answer is closed.
const SIGN_OF_LIFE: Duration = Duration::from_secs(20);
/// Rest after the system refused a connection: it has no descriptor or no memory left.
const REST: Duration = Duration::from_millis(100);

/// Accepts connections and answers them, until it is dropped. Nothing that a client does or the system refuses ends it.
pub async fn answer(listener: TcpListener, routes: Router, limits: ConnectionLimits) {
    let free_connections = Arc::new(Semaphore::new(limits.most));
    let mut open = OpenConnections::default();
    loop {
        let (stream, client) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                if !ended_early(&error) {
                    open.end_a_silent_one();
                    tokio::time::sleep(REST).await;
                }
                continue;
            }
        };
        if free_connections.available_permits() == 0 {
            // Requests that have arrived are read first: in a crowd, only silent ones lose their slot.
            tokio::task::yield_now().await;
            if free_connections.available_permits() == 0 && !open.end_a_silent_one() {
                // All of them are being answered; this one may come again.
                continue;
            }
        }
        // The slot of a connection is free once its socket is closed.
        let Ok(permit) = free_connections.clone().acquire_owned().await else { return };
        let received = Arc::new(AtomicBool::new(false));
        let work = requests(stream, client, routes.clone(), received.clone(), limits);
        let task = tokio::spawn(async move {
            // A client that is too slow, or that has gone, has nobody to answer.
            let _ = match limits.whole_time {
                Some(time) => tokio::time::timeout(time, work).await.unwrap_or(Ok(())),
                None => work.await,
            };
            drop(permit);
        });
        open.add(task.abort_handle(), received);
    }
}

/// Whether a client went away before it was accepted: the next one may be accepted at once.
fn ended_early(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset, Interrupted};
    matches!(error.kind(), ConnectionAborted | ConnectionRefused | ConnectionReset | Interrupted)
}

/// Answers a connection's requests, in the protocol that it starts with.
async fn requests(
    stream: TcpStream,
    client: SocketAddr,
    routes: Router,
    received: Arc<AtomicBool>,
    limits: ConnectionLimits,
) -> hyper::Result<()> {
    if !limits.http2 {
        return by_http1(stream, client, routes, received, limits.keep_alive).await;
    }
    match tokio::time::timeout(HEAD_TIME, starts_with_http2(&stream)).await {
        Ok(Ok(true)) => by_http2(stream, client, routes, received).await,
        Ok(Ok(false)) => by_http1(stream, client, routes, received, limits.keep_alive).await,
        // Nothing came in time, or the client has gone.
        Ok(Err(_)) | Err(_) => Ok(()),
    }
}

/// Whether a connection starts with HTTP/2. What it has sent stays to be read.
async fn starts_with_http2(stream: &TcpStream) -> io::Result<bool> {
    let mut start = [0; HTTP2_START.len()];
    loop {
        let n = stream.peek(&mut start).await?;
        if n == 0 || n == start.len() || !HTTP2_START.starts_with(&start[..n]) {
            return Ok(start[..n] == *HTTP2_START);
        }
        tokio::time::sleep(START_CHECK).await;
    }
}

/// A request that knows its client's address ([`ConnectInfo`]), and whose body has to come in time.
fn bounded(mut request: Request<Incoming>, client: SocketAddr) -> Request<TimedBody<Incoming>> {
    request.extensions_mut().insert(ConnectInfo(client));
    request.map(|body| TimedBody::new(body, BODY_TIME))
}

/// Whether an answer refuses its client, or its client's haste.
fn refuses(answer: &Response) -> bool {
    [StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN, StatusCode::TOO_MANY_REQUESTS]
        .contains(&answer.status())
}

/// Answers a request. `received` is whether its connection is no silent one: it is none while a request is being answered, nor once
/// one was not refused.
async fn answered(
    routes: TowerToHyperService<Router>,
    request: Request<Incoming>,
    client: SocketAddr,
    received: Arc<AtomicBool>,
) -> Result<Response, Infallible> {
    let answered_before = received.swap(true, Ordering::Relaxed);
    let answer = routes.call(bounded(request, client)).await;
    if !answered_before && answer.as_ref().is_ok_and(refuses) {
        received.store(false, Ordering::Relaxed);
    }
    answer
}

/// Answers requests by HTTP/1. Without keep-alive nobody holds a connection between two. A refusal ends its connection: with
/// one request every few seconds a client without access would never be silent.
async fn by_http1(
    stream: TcpStream,
    client: SocketAddr,
    routes: Router,
    received: Arc<AtomicBool>,
    keep_alive: bool,
) -> hyper::Result<()> {
    let routes = TowerToHyperService::new(routes);
    let service = service_fn(move |request: Request<Incoming>| {
        let answer = answered(routes.clone(), request, client, received.clone());
        async move {
            answer.await.map(|mut response| {
                if refuses(&response) {
                    response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
                }
                response
            })
        }
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIME)
        .max_buf_size(HEAD_BYTES)
        .keep_alive(keep_alive)
        // A client that sent its request and closed its side is still answered.
        .half_close(true)
        .serve_connection(TokioIo::new(TimedStream::new(stream, WRITE_TIME)), service)
        .await
}

/// Answers requests by HTTP/2. An idle connection lasts for minutes, so one whose requests were all refused counts as silent: it
/// loses its slot in a crowd.
async fn by_http2(
    stream: TcpStream,
    client: SocketAddr,
    routes: Router,
    received: Arc<AtomicBool>,
) -> hyper::Result<()> {
    let routes = TowerToHyperService::new(routes);
    let (open, requests) = watch::channel(0);
    let open = Arc::new(open);
    let service = service_fn(move |request: Request<Incoming>| {
        let answer = answered(routes.clone(), request, client, received.clone());
        let request = OpenRequest::new(&open);
        async move { answer.await.map(|response| response.map(|body| CountedBody::new(body, request))) }
    });
    let connection = http2::Builder::new(AnswerExecutor::new(WRITE_TIME))
        .timer(TokioTimer::new())
        .keep_alive_interval(SIGN_OF_LIFE)
        .keep_alive_timeout(SIGN_OF_LIFE)
        .max_concurrent_streams(MOST_STREAMS)
        .max_header_list_size(HEAD_BYTES as u32)
        .serve_connection(TokioIo::new(TimedStream::new(stream, WRITE_TIME)), service);
    let mut connection = pin!(connection);
    tokio::select! {
        ended = connection.as_mut() => return ended,
        () = idle(requests, IDLE_TIME) => connection.as_mut().graceful_shutdown(),
    }
    // What is left of the last answers is not waited for without end.
    tokio::time::timeout(WRITE_TIME, connection).await.unwrap_or(Ok(()))
}

/// The connections that are open, the oldest first: each with whether its request came.
#[derive(Default)]
struct OpenConnections(VecDeque<(AbortHandle, Arc<AtomicBool>)>);

impl OpenConnections {
    fn add(&mut self, task: AbortHandle, received: Arc<AtomicBool>) {
        self.0.retain(|(task, _)| !task.is_finished());
        self.0.push_back((task, received));
    }

    /// Ends the oldest connection whose request is not there yet; returns whether there was one, or one has ended by itself.
    fn end_a_silent_one(&mut self) -> bool {
        let before = self.0.len();
        self.0.retain(|(task, _)| !task.is_finished());
        if self.0.len() < before {
            return true;
        }
        let silent = self.0.iter().position(|(_, received)| !received.load(Ordering::Relaxed));
        let Some((task, _)) = silent.and_then(|index| self.0.remove(index)) else { return false };
        task.abort();
        true
    }
}
