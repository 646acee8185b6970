//! `segwild eval`

use crate::args::{self, examples, json, path_of, selection};
use crate::failure::Failure;
use crate::output::{print_json, print_line, print_warning};
use clap::{ArgMatches, Command};
use segwild_pipeline::{HeldOut, RunFolder};

/// The command's arguments.
pub fn command() -> Command {
    Command::new("eval")
        .about("Score held-out photos, and selections against true masks")
        .arg(args::run())
        .arg(args::path("truth", "Folder of true masks of the object, named as the photos"))
        .arg(args::path("transient-truth", "Folder of true transient masks, named as the photos"))
        .arg(selection("The selection to score [default: object]"))
        .arg(json())
        .after_help(examples(
            "segwild eval runs/trevi",
            "segwild eval runs/trevi --selection oceanus --truth masks/oceanus",
        ))
}

/// Prints held-out scores, or scores a selection against true masks.
pub fn eval(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path_of(matches, "run").expect("clap requires it"))?;
    let json = matches.get_flag("json");
    let selection = matches.get_one::<String>("selection");
    if let Some(truth) = path_of(matches, "transient-truth") {
        return transients(&folder, &truth, json);
    }
    let Some(truth) = path_of(matches, "truth") else {
        if let Some(name) = selection {
            return Err(Failure::usage(format!("scoring the selection `{name}` needs --truth FOLDER")));
        }
        return held_out(&folder, json);
    };
    let name = selection.cloned().unwrap_or_else(|| "object".into());
    let score = segwild_pipeline::score(&folder, &name, &truth)?;
    if json {
        return print_json(&score);
    }
    for unread in &score.unread {
        print_warning(&format!("{unread}; this photo does not count"));
    }
    if let Some(provider) = &score.provider {
        print_line(&format!("masks of the provider {provider}"))?;
    }
    print_line(&format!("{:>7} {:>7} {:>7} {:>7} {:>7}  photo", "IoU", "acc", "B-IoU", "amodal", "stray"))?;
    for p in &score.photos {
        let note = if p.prompted { " (prompted, not in the mean)" } else { "" };
        print_line(&format!(
            "{:7.3} {:7.3} {:7.3} {:7.3} {:7.3}  {}{note}",
            p.iou, p.accuracy, p.boundary_iou, p.amodal_iou, p.stray_light, p.photo
        ))?;
    }
    print_line(&format!(
        "{:7.3} {:7.3} {:7.3} {:7.3} {:7.3}  mean",
        score.iou, score.accuracy, score.boundary_iou, score.amodal_iou, score.stray_light
    ))
}

fn held_out(folder: &RunFolder, json: bool) -> Result<(), Failure> {
    let file = folder.path().join("evaluation.json");
    let text = std::fs::read_to_string(&file).map_err(|_| {
        Failure::usage(
            "this run has no held-out scores: hold photos out with --hold-out N or a split, and run; or give --truth to \
             score a selection",
        )
    })?;
    let held: HeldOut = serde_json::from_str(&text)
        .map_err(|e| Failure { message: format!("{}: {e}", file.display()), code: crate::exit::FOLDER })?;
    if json {
        return print_json(&held);
    }
    let named = held.named_lpips();
    // A column where there are weights of LPIPS, none where there are not.
    let lpips = |score: Option<f32>| match (&named, score) {
        (Some((name, _)), Some(score)) => format!("  {name} {score:.3}"),
        (Some((name, _)), None) => format!("  {name}     -"),
        (None, _) => String::new(),
    };
    for p in &held.photos {
        print_line(&format!("{:6.2} dB  SSIM {:.3}{}  {}", p.psnr, p.ssim, lpips(p.lpips), p.photo))?;
    }
    let mean = lpips(held.lpips);
    print_line(&format!("{:6.2} dB  SSIM {:.3}{mean}  mean ({})", held.psnr, held.ssim, held.protocol))?;
    if held.left_out > 0.0 {
        let share = 100.0 * held.left_out;
        print_line(&format!(
            "{:6.2} dB  without the {share:.1} % of the pixels that contradict the scene",
            held.kept_psnr
        ))?;
    }
    Ok(())
}

fn transients(folder: &RunFolder, truth: &std::path::Path, json: bool) -> Result<(), Failure> {
    let scores = segwild_pipeline::score_transients(folder, truth)?;
    if json {
        return print_json(&scores);
    }
    for unread in &scores.unread {
        print_warning(&format!("{unread}; this photo does not count"));
    }
    print_line(&format!("{:>7} {:>9} {:>9}  photo", "IoU", "covered %", "wrong %"))?;
    for p in &scores.photos {
        let (covered, wrong) = (100.0 * p.covered, 100.0 * p.false_share);
        print_line(&format!("{:7.3} {covered:9.1} {wrong:9.1}  {}", p.iou, p.photo))?;
    }
    print_line(&format!(
        "{:7.3} mean of the photos with transients; {:.3} over all pixels; {:.1} % of the photos wrongly left out",
        scores.iou,
        scores.pooled_iou,
        100.0 * scores.false_share
    ))
}
