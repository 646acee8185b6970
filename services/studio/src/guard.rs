//! Who may ask: requests with the token, to this host, from this page.
//!
//! The address that `segwild serve` prints carries the token. The first request with it gets a cookie, so that the address bar and
//! the browser's history lose it. Programs send it as `Authorization: Bearer`, those that speak gRPC as well.

use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use segwild_proto::Token;
use std::net::SocketAddr;
use std::sync::Arc;

/// What the browser may load and do: nothing from elsewhere, no script in the page itself.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// What requests are checked against.
pub(crate) struct Guard {
    pub token: Token,
    pub address: SocketAddr,
    /// Whether it listens on the loopback address: a name that leads here from elsewhere is refused then.
    pub loopback: bool,
}

impl Guard {
    /// Cookies are shared by all ports of a host: each server has its own.
    fn cookie(&self) -> String {
        format!("segwild-{}", self.address.port())
    }

    fn knows(&self, headers: &HeaderMap) -> bool {
        let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
        let bearer = text(header::AUTHORIZATION).and_then(|value| value.strip_prefix("Bearer "));
        if bearer.is_some_and(|token| self.token.is(token)) {
            return true;
        }
        let name = self.cookie();
        let cookies = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
        cookies.flat_map(|value| value.split(';')).any(|cookie| {
            cookie.trim().split_once('=').is_some_and(|(key, value)| key == name && self.token.is(value))
        })
    }

    /// Whether the request names this host: a page elsewhere can make its own name lead to the loopback address.
    fn is_own_host(&self, host: &str) -> bool {
        if !self.loopback {
            return true;
        }
        let port = self.address.port();
        ["127.0.0.1", "localhost", "[::1]"].iter().any(|name| host == format!("{name}:{port}"))
    }

    /// Whether a request comes from a page of this server, or from no page at all.
    fn is_own_origin(&self, headers: &HeaderMap, host: &str) -> bool {
        match headers.get(header::ORIGIN).map(|origin| origin.to_str()) {
            None => true,
            Some(Ok(origin)) => origin.split_once("://").is_some_and(|(_, rest)| rest == host),
            Some(Err(_)) => false,
        }
    }
}

/// The token in a query, if there is one.
fn token_of(uri: &Uri) -> Option<&str> {
    uri.query()?.split('&').find_map(|pair| pair.strip_prefix("token="))
}

/// The host that a request names: in a header, and by HTTP/2 in its address.
fn host_of(request: &Request) -> &str {
    let header = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    let address = || request.uri().authority().map(Authority::as_str);
    header.or_else(address).unwrap_or_default()
}

/// Whether a request is a call of gRPC.
fn is_call(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
    kind.is_some_and(|kind| kind.starts_with("application/grpc"))
}

/// A refusal, in the form that the client reads.
fn refused(call: bool, code: StatusCode, why: &'static str) -> Response {
    if !call {
        return (code, axum::Json(serde_json::json!({ "error": why }))).into_response();
    }
    let status = match code {
        StatusCode::UNAUTHORIZED => tonic::Status::unauthenticated(why),
        _ => tonic::Status::permission_denied(why),
    };
    let mut response: Response = status.into_http();
    *response.status_mut() = code;
    response
}

/// Lets a request pass, or refuses it; adds the headers that keep the page to itself.
pub(crate) async fn guard(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let mut response = checked(&guard, request, next).await;
    let headers = response.headers_mut();
    let fixed = [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_FRAME_OPTIONS, "DENY"),
    ];
    for (name, value) in fixed {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    response
}

async fn checked(guard: &Guard, request: Request, next: Next) -> Response {
    let (headers, host) = (request.headers(), host_of(&request));
    let refused = |code, why| refused(is_call(headers), code, why);
    if !guard.is_own_host(host) {
        return refused(StatusCode::FORBIDDEN, "this server answers to its own address only");
    }
    if !guard.is_own_origin(headers, host) {
        return refused(StatusCode::FORBIDDEN, "the request comes from another page");
    }
    if request.method() == Method::GET
        && let Some(token) = token_of(request.uri())
    {
        if !guard.token.is(token) {
            return refused(
                StatusCode::UNAUTHORIZED,
                "the token is another one: use the address that `segwild serve` printed",
            );
        }
        let cookie = format!("{}={}; HttpOnly; SameSite=Strict; Path=/", guard.cookie(), guard.token.text());
        let to = request.uri().path().to_owned();
        return (StatusCode::SEE_OTHER, [(header::SET_COOKIE, cookie), (header::LOCATION, to)])
            .into_response();
    }
    if !guard.knows(headers) {
        return refused(
            StatusCode::UNAUTHORIZED,
            "open the address that `segwild serve` printed: it has the token",
        );
    }
    next.run(request).await
}
