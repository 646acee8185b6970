//! Explains what a run would do, and why: which stages are computed again, because of which setting or photo.
//!
//! Every stage has a key that hashes all it depends on ([`Keys`]). A changed setting is a cause if it alone changes the
//! stage's key; there is no table of dependencies.

use super::poses::scene_or_photos;
use super::prepare::UNTIL_STEP;
use super::stage::Stage;
use crate::artifacts::keys::{Digests, End, Keys, TrainingOrigin, photo_digest};
use crate::code;
use crate::run::choice;
use crate::run::continued::ContinuedTraining;
use crate::transients::Corrections;
use crate::{RunError, RunFolder, Settings, Until, choose_engine};
use segwild_flow::ledger::{StageRow, State};
use segwild_flow::{Cache, Ledger, files};
use segwild_scene::{PhotoStore, Scene};
use segwild_vision::{NetworkFile, Providers, VisionSettings};
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

/// What a run would do with a stage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "verdict")]
pub enum StageVerdict {
    /// The whole result is in the cache.
    Reused,
    /// The results of some photos are in the cache.
    Partly {
        /// Photos whose results would be made.
        made: usize,
        /// Photos in all.
        of: usize,
    },
    /// An interrupted training continues.
    GoesOn {
        /// From this step.
        step: u32,
    },
    /// The training has reached the requested step, and is not over.
    Stands {
        /// At this step.
        step: u32,
    },
    /// The trained scene is there, and its snapshot is not. Masks are proposed from the snapshot, so that the training
    /// is repeated up to it.
    SnapshotAgain {
        /// From the checkpoint at this step; 0 without one.
        from: u32,
        /// To this step.
        to: u32,
    },
    /// The training stops before the snapshot that the stage needs.
    NotReached,
    /// The stage would be computed from the start.
    Made,
}

/// One stage of the plan.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct StagePlan {
    /// The stage, one of [`Stage::LISTED`].
    pub stage: Stage,
    /// What the run would do with it.
    #[serde(flatten)]
    pub verdict: StageVerdict,
    /// Why, a phrase each; empty when it is reused.
    pub why: Vec<String>,
}

/// A run's scene and the keys that follow from its settings.
struct Situation {
    scene: Arc<Scene>,
    keys: Keys,
    networks: Vec<NetworkFile>,
    /// The photos whose transients were corrected by hand, in words.
    corrected: Option<String>,
    /// Where the training starts, if not at step 0.
    origin: Option<TrainingOrigin>,
    /// The step that the training ends at, or is to stop at.
    goal: u32,
    /// The step that the training ends at by its settings.
    end: u32,
    snapshot_step: u32,
}

fn situation(
    path: &Path,
    folder: &RunFolder,
    ledger: Option<&Ledger>,
    settings: &Settings,
    end: &End,
) -> Result<Situation, RunError> {
    let scene = match scene_or_photos(path, &settings.scene)? {
        Ok(scene) => scene,
        Err(_) => folder.open_posed(path, &settings.scene)?,
    };
    let providers = Providers::from_settings(&settings.vision)?;
    let steps_open = settings.steps_open(&scene);
    let settings = &settings.decided(&scene);
    let engine = choose_engine(&settings.run, drop)?.engine;
    let corrections = Corrections::find(&scene, folder, &settings.scene.transient_masks)?;
    let corrected = corrections.in_words(&scene);
    let scene = Arc::new(scene);
    // Without a cache: to explain a run changes nothing.
    let photos = PhotoStore::new(scene.clone(), settings.scene.size, 0);
    let digest = |view: usize| photo_digest(&scene.views[view]);
    let digests = Digests::read(&photos, &digest, settings, &|| false)?.without(&corrections);
    let named = |settings: &Settings, corrections: &Corrections, end: &End| {
        Keys::of(&scene, digests.clone(), settings, &providers, corrections, engine.name(), end)
    };
    let name = |settings: &Settings| named(settings, &corrections, end);
    // A choice that is still open leaves its `auto` in the key: all that depends on it is then to be made.
    let cache = Cache::at(folder.path().join("cache"));
    let settings = choice::decided_before(&cache, settings, steps_open, &name)?;
    let (mut keys, mut goal, mut origin) = (name(&settings), end.step(), None);
    if let (End::Settings, Some(ledger)) = (end, ledger) {
        let named = |corrections: &Corrections, end: &End| named(&settings, corrections, end);
        if let Some(continued) =
            ContinuedTraining::find(folder, ledger, &cache, &settings, &corrections, &named)?
        {
            (keys, goal, origin) = (continued.keys, Some(continued.origin.end), Some(continued.origin));
        }
    }
    let (end, snapshot_step) = (settings.train.steps, settings.train.snapshot_step());
    let networks = providers.networks;
    Ok(Situation { scene, keys, networks, corrected, origin, goal: goal.unwrap_or(end), end, snapshot_step })
}

