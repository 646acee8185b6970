//! The step `model`: the program that computes poses and points of the pairs, and its command.

use crate::colmap::{Colmap, ColmapCommand};
use crate::snapshots::EVERY;
use crate::{PoseMapper, PosesError};
use segwild_flow::{find_program, program_output};
use std::path::{Path, PathBuf};

/// Photos up to which `auto` takes COLMAP's mapper. It adds photo by photo and adjusts all of them again and again;
/// GLOMAP (Pan et al. 2024) solves for all at once, which pays for many. Not measured here.
pub(crate) const FEW: usize = 300;

/// A global mapper that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Glomap {
    program: PathBuf,
    command: &'static str,
    /// The command that estimates focal lengths before it, where it does not do that itself, as GLOMAP 1 does.
    calibrator: Option<&'static str>,
    /// As it names itself: `GLOMAP`, or `COLMAP 4.0.1 (global_mapper)`.
    pub version: String,
}

impl Glomap {
    /// That within a COLMAP, whose database it certainly reads, else the program `glomap` on the `PATH`; `None` where
    /// there is neither.
    pub fn find(colmap: Option<&Colmap>) -> Option<Glomap> {
        let within = colmap.filter(|colmap| colmap.has_global_mapper).map(|colmap| Glomap {
            program: colmap.program().to_owned(),
            command: "global_mapper",
            calibrator: colmap.has_calibrator.then_some("view_graph_calibrator"),
            version: format!("{} (global_mapper)", colmap.version),
        });
        within.or_else(Glomap::alone)
    }

    fn alone() -> Option<Glomap> {
        let program = find_program("glomap")?;
        let help = program_output(&program, &["mapper", "-h"]).ok()?;
        let answers = help.contains("--database_path") && help.contains("--output_path");
        let version = "GLOMAP".to_owned();
        answers.then_some(Glomap { program, command: "mapper", calibrator: None, version })
    }

    /// Its file.
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// Its command, without options.
    ///
    /// # Errors
    /// It cannot be started.
    pub(crate) fn command(&self) -> Result<ColmapCommand, PosesError> {
        ColmapCommand::of(&self.program, self.command)
    }

    /// The command that estimates the focal lengths of a database, without options, where it has one.
    ///
    /// # Errors
    /// It cannot be started.
    pub(crate) fn calibrator(&self) -> Result<Option<ColmapCommand>, PosesError> {
        self.calibrator.map(|command| ColmapCommand::of(&self.program, command)).transpose()
    }
}

/// Whether focal lengths are estimated before a global mapper, which keeps close to them: where most photos do not say theirs
/// and at least two on average share one. On 15 photos of one camera without EXIF data, COLMAP 4.2.1 puts 6 at 3 to 9 times the
/// scene's size from where they are without this, and none with it. With a camera for each photo it does harm.
pub(crate) fn calibrates(photos: usize, with_focal_length: usize, cameras: usize) -> bool {
    2 * with_focal_length < photos && 2 * cameras <= photos
}

/// Whether a global mapper that is there computes the poses of so many photos.
pub(crate) fn is_global(choice: PoseMapper, photos: usize) -> bool {
    match choice {
        PoseMapper::Auto => photos > FEW,
        PoseMapper::Colmap => false,
        PoseMapper::Glomap => true,
    }
}

/// What a mapper reads and writes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MapperFiles<'a> {
    pub database: &'a Path,
    /// The folder of the photos.
    pub photos: &'a Path,
    /// Their names, a line each.
    pub list: &'a Path,
    /// The folder of the models.
    pub models: &'a Path,
}

impl MapperFiles<'_> {
    fn of(&self, command: ColmapCommand) -> ColmapCommand {
        command
            .path("database_path", self.database)
            .path("image_path", self.photos)
            .path("output_path", self.models)
    }

    /// COLMAP's mapper with models of so many photos at the least. It leaves snapshots in a folder, and starts `from`
    /// one.
    pub fn one_by_one(
        &self,
        command: ColmapCommand,
        threads: usize,
        least_photos: usize,
        snapshots: &Path,
        from: Option<&Path>,
    ) -> Vec<String> {
        let command = self
            .of(command)
            .path("image_list_path", self.list)
            .option(&["Mapper.num_threads"], threads)
            .option(&["Mapper.min_model_size"], least_photos)
            .path("Mapper.snapshot_path", snapshots)
            .option(&["Mapper.snapshot_images_freq", "Mapper.snapshot_frames_freq"], EVERY);
        match from {
            Some(snapshot) => command.path("input_path", snapshot).arguments(),
            None => command.arguments(),
        }
    }

    /// A global mapper. Those that know no list take all photos of the database; those that know no threads have them from
    /// [`thread_variables`].
    pub fn at_once(&self, command: ColmapCommand, threads: usize) -> Vec<String> {
        let mut command = self.of(command);
        if command.knows(LIST) {
            command = command.path(LIST, self.list);
        }
        if command.knows(GLOBAL_THREADS) {
            command = command.option(&[GLOBAL_THREADS], threads);
        }
        command.arguments()
    }
}

