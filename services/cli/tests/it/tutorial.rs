//! `docs/tutorial.md`, followed literally: every shell block is run in order, in one empty folder, and the figures that the page
//! prints are compared with those that the commands answer. Then the notebook, on the same run.

use crate::common::folder;
use crate::python::notebook_passes;
use std::path::Path;
use std::process::Command;

/// How far an IoU may be from what the page prints. The page rounds to two digits, and the same bytes come from the same machine
/// only: other instructions round otherwise, and a training makes more of that. A change of the method may move a single object by
/// a few hundredths without a reason to write the page again. What a reader learns from the figures (one click is good, another
/// is not, a box mends it) lies .3 apart.
const TOLERANCE: f64 = 0.05;

/// What the page asks of a reader, in its order.
#[derive(Debug, PartialEq)]
enum Step<'a> {
    /// Run this command of an `sh` block.
    Run(&'a str),
    /// Read this IoU in the text: the answer of the last command.
    Compare(f64),
}

/// The commands of the page's `sh` blocks and the figures between them, each with its line.
fn steps(page: &str) -> Vec<(usize, Step<'_>)> {
    let mut block = None;
    let mut found = Vec::new();
    for (i, line) in page.lines().enumerate() {
        match (line.trim().strip_prefix("```"), block) {
            (Some(_), Some(_)) => block = None,
            (Some(language), None) => block = Some(language),
            (None, Some("sh")) if !line.trim().is_empty() => found.push((i + 1, Step::Run(line.trim()))),
            (None, None) => {
                found.extend(line.split(' ').filter_map(figure).map(|iou| (i + 1, Step::Compare(iou))));
            }
            _ => {}
        }
    }
    found
}

/// A word such as `.81`, with what ends a sentence behind it.
fn figure(word: &str) -> Option<f64> {
    let digits = word.trim_end_matches(['.', ',', ';', ':']).strip_prefix('.')?;
    let number = !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
    number.then(|| format!("0.{digits}").parse().ok()).flatten()
}

/// The IoU of the line of means that `segwild eval` prints.
fn mean_iou(printed: &str) -> Option<f64> {
    let line = printed.lines().find(|line| line.trim_end().ends_with(" mean"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[test]
fn the_tutorial_works_when_it_is_followed_literally() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/tutorial.md");
    let page = std::fs::read_to_string(&file).expect("the tutorial");
    let steps = steps(&page);
    let count = |wanted: fn(&Step) -> bool| steps.iter().filter(|(_, step)| wanted(step)).count();
    assert!(count(|step| matches!(step, Step::Run(_))) >= 15, "{steps:?}");
    assert!(count(|step| matches!(step, Step::Compare(_))) >= 4, "{steps:?}");
    let dir = folder();
    let program = Path::new(env!("CARGO_BIN_EXE_segwild")).parent().expect("a folder");
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap_or_default());
    let mut answer = (String::new(), None);
    let mut wrong = Vec::new();
    for (line, step) in steps {
        match step {
            Step::Run(command) => {
                let mut shell = Command::new("sh");
                shell.args(["-ec", command]).current_dir(dir.path()).env("PATH", &path);
                let output = shell.output().expect("a shell");
                let stderr = String::from_utf8_lossy(&output.stderr);
                assert!(output.status.success(), "docs/tutorial.md:{line}: `{command}`: {stderr}");
                answer = (command.to_owned(), mean_iou(&String::from_utf8_lossy(&output.stdout)));
            }
            Step::Compare(iou) => {
                let (command, found) = &answer;
                let found =
                    found.unwrap_or_else(|| panic!("docs/tutorial.md:{line}: `{command}` has no IoU"));
                if (found - iou).abs() > TOLERANCE {
                    wrong.push(format!("docs/tutorial.md:{line}: {iou}, and `{command}` answers {found}"));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    for file in ["pavilion.ply", "pavilion-dusk.ply", "scene.ply", "runs/tutorial/report.html"] {
        assert!(dir.path().join(file).is_file(), "{file}");
    }
    // The notebook trains the same photos with the same settings: it takes over the run, and need not wait for another one.
    let (run, notebook) = (dir.path().join("runs/tutorial"), dir.path().join("labelled-cloud"));
    std::fs::remove_dir_all(run.join("selections")).expect("the tutorial's selections");
    std::fs::create_dir(&notebook).expect("a folder");
    std::fs::rename(run, notebook.join("run")).expect("the tutorial's run");
    notebook_passes(dir.path());
}

#[test]
fn commands_and_figures_of_a_page_are_found_in_its_order() {
    let page = "# A page\n\n```sh\nsegwild eval a\n```\n\nIt is .45, not a `.ply`.\n\n```text\nno .99\n```\nNow it is .8.\n";
    let found: Vec<Step> = steps(page).into_iter().map(|(_, step)| step).collect();
    assert_eq!(found, [Step::Run("segwild eval a"), Step::Compare(0.45), Step::Compare(0.8)]);
    assert_eq!(
        mean_iou("    IoU     acc  photo\n  0.812   0.990  a.png\n  0.790   0.980   0.7   0.8  mean\n"),
        Some(0.79)
    );
}