/// Returns what [`crate::run()`] would do with these settings, without doing it. Works while another process runs.
///
/// # Errors
/// When the scene, the settings or the run folder cannot be used.
pub fn explain(
    path: &Path,
    folder: &RunFolder,
    settings: &Settings,
    until: Option<Until>,
) -> Result<Vec<StagePlan>, RunError> {
    folder.stays_inside()?;
    let settings = settings.anchored();
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let ledger = match folder.ledger().is_file() {
        true => Some(Ledger::open_read_only(folder.ledger())?),
        false => None,
    };
    let mut plans = Vec::new();
    if let Err(photos) = scene_or_photos(&path, &settings.scene)? {
        let poses = folder.poses().plan(&photos, &settings.poses)?;
        if !poses.is_done() {
            return Ok(without_poses(poses.why, until));
        }
        plans.push(StagePlan { stage: Stage::Poses, verdict: StageVerdict::Reused, why: Vec::new() });
        if until == Some(Until::Stage(Stage::Poses)) {
            return Ok(plans);
        }
    }
    let now = situation(&path, folder, ledger.as_ref(), &settings, &End::of(until))?;
    let before = match &ledger {
        Some(ledger) => Some(Before::read(ledger, &path, folder, &settings)?),
        None => None,
    };
    let cache = Cache::at(folder.path().join("cache"));
    for stage in Stage::LISTED.into_iter().filter(|stage| *stage != Stage::Poses) {
        let verdict = verdict(stage, &now, &cache, folder, ledger.as_ref())?;
        let why = match (&verdict, &before) {
            (StageVerdict::Reused | StageVerdict::Stands { .. } | StageVerdict::NotReached, _) => Vec::new(),
            (_, None) => vec!["the run is new".into()],
            _ if stage == Stage::Report => vec!["it is written at the end of every run".into()],
            (_, Some(before)) => before.why(stage, &now, &verdict, ledger.as_ref())?,
        };
        plans.push(StagePlan { stage, verdict, why });
        // The stages after the training need its end.
        if until == Some(Until::Stage(stage)) || stage == Stage::Geometry && now.goal < now.end {
            break;
        }
    }
    Ok(plans)
}

/// What a run would do whose poses are to be computed: what depends on them is not known before.
fn without_poses(why: Vec<String>, until: Option<Until>) -> Vec<StagePlan> {
    let last = match until {
        Some(Until::Stage(stage)) => stage,
        Some(Until::Step(_)) => Stage::Geometry,
        None => Stage::Report,
    };
    let plan = |stage: Stage| {
        let why = if stage == Stage::Poses { why.clone() } else { vec!["it waits for the poses".into()] };
        StagePlan { stage, verdict: StageVerdict::Made, why }
    };
    Stage::LISTED.into_iter().filter(|stage| *stage <= last).map(plan).collect()
}

fn verdict(
    stage: Stage,
    now: &Situation,
    cache: &Cache,
    folder: &RunFolder,
    ledger: Option<&Ledger>,
) -> Result<StageVerdict, RunError> {
    let keys = &now.keys;
    if stage == Stage::Geometry {
        return geometry(now, cache, folder, ledger);
    }
    if stage == Stage::Masks && now.goal < now.snapshot_step && !cache.contains(&keys.snapshot) {
        return Ok(StageVerdict::NotReached);
    }
    let per_view = match stage {
        Stage::Sky => Some((&keys.sky, true)),
        Stage::Embed => Some((&keys.embedding, false)),
        Stage::Masks => Some((&keys.masks, false)),
        _ => None,
    };
    if let Some((keys_of_stage, with_test)) = per_view {
        let views: Vec<usize> = (0..now.scene.views.len())
            .filter(|&i| (with_test || !now.scene.views[i].test) && keys.unreadable(i).is_none())
            .collect();
        let made = views.iter().filter(|&&i| !cache.contains(&keys_of_stage[i])).count();
        return Ok(match made {
            0 => StageVerdict::Reused,
            _ if made == views.len() => StageVerdict::Made,
            _ => StageVerdict::Partly { made, of: views.len() },
        });
    }
    let there = match stage {
        Stage::Features => cache.contains(&keys.features),
        Stage::Evaluate | Stage::Objects => match ledger {
            Some(ledger) => ledger.stage_is_done(stage.name(), &keys.stage(stage))?,
            None => false,
        },
        _ => false,
    };
    Ok(if there { StageVerdict::Reused } else { StageVerdict::Made })
}

