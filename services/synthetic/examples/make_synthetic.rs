//! Writes a synthetic wild set and contact sheets of it.
//!
//! `cargo run -p segwild-synthetic --example make_synthetic -- DIR [--small] [--seed N] [--train N] [--test N]
//! [--long-side PX] [--occlusion X] [--light none|affine|sun|camera|mixed] [--strength X] [--units X]`

use segwild_scene::Image;
use segwild_scene::settings::Value;
use segwild_synthetic::{LightVariation, SyntheticOptions, SyntheticScene, generate};
use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let dir = PathBuf::from(args.next().ok_or("name the folder to write")?);
    let mut options = SyntheticOptions::default();
    while let Some(flag) = args.next() {
        if flag == "--small" {
            options = SyntheticOptions { seed: options.seed, ..SyntheticOptions::small() };
            continue;
        }
        let value = args.next().ok_or_else(|| format!("{flag} needs a value"))?;
        match flag.as_str() {
            "--seed" => options.seed = value.parse()?,
            "--train" => options.train = value.parse()?,
            "--test" => options.test = value.parse()?,
            "--long-side" => options.long_side = value.parse()?,
            "--occlusion" => options.occlusion = value.parse()?,
            "--light" => options.photo_light = LightVariation::read(&value)?,
            "--strength" => options.appearance_strength = value.parse()?,
            "--units" => options.units = value.parse()?,
            other => return Err(format!("there is no flag {other}").into()),
        }
    }
    let start = std::time::Instant::now();
    let scene = generate(&options)?;
    println!("generated in {:.1} s", start.elapsed().as_secs_f32());
    let manifest = scene.write(&dir)?;
    for object in &manifest.objects {
        println!(
            "{:3} {:15} {:?}, clicks in {} photos",
            object.id,
            object.name,
            object.kind,
            object.clicks.len()
        );
    }
    sheets(&scene, &dir)
}

/// Photos, clean views and instances, side by side.
fn sheets(scene: &SyntheticScene, dir: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let cell = scene.options.long_side as usize;
    let columns = 5;
    let photos: Vec<&Image> = scene.photos.iter().map(|p| &p.photo).collect();
    let clean: Vec<&Image> = scene.photos.iter().map(|p| &p.clean).collect();
    let coloured: Vec<Image> = scene.photos.iter().map(|p| colours(&p.parts, p.photo.width)).collect();
    let ids: Vec<&Image> = coloured.iter().collect();
    for (name, images) in [("photos", photos), ("clean", clean), ("parts", ids)] {
        for (page, some) in images.chunks(20).enumerate() {
            let rows = some.len().div_ceil(columns);
            let mut sheet = Image::filled(cell * columns, cell * rows, 3, 0.12);
            for (i, image) in some.iter().enumerate() {
                let (left, top) = (
                    i % columns * cell + (cell - image.width) / 2,
                    i / columns * cell + (cell - image.height) / 2,
                );
                for c in 0..3 {
                    for y in 0..image.height {
                        let at = (c * sheet.height + top + y) * sheet.width + left;
                        let from = &image.plane(c)[y * image.width..][..image.width];
                        sheet.data[at..at + image.width].copy_from_slice(from);
                    }
                }
            }
            sheet.write_png(&dir.join(format!("sheet_{name}_{page}.png")))?;
        }
    }
    Ok(())
}

fn colours(ids: &[u16], width: usize) -> Image {
    let mut image = Image::zeros(width, ids.len() / width, 3);
    let n = image.pixels();
    for (i, &id) in ids.iter().enumerate() {
        for c in 0..3 {
            let wave = (f32::from(id) * [2.4, 3.7, 5.3][c]).sin() * 0.45 + 0.5;
            image.data[c * n + i] = if id == 0 { 0.0 } else { wave };
        }
    }
    image
}
