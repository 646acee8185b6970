//! The runs that a server has: one, or all of a folder; none where it shows a farm alone. Sessions are opened when somebody wants
//! them.

use crate::document::JournalError;
use crate::early::EarlyViews;
use crate::farm::ServedFarm;
use crate::messages::{RunEntry, TrainingMessage};
use crate::{Studio, StudioError};
use segwild_farm::BatchFolder;
use segwild_flow::{FileError, Stopper, files, lock};
use segwild_monitor::view::RunState;
use segwild_monitor::{MonitorTarget, MonitorView};
use segwild_pipeline::{Code, RunFolder, TrainingSnapshot};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Runs of a folder that are listed.
const MOST_RUNS: usize = 2000;

/// Time between two checks whether a newer scene is there.
const CHECKED: Duration = Duration::from_millis(500);

/// Time after which a run that could not be opened is tried again: its files may have changed.
const REOPENED: Duration = Duration::from_secs(2);

/// How long the session of an earlier snapshot may take to answer its last requests.
const FREED: Duration = Duration::from_secs(5);

/// A session's way into memory.
enum OpenState {
    /// It is being opened. A run that could not be opened before has the reason until it is open.
    Opening(Option<String>),
    Open {
        studio: Arc<Studio>,
        used: Instant,
        /// When it was last checked whether a newer scene is there.
        checked: Instant,
    },
    /// It could not be opened, why, and when that was.
    Failed(String, Instant),
}

impl OpenState {
    fn failed(why: String) -> OpenState {
        OpenState::Failed(why, Instant::now())
    }
}

/// What a request finds.
pub(crate) enum Found {
    /// The session is open.
    Open(Arc<Studio>),
    /// It is not open yet.
    Waiting(RunEntry),
    /// It cannot be opened, and why.
    Failed(String),
    /// There is no such run.
    None,
}

/// The runs of a server.
pub(crate) struct ServedRuns {
    root: Option<PathBuf>,
    farm: Option<ServedFarm>,
    /// Whether the root is a run itself.
    single: bool,
    /// Bytes that open sessions may take together; the newest is kept whatever it takes.
    memory_budget: usize,
    open: Mutex<BTreeMap<String, OpenState>>,
    stopper: Stopper,
    /// The program that trains.
    program: Option<PathBuf>,
    /// The networks and services for all runs.
    code: Code,
    /// Runs that are being trained again.
    training: Mutex<BTreeMap<String, Child>>,
    early: EarlyViews,
}

/// Share of its steps for which a scene is trained on after a correction.
const CONTINUED: &str = "0.2";

impl ServedRuns {
    pub fn new(
        root: Option<&Path>,
        farm: Option<ServedFarm>,
        memory_budget: usize,
        program: Option<PathBuf>,
        code: Code,
        photos: Option<PathBuf>,
    ) -> ServedRuns {
        let root = root.map(|root| root.canonicalize().unwrap_or_else(|_| root.to_owned()));
        ServedRuns {
            // A folder that is not there yet will be a run's.
            single: root.as_deref().is_some_and(|root| !holds_runs(root)),
            root,
            farm,
            memory_budget,
            open: Mutex::default(),
            stopper: Stopper::new(),
            program,
            code,
            training: Mutex::default(),
            early: EarlyViews::new(photos),
        }
    }

