//! `segwild objects`

use crate::args::{self, examples, json, path_of};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line, print_warning};
use crate::progress::stop_on_ctrl_c;
use clap::builder::PossibleValuesParser;
use clap::{Arg, ArgAction, ArgMatches, Command};
use segwild_flow::Stopper;
use segwild_pipeline::{
    ExportFormat, ExportedObjects, ObjectList, RunFolder, SceneObject, Session, SessionOptions,
    export_objects, list_objects,
};
use serde::Serialize;

/// The command's arguments.
pub fn command() -> Command {
    Command::new("objects")
        .about("List the objects of a scene, name them, and write all of them as files")
        .arg(args::run())
        .arg(
            Arg::new("rename")
                .long("rename")
                .value_name("N=NAME")
                .action(ArgAction::Append)
                .help("Name object N (a number, or its present name); an empty NAME takes its name away"),
        )
        .arg(args::path(
            "out",
            "Write all objects into this folder: a file each, labels.ply, labels.npy, coco.json",
        ))
        .arg(
            Arg::new("format")
                .long("format")
                .value_name("WORD")
                .value_parser(PossibleValuesParser::new(ExportFormat::choices()))
                .default_value("ply")
                .requires("out")
                .help("Format of the objects' files"),
        )
        .arg(
            Arg::new("appearance")
                .long("appearance")
                .value_name("PHOTO")
                .requires("out")
                .help("Use this photo's appearance [default: the scene's own]"),
        )
        .arg(json())
        .after_help(examples(
            "segwild objects runs/trevi --rename 3=oceanus --out trevi-objects",
            "segwild segment runs/trevi --object oceanus --name oceanus",
        ))
}

/// Lists, names and exports objects.
pub fn objects(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path_of(matches, "run").expect("clap requires it"))?;
    let renames: Vec<(&str, &str)> = matches
        .get_many::<String>("rename")
        .unwrap_or_default()
        .map(|text| {
            text.split_once('=').ok_or_else(|| {
                Failure::usage(format!("--rename {text}: expected N=NAME, such as --rename 3=statue"))
            })
        })
        .collect::<Result<_, _>>()?;
    let stopper = Stopper::new();
    stop_on_ctrl_c(&stopper)?;
    use_threads(folder.settings()?.run.threads);
    let session =
        Session::open(&folder, SessionOptions { stopper: stopper.clone(), ..SessionOptions::default() })?;
    let mut listed = list_objects(&session, &stopper)?;
    if let Some(why) = &listed.not_kept {
        print_warning(&format!("the list is not kept: {why}"));
    }
    for (object, name) in &renames {
        listed.list.rename(object, name)?;
    }
    if !renames.is_empty() {
        listed.list.write(&folder)?;
    }
    let exported = match path_of(matches, "out") {
        Some(out) => {
            let format = matches.get_one::<String>("format").expect("it has a default");
            let format = ExportFormat::read(format).expect("clap lets no other value through");
            let appearance = matches.get_one::<String>("appearance").map_or("", String::as_str);
            Some(export_objects(&session, &listed, &out, appearance, format, &stopper)?)
        }
        None => None,
    };
    let list = &listed.list;
    if matches.get_flag("json") {
        return print_json(&ListedAndExported { objects: &list.objects, exported: exported.as_ref() });
    }
    print_table(list)?;
    let sheet = ObjectList::sheet(&folder);
    if sheet.is_file() {
        print_line(&format!("thumbnails: {}", sheet.display()))?;
    }
    match exported {
        Some(done) => print_line(&format!(
            "{} objects, and {} masks in coco.json: {}",
            done.objects,
            done.masks,
            done.folder.display()
        )),
        None => Ok(()),
    }
}

/// The answer as JSON.
#[derive(Serialize)]
struct ListedAndExported<'a> {
    objects: &'a [SceneObject],
    /// What was written; `null` without `--out`.
    exported: Option<&'a ExportedObjects>,
}

fn print_table(list: &ObjectList) -> Result<(), Failure> {
    let longest = list.objects.iter().map(|o| o.name.len()).max().unwrap_or(0).max(4);
    print_line(&format!("  n  {:longest$}   splats  % of light  photos  shown best by", "name"))?;
    for o in &list.objects {
        print_line(&format!(
            "{:3}  {:longest$}  {:7}  {:10.1}  {:6}  {}",
            o.number,
            o.name,
            o.splats,
            100.0 * o.light,
            o.photos,
            o.photo
        ))?;
    }
    Ok(())
}
