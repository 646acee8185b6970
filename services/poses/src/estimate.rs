//! Computing poses, step by step. Each step goes on from what the folder holds.

use crate::colmap::{ColmapCommand, numbers_in};
use crate::features::{lens_groups, within_memory};
use crate::folder::{PoseInputs, stamps};
use crate::mapper::{self, MapperFiles};
use crate::models::{PhotoFacts, PoseModel, read_models};
use crate::record::{PosesDone, PosesRecord};
use crate::snapshots::{self, MapperSnapshot};
use crate::{
    Colmap, Ffmpeg, Glomap, PairChoice, PoseLimits, PoseMapper, PosePlan, PoseSettings, PoseSource, PoseSpan,
    PoseStep, PosesError, PosesFolder, pairs,
};
use segwild_flow::{Events, FileError, ProgramError, ProgramRunner, StageProgress, Stopper, files};
use segwild_scene::{SceneSettings, UnposedPhotos};
use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Name of the stage in events.
const STAGE: &str = "poses";
/// Photos in a model at the least; COLMAP's own 10 would refuse a small scene.
const LEAST_PHOTOS: usize = 3;
/// Time between two signs of life while a program computes something long.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

/// Poses while they are computed.
struct Estimation<'a> {
    folder: &'a PosesFolder,
    settings: &'a PoseSettings,
    limits: &'a PoseLimits,
    events: &'a Events,
    programs: ProgramRunner<'a>,
    colmap: Colmap,
    /// The global mapper, where there is one and the settings allow it.
    glomap: Option<Glomap>,
    progress: StageProgress,
    spans: Vec<PoseSpan>,
    of_video: bool,
}

impl PosesFolder {
    /// Computes the poses of a source, or what is left of them. Progress and messages go to `events` as the stage
    /// `poses`.
    ///
    /// # Errors
    /// When a program is missing or fails, no poses are found, the disk fails, or the run is stopped.
    pub fn estimate(
        &self,
        source: &PoseSource,
        plan: &PosePlan,
        settings: &PoseSettings,
        limits: &PoseLimits,
        events: &Events,
        stopper: &Stopper,
    ) -> Result<Vec<PoseSpan>, PosesError> {
        let missing = || PosesError::NoColmap { path: source.path().to_owned() };
        let colmap = Colmap::find().ok_or_else(missing)?;
        let glomap = match settings.mapper {
            PoseMapper::Colmap => None,
            _ => Glomap::find(Some(&colmap)),
        };
        // Before hours are spent on what comes first.
        if settings.mapper == PoseMapper::Glomap && glomap.is_none() {
            return Err(PosesError::NoGlomap { path: source.path().to_owned() });
        }
        std::fs::create_dir_all(self.path())
            .map_err(|e| FileError::new("create the folder", self.path(), e))?;
        let mut estimation = Estimation {
            folder: self,
            settings,
            limits,
            events,
            programs: ProgramRunner { log: Some(self.path().join("colmap.log")), stopper },
            colmap,
            glomap,
            progress: events.stage(STAGE, None),
            spans: Vec::new(),
            of_video: matches!(source, PoseSource::Video(_)),
        };
        estimation.run(source, plan)?;
        let Estimation { progress, spans, .. } = estimation;
        progress.finish();
        Ok(spans)
    }
}

/// Removes what a folder of poses holds of earlier inputs; what is not there is as good.
fn remove(path: &Path) -> Result<(), PosesError> {
    let removed = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(FileError::new("remove", path, error).into())
        }
        _ => Ok(()),
    }
}

