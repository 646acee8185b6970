//! Which engine computes the splats.

use crate::{RunError, RunSettings};
use segwild_gpu::{Choice, GpuEngine, GpuError};
use segwild_raster::{CpuEngine, Engine, FallbackEngine};
use std::sync::Arc;

segwild_scene::choice! {
    /// What computes the splats.
    pub enum EngineKind {
        /// An accelerator that is no program on the CPU, where there is one; else the CPU.
        Auto = "auto",
        /// The CPU engine.
        Cpu = "cpu",
        /// An accelerator.
        Gpu = "gpu",
    }
}

segwild_scene::choice! {
    /// What happens when the accelerator fails in the middle of something.
    pub enum WhenLost {
        /// The run stops, and the same command goes on with it.
        Stop = "stop",
        /// The CPU engine takes over.
        Cpu = "cpu",
    }
}

/// An engine, and why it was taken.
#[derive(Clone)]
pub struct Chosen {
    /// The engine.
    pub engine: Arc<dyn Engine>,
    /// What it is and why, in words.
    pub why: String,
}

impl Chosen {
    fn cpu(why: &str) -> Chosen {
        let engine = CpuEngine::default();
        let why = format!("the CPU engine ({:?}): {why}", engine.isa());
        Chosen { engine: Arc::new(engine), why }
    }

    fn gpu(engine: GpuEngine, when_lost: WhenLost, told: impl Fn(String) + Send + Sync + 'static) -> Chosen {
        let adapter = engine.adapter();
        let why = format!("the accelerator {} ({}, {})", adapter.name, adapter.kind, adapter.backend);
        let engine: Arc<dyn Engine> = match when_lost {
            WhenLost::Stop => Arc::new(engine),
            WhenLost::Cpu => {
                let told = move |why: &str| told(format!("{why}; the CPU engine goes on"));
                Arc::new(FallbackEngine::new(Box::new(engine), Box::new(CpuEngine::default()), told))
            }
        };
        Chosen { engine, why }
    }
}

/// Opens the engine of these settings. `told` hears if it is replaced later, and why.
pub fn choose_engine(
    settings: &RunSettings,
    told: impl Fn(String) + Send + Sync + 'static,
) -> Result<Chosen, RunError> {
    let choice = match settings.adapter.as_str() {
        "" => Choice::Hardware,
        name => Choice::Named(name.to_owned()),
    };
    let open = || -> Result<GpuEngine, GpuError> {
        let engine = GpuEngine::new(&choice)?;
        engine.keep_within(u64::from(settings.memory_budget) << 20);
        Ok(engine)
    };
    match settings.engine {
        EngineKind::Cpu => Ok(Chosen::cpu("`--engine auto` takes an accelerator, where there is one")),
        EngineKind::Gpu => Ok(Chosen::gpu(open()?, settings.when_lost, told)),
        // An adapter that was named is wanted, not wished for.
        EngineKind::Auto if !settings.adapter.is_empty() => {
            Ok(Chosen::gpu(open()?, settings.when_lost, told))
        }
        EngineKind::Auto => match open() {
            Ok(engine) => Ok(Chosen::gpu(engine, settings.when_lost, told)),
            Err(reason) => Ok(Chosen::cpu(&reason.to_string())),
        },
    }
}

/// What to do with the loss of an engine where no run listens.
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
