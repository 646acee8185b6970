//! `segwild segment`

use crate::args::{self, examples, json, path_of, positions, with_fields, with_table};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line};
use crate::progress::{duration, stop_on_ctrl_c};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_flow::Stopper;
use segwild_pipeline::{
    Code, ObjectList, PhotoPrompts, Replay, RunFolder, SegmentOutcome, Settings, TextMatch, TextRanking,
};
use segwild_scene::{BoxPrompt, PointPrompt, Prompts};
use segwild_segmenter::Alternative;

/// The command's arguments.
pub fn command() -> Command {
    with_fields(
        with_table(Command::new("segment").about("Click an object in one photo, get it in 3D"), "segment"),
        "vision",
        args::names_code,
    )
    .arg(args::run())
    .arg(args::photos("Photo of the prompts that follow; repeat for a second photo"))
    .arg(positions("positive", "X,Y", "Pixel that belongs to the object, at the photo's full size"))
    .arg(positions("negative", "X,Y", "Pixel that does not belong to it"))
    .arg(positions("box", "X0,Y0,X1,Y1", "Box around the object"))
    .arg(
        Arg::new("granularity")
            .long("granularity")
            .value_name("G")
            .value_parser(value_parser!(f32))
            .help("0 is the finest part under the click, 1 the largest object [default: automatic]"),
    )
    .arg(
        Arg::new("object")
            .long("object")
            .value_name("N|NAME")
            .conflicts_with_all(["photo", "positive", "negative", "box", "granularity"])
            .help("An object of the list of `segwild objects`, instead of clicks"),
    )
    .arg(
        Arg::new("text")
            .long("text")
            .value_name("TEXT")
            .conflicts_with_all(["photo", "positive", "negative", "box", "granularity", "object"])
            .help("Words for it, by a CLIP model in `--models`: 'the dome', or 'all windows'"),
    )
    .arg(
        args::path("prompts", "Repeat the prompts of this file (prompts.json of a selection)")
            .conflicts_with_all(["photo", "positive", "negative", "box", "granularity", "object", "text"]),
    )
    .arg(
        Arg::new("name")
            .long("name")
            .value_name("NAME")
            .default_value("object")
            .help("Name of the selection"),
    )
    .arg(json())
    .after_help(examples(
        "segwild segment runs/trevi --photo a.jpg --positive 640,420 --name oceanus",
        "segwild segment runs/trevi --photo a.jpg --box 500,200,800,700 --negative 520,690",
    ))
}

/// Clicks to an object.
pub fn segment(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path_of(matches, "run").expect("clap requires it"))?;
    let replay = replay(matches, &folder)?;
    let mut settings: Settings = folder.settings()?;
    // What the selection was made with, then what is requested now.
    settings.segment = replay.settings.clone().unwrap_or(settings.segment);
    let flags = crate::args::given(matches);
    for (name, value) in &flags {
        settings.set(name, value).map_err(segwild_pipeline::SettingsError::from)?;
    }
    use_threads(settings.run.threads);
    let stopper = Stopper::new();
    stop_on_ctrl_c(&stopper)?;
    let name = matches.get_one::<String>("name").expect("it has a default");
    let providers = segwild_pipeline::providers_for(&folder, &Code::given(&flags))?;
    let done =
        segwild_pipeline::segment(&folder, name, &replay, &settings.segment, Some(&providers), &stopper)?;
    if matches.get_flag("json") {
        return print_json(&done);
    }
    print_line(&format!(
        "{} splats by the masks of {}; the spike cut shortened {}, dropped {} and took in pieces of {}; shows on {} photos",
        done.splats, done.provider, done.cut, done.dropped, done.joined, done.photos
    ))?;
    print_line(&format!(
        "{} photos' own boundaries took part, {} disagreed; selected in {}",
        done.agreeing,
        done.disagreeing,
        duration(done.select_s)
    ))?;
    for words in done.confidence.sentences() {
        print_line(&words)?;
    }
    if done.seen_once > 0 {
        print_line(&format!("{} splats that one photo alone shows were left out", done.seen_once))?;
    }
    let alternative = settings.segment.alternative as usize;
    match &done.ranking {
        Some(ranking) => print_ranking(ranking, alternative)?,
        None => print_alternatives(&done, alternative)?,
    }
    for note in &done.notes {
        print_line(&format!("warning: {note}"))?;
    }
    print_line(&format!("object: {}", done.folder.join("object.ply").display()))?;
    print_line(&format!("masks:  {}", done.folder.join("masks").display()))
}

