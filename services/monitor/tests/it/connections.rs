//! Clients that only connect, that send a byte at a time, too much, or half of it: the server answers the others, and holds
//! few sockets for a short time.

use axum::Router;
use axum::http::StatusCode;
use axum::routing::get;
use segwild_monitor::connections::{ConnectionLimits, HEAD_BYTES, HEAD_TIME, MOST};
use segwild_monitor::{Server, serve, start};
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::mpsc;
use std::time::{Duration, Instant};

fn server() -> (tempfile::TempDir, Server) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = "127.0.0.1:0".parse().expect("an address");
    let server = serve(at, dir.path().join("run"), false).expect("it listens");
    (dir, server)
}

fn connect(at: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(at).expect("it listens");
    // Longer than anything may take: a test that would wait for ever fails.
    stream.set_read_timeout(Some(HEAD_TIME * 3)).expect("a time");
    stream
}

/// What it answers until it closes; a reset is an end as well.
fn answer(stream: &mut TcpStream) -> String {
    let mut bytes = Vec::new();
    if let Err(error) = stream.read_to_end(&mut bytes) {
        assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "it neither answers nor closes");
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn livez(at: SocketAddr) -> String {
    let mut stream = connect(at);
    match stream.write_all(b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n") {
        Ok(()) => answer(&mut stream),
        Err(_) => String::new(),
    }
}

fn is_alive(at: SocketAddr) {
    let began = Instant::now();
    // Amid a crowd a connection may lose its slot before this thread has sent its request: a client asks again.
    let response = (0..3).map(|_| livez(at)).find(|response| !response.is_empty()).unwrap_or_default();
    assert!(response.starts_with("HTTP/1.1 200") && response.ends_with("ok\n"), "{response}");
    assert!(began.elapsed() < HEAD_TIME, "it answered after {:?}", began.elapsed());
}

/// Sockets of this process, clients' and server's.
#[cfg(target_os = "linux")]
fn sockets() -> usize {
    let open = std::fs::read_dir("/proc/self/fd").expect("the system tells").flatten();
    let is_socket = |path: std::path::PathBuf| {
        std::fs::read_link(path).is_ok_and(|to| to.to_string_lossy().starts_with("socket:"))
    };
    open.filter(|entry| is_socket(entry.path())).count()
}

#[cfg(target_os = "linux")]
#[test]
fn idle_connections_without_end_take_few_sockets_and_hold_nobody_up() {
    let (_dir, server) = server();
    let at = server.address();
    let idle: Vec<TcpStream> = (0..300).map(|_| connect(at)).collect();
    is_alive(at);
    // Other tests of this process have some as well.
    let held = sockets().saturating_sub(idle.len());
    assert!(held < 6 * MOST, "{held} sockets are held for {} idle clients", idle.len());
    // The last ones may stay until their time is over, the first ones have gone.
    assert_eq!(answer(&mut idle[0].try_clone().expect("a handle")), "");
    is_alive(at);
}

#[test]
fn a_client_that_sends_a_byte_at_a_time_is_left_after_the_time_for_a_head() {
    let (_dir, server) = server();
    let at = server.address();
    let began = Instant::now();
    let slow: Vec<_> = (0..MOST + 8)
        .map(|_| {
            std::thread::spawn(move || {
                let mut stream = connect(at);
                let (_never, next) = mpsc::channel::<()>();
                for byte in b"GET /livez HTTP/1.1\r\nX-Slow: ".iter().chain(std::iter::repeat(&b'a')) {
                    if stream.write_all(&[*byte]).is_err() {
                        return;
                    }
                    let _ = next.recv_timeout(Duration::from_millis(200));
                }
            })
        })
        .collect();
    while began.elapsed() < HEAD_TIME / 2 {
        is_alive(at);
    }
    for client in slow {
        client.join().expect("it ends");
    }
    assert!(began.elapsed() < HEAD_TIME * 3, "{:?}", began.elapsed());
}

#[test]
fn a_head_of_ten_megabytes_is_refused_before_it_is_read() {
    let (_dir, server) = server();
    let mut stream = connect(server.address());
    let part = vec![b'a'; 4 * HEAD_BYTES];
    let mut sent = 0;
    let mut send = |bytes: &[u8]| {
        let done = stream.write_all(bytes).is_ok();
        sent += if done { bytes.len() } else { 0 };
        done
    };
    let refused = !send(b"GET /livez HTTP/1.1\r\nX-Large: ") || (0..160).any(|_| !send(&part));
    assert!(refused || answer(&mut stream).starts_with("HTTP/1.1 431"), "{sent} bytes were read");
    is_alive(server.address());
}

#[test]
fn half_open_and_unfinished_requests_are_closed() {
    let (_dir, server) = server();
    let at = server.address();
    for partial in
        ["", "GET", "GET /livez HTTP/1.1\r\nHost", "\r\n\r\n", "\0\u{1}\u{2}", "GET / HTTP/9.9\r\n\r\n"]
    {
        let mut stream = connect(at);
        stream.write_all(partial.as_bytes()).expect("it is sent");
        stream.shutdown(Shutdown::Write).expect("it is open");
        let began = Instant::now();
        let response = answer(&mut stream);
        assert!(response.is_empty() || response.starts_with("HTTP/1.1 400"), "`{partial}`: {response}");
        assert!(began.elapsed() < HEAD_TIME, "`{partial}`: {:?}", began.elapsed());
    }
    is_alive(at);
}

#[test]
fn a_body_that_never_comes_and_a_second_request_hold_no_connection() {
    let (_dir, server) = server();
    let at = server.address();
    for (method, code) in [("GET", "200"), ("POST", "405")] {
        let mut stream = connect(at);
        write!(stream, "{method} /livez HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n")
            .expect("it is sent");
        let began = Instant::now();
        let response = answer(&mut stream);
        assert!(response.starts_with(&format!("HTTP/1.1 {code}")), "{response}");
        assert!(began.elapsed() < HEAD_TIME, "{:?}", began.elapsed());
    }
    let mut stream = connect(at);
    stream.write_all(&b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n".repeat(2)).expect("it is sent");
    assert_eq!(answer(&mut stream).matches("HTTP/1.1 200").count(), 1);
}

/// Sends a request and reads the head of its answer; the connection stays open.
fn head(stream: &mut TcpStream, path: &str) -> String {
    write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\n\r\n").expect("it is sent");
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") && stream.read(&mut byte).expect("it answers") == 1 {
        head.push(byte[0]);
    }
    String::from_utf8_lossy(&head).into_owned()
}

#[test]
fn keep_alive_connections_whose_requests_are_refused_lock_nobody_out() {
    let limits = ConnectionLimits { most: 8, whole_time: None, keep_alive: true, http2: true };
    let routes = Router::new()
        .route("/own", get(async || StatusCode::NO_CONTENT))
        .fallback(async || StatusCode::UNAUTHORIZED);
    let at = "127.0.0.1:0".parse().expect("an address");
    let server = start(at, limits, 2, |_| routes).expect("it listens");
    let at = server.address();
    let mut kept = connect(at);
    assert!(head(&mut kept, "/own").starts_with("HTTP/1.1 204"));
    let mut crowd: Vec<TcpStream> = (1..limits.most).map(|_| connect(at)).collect();
    for stream in &mut crowd {
        let refusal = head(stream, "/");
        assert!(refusal.starts_with("HTTP/1.1 401") && refusal.contains("connection: close"), "{refusal}");
    }
    // Nobody of the crowd closes its side.
    let began = Instant::now();
    for mut stream in [connect(at), connect(at)] {
        let response = head(&mut stream, "/own");
        assert!(response.starts_with("HTTP/1.1 204"), "{response}");
    }
    assert!(head(&mut kept, "/own").starts_with("HTTP/1.1 204"), "who has access keeps a connection");
    assert!(crowd.iter_mut().all(|stream| answer(stream).is_empty()));
    assert!(began.elapsed() < HEAD_TIME, "they were waited for: {:?}", began.elapsed());
}