    fn open(&self) -> MutexGuard<'_, BTreeMap<String, OpenState>> {
        lock(&self.open)
    }

    /// The folder that operators' views are of, if it has one.
    pub fn root(&self) -> Option<&Path> {
        self.root.as_deref()
    }

    /// The farm that operators see, if it shows one.
    pub fn farm(&self) -> Option<&ServedFarm> {
        self.farm.as_ref()
    }

    fn names(&self) -> Vec<String> {
        let Some(root) = &self.root else { return Vec::new() };
        match self.single {
            true => vec![name_of(root)],
            false => {
                let mut names: Vec<String> = runs_in(root).take(MOST_RUNS).collect();
                names.sort();
                names
            }
        }
    }

    /// The folder of a run. Only plain names of folders that hold one have it: a request names no path.
    pub fn folder(&self, name: &str) -> Option<PathBuf> {
        let root = self.root.as_ref()?;
        if self.single {
            return (name == name_of(root)).then(|| root.clone());
        }
        let folder = root.join(name);
        (files::name::is_plain(name) && has_ledger(&folder)).then_some(folder)
    }

    /// Opens the session of a server that has one run: somebody will want it.
    pub fn open_first(self: &Arc<Self>) {
        if let Some(root) = self.root.as_ref().filter(|_| self.single) {
            let _ = self.find(&name_of(root));
        }
    }

    /// Trains a run on without its corrected transients, in a process of its own. It stops with this server, where it can be
    /// continued.
    ///
    /// # Errors
    /// When nobody may train here, the run is being trained, or the process cannot be started.
    pub fn train_again(&self, name: &str) -> Result<(), StudioError> {
        let program = self.program.as_ref().ok_or(StudioError::Request("this server does not train"))?;
        let folder = self.folder(name).ok_or(StudioError::Request("there is no such run"))?;
        let mut training = lock(&self.training);
        if training.get_mut(name).is_some_and(|child| matches!(child.try_wait(), Ok(None))) {
            return Err(StudioError::Request("this run is being trained already"));
        }
        let scene = RunFolder::open(&folder)?.scene_path()?;
        let child = Command::new(program)
            .arg("run")
            .arg(scene)
            .arg("--out")
            .arg(&folder)
            .args(["--continue-share", CONTINUED, "--stop-with-parent"])
            .envs(self.code.variables())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|e| FileError::new("start", program, e))?;
        training.insert(name.to_owned(), child);
        Ok(())
    }

    /// How far a run is before it has a scene; `None` where there is no such run.
    pub fn training(&self, name: &str) -> Option<TrainingMessage> {
        let folder = self.folder(name)?;
        Some(self.early.training(name, &folder))
    }

    /// A photo of a run that may have no scene yet, as JPEG.
    ///
    /// # Errors
    /// When there is no such run or photo, or it cannot be read any more.
    pub fn early_photo(&self, name: &str, photo: usize, size: u32) -> Result<Vec<u8>, StudioError> {
        let folder = self.folder(name).ok_or(StudioError::Request("there is no such run"))?;
        self.early.photo(name, &folder, photo, size)
    }

    /// All runs with their states.
    pub fn list(&self) -> Vec<RunEntry> {
        self.names().into_iter().map(|name| self.entry(&name)).collect()
    }

    fn entry(&self, name: &str) -> RunEntry {
        let state = |state, reason| RunEntry { name: name.to_owned(), state, reason };
        match self.open().get(name) {
            Some(OpenState::Open { .. }) => return state("open", None),
            Some(OpenState::Opening(None)) => return state("opening", None),
            Some(OpenState::Opening(Some(why)) | OpenState::Failed(why, _)) => {
                return state("failed", Some(why.clone()));
            }
            None => {}
        }
        match self.folder(name) {
            Some(folder) if is_trained(&folder) => state("trained", None),
            _ => state("training", Some("the scene is not trained yet".into())),
        }
    }

    /// A run's session. Where it is not open, it is opened in the background.
    pub fn find(self: &Arc<Self>, name: &str) -> Found {
        let Some(folder) = self.folder(name) else { return Found::None };
        let mut open = self.open();
        if let Some(OpenState::Open { studio, used, checked }) = open.get_mut(name) {
            *used = Instant::now();
            let unchecked = checked.elapsed() > CHECKED;
            if unchecked {
                *checked = Instant::now();
            }
            if !(unchecked && is_outdated(studio, &folder)) {
                return Found::Open(studio.clone());
            }
            // Its journal has to be free before the next one opens it: whoever still asks this one is waited for. Objects are not
            // written of a scene that is not the newest.
            studio.end_writes();
            open.remove(name);
        }
        let (reason, opens) = match open.get(name) {
            // A later request tries again: what was missing may be there by then.
            Some(OpenState::Failed(why, at)) => (Some(why.clone()), at.elapsed() > REOPENED),
            Some(OpenState::Opening(why)) => (why.clone(), false),
            _ => (None, true),
        };
        if opens {
            open.remove(name);
            let source = if is_trained(&folder) { Some(None) } else { snapshot_of(&folder).map(Some) };
            let Some(snapshot) = source else {
                drop(open);
                return Found::Waiting(self.entry(name));
            };
            open.insert(name.to_owned(), OpenState::Opening(reason.clone()));
            let (runs, of) = (self.clone(), name.to_owned());
            let work = move || runs.open_session(&of, &folder, snapshot.as_ref());
            if let Err(e) = std::thread::Builder::new().name("studio open".into()).spawn(work) {
                open.insert(name.to_owned(), OpenState::failed(format!("no thread can be started: {e}")));
            }
        }
        drop(open);
        reason.map_or_else(|| Found::Waiting(self.entry(name)), Found::Failed)
    }

    fn open_session(&self, name: &str, folder: &Path, snapshot: Option<&TrainingSnapshot>) {
        let began = Instant::now();
        let open = || {
            let folder = RunFolder::open(folder)?;
            Studio::open_at(&folder, name, snapshot, &self.code, &self.stopper)
        };
        let mut opened = open();
        // A session of an earlier snapshot still answers its last requests.
        while matches!(&opened, Err(StudioError::Journal(JournalError::Busy(_)))) && began.elapsed() < FREED {
            std::thread::park_timeout(FREED / 50);
            opened = open();
        }
        let state = match opened {
            Ok(studio) => OpenState::Open { studio, used: Instant::now(), checked: Instant::now() },
            Err(error) => OpenState::failed(error.to_string()),
        };
        let mut open = self.open();
        open.insert(name.to_owned(), state);
        self.close_oldest(&mut open, name);
    }

    /// Closes the sessions that were used longest ago until those that stay fit into the budget, those that write objects last.
    fn close_oldest(&self, open: &mut BTreeMap<String, OpenState>, newest: &str) {
        loop {
            let mut opened: Vec<(bool, Instant, String, usize)> = open
                .iter()
                .filter_map(|(name, state)| match state {
                    OpenState::Open { studio, used, .. } => {
                        Some((studio.is_writing(), *used, name.clone(), studio.bytes()))
                    }
                    _ => None,
                })
                .collect();
            let bytes: usize = opened.iter().map(|(.., bytes)| bytes).sum();
            opened.retain(|(_, _, name, _)| name != newest);
            opened.sort();
            let Some((_, _, oldest, _)) = opened.first().filter(|_| bytes > self.memory_budget) else {
                return;
            };
            if let Some(OpenState::Open { studio, .. }) = open.remove(oldest) {
                studio.end_writes();
            }
        }
    }
}

