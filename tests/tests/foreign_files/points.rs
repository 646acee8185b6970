//! Points: colours, units, outliers; photos that stand far off.

use crate::FileCase;
use crate::base::{Files, PHOTOS, SIZE};
use crate::{Expect::Holds, Expect::Reads, Expect::Refuses};
use segwild_scene::colmap::{ImageRecord, Keypoint};
use segwild_scene::{NEAR, Point, Scene};

pub const ROWS: &[FileCase] = &[
    FileCase {
        name: "all points black (RGB 0)",
        make: |files| files.remodel(|m| m.points.iter_mut().for_each(|p| p.colour = [0; 3])),
        settings: &[],
        expect: Reads {
            photos: 12,
            words: &["60 of 60 points have no colour of their own (they are RGB 0 0 0)"],
        },
    },
    FileCase {
        name: "all points white",
        make: |files| files.remodel(|m| m.points.iter_mut().for_each(|p| p.colour = [255; 3])),
        settings: &[],
        expect: Reads { photos: 12, words: &["no colour of their own (they are RGB 255 255 255)"] },
    },
    FileCase {
        name: "a third of the points black, as a merged model has them",
        make: |files| {
            files.remodel(|m| {
                for (i, p) in m.points.iter_mut().enumerate() {
                    p.colour = if i % 3 == 0 { [0; 3] } else { [50 + i as u8; 3] };
                }
            });
        },
        settings: &[],
        expect: Reads { photos: 12, words: &["20 of 60 points have no colour of their own"] },
    },
    FileCase {
        name: "a saturated colour: one channel is 0",
        make: |files| {
            files.remodel(|m| {
                m.points.iter_mut().enumerate().for_each(|(i, p)| p.colour = [0, 100 + i as u8, 255]);
            });
        },
        settings: &[],
        expect: Holds {
            photos: 12,
            check: |scene| scene.points.iter().for_each(|p| assert!(p.colour[0] > 0.0)),
        },
    },
    FileCase {
        name: "ply cloud, float colours 0 to 1",
        make: |files| cloud(files, "ascii", "float", ["red", "green", "blue"], &|c| c / 255.0),
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "ply cloud, double colours 0 to 255",
        make: |files| cloud(files, "ascii", "double", ["red", "green", "blue"], &|c| c),
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "ply cloud, 16-bit colours",
        make: |files| cloud(files, "ascii", "ushort", ["red", "green", "blue"], &|c| c * 257.0),
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "ply cloud, big-endian, diffuse_red",
        make: |files| {
            let names = ["diffuse_red", "diffuse_green", "diffuse_blue"];
            cloud(files, "binary_big_endian", "uchar", names, &|c| c);
        },
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "a ply of splats as the point cloud",
        make: |files| {
            let harmonic = |c: f64| (c / 255.0 - 0.5) / 0.282_094_79;
            cloud(files, "binary_little_endian", "float", ["f_dc_0", "f_dc_1", "f_dc_2"], &harmonic);
        },
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "ply cloud without colours",
        make: |files| cloud(files, "ascii", "float", ["nx", "ny", "nz"], &|_| 0.0),
        settings: &[],
        expect: Reads {
            photos: 12,
            words: &["60 of 60 points have no colour of their own (they are RGB 128 128 128)"],
        },
    },
    FileCase {
        name: "ply cloud, a list element before the vertices, binary",
        make: |files| {
            let (head, body) = ply("binary_little_endian", "uchar", ["red", "green", "blue"], &|c| c);
            let faces = [&[3u8][..], &[0; 12], &[4], &[0; 16]].concat();
            let head = head.replace("element vertex", &format!("{FACES}element vertex"));
            finish(files, &[head.into_bytes(), faces, body].concat());
        },
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "ply cloud, a list element before the vertices, ascii",
        make: |files| {
            let (head, body) = ply("ascii", "uchar", ["red", "green", "blue"], &|c| c);
            let head = head.replace("element vertex", &format!("{FACES}element vertex"));
            finish(files, &[head.into_bytes(), b"3 0 1 2\n4 0 1 2 3\n".to_vec(), body].concat());
        },
        settings: &[],
        expect: Holds { photos: 12, check: coloured },
    },
    FileCase {
        name: "ply cloud that ends within an element before the vertices",
        make: |files| {
            let (head, _) = ply("binary_little_endian", "uchar", ["red", "green", "blue"], &|c| c);
            let faces = FACES.replace('2', "18446744073709551615");
            let head = head.replace("element vertex 60", &format!("{faces}element vertex 0"));
            finish(files, head.as_bytes());
        },
        settings: &[],
        expect: Refuses(&["cloud.ply", "ends within its 18446744073709551615 `face`"]),
    },
    FileCase {
        name: "a compressed ply as the point cloud",
        make: |files| {
            let head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty uint packed_position\nend_header\n";
            finish(files, &[head.as_bytes(), &[0; 4]].concat());
        },
        settings: &[],
        expect: Refuses(&["cloud.ply", "there are no properties x, y, z"]),
    },
    FileCase {
        name: "four right photos from 400 times farther",
        make: |files| far_photos(files, 4, |_| [0.0; 2]),
        settings: &[],
        expect: Holds { photos: 16, check: scale_of_the_near },
    },
    FileCase {
        name: "a photo whose pose is wrong and 1000 times too far",
        make: |files| far_photos(files, 1, |k| [(k * 7 % 48) as f64, (k * 5 % 36) as f64]),
        settings: &[],
        expect: Reads {
            photos: 12,
            words: &["far0.png", "it stands far away from all others", "its pose is wrong"],
        },
    },
    FileCase {
        name: "a photo without points, far off",
        make: |files| {
            files.photo("alone.png");
            files.remodel(|m| {
                m.images.push(ImageRecord {
                    id: 99,
                    name: "alone.png".into(),
                    translation: [5e4, 0.0, 0.0],
                    keypoints: vec![],
                    ..m.images[0].clone()
                });
            });
        },
        settings: &[],
        expect: Reads { photos: 12, words: &["alone.png", "it shares no points with them"] },
    },
    FileCase {
        name: "points a million units away",
        make: |files| {
            files.remodel(|m| {
                m.points[7].position = [1e6, 0.0, 2e6];
                m.points[9].position = [-1e12, 0.0, 2e9];
            });
        },
        settings: &[],
        expect: Reads { photos: 12, words: &["2 of 60 points lie absurdly far away"] },
    },
    FileCase {
        name: "a long walk past things that are near",
        make: long_walk,
        settings: &[],
        expect: Holds {
            photos: 12,
            check: |scene| {
                let depth =
                    |p: &Point| p.track.iter().map(|o| depth_in(scene, o.view, p)).fold(f32::MAX, f32::min);
                scene.points.iter().for_each(|p| assert!(depth(p) > NEAR, "{}", depth(p)));
            },
        },
    },
    FileCase {
        name: "UTM coordinates",
        make: |files| moved(files, [448_262.3, 5_411_932.7, 35.0]),
        settings: &[],
        expect: Holds {
            photos: 12,
            check: |scene| {
                let offset = scene.frame.offset();
                assert!((offset - scene.frame.origin).abs().max_element() <= scene.frame.scale);
                // What is left of the coordinates is exact to a millionth of the scene.
                let seen = scene.points.iter().flat_map(|p| p.track.iter().map(move |o| scene.astray(p, o)));
                assert!(seen.fold(0.0, f32::max) < 1e-4);
            },
        },
    },
];

