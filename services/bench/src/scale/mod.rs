//! How time and memory grow: with splats, photos, pixels, channels and objects, and the time of a click with photos; the slopes;
//! and what they predict for a scene that does not fit here.

mod axes;
pub(crate) mod kernels;
mod page;

pub use axes::{AXES, Fit, PROTOCOL, along, beyond};
pub use page::{markdown, write};

use crate::harm::Harm;
use crate::page::{PageError, io};
use crate::point::{self, PhotoSource, PointJob, Prompting};
use segwild_eval::oracle::OracleOptions;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::trial::ProviderKind;
use segwild_scene::statistics::median;
use segwild_synthetic::SyntheticOptions;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What to measure. An axis with fewer than two sizes is left out.
#[derive(Clone, Debug)]
pub struct ScaleOptions {
    /// Folder for `results.json`, and for scenes and runs while they are made.
    pub out: PathBuf,
    /// The `segwild` program.
    pub program: PathBuf,
    /// The command line that makes it again.
    pub command: String,
    /// Axes to measure; all when empty.
    pub only: Vec<String>,
    /// Splats of the kernels' frame.
    pub kernel_splats: Vec<u32>,
    /// Widths of the kernels' frame in pixels.
    pub kernel_pixels: Vec<u32>,
    /// Channels of the kernels' frame.
    pub kernel_channels: Vec<u32>,
    /// Photos of whole runs.
    pub photos: Vec<u32>,
    /// Most splats of whole runs.
    pub splats: Vec<u32>,
    /// Long sides of the photos of whole runs.
    pub pixels: Vec<u32>,
    /// Photos of whole runs that are clicked.
    pub clicks: Vec<u32>,
}

/// Measures what is not known yet; `report` receives the record of every size.
pub fn scale(options: &ScaleOptions, mut report: impl FnMut(&Record)) -> Result<Results, PageError> {
    PageError::refuse("axis", &options.only, &AXES, |o| AXES.contains(&o))?;
    io(&options.out, std::fs::create_dir_all(&options.out))?;
    let file = options.out.join("results.json");
    let mut results = if file.is_file() { Results::read(&file)? } else { Results::default() };
    results.made = Provenance::here(options.command.clone());
    for axis in AXES {
        if !(options.only.is_empty() || options.only.iter().any(|o| o == axis)) {
            continue;
        }
        for size in sizes(options, axis) {
            let at = Some(f64::from(size));
            // Of objects, `at` is how many there were to click on.
            let known = |r: &&Record| r.at == at || r.numbers.get(PER_OBJECT) == at.as_ref();
            if results.records.iter().filter(|r| r.setting == axis).any(|r| known(&r)) {
                continue;
            }
            let record = match axis {
                "kernels splats" => kernels::measure(axis, size, size, 400, 3)?,
                "kernels pixels" => kernels::measure(axis, size, 20_000, size, 3)?,
                "kernels channels" => kernels::measure(axis, size, 20_000, 400, size)?,
                _ => run(options, axis, size)?,
            };
            report(&record);
            results.put(record);
            results.write(&file)?;
        }
    }
    Ok(results)
}

fn sizes(options: &ScaleOptions, axis: &str) -> Vec<u32> {
    match axis {
        "kernels splats" => options.kernel_splats.clone(),
        "kernels pixels" => options.kernel_pixels.clone(),
        "kernels channels" => options.kernel_channels.clone(),
        "photos" => options.photos.clone(),
        "splats" => options.splats.clone(),
        "pixels" => options.pixels.clone(),
        "clicks" => options.clicks.clone(),
        _ => vec![1, 2, 4],
    }
}

/// Clicks on each object.
const PER_OBJECT: &str = "clicks_per_object";
/// Clicks on each object that are timed, anywhere on it. By choice: the median is over two clicks on each object of the scene.
const TIMED_CLICKS: u32 = 2;
/// What is recorded of a timed click: seconds to the first and to the last answer, and photos that it visited.
const OF_CLICKS: [&str; 3] = ["first_s", "click_s", "visited"];
/// Photos, steps and pixels of a whole run in which something else grows.
const PHOTOS: u32 = 16;
const STEPS: u32 = 300;
const PIXELS: u32 = 128;

