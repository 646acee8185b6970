//! `segwild render`

use crate::args::{self, appearances, choice, examples, json, path_of, selection, under};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use crate::progress::stop_on_ctrl_c;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_flow::Stopper;
use segwild_pipeline::{
    AppearanceRequest, CameraPath, FRAMES_PER_SECOND, MOST_FRAMES, Mode, RenderContent, RenderRequest,
    RunFolder,
};
use segwild_scene::settings::Value;

/// The command's arguments.
pub fn command() -> Command {
    let camera = [
        args::photos("View to render; two or more with --frames make a path [default: all]"),
        choice(
            "path",
            ["photos", "turntable", "orbit"],
            "Camera path: through the photos; around the selection alone; around it in its scene [default: photos]",
        ),
        Arg::new("frames")
            .long("frames")
            .value_name("N")
            .value_parser(value_parser!(u32).range(2..=i64::from(MOST_FRAMES)))
            .help("Frames of the path, 100000 at most [default: 120 around a selection]"),
        Arg::new("fps")
            .long("fps")
            .value_name("N")
            .value_parser(value_parser!(u32).range(1..=240))
            .help("Frames per second of a video [default: 30]"),
    ];
    let selected = [
        selection("Render this selection"),
        choice(
            "mode",
            ["highlight", "only", "without", "scene"],
            "How the selection is rendered [default: highlight; only on a turntable; scene with --object-appearance]",
        )
        .requires("selection"),
    ];
    let output = [
        choice("what", ["colour", "depth", "alpha", "features"], "What is rendered").default_value("colour"),
        Arg::new("width")
            .long("width")
            .value_name("PX")
            .value_parser(value_parser!(u32).range(16..=16384))
            .help("Long side of the images [default: as trained]"),
        args::path("out", "Folder for the images, or a video .mp4 [default: RUN/renders]"),
        json(),
    ];
    Command::new("render")
        .about("Render views of photos, a camera path, or a video; any appearance; a selection")
        .arg(args::run())
        .args(under("Camera", camera))
        .args(appearances("view's own; on a path it changes from photo to photo"))
        .args(under("Selection", selected))
        .args(under("Output", output))
        .after_help(examples(
            "segwild render runs/trevi --photo a.jpg --selection oceanus --mode only",
            "segwild render runs/trevi --selection oceanus --path turntable --out oceanus.mp4",
        ))
}

/// Renders views.
pub fn render(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path_of(matches, "run").expect("clap requires it"))?;
    let word = |name: &str| matches.get_one::<String>(name).cloned();
    let object_appearance = object_appearance(matches);
    let path = word("path").map_or(CameraPath::Photos, |word| {
        CameraPath::read(&word).expect("clap lets no other value through")
    });
    let mode = match word("mode").as_deref() {
        Some("only") => Mode::Only,
        Some("without") => Mode::Without,
        Some("scene") => Mode::Scene,
        None if object_appearance.is_some() => Mode::Scene,
        None if path == CameraPath::Turntable => Mode::Only,
        _ => Mode::Highlight,
    };
    let what = match word("what").as_deref() {
        Some("depth") => RenderContent::Depth,
        Some("alpha") => RenderContent::Alpha,
        Some("features") => RenderContent::Features,
        _ => RenderContent::Colour,
    };
    let request = RenderRequest {
        photos: matches.get_many::<String>("photo").into_iter().flatten().cloned().collect(),
        path,
        frames: matches.get_one::<u32>("frames").copied(),
        rate: matches.get_one::<u32>("fps").copied().unwrap_or(FRAMES_PER_SECOND),
        appearance: appearance(matches),
        object_appearance,
        interpolate: matches.get_one::<f32>("interpolate").copied(),
        selection: word("selection").map(|name| (name, mode)),
        what,
        width: matches.get_one::<u32>("width").copied(),
        out: path_of(matches, "out"),
    };
    let stopper = Stopper::new();
    stop_on_ctrl_c(&stopper)?;
    for rendered in segwild_pipeline::render(&folder, &request, &stopper)? {
        if matches.get_flag("json") {
            print_json(&rendered)?;
        } else {
            print_line(&format!("{}{}", rendered.file.display(), unseen(rendered.unseen)))?;
        }
    }
    Ok(())
}

/// What an image shows that no photo saw, in words.
fn unseen(share: Option<f32>) -> String {
    match share.filter(|share| *share > 0.0) {
        Some(share) => format!(" ({:.1} % of its pixels show what no photo saw)", 100.0 * share),
        None => String::new(),
    }
}

/// The appearances of the scene that flags name.
pub fn appearance(matches: &ArgMatches) -> AppearanceRequest {
    let file = path_of(matches, "appearance-from");
    AppearanceRequest { file, ..named(matches, "appearance", "strength") }
}

fn named(matches: &ArgMatches, flag: &str, strength: &str) -> AppearanceRequest {
    AppearanceRequest {
        photos: matches.get_many::<String>(flag).into_iter().flatten().cloned().collect(),
        strength: matches.get_one::<f32>(strength).copied().unwrap_or(1.0),
        file: None,
    }
}

/// The appearances of the selected object, if it has its own.
pub fn object_appearance(matches: &ArgMatches) -> Option<AppearanceRequest> {
    Some(named(matches, "object-appearance", "object-strength"))
        .filter(|appearance| !appearance.photos.is_empty())
}
