//! What is chosen before the training, as the cache and the run folder keep it.

use crate::{RunBudget, Settings};
use segwild_trainer::{AppearanceChoice, AppearanceModel, BudgetChoice, TimeChoice};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Something that is chosen before the training.
pub(crate) trait AutoChoice: Serialize + DeserializeOwned {
    /// Kind of the cache's record.
    const KIND: &'static str;
    /// Raised when the same inputs may lead to another choice.
    const RULE: u32;
    /// The file in the run folder that records the choice.
    const FILE: &'static str;
    /// Whether the settings leave it open.
    fn is_open(settings: &Settings) -> bool;
    /// The settings with the choice made; `steps_open`: whether the steps of the training were left to
    /// the scene.
    fn decided(&self, settings: &Settings, steps_open: bool) -> Settings;
    /// Why, in a sentence.
    fn why(&self) -> &str;
}

impl AutoChoice for AppearanceChoice {
    const KIND: &'static str = "appearance";
    const RULE: u32 = 3;
    const FILE: &'static str = "appearance_choice.json";
    fn is_open(settings: &Settings) -> bool {
        settings.train.appearance_model == AppearanceModel::Auto
    }
    fn decided(&self, settings: &Settings, steps_open: bool) -> Settings {
        let mut settings = settings.clone();
        settings.train.appearance_model = self.appearance;
        if steps_open {
            settings.train.steps = self.steps(settings.train.steps);
        }
        settings
    }
    fn why(&self) -> &str {
        &self.why
    }
}

impl AutoChoice for BudgetChoice {
    const KIND: &'static str = "budget";
    const RULE: u32 = 1;
    const FILE: &'static str = "budget.json";
    fn is_open(settings: &Settings) -> bool {
        settings.run.budget == RunBudget::Auto
    }
    fn decided(&self, settings: &Settings, _: bool) -> Settings {
        let mut settings = settings.clone();
        settings.train.steps = self.steps;
        settings
    }
    fn why(&self) -> &str {
        &self.why
    }
}

impl AutoChoice for TimeChoice {
    const KIND: &'static str = "time";
    const RULE: u32 = 1;
    const FILE: &'static str = "time.json";
    fn is_open(settings: &Settings) -> bool {
        !settings.run.time.is_none()
    }
    fn decided(&self, settings: &Settings, _: bool) -> Settings {
        let mut settings = settings.clone();
        settings.train.steps = self.steps;
        if self.splats > 0 {
            settings.train.splats = self.splats;
        }
        settings
    }
    fn why(&self) -> &str {
        &self.why
    }
}