/// A face of three and one of four vertices.
const FACES: &str = "element face 2\nproperty list uchar int vertex_indices\n";

/// The points' colour, as [`crate::base`] gives it.
const COLOUR: [f64; 3] = [90.0, 120.0, 150.0];

fn coloured(scene: &Scene) {
    assert_eq!(scene.points.len(), 60);
    for point in &scene.points {
        let off = (0..3).map(|c| (f64::from(point.colour[c]) * 255.0 - COLOUR[c]).abs()).fold(0.0, f64::max);
        assert!(off < 1.01, "{:?}", point.colour);
    }
}

/// The scene as a `transforms.json` with a point cloud.
fn cloud(files: &Files, format: &str, kind: &str, names: [&str; 3], value: &dyn Fn(f64) -> f64) {
    let (head, body) = ply(format, kind, names, value);
    finish(files, &[head.into_bytes(), body].concat());
}

/// Header and body of a cloud of 60 points whose colours are of some type.
fn ply(format: &str, kind: &str, names: [&str; 3], value: &dyn Fn(f64) -> f64) -> (String, Vec<u8>) {
    let mut head = format!("ply\nformat {format} 1.0\nelement vertex 60\n");
    ["x", "y", "z"].iter().for_each(|name| head += &format!("property float {name}\n"));
    names.iter().for_each(|name| head += &format!("property {kind} {name}\n"));
    head += "end_header\n";
    let mut body = Vec::new();
    for k in 0..60 {
        let position = [0.1 + 0.08 * (k % 10) as f32, -0.5 + 0.18 * (k / 10) as f32, 5.0];
        let colour = COLOUR.map(value);
        if format == "ascii" {
            let words: Vec<String> =
                position.iter().map(f32::to_string).chain(colour.iter().map(f64::to_string)).collect();
            body.extend(format!("{}\n", words.join(" ")).bytes());
            continue;
        }
        let put = |bytes: &[u8]| match format {
            "binary_big_endian" => bytes.iter().rev().copied().collect::<Vec<u8>>(),
            _ => bytes.to_vec(),
        };
        position.iter().for_each(|v| body.extend(put(&v.to_le_bytes())));
        for c in colour {
            match kind {
                "uchar" => body.push(c as u8),
                _ => body.extend(put(&(c as f32).to_le_bytes())),
            }
        }
    }
    (head, body)
}

