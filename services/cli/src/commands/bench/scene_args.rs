//! Arguments of benchmarks about their scenes: what synthetic ones are made of, who sees, where given ones lie.

use crate::args::{number, path, path_of, photo_count, pixels};
use crate::failure::Failure;
use clap::builder::{PossibleValue, PossibleValuesParser};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::protocols::ProtocolError;
use segwild_eval::protocols::folder::{Parts, read_parts};
use segwild_eval::trial::ProviderKind;
use segwild_scene::settings::Value;
use segwild_synthetic::{LightVariation, SyntheticOptions};
use std::path::PathBuf;

/// Adds what a synthetic scene is made of.
pub fn with_scene(command: Command, photos: &'static str, long_side: &'static str) -> Command {
    command.arg(photo_count(photos)).arg(pixels(long_side))
}

/// `--occlusion` of synthetic scenes.
pub fn occlusion() -> Arg {
    number("occlusion", "0.1", "Share of each synthetic photo that transients cover, 0 to 0.6")
        .value_parser(value_parser!(f32))
}

/// A flag that takes several numbers, of which each is measured.
pub fn each_of(name: &'static str, default: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("LIST").default_value(default).help(help)
}

/// `--only`: the parts of a benchmark that are measured.
pub fn only(help: &'static str) -> Arg {
    Arg::new("only").long("only").value_name("LIST").help(help)
}

/// `--sizes`: photos at each of them.
pub fn photo_sizes(default: &'static str) -> Arg {
    each_of("sizes", default, "Long sides of the photos in pixels, with commas")
}

/// What [`with_scene`] was given, but for the seed.
pub fn scene_of(matches: &ArgMatches) -> SyntheticOptions {
    let number = |name: &str| *matches.get_one::<u32>(name).expect("it has a default");
    let photos = number("photo-count") as usize;
    SyntheticOptions {
        train: photos,
        test: photos.div_ceil(5),
        long_side: number("pixels"),
        ..SyntheticOptions::default()
    }
}

/// `--light` of synthetic scenes.
pub fn light() -> Arg {
    Arg::new("light")
        .long("light")
        .value_name("WORD")
        .value_parser(PossibleValuesParser::new(LightVariation::CHOICES))
        .default_value("mixed")
        .help("What differs from photo to photo of a synthetic scene")
}

/// What [`light`] was given.
pub fn light_of(matches: &ArgMatches) -> Result<LightVariation, Failure> {
    LightVariation::read(matches.get_one::<String>("light").expect("it has a default"))
        .map_err(|e| Failure::usage(e.to_string()))
}

/// `--providers` of synthetic scenes.
pub fn providers() -> Arg {
    let choices = [
        PossibleValue::new("builtin")
            .alias("built-in")
            .help("What the settings name, as a user has it: the built-in provider, or networks"),
        PossibleValue::new("oracle")
            .help("The truth with faults: tests the 3D part alone, and no user has it"),
    ];
    Arg::new("providers")
        .long("providers")
        .value_name("WORD")
        .value_parser(PossibleValuesParser::new(choices))
        .default_value("builtin")
        .help("Who makes the masks of synthetic photos")
}

/// What [`providers`] was given.
pub fn providers_of(matches: &ArgMatches) -> ProviderKind {
    match matches.get_one::<String>("providers").map(String::as_str) {
        Some("oracle") => ProviderKind::Oracle,
        _ => ProviderKind::Builtin,
    }
}

/// `--parts` of an object on given photos.
pub fn parts() -> Arg {
    path("parts", "JSON file of the rows at which an object's parts meet, by photo: one click into each part")
}

/// What [`parts`] was given; none otherwise.
pub fn parts_of(matches: &ArgMatches) -> Result<Parts, ProtocolError> {
    path_of(matches, "parts").map_or_else(|| Ok(Parts::new()), |file| read_parts(&file))
}

/// The arguments of a benchmark that trains scenes by itself: their folders, and `--sizes`.
pub fn scenes_and_sizes(scenes: &'static str) -> [Arg; 2] {
    let folders = Arg::new("scenes").value_name("SCENE").num_args(1..).required(true);
    [folders.value_parser(value_parser!(PathBuf)).help(scenes), photo_sizes("320")]
}
