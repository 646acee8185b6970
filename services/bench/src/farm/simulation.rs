//! A farm simulated: the engine's own state machine, with workers that take time, fall silent and come back.
//!
//! Nothing of it waits: events are taken in the order of their time. The same seed gives the same farm.

use segwild_farm::{
    Decision, ErrorClass, Job, JobLease, JobState, JobTable, Needs, Retry, Transition, WorkerOffer,
};
use segwild_scene::Random;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// How a farm is simulated.
#[derive(Clone, Copy, Debug)]
pub struct SimulatedFarm {
    /// Scenes that are handed in at the start.
    pub scenes: usize,
    /// Machines.
    pub workers: usize,
    /// What is random follows from it.
    pub seed: u64,
}

/// How a simulated farm worked.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SimulatedFigures {
    /// The seed.
    pub seed: u64,
    /// Scenes that are done.
    pub done: usize,
    /// Dead letters.
    pub dead: usize,
    /// Scenes that can only become one.
    pub hopeless: usize,
    /// Scenes that are neither, at the end.
    pub lost: usize,
    /// Scenes that were completed more than once.
    pub completed_twice: usize,
    /// Until everything was done, in hours.
    pub hours: f64,
    /// That over the ideal: the work divided by all cores, or the longest scene where that takes longer. No farm is faster
    /// than 1.
    pub over_ideal: f64,
    /// Part of all core time that was worked while a scene was waiting.
    pub busy: f64,
    /// Part of the core time that was worked which had to be worked again.
    pub redone: f64,
    /// How long an urgent scene that needs a whole large machine waited at most, in minutes.
    pub urgent_wait_min: f64,
    /// How many scenes that were behind it in the queue (less urgent, or handed in later) at most were started before a scene of
    /// the start. Smaller ones may pass where it fits nowhere.
    pub overtaken: usize,
    /// From when no scene was waiting any more until the end, over the time of the longest scene.
    pub tail: f64,
    /// How often a machine fell silent.
    pub silences: usize,
    /// Records of the log.
    pub records: u64,
    /// How many there were a second.
    pub records_per_s: f64,
}

/// A lease lasts so long, and is renewed three times in it, in seconds.
const LEASE_S: f64 = 60.0;
/// A scene's state is stored so often, in seconds.
const STORE_S: f64 = 60.0;
/// A machine with nothing to do asks again after so many seconds.
const ASK_S: f64 = 5.0;
/// A machine falls silent after so many hours on average, and is back after so many seconds.
const DEATHS: (f64, f64) = (12.0, 300.0);
/// The server is out of reach once: from when, in hours, and for how many seconds.
const OUTAGE: (f64, f64) = (1.0, 600.0);
/// Urgent scenes that need a large machine alone come at this time, in hours.
const URGENT_AT: f64 = 0.5;
const URGENT: usize = 20;
const LARGE: u32 = 16;

/// What a scene is like. Nobody knows it before it ran.
#[derive(Clone, Copy, PartialEq)]
enum Nature {
    Sound,
    /// Its first attempt fails half way.
    Flaky,
    /// Its photos cannot be used.
    Bad,
    /// It takes its machine down, whenever it is tried.
    Poison,
}

struct SimulatedScene {
    nature: Nature,
    /// In core seconds.
    work: f64,
    /// What is stored of it.
    stored: f64,
    attempts: u32,
    completed: usize,
}

struct Running {
    lease: JobLease,
    /// What the scene has of the machine: all of it where it must be alone.
    granted: Needs,
    began: f64,
    /// What was stored when it began.
    from: f64,
    renewed: f64,
}

struct Machine {
    whole: Needs,
    /// Events of an earlier life are void.
    life: u32,
    running: Vec<Running>,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Happening {
    /// The machine asks for work.
    Asks,
    /// It renews leases and stores states.
    Beats,
    /// A scene of it ends: the scene and the attempt.
    Ends(usize, u32),
    /// It falls silent.
    Dies,
    /// It is back.
    Returns,
    /// Urgent scenes are handed in.
    Urgent,
    /// The server can be reached again.
    Back,
}

/// Taken by time, then in the order in which they were planned.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Planned {
    at_ms: u64,
    number: u64,
    machine: usize,
    life: u32,
    happening: Happening,
}

struct FarmState {
    table: JobTable,
    scenes: Vec<SimulatedScene>,
    machines: Vec<Machine>,
    events: BinaryHeap<Reverse<Planned>>,
    planned: u64,
    now: f64,
    random: Random,
    records: u64,
    worked: f64,
    useful: f64,
    last_claim: f64,
    /// Core time that was worked up to then.
    worked_then: f64,
    longest: f64,
    urgent: BTreeMap<usize, f64>,
    urgent_wait: f64,
    /// Scenes of the start, in the order in which they were first started.
    started: Vec<usize>,
    silences: usize,
}

