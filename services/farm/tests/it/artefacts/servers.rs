//! A NATS server and a server of S3 for a test, each a process of its own.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

/// A server that does not outlive its test.
pub struct Server {
    child: Child,
    /// Its address, as a client takes it.
    pub url: String,
}

impl Drop for Server {
    fn drop(&mut self) {
        // One that has ended by itself is as good.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn until<T>(what: &str, mut see: impl FnMut() -> Option<T>) -> T {
    let (_never, next) = mpsc::channel::<()>();
    for _ in 0..600 {
        if let Some(seen) = see() {
            return seen;
        }
        let _ = next.recv_timeout(Duration::from_millis(50));
    }
    panic!("{what} did not come");
}

fn started(names: &[&str], arguments: &[&str]) -> Option<Child> {
    names.iter().find_map(|name| {
        Command::new(name).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().ok()
    })
}

/// A NATS server with JetStream, in a folder; `None` where there is none to start.
pub fn nats(folder: &Path) -> Option<Server> {
    let show = |path: &Path| path.display().to_string();
    let (ports, data) = (folder.join("ports"), folder.join("data"));
    std::fs::create_dir_all(&ports).unwrap();
    let arguments =
        ["-a", "127.0.0.1", "-p", "-1", "-js", "-sd", &show(&data), "--ports_file_dir", &show(&ports)];
    let child = started(&["nats-server", "/usr/sbin/nats-server"], &arguments)?;
    let mut server = Server { child, url: String::new() };
    server.url = until("the server's port", || {
        let file = std::fs::read_dir(&ports).unwrap().flatten().next()?.path();
        let ports: serde_json::Value = serde_json::from_slice(&std::fs::read(file).ok()?).ok()?;
        ports["nats"][0].as_str().map(str::to_owned)
    });
    Some(server)
}

/// A server of S3 (moto) with a bucket `farm`; `None` where there is none to start.
pub fn s3() -> Option<Server> {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port().to_string();
    let named = std::env::var("SEGWILD_MOTO_SERVER").unwrap_or_default();
    let names = [named.as_str(), "moto_server", "/tmp/moto/bin/moto_server"];
    let child = started(&names, &["-H", "127.0.0.1", "-p", &port])?;
    let server = Server { child, url: format!("http://127.0.0.1:{port}") };
    until("the server's answer", || TcpStream::connect(format!("127.0.0.1:{port}")).ok());
    put(&server.url, "/farm", b"");
    Some(server)
}

/// Writes an object as it is.
pub fn put(url: &str, path: &str, bytes: &[u8]) {
    let host = url.strip_prefix("http://").unwrap();
    let mut stream = TcpStream::connect(host).unwrap();
    let head = format!(
        "PUT {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        bytes.len()
    );
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(bytes).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
}
