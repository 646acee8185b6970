//! `segwild run`

use super::{path, print_json, print_line, use_threads};
use crate::failure::Failure;
use crate::progress::{duration, show, stop_on_ctrl_c};
use clap::ArgMatches;
use segwild_flow::{Events, Stopper};
use segwild_pipeline::{RunFolder, RunOptions, Settings, Summary};
use std::path::{Path, PathBuf};

/// Runs a scene, or what is left of it.
pub fn run(matches: &ArgMatches) -> Result<(), Failure> {
    let scene = path(matches, "scene").expect("clap requires it");
    let out = path(matches, "out").unwrap_or_else(|| default_folder(&scene));
    let kept = out.join("segwild.toml");
    let file = path(matches, "config").or_else(|| kept.is_file().then_some(kept));
    let settings = Settings::layered(file.as_deref(), &crate::args::given(matches))?;
    let json = matches.get_flag("json");
    let summary = run_scene(&scene, &out, &settings, matches.get_one::<String>("until").cloned(), json)?;
    if json {
        return print_json(&serde_json::json!({ "event": "summary", "folder": out, "summary": summary }));
    }
    tell(&summary, &out)
}

/// `runs/NAME` for a scene folder of that name.
fn default_folder(scene: &Path) -> PathBuf {
    let whole = std::path::absolute(scene).unwrap_or_else(|_| scene.to_owned());
    let name = whole.file_stem().map_or("scene".into(), |n| n.to_string_lossy().into_owned());
    Path::new("runs").join(name)
}

/// Runs a scene with progress and Ctrl-C.
pub fn run_scene(
    scene: &Path,
    out: &Path,
    settings: &Settings,
    until: Option<String>,
    json: bool,
) -> Result<Summary, Failure> {
    use_threads(settings.run.threads);
    let events = Events::new();
    let stopper = Stopper::new();
    stop_on_ctrl_c(&stopper)?;
    let sink = show(&events, json)?;
    let folder = RunFolder::create(out)?;
    let options = RunOptions { events, stopper, providers: None, until };
    let done = segwild_pipeline::run(scene, &folder, settings, &options);
    drop(options);
    drop(sink); // everything that happened is shown before the last word
    Ok(done?)
}

/// Says how it went.
pub fn tell(summary: &Summary, out: &Path) -> Result<(), Failure> {
    print_line(&format!(
        "{} photos, {} splats, {}",
        summary.photos,
        summary.splats,
        duration(summary.wall_s)
    ))?;
    for skipped in &summary.skipped {
        print_line(&format!("skipped {}: {}", skipped.name, skipped.reason))?;
    }
    if let Some(psnr) = summary.train_psnr {
        print_line(&format!("training photos: {psnr:.2} dB"))?;
    }
    if let Some(held) = &summary.held_out {
        print_line(&format!(
            "held-out photos: {:.2} dB, SSIM {:.3} ({})",
            held.psnr, held.ssim, held.protocol
        ))?;
    }
    let report = out.join("report.html");
    if report.is_file() {
        print_line(&format!("report: {}", report.display()))?;
    }
    Ok(())
}
