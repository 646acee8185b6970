//! Feeds every reader with its corpus, its good inputs and changes of them, for a bounded time.
//!
//! `segwild-fuzzing [--seconds N] [--inputs N] [--seed N] [TARGET ..]`: at most so many seconds (default 30) shared by all
//! targets, at most so many inputs each. One line a target: `fuzz TARGET: N inputs in S s`. The same seed gives the same
//! inputs. What panics, takes more than [`MOST_MEMORY`] or longer than [`MOST_TIME`] is written to `target/fuzz-failures/`, and the
//! exit code is 1.

mod memory;
mod watch;

use segwild_fuzzing::mutate::{FuzzDice, change};
use segwild_fuzzing::{FuzzTarget, TARGETS};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

#[global_allocator]
static MEMORY: memory::CountedAllocator = memory::CountedAllocator::new();

/// The message of the last panic, and where it was.
static PANIC: Mutex<String> = Mutex::new(String::new());

/// Memory that one input may take on top of what was there, in bytes.
const MOST_MEMORY: usize = 256 << 20;
/// Processor time that one input may take, on all threads.
const MOST_TIME: Duration = Duration::from_secs(2);

struct FuzzOptions {
    seconds: f64,
    inputs: u64,
    seed: u64,
    targets: Vec<&'static FuzzTarget>,
}

impl FuzzOptions {
    fn read(words: impl Iterator<Item = String>) -> Result<FuzzOptions, String> {
        let mut options = FuzzOptions { seconds: 30.0, inputs: u64::MAX, seed: 1, targets: Vec::new() };
        let mut words = words;
        while let Some(word) = words.next() {
            let mut number = || {
                let value = words.next().unwrap_or_default();
                value.parse::<u64>().map_err(|_| format!("{word} {value}: expected a number"))
            };
            match word.as_str() {
                "--seconds" => options.seconds = number()? as f64,
                "--inputs" => options.inputs = number()?,
                "--seed" => options.seed = number()?,
                name => {
                    let target =
                        segwild_fuzzing::target(name).ok_or(format!("there is no target `{name}`"))?;
                    options.targets.push(target);
                }
            }
        }
        if options.targets.is_empty() {
            options.targets = TARGETS.iter().collect();
        }
        Ok(options)
    }
}

fn main() -> ExitCode {
    let options = match FuzzOptions::read(std::env::args().skip(1)) {
        Ok(options) => options,
        Err(error) => {
            eprintln!("error: {error}");
            return ExitCode::from(2);
        }
    };
    let Ok(folder) = tempfile::tempdir() else {
        eprintln!("error: no temporary folder can be made");
        return ExitCode::FAILURE;
    };
    segwild_fuzzing::keep_files_in(folder.path());
    // A panic is printed once, with its input.
    std::panic::set_hook(Box::new(|panic| {
        *PANIC.lock().unwrap_or_else(PoisonError::into_inner) = panic.to_string().replace('\n', " ");
    }));
    let (began, mut inputs, mut failed) = (Instant::now(), 0, 0);
    let share = Duration::from_secs_f64(options.seconds / options.targets.len() as f64);
    for target in &options.targets {
        let (count, failure) = fuzz(target, share, &options);
        inputs += count;
        if let Some(failure) = failure {
            failed += 1;
            eprintln!("fuzz {}: FAILED: {}", target.name, failure);
        }
    }
    println!(
        "fuzz: {inputs} inputs of {} targets in {:.1} s",
        options.targets.len(),
        began.elapsed().as_secs_f64()
    );
    if failed > 0 { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

/// The inputs of a target that were kept because they failed once, or because nothing makes them.
fn corpus(target: &FuzzTarget) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(target.name);
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    files.sort();
    files.iter().filter_map(|file| std::fs::read(file).ok()).collect()
}

/// Feeds one target; returns how many inputs it had, and what the first one that failed did.
fn fuzz(target: &FuzzTarget, share: Duration, options: &FuzzOptions) -> (u64, Option<String>) {
    let seeds = [corpus(target), (target.seeds)()].concat();
    let mut dice = FuzzDice::new(options.seed, target.name);
    let (began, mut count, mut failure) = (Instant::now(), 0, None);
    let mut given = seeds.iter();
    while failure.is_none() && count < options.inputs {
        // Those that were kept are tried however little time there is.
        let mut bytes = match given.next() {
            Some(bytes) => bytes.clone(),
            None if began.elapsed() > share => break,
            None => change(&mut dice, &seeds, target.words),
        };
        (target.seal)(&mut bytes);
        count += 1;
        failure =
            attempt(target, &bytes).map(|what| format!("input {count}, {what}: {}", keep(target, &bytes)));
    }
    println!("fuzz {}: {count} inputs in {:.1} s", target.name, began.elapsed().as_secs_f64());
    (count, failure)
}

/// What is wrong with what a reader did with an input.
fn attempt(target: &FuzzTarget, bytes: &[u8]) -> Option<String> {
    let _watched = watch::Watched::new(target.name, bytes);
    let (before, cpu) = (MEMORY.start_counting(), processor_time());
    let done = std::panic::catch_unwind(|| (target.read)(bytes));
    let (memory, time) = (MEMORY.peak().saturating_sub(before), processor_time().saturating_sub(cpu));
    if done.is_err() {
        return Some(PANIC.lock().unwrap_or_else(PoisonError::into_inner).clone());
    }
    if memory > MOST_MEMORY {
        return Some(format!("it takes {} MiB", memory >> 20));
    }
    (time > MOST_TIME).then(|| format!("it takes {:.1} s", time.as_secs_f64()))
}

/// Processor time of this process: what else runs on the machine does not count.
fn processor_time() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec.unsigned_abs() as u32)
}

/// Writes an input that failed where a person finds it, and says where.
fn keep(target: &FuzzTarget, bytes: &[u8]) -> String {
    let name = format!("{}-{}", target.name, &blake3::hash(bytes).to_hex()[..12]);
    let folder = Path::new("target/fuzz-failures");
    let file = folder.join(name);
    let written = std::fs::create_dir_all(folder).and_then(|()| std::fs::write(&file, bytes));
    match written {
        Ok(()) => file.display().to_string(),
        Err(error) => format!("{} cannot be written: {error}", file.display()),
    }
}
