//! Who may ask, and how often: requests with the token, to this host, from this page.
//!
//! The address that `segwild serve` prints carries the token. The first request with it gets a cookie, so that the address bar and
//! the browser's history lose it. Programs send it as `Authorization: Bearer`, those that speak gRPC as well.

use crate::rates::{AdmittedClient, RatedClient, RequestCost, RequestRates};
use crate::{grpc, routes};
use axum::extract::{ConnectInfo, Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use segwild_proto::Token;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What the browser may load and do: nothing from elsewhere, no script in the page itself.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// What requests are checked against.
pub(crate) struct Guard {
    pub token: Token,
    pub address: SocketAddr,
    /// Whether it listens on the loopback address: a name that leads here from elsewhere is refused then.
    pub loopback: bool,
    /// What each client has left of its requests.
    pub rates: Arc<RequestRates>,
}

/// What a request gets that may pass.
enum Admission {
    /// The address has the token: a cookie with it, and the address without it.
    Welcome,
    /// Its answer.
    Answer,
}

/// Why a request is refused.
type RefusedAccess = (StatusCode, &'static str);

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

    /// Whether a request may pass.
    fn checked(&self, request: &Request) -> Result<Admission, RefusedAccess> {
        let (headers, host) = (request.headers(), host_of(request));
        if !self.is_own_host(host) {
            return Err((StatusCode::FORBIDDEN, "this server answers to its own address only"));
        }
        if !self.is_own_origin(headers, host) {
            return Err((StatusCode::FORBIDDEN, "the request comes from another page"));
        }
        if request.method() == Method::GET
            && let Some(token) = token_of(request.uri())
        {
            let other = "the token is another one: use the address that `segwild serve` printed";
            return match self.token.is(token) {
                true => Ok(Admission::Welcome),
                false => Err((StatusCode::UNAUTHORIZED, other)),
            };
        }
        if !self.knows(headers) {
            let none = "open the address that `segwild serve` printed: it has the token";
            return Err((StatusCode::UNAUTHORIZED, none));
        }
        Ok(Admission::Answer)
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
fn refused(call: bool, code: StatusCode, why: &str) -> Response {
    if !call {
        return (code, axum::Json(serde_json::json!({ "error": why }))).into_response();
    }
    let status = match code {
        StatusCode::UNAUTHORIZED => tonic::Status::unauthenticated(why),
        StatusCode::TOO_MANY_REQUESTS => tonic::Status::resource_exhausted(why),
        _ => tonic::Status::permission_denied(why),
    };
    let mut response: Response = status.into_http();
    *response.status_mut() = code;
    response
}

/// A refusal for a time: the same request is answered later.
fn too_many(call: bool, wait: Duration) -> Response {
    let seconds = wait.as_secs_f64().ceil().max(1.0) as u64;
    let why = format!("too many requests in a short time: send this one again in {seconds} s");
    let mut response = refused(call, StatusCode::TOO_MANY_REQUESTS, &why);
    response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    response
}

/// What a request of a path costs, whether it comes as JSON or as gRPC.
fn cost_of(path: &str) -> RequestCost {
    grpc::call_of(path).or_else(|| routes::call_of(path)).map_or(RequestCost::LEAST, RequestCost::of)
}

/// The address that a request comes from.
fn client_of(request: &Request) -> IpAddr {
    let connection = request.extensions().get::<ConnectInfo<SocketAddr>>();
    connection.map_or(Ipv4Addr::UNSPECIFIED.into(), |ConnectInfo(client)| client.ip())
}

/// Lets a request pass, or refuses it; adds the headers that keep the page to itself.
pub(crate) async fn guard(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let mut response = answer(&guard, request, next).await;
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

async fn answer(guard: &Guard, mut request: Request, next: Next) -> Response {
    let call = is_call(request.headers());
    let checked = guard.checked(&request);
    // The right token passes however many wrong ones come from the same address: nobody locks others out of their own machine. A
    // token has too many bits to be found by trying.
    let client = RatedClient::of(client_of(&request), checked.is_ok());
    let cost = if checked.is_ok() { cost_of(request.uri().path()) } else { RequestCost::LEAST };
    if let Err(wait) = guard.rates.admit(client, cost, Instant::now()) {
        return too_many(call, wait);
    }
    match checked {
        Ok(Admission::Answer) => {
            request.extensions_mut().insert(AdmittedClient { rates: guard.rates.clone(), client });
            next.run(request).await
        }
        Ok(Admission::Welcome) => {
            let cookie =
                format!("{}={}; HttpOnly; SameSite=Strict; Path=/", guard.cookie(), guard.token.text());
            let to = request.uri().path().to_owned();
            (StatusCode::SEE_OTHER, [(header::SET_COOKIE, cookie), (header::LOCATION, to)]).into_response()
        }
        Err((code, why)) => refused(call, code, why),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_click_costs_more_than_a_candidate_by_either_form() {
        let of_run = |path: &str| cost_of(&format!("/api/v1/runs/a/{path}"));
        let click = RequestCost::of("Act");
        assert_eq!((of_run("act"), cost_of("/segwild.v1.Session/Act")), (click, click));
        assert_eq!((of_run("hover"), cost_of("/page/main.js")), (RequestCost::LEAST, RequestCost::LEAST));
        assert!(click != RequestCost::LEAST && of_run("objects/1/ply") != click);
    }

    #[test]
    fn a_client_that_asks_too_often_reads_how_long_to_wait() {
        let response = too_many(false, Duration::from_millis(1200));
        assert_eq!(response.status(), StatusCode::TOO_MANY_REQUESTS);
        assert_eq!(response.headers()[header::RETRY_AFTER], "2");
        let call = too_many(true, Duration::from_millis(1));
        assert_eq!(
            (call.status().as_u16(), &call.headers()[header::RETRY_AFTER]),
            (429, &HeaderValue::from(1u64))
        );
        let status = tonic::Status::from_header_map(call.headers()).expect("a status of gRPC");
        assert_eq!(status.code(), tonic::Code::ResourceExhausted);
        assert!(status.message().contains("again in 1 s"), "{status}");
    }
}