impl Estimation<'_> {
    fn run(&mut self, source: &PoseSource, plan: &PosePlan) -> Result<(), PosesError> {
        let mut record = PosesRecord::read(self.folder.path())?.unwrap_or_default();
        let mut inputs = plan.inputs.clone();
        let photos = match source {
            PoseSource::Photos { photos, .. } => photos.clone(),
            PoseSource::Video(video) => {
                let photos = self.frames(video, &inputs, &mut record)?;
                inputs.photos = stamps(&photos, &record)?;
                photos
            }
        };
        self.enough(&photos)?;
        self.keep_what_fits(&inputs, &mut record)?;
        self.step(PoseStep::Features, |this| this.features(&photos))?;
        self.step(PoseStep::Pairs, |this| this.pairs(&photos))?;
        let done = self.step(PoseStep::Model, |this| this.model(&photos, plan))?;
        record.done = Some(done);
        record.write(self.folder.path())
    }

    /// Does a step, and notes when.
    fn step<T>(
        &mut self,
        step: PoseStep,
        work: impl FnOnce(&mut Self) -> Result<T, PosesError>,
    ) -> Result<T, PosesError> {
        let start = Instant::now();
        let done = work(self);
        self.spans.push(PoseSpan { step, start, end: Instant::now() });
        done
    }

    fn say(&self, words: String) {
        self.events.info(Some(STAGE), words);
    }

    fn enough(&self, photos: &UnposedPhotos) -> Result<(), PosesError> {
        if photos.photos.len() >= LEAST_PHOTOS {
            return Ok(());
        }
        let first = photos.skipped.first().map(|s| format!("; {} cannot be used: {}", s.name, s.reason));
        Err(PosesError::TooFew {
            path: photos.folder.clone(),
            usable: photos.photos.len(),
            first: first.unwrap_or_default(),
        })
    }

    /// Removes features and pairs that are not of these inputs, and writes down what the others are of.
    fn keep_what_fits(&self, inputs: &PoseInputs, record: &mut PosesRecord) -> Result<(), PosesError> {
        if !inputs.fit(record) {
            for name in ["colmap.db", "colmap.db-wal", "colmap.db-shm", "snapshots"] {
                remove(&self.folder.path().join(name))?;
            }
            record.photos.clear();
        }
        record.done = None;
        record.features = inputs.features.to_string();
        record.video.clone_from(&inputs.video);
        record.photos.extend(inputs.photos.clone());
        record.write(self.folder.path())
    }

    /// The frames of a video: those of before, where they were taken by the same settings.
    fn frames(
        &mut self,
        video: &Path,
        inputs: &PoseInputs,
        record: &mut PosesRecord,
    ) -> Result<UnposedPhotos, PosesError> {
        let folder = self.folder.frames();
        if record.frames != inputs.features.to_string() || !folder.is_dir() {
            let missing = || PosesError::NoFfmpeg { path: video.to_owned() };
            let ffmpeg = Ffmpeg::find().ok_or_else(missing)?;
            self.say(format!("the sharpest frames of {} are taken", video.display()));
            record.frames.clear();
            record.write(self.folder.path())?;
            remove(&folder)?;
            std::fs::create_dir_all(&folder).map_err(|e| FileError::new("create the folder", &folder, e))?;
            let most = self.settings.video_frames as usize;
            self.step(PoseStep::Frames, |this| {
                ffmpeg.take_frames(video, &folder, most, &this.programs, &mut this.progress)
            })?;
            record.frames = inputs.features.to_string();
            record.write(self.folder.path())?;
        }
        let found = UnposedPhotos::find(&folder, &SceneSettings::default())?;
        let none =
            || PosesError::Video { path: video.to_owned(), reason: "no frame could be written".into() };
        found.ok_or_else(none)
    }

    /// Runs a command of COLMAP; `line` returns how many units a line of its output is worth.
    fn colmap(
        &mut self,
        command: ColmapCommand,
        line: impl FnMut(&str, &mut StageProgress),
    ) -> Result<(), PosesError> {
        let program = self.colmap.program().to_owned();
        self.child(&[], &program, &command.arguments(), line)
    }

    /// Runs a program with more variables in its environment; `line` as for [`Estimation::colmap`].
    fn child(
        &mut self,
        variables: &[(&str, String)],
        program: &Path,
        arguments: &[String],
        mut line: impl FnMut(&str, &mut StageProgress),
    ) -> Result<(), PosesError> {
        let (events, progress) = (self.events, &mut self.progress);
        let (mut lines, mut shown) = (0_u32, Instant::now());
        self.programs.run_with(variables, program, arguments, |text| {
            lines += 1;
            // A bundle adjustment of many photos takes minutes in which no unit is done.
            if shown.elapsed() > SIGN_OF_LIFE {
                shown = Instant::now();
                events.metric(STAGE, "lines of COLMAP", f64::from(lines), Some(u64::from(lines)));
            }
            line(text, progress);
        })?;
        Ok(())
    }

    /// The features of the photos that have none yet.
    fn features(&mut self, photos: &UnposedPhotos) -> Result<(), PosesError> {
        let all = &photos.photos;
        let (threads, size) = within_memory(all, self.limits, self.settings.pose_photo_size);
        self.say(format!("{} finds features in {} photos", self.colmap.version, all.len()));
        if size < self.settings.pose_photo_size {
            self.events
                .warn(Some(STAGE), format!("memory is short: photos are scaled down to {size} px for it"));
        }
        self.progress.next_part("features", Some(all.len() as u64));
        // No photo is in two groups, so that what was there before the first is enough.
        let images = self.folder.images()?;
        for group in lens_groups(all, self.settings.camera_sharing, self.of_video) {
            let left = group.left(&images);
            self.progress.cached((group.names.len() - left.len()) as u64);
            if left.is_empty() {
                continue;
            }
            let list = self.list();
            files::write_atomic(&list, left.join("\n").as_bytes())?;
            let mut command = self
                .colmap
                .command("feature_extractor")?
                .path("database_path", &self.folder.database())
                .path("image_path", &photos.folder)
                .path("image_list_path", &list)
                .option(
                    &["SiftExtraction.use_gpu", "FeatureExtraction.use_gpu"],
                    u8::from(self.colmap.has_cuda),
                )
                .option(&["SiftExtraction.num_threads", "FeatureExtraction.num_threads"], threads)
                .option(&["SiftExtraction.max_image_size", "FeatureExtraction.max_image_size"], size);
            if group.shared {
                command = match group.camera(&images) {
                    Some(camera) => command.option(&["ImageReader.existing_camera_id"], camera),
                    None => command.option(&["ImageReader.single_camera"], 1),
                };
            }
            self.colmap(command, |line, progress| {
                progress.advance(u64::from(line.contains("Processed file [")));
            })?;
        }
        Ok(())
    }

    /// The pairs that show the same, of those that were not compared yet.
    fn pairs(&mut self, photos: &UnposedPhotos) -> Result<(), PosesError> {
        let count = photos.photos.len();
        let choice = pairs::decided(self.settings.pair_choice, count, self.of_video);
        self.say(pairs::in_words(choice, count));
        match choice {
            PairChoice::Nearest => self.nearest(count, pairs::NEAREST),
            PairChoice::Sequential => {
                let command = self
                    .matcher("sequential_matcher")?
                    .option(&["SequentialMatching.overlap"], pairs::FOLLOWING)
                    .option(&["SequentialMatching.quadratic_overlap"], 1);
                self.per_photo(command, count)?;
                self.nearest(count, pairs::RETURNING)
            }
            PairChoice::Exhaustive | PairChoice::Auto => {
                let command = self
                    .matcher("exhaustive_matcher")?
                    .option(&["ExhaustiveMatching.block_size"], pairs::BLOCK);
                let blocks = (count as u64).div_ceil(pairs::BLOCK).pow(2);
                self.progress.next_part("matches", Some(blocks));
                self.colmap(command, |line, progress| {
                    if let Some((done, total)) = line
                        .contains("Matching block")
                        .then(|| pairs::blocks(&numbers_in(line, '[', ']')))
                        .flatten()
                    {
                        progress.set_total(total);
                        progress.advance(done.saturating_sub(progress.done()));
                    }
                })
            }
        }
    }

    /// A command that compares photos.
    fn matcher(&self, name: &str) -> Result<ColmapCommand, PosesError> {
        let command = self.colmap.command(name)?.path("database_path", &self.folder.database());
        Ok(command
            .option(&["SiftMatching.use_gpu", "FeatureMatching.use_gpu"], u8::from(self.colmap.has_cuda))
            .option(&["SiftMatching.num_threads", "FeatureMatching.num_threads"], self.limits.threads))
    }

    /// Runs a command that compares photo by photo.
    fn per_photo(&mut self, command: ColmapCommand, count: usize) -> Result<(), PosesError> {
        self.progress.next_part("matches", Some(count as u64));
        self.colmap(command, |line, progress| {
            progress.advance(u64::from(line.contains("Matching image [")));
        })
    }

    /// Compares each photo with those most similar by a vocabulary tree of the photos themselves.
    fn nearest(&mut self, count: usize, nearest: u64) -> Result<(), PosesError> {
        let tree = self.folder.path().join("vocabulary.tree");
        let images = self.folder.images()?;
        let features: u64 = images.values().filter_map(|image| image.features).sum();
        // The tree is made of some of the photos alone.
        let features = features * pairs::TREE_PHOTOS.min(images.len()) as u64 / images.len().max(1) as u64;
        self.progress.next_part("vocabulary tree", None);
        let command = self
            .colmap
            .command("vocab_tree_builder")?
            .path("database_path", &self.folder.database())
            .path("vocab_tree_path", &tree)
            .option(&["num_visual_words"], pairs::tree_words(features))
            .option(&["branching"], pairs::TREE_BRANCHES)
            .option(&["num_iterations"], pairs::TREE_ROUNDS)
            .option(&["num_checks"], pairs::TREE_CHECKS)
            .option(&["max_num_images"], pairs::TREE_PHOTOS.min(count));
        self.colmap(command, |_, _| {})?;
        let command = self
            .matcher("vocab_tree_matcher")?
            .path("VocabTreeMatching.vocab_tree_path", &tree)
            .option(&["VocabTreeMatching.num_images"], nearest);
        self.per_photo(command, count)
    }

    /// Poses and points: the models of all photos, and the reasons of photos without a pose.
    fn model(&mut self, photos: &UnposedPhotos, plan: &PosePlan) -> Result<PosesDone, PosesError> {
        let count = photos.photos.len();
        let names: Vec<&str> = photos.photos.iter().map(|photo| photo.name.as_str()).collect();
        files::write_atomic(&self.list(), names.join("\n").as_bytes())?;
        let may_fall_back = self.settings.mapper == PoseMapper::Auto;
        let glomap = self.global_mapper(&names)?;
        let mut models = match &glomap {
            None => Vec::new(),
            Some(glomap) => match self.mapped_at_once(glomap, photos) {
                Err(error) if may_fall_back && error.is_of_one_mapper() => {
                    self.events.warn(Some(STAGE), error.to_string());
                    Vec::new()
                }
                done => done?,
            },
        };
        let mut by = glomap.as_ref().map_or(String::new(), |glomap| glomap.version.clone());
        if models.is_empty() && (glomap.is_none() || may_fall_back) {
            if glomap.is_some() {
                self.events.warn(Some(STAGE), format!("{by} found no poses: COLMAP tries it photo by photo"));
            }
            models = self.mapped_one_by_one(photos)?;
            by.clone_from(&self.colmap.version);
        }
        let facts = PhotoFacts::of(self.folder.open_database()?)?;
        if models.is_empty() {
            let reason = facts.nothing(count);
            return Err(PosesError::NoModel { path: photos.folder.clone(), photos: count, reason });
        }
        remove(&self.folder.snapshots())?;
        let unposed = facts.unposed(names.into_iter(), &models);
        let models = models.into_iter().map(|model| model.size).collect();
        Ok(PosesDone { key: plan.key.to_string(), colmap: by, models, unposed })
    }

    /// The file with the names of the photos.
    fn list(&self) -> PathBuf {
        self.folder.path().join("photos.txt")
    }

    /// The global mapper, where it computes the poses of these photos.
    ///
    /// # Errors
    /// When the settings name it, and it cannot map these photos alone.
    fn global_mapper(&self, names: &[&str]) -> Result<Option<Glomap>, PosesError> {
        let chosen = self.glomap.clone().filter(|_| mapper::is_global(self.settings.mapper, names.len()));
        let Some(glomap) = chosen else { return Ok(None) };
        match self.maps_these_alone(&glomap, names) {
            Err(error) if self.settings.mapper == PoseMapper::Auto && error.is_of_one_mapper() => {
                self.events.warn(Some(STAGE), format!("COLMAP's mapper is used: {error}"));
                Ok(None)
            }
            checked => checked.map(|()| Some(glomap)),
        }
    }

    /// Checks that a global mapper maps these photos and no others: one that knows no list maps what the database holds, photos of
    /// before among it.
    fn maps_these_alone(&self, glomap: &Glomap, names: &[&str]) -> Result<(), PosesError> {
        if glomap.command()?.knows(mapper::LIST) {
            return Ok(());
        }
        let names: BTreeSet<&str> = names.iter().copied().collect();
        let images = self.folder.images()?;
        match images.keys().filter(|name| !names.contains(name.as_str())).count() {
            0 => Ok(()),
            photos => Err(PosesError::GonePhotos {
                mapper: glomap.version.clone(),
                path: self.folder.path().to_owned(),
                photos,
            }),
        }
    }

    /// The models of a global mapper, the largest first.
    fn mapped_at_once(
        &mut self,
        glomap: &Glomap,
        photos: &UnposedPhotos,
    ) -> Result<Vec<PoseModel>, PosesError> {
        self.calibrate(glomap, photos)?;
        self.say(format!("{} finds the poses of {} photos at once", glomap.version, photos.photos.len()));
        self.progress.next_part("mapping", None);
        let (database, list, models) = (self.folder.database(), self.list(), self.empty_models()?);
        let files = MapperFiles { database: &database, photos: &photos.folder, list: &list, models: &models };
        let command = glomap.command()?;
        let variables = mapper::thread_variables(&command, self.limits.threads);
        let arguments = files.at_once(command, self.limits.threads);
        self.child(&variables, glomap.program(), &arguments, |_, _| {})?;
        let mut models = read_models(&models)?;
        models.retain(|model| model.size.photos >= LEAST_PHOTOS);
        Ok(models)
    }

    /// Estimates focal lengths that most photos do not say, for a global mapper that does not do that itself.
    fn calibrate(&mut self, glomap: &Glomap, photos: &UnposedPhotos) -> Result<(), PosesError> {
        let Some(command) = glomap.calibrator()? else { return Ok(()) };
        let with_focal_length = photos.photos.iter().filter(|photo| photo.camera.is_some()).count();
        let cameras: BTreeSet<i64> = self.folder.images()?.values().map(|image| image.camera).collect();
        if !mapper::calibrates(photos.photos.len(), with_focal_length, cameras.len()) {
            return Ok(());
        }
        self.say("most photos do not say their focal length: pairs of them tell it".to_owned());
        let variables = mapper::thread_variables(&command, self.limits.threads);
        let arguments = command.path("database_path", &self.folder.database()).arguments();
        match self.child(&variables, glomap.program(), &arguments, |_, _| {}) {
            Err(PosesError::Program(failed @ ProgramError::Failed { .. })) => {
                self.events.warn(Some(STAGE), format!("focal lengths are guesses: {failed}"));
                Ok(())
            }
            done => done,
        }
    }

    /// The models of COLMAP's mapper, the largest first; none where it made none.
    fn mapped_one_by_one(&mut self, photos: &UnposedPhotos) -> Result<Vec<PoseModel>, PosesError> {
        if let Some(models) = self.continued(photos)? {
            return Ok(models);
        }
        remove(&self.folder.snapshots())?;
        let models = self.empty_models()?;
        self.say(format!("{} finds the poses of {} photos", self.colmap.version, photos.photos.len()));
        match self.mapper(photos, &models, None) {
            // COLMAP reports a failure where it made no model.
            Err(PosesError::Program(failed @ ProgramError::Failed { .. })) => match read_models(&models) {
                Ok(none) if none.is_empty() => Ok(none),
                _ => Err(PosesError::Program(failed)),
            },
            // A mapper that was stopped may have left a part of a model.
            mapped => mapped.and_then(|()| read_models(&models)),
        }
    }

    /// The model that grows out of a snapshot of a mapping that was stopped; `None` where there is none of more than
    /// half of the photos. The mapper goes on with one model and leaves out the others, one of which may be larger
    /// then.
    fn continued(&mut self, photos: &UnposedPhotos) -> Result<Option<Vec<PoseModel>>, PosesError> {
        let count = photos.photos.len();
        let names: BTreeSet<&str> = photos.photos.iter().map(|photo| photo.name.as_str()).collect();
        let Some(snapshot) = snapshots::largest(&self.folder.snapshots(), &names) else { return Ok(None) };
        // It writes such a model into the folder itself, not into one of that folder.
        let models = self.empty_models()?;
        let folder = models.join("0");
        std::fs::create_dir_all(&folder).map_err(|e| FileError::new("create the folder", &folder, e))?;
        let MapperSnapshot { path, photos: posed } = snapshot;
        self.say(format!("{} goes on from the poses of {posed} of {count} photos", self.colmap.version));
        match self.mapper(photos, &folder, Some(&path)) {
            Err(PosesError::Program(error)) => {
                let words = format!("the snapshot is left aside: {error}");
                self.events.warn(Some(STAGE), words);
                return Ok(None);
            }
            done => done?,
        }
        // Where it wrote none, the mapping starts again.
        let models = read_models(&models).unwrap_or_default();
        let is_largest = models.first().is_some_and(|model| 2 * model.size.photos > count);
        Ok(is_largest.then_some(models))
    }

    /// Runs COLMAP's mapper, from a snapshot or from the start. Snapshots are left on the way.
    fn mapper(
        &mut self,
        photos: &UnposedPhotos,
        models: &Path,
        from: Option<&Path>,
    ) -> Result<(), PosesError> {
        let snapshots = self.folder.snapshots();
        std::fs::create_dir_all(&snapshots)
            .map_err(|e| FileError::new("create the folder", &snapshots, e))?;
        let (database, list) = (self.folder.database(), self.list());
        let files = MapperFiles { database: &database, photos: &photos.folder, list: &list, models };
        let command = self.colmap.command("mapper")?;
        let arguments = files.one_by_one(command, self.limits.threads, LEAST_PHOTOS, &snapshots, from);
        self.progress.next_part("mapping", Some(photos.photos.len() as u64));
        let program = self.colmap.program().to_owned();
        self.child(&[], &program, &arguments, |line, progress| {
            if line.contains("Registering image #") {
                let posed = numbers_in(line, '(', ')').first().copied().unwrap_or(0);
                progress.advance(posed.saturating_sub(progress.done()));
            } else if line.contains("Creating snapshot") {
                snapshots::thin(&snapshots);
            }
        })
    }

    /// The folder of the models, emptied.
    fn empty_models(&self) -> Result<PathBuf, PosesError> {
        let models = self.folder.models();
        remove(&models)?;
        std::fs::create_dir_all(&models).map_err(|e| FileError::new("create the folder", &models, e))?;
        Ok(models)
    }
}