impl SimulatedFarm {
    /// Simulates it to the end.
    pub fn run(&self) -> SimulatedFigures {
        let mut random = Random::new(self.seed);
        let machines = (0..self.workers)
            .map(|_| {
                let cores = [4, 8, LARGE][random.below(3)];
                let whole = Needs { cores, memory_bytes: u64::from(cores) << 32, accelerators: 0 };
                Machine { whole, life: 0, running: Vec::new() }
            })
            .collect();
        let mut farm = FarmState {
            table: JobTable::default(),
            scenes: Vec::new(),
            machines,
            events: BinaryHeap::new(),
            planned: 0,
            now: 0.0,
            random,
            records: 0,
            worked: 0.0,
            useful: 0.0,
            last_claim: 0.0,
            worked_then: 0.0,
            longest: 0.0,
            urgent: BTreeMap::new(),
            urgent_wait: 0.0,
            started: Vec::with_capacity(self.scenes),
            silences: 0,
        };
        for i in 0..self.scenes {
            let nature = match i % 1000 {
                0..10 => Nature::Bad,
                10..40 => Nature::Flaky,
                40..42 => Nature::Poison,
                _ => Nature::Sound,
            };
            let cores = [1, 1, 2, 4][farm.random.below(4)];
            farm.hand_in(nature, cores, farm_priority(i));
        }
        for machine in 0..self.workers {
            // They do not all start in the same instant.
            let start = f64::from(farm.random.uniform()) * 60.0;
            farm.plan(start, machine, Happening::Asks);
            farm.plan(start + LEASE_S / 3.0, machine, Happening::Beats);
            farm.plan_death(machine);
        }
        farm.plan(URGENT_AT * 3600.0, 0, Happening::Urgent);
        farm.plan(OUTAGE.0 * 3600.0 + OUTAGE.1, 0, Happening::Back);
        farm.run();
        farm.figures(self.seed)
    }
}

/// A few scenes are a little more urgent than others.
fn farm_priority(i: usize) -> i32 {
    i32::from(i.is_multiple_of(7))
}

/// How many scenes that were behind it at most were started before a scene.
fn most_overtaken(started: &[usize]) -> usize {
    let turn = |scene: usize| (Reverse(farm_priority(scene)), scene);
    let passed_by = |i: usize| started[..i].iter().filter(|before| turn(**before) > turn(started[i])).count();
    (0..started.len()).map(passed_by).max().unwrap_or_default()
}

impl FarmState {
    fn plan(&mut self, at: f64, machine: usize, happening: Happening) {
        self.planned += 1;
        let life = self.machines.get(machine).map_or(0, |m| m.life);
        let (at_ms, number) = ((at * 1000.0) as u64, self.planned);
        self.events.push(Reverse(Planned { at_ms, number, machine, life, happening }));
    }

    fn plan_death(&mut self, machine: usize) {
        let hours = -DEATHS.0 * f64::from(1.0 - self.random.uniform()).ln();
        self.plan(self.now + hours * 3600.0, machine, Happening::Dies);
    }

    /// Appends what was decided, as one record.
    fn append<A>(&mut self, decision: Decision<A>) -> Option<A> {
        if !decision.transitions.is_empty() {
            self.records += 1;
            for transition in &decision.transitions {
                self.table.apply(transition, self.now, self.records);
            }
        }
        decision.answer.ok()
    }

    fn is_out_of_reach(&self) -> bool {
        (OUTAGE.0 * 3600.0..OUTAGE.0 * 3600.0 + OUTAGE.1).contains(&self.now)
    }

    fn hand_in(&mut self, nature: Nature, cores: u32, priority: i32) -> usize {
        let work = 1800.0 * f64::from(self.random.normal() * 0.6).exp();
        let i = self.scenes.len();
        self.scenes.push(SimulatedScene { nature, work, stored: 0.0, attempts: 0, completed: 0 });
        let needs = Needs { cores, memory_bytes: u64::from(cores) << 32, accelerators: 0 };
        let job = Job { priority, retry: Retry::default(), ..Job::new(format!("{i:05}"), "{}", needs) };
        self.append(self.table.publish(&job));
        i
    }

