//! Requests of gRPC as what the studio works with.

use crate::messages::{FrameRequest, HoverRequest, PickRequest, ShownPrompts, StudioAction, ViewMessage};
use crate::regions::{Combination, Region, RegionRule};
use segwild_proto::v1;
use segwild_proto::v1::act_request::Do;
use segwild_proto::v1::view_region::Shape;
use segwild_scene::{BoxPrompt, Camera, PointPrompt, Prompts, SplatFormat};

/// A message that lacks what it needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this is no such request: {0}")]
pub(crate) struct NoSuchRequest(&'static str);

/// What a message is, or why it is nothing.
type Parsed<T> = Result<T, NoSuchRequest>;

fn of<const N: usize>(numbers: &[f32], wanted: &'static str) -> Parsed<[f32; N]> {
    numbers.try_into().map_err(|_| NoSuchRequest(wanted))
}

fn index(index: Option<u32>) -> Option<usize> {
    index.map(|index| index as usize)
}

fn view(camera: Option<v1::Camera>, rotation: &[f32], translation: &[f32]) -> Parsed<ViewMessage> {
    let v1::Camera { width, height, fx, fy, cx, cy } = camera.ok_or(NoSuchRequest("a view has a camera"))?;
    Ok(ViewMessage {
        camera: Camera { width, height, fx, fy, cx, cy },
        rotation: of(rotation, "a rotation has 9 numbers")?,
        translation: of(translation, "a translation has 3 numbers")?,
    })
}

/// Prompts on a photo.
fn prompts(prompts: v1::ShownPrompts) -> ShownPrompts {
    let v1::ShownPrompts { photo, points, boxes, granularity } = prompts;
    let point = |v1::Click { x, y, inside }| PointPrompt { x, y, inside };
    let corners = |v1::ClickBox { x0, y0, x1, y1 }| BoxPrompt { x0, y0, x1, y1 };
    let prompts = Prompts {
        points: points.into_iter().map(point).collect(),
        boxes: boxes.into_iter().map(corners).collect(),
        granularity,
    };
    ShownPrompts { photo: photo as usize, prompts }
}

fn how(how: v1::Combination) -> Parsed<Combination> {
    match how {
        v1::Combination::Add => Ok(Combination::Add),
        v1::Combination::Subtract => Ok(Combination::Subtract),
        v1::Combination::Intersect => Ok(Combination::Intersect),
        v1::Combination::Unspecified => Err(NoSuchRequest("`how` is add, subtract or intersect")),
    }
}

fn rule(rule: v1::RegionRule) -> RegionRule {
    match rule {
        v1::RegionRule::Unspecified | v1::RegionRule::Centre => RegionRule::Centre,
        v1::RegionRule::Visible => RegionRule::Visible,
        v1::RegionRule::Footprint => RegionRule::Footprint,
    }
}

fn region(region: Option<v1::ViewRegion>) -> Parsed<Region> {
    let pairs = |points: Vec<v1::Pair>| -> Vec<[f32; 2]> {
        points.into_iter().map(|v1::Pair { x, y }| [x, y]).collect()
    };
    match region.and_then(|region| region.shape) {
        Some(Shape::Polygon(shape)) => Ok(Region::Polygon { points: pairs(shape.points) }),
        Some(Shape::Brush(shape)) => Ok(Region::Brush { points: pairs(shape.points), radius: shape.radius }),
        Some(Shape::Sphere(shape)) => {
            Ok(Region::Sphere { at: of(&shape.at, "a pixel has 2 numbers")?, radius: shape.radius })
        }
        None => Err(NoSuchRequest("a region has a shape")),
    }
}

/// What a person wants done.
pub(super) fn action(what: Option<Do>) -> Parsed<StudioAction> {
    Ok(match what.ok_or(NoSuchRequest("nothing is to be done"))? {
        Do::Prompt(v) => StudioAction::Prompt {
            prompts: v.prompts.into_iter().map(prompts).collect(),
            alternative: v.alternative,
        },
        Do::Listed(v) => StudioAction::Listed { number: v.number as usize },
        Do::Text(v) => StudioAction::Text { text: v.text, alternative: v.alternative },
        Do::Refine(v) => StudioAction::Refine { id: v.id },
        Do::Keep(v) => StudioAction::Keep { name: v.name },
        Do::Rename(v) => StudioAction::Rename { id: v.id, name: v.name },
        Do::Show(v) => StudioAction::Show { id: v.id, visible: v.visible },
        Do::Lock(v) => StudioAction::Lock { id: v.id, locked: v.locked },
        Do::Isolate(v) => StudioAction::Isolate { id: v.id },
        Do::Colour(v) => {
            let colour =
                u8::try_from(v.colour).map_err(|_| NoSuchRequest("a colour is an index into the palette"))?;
            StudioAction::Colour { id: v.id, colour }
        }
        Do::Delete(v) => StudioAction::Delete { id: v.id },
        Do::Duplicate(v) => StudioAction::Duplicate { id: v.id },
        Do::Combine(v) => StudioAction::Combine { id: v.id, with: v.with, how: how(v.how())? },
        Do::Grow(v) => StudioAction::Grow { id: v.id, steps: v.steps },
        Do::Region(v) => {
            let (how, rule) = (how(v.how())?, rule(v.rule()));
            let seen = v.view.ok_or(NoSuchRequest("a region has a view"))?;
            let view = view(seen.camera, &seen.rotation, &seen.translation)?;
            StudioAction::Region { id: v.id, view, region: region(v.region)?, how, rule }
        }
        Do::Appearance(v) => StudioAction::Appearance {
            id: v.id,
            photo: index(v.photo),
            towards: index(v.towards),
            share: v.share,
        },
        Do::Transients(v) => {
            let how = how(v.how())?;
            StudioAction::Transients { photo: v.photo as usize, region: region(v.region)?, how }
        }
        Do::StopSave(v) => StudioAction::StopSave { id: v.id },
        Do::CutSpikes(v) => StudioAction::CutSpikes { cut: v.cut },
        Do::Undo(_) => StudioAction::Undo,
        Do::Redo(_) => StudioAction::Redo,
    })
}

/// A request for the candidate at a position.
pub(super) fn hover(request: &v1::HoverRequest) -> Parsed<HoverRequest> {
    let v1::HoverRequest { run: _, photo, x, y, granularity, view: seen } = request;
    let of_scene = |seen: &v1::ViewMessage| view(seen.camera, &seen.rotation, &seen.translation);
    let view = seen.as_ref().map(of_scene).transpose()?;
    Ok(HoverRequest { photo: *photo as usize, x: *x, y: *y, granularity: *granularity, view })
}

/// A request for the photo that shows best what a pixel of a view shows.
pub(super) fn pick(request: &v1::PickRequest) -> Parsed<PickRequest> {
    let v1::PickRequest { run: _, camera, rotation, translation, at } = request;
    Ok(PickRequest { view: view(*camera, rotation, translation)?, at: of(at, "a pixel has 2 numbers")? })
}

/// A request for a rendered view.
pub(super) fn frame(request: &v1::FrameRequest) -> Parsed<FrameRequest> {
    let v1::FrameRequest { run: _, camera, rotation, translation, marks, background, appearance } = request;
    Ok(FrameRequest {
        view: view(*camera, rotation, translation)?,
        marks: *marks,
        background: *background,
        appearance: index(*appearance),
    })
}

/// How an object is written.
pub(super) fn format(format: v1::ObjectFormat) -> Parsed<SplatFormat> {
    match format {
        v1::ObjectFormat::Ply => Ok(SplatFormat::Ply),
        v1::ObjectFormat::Spz => Ok(SplatFormat::Spz),
        v1::ObjectFormat::Glb => Ok(SplatFormat::Glb),
        v1::ObjectFormat::Unspecified => Err(NoSuchRequest("`format` is ply, spz or glb")),
    }
}
