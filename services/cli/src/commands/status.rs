//! `segwild status`

use super::{path, print_json, print_line};
use crate::failure::Failure;
use crate::progress::duration;
use clap::ArgMatches;
use segwild_flow::Ledger;
use segwild_pipeline::RunFolder;

/// Says what a run has done and is doing, also while another process runs it.
pub fn status(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path(matches, "run").expect("clap requires it"))?;
    let ledger = Ledger::open_read_only(folder.ledger())?;
    let owner = ledger.owner();
    let stages = ledger.stages()?;
    if matches.get_flag("json") {
        return print_json(&serde_json::json!({
            "running": owner.is_some(),
            "owner": owner.map(|o| o.to_string()),
            "stages": stages,
            "selections": folder.selections(),
        }));
    }
    match &owner {
        Some(owner) => print_line(&format!("in use by {owner}"))?,
        None => print_line("no process is working on this run")?,
    }
    for stage in &stages {
        let state = serde_json::to_value(stage.state).unwrap_or_default();
        let time = stage
            .started
            .zip(stage.ended)
            .map_or(String::new(), |(a, b)| format!("in {}", duration((b - a).max(0.0))));
        let views = ledger.views(&stage.name)?;
        let failed = views.iter().filter(|v| v.outcome.error.is_some()).count();
        let photos = match (views.len(), failed) {
            (0, _) => String::new(),
            (n, 0) => format!(", {n} photos"),
            (n, f) => format!(", {n} photos, {f} failed"),
        };
        print_line(&format!("{:>9}  {:8} {time}{photos}", stage.name, state.as_str().unwrap_or_default()))?;
        if let Some(error) = &stage.error {
            print_line(&format!("{:>9}  {error}", ""))?;
        }
        for view in views.iter().filter(|v| v.outcome.error.is_some()) {
            print_line(&format!(
                "{:>9}  {}: {}",
                "",
                view.view,
                view.outcome.error.as_deref().unwrap_or_default()
            ))?;
        }
    }
    for name in folder.selections() {
        print_line(&format!("selection  {name}"))?;
    }
    Ok(())
}
