//! What SASM plans and the built-in provider answers, photo by photo, before any training: prompts come from the
//! scene's points. `cargo run -p segwild-masks --example plan -- SCENE [photos]`.

use segwild_masks::{MaskSettings, generate, sasm};
use segwild_scene::Scene;
use segwild_vision::{Builtin, SkyDetector};
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let scene =
        Scene::open(arguments.next().ok_or("a scene's folder is missing")?.as_ref(), &Default::default())?;
    let count = arguments.next().map_or(Ok(8), |n| n.parse())?;
    let (builtin, settings) = (Builtin::new(), MaskSettings::default());
    let depths = sasm::SceneDepths::of(&scene);
    let means: Vec<[f32; 3]> = scene.points.iter().map(|p| p.position.to_array()).collect();
    for view in scene.views.iter().take(count) {
        let photo = view.load(320)?;
        let sky = builtin.sky(&photo.image)?;
        let relative = depths.relative(sasm::scene_view_depth(&scene, view));
        let plan = sasm::plan(&means, &photo.camera, &view.pose, relative, Some(&sky), &settings)?;
        let start = Instant::now();
        let made = generate(&builtin, &photo.image, &plan.points, Some(&sky), &settings)?;
        let seconds = start.elapsed().as_secs_f32();
        let map = plan.map.map(|m| (m.segs, m.counts));
        println!("{}: depth {relative:.2}, {map:?}\n  {:?}, {seconds:.2} s", view.name, made.tally);
    }
    Ok(())
}
