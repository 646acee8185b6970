//! The selections in the report: a section for each, which can be added without making the others again.

use super::{html, pass, spread, write_report};
use crate::artifacts::folder::Loaded;
use crate::output::render::{Mode, RenderContent, SceneRenderer};
use crate::{ObjectList, RunError, RunFolder, Selected, choose_engine, log_loss};
use segwild_flow::{FileError, files};
use segwild_raster::Rasterizer;
use segwild_scene::Image;
use std::collections::BTreeMap;

const END_OF_OBJECTS: &str = "<!-- end of objects -->";
const START_OF_OBJECT: &str = "<!-- object ";
const AFTER_NAME: &str = " -->";

/// The list of the scene's objects; nothing where the run has none.
pub(super) fn list(folder: &RunFolder) -> String {
    let Some(list) = ObjectList::read(folder).filter(|list| !list.objects.is_empty()) else {
        return String::new();
    };
    // A sheet that cannot be read is left out; the table stands for it.
    let sheet = Image::read(&ObjectList::sheet(folder));
    let sheet = sheet.map_or_else(|_| String::new(), |sheet| html::figure(&sheet, "each by its number"));
    let head = ["number", "name", "splats", "light (%)", "photos", "shown best by"];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(list.objects.iter().map(|o| {
        vec![
            o.number.to_string(),
            o.name.clone(),
            o.splats.to_string(),
            format!("{:.1}", 100.0 * o.light),
            o.photos.to_string(),
            o.photo.clone(),
        ]
    }));
    format!(
        "<h2>Objects found without a click</h2><p><code>segwild segment RUN --object N</code> makes a selection of one.</p>\
         {sheet}<details><summary>{} objects</summary>{}</details>",
        list.objects.len(),
        html::table(&rows)
    )
}

/// All selections, each from a few of the photos it shows on.
pub(super) fn all(folder: &RunFolder, loaded: &Loaded, engine: &dyn Rasterizer) -> Result<String, RunError> {
    let mut text = start_of_objects(folder)?;
    for name in folder.selections() {
        text.push_str(&object(folder, loaded, &name, engine)?);
    }
    text.push_str(END_OF_OBJECTS);
    Ok(text)
}

/// The comment before the selections in the report. It holds the hash of what they were made from.
fn start_of_objects(folder: &RunFolder) -> Result<String, RunError> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(env!("CARGO_PKG_VERSION").as_bytes());
    for name in ["segwild.toml", "model.bin", "features.bin"] {
        let path = folder.path().join(name);
        let bytes = match files::read_plain(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::new("read", &path, error).into());
            }
            read => read.unwrap_or_default(),
        };
        hasher.update(&(bytes.len() as u64).to_le_bytes()).update(&bytes);
    }
    Ok(format!("<!-- objects of {} -->", hasher.finalize()))
}

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

/// A selection from a few of the photos it shows on; nothing if it cannot be read.
fn object(
    folder: &RunFolder,
    loaded: &Loaded,
    name: &str,
    engine: &dyn Rasterizer,
) -> Result<String, RunError> {
    let Ok(selected) = Selected::read(folder, name, loaded.model.splats.len()) else {
        return Ok(String::new());
    };
    let count = selected.labels.iter().filter(|&&l| l).count();
    let mut text = format!(
        "{START_OF_OBJECT}{0}{AFTER_NAME}<h2>Object: {0}</h2><p>{count} splats{1}. <code>selections/{0}/object.ply</code>, \
         masks beside it.</p><div class=\"row\">",
        html::escape(name),
        folder
            .provider_of(name)
            .map_or_else(String::new, |by| format!(", by the masks of {}", html::escape(&by)))
    );
    let highlight =
        SceneRenderer::new(loaded, Some((selected.clone(), Mode::Highlight)), RenderContent::Colour, engine)?;
    let only = SceneRenderer::new(loaded, Some((selected, Mode::Only)), RenderContent::Colour, engine)?;
    for view in spread(loaded, 4) {
        let v = &loaded.scene.views[view];
        let camera = v.camera.scaled_to(loaded.settings.scene.size.min(super::SHOWN));
        let mut show = |renderer: &SceneRenderer, caption: &str| -> Result<(), RunError> {
            let image = renderer.render(engine, &camera, &v.pose, &renderer.light(Some(view)))?;
            text.push_str(&html::figure(&image, caption));
            Ok(())
        };
        show(&highlight, &v.name)?;
        show(&only, "alone")?;
        pass(folder)?;
    }
    text.push_str("</div>");
    Ok(text)
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
