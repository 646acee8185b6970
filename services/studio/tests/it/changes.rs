//! What objects change of the splats, as the page gets it: cut shapes, and colours of their own appearances.

use crate::common::{keep, open, run};
use segwild_flow::Stopper;
use segwild_pipeline::{RunFolder, Selected};
use segwild_segmenter::scene_tree::NONE;
use segwild_studio::messages::StudioAction;
use segwild_studio::{Studio, StudioError};

/// A photo that objects get the appearance of.
const OTHER_PHOTO: usize = 3;

/// Numbers before the first list.
const HEAD: usize = 3;
/// Numbers of the head of packed splats.
const PACKED_HEAD: usize = 4;
/// Numbers of a packed splat before its colours, its index included.
const BEFORE_COLOURS: usize = 11;

/// Little-endian numbers.
fn counts(bytes: &[u8]) -> Vec<u32> {
    bytes.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect()
}

fn numbers(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

/// The colours of all splats by their indices, and the indices in the order in which they are packed.
fn colours_and_order(studio: &Studio, photo: Option<usize>) -> (Vec<f32>, Vec<u32>) {
    let bytes: Vec<u8> = studio.packed(photo).unwrap().flatten().collect();
    let (indices, values) = (counts(&bytes), numbers(&bytes));
    let [n, degree, _, chunk] = [0, 1, 2, 3].map(|k| indices[k] as usize);
    let stride = 3 * (degree + 1).pow(2);
    let (mut colours, mut order) = (vec![f32::NAN; stride * n], Vec::new());
    let mut at = PACKED_HEAD;
    while order.len() < n {
        let count = chunk.min(n - order.len());
        for k in 0..count {
            let own = &values[at + BEFORE_COLOURS * count + stride * k..][..stride];
            colours[stride * indices[at + k] as usize..][..stride].copy_from_slice(own);
        }
        order.extend(&indices[at..][..count]);
        at += (BEFORE_COLOURS + stride) * count;
    }
    assert_eq!(at, values.len());
    (colours, order)
}

/// Packed changes, taken apart.
#[derive(Debug, PartialEq)]
struct Unpacked {
    version: String,
    shapes: Vec<u32>,
    means: Vec<f32>,
    covariances: Vec<f32>,
    lit: Vec<u32>,
    colours: Vec<f32>,
}

fn unpacked(studio: &Studio) -> Unpacked {
    let (bytes, version) = studio.packed_changes(&Stopper::new()).unwrap();
    assert_eq!(version, studio.message().changes, "the state names the same");
    let (head, values) = (counts(&bytes), numbers(&bytes));
    let (shapes, lit, stride) = (head[0] as usize, head[1] as usize, 3 * (head[2] as usize + 1).pow(2));
    let means = HEAD + shapes;
    let covariances = means + 3 * shapes;
    let second = covariances + 6 * shapes;
    let colours = second + lit;
    assert_eq!(bytes.len(), 4 * (colours + stride * lit));
    Unpacked {
        version,
        shapes: head[HEAD..means].to_vec(),
        means: values[means..covariances].to_vec(),
        covariances: values[covariances..second].to_vec(),
        lit: head[second..colours].to_vec(),
        colours: values[colours..].to_vec(),
    }
}

fn appearance(id: Option<u32>, photo: Option<usize>) -> StudioAction {
    StudioAction::Appearance { id, photo, towards: None, share: 0.0 }
}

/// The record of a selection of an object.
fn record(studio: &Studio, folder: &RunFolder, object: usize) -> Selected {
    let hash = studio.message().objects[object].selection.clone();
    let bytes = std::fs::read(folder.path().join(format!("studio/selections/{hash}.bin"))).unwrap();
    Selected::from_bytes(&bytes, studio.session().model().splats.len()).unwrap()
}

#[test]
fn shapes_are_those_of_the_cut_and_go_with_it_and_with_the_object() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    let act = |action| studio.act(action).unwrap();
    let plain = unpacked(&studio);
    assert_eq!((plain.version.as_str(), plain.shapes.len(), plain.lit.len()), ("", 0, 0));
    (0..2).for_each(|object| keep(&studio, object, &format!("object {object}")).unwrap());
    let cut = unpacked(&studio);
    let mut wanted: Vec<_> = (0..2).flat_map(|object| record(&studio, &folder, object).changed).collect();
    wanted.sort_by_key(|shape| shape.splat);
    assert!(!wanted.is_empty(), "the cut changes something of this scene");
    assert!(cut.lit.is_empty() && cut.shapes.is_sorted_by(|a, b| a < b));
    assert_eq!(cut.shapes.len(), {
        wanted.dedup_by_key(|shape| shape.splat);
        wanted.len()
    });
    for (k, &splat) in cut.shapes.iter().enumerate() {
        let of_splat =
            (0..2).flat_map(|object| record(&studio, &folder, object).changed).rfind(|s| s.splat == splat);
        assert_eq!(cut.means[3 * k..][..3], of_splat.unwrap().mean);
        let [xx, xy, xz, yy, yz, zz] = cut.covariances[6 * k..][..6].try_into().unwrap();
        let trace: f32 = of_splat.unwrap().log_scales.iter().map(|s| (2.0 * s).exp()).sum();
        assert!((xx + yy + zz - trace).abs() <= 1e-3 * trace, "{splat}: {trace}");
        assert!(xy.abs() <= (xx * yy).sqrt() * 1.001 && xz.abs() + yz.abs() < f32::INFINITY);
    }
    // Alone, only the object's own cut is shown.
    act(StudioAction::Isolate { id: Some(1) });
    let own: Vec<u32> = unpacked(&studio).shapes;
    assert_eq!(own.len(), record(&studio, &folder, 0).changed.len());
    act(StudioAction::Isolate { id: None });
    act(StudioAction::CutSpikes { cut: false });
    assert_eq!(unpacked(&studio), plain);
    act(StudioAction::Undo);
    assert_eq!(unpacked(&studio), cut, "the same version names the same changes");
    act(StudioAction::Delete { id: 1 });
    act(StudioAction::Delete { id: 2 });
    assert_eq!(unpacked(&studio), plain);
    act(StudioAction::Undo);
    assert!(!unpacked(&studio).version.is_empty());
}

