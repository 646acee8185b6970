//! An actor that has stopped moving is named: on standard error, by `status`, at `/readyz` and `/metrics`, and in the log.

use crate::common::*;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command, Stdio};

/// Ended when the test ends, however it ends.
struct Guarded(Child);
impl Drop for Guarded {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn get(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("it listens");
    // HTTP/1.0: the answer comes in one piece.
    write!(stream, "GET {path} HTTP/1.0\r\nHost: x\r\n\r\n").expect("it takes the question");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    answer
}

#[test]
fn an_actor_that_stands_still_is_named_and_others_that_wait_are_not() {
    let dir = folder();
    for (fault, actor, item) in [
        ("stall@coordinator.handle:5", "coordinator", "handles "),
        ("stall@masks.handle:3", "masks", "sky photo_"),
        ("stall@trainer.step:30", "trainer", "60 steps"),
        ("stall@features.handle:4", "features", "embed photo_"),
    ] {
        let run = dir.path().join(actor);
        let args = again(&run, &["--stuck-after", "1", "--metrics-listen", "127.0.0.1:0", "--fault", fault]);
        let mut child = Guarded(
            Command::new(env!("CARGO_BIN_EXE_segwild"))
                .args(&args)
                .stdout(Stdio::null())
                .stderr(Stdio::piped())
                .spawn()
                .expect("the program starts"),
        );
        let mut lines = BufReader::new(child.0.stderr.take().expect("a pipe")).lines().map_while(Result::ok);
        let first = lines.next().expect("a line");
        let address: SocketAddr = first
            .strip_prefix("listening on http://")
            .and_then(|a| a.parse().ok())
            .unwrap_or_else(|| panic!("{first}"));
        let stdout = lines.find(|line| line.contains("no progress")).expect("it is named");
        assert!(stdout.contains(&format!("{actor} has shown no progress on `{item}")), "{stdout}");

        // The live view is written once a second.
        let named = format!("segwild_actor_stuck{{actor=\"{actor}\"}} 1");
        let metrics = loop {
            assert!(
                child.0.try_wait().expect("a child").is_none(),
                "it ended before {actor} was seen as stuck"
            );
            let metrics = get(address, "/metrics");
            if metrics.contains(&named) {
                break metrics;
            }
            std::thread::park_timeout(std::time::Duration::from_millis(100));
        };
        let stuck =
            metrics.lines().filter(|l| l.starts_with("segwild_actor_stuck") && l.ends_with(" 1")).count();
        assert_eq!(stuck, 1, "who waits is not stuck: {metrics}");
        let status = works(&["status", &show(&run)]);
        assert!(status.contains("stuck: no progress on") && status.contains(item), "{status}");
        let json: serde_json::Value =
            serde_json::from_str(&works(&["status", &show(&run), "--json"])).expect("JSON");
        assert!(json.to_string().contains("\"stuck\":true"), "{json}");
        let ready = get(address, "/readyz");
        assert!(
            ready.starts_with("HTTP/1.0 503") && ready.contains("[-]") && ready.contains(actor),
            "{ready}"
        );
    }
}
