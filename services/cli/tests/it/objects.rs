//! `segwild objects`: the list of a scene's objects, their names, and their files.

use crate::common::*;
use segwild_scene::ply;
use std::path::Path;

fn list(run: &Path, more: &[&str]) -> Vec<serde_json::Value> {
    let answer = json(works(&[&["objects", &show(run), "--json"][..], more].concat()).as_bytes());
    answer["objects"].as_array().expect("a list").clone()
}

#[test]
fn a_run_lists_its_objects_with_thumbnails() {
    let dir = folder();
    let run = copied_run(&dir);
    let text = std::fs::read_to_string(run.join("objects/objects.json")).expect("the run listed them");
    let objects = list(&run, &[]);
    let recorded: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
    assert_eq!(recorded["objects"].as_array(), Some(&objects), "the command lists what the run listed");
    assert!(!objects.is_empty());
    assert!(run.join("objects/sheet.png").is_file());
    let shown = works(&["objects", &show(&run)]);
    assert_eq!(shown.lines().count(), objects.len() + 2, "{shown}");
    assert!(shown.contains("sheet.png"), "{shown}");
    // A folder that can only be read is listed all the same.
    std::fs::remove_dir_all(run.join("objects")).expect("it goes");
    let text = show(&run);
    let read_only = ["objects", &text, "--json", "--fault", "read-only@file.write:1+"];
    let output = segwild(&read_only);
    let printed = crate::common::text(&output.stderr);
    assert!(output.status.success() && printed.contains("the list is not kept: cannot write"), "{printed}");
    assert_eq!(json(&output.stdout)["objects"].as_array(), Some(&objects));
    refuses(&[&read_only[..], &["--rename", "1=statue"]].concat(), 6, &["read-only"]);
}

#[test]
fn names_of_objects_are_kept_and_cannot_be_paths_or_anothers() {
    let dir = folder();
    let run = copied_run(&dir);
    let named = list(&run, &["--rename", "1=statue"]);
    assert_eq!(named[0]["name"], "statue");
    assert_eq!(list(&run, &[])[0]["name"], "statue", "kept");
    let text = show(&run);
    for (rename, why) in [
        ("1=../../etc", "cannot name"),
        ("1=a b", "cannot name"),
        ("1=2", "objects without names"),
        ("1=Object-7", "objects without names"),
        ("1=labels", "all labels"),
        ("99=x", "there is no object"),
        ("nobody=x", "there is no object"),
        ("statue", "N=NAME"),
    ] {
        refuses(&["objects", &text, "--rename", rename], 2, &[why]);
    }
    if named.len() > 1 {
        refuses(&["objects", &text, "--rename", "2=STATUE"], 2, &["named `statue` already"]);
    }
    assert_eq!(list(&run, &["--rename", "statue=pillar"])[0]["name"], "pillar");
    assert_eq!(list(&run, &["--rename", "pillar="])[0]["name"], "");
}

#[test]
fn objects_are_exported_for_other_tools_and_one_is_refined_by_the_photos() {
    let dir = folder();
    let run = copied_run(&dir);
    let (text, out) = (show(&run), dir.path().join("all"));
    let objects = list(&run, &["--rename", "1=statue", "--out", &show(&out)]);
    let scene = ply::read(&run.join("scene.ply")).expect("the scene is there");
    let labels =
        ply::read_extra(&out.join("labels.ply"), "object").expect("it is read").expect("it has them");
    assert_eq!(labels.len(), scene.len());
    let coco: serde_json::Value =
        serde_json::from_slice(&std::fs::read(out.join("coco.json")).expect("it is there")).expect("JSON");
    for (object, category) in objects.iter().zip(coco["categories"].as_array().expect("a list")) {
        let number = object["number"].as_u64().expect("a number");
        let splats = labels.iter().filter(|l| u64::from(**l) == number).count();
        assert_eq!(object["splats"].as_u64(), Some(splats as u64));
        let name = category["name"].as_str().expect("a name");
        assert_eq!(ply::read(&out.join(format!("{name}.ply"))).expect("it is there").len(), splats);
        let masks = coco["annotations"].as_array().expect("a list").iter();
        let masks = masks.filter(|a| a["category_id"] == object["number"]).count() as u64;
        assert!(masks >= object["photos"].as_u64().expect("a count"), "{object}");
    }
    assert_eq!(coco["categories"][0]["name"], "statue");
    refuses(&["objects", &text, "--out", &show(&out)], 2, &["is not empty"]);
    let night = dir.path().join("night");
    refuses(&["objects", &text, "--out", &show(&night), "--appearance", "nobody.jpg"], 2, &["no photo"]);
    assert!(!night.exists());
    let packed = dir.path().join("packed");
    works(&["objects", &text, "--out", &show(&packed), "--format", "spz"]);
    assert!(packed.join("statue.spz").is_file() && packed.join("labels.ply").is_file());
    // One object, refined: by its name and by its number.
    let select = |object: &str| {
        works(&["segment", &text, "--object", object, "--name", "one"]);
        std::fs::read(run.join("selections/one/object.ply")).expect("it is there")
    };
    let by_name = select("statue");
    assert!(by_name == select("1"));
    let prompts = show(&run.join("selections/one/prompts.json"));
    works(&["segment", &text, "--prompts", &prompts, "--name", "again"]);
    assert!(by_name == std::fs::read(run.join("selections/again/object.ply")).expect("it is there"));
    refuses(&["segment", &text, "--object", "99"], 2, &["there is no object", "segwild objects"]);
    // A list of another training names other things.
    let file = run.join("objects/objects.json");
    let other = std::fs::read_to_string(&file).expect("it is there").replace("objects:", "objects:0");
    std::fs::write(&file, other).expect("it is written");
    refuses(&["segment", &text, "--object", "1"], 2, &["trained again"]);
    // What is no list is made again, whatever names it holds.
    std::fs::write(&file, "{\"tree\": \"x\", \"objects\": [{\"number\": 7}]}").expect("it is written");
    refuses(&["segment", &text, "--object", "1"], 2, &["not listed yet"]);
    assert_eq!(list(&run, &[]).len(), objects.len());
    works(&["segment", &text, "--object", "1", "--name", "one"]);
}