    fn run(&mut self) {
        let open = |table: &JobTable| {
            table.jobs().any(|job| matches!(job.state, JobState::Pending | JobState::Leased))
        };
        let mut checked = 0.0;
        while let Some(Reverse(planned)) = self.events.pop() {
            let Planned { at_ms, machine, life, happening, .. } = planned;
            self.now = at_ms as f64 / 1000.0;
            let is_void = self.machines.get(machine).is_some_and(|m| m.life != life);
            if is_void && !matches!(happening, Happening::Urgent | Happening::Back) {
                continue;
            }
            match happening {
                Happening::Asks => self.asks(machine),
                Happening::Beats => self.beats(machine),
                Happening::Ends(scene, attempt) => self.ends(machine, scene, attempt),
                Happening::Dies => self.dies(machine, DEATHS.1),
                Happening::Returns => {
                    self.plan(self.now, machine, Happening::Asks);
                    self.plan(self.now + LEASE_S / 3.0, machine, Happening::Beats);
                    self.plan_death(machine);
                }
                Happening::Urgent => {
                    for _ in 0..URGENT {
                        let scene = self.hand_in(Nature::Sound, LARGE, 9);
                        self.urgent.insert(scene, self.now);
                    }
                }
                Happening::Back => {
                    // Who comes back first notes how long nobody could renew a lease.
                    let moved = Transition::TimesMoved { seconds: OUTAGE.1, since: u64::MAX };
                    self.append(Decision { transitions: vec![moved], answer: Ok(()) });
                }
            }
            if self.now - checked > 60.0 {
                checked = self.now;
                if !open(&self.table) {
                    break;
                }
            }
        }
    }

    /// Asks for work, now and later.
    fn asks(&mut self, machine: usize) {
        self.takes(machine);
        self.plan(self.now + ASK_S, machine, Happening::Asks);
    }

    /// Takes what fits.
    fn takes(&mut self, machine: usize) {
        while !self.is_out_of_reach() {
            let of = &self.machines[machine];
            let free = of.running.iter().fold(of.whole, |free, r| r.granted.taken_from(&free));
            let offer = WorkerOffer { free, ..WorkerOffer::all(machine.to_string(), of.whole, LEASE_S) };
            if free.cores == 0 {
                break;
            }
            let Some(Some(id)) = self.append(self.table.claim(&offer, self.now)) else { break };
            self.starts(machine, &id);
        }
    }

    fn starts(&mut self, machine: usize, id: &str) {
        let Some(status) = self.table.job(id) else { return };
        let scene: usize = id.parse().unwrap_or_default();
        let lease = JobLease {
            job: status.job.clone(),
            attempt: status.attempt,
            worker: machine.to_string(),
            failures: status.failures,
            until: self.now + LEASE_S,
            lease_s: LEASE_S,
            checkpoint: status.checkpoint.clone(),
            alone: status.must_be_alone(),
        };
        if let Some(since) = self.urgent.remove(&scene) {
            self.urgent_wait = self.urgent_wait.max(self.now - since);
        } else if self.scenes[scene].attempts == 0 {
            self.started.push(scene);
        }
        self.last_claim = self.now;
        let under_way = self.machines.iter().flat_map(|m| &m.running);
        let cores = |r: &Running| f64::from(r.lease.job.needs.cores);
        self.worked_then = self.worked + under_way.map(|r| (self.now - r.began) * cores(r)).sum::<f64>();
        let of = &mut self.scenes[scene];
        of.attempts += 1;
        let cores = f64::from(lease.job.needs.cores);
        let left = (of.work - of.stored) / cores;
        self.longest = self.longest.max(of.work / cores);
        let lasts = match of.nature {
            Nature::Bad => 5.0,
            Nature::Poison => 30.0,
            Nature::Flaky if of.attempts == 1 => left / 2.0,
            _ => left,
        };
        let (attempt, from) = (lease.attempt, of.stored);
        let machine_of = &mut self.machines[machine];
        let granted = if lease.alone { machine_of.whole } else { lease.job.needs };
        machine_of.running.push(Running { lease, granted, began: self.now, from, renewed: self.now });
        self.plan(self.now + lasts, machine, Happening::Ends(scene, attempt));
    }

    /// Renews leases and stores states.
    fn beats(&mut self, machine: usize) {
        self.plan(self.now + LEASE_S / 3.0, machine, Happening::Beats);
        if self.is_out_of_reach() {
            return;
        }
        let mut kept = Vec::new();
        for mut running in std::mem::take(&mut self.machines[machine].running) {
            if self.append(self.table.heartbeat(&running.lease)).is_none() {
                // Lost: its process is ended.
                self.account(&running);
                continue;
            }
            if self.now - running.renewed >= STORE_S {
                running.renewed = self.now;
                let scene: usize = running.lease.job.id.parse().unwrap_or_default();
                self.scenes[scene].stored = self.progress(&running);
                self.append(self.table.checkpoint(&running.lease, "stored"));
            }
            kept.push(running);
        }
        self.machines[machine].running = kept;
    }

