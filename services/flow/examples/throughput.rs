//! What the dataflow itself costs: messages, ledger rows and artefacts per second.
//! `cargo run -p segwild-flow --example throughput`

use std::time::Instant;

use segwild_flow::ledger::ViewOutcome;
use segwild_flow::*;

struct SinkActor(u64);
impl Actor for SinkActor {
    type Message = u64;
    fn handle(&mut self, n: u64, _: &Context) -> Result<(), ActorFailure> {
        self.0 += n;
        Ok(())
    }
}

fn rate(what: &str, count: u64, work: impl FnOnce()) {
    let start = Instant::now();
    work();
    let seconds = start.elapsed().as_secs_f64();
    let each = seconds * 1e6 / count as f64;
    println!("{what:40} {:>12.0} /s {each:>10.2} us each", count as f64 / seconds);
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    rate("mailbox, one thread", 200_000, || {
        let (sender, receiver) = mailbox("m", Limits::default());
        for n in 0..200_000u64 {
            let _ = sender.try_send(n);
            let _ = receiver.try_recv();
        }
    });
    rate("mailbox, thread to thread", 200_000, || {
        let (sender, receiver) = mailbox("m", Limits::default());
        std::thread::scope(|scope| {
            scope.spawn(move || (0..200_000u64).all(|n| sender.blocking_send(n).is_ok()));
            while receiver.blocking_recv().is_some() {}
        });
    });
    let system = System::new(SystemOptions::default())?;
    let (sender, inbox) = mailbox("sink", Limits::default());
    rate("supervised actor, timed and labelled", 100_000, || {
        system.spawn(inbox, ActorOptions::default(), || Ok(SinkActor(0))).expect("a thread");
        (0..100_000u64).for_each(|n| sender.blocking_send(n).expect("open"));
        drop(sender);
        println!("{}", system.join());
    });
    let events = Events::new();
    let _listener = events.subscribe();
    rate("event sent", 100_000, || (0..100_000).for_each(|n| events.metric("s", "loss", 1.0, Some(n))));
    let ledger = Ledger::open(folder.path().join("run.sqlite"))?;
    let key = Key::of("masks").finish();
    rate("ledger, a view's row", 5000, || {
        for n in 0..5000 {
            ledger
                .record_view("masks", &format!("{n}.jpg"), &key, &ViewOutcome::done(0.1))
                .expect("writable");
        }
    });
    rate("ledger, a stage begun and done", 20, || {
        for n in 0..20 {
            ledger.start_stage(&format!("s{n}"), &key).expect("writable");
            ledger.finish_stage(&format!("s{n}"), &key, None).expect("writable");
        }
    });
    let cache = Cache::open(folder.path().join("cache"))?;
    let bytes = vec![7u8; 300 << 10];
    let keys: Vec<_> = (0..50).map(|n| Key::of("masks").value("n", n).finish()).collect();
    rate("cache, 300 KiB put", 50, || keys.iter().for_each(|k| cache.put(k, &bytes).expect("writable")));
    rate("cache, 300 KiB got and verified", 50, || {
        keys.iter().for_each(|k| assert!(cache.get(k).expect("readable").is_some()));
    });
    let floats = vec![0.5f32; 4 << 20];
    rate("codec, 16 MiB written and read", 10, || {
        for _ in 0..10 {
            let record = codec::encode("floats/1", &floats).expect("small enough");
            assert!(codec::decode::<Vec<f32>>("floats/1", &record).expect("whole").len() == floats.len());
        }
    });
    Ok(())
}
