//! A loaded network: its inputs and outputs, and running it within a limit of time.

use super::Runtime;
use super::half::extract;
use crate::VisionError;
use crate::model_file::{TensorSpec, inspect};
use ort::session::{RunOptions, Session, SessionInputValue};
use segwild_files::lock;
use std::path::Path;
use std::sync::Mutex;
use std::sync::mpsc;
use std::time::Duration;

/// Where a network computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NetworkDevice {
    Cpu,
    Cuda,
}

/// How a network is run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Options {
    pub threads: u32,
    pub device: NetworkDevice,
    /// Longest that one run may take.
    pub limit: Duration,
    /// Most MiB on the accelerator.
    pub memory_mib: u32,
}

/// One output of a network.
pub(crate) struct NetworkOutput {
    pub shape: Vec<usize>,
    pub data: Vec<f32>,
}

/// A loaded network.
pub(crate) struct NetworkModel {
    session: Mutex<Session>,
    pub inputs: Vec<TensorSpec>,
    pub outputs: Vec<TensorSpec>,
    name: String,
    hash: String,
    limit: Duration,
}

impl NetworkModel {
    /// Checks a file and loads it.
    pub fn load(runtime: &Runtime, path: &Path, options: Options) -> Result<NetworkModel, VisionError> {
        let name = path.display().to_string();
        let wrong = |what: String| VisionError::Model(format!("{name}: {what}"));
        let file = inspect(path)
            .map_err(|reason| VisionError::File { file: path.to_owned(), reason: Box::new(reason) })?;
        let build = || -> ort::Result<Session> {
            let mut builder = Session::builder(&runtime.environment)?
                .with_intra_threads(options.threads as usize)?
                .with_inter_threads(1)?
                .with_deterministic_compute(true)?
                .with_env_allocators()?
                // Errors come back as values; the runtime need not print them as well.
                .with_log_level(ort::logging::LogLevel::Fatal)?;
            if options.device == NetworkDevice::Cuda {
                let cuda = ort::ep::CUDA::default()
                    .with_memory_limit(options.memory_mib as usize * (1 << 20))
                    .with_conv_algorithm_search(ort::ep::cuda::ConvAlgorithmSearch::Heuristic);
                builder = builder.with_execution_providers([cuda.build().error_on_failure()])?;
            }
            // Weights in other files are read from beside the file, and not from the working directory.
            match file.beside {
                true => builder.commit_from_file(path),
                false => builder.commit_from_memory(&file.bytes),
            }
        };
        let session = build().map_err(|e| match options.device {
            NetworkDevice::Cuda => wrong(format!("cannot be loaded on CUDA: {e}")),
            NetworkDevice::Cpu => {
                wrong(format!("is no network that ONNX Runtime can load: {}", plain(&e.to_string())))
            }
        })?;
        Ok(NetworkModel {
            inputs: session.inputs().iter().map(TensorSpec::of).collect(),
            outputs: session.outputs().iter().map(TensorSpec::of).collect(),
            session: Mutex::new(session),
            hash: file.hash,
            limit: options.limit,
            name,
        })
    }

    /// The file's name, for messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Hash of the file (16 hexadecimal digits).
    pub fn key(&self) -> &str {
        &self.hash[..16]
    }

    /// An error with the file's name before `what`.
    pub fn wrong(&self, what: impl Into<String>) -> VisionError {
        VisionError::Model(format!("{}: {}", self.name, what.into()))
    }

    /// Runs the network and returns the named outputs. `on` names the input, for messages.
    pub fn run(
        &self,
        inputs: Vec<(&str, SessionInputValue)>,
        outputs: &[&str],
        on: &str,
    ) -> Result<Vec<NetworkOutput>, VisionError> {
        let failed = |e: ort::Error| self.wrong(format!("fails on {on}: {}", plain(&e.to_string())));
        let mut session = lock(&self.session);
        let mut options = RunOptions::new().map_err(failed)?;
        options.set_log_level(ort::logging::LogLevel::Fatal).map_err(failed)?;
        // A file from an untrusted source may hold an endless loop.
        let (done, over) = mpsc::channel::<()>();
        std::thread::scope(|scope| {
            let watch = std::thread::Builder::new().name("network limit".into());
            let watched = watch.spawn_scoped(scope, {
                let (options, limit) = (&options, self.limit);
                move || {
                    let late = over.recv_timeout(limit) == Err(mpsc::RecvTimeoutError::Timeout);
                    late && options.terminate().is_ok()
                }
            });
            let given = session.run_with_options(inputs, &options);
            drop(done);
            let late = watched.is_ok_and(|thread| thread.join().unwrap_or(false));
            let given = given.map_err(|e| match late {
                true => self.wrong(format!(
                    "was stopped on {on} after {} seconds (`network_limit` allows more)",
                    self.limit.as_secs()
                )),
                false => failed(e),
            })?;
            let answer = |name: &&str| -> Result<NetworkOutput, VisionError> {
                let value = given.get(name).ok_or_else(|| self.wrong(format!("gave no `{name}`")))?;
                let (shape, data) =
                    extract(value).map_err(|e| self.wrong(format!("gave no numbers as `{name}`: {e}")))?;
                Ok(NetworkOutput { shape, data })
            };
            outputs.iter().map(answer).collect()
        })
    }
}

/// The runtime's message, with advice where there is some.
fn plain(error: &str) -> String {
    match error.contains("Available memory of") {
        true => format!("it needs more memory than `network_memory` allows ({error})"),
        false => error.to_owned(),
    }
}