#[test]
fn colours_are_those_that_the_scene_would_have_in_that_appearance() {
    let (_dir, folder) = run();
    let studio = open(&folder);
    keep(&studio, 0, "statue").unwrap();
    studio.act(StudioAction::CutSpikes { cut: false }).unwrap();
    studio.act(appearance(Some(1), Some(OTHER_PHOTO))).unwrap();
    let changed = unpacked(&studio);
    let labels = record(&studio, &folder, 0).labels;
    let inside: Vec<u32> = (0..labels.len() as u32).filter(|&i| labels[i as usize]).collect();
    assert!(changed.shapes.is_empty() && changed.lit == inside);
    let (colours, order) = colours_and_order(&studio, Some(OTHER_PHOTO));
    let (stride, (own, _)) = (colours.len() / labels.len(), colours_and_order(&studio, None));
    // Each splat once, those that the views see most of first.
    let tree = studio.session().tree().unwrap();
    let light = |splat: &u32| match tree.leaf[*splat as usize] {
        NONE => 0.0,
        leaf => tree.trees[0].groups[leaf as usize].area,
    };
    assert!(order.is_sorted_by(|a, b| light(a) >= light(b)) && light(&order[0]) > 0.0);
    let mut indices = order.clone();
    indices.sort_unstable();
    assert!(indices.into_iter().eq(0..labels.len() as u32));
    let wanted: Vec<f32> =
        inside.iter().flat_map(|&i| &colours[stride * i as usize..][..stride]).copied().collect();
    let far = wanted.iter().zip(&changed.colours).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(wanted.len() == changed.colours.len() && far < 1e-4, "{far}");
    assert!(own != colours, "the photo has another appearance");
    studio.act(appearance(Some(1), None)).unwrap();
    assert_eq!(unpacked(&studio).version, "");
    // Nobody waits for it any more.
    studio.act(appearance(Some(1), Some(OTHER_PHOTO))).unwrap();
    let stopper = Stopper::new();
    stopper.stop();
    assert!(matches!(studio.packed_changes(&stopper), Err(StudioError::Run(_))));
}
