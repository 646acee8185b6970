//! Requests to `--metrics-listen`.

use crate::yard::folder;
use crate::{FuzzTarget, seal};
use segwild_monitor::Server;
use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::OnceLock;
use std::time::Duration;

/// Longer than the server lets a connection stand.
const PATIENCE: Duration = Duration::from_secs(30);

fn exchange(bytes: &[u8]) -> Vec<u8> {
    static SERVER: OnceLock<Server> = OnceLock::new();
    let server = SERVER.get_or_init(|| {
        let any = std::net::SocketAddr::from(([127, 0, 0, 1], 0));
        segwild_monitor::serve(any, folder("server"), true).unwrap_or_else(|e| panic!("{e}"))
    });
    let mut stream =
        TcpStream::connect(server.address()).unwrap_or_else(|e| panic!("it accepts no more: {e}"));
    let mut answer = Vec::new();
    // It may refuse before it has received everything.
    let _ = stream.set_read_timeout(Some(PATIENCE));
    let _ = stream.write_all(bytes).and_then(|()| stream.shutdown(Shutdown::Write));
    if let Err(error) = stream.read_to_end(&mut answer) {
        assert_ne!(error.kind(), std::io::ErrorKind::WouldBlock, "it neither answers nor closes");
    }
    answer
}

pub(super) const REQUEST: FuzzTarget = FuzzTarget {
    name: "http_request",
    seeds: || {
        let of =
            |path: &str| format!("GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").into_bytes();
        let body = b"POST /metrics HTTP/1.1\r\nHost: x\r\nContent-Length: 4\r\n\r\nbody".to_vec();
        let chunks =
            b"GET /livez HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n4\r\nbody\r\n0\r\n\r\n"
                .to_vec();
        let paths = ["/", "/livez", "/metrics", "/readyz", "/api/v1/status"];
        paths.map(of).into_iter().chain([body, chunks]).collect()
    },
    words: &[
        "\r\n",
        "\r\n\r\n",
        "HTTP/0.9",
        "HTTP/2.0",
        "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        "Content-Length: 99999999999999999999\r\n",
        "Transfer-Encoding: chunked\r\n",
        "Expect: 100-continue\r\n",
        "Upgrade: websocket\r\n",
        "%00",
        "/../",
        "ffffffffffffffff\r\n",
    ],
    seal: seal::nothing,
    read: |bytes| {
        exchange(bytes);
        let alive = exchange(b"GET /livez HTTP/1.0\r\n\r\n");
        assert!(alive.starts_with(b"HTTP/1.0 200"), "it answers nobody any more");
    },
};
