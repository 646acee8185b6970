//! StoreCalls of async clients from threads that run no async task.

use std::sync::mpsc;

use tokio::runtime::{Builder, Handle, Runtime};

/// A runtime for the client of a store: its own, or one that its caller keeps.
#[derive(Debug)]
pub(super) struct StoreCalls {
    handle: Handle,
    own: Option<Runtime>,
}

/// The runtime was shut down before the call ended.
#[derive(Debug, thiserror::Error)]
#[error("the program is shutting down")]
pub(super) struct ShutDown;

/// A call under way.
pub(super) struct Pending<T>(mpsc::Receiver<T>);

impl<T> Pending<T> {
    pub fn wait(self) -> Result<T, ShutDown> {
        self.0.recv().map_err(|_| ShutDown)
    }
}

impl StoreCalls {
    /// With threads of its own.
    pub fn own() -> std::io::Result<Self> {
        let runtime =
            Builder::new_multi_thread().worker_threads(2).thread_name("artefacts").enable_all().build()?;
        Ok(Self { handle: runtime.handle().clone(), own: Some(runtime) })
    }

    /// On a runtime that runs as long as this is used.
    pub fn on(handle: Handle) -> Self {
        Self { handle, own: None }
    }

    pub fn start<T: Send + 'static>(&self, future: impl Future<Output = T> + Send + 'static) -> Pending<T> {
        let (send, receive) = mpsc::channel();
        self.handle.spawn(async move { send.send(future.await) });
        Pending(receive)
    }

    pub fn wait<T: Send + 'static>(
        &self,
        future: impl Future<Output = T> + Send + 'static,
    ) -> Result<T, ShutDown> {
        self.start(future).wait()
    }
}

impl Drop for StoreCalls {
    fn drop(&mut self) {
        // Waiting for it would panic where the last user is an async task.
        if let Some(runtime) = self.own.take() {
            runtime.shutdown_background();
        }
    }
}