/// What else clicks may mean.
fn print_alternatives(done: &SegmentOutcome, selected: usize) -> Result<(), Failure> {
    let others = done.alternatives.iter().enumerate().filter(|(i, _)| *i != selected);
    let others: Vec<String> = others
        .map(|(i, alternative)| match alternative {
            Alternative::Group(area) => format!("--alternative {i} ({:.1} % of the scene)", 100.0 * area),
            Alternative::Surface(area) => {
                format!("--alternative {i} (the surface, {:.1} % of the scene)", 100.0 * area)
            }
            Alternative::Photo => format!("--alternative {i} (the prompted photo's own mask)"),
        })
        .collect();
    if others.is_empty() {
        return Ok(());
    }
    print_line(&format!("the prompts may also mean {}", others.join(", ")))
}

/// What a text may mean: what it selects, and a line for each other match.
fn print_ranking(ranking: &TextRanking, selected: usize) -> Result<(), Failure> {
    let selected = selected.min(ranking.matches.len().saturating_sub(1));
    let described = |found: &TextMatch| {
        let what = match (found.groups, found.object) {
            (groups, _) if groups > 1 => format!("{groups} groups together"),
            (_, Some(number)) => format!("object {number}"),
            _ => "a group that is not listed".to_owned(),
        };
        let share = 100.0 * found.light;
        format!("{what}, {share:.1} % of the scene, shown best by {}, score {:.2}", found.photo, found.score)
    };
    if let Some(found) = ranking.matches.get(selected) {
        print_line(&format!("`{}` is {}", ranking.text, described(found)))?;
    }
    for (i, found) in ranking.matches.iter().enumerate().filter(|(i, _)| *i != selected) {
        print_line(&format!("--alternative {i} is {}", described(found)))?;
    }
    Ok(())
}

/// Which kind of prompt, where it stands on the command line, and its text.
type Given<'a> = (usize, &'static str, &'a String);

/// The prompts on the command line, each on the photo named last before it, an object of the list, a text, or what a file asks.
fn replay(matches: &ArgMatches, folder: &RunFolder) -> Result<Replay, Failure> {
    if let Some(file) = path_of(matches, "prompts") {
        return Ok(Replay::read(&file)?);
    }
    if let Some(object) = matches.get_one::<String>("object") {
        let Some(list) = ObjectList::read(folder) else {
            return Err(Failure::usage(
                "the scene's objects are not listed yet: `segwild objects RUN` lists them",
            ));
        };
        return Ok(Replay { object: Some(list.query(object)?), ..Replay::default() });
    }
    if let Some(text) = matches.get_one::<String>("text") {
        return Ok(Replay { text: Some(text.clone()), ..Replay::default() });
    }
    let mut given: Vec<Given> = Vec::new();
    for kind in ["photo", "positive", "negative", "box"] {
        if let (Some(at), Some(texts)) = (matches.indices_of(kind), matches.get_many::<String>(kind)) {
            given.extend(at.zip(texts).map(|(i, text)| (i, kind, text)));
        }
    }
    given.sort_by_key(|g| g.0);
    let granularity = matches.get_one::<f32>("granularity").copied();
    let mut photos: Vec<PhotoPrompts> = Vec::new();
    for (_, kind, text) in given {
        if kind == "photo" {
            let prompts = Prompts { granularity, ..Prompts::default() };
            photos.push(PhotoPrompts { photo: text.clone(), prompts });
            continue;
        }
        let Some(photo) = photos.last_mut() else {
            return Err(Failure::usage(format!(
                "--{kind} {text} comes before --photo: name the photo first"
            )));
        };
        if kind == "box" {
            let [x0, y0, x1, y1] = numbers(kind, text)?;
            photo.prompts.boxes.push(BoxPrompt { x0, y0, x1, y1 });
        } else {
            let [x, y] = numbers(kind, text)?;
            photo.prompts.points.push(PointPrompt { x, y, inside: kind == "positive" });
        }
    }
    if photos.is_empty() {
        return Err(Failure::usage(
            "nothing is prompted: give --photo NAME --positive x,y, --object N, --text WORDS or --prompts FILE",
        ));
    }
    Ok(Replay { prompts: photos, ..Replay::default() })
}

/// `N` finite numbers with commas between them.
fn numbers<const N: usize>(flag: &str, text: &str) -> Result<[f32; N], Failure> {
    let read: Vec<f32> =
        text.split(',').filter_map(|t| t.trim().parse().ok()).filter(|x: &f32| x.is_finite()).collect();
    match <[f32; N]>::try_from(read) {
        Ok(numbers) if text.split(',').count() == N => Ok(numbers),
        _ => Err(Failure::usage(format!("--{flag} {text}: expected {N} numbers with commas between them"))),
    }
}
