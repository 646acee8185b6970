//! Whose threads compute: those of the actor that called the kernel, and no others.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::thread;

use rayon::prelude::*;
use segwild_flow::*;

type Names = Arc<Mutex<BTreeSet<String>>>;

/// A kernel: work in many pieces, each of which notes the thread that it ran on.
fn kernel(names: &Names) -> u64 {
    (0..20_000u64)
        .into_par_iter()
        .map(|i| {
            let thread = thread::current();
            names.lock().unwrap().insert(thread.name().unwrap_or("unnamed").to_owned());
            i
        })
        .sum()
}

/// Computes at each message.
struct ComputeWorker(Names);
impl Actor for ComputeWorker {
    type Message = u32;
    fn handle(&mut self, _: u32, _: &Context) -> Result<(), ActorFailure> {
        assert_eq!(kernel(&self.0), 199_990_000);
        Ok(())
    }
}

#[test]
fn kernels_run_on_the_threads_of_the_actor_that_calls_them() {
    let system = System::new(SystemOptions { threads: 3, ..SystemOptions::default() }).unwrap();
    let seen: Vec<(String, usize, Names)> =
        [("masks", None, 3), ("trainer", Some(2), 2), ("photos", Some(1), 1)]
            .into_iter()
            .map(|(name, threads, expected)| {
                let names = Names::default();
                let (tasks, inbox) = mailbox::<u32>(name, Limits::default());
                let (mine, options) = (names.clone(), ActorOptions { threads, ..ActorOptions::default() });
                system.spawn(inbox, options, move || Ok(ComputeWorker(mine.clone()))).unwrap();
                (0..20).for_each(|n| tasks.blocking_send(n).unwrap());
                (name.to_owned(), expected, names)
            })
            .collect();
    let source = Names::default();
    let mine = source.clone();
    system
        .source("renders", ActorOptions::default(), move |_| {
            kernel(&mine);
            Ok(())
        })
        .unwrap();
    assert!(system.join().finished());
    for (name, threads, names) in &seen {
        let names = names.lock().unwrap();
        assert!(names.iter().all(|thread| thread.starts_with(&format!("{name}/"))), "{name}: {names:?}");
        assert!((1..=*threads).contains(&names.len()), "{name}: {names:?}");
    }
    let source = source.lock().unwrap();
    assert!(source.iter().all(|thread| thread.starts_with("renders/")), "{source:?}");
}

#[test]
fn async_workers_never_compute() {
    // The message comes from an async task, on a runtime whose workers have names of their own.
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).thread_name("async").build().unwrap();
    let names = Names::default();
    let system = System::new(SystemOptions::default()).unwrap();
    let (tasks, inbox) = mailbox::<u32>("masks", Limits { count: 1, bytes: 1 });
    let mine = names.clone();
    system.spawn(inbox, ActorOptions::default(), move || Ok(ComputeWorker(mine.clone()))).unwrap();
    runtime
        .block_on(runtime.spawn(async move {
            for n in 0..10 {
                tasks.send(n).await.unwrap();
            }
        }))
        .unwrap();
    assert!(system.join().finished());
    let names = names.lock().unwrap();
    assert!(!names.is_empty() && names.iter().all(|thread| thread.starts_with("masks/")), "{names:?}");
}
