//! `segwild bench`: what it says where data is missing, and what it leaves.

use crate::common::*;

#[test]
fn benchmarks_without_their_data_say_what_to_put_where() {
    let dir = folder();
    let (none, out) = (show(&dir.path().join("none")), show(&dir.path().join("out")));
    let bench = |args: &[&str], code, words: &[&str]| {
        let all: Vec<&str> = ["bench"].iter().chain(args).chain(&["--out", &out]).copied().collect();
        refuses(&all, code, words);
    };
    bench(&["photo-tourism", &none], 3, &["Brandenburg Gate", "taj_mahal", "truth/lintel/PHOTO.png"]);
    bench(&["nvos", &none], 3, &["scribbles", "pos_*.png"]);
    bench(&["spin-nerf", &none], 3, &["ROOT/SCENE/label"]);
    bench(&["folder", &none], 3, &["none"]);
    bench(&["synthetic", "--only", "no-such-row"], 2, &["no row `no-such-row`", "the rows are full"]);
    bench(&["synthetic", "--seeds", "one"], 2, &["--seeds one", "whole numbers"]);
    bench(&["synthetic", "--change", "tau=7"], 2, &["-1 to 1"]);
}

#[test]
fn a_table_of_baselines_is_printed_kept_and_written_as_a_page() {
    let dir = folder();
    let (out, page) = (show(dir.path()), dir.path().join("page.md"));
    let bench = |row: &str, more: &[&str]| {
        let small = ["--photo-count", "6", "--pixels", "80", "--steps", "40", "--refine-steps", "0"];
        let rest = ["--prompt-budget", "8", "--seeds", "5", "--only", row, "--out", &out];
        let start = ["bench", "synthetic", "--table", "baselines"];
        let all: Vec<&str> = start.iter().chain(&small).chain(&rest).chain(more).copied().collect();
        works(&all)
    };
    let stdout = bench("gs-w", &[]);
    assert!(
        stdout.contains("| gs-w | paper | – | 0.803 |") && stdout.contains("| gs-w | here | built-in |"),
        "{stdout}"
    );
    let stdout = bench("flashsplat-one", &["--keep", "--page", &show(&page)]);
    assert!(stdout.contains("| gs-w | here |") && stdout.contains("| flashsplat-one | here |"), "{stdout}");
    // The oracle's figures stand beside the others, and no page with them hides whose they are.
    let stdout = bench("gs-w", &["--keep", "--providers", "oracle", "--page", &show(&page)]);
    assert!(
        stdout.contains("| gs-w | here | built-in |") && stdout.contains("| gs-w | here | oracle |"),
        "{stdout}"
    );
    let text = std::fs::read_to_string(&page).expect("a page");
    assert!(
        text.starts_with(
            "# Synthetic scenes (built-in, oracle)\n\nThe rows named after GS-W and FlashSplat are settings"
        ),
        "{text}"
    );
    assert!(text.contains("--only gs-w") && text.contains("--only flashsplat-one"), "what made it: {text}");
    assert!(!text.contains("--page") && text.contains("cores"), "{text}");
    let file = dir.path().join("results.json");
    // The same tables from the results alone, without measuring again.
    assert_eq!(works(&["bench", "tables", &show(&file), "--title", "Synthetic scenes"]), text);
    let results = json(&std::fs::read(file).expect("results"));
    let records = results["records"].as_array().expect("records");
    assert!(records.len() >= 2 && records.iter().all(|r| r["numbers"]["iou"].is_number()), "{results}");
    let by = |name: &str| records.iter().filter(|r| r["provider"] == name).count();
    assert!(by("oracle") >= 1 && by("built-in") == 2 * by("oracle"), "{results}");
}

#[test]
fn the_accelerators_speed_is_measured_or_its_absence_reported() {
    let dir = folder();
    let page = dir.path().join("engine.md");
    let shown = show(&page);
    let bench = |adapter| {
        let small =
            ["bench", "engine", "--splat-counts", "300", "--frame-sizes", "48x32", "--channel-counts", "20"];
        let goal = ["--db", "6", "--pixels", "48"];
        [&small[..], &goal, &["--page", shown.as_str(), "--adapter", adapter]].concat()
    };
    refuses(&bench("no such thing"), 2, &["accelerator"]);
    let Some(adapter) = segwild_gpu::adapters().into_iter().next() else {
        println!("skipped: no Vulkan, Metal or Direct3D 12 adapter (mesa-vulkan-drivers has one)");
        return;
    };
    works(&bench(&adapter.name));
    let text = std::fs::read_to_string(&page).expect("a page");
    assert!(text.contains(&adapter.name) && text.contains("GB/s"), "{text}");
    let (_, rows) = text.split_once("300 splats, 48 x 32, 20 channels").expect("its table");
    for pass in ["project, sort, bin", "sort", "shade", "blend", "gather", "backward", "adam"] {
        let row = rows.lines().find(|l| l.starts_with(&format!("| {pass} |"))).expect("its row");
        let ms = row.split('|').nth(2).and_then(|ms| ms.trim().parse::<f64>().ok());
        assert!(ms.is_some_and(|ms| ms > 0.0), "{row}");
    }
}

#[test]
fn photos_held_out_are_scored_whole_and_shown_beside_their_renders() {
    let dir = folder();
    let (out, page) = (show(&dir.path().join("out")), dir.path().join("page.md"));
    let (there, none, shown) = (show(scene()), show(&dir.path().join("none")), show(&page));
    let small = ["--sizes", "64", "--steps", "40", "--out", &out, "--page", &shown];
    let all: Vec<&str> = ["bench", "reconstruction", &there, &none].iter().chain(&small).copied().collect();
    let done = segwild(&all);
    let (stdout, stderr) = (text(&done.stdout), text(&done.stderr));
    assert!(done.status.success() && stdout.contains("64 px: held out "), "{stdout}{stderr}");
    assert!(stderr.contains("not measured: none at 64 px"), "{stderr}");
    let out = dir.path().join("out");
    let results = json(&std::fs::read(out.join("results.json")).expect("results"));
    let records = results["records"].as_array().expect("records");
    let whole = &records[0]["numbers"];
    for name in ["psnr", "ssim", "kept_psnr", "left_out", "train_psnr", "transient", "steps"] {
        assert!(whole[name].is_number(), "{name}: {whole}");
    }
    assert_eq!(whole["steps"], 40.0);
    assert!(records.iter().any(|r| r["target"] == "dome" && r["numbers"]["psnr"].is_number()), "{results}");
    let (with, without) = [out.join("reconstruction.md"), page].map(std::fs::read_to_string).into();
    let (with, without) = (with.expect("a page"), without.expect("a page"));
    let images: Vec<_> = std::fs::read_dir(&out)
        .expect("a folder")
        .flatten()
        .map(|e| e.file_name().to_string_lossy().into_owned())
        .filter(|name| name.ends_with(".png"))
        .collect();
    assert_eq!(images.len(), 1, "{images:?}");
    assert!(with.contains(&images[0]) && !without.contains(".png"), "{with}");
    assert!(without.contains("Provider: built-in.") && without.contains("Not measured: none"), "{without}");
    assert!(!out.join("runs").join("none").exists());
}
