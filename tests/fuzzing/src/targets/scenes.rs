//! Files of a scene: COLMAP's, nerfstudio's, splits, clouds of points and splats.

use crate::seeds::{models, photos_for, scene_for, transforms};
use crate::yard::{folder, put, take};
use crate::{FuzzTarget, seal};
use segwild_scene::settings::Group;
use segwild_scene::{Scene, SceneSettings, SplatFile, Splats, ply};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Opens a scene and loads its photos, as a run does.
fn open(path: &Path, settings: &SceneSettings) {
    // An error may come back; the test is that it returns.
    let Ok(scene) = Scene::open(path, settings) else { return };
    for view in &scene.views {
        let _ = view.load(16);
    }
}

fn colmap(target: &'static str, file: &str, ending: &str, bytes: &[u8]) {
    let scene = folder(target);
    if !scene.join("images").is_dir() {
        scene_for(target, ending);
    }
    put(&scene.join(format!("sparse/0/{file}.{ending}")), bytes);
    open(&scene, &SceneSettings::default());
}

fn seeds_of(name: &str) -> Vec<Vec<u8>> {
    ["0", "1"].map(|model| take(&models().join(model).join(name))).to_vec()
}

const TEXT: &[&str] = &[
    " ",
    "\n",
    "#",
    "\r\n",
    "-1",
    "1e308",
    "nan",
    "PINHOLE",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "\u{feff}",
    "../",
    "\\",
];

macro_rules! colmap_target {
    ($name:ident, $target:literal, $file:literal, $ending:literal, $words:expr) => {
        pub(super) const $name: FuzzTarget = FuzzTarget {
            name: $target,
            seeds: || seeds_of(concat!($file, ".", $ending)),
            words: $words,
            seal: seal::nothing,
            read: |bytes| colmap($target, $file, $ending, bytes),
        };
    };
}

colmap_target!(CAMERAS_BIN, "colmap_cameras_bin", "cameras", "bin", &[]);
colmap_target!(IMAGES_BIN, "colmap_images_bin", "images", "bin", &["photo0.png", "/", "..", "\0"]);
colmap_target!(POINTS_BIN, "colmap_points_bin", "points3D", "bin", &[]);
colmap_target!(CAMERAS_TXT, "colmap_cameras_txt", "cameras", "txt", TEXT);
colmap_target!(IMAGES_TXT, "colmap_images_txt", "images", "txt", TEXT);
colmap_target!(POINTS_TXT, "colmap_points_txt", "points3D", "txt", TEXT);

pub(super) const TRANSFORMS: FuzzTarget = FuzzTarget {
    name: "transforms_json",
    seeds: || {
        let more = [
            "",
            "\"ply_file_path\": \"points.ply\", ",
            "\"camera_angle_x\": 0.9, \"k3\": 0.1, \"k4\": 0.1, ",
        ];
        more.map(transforms).to_vec()
    },
    words: &[
        "NaN",
        "Infinity",
        "null",
        "\"mask_path\": \"images/photo0.png\", ",
        "OPENCV_FISHEYE",
        "[]",
        "{}",
        "\\u0000",
        "../",
        "\"is_fisheye\": true, ",
        "\"train_filenames\": [",
        "\u{feff}",
        "1e999",
        "\"camera_angle_x\": 3.2, ",
    ],
    seal: seal::nothing,
    read: |bytes| {
        static SCENE: OnceLock<PathBuf> = OnceLock::new();
        let scene = SCENE.get_or_init(|| photos_for("transforms_json"));
        put(&scene.join("transforms.json"), bytes);
        open(scene, &SceneSettings::default());
    },
};

pub(super) const SPLIT: FuzzTarget = FuzzTarget {
    name: "split_tsv",
    seeds: || {
        let rows = "photo0.png\t1\ttrain\tplace\nphoto1.png\t2\ttest\tplace\nphoto2.png\t\t\tplace\n";
        vec![
            format!("filename\tid\tsplit\tdataset\n{rows}").into_bytes(),
            b"photo0.png\nphoto1.png\n".to_vec(),
        ]
    },
    words: &["\t", "\n", "\r\n", "train", "test", "filename", "id", "split", "\u{feff}", "photo1.png"],
    seal: seal::nothing,
    read: |bytes| {
        static SCENE: OnceLock<PathBuf> = OnceLock::new();
        let scene = SCENE.get_or_init(|| scene_for("split_tsv", "bin"));
        put(&scene.join("split.tsv"), bytes);
        put(&scene.join("test_list.txt"), bytes);
        let mut settings = SceneSettings::default();
        open(scene, &settings);
        settings.set("split", &scene.join("split.tsv").to_string_lossy()).unwrap_or_else(|e| panic!("{e}"));
        open(scene, &settings);
    },
};

