//! The list of objects and the selections in the report: a section for each selection.

use super::html;
use super::shown::{SHOWN, pass, spread};
use crate::artifacts::folder::Loaded;
use crate::output::render::{Mode, RenderContent, SceneRenderer};
use crate::{ObjectList, RunError, RunFolder, Selected};
use segwild_flow::{FileError, codec};
use segwild_raster::Rasterizer;
use segwild_scene::Image;
use segwild_segmenter::{SelectionConfidence, ShownSide, counted};
use std::io::{ErrorKind, Read};

/// The comment after the last selection.
pub(super) const END_OF_OBJECTS: &str = "<!-- end of objects -->";
/// The start of the comment before a selection; its name follows.
pub(super) const START_OF_OBJECT: &str = "<!-- object ";
/// The end of that comment.
pub(super) const AFTER_NAME: &str = " -->";

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
    let seen_once = list.seen_once.as_ref().map_or_else(String::new, |once| {
        format!(
            "<p>{:.1} % of the splats are seen once, by one photo alone: they are rendered, and left out of objects that other photos \
             show as well.</p>",
            100.0 * once.splats
        )
    });
    format!(
        "<h2>Objects found without a click</h2><p><code>segwild segment RUN --object N</code> makes a selection of one.</p>\
         {seen_once}{sheet}<details><summary>{} objects</summary>{}</details>",
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
pub(super) fn start_of_objects(folder: &RunFolder) -> Result<String, RunError> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(env!("CARGO_PKG_VERSION").as_bytes());
    for name in ["segwild.toml", "model.bin", "features.bin"] {
        let path = folder.path().join(name);
        let failed = |error| FileError::new("read", &path, error);
        match codec::open_file(&path) {
            Ok((file, bytes)) => {
                hasher.update(&bytes.to_le_bytes());
                hasher.update_reader(file.take(bytes)).map_err(failed)?;
            }
            Err(error) if error.kind() == ErrorKind::NotFound => {
                hasher.update(&0u64.to_le_bytes());
            }
            Err(error) => return Err(failed(error).into()),
        }
    }
    Ok(format!("<!-- objects of {} -->", hasher.finalize()))
}

/// A selection from a few of the photos it shows on; nothing if it cannot be read.
pub(super) fn object(
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
         masks beside it.</p>{2}<div class=\"row\">",
        html::escape(name),
        folder
            .provider_of(name)
            .map_or_else(String::new, |by| format!(", by the masks of {}", html::escape(&by))),
        folder.confidence_of(name).map_or_else(String::new, |confidence| sure(&confidence))
    );
    let highlight =
        SceneRenderer::new(loaded, Some((selected.clone(), Mode::Highlight)), RenderContent::Colour, engine)?;
    let only = SceneRenderer::new(loaded, Some((selected, Mode::Only)), RenderContent::Colour, engine)?;
    for view in spread(loaded, 4) {
        let v = &loaded.scene.views[view];
        let camera = v.camera.scaled_to(loaded.settings.scene.size.min(SHOWN));
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

/// How sure a selection is, in words, with a row for each photo.
fn sure(confidence: &SelectionConfidence) -> String {
    let sentences: Vec<String> = confidence
        .sentences()
        .into_iter()
        .map(|words| {
            // A sentence starts with a capital letter; its first letter is one of ours.
            let (first, rest) = words.split_at(words.len().min(1));
            format!("{}{}.", first.to_uppercase(), html::escape(rest))
        })
        .collect();
    let head = ["photo", "side", "agreement", "of the photo (%)", ""];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(confidence.photos.iter().map(|photo| {
        let side = match photo.side {
            ShownSide::Prompted => "prompted",
            ShownSide::Far => "other",
        };
        let note = match (photo.prompted, photo.disagrees) {
            (true, _) => "prompted",
            (false, true) => "disagrees",
            (false, false) => "",
        };
        vec![
            photo.photo.clone(),
            side.into(),
            format!("{:.2}", photo.agreement),
            format!("{:.1}", 100.0 * photo.shown),
            note.into(),
        ]
    }));
    format!(
        "<p>{}</p><details><summary>{} compared</summary>{}</details>",
        sentences.join(" "),
        counted(confidence.photos.len()),
        html::table(&rows)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_segmenter::{Lopsided, PhotoAgreement, SideAgreement};

    #[test]
    fn how_sure_a_selection_is_survives_its_summary_and_stands_in_the_report() {
        let photo = |name: &str, side: ShownSide, agreement: f32| PhotoAgreement {
            photo: name.into(),
            prompted: side == ShownSide::Prompted,
            side,
            agreement,
            shown: 0.123,
            disagrees: agreement < 0.6,
        };
        let confidence = SelectionConfidence {
            value: 0.47,
            agreement: Some(0.6),
            worst_side_agreement: Some(0.3),
            levels_agreement: None,
            prompted_side: SideAgreement { photos: 1, agreement: Some(0.9) },
            far_side: SideAgreement { photos: 2, agreement: Some(0.3) },
            lopsided: Some(Lopsided::Disagrees),
            next_click: Some("b<.jpg".into()),
            photos: vec![
                photo("a.jpg", ShownSide::Prompted, 0.9),
                photo("b<.jpg", ShownSide::Far, 0.2),
                photo("c.jpg", ShownSide::Far, 0.4),
            ],
        };
        let dir = tempfile::tempdir().expect("a folder");
        let folder = RunFolder::create(dir.path()).expect("a run");
        let selection = folder.selection("statue");
        std::fs::create_dir_all(&selection).expect("a folder");
        assert_eq!(folder.confidence_of("statue"), None, "there is no summary");
        let write = |summary: serde_json::Value| {
            std::fs::write(selection.join("summary.json"), summary.to_string()).expect("it is written");
        };
        write(serde_json::json!({ "provider": "built-in" }));
        assert_eq!(folder.confidence_of("statue"), None, "a summary of an earlier version");
        write(serde_json::json!({ "confidence": confidence }));
        assert_eq!(folder.confidence_of("statue").as_ref(), Some(&confidence));
        let shown = sure(&confidence);
        assert!(
            shown.starts_with("<p>Confidence 0.47: agreement 0.90 in 1 photo of the prompted side"),
            "{shown}"
        );
        assert!(shown.contains("lopsided") && shown.contains("help most in b&lt;.jpg."), "{shown}");
        assert!(shown.contains("<td>c.jpg</td><td>other</td><td>0.40</td><td>12.3</td><td>disagrees</td>"));
    }
}
