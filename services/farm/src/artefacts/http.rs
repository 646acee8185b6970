//! The HTTP client of an object store: hyper, and rustls with the system's certificates.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use http_body_util::BodyExt;
use hyper_rustls::{HttpsConnector, HttpsConnectorBuilder};
use hyper_util::client::legacy::Client;
use hyper_util::client::legacy::connect::{Connect, HttpConnector as Tcp};
use hyper_util::rt::{TokioExecutor, TokioTimer};
use object_store::ClientOptions;
use object_store::client::{
    HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpRequestBody, HttpResponse,
    HttpResponseBody, HttpService,
};

/// A connection is given up after so long.
const CONNECT: Duration = Duration::from_secs(10);
/// An answer is given up after so long. A part of a large file is sent within it.
const ANSWER: Duration = Duration::from_secs(120);

/// Makes the client.
#[derive(Debug)]
pub(super) struct HyperConnector {
    /// Whether the endpoint is plain HTTP; then no certificates are needed.
    pub plain: bool,
}

impl HttpConnector for HyperConnector {
    fn connect(&self, _: &ClientOptions) -> object_store::Result<HttpClient> {
        let mut tcp = Tcp::new();
        tcp.enforce_http(self.plain);
        tcp.set_nodelay(true);
        tcp.set_connect_timeout(Some(CONNECT));
        if self.plain {
            return Ok(client(tcp));
        }
        let tls = encrypted(tcp).map_err(|source| object_store::Error::Generic {
            store: "S3",
            source: NoCertificates(source).into(),
        })?;
        Ok(client(tls))
    }
}

/// Without certificates there is no HTTPS.
#[derive(Debug, thiserror::Error)]
#[error("the system's certificates cannot be read: {0}")]
struct NoCertificates(#[source] io::Error);

fn encrypted(tcp: Tcp) -> io::Result<HttpsConnector<Tcp>> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = HttpsConnectorBuilder::new().with_provider_and_native_roots(provider)?;
    Ok(builder.https_only().enable_http1().wrap_connector(tcp))
}

fn client<C: Connect + Clone + Send + Sync + 'static>(connector: C) -> HttpClient {
    let client = Client::builder(TokioExecutor::new())
        .pool_timer(TokioTimer::new())
        .pool_idle_timeout(Duration::from_secs(30))
        .build(connector);
    HttpClient::new(Hyper(client))
}

struct Hyper<C>(Client<C, HttpRequestBody>);

impl<C> std::fmt::Debug for Hyper<C> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Hyper")
    }
}

#[async_trait]
impl<C: Connect + Clone + Send + Sync + 'static> HttpService for Hyper<C> {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        let answer = tokio::time::timeout(ANSWER, self.0.request(request)).await;
        let answer = answer.map_err(|late| HttpError::new(HttpErrorKind::Timeout, late))?;
        let answer = answer.map_err(|error| {
            let kind = if error.is_connect() { HttpErrorKind::Connect } else { HttpErrorKind::Request };
            HttpError::new(kind, error)
        })?;
        let body = |body: hyper::body::Incoming| {
            HttpResponseBody::new(body.map_err(|e| HttpError::new(HttpErrorKind::Interrupted, e)))
        };
        Ok(answer.map(body))
    }
}
