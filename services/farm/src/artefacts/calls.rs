//! Calls of async clients from threads that run no async task.

use tokio::runtime::{Builder, Handle, Runtime};

use crate::pending::{Pending, ShutDown};

/// A runtime for the client of a store: its own, or one that its caller keeps.
#[derive(Debug)]
pub(super) struct StoreCalls {
    handle: Handle,
    own: Option<Runtime>,
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
        Pending::start(&self.handle, future)
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
