//! Explains what a run would do, and why: which stages are computed again, because of which setting or photo.
//!
//! Every stage has a key that hashes all it depends on ([`Keys`]). A changed setting is a cause if it alone changes the
//! stage's key; there is no table of dependencies.

use super::graph::node_of;
use super::poses::scene_or_photos;
use super::prepare::UNTIL_STEP;
use super::results::{StageResults, StageVerdict};
use super::situation::{KeptResults, Situation};
use super::stage::Stage;
use super::stages::NODES;
use super::time::{TimeMeasurement, fits_time};
use crate::artifacts::blocks;
use crate::artifacts::keys::{End, Keys};
use crate::code;
use crate::{RunError, RunFolder, Settings, Until, choose_engine};
use segwild_flow::ledger::{StageRow, State};
use segwild_flow::{Cache, Key, Ledger};
use segwild_scene::{few_of_photos, named_and_counted};
use segwild_trainer::AppearanceModel;
use segwild_vision::{Providers, VisionSettings};
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::Path;

/// One stage of the plan.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct StagePlan {
    /// The stage, one of [`Stage::all_listed`].
    pub stage: Stage,
    /// What the run would do with it.
    #[serde(flatten)]
    pub verdict: StageVerdict,
    /// Why, a phrase each; empty when it is reused.
    pub why: Vec<String>,
}

/// Returns what [`crate::run()`] would do with these settings, without doing it. Works while another process runs.
///
/// # Errors
/// When the scene, the settings or the run folder cannot be used, or the folder is the run of another scene.
pub fn explain(
    path: &Path,
    folder: &RunFolder,
    settings: &Settings,
    until: Option<Until>,
) -> Result<Vec<StagePlan>, RunError> {
    folder.stays_inside()?;
    let settings = settings.anchored();
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let ledger = ledger_of(folder)?;
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
    let now = Situation::of(&path, folder, ledger.as_ref(), &settings, &Until::end(until))?;
    folder.belongs_to(&path, &now.scene)?;
    let before = match &ledger {
        Some(ledger) => Some(Before::read(ledger, &path, folder, &settings)?),
        None => None,
    };
    let cache = Cache::at(folder.path().join("cache"));
    let kept = KeptResults { cache: &cache, folder, ledger: ledger.as_ref() };
    for stage in Stage::all_listed().filter(|stage| *stage != Stage::Poses) {
        let results = node_of(stage).results;
        let verdict = results.verdict(stage.name(), &now, &kept)?;
        let why = match (&verdict, &before) {
            (StageVerdict::Reused | StageVerdict::Stands { .. } | StageVerdict::NotReached, _) => Vec::new(),
            (_, None) => vec!["the run is new".into()],
            _ if matches!(results, StageResults::Rewritten(_)) => {
                vec!["it is written at the end of every run".into()]
            }
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

/// The ledger of a run folder; `None` where nothing has run in it yet.
fn ledger_of(folder: &RunFolder) -> Result<Option<Ledger>, RunError> {
    match folder.ledger().is_file() {
        true => Ok(Some(Ledger::open_read_only(folder.ledger())?)),
        false => Ok(None),
    }
}

/// Returns what the time of these settings buys, in a sentence: as it was decided when the run started, or as this machine is
/// measured now. `None` without a time. Nothing is kept: the run measures again.
///
/// # Errors
/// When the scene, the settings or the run folder cannot be used, or the time does not suffice.
pub fn explain_time(
    path: &Path,
    folder: &RunFolder,
    settings: &Settings,
) -> Result<Option<String>, RunError> {
    let time = settings.run.time;
    if time.is_none() {
        return Ok(None);
    }
    folder.stays_inside()?;
    let settings = settings.anchored();
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    if let Err(photos) = scene_or_photos(&path, &settings.scene)?
        && !folder.poses().plan(&photos, &settings.poses)?.is_done()
    {
        return Ok(Some(format!("{time} buy steps and splats once the photos have poses")));
    }
    let ledger = ledger_of(folder)?;
    let now = Situation::of(&path, folder, ledger.as_ref(), &settings, &End::Settings)?;
    fits_time(&now.scene, &settings, blocks::of(folder))?;
    if let Some(decided) = &now.time {
        return Ok(Some(format!("{}; this was decided when the run started, and stays", decided.why)));
    }
    let mut settings = now.settings.clone();
    let open = settings.train.appearance_model == AppearanceModel::Auto;
    if open {
        settings.train.appearance_model = AppearanceModel::Affine;
    }
    let engine = choose_engine(&settings.run, drop)?.engine;
    let providers = Providers::from_settings(&settings.vision)?;
    let measurement = TimeMeasurement {
        scene: &now.scene,
        engine: &engine,
        providers: &providers,
        lpips: now.lpips.as_ref(),
        keys: &now.keys,
        steps_open: now.steps_open,
        stopping: &|| false,
    };
    let why = measurement.choose(&settings, &|| 0.0)?.why;
    let before = if open { ", after it has chosen the appearance model" } else { "" };
    Ok(Some(format!("{why}; measured now, and again when the run starts{before}")))
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
    Stage::all_listed().filter(|stage| *stage <= last).map(plan).collect()
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
        let then = Situation::of(path, folder, Some(ledger), &old, &end)?;
        let mut alone = Vec::new();
        for (name, _, value) in &changed {
            let mut one = old.clone();
            one.set(name, value).map_err(crate::SettingsError::from)?;
            alone.push(Situation::of(path, folder, Some(ledger), &one, &end)?.keys);
        }
        let mut given_up = Vec::new();
        let per_photo = NODES.iter().filter_map(|node| match node.results {
            StageResults::PerPhoto { keys, .. } => Some((node.stage, keys(&then.keys))),
            _ => None,
        });
        // The scores have one key for all photos, so that the skies' keys, one per view, stand in.
        for (stage, keys) in per_photo.chain([(Stage::Evaluate, then.keys.sky.as_slice())]) {
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
        without_given_up.give_up_masks(&by(Stage::Masks, false));
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
        let names: Vec<String> = self.given_up.iter().map(name).collect();
        format!("given up before and tried again: {}", named_and_counted(&names))
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
        let key = |keys: &Keys| -> Key { node_of(stage).results.key(keys) };
        let then = key(&self.then.keys);
        for ((name, old, new), keys) in self.changed.iter().zip(&self.alone) {
            let snapshot = stage == Stage::Geometry && keys.snapshot != self.then.keys.snapshot;
            if key(keys) != then || snapshot {
                why.push(format!("{name}: {} -> {}", shown(old), shown(new)));
            }
        }
        if row.key != then.to_string() {
            let lacked = row.key == key(&self.without_given_up).to_string();
            why.push(if lacked { self.tried_again() } else { self.inputs(ledger)? });
        }
        let (was, goal) = (self.then.goal, now.goal);
        if was != goal && (why.is_empty() && key(&now.keys).to_string() != row.key) {
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
            _ => few_of_photos(odd).join(", "),
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
