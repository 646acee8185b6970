//! The OpenAPI document: its messages are those that the server reads and writes, field by field.

use crate::common::{answered, click, keep, open, run, trained};
use segwild_farm::{EmbeddedEngine, FarmLogState, Job, JobEngine, Needs, WorkerOffer};
use segwild_monitor::view::FarmTarget;
use segwild_monitor::{MonitorTarget, MonitorView};
use segwild_studio::messages::{
    FrameRequest, HoverRequest, PickRequest, RunEntry, SavingMessage, StudioAction, TrainingMessage,
    ViewMessage,
};
use segwild_studio::openapi;
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The schema itself, or the one that it refers to.
fn resolved<'a>(page: &'a Value, schema: &'a Value) -> &'a Value {
    match schema["$ref"].as_str() {
        Some(name) => &page["components"]["schemas"][name.rsplit('/').next().unwrap()],
        None => schema,
    }
}

/// Fields of an object, and those that are required; of all parts of one that is put together.
fn fields<'a>(page: &'a Value, schema: &'a Value) -> (BTreeMap<&'a str, &'a Value>, BTreeSet<&'a str>) {
    let schema = resolved(page, schema);
    let properties = schema["properties"].as_object().into_iter().flatten();
    let mut named: BTreeMap<&str, &Value> = properties.map(|(name, field)| (name.as_str(), field)).collect();
    let required = schema["required"].as_array().into_iter().flatten();
    let mut required: BTreeSet<&str> = required.filter_map(Value::as_str).collect();
    for part in schema["allOf"].as_array().into_iter().flatten() {
        let (more, needed) = fields(page, part);
        named.extend(more);
        required.extend(needed);
    }
    (named, required)
}

fn object_fits(page: &Value, schema: &Value, value: &Value) -> Result<(), String> {
    let object = value.as_object().ok_or(format!("{value} is no object"))?;
    if let Some(all) = schema.get("additionalProperties") {
        return object.values().try_for_each(|value| fits(page, all, value));
    }
    let (named, required) = fields(page, schema);
    if let Some(missing) = required.iter().find(|name| !object.contains_key(**name)) {
        return Err(format!("`{missing}` is missing"));
    }
    object.iter().try_for_each(|(name, value)| match named.get(name.as_str()) {
        Some(field) => fits(page, field, value).map_err(|why| format!("{name}: {why}")),
        None => Err(format!("`{name}` is not described")),
    })
}

/// Whether a value is one of a schema. Fields that the schema does not name are refused.
fn fits(page: &Value, schema: &Value, value: &Value) -> Result<(), String> {
    let schema = resolved(page, schema);
    let cases = schema["oneOf"].as_array().or(schema["anyOf"].as_array());
    if let Some(cases) = cases {
        let flaws: Vec<String> = cases.iter().filter_map(|case| fits(page, case, value).err()).collect();
        return if flaws.len() < cases.len() { Ok(()) } else { Err(flaws.join("; ")) };
    }
    if let Some(word) = schema.get("const") {
        return if word == value { Ok(()) } else { Err(format!("{value} is not {word}")) };
    }
    if schema.get("allOf").is_some() {
        return object_fits(page, schema, value);
    }
    let of_kind = match schema["type"].as_str() {
        Some("object") => return object_fits(page, schema, value),
        Some("array") => {
            let all = value.as_array().ok_or(format!("{value} is no array"))?;
            let count = all.len() as u64;
            if schema["minItems"].as_u64().is_some_and(|least| count < least)
                || schema["maxItems"].as_u64().is_some_and(|most| count > most)
            {
                return Err(format!("{count} items"));
            }
            return all.iter().try_for_each(|item| fits(page, &schema["items"], item));
        }
        Some("number") => value.is_number(),
        Some("integer") if schema.get("minimum").is_some() => value.is_u64(),
        Some("integer") => value.is_i64(),
        Some("boolean") => value.is_boolean(),
        Some("null") => value.is_null(),
        Some("string") => match schema["enum"].as_array() {
            Some(words) => words.contains(value),
            None => value.is_string(),
        },
        other => return Err(format!("a schema of type {other:?}")),
    };
    if of_kind { Ok(()) } else { Err(format!("{value} is no {}", schema["type"])) }
}