/// A whole run with the built-in provider, in a process of its own, up to the held-out scores.
fn run(options: &ScaleOptions, axis: &str, size: u32) -> Result<Record, PageError> {
    let job = job_of(&options.out, axis, size);
    let _ = std::fs::remove_dir_all(&job.dir);
    let records = point::apart(&options.program, &job)?;
    let _ = std::fs::remove_dir_all(&job.dir);
    let (scene, clicks): (Vec<Record>, Vec<Record>) = records.into_iter().partition(|r| r.target.is_empty());
    let mut record = scene.into_iter().next().unwrap_or_default();
    match axis {
        "objects" => {
            let each = record.numbers.get("click_s").copied().unwrap_or(f64::NAN);
            record.at = Some(clicks.len() as f64);
            record.numbers.retain(|name, _| name == "peak_mib");
            record.numbers.insert("all_clicks_s".into(), each * clicks.len() as f64);
            record.numbers.insert(PER_OBJECT.into(), f64::from(size));
        }
        "clicks" => record.numbers = medians(&clicks),
        _ => {
            let kept = ["cpu_s", "wall_s", "peak_mib", "splats"];
            record.numbers.retain(|name, _| kept.contains(&name.as_str()));
        }
    }
    Ok(record)
}

/// What the process of that run is to do.
fn job_of(out: &Path, axis: &str, size: u32) -> PointJob {
    let of = |name: &str, usual: u32| if axis == name { size } else { usual };
    let photos = if axis == "clicks" { size } else { of("photos", PHOTOS) };
    let scene = SyntheticOptions {
        seed: 1,
        train: photos as usize,
        test: 2,
        long_side: of("pixels", PIXELS),
        // Where splats grow, there are points enough to start with.
        points: of("splats", 3000) as usize * 21 / 20,
        ..SyntheticOptions::default()
    };
    let splats = of("splats", 4000);
    let settings = [
        ("preset", "draft".to_owned()),
        // Else photos larger than the default would be made smaller.
        ("size", scene.long_side.to_string()),
        ("steps", STEPS.to_string()),
        ("refine_steps", "60".into()),
        ("splats", splats.to_string()),
        // Every run grows to what it is allowed; this strategy gives no splat away either.
        ("grow_gain", "0".into()),
        // Nor may pruning by multi-view support remove any: the photos are too few and small for it.
        ("robust", "false".into()),
        ("density", if axis == "splats" { "mcmc" } else { "budget" }.into()),
        // Caches of a fixed size, full in all.
        ("photo_cache_mib", "4".into()),
        ("feature_memory", "8".into()),
        ("vision_memory", "16".into()),
    ];
    PointJob {
        protocol: PROTOCOL.into(),
        setting: axis.into(),
        at: Some(f64::from(size)),
        source: PhotoSource::Synthetic(scene),
        providers: ProviderKind::Builtin,
        faults: OracleOptions::default(),
        settings: settings.map(|(name, value)| (name.to_owned(), value)).to_vec(),
        harm: Harm::default(),
        prompting: match axis {
            "objects" => Prompting::Random(size),
            "clicks" => Prompting::Timed(TIMED_CLICKS),
            _ => Prompting::Nowhere,
        },
        count: false,
        seed: 1,
        dir: out.join("run"),
    }
}

/// The median of each number of timed clicks; a number that none has is left out.
fn medians(clicks: &[Record]) -> BTreeMap<String, f64> {
    let median_of = |name: &str| median(clicks.iter().filter_map(|r| r.numbers.get(name).copied()).collect());
    OF_CLICKS.iter().filter_map(|name| Some(((*name).to_owned(), median_of(name)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_has_the_medians_of_its_timed_clicks() {
        let click = |click_s: f64, visited: f64| {
            let numbers = BTreeMap::from([("click_s".into(), click_s), ("visited".into(), visited)]);
            Record { numbers, ..Record::default() }
        };
        let of_run = medians(&[click(0.5, 64.0), click(9.0, 10.0), click(1.5, 40.0)]);
        assert_eq!(of_run, BTreeMap::from([("click_s".into(), 1.5), ("visited".into(), 40.0)]));
        assert!(medians(&[]).is_empty());
    }

    #[test]
    fn photos_larger_than_the_default_are_trained_at_their_size() {
        let size_of = |axis: &str, size: u32| {
            let job = job_of(Path::new("out"), axis, size);
            let PhotoSource::Synthetic(scene) = job.source else { panic!("a synthetic scene") };
            let set = job.settings.iter().find(|(name, _)| name == "size").map(|(_, value)| value.clone());
            (scene.long_side, set)
        };
        assert_eq!(size_of("pixels", 1600), (1600, Some("1600".into())));
        assert_eq!(size_of("splats", 1600), (PIXELS, Some(PIXELS.to_string())));
    }

    #[test]
    fn kernels_are_measured_and_cost_something() {
        let record = kernels::measure("kernels splats", 500, 500, 64, 3).unwrap();
        for name in ["project_ms", "forward_ms", "backward_ms", "gather_ms"] {
            assert!(record.numbers[name] > 0.0, "{name}");
        }
    }
}
