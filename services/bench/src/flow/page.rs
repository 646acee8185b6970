//! The rows as a page.

use super::row::Row;
use segwild_eval::record::Provenance;
use segwild_eval::stamp;

/// The rows that are over their bars, in words; nothing where all keep to them.
pub fn over(rows: &[Row]) -> Option<String> {
    let over: Vec<String> = rows
        .iter()
        .filter(|r| !r.holds())
        .map(|r| format!("{} is {:.3}, its bar {}", r.name, r.value, r.bar))
        .collect();
    (!over.is_empty())
        .then(|| format!("{} of {} rows over the bar: {}", over.len(), rows.len(), over.join("; ")))
}

/// The rows as a page; those that are over their bars are named first.
pub fn page(rows: &[Row], made: &Provenance) -> String {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let first = over(rows).map_or("All rows keep to their bars.".into(), |over| format!("**{over}.**"));
    let stamp =
        stamp::stamp(made, &["built-in, and one that waits in `overlap`, `accelerator` and `remote`"]);
    let mut text = format!(
        "# The dataflow, measured\n\n{first} This page is generated. {stamp}\n\nEvery number is a ratio \
         or a count. A ratio of times is the median over pairs of runs, each pair back to back; all of them are listed. \
         The load is the machine's average over a minute, on {cores} cores: what is over {cores} had to wait for a \
         core.\n\n| row | what | measured | bar | load | from |\n|---|---|---:|---:|---:|---|\n",
    );
    for r in rows {
        text += &format!(
            "| {} | {} | {:.3} | {} {} | {} | {} |\n",
            r.name,
            r.what,
            r.value,
            if r.holds() { "<=" } else { "**over**" },
            r.bar,
            r.load.map_or("unknown".into(), |load| format!("{load:.1}")),
            r.from
        );
    }
    text
}
