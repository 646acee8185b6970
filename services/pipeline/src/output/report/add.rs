//! Adds a selection to the report without making the others again.

use super::objects::{AFTER_NAME, END_OF_OBJECTS, START_OF_OBJECT, object, start_of_objects};
use super::page::write_report;
use crate::engine::{choose_engine, log_loss};
use crate::{RunError, RunFolder};
use segwild_flow::files;
use std::collections::BTreeMap;

/// Adds a selection to the report. A report of another scene is written again as a whole.
pub(crate) fn add_object(folder: &RunFolder, name: &str) -> Result<(), RunError> {
    let known = files::read_plain(&folder.report()).unwrap_or_default();
    let known = String::from_utf8(known).unwrap_or_default();
    let start = start_of_objects(folder)?;
    if !known.contains(&start) {
        return write_report(folder).map(drop);
    }
    let loaded = folder.load()?;
    let engine = choose_engine(&loaded.settings.run, log_loss)?.engine;
    let section = object(folder, &loaded, name, &*engine)?;
    match with_object(&known, &start, &folder.selections(), name, &section) {
        Some(report) => Ok(folder.write("report.html", report.as_bytes())?),
        None => write_report(folder).map(drop),
    }
}

/// A report with a section for the selection of this name among those of the others that there are; `None` if it cannot
/// be taken apart.
fn with_object(report: &str, start: &str, names: &[String], name: &str, section: &str) -> Option<String> {
    let (before, rest) = report.split_once(start)?;
    let (objects, after) = rest.split_once(END_OF_OBJECTS)?;
    let mut sections = BTreeMap::new();
    // The text before the first section is empty.
    for part in objects.split(START_OF_OBJECT).filter(|part| !part.is_empty()) {
        sections.insert(part.split_once(AFTER_NAME)?.0, part);
    }
    sections.insert(name, section.strip_prefix(START_OF_OBJECT)?);
    let kept = names.iter().filter_map(|name| sections.get(name.as_str()));
    let objects: String = kept.flat_map(|part| [START_OF_OBJECT, part]).collect();
    Some([before, start, &objects, END_OF_OBJECTS, after].concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_selection_is_added_in_order_among_the_others() {
        let section = |name: &str, what: &str| format!("{START_OF_OBJECT}{name}{AFTER_NAME}<h2>{what}</h2>");
        let report = |sections: &[String]| {
            format!("<p>before</p><!-- objects of 7 -->{}{END_OF_OBJECTS}<p>after</p>", sections.concat())
        };
        let add = |report: &str, names: &[&str], section: &str| {
            let names: Vec<String> = names.iter().map(ToString::to_string).collect();
            with_object(report, "<!-- objects of 7 -->", &names, "b", section)
        };
        let (a, b, c) = (section("a", "first"), section("b", "new"), section("c", "last"));
        let all = report(&[a.clone(), b.clone(), c.clone()]);
        assert_eq!(add(&report(&[]), &["b"], &b).unwrap(), report(std::slice::from_ref(&b)));
        assert_eq!(add(&report(&[a.clone(), c.clone()]), &["a", "b", "c"], &b).unwrap(), all);
        assert_eq!(add(&report(&[a, section("b", "old"), c.clone()]), &["a", "b", "c"], &b).unwrap(), all);
        // A selection that has been removed since is dropped.
        assert_eq!(add(&all, &["b", "c"], &b).unwrap(), report(&[b.clone(), c]));
        // A report of another scene, and a selection that cannot be shown.
        assert!(add("<!-- objects of 8 --><!-- end of objects -->", &["b"], &b).is_none());
        assert!(add("<!-- objects of 7 -->", &["b"], &b).is_none() && add(&all, &["b"], "").is_none());
    }
}