impl Drop for ServedRuns {
    fn drop(&mut self) {
        self.stopper.stop();
        for state in self.open().values() {
            if let OpenState::Open { studio, .. } = state {
                studio.stop_answers();
            }
        }
    }
}

/// Whether a folder is a run, a batch, or has runs in it.
pub fn has_runs(folder: &Path) -> bool {
    has_ledger(folder) || holds_runs(folder)
}

/// Whether a folder is a batch or has runs in it.
fn holds_runs(folder: &Path) -> bool {
    BatchFolder::open(folder).is_some() || (!has_ledger(folder) && runs_in(folder).next().is_some())
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(|| "run".into(), |name| name.to_string_lossy().into_owned())
}

/// The newest scene of a run that is still trained.
fn snapshot_of(folder: &Path) -> Option<TrainingSnapshot> {
    RunFolder::at(folder).newest_snapshot()
}

/// Whether a newer scene is there: of a later training, the trained one instead of a snapshot, or a newer snapshot that nobody
/// would miss anything by.
fn is_outdated(studio: &Studio, folder: &Path) -> bool {
    let Some(step) = studio.snapshot() else {
        let newest = RunFolder::at(folder).training_key();
        return newest.is_some() && newest.as_deref() != studio.session().training() && !is_listing(folder);
    };
    match is_trained(folder) {
        // Its tree and its list of objects are being made: the snapshot serves until they are there.
        true => !is_listing(folder),
        false => studio.is_untouched() && snapshot_of(folder).is_some_and(|newest| newest.step != step),
    }
}

/// Whether a process works on a run whose objects it has not listed yet.
fn is_listing(folder: &Path) -> bool {
    let Ok(MonitorView::Run(run)) = MonitorTarget::at(folder).and_then(|target| target.view()) else {
        return false;
    };
    let open = run.stages.iter().any(|stage| stage.name == "objects" && stage.state != "done");
    run.state == RunState::Running && open
}

fn has_ledger(folder: &Path) -> bool {
    RunFolder::at(folder).ledger().is_file()
}

fn is_trained(folder: &Path) -> bool {
    folder.join("model.bin").is_file()
}

/// Names of the folders in a folder that are runs.
fn runs_in(root: &Path) -> impl Iterator<Item = String> {
    let entries = std::fs::read_dir(root).into_iter().flatten().flatten();
    entries.filter(|entry| has_ledger(&entry.path())).filter_map(|entry| entry.file_name().into_string().ok())
}