/// What a run would do with the training: the same decision as in the start of the stage `geometry`.
fn geometry(
    now: &Situation,
    cache: &Cache,
    folder: &RunFolder,
    ledger: Option<&Ledger>,
) -> Result<StageVerdict, RunError> {
    let (trained, snapshot) = (cache.contains(&now.keys.geometry), cache.contains(&now.keys.snapshot));
    if trained && snapshot {
        return Ok(StageVerdict::Reused);
    }
    let mut steps: Vec<u32> = Vec::new();
    if let Some(ledger) = ledger {
        let rows = ledger.checkpoints(Stage::Geometry.name(), &now.keys.training)?;
        // A run passes over checkpoints that are gone or whose content has changed.
        let whole = rows.iter().filter(|row| {
            let bytes = folder.checkpoint(row).and_then(|path| files::read_plain(&path).ok());
            bytes.is_some_and(|bytes| blake3::hash(&bytes).to_hex().as_str() == row.digest)
        });
        // Without the snapshot, the training has to pass the snapshot step again.
        steps.extend(whole.map(|row| row.step as u32).filter(|&step| snapshot || step < now.snapshot_step));
    }
    // A continued training starts from the last step of another, until it has a checkpoint of its own.
    steps.extend(now.origin.as_ref().filter(|_| snapshot).map(|origin| origin.step));
    let last_before = |end: u32| steps.iter().copied().filter(|&step| step <= end).max();
    if trained {
        let from = last_before(now.snapshot_step).unwrap_or(0);
        return Ok(StageVerdict::SnapshotAgain { from, to: now.snapshot_step });
    }
    if let Some(step) = last_before(u32::MAX).filter(|&step| now.goal < now.end && step >= now.goal) {
        return Ok(StageVerdict::Stands { step });
    }
    Ok(last_before(now.goal).map_or(StageVerdict::Made, |step| StageVerdict::GoesOn { step }))
}

/// The inputs of the run when it was last started.
struct Before {
    stages: Vec<StageRow>,
    /// Settings that differ: name, old, new.
    changed: Vec<(String, String, String)>,
    /// The old settings with the present photos.
    then: Situation,
    /// Per changed setting, the keys when it alone changes.
    alone: Vec<Keys>,
    /// Photos that a stage gave up: stage, view.
    given_up: Vec<(Stage, usize)>,
    /// The old keys, without the photos that were given up.
    without_given_up: Keys,
    /// How the networks differ from those that the run was made with.
    networks: Vec<String>,
}

impl Before {
    fn read(
        ledger: &Ledger,
        path: &Path,
        folder: &RunFolder,
        settings: &Settings,
    ) -> Result<Before, RunError> {
        let mut old = settings.clone();
        let (mut changed, mut end) = (Vec::new(), End::Settings);
        for (name, value) in ledger.settings()? {
            if name == UNTIL_STEP {
                end = value.parse().map_or(End::Settings, End::Step);
                continue;
            }
            // Paths of code come from the present command only: see `Code`.
            if VisionSettings::CODE.contains(&name.as_str()) {
                continue;
            }
            let new = settings.get(&name).unwrap_or_default();
            // A setting that this program no longer has, or whose old value it refuses, is passed over.
            if new != value && old.set(&name, &value).is_ok() {
                changed.push((name, value, new));
            }
        }
        let then = situation(path, folder, Some(ledger), &old, &end)?;
        let mut alone = Vec::new();
        for (name, _, value) in &changed {
            let mut one = old.clone();
            one.set(name, value).map_err(crate::SettingsError::from)?;
            alone.push(situation(path, folder, Some(ledger), &one, &end)?.keys);
        }
        let mut given_up = Vec::new();
        for (stage, keys) in [
            (Stage::Sky, &then.keys.sky),
            (Stage::Embed, &then.keys.embedding),
            (Stage::Masks, &then.keys.masks),
            (Stage::Visibility, &then.keys.visibility),
            // The scores have one key for all photos, so that the skies' keys, one per view, stand in.
            (Stage::Evaluate, &then.keys.sky),
        ] {
            for row in ledger.views(stage.name())?.iter().filter(|row| row.outcome.state == State::Failed) {
                // A result without another photo's sky has another key; the photo counts all the same.
                let of_then = |i: &usize| {
                    matches!(stage, Stage::Masks | Stage::Visibility | Stage::Evaluate)
                        || keys[*i].to_string() == row.key
                };
                let view = (0..keys.len()).filter(of_then).find(|&i| then.scene.views[i].name == row.view);
                given_up.extend(view.map(|view| (stage, view)));
            }
        }
        let by = |stage: Stage, test: bool| -> BTreeSet<usize> {
            let views = given_up.iter().filter(|(s, _)| *s == stage).map(|(_, view)| *view);
            views.filter(|&view| then.scene.views[view].test == test).collect()
        };
        let mut without_given_up = then.keys.without_skies(&by(Stage::Sky, false), &by(Stage::Sky, true));
        without_given_up.features = without_given_up.features_without(
            &by(Stage::Embed, false),
            &by(Stage::Masks, false),
            &by(Stage::Visibility, false),
        );
        without_given_up.evaluation = without_given_up.evaluation_without(&by(Stage::Evaluate, true));
        let networks = code::changes(&code::recorded(folder), &then.networks);
        Ok(Before { stages: ledger.stages()?, changed, then, alone, given_up, without_given_up, networks })
    }