    fn progress(&self, running: &Running) -> f64 {
        running.from + (self.now - running.began) * f64::from(running.lease.job.needs.cores)
    }

    fn account(&mut self, running: &Running) {
        self.worked += (self.now - running.began) * f64::from(running.lease.job.needs.cores);
    }

    fn ends(&mut self, machine: usize, scene: usize, attempt: u32) {
        let ours = |r: &Running| r.lease.attempt == attempt && r.lease.job.id == format!("{scene:05}");
        let Some(i) = self.machines[machine].running.iter().position(ours) else { return };
        if self.scenes[scene].nature == Nature::Poison {
            return self.dies(machine, DEATHS.1);
        }
        if self.is_out_of_reach() {
            return self.plan(self.now + 1.0, machine, Happening::Ends(scene, attempt));
        }
        let running = self.machines[machine].running.remove(i);
        self.account(&running);
        let of = &self.scenes[scene];
        let class = match of.nature {
            Nature::Bad => Some(ErrorClass::Fatal),
            Nature::Flaky if of.attempts == 1 => Some(ErrorClass::Retryable),
            _ => None,
        };
        match class {
            Some(class) => drop(self.append(self.table.fail(&running.lease, class, "no luck"))),
            None => {
                if self.append(self.table.complete(&running.lease, "{}")).is_some() {
                    self.scenes[scene].completed += 1;
                    self.useful += self.scenes[scene].work;
                }
            }
        }
        self.takes(machine);
    }

    fn dies(&mut self, machine: usize, back_s: f64) {
        self.silences += 1;
        let running = std::mem::take(&mut self.machines[machine].running);
        running.iter().for_each(|running| self.account(running));
        self.machines[machine].life += 1;
        self.plan(self.now + back_s, machine, Happening::Returns);
    }

    fn figures(&self, seed: u64) -> SimulatedFigures {
        let count = |state: JobState| self.table.jobs().filter(|job| job.state == state).count();
        let (done, dead) = (count(JobState::Done), count(JobState::Dead));
        let hopeless =
            self.scenes.iter().filter(|s| matches!(s.nature, Nature::Bad | Nature::Poison)).count();
        let end = self.table.jobs().filter_map(|job| job.ended).fold(0.0, f64::max);
        let cores: u32 = self.machines.iter().map(|m| m.whole.cores).sum();
        SimulatedFigures {
            seed,
            done,
            dead,
            hopeless,
            lost: self.scenes.len() - done - dead,
            completed_twice: self.scenes.iter().filter(|s| s.completed > 1).count(),
            hours: end / 3600.0,
            over_ideal: end / (self.useful / f64::from(cores)).max(self.longest),
            busy: self.worked_then / (f64::from(cores) * self.last_claim),
            redone: 1.0 - self.useful / self.worked,
            urgent_wait_min: self.urgent_wait / 60.0,
            overtaken: most_overtaken(&self.started),
            tail: (end - self.last_claim) / self.longest,
            silences: self.silences,
            records: self.records,
            records_per_s: self.records as f64 / end,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_simulated_farm_loses_and_doubles_nothing_and_is_the_same_for_a_seed() {
        let farm = SimulatedFarm { scenes: 1000, workers: 12, seed: 7 };
        let found = farm.run();
        assert_eq!((found.lost, found.completed_twice), (0, 0));
        assert_eq!(found.dead, found.hopeless, "who is hopeless and nobody else is given up");
        assert!(found.silences > 6, "the machines do fall silent: {}", found.silences);
        assert!((1.0..2.0).contains(&found.over_ideal), "{}", found.over_ideal);
        assert!((0.7..=1.0).contains(&found.busy), "{}", found.busy);
        assert!(found.urgent_wait_min < 120.0, "{}", found.urgent_wait_min);
        assert_eq!(found, farm.run());
    }

    #[test]
    fn a_scene_is_overtaken_by_later_ones_that_start_first() {
        // Multiples of 7 are more urgent, then the first one goes first.
        assert_eq!(most_overtaken(&[0, 7, 14, 1, 2, 3]), 0);
        assert_eq!(most_overtaken(&[1, 0, 2, 7, 3]), 2, "1 and 2 are behind 7");
        assert_eq!(most_overtaken(&[0, 2, 3, 4, 1]), 3);
        assert_eq!(most_overtaken(&[]), 0);
    }
}