/// Checks a message against its schema.
fn check(page: &Value, name: &str, message: &impl Serialize) {
    let value = serde_json::to_value(message).unwrap();
    let schema = &page["components"]["schemas"][name];
    assert!(schema.is_object(), "{name} is not described");
    if let Err(why) = fits(page, schema, &value) {
        panic!("{name}: {why}\n{value:#}");
    }
}

#[test]
fn what_is_answered_is_what_the_document_describes() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let page = openapi();
    check(&page, "RunEntry", &RunEntry { name: "a".into(), state: "trained", reason: None });
    check(&page, "RunEntry", &RunEntry { name: "a".into(), state: "failed", reason: Some("b".into()) });
    check(&page, "RunDescription", &studio.describe());
    check(&page, "StateMessage", &studio.message());
    keep(&studio, 0, "first").unwrap();
    studio.act(StudioAction::Appearance { id: Some(1), photo: Some(3), towards: None, share: 0.0 }).unwrap();
    studio.act(click(&studio, 1)).unwrap();
    let state = answered(&studio);
    assert!(state.answer.step.is_some() && state.objects[0].appearance.is_some(), "nothing is left open");
    check(&page, "StateMessage", &state);
    check(&page, "SavingMessage", &SavingMessage { object: 1, done: 2, photos: 3 });
    check(&page, "LabelMap", &studio.labels(0).unwrap());
    let (photo, [x, y]) = trained().clicks[0].clone();
    let photo = studio.session().scene().view_named(&photo).unwrap();
    let candidate = studio.hover(&HoverRequest { photo, x, y, ..HoverRequest::default() }).unwrap();
    check(&page, "LabelMap", &candidate.expect("a candidate"));
    let seen = &studio.describe().photos[photo];
    let view = ViewMessage { camera: seen.camera, rotation: seen.rotation, translation: seen.translation };
    let picked = studio.pick(&PickRequest { view, at: [x, y] }).unwrap();
    check(&page, "PickedPixel", &picked.expect("a splat"));
    let history = folder.moments();
    assert!(!history.is_empty());
    check(
        &page,
        "TrainingMessage",
        &TrainingMessage { photos: vec!["a".into()], history, snapshot: Some(3) },
    );
    check(&page, "MonitorView", &MonitorTarget::at(folder.path()).unwrap().view().unwrap());
}

#[test]
fn a_farm_is_answered_as_the_document_describes_it() {
    let dir = tempfile::tempdir().unwrap();
    let engine = Arc::new(EmbeddedEngine::open(dir.path().join("jobs.sqlite")).unwrap());
    let farm = FarmTarget::new("farm", engine.clone());
    for name in ["b/done", "b/held", "b/waits"] {
        engine.publish(&Job::new(name, "{}", Needs { cores: 1, ..Needs::default() })).unwrap();
    }
    let offer = WorkerOffer::all("w", Needs { cores: 1, ..Needs::default() }, 60.0);
    engine.announce(&WorkerOffer { accelerator: Some("h100".into()), ..offer.clone() }).unwrap();
    engine.complete(&engine.claim(&offer).unwrap().unwrap(), "done").unwrap();
    engine.claim(&offer).unwrap().unwrap();
    let mut view = farm.view().unwrap();
    let own = view.farm.as_mut().unwrap();
    assert!(own.workers[0].whole.is_some() && own.left_s.is_some() && !own.past.is_empty());
    own.log = Some(FarmLogState::default());
    let page = openapi();
    check(&page, "BatchView", &view);
    check(&page, "MonitorView", &MonitorView::Batch(Box::new(view)));
}

