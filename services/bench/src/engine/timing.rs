//! How long passes take that are submitted repeatedly.

use segwild_gpu::probe::{DevicePasses, start_clock, stop_clock};
use segwild_gpu::{GpuEngine, GpuError, WorkCounts};
use std::collections::BTreeMap;
use std::time::Instant;

/// Least seconds over which a pass is repeated, and most repetitions.
pub(super) const LEAST: f64 = 0.25;
const MOST: usize = 200;
/// Peak rates of the device.
#[derive(Clone, Copy, Debug)]
pub struct Reach {
    /// Bytes read and written in a second by a copy.
    pub bytes: f64,
    /// Operations in a second.
    pub operations: f64,
}

impl Reach {
    /// Least milliseconds for so many bytes and operations.
    fn floor_ms(&self, floor: Floor) -> f64 {
        1e3 * (floor.bytes / self.bytes).max(floor.operations / self.operations)
    }
}

/// The least that a pass moves and computes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Floor {
    /// Bytes of its arrays, each read or written once.
    pub bytes: f64,
    /// Operations on numbers.
    pub operations: f64,
}

/// One pass over one view.
#[derive(Clone, Debug, Default)]
pub struct PassTime {
    /// Its name: that of a kernel of `shaders/`, or of what several do together.
    pub pass: &'static str,
    /// Milliseconds of wall clock.
    pub ms: f64,
    /// The floor of this time; 0 where it is not one pass of the device.
    pub floor_ms: f64,
    /// The floor of the bytes that it moves.
    pub floor_bytes: f64,
    /// What the device was given to do for it.
    pub counts: WorkCounts,
    /// Milliseconds of its kernels by the device's own clock, the slowest first; none where it has no clock. The rest
    /// of [`PassTime::ms`] is submission and waiting.
    pub kernels: Vec<(&'static str, f64)>,
}

/// Mean milliseconds of work, and of each of its kernels.
pub(super) struct Spent {
    ms: f64,
    counts: WorkCounts,
    kernels: Vec<(&'static str, f64)>,
}

impl Spent {
    /// The row of a pass with this floor.
    pub fn row(self, pass: &'static str, reach: Reach, floor: Floor) -> PassTime {
        PassTime {
            pass,
            ms: self.ms,
            floor_ms: reach.floor_ms(floor),
            floor_bytes: floor.bytes,
            counts: self.counts,
            kernels: self.kernels,
        }
    }
}

/// Times that kernels are timed one by one.
pub(super) const CLOCKED: u32 = 3;

/// Times by the device's clock over so many repetitions, the slowest kernel first.
pub(super) fn slowest(spent: BTreeMap<&'static str, f64>, repetitions: u32) -> Vec<(&'static str, f64)> {
    let mut kernels: Vec<_> =
        spent.into_iter().map(|(name, ms)| (name, ms / f64::from(repetitions))).collect();
    kernels.sort_by(|a, b| b.1.total_cmp(&a.1));
    kernels
}

/// Times a pass that is submitted repeatedly and waited for once; then its kernels.
pub(super) fn timed<P: DevicePasses>(
    engine: &GpuEngine,
    passes: &mut P,
    mut pass: impl FnMut(&mut P) -> Result<(), GpuError>,
) -> Result<Spent, GpuError> {
    let ms = repeated(passes, &mut pass)?;
    let before = engine.work_counts();
    pass(passes)?;
    passes.wait()?;
    let counts = engine.work_counts() - before;
    start_clock(engine);
    for _ in 0..CLOCKED {
        pass(passes)?;
    }
    passes.wait()?;
    Ok(Spent { ms, counts, kernels: slowest(stop_clock(engine), CLOCKED) })
}

/// Mean milliseconds of a pass that is submitted repeatedly and waited for once.
pub(super) fn repeated<P: DevicePasses>(
    passes: &mut P,
    mut pass: impl FnMut(&mut P) -> Result<(), GpuError>,
) -> Result<f64, GpuError> {
    // Compiles, and allocates its memory.
    pass(passes)?;
    passes.wait()?;
    let mut calls = 1;
    loop {
        let began = Instant::now();
        for _ in 0..calls {
            pass(passes)?;
        }
        passes.wait()?;
        let spent = began.elapsed().as_secs_f64();
        if spent >= LEAST || calls >= MOST {
            return Ok(spent * 1e3 / calls as f64);
        }
        calls = ((1.5 * LEAST / spent.max(1e-6)) as usize * calls).clamp(2 * calls, MOST.max(2 * calls));
    }
}
