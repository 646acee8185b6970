//! The dataflow with models on other machines: services of this process, which wait as a machine with an accelerator makes us
//! wait, behind real connections.

use super::overlap::{PAIRS, RunPair, median, timed};
use super::row::{FlowError, FlowOptions, Row, io};
use super::scene::{fresh, settings, write_scene};
use super::waiting::{Waits, wait, waiting};
use segwild_pipeline::RunError;
use segwild_vision::{Providers, SkyChoice, VisionServer, VisionServiceOptions, serve_vision};
use std::net::{Ipv4Addr, SocketAddr};
use std::time::{Duration, Instant};

/// Time after which a service that was killed is started again.
const DOWNTIME: Duration = Duration::from_secs(1);
/// Bytes of photos that a service keeps.
const IMAGES: usize = 64 << 20;
/// Time in which a port that was used must be free again.
const PORT_FREE: Duration = Duration::from_secs(5);

fn start(providers: &Providers, address: SocketAddr) -> std::io::Result<VisionServer> {
    let began = Instant::now();
    loop {
        let options = VisionServiceOptions { address, token: None, memory: IMAGES, parallel: 1, tls: None };
        match serve_vision(providers.clone(), options) {
            Err(error) if error.kind() == std::io::ErrorKind::AddrInUse && began.elapsed() < PORT_FREE => {
                wait(Duration::from_millis(10));
            }
            started => return started,
        }
    }
}

/// The wall time over the longest chain of work that cannot overlap: with two services, and when one of them is killed on the way
/// and comes back; and how many calls a second run makes.
///
/// Three chains of work could be the longest. Skies come before the training, and the training up to the snapshot before the
/// masks. Embeddings are a chain of their own. And the services are one, since skies, embeddings and masks share them: a run cannot
/// end before its services have computed all its calls, which takes the time of all calls over the number of calls that are
/// computed at a time. After each chain come the stages that need all of it.
///
/// Only the time in which a service computes is counted, measured in the services. So the ratio grows when a service is idle
/// while a call could be made, when a call is on its way, and when a service computes the wrong calls first, so that the training
/// waits and nothing is left to compute meanwhile.
///
/// The run in which a service is killed is compared with the chain of the undisturbed run: that the service is away, and that its
/// calls are computed again, is part of the ratio.
pub fn remote(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("remote"))?;
    let scene = dir.join("scene");
    write_scene(&scene, 30, 96)?;
    let mut settings =
        settings(&[("size", "96"), ("steps", "1000"), ("refine_steps", "40"), ("prompt_budget", "24")])?;
    let vision = |settings: &_| Providers::from_settings(settings).map_err(RunError::from);
    let ms = Duration::from_millis;
    // Twice the waits of `overlap`: both services together are as fast as the provider there.
    let waits = Waits { sky: ms(80), embed: ms(240), masks: ms(240), accelerator: false };
    let waiting = waiting(&vision(&settings.vision)?, waits);
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let started = |address| io("start a vision service", start(&waiting, address));
    let (first, mut second) = (started(any)?, started(any)?);
    let address = second.address();
    settings.vision.vision_service = format!("grpc://{},grpc://{address}", first.address());
    settings.vision.sky = SkyChoice::Service;
    let providers = vision(&settings.vision)?;

    // Each computes one call at a time.
    let busy = || (first.busy() + second.busy()).as_secs_f64() / 2.0;
    let pairs = RunPair::measure_all(&scene, &dir, &settings, &providers, busy)?;
    let (pair, value, spread) = median(&pairs, |p| p.whole.wall / p.chain().0);
    let (wall, chain) = (pair.whole.wall, pair.chain());
    let mut rows = vec![Row {
        name: "remote".into(),
        what: "wall time over the longest chain, with two vision services".into(),
        value,
        bar: 1.10,
        from: format!("{spread}; that one: wall {wall:.2} s, chain {}", chain.1),
        load: None,
    }];

    let (mut killed, mut absence) = (Vec::new(), Duration::ZERO);
    for _ in 0..PAIRS {
        let folder = fresh(&dir.join("killed"))?;
        let third = Duration::from_secs_f64(wall / 3.0);
        let (run, back) = std::thread::scope(|scope| {
            let killer = scope.spawn(|| {
                wait(third);
                let gone = Instant::now();
                drop(second);
                wait(DOWNTIME);
                started(address).map(|back| (back, gone.elapsed()))
            });
            let run = timed(&scene, &folder, &settings, &providers, None);
            (run, killer.join().expect("it does not panic"))
        });
        (second, absence) = back?;
        killed.push(run?.wall / chain.0);
    }
    killed.sort_by(f64::total_cmp);
    let ratios: Vec<String> = killed.iter().map(|ratio| format!("{ratio:.3}")).collect();
    rows.push(Row {
        name: "remote, one killed".into(),
        what: "the same, when one of them is killed after a third of the run and comes back a second later"
            .into(),
        value: killed[killed.len() / 2],
        bar: 1.10,
        from: format!(
            "median of {}; it was away for {:.2} s, while the other one computed alone: {:.3} of the ratio",
            ratios.join(" "),
            absence.as_secs_f64(),
            absence.as_secs_f64() / 2.0 / chain.0
        ),
        load: None,
    });

    let before = first.computed() + second.computed();
    timed(&scene, &dir.join("killed"), &settings, &providers, None)?;
    rows.push(Row {
        name: "remote, second run".into(),
        what: "calls that the services compute for a second run".into(),
        value: (first.computed() + second.computed() - before) as f64,
        bar: 0.0,
        from: format!("{before} calls before"),
        load: None,
    });
    Ok(rows)
}
