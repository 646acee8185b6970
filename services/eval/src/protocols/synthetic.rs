//! Synthetic scenes, whose truth is known exactly: one click per object, or several at random (method, section 11).

use super::base::{OnRecord, ProtocolBase, Table, keep};
use super::clicks;
use super::error::ProtocolError;
use crate::oracle::OracleOptions;
use crate::record::{Record, Results};
use crate::trial::{ProviderKind, Trial};
use segwild_pipeline::PhotoPrompts;
use segwild_scene::Prompts;
use segwild_synthetic::{ObjectKind, ObjectTruth, SyntheticOptions};
use std::path::Path;

/// The protocol under which clicks on the ground and on walls are recorded.
pub const SURFACES: &str = "surfaces";

/// What is clicked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Targets {
    /// The objects: domes, pavilions, statues.
    #[default]
    Objects,
    /// The ground and the walls that objects stand on or before: what else the click takes along is counted as
    /// `standing`. Known not to be good on walls.
    Surfaces,
}

/// The surfaces that a person may want by themselves.
const CLICKED: [&str; 3] = ["ground", "facade", "hall"];

impl Targets {
    fn holds(self, object: &ObjectTruth) -> bool {
        match self {
            Targets::Objects => object.kind == ObjectKind::Object,
            Targets::Surfaces => CLICKED.contains(&object.name.as_str()),
        }
    }

    /// [`Record::protocol`] of its records.
    fn protocol(self) -> &'static str {
        if self == Targets::Surfaces { SURFACES } else { "synthetic" }
    }
}

/// What is measured.
#[derive(Clone, Debug)]
pub struct SyntheticProtocol {
    /// The rows, if none is named.
    pub table: Table,
    /// Rows to compute; all of the table if empty.
    pub only: Vec<String>,
    /// Seeds of the scenes.
    pub seeds: Vec<u64>,
    /// What is clicked.
    pub targets: Targets,
    /// Clicks that each object is found from, one at a time: 1 is the click in its middle; more are sampled anywhere inside
    /// what is seen of it.
    pub prompts: usize,
    /// The provider of masks and descriptors.
    pub providers: ProviderKind,
    /// How the oracle errs.
    pub faults: OracleOptions,
    /// The scenes, but for their seeds.
    pub scene: SyntheticOptions,
    /// What all rows have in common.
    pub base: ProtocolBase,
}

/// Measures every row on every scene. Geometry that rows share is trained once per scene: what a row does not change
/// comes from the content cache of the scene's run.
pub fn synthetic(
    out: &Path,
    options: &SyntheticProtocol,
    results: &mut Results,
    report: OnRecord,
) -> Result<(), ProtocolError> {
    let rows = options.table.rows(&options.only)?;
    for &seed in &options.seeds {
        let scene = SyntheticOptions { seed, ..options.scene.clone() };
        let dir = out.join(format!("seed-{seed}"));
        let trial = Trial::new(&dir, &scene, options.providers, &options.faults)?;
        for row in &rows {
            let settings = options.base.row(row)?;
            trial.train(&settings)?;
            let session = trial.session(&settings)?;
            for object in trial.manifest().objects.iter().filter(|o| options.targets.holds(o)) {
                for (prompt, prompts) in prompts_for(&trial, object, options.prompts).into_iter().enumerate()
                {
                    let score = session.score(object, prompts)?;
                    let mut numbers = score.numbers();
                    if options.targets == Targets::Surfaces {
                        numbers.insert("standing".into(), score.standing);
                    }
                    let record = Record {
                        protocol: options.targets.protocol().into(),
                        scene: format!("seed {seed}"),
                        setting: row.name.into(),
                        provider: session.provider().into(),
                        target: score.object,
                        seed,
                        prompt: prompt as u32,
                        numbers,
                        ..Record::default()
                    };
                    keep(results, record, out, report)?;
                }
            }
        }
    }
    Ok(())
}

/// The clicks that an object is found from, in the training photo that shows it best: in its middle, or so many at
/// random. None where no photo shows it well enough.
fn prompts_for(trial: &Trial, object: &ObjectTruth, count: usize) -> Vec<PhotoPrompts> {
    let Some(click) = object.clicks.first() else { return Vec::new() };
    let on = |x, y| PhotoPrompts { photo: click.photo.clone(), prompts: Prompts::click(x, y) };
    let photo = trial.scene().photos.iter().find(|p| p.name == click.photo);
    match photo {
        Some(photo) if count > 1 => {
            let seen = photo.mask(object.id).minus(&photo.transients);
            let seed = trial.manifest().options.seed;
            let clicks = clicks::random(&seen, count, seed, u64::from(object.id));
            clicks.into_iter().map(|p| on(p.x, p.y)).collect()
        }
        _ => vec![on(click.x, click.y)],
    }
}