/// The variables by which a global mapper without an option for threads has them: its solvers are of OpenMP.
pub(crate) fn thread_variables(command: &ColmapCommand, threads: usize) -> Vec<(&'static str, String)> {
    let variables = || vec![("OMP_NUM_THREADS", threads.to_string())];
    if command.knows(GLOBAL_THREADS) { Vec::new() } else { variables() }
}

/// Options that not every global mapper has.
pub(crate) const LIST: &str = "image_list_path";
const GLOBAL_THREADS: &str = "GlobalMapper.num_threads";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_choice_follows_the_setting_and_the_number_of_photos() {
        for (choice, few, many) in [
            (PoseMapper::Auto, false, true),
            (PoseMapper::Colmap, false, false),
            (PoseMapper::Glomap, true, true),
        ] {
            assert_eq!((is_global(choice, 12), is_global(choice, 2000)), (few, many), "{choice}");
        }
    }

    #[test]
    fn commands_have_the_options_that_each_mapper_knows() {
        let files = MapperFiles {
            database: Path::new("/p/colmap.db"),
            photos: Path::new("/photos"),
            list: Path::new("/p/photos.txt"),
            models: Path::new("/p/models"),
        };
        let common = "--database_path arg\n  --image_path arg\n  --output_path arg";
        let paths =
            ["--database_path", "/p/colmap.db", "--image_path", "/photos", "--output_path", "/p/models"];
        let list = ["--image_list_path", "/p/photos.txt"];
        // `glomap mapper` of GLOMAP 1.
        let alone = files.at_once(ColmapCommand::with_help("mapper", common), 4);
        assert_eq!(alone, [&["mapper"][..], &paths[..]].concat());
        let variables = thread_variables(&ColmapCommand::with_help("mapper", common), 4);
        assert_eq!(variables, [("OMP_NUM_THREADS", "4".to_owned())]);
        // `colmap global_mapper` with a list and threads.
        let help = format!("{common}\n --image_list_path arg\n --GlobalMapper.num_threads arg (=-1)");
        let command = ColmapCommand::with_help("global_mapper", help);
        assert!(thread_variables(&command, 4).is_empty());
        let within = files.at_once(command, 4);
        let threads = ["--GlobalMapper.num_threads", "4"];
        assert_eq!(within, [&["global_mapper"][..], &paths[..], &list[..], &threads[..]].concat());
        // COLMAP 3.8.
        let help = format!(
            "{common}\n --input_path arg\n --image_list_path arg\n --Mapper.num_threads arg\n \
             --Mapper.min_model_size arg (=10)\n --Mapper.snapshot_path arg\n --Mapper.snapshot_images_freq arg (=0)"
        );
        let command = || ColmapCommand::with_help("mapper", help.as_str());
        let snapshots = Path::new("/p/snapshots");
        let rest = ["--Mapper.num_threads", "4", "--Mapper.min_model_size", "3"];
        let leaves = ["--Mapper.snapshot_path", "/p/snapshots", "--Mapper.snapshot_images_freq", "50"];
        let whole = [&["mapper"][..], &paths[..], &list[..], &rest[..], &leaves[..]].concat();
        assert_eq!(files.one_by_one(command(), 4, 3, snapshots, None), whole);
        let from = ["--input_path", "/p/snapshots/7"];
        let again = files.one_by_one(command(), 4, 3, snapshots, Some(Path::new("/p/snapshots/7")));
        assert_eq!(again, [&whole[..], &from[..]].concat());
    }

    #[test]
    fn photos_of_one_unknown_lens_are_not_mapped_by_a_guessed_focal_length() {
        for (photos, with_focal_length, cameras, estimated) in
            [(15, 0, 1, true), (15, 7, 7, true), (15, 8, 1, false), (15, 15, 1, false), (15, 0, 15, false)]
        {
            let found = calibrates(photos, with_focal_length, cameras);
            assert_eq!(found, estimated, "{with_focal_length} of {photos}, {cameras} cameras");
        }
        let found =
            |help: &str| Glomap::find(Colmap::of_help("colmap".into(), help).as_ref()).unwrap().calibrator;
        assert_eq!(found("COLMAP 4.0.1 -- x\n  global_mapper\n"), None);
        let newer = "COLMAP 4.2.1 -- x\n  global_mapper\n  view_graph_calibrator\n";
        assert_eq!(found(newer), Some("view_graph_calibrator"));
    }

    #[test]
    fn a_colmap_without_a_global_mapper_gives_none() {
        // Whether the program `glomap` is on this machine does not matter here.
        let within = |colmap: Option<Colmap>| {
            Glomap::find(colmap.as_ref())
                .filter(|found| found.command == "global_mapper")
                .map(|found| found.version)
        };
        assert_eq!(within(None), None);
        assert_eq!(within(Colmap::of_help("colmap".into(), "COLMAP 3.8 -- x\n  mapper\n")), None);
        let new = Colmap::of_help("colmap".into(), "COLMAP 4.0.1 -- x\n  global_mapper\n");
        assert_eq!(within(new).as_deref(), Some("COLMAP 4.0.1 (global_mapper)"));
    }
}