fn splats() -> Splats {
    let n = 5;
    Splats {
        means: vec![[0.5, -1.0, 2.0]; n],
        log_scales: vec![[-3.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacities: vec![0.3; n],
        sh_degree: 1,
        sh: vec![0.1; n * 12],
    }
}

const PLY: &[&str] = &[
    "element vertex 4294967295\n",
    "element vertex -1\n",
    "property list uchar int vertex_indices\n",
    "property float x\n",
    "property double y\n",
    "property uchar red\n",
    "format ascii 1.0\n",
    "format binary_big_endian 1.0\n",
    "end_header\n",
    "comment ",
    "property float f_rest_0\n",
    "\r\n",
    "element face 1000000000\n",
];

pub(super) const PLY_SPLATS: FuzzTarget = FuzzTarget {
    name: "ply_splats",
    seeds: || {
        let file = folder("ply_splats").join("seed.ply");
        let extra = [("label", &[1u8, 0, 1, 0, 1][..])];
        ply::write_with(&file, &splats(), &extra).unwrap_or_else(|e| panic!("{e}"));
        vec![take(&file)]
    },
    words: PLY,
    seal: seal::nothing,
    read: |bytes| {
        let file = folder("ply_splats").join("input.ply");
        put(&file, bytes);
        let _ = ply::read_extra(&file, "label");
        if let Ok(splats) = ply::read(&file) {
            assert_eq!(
                splats.sh.len(),
                splats.len() * splats.sh_stride(),
                "the arrays do not fit each other"
            );
        }
    },
};

pub(super) const PLY_POINTS: FuzzTarget = FuzzTarget {
    name: "ply_points",
    seeds: || {
        let head = |format: &str, colour: &str| {
            let colours: String =
                ["red", "green", "blue"].map(|c| format!("property {colour} {c}\n")).concat();
            format!(
                "ply\nformat {format} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                 {colours}end_header\n"
            )
        };
        let text = head("ascii", "uchar") + "0 0 4 10 20 30\n1 0.5 4 0 0 0\n";
        let mut binary = head("binary_little_endian", "uchar").into_bytes();
        binary.extend(
            [0.5f32, 0.5, 4.0]
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .chain([1, 2, 3])
                .collect::<Vec<_>>()
                .repeat(2),
        );
        let floats = head("ascii", "float") + "0 0 4 0.1 0.2 0.3\n1 0.5 4 1 1 1\n";
        vec![text.into_bytes(), binary, floats.into_bytes()]
    },
    words: PLY,
    seal: seal::nothing,
    read: |bytes| {
        static SCENE: OnceLock<PathBuf> = OnceLock::new();
        let scene = SCENE.get_or_init(|| {
            let scene = photos_for("ply_points");
            put(&scene.join("transforms.json"), &transforms("\"ply_file_path\": \"points.ply\", "));
            scene
        });
        put(&scene.join("points.ply"), bytes);
        let _ = Scene::open(scene, &SceneSettings::default());
    },
};

pub(super) const IMPORTED_SPLATS: FuzzTarget = FuzzTarget {
    name: "imported_splats",
    seeds: || {
        vec![
            include_bytes!("../../../../services/scene/tests/files/six.compressed.ply").to_vec(),
            include_bytes!("../../../../services/scene/tests/files/six-v3.spz").to_vec(),
            include_bytes!("../../../../services/scene/tests/files/six-v4.spz").to_vec(),
        ]
    },
    words: PLY,
    seal: seal::nothing,
    read: |bytes| import("imported_splats", bytes),
};

pub(super) const GLB_SPLATS: FuzzTarget = FuzzTarget {
    name: "glb_splats",
    seeds: || vec![include_bytes!("../../../../services/scene/tests/files/six.glb").to_vec()],
    words: &[
        "\"count\":4294967295",
        "\"byteOffset\":18446744073709551615",
        "\"byteStride\":1,",
        "\"children\":[0],",
        "\"scale\":[0,1,1],",
        "\"matrix\":[",
        "\"nodes\":[0,0,0]",
        "\"componentType\":5120",
        "\"normalized\":true,",
        "\"type\":\"VEC4\"",
        "SH_DEGREE_3_COEF_6",
        "1e999",
        "glTF",
    ],
    seal: seal::nothing,
    read: |bytes| import("glb_splats", bytes),
};

pub(super) const SOG_SPLATS: FuzzTarget = FuzzTarget {
    name: "sog_splats",
    seeds: || vec![include_bytes!("../../../../services/scene/tests/files/six.sog").to_vec()],
    words: &[
        "PK\u{1}\u{2}",
        "PK\u{5}\u{6}",
        "\"count\":4294967295",
        "\"bands\":3",
        "\"version\":1",
        "\"model\":\"2dgs\",",
        "\"codebook\":[],",
        "meta.json",
        "sh0.webp",
        "VP8X",
        "1e999",
    ],
    seal: seal::zip,
    read: |bytes| import("sog_splats", bytes),
};

/// Reads splats of another program; what the file is follows from its content.
fn import(target: &str, bytes: &[u8]) {
    let path = folder(target).join("input.ply");
    put(&path, bytes);
    // Few splats: what a head promises is read only as far as it is there.
    let few = |file: &SplatFile| file.splats < 100_000;
    if let Some(read) = SplatFile::open(&path).ok().filter(few).and_then(|file| file.read().ok()) {
        let splats = read.splats;
        assert!(!splats.is_empty(), "a file without splats was read");
        assert!(splats.means.iter().flatten().all(|v| v.is_finite()), "a splat lies nowhere");
        assert_eq!(splats.sh.len(), splats.len() * splats.sh_stride(), "the arrays do not fit");
    }
}

pub(super) const SPLAT: FuzzTarget = FuzzTarget {
    name: "splat",
    seeds: || vec![(0..96u8).collect(), vec![0; 32]],
    words: &[],
    seal: seal::nothing,
    read: |bytes| {
        let file = folder("splat").join("input.splat");
        put(&file, bytes);
        let _ = ply::read(&file);
    },
};