/// Writes `cloud.ply`, and a `transforms.json` that names it instead of the model.
fn finish(files: &Files, ply: &[u8]) {
    files.remove("sparse");
    files.write("cloud.ply", ply);
    let frames: Vec<_> = (0..PHOTOS)
        .map(|i| {
            let x = f64::from(i) / f64::from(PHOTOS - 1);
            let pose =
                [[1.0, 0.0, 0.0, x], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
            serde_json::json!({ "file_path": format!("images/photo{i:02}.png"), "transform_matrix": pose })
        })
        .collect();
    let (w, h) = SIZE;
    let scene = serde_json::json!({
        "fl_x": 50.0, "fl_y": 50.0, "w": w, "h": h, "frames": frames, "ply_file_path": "cloud.ply",
    });
    files.write("transforms.json", scene.to_string());
}

/// Adds photos from far behind the others; `off` is by how many pixels their points lie elsewhere than they were seen.
fn far_photos(files: &Files, count: u32, off: fn(usize) -> [f64; 2]) {
    (0..count).for_each(|i| files.photo(&format!("far{i}.png")));
    files.remodel(|m| {
        for i in 0..count {
            let centre = [f64::from(i), 0.0, -2000.0];
            let see = |(k, p): (usize, &[f64; 3])| {
                let z = p[2] - centre[2];
                let at = |axis: usize, c: f64| 50.0 * (p[axis] - centre[axis]) / z + c;
                let [x, y] = [at(0, SIZE.0 as f64 / 2.0), at(1, SIZE.1 as f64 / 2.0)];
                Keypoint { pixel: [x + off(k)[0], y + off(k)[1]], point: Some(k as u64 + 1) }
            };
            let positions: Vec<[f64; 3]> = m.points.iter().map(|p| p.position).collect();
            let id = 100 + i;
            m.images.push(ImageRecord {
                id,
                rotation: [1.0, 0.0, 0.0, 0.0],
                translation: centre.map(|v| -v),
                camera_id: 1,
                name: format!("far{i}.png"),
                keypoints: positions.iter().enumerate().map(see).collect(),
            });
            m.points.iter_mut().enumerate().for_each(|(k, p)| p.track.push((id, k as u32)));
        }
    });
}

/// Photos 200 apart, each of points at a depth of 5.
fn long_walk(files: &Files) {
    files.remodel(|m| {
        m.images.iter_mut().for_each(|i| i.keypoints.clear());
        for (k, point) in m.points.iter_mut().enumerate() {
            let image = &mut m.images[k % PHOTOS as usize];
            let x = 200.0 * (k % PHOTOS as usize) as f64;
            image.translation = [-x, 0.0, 0.0];
            let (across, down) = (0.2 * (k / 12) as f64, 0.1 * (k % 7) as f64);
            point.position = [x + across, down, 5.0];
            point.track = vec![(image.id, image.keypoints.len() as u32)];
            let pixel = [10.0 * across + SIZE.0 as f64 / 2.0, 10.0 * down + SIZE.1 as f64 / 2.0];
            image.keypoints.push(Keypoint { pixel, point: Some(point.id) });
        }
    });
}

fn depth_in(scene: &Scene, view: u32, point: &Point) -> f32 {
    scene.views[view as usize].pose.to_camera(point.position).z
}

/// The frame is that of the cameras at x = 0 to 1.
fn scale_of_the_near(scene: &Scene) {
    assert!((scene.frame.scale - 0.55).abs() < 1e-9, "{:?}", scene.frame);
    assert!((scene.frame.origin.x - 0.5).abs() < 1e-9, "{:?}", scene.frame);
    assert!(scene.notes.iter().any(|n| n.contains("4 of 16 photos stand far away")), "{:?}", scene.notes);
}

/// Puts the scene elsewhere.
fn moved(files: &Files, by: [f64; 3]) {
    files.remodel(|m| {
        // The cameras do not turn: what is added to the points is taken from the translations.
        m.images.iter_mut().for_each(|i| (0..3).for_each(|k| i.translation[k] -= by[k]));
        m.points.iter_mut().for_each(|p| (0..3).for_each(|k| p.position[k] += by[k]));
    });
}
