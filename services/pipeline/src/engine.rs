//! Which engine computes the splats.

use crate::{EngineKind, RunError, RunSettings, WhenLost};
use segwild_gpu::{AdapterChoice, GpuEngine, GpuError};
use segwild_objective::{Engine, FallbackEngine};
use segwild_raster::CpuEngine;
use std::sync::Arc;

/// An engine, and why it was chosen.
#[derive(Clone)]
pub struct ChosenEngine {
    /// The engine.
    pub engine: Arc<dyn Engine>,
    /// Which engine it is and why, in words.
    pub why: String,
    /// Bytes of the longest array that it can use; `None`: of any.
    pub longest_array: Option<u64>,
}

impl ChosenEngine {
    fn cpu(why: &str) -> ChosenEngine {
        let engine = CpuEngine::default();
        let why = format!("the CPU engine ({:?}): {why}", engine.isa());
        ChosenEngine { engine: Arc::new(engine), why, longest_array: None }
    }

    fn gpu(
        engine: GpuEngine,
        when_lost: WhenLost,
        on_loss: impl Fn(String) + Send + Sync + 'static,
    ) -> ChosenEngine {
        let adapter = engine.adapter();
        let why = format!("the accelerator {} ({}, {})", adapter.name, adapter.kind, adapter.backend);
        let longest_array = Some(adapter.binding);
        let engine: Arc<dyn Engine> = match when_lost {
            WhenLost::Stop => Arc::new(engine),
            WhenLost::Cpu => {
                let on_loss = move |why: &str| on_loss(format!("{why}; the CPU engine goes on"));
                Arc::new(FallbackEngine::new(Box::new(engine), Box::new(CpuEngine::default()), on_loss))
            }
        };
        ChosenEngine { engine, why, longest_array }
    }
}

/// Opens the engine of these settings. `on_loss` is called with the reason if the engine is replaced later.
///
/// # Errors
/// When an accelerator is required and cannot be used.
pub fn choose_engine(
    settings: &RunSettings,
    on_loss: impl Fn(String) + Send + Sync + 'static,
) -> Result<ChosenEngine, RunError> {
    let choice = match settings.adapter.as_str() {
        "" => AdapterChoice::Hardware,
        name => AdapterChoice::Named(name.to_owned()),
    };
    let open = || -> Result<GpuEngine, GpuError> {
        let engine = GpuEngine::new(&choice)?;
        engine.keep_within(u64::from(settings.memory_budget) << 20);
        Ok(engine)
    };
    match settings.engine {
        EngineKind::Cpu => Ok(ChosenEngine::cpu("`--engine auto` takes an accelerator, where there is one")),
        EngineKind::Gpu => Ok(ChosenEngine::gpu(open()?, settings.when_lost, on_loss)),
        // An adapter that is named is required: without it the run fails.
        EngineKind::Auto if !settings.adapter.is_empty() => {
            Ok(ChosenEngine::gpu(open()?, settings.when_lost, on_loss))
        }
        EngineKind::Auto => match open() {
            Ok(engine) => Ok(ChosenEngine::gpu(engine, settings.when_lost, on_loss)),
            Err(reason) => Ok(ChosenEngine::cpu(&reason.to_string())),
        },
    }
}

/// Logs the loss of an engine where no run receives events.
pub(crate) fn log_loss(lost: String) {
    tracing::warn!("{lost}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn auto_never_takes_a_software_adapter() {
        let settings = RunSettings { engine: EngineKind::Auto, ..RunSettings::default() };
        let chosen = choose_engine(&settings, drop).expect("auto always finds one");
        let hardware = segwild_gpu::adapters().iter().any(|adapter| !adapter.is_software());
        assert_eq!(chosen.engine.name(), if hardware { "gpu" } else { "cpu" }, "{}", chosen.why);
    }

    #[test]
    fn an_adapter_that_is_not_there_is_refused_with_what_there_is() {
        for engine in [EngineKind::Auto, EngineKind::Gpu] {
            let settings =
                RunSettings { engine, adapter: "no such adapter".into(), ..RunSettings::default() };
            let error = choose_engine(&settings, drop).map(|chosen| chosen.why).expect_err("there is none");
            let text = error.to_string();
            assert!(text.contains("no such adapter") || text.contains("no accelerator was found"), "{text}");
            assert!(text.contains("--engine cpu"), "{text}");
        }
    }
}