    /// The photos that a stage gave up before and now tries again, in words.
    fn tried_again(&self) -> String {
        let name =
            |(stage, view): &(Stage, usize)| format!("{stage} of {}", self.then.scene.views[*view].name);
        let names: Vec<String> = self.given_up.iter().take(3).map(name).collect();
        let more = self.given_up.len().saturating_sub(names.len());
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        format!("given up before and tried again: {}{more}", names.join(", "))
    }

    fn why(
        &self,
        stage: Stage,
        now: &Situation,
        verdict: &StageVerdict,
        ledger: Option<&Ledger>,
    ) -> Result<Vec<String>, RunError> {
        let Some(row) = self.stages.iter().find(|row| row.name == stage.name()) else {
            return Ok(vec!["it was not done before".into()]);
        };
        let mut why = Vec::new();
        let then = self.then.keys.stage(stage);
        for ((name, old, new), keys) in self.changed.iter().zip(&self.alone) {
            let snapshot = stage == Stage::Geometry && keys.snapshot != self.then.keys.snapshot;
            if keys.stage(stage) != then || snapshot {
                why.push(format!("{name}: {} -> {}", shown(old), shown(new)));
            }
        }
        if row.key != then.to_string() {
            let lacked = row.key == self.without_given_up.stage(stage).to_string();
            why.push(if lacked { self.tried_again() } else { self.inputs(ledger)? });
        }
        let (was, goal) = (self.then.goal, now.goal);
        if was != goal && (why.is_empty() && now.keys.stage(stage).to_string() != row.key) {
            why.push(format!("the training is to end at step {goal}, and was to end at step {was}"));
            if stage == Stage::Geometry && *verdict == StageVerdict::Made {
                why.push(format!("there is no checkpoint of it at or before step {goal}"));
            }
        }
        if why.is_empty() {
            why.push(match row.state {
                State::Done => "its results have gone from the cache".into(),
                State::Failed => {
                    format!("it failed: {}", row.error.as_deref().unwrap_or("for an unknown reason"))
                }
                State::Running => "another process is working on it, or was killed".into(),
                State::Pending => "it was interrupted".into(),
            });
        }
        Ok(why)
    }

    /// Which photos are new, gone or changed, in words. The keys of the skies show it, since every photo has one.
    fn inputs(&self, ledger: Option<&Ledger>) -> Result<String, RunError> {
        let known = match ledger {
            Some(ledger) => ledger.views(Stage::Sky.name())?,
            None => Vec::new(),
        };
        let views = &self.then.scene.views;
        let mut odd = Vec::new();
        for (view, key) in views.iter().zip(&self.then.keys.sky) {
            match known.iter().find(|row| row.view == view.name) {
                None => odd.push(format!("{} is new", view.name)),
                Some(row) if row.key != key.to_string() => odd.push(format!("{} has changed", view.name)),
                Some(_) => {}
            }
        }
        for row in &known {
            if !views.iter().any(|view| view.name == row.view) {
                odd.push(format!("{} is gone", row.view));
            }
        }
        Ok(match odd.len() {
            0 => match &self.then.corrected {
                Some(words) => words.clone(),
                None if !self.networks.is_empty() => self.networks.join("; "),
                None => "points, cameras or masks of transients have changed, or the run was made by another version".into(),
            },
            1..=3 => odd.join(", "),
            n => format!("{} and {} more photos", odd[..2].join(", "), n - 2),
        })
    }
}

fn shown(value: &str) -> &str {
    if value.is_empty() { "''" } else { value }
}

#[cfg(test)]
mod tests {
    use super::shown;

    #[test]
    fn a_value_that_is_left_out_is_not_taken_for_the_value_none() {
        assert_ne!(shown(""), shown("none"));
        assert_eq!(shown(""), "''");
    }
}
