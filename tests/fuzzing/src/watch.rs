//! Ends the process when an input hangs: nothing else would.

use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

/// An input that has not returned after this time will not.
const PATIENCE: Duration = Duration::from_secs(60);

type Input = Option<(&'static str, Vec<u8>)>;

/// An input that is being read; dropped when the reader has returned.
pub struct Watched;

impl Watched {
    /// The next input.
    pub fn new(target: &'static str, bytes: &[u8]) -> Watched {
        tell(Some((target, bytes.to_vec())));
        Watched
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        tell(None);
    }
}

fn tell(input: Input) {
    static WATCH: OnceLock<Mutex<Sender<Input>>> = OnceLock::new();
    let watch = WATCH.get_or_init(|| {
        let (sender, inputs) = channel();
        std::thread::spawn(move || watch(&inputs));
        Mutex::new(sender)
    });
    // It listens as long as the process lives.
    let _ = watch.lock().unwrap_or_else(PoisonError::into_inner).send(input);
}

fn watch(inputs: &Receiver<Input>) {
    let mut now: Input = None;
    loop {
        match inputs.recv_timeout(PATIENCE) {
            Ok(input) => now = input,
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {
                let Some((target, bytes)) = &now else { continue };
                let file = format!("target/fuzz-hang-{target}");
                // The name says enough where it cannot be written.
                let _ = std::fs::write(&file, bytes);
                eprintln!("fuzz {target}: FAILED: it has not returned for {} s: {file}", PATIENCE.as_secs());
                std::process::exit(1);
            }
        }
    }
}
