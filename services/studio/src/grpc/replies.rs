//! What the studio answers, as messages of gRPC. Every field is named, so that none is forgotten.

use crate::messages::{
    AnswerMessage, AppearanceMessage, ConfidenceMessage, DraftMessage, LabelMap, ListedDescription,
    ObjectMessage, PhotoConfidence, PhotoDescription, PickedPixel, RunDescription, RunEntry, SavingMessage,
    ShownPrompts, StateMessage, TrainingMessage,
};
use segwild_pipeline::{AnswerStep, Moment};
use segwild_proto::v1::{self, alternative, answer_step};
use segwild_scene::{BoxPrompt, Camera, PointPrompt, Prompts};
use segwild_segmenter::{Alternative, Lopsided, SideAgreement};

/// A number that is far below the limit of 32 bits: of photos, pixels, objects of a list.
fn small(number: usize) -> u32 {
    u32::try_from(number).unwrap_or(u32::MAX)
}

/// A run of the list.
pub(super) fn entry(entry: RunEntry) -> v1::RunEntry {
    let RunEntry { name, state, reason } = entry;
    v1::RunEntry { name, state: state.into(), reason }
}

fn camera(camera: Camera) -> v1::Camera {
    let Camera { width, height, fx, fy, cx, cy } = camera;
    v1::Camera { width, height, fx, fy, cx, cy }
}

fn photo(photo: PhotoDescription) -> v1::PhotoDescription {
    let PhotoDescription { name, camera: intrinsics, rotation, translation, held_out } = photo;
    let camera = Some(camera(intrinsics));
    v1::PhotoDescription {
        name,
        camera,
        rotation: rotation.into(),
        translation: translation.into(),
        held_out,
    }
}

fn listed(listed: ListedDescription) -> v1::ListedDescription {
    let ListedDescription { number, name, splats, photos, photo } = listed;
    v1::ListedDescription {
        number: small(number),
        name,
        splats: splats as u64,
        photos: small(photos),
        photo: small(photo),
    }
}

/// What does not change while a session is open.
pub(super) fn description(description: RunDescription) -> v1::RunDescription {
    let RunDescription {
        name,
        provider,
        splats,
        size,
        photos,
        centre,
        up,
        listed: objects,
        palette,
        tree,
        snapshot,
        texts,
    } = description;
    let rgb =
        |[red, green, blue]: [u8; 3]| v1::Rgb { red: red.into(), green: green.into(), blue: blue.into() };
    v1::RunDescription {
        name,
        provider,
        splats: splats as u64,
        size,
        photos: photos.into_iter().map(photo).collect(),
        centre: centre.into(),
        up: up.into(),
        listed: objects.into_iter().map(listed).collect(),
        palette: palette.into_iter().map(rgb).collect(),
        tree,
        snapshot,
        texts,
    }
}

/// A run that is being trained.
pub(super) fn training(training: TrainingMessage) -> v1::TrainingMessage {
    let TrainingMessage { photos, history, snapshot } = training;
    let moment = |Moment { step, loss, psnr, splats, left_out }| v1::Moment {
        step,
        loss,
        psnr,
        splats: splats as u64,
        left_out,
    };
    v1::TrainingMessage { photos, history: history.into_iter().map(moment).collect(), snapshot }
}

fn prompts(prompts: ShownPrompts) -> v1::ShownPrompts {
    let ShownPrompts { photo, prompts: Prompts { points, boxes, granularity } } = prompts;
    let point = |PointPrompt { x, y, inside }| v1::Click { x, y, inside };
    let corners = |BoxPrompt { x0, y0, x1, y1 }| v1::ClickBox { x0, y0, x1, y1 };
    v1::ShownPrompts {
        photo: small(photo),
        points: points.into_iter().map(point).collect(),
        boxes: boxes.into_iter().map(corners).collect(),
        granularity,
    }
}

fn appearance(appearance: AppearanceMessage) -> v1::AppearanceMessage {
    let AppearanceMessage { photo, towards, share } = appearance;
    v1::AppearanceMessage { photo: photo.map(small), towards: towards.map(small), share }
}

fn draft(draft: DraftMessage) -> v1::DraftMessage {
    let DraftMessage { prompts: all, listed, of, alternative, text } = draft;
    v1::DraftMessage {
        prompts: all.into_iter().map(prompts).collect(),
        listed: listed.map(small),
        of,
        alternative,
        text,
    }
}

