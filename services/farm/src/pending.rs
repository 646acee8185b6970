//! Futures of async clients, waited for by threads that run no async task.

use std::sync::mpsc;

use tokio::runtime::Handle;

/// A future under way on a runtime.
pub(crate) struct Pending<T>(mpsc::Receiver<T>);

/// The runtime was shut down before the future ended, or the future panicked.
#[derive(Debug, thiserror::Error)]
#[error("the program is shutting down")]
pub(crate) struct ShutDown;

impl<T: Send + 'static> Pending<T> {
    /// Starts a future. It goes on where nobody waits for it.
    pub fn start(runtime: &Handle, future: impl Future<Output = T> + Send + 'static) -> Self {
        let (send, receive) = mpsc::channel();
        runtime.spawn(async move { send.send(future.await) });
        Self(receive)
    }

    /// Waits until it ends, from a thread that is none of the runtime's own.
    pub fn wait(self) -> Result<T, ShutDown> {
        self.0.recv().map_err(|_| ShutDown)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_runtime_drops_is_not_waited_for() {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).build().unwrap();
        assert_eq!(Pending::start(runtime.handle(), async { 7 }).wait().unwrap(), 7);
        let endless = Pending::start(runtime.handle(), std::future::pending::<()>());
        runtime.shutdown_background();
        assert!(endless.wait().is_err());
    }
}