#[test]
fn what_is_requested_is_what_the_document_describes() {
    let page = openapi();
    let view = json!({
        "camera": { "width": 8, "height": 6, "fx": 9.0, "fy": 9.0, "cx": 4.0, "cy": 3.0 },
        "rotation": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "translation": [0.0, 0.5, 2.0],
    });
    let point = json!({ "x": 1.5, "y": 2.0, "inside": true });
    let corners = json!({ "x0": 0.0, "y0": 1.0, "x1": 5.0, "y1": 4.0 });
    let prompts = json!([{ "photo": 0, "points": [point], "boxes": [corners], "granularity": null }]);
    let region = |shape: Value, rule: &str| json!({ "do": "region", "id": null, "view": view, "region": shape, "how": "add", "rule": rule });
    let polygon = json!({ "shape": "polygon", "points": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]] });
    let actions = [
        json!({ "do": "prompt", "prompts": prompts, "alternative": 1 }),
        json!({ "do": "listed", "number": 2 }),
        json!({ "do": "text", "text": "the dome", "alternative": 1 }),
        json!({ "do": "refine", "id": 1 }),
        json!({ "do": "keep", "name": null }),
        json!({ "do": "keep", "name": "statue" }),
        json!({ "do": "rename", "id": 1, "name": "statue" }),
        json!({ "do": "show", "id": 1, "visible": false }),
        json!({ "do": "lock", "id": 1, "locked": true }),
        json!({ "do": "isolate", "id": null }),
        json!({ "do": "colour", "id": 1, "colour": 3 }),
        json!({ "do": "delete", "id": 1 }),
        json!({ "do": "duplicate", "id": 1 }),
        json!({ "do": "combine", "id": 1, "with": 2, "how": "intersect" }),
        json!({ "do": "grow", "id": 1, "steps": -2 }),
        region(polygon.clone(), "centre"),
        region(json!({ "shape": "brush", "points": [[0.0, 0.0]], "radius": 2.0 }), "visible"),
        region(json!({ "shape": "sphere", "at": [0.0, 0.0], "radius": 2.0 }), "footprint"),
        json!({ "do": "appearance", "id": null, "photo": 1, "towards": null, "share": 0.5 }),
        json!({ "do": "transients", "photo": 0, "region": polygon, "how": "subtract" }),
        json!({ "do": "cut_spikes", "cut": true }),
        json!({ "do": "stop_save", "id": 1 }),
        json!({ "do": "undo" }),
        json!({ "do": "redo" }),
    ];
    let mut done = BTreeSet::new();
    for action in &actions {
        let read: Result<StudioAction, _> = serde_json::from_value(action.clone());
        assert!(read.is_ok(), "{action}: {read:?}");
        check(&page, "ActRequest", action);
        done.insert(action["do"].as_str().unwrap());
    }
    let cases = page["components"]["schemas"]["ActRequest"]["oneOf"].as_array().unwrap();
    let cases: BTreeSet<&str> =
        cases.iter().map(|case| fields(&page, case).0["do"]["const"].as_str().unwrap()).collect();
    assert_eq!(cases, done, "all that can be done is checked");

    let mut frame = view.clone();
    frame["marks"] = true.into();
    frame["background"] = false.into();
    frame["appearance"] = Value::Null;
    assert!(serde_json::from_value::<FrameRequest>(frame.clone()).is_ok());
    check(&page, "FrameRequest", &frame);
    let mut pick = view.clone();
    pick["at"] = json!([1.0, 2.0]);
    assert!(serde_json::from_value::<PickRequest>(pick.clone()).is_ok());
    check(&page, "PickRequest", &pick);
    let hover = json!({ "photo": 0, "x": 1.0, "y": 2.0, "granularity": 0.5, "view": view });
    assert!(serde_json::from_value::<HoverRequest>(hover.clone()).is_ok());
    check(&page, "HoverRequest", &hover);
}

#[test]
fn a_field_of_another_name_or_kind_is_noticed() {
    let page = openapi();
    let flaw = |name: &str, value: Value| fits(&page, &page["components"]["schemas"][name], &value).is_err();
    assert!(!flaw("RunEntry", json!({ "name": "a", "state": "open" })));
    assert!(flaw("RunEntry", json!({ "name": "a", "status": "open" })));
    assert!(flaw("RunEntry", json!({ "name": "a" })));
    assert!(flaw("RunEntry", json!({ "name": 1, "state": "open" })));
    assert!(flaw("ActRequest", json!({ "do": "rename", "id": 1, "title": "a" })));
    assert!(flaw("ActRequest", json!({ "do": "combine", "id": 1, "with": 2, "how": "join" })));
    assert!(flaw("AnswerStep", json!({ "photos": -1 })) && !flaw("AnswerStep", json!("tree")));
}
