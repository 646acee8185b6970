//! An accelerator for tests.

use segwild_gpu::{AdapterChoice, GpuEngine, adapters};
use std::sync::OnceLock;

/// The engine that the tests of this process share: on the adapter that `SEGWILD_GPU_ADAPTER` names, else on the best
/// one, software included. Without any it prints that `test` is skipped; with `SEGWILD_GPU_TESTS=require` it fails.
pub fn engine(test: &str) -> Option<&'static GpuEngine> {
    static ENGINE: OnceLock<Option<GpuEngine>> = OnceLock::new();
    let engine = ENGINE.get_or_init(|| {
        let name = std::env::var("SEGWILD_GPU_ADAPTER").ok();
        let name = name.or_else(|| adapters().first().map(|adapter| adapter.name.clone()))?;
        Some(GpuEngine::new(&AdapterChoice::Named(name)).expect("an adapter that is listed can be opened"))
    });
    match engine {
        Some(engine) => println!("{test}: on {}", engine.adapter().name),
        None => {
            let required = std::env::var("SEGWILD_GPU_TESTS").is_ok_and(|v| v == "require");
            assert!(
                !required,
                "{test}: no Vulkan, Metal or Direct3D 12 adapter, and SEGWILD_GPU_TESTS=require"
            );
            println!(
                "skipped: {test}: no Vulkan, Metal or Direct3D 12 adapter (mesa-vulkan-drivers has one)"
            );
        }
    }
    engine.as_ref()
}

/// [`engine`], and the same adapter without subgroups; prints a note where it has none anyway.
pub fn either_way(test: &str) -> Vec<&'static GpuEngine> {
    static PLAIN: OnceLock<GpuEngine> = OnceLock::new();
    let Some(engine) = engine(test) else { return Vec::new() };
    if engine.adapter().subgroups.is_none() {
        println!("skipped: {test} by subgroups: {} has none", engine.adapter().name);
        return vec![engine];
    }
    let choice = AdapterChoice::Named(engine.adapter().name.clone());
    let plain = PLAIN.get_or_init(|| GpuEngine::without_subgroups(&choice).expect("it opens again"));
    vec![engine, plain]
}
