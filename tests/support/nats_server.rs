//! A real nats-server for a test: shared as a file, because tests of several crates need it.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A server of its own with its store in a folder; ends with this value.
pub struct NatsServer {
    child: Child,
    host: String,
    pub port: u16,
    folder: PathBuf,
    flags: Vec<String>,
}

impl NatsServer {
    /// `None` where no server is installed.
    pub fn start(folder: &Path) -> Option<NatsServer> {
        Self::start_with(folder, "127.0.0.1", &[])
    }

    /// At an address of this machine, with further flags.
    pub fn start_with(folder: &Path, host: &str, flags: &[String]) -> Option<NatsServer> {
        Self::start_at(folder, host, flags, None)
    }

    fn start_at(folder: &Path, host: &str, flags: &[String], port: Option<u16>) -> Option<NatsServer> {
        let ports = folder.join("ports");
        let _ = std::fs::remove_dir_all(&ports);
        std::fs::create_dir_all(&ports).unwrap();
        let spawned = Command::new("nats-server")
            .args(["-a", host, "-p", &port.map_or("-1".into(), |port| port.to_string()), "-js", "-sd"])
            .arg(folder.join("store"))
            .arg("--ports_file_dir")
            .arg(&ports)
            .args(flags)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        let child = match spawned {
            Ok(child) => child,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                eprintln!("skipped: nats-server is not installed (apt-get install nats-server)");
                return None;
            }
            Err(error) => panic!("{error}"),
        };
        let began = Instant::now();
        loop {
            let file = std::fs::read_dir(&ports).unwrap().next().map(|entry| entry.unwrap().path());
            let text = file.and_then(|file| std::fs::read_to_string(file).ok()).unwrap_or_default();
            let read: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
            let url = read["nats"][0].as_str().map(str::to_owned);
            if let Some(port) = url.and_then(|url| url.rsplit(':').next()?.parse().ok()) {
                let (host, folder, flags) = (host.to_owned(), folder.to_owned(), flags.to_vec());
                return Some(NatsServer { child, host, port, folder, flags });
            }
            assert!(began.elapsed() < Duration::from_secs(20), "the server does not start");
            std::thread::park_timeout(Duration::from_millis(10));
        }
    }

    /// The address of a farm on it.
    pub fn farm(&self, name: &str) -> String {
        format!("nats://{}:{}/{name}", self.host, self.port)
    }

    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Starts it again on its port and its store.
    pub fn restart(&mut self) {
        let port = Some(self.port);
        let mut started = NatsServer::start_at(&self.folder, &self.host, &self.flags, port).unwrap();
        std::mem::swap(&mut self.child, &mut started.child);
    }
}

impl Drop for NatsServer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