fn step(step: AnswerStep) -> v1::AnswerStep {
    use answer_step::Case;
    let case = match step {
        AnswerStep::Tree => Case::Tree(v1::Nothing {}),
        AnswerStep::Prompted => Case::Prompted(v1::Nothing {}),
        AnswerStep::Photos(photos) => Case::Photos(small(photos)),
        AnswerStep::Selected => Case::Selected(v1::Nothing {}),
    };
    v1::AnswerStep { case: Some(case) }
}

fn alternative(alternative: Alternative) -> v1::Alternative {
    use alternative::Case;
    let case = match alternative {
        Alternative::Group(share) => Case::Group(share),
        Alternative::Surface(share) => Case::Surface(share),
        Alternative::Photo => Case::Photo(v1::Nothing {}),
    };
    v1::Alternative { case: Some(case) }
}

fn answer(answer: AnswerMessage) -> v1::AnswerMessage {
    let AnswerMessage {
        number,
        state,
        step: from,
        splats,
        alternatives,
        error,
        seconds,
        confidence: sure,
        scores,
    } = answer;
    v1::AnswerMessage {
        number,
        state: state.into(),
        step: from.map(step),
        splats: splats as u64,
        alternatives: alternatives.into_iter().map(alternative).collect(),
        error,
        seconds,
        confidence: sure.map(confidence),
        scores,
    }
}

fn side(side: SideAgreement) -> v1::SideMessage {
    let SideAgreement { photos, agreement } = side;
    v1::SideMessage { photos: small(photos), agreement }
}

fn photo_confidence(photo: PhotoConfidence) -> v1::PhotoConfidence {
    let PhotoConfidence { photo, prompted, far, agreement, shown, disagrees } = photo;
    v1::PhotoConfidence { photo: small(photo), prompted, far, agreement, shown, disagrees }
}

fn confidence(confidence: ConfidenceMessage) -> v1::ConfidenceMessage {
    let ConfidenceMessage {
        value,
        agreement,
        worst_side_agreement,
        levels_agreement,
        prompted_side,
        far_side,
        lopsided,
        next_click,
        photos,
    } = confidence;
    let word = |lopsided| match lopsided {
        Lopsided::Disagrees => "disagrees".to_owned(),
        Lopsided::Unseen => "unseen".to_owned(),
    };
    v1::ConfidenceMessage {
        value,
        agreement,
        worst_side_agreement,
        levels_agreement,
        prompted_side: Some(side(prompted_side)),
        far_side: Some(side(far_side)),
        lopsided: lopsided.map(word),
        next_click: next_click.map(small),
        photos: photos.into_iter().map(photo_confidence).collect(),
    }
}

fn object(object: ObjectMessage) -> v1::ObjectMessage {
    let ObjectMessage {
        id,
        name,
        colour,
        visible,
        locked,
        appearance: own,
        splats,
        selection,
        prompted,
        edited,
    } = object;
    v1::ObjectMessage {
        id,
        name,
        colour: colour.into(),
        visible,
        locked,
        appearance: own.map(appearance),
        splats: splats as u64,
        selection,
        prompted,
        edited,
    }
}

/// The state of a session.
pub(super) fn state(state: StateMessage) -> v1::StateMessage {
    let StateMessage {
        revision,
        sequence,
        draft: requested,
        answer: present,
        objects,
        isolated,
        appearance: of_scene,
        corrected,
        cut_spikes,
        changes,
        undo,
        redo,
        notes,
        saving,
    } = state;
    let save = |SavingMessage { object, done, photos }| v1::SavingMessage {
        object,
        done: small(done),
        photos: small(photos),
    };
    v1::StateMessage {
        revision,
        sequence,
        draft: Some(draft(requested)),
        answer: Some(answer(present)),
        objects: objects.into_iter().map(object).collect(),
        isolated,
        appearance: Some(appearance(of_scene)),
        corrected: corrected.into_iter().map(small).collect(),
        cut_spikes,
        changes,
        undo: undo.map(Into::into),
        redo: redo.map(Into::into),
        notes,
        saving: saving.into_iter().map(save).collect(),
    }
}

/// Labels of a photo's pixels.
pub(super) fn labels(map: LabelMap) -> v1::LabelMap {
    let LabelMap { width, height, runs, revision } = map;
    v1::LabelMap { width: small(width), height: small(height), runs, revision }
}

/// A position on a photo.
pub(super) fn pixel(pixel: PickedPixel) -> v1::PickedPixel {
    let PickedPixel { photo, x, y, point } = pixel;
    v1::PickedPixel { photo: small(photo), x, y, point: point.into() }
}
