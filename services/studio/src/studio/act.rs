//! What a person does, as operations.

use super::state::{LOST, Studio, StudioError, StudioState};
use crate::document::{JournalEntry, ObjectDraft, ObjectId, Operation, StoredSelection};
use crate::messages::{ShownPrompts, StudioAction};
use segwild_flow::lock;
use segwild_pipeline::{BlendedAppearance, PhotoPrompts, Selected, TextRanking};
use segwild_segmenter::NeighbourGraph;
use std::sync::Arc;

/// Neighbours of a splat that grow and shrink step to.
const NEIGHBOURS: usize = 10;

/// Steps of grow and shrink at most.
const MOST_STEPS: i32 = 32;

/// Prompts of one query at most.
const MOST_PROMPTS: usize = 256;

/// Characters of a text that names the object that it described, at most.
const LONGEST_TEXT_AS_NAME: usize = 40;

impl Studio {
    /// Does what a person wants.
    ///
    /// # Errors
    /// When it does not fit, or cannot be written.
    pub fn act(self: &Arc<Self>, action: StudioAction) -> Result<(), StudioError> {
        let mut guard = self.state();
        let state = &mut *guard;
        let objects = state.document.objects();
        let operation = match action {
            StudioAction::Undo => return self.enter(state, JournalEntry::Undo),
            StudioAction::Redo => return self.enter(state, JournalEntry::Redo),
            StudioAction::Prompt { prompts, alternative } => {
                let prompts = self.as_taken(&prompts)?;
                let of = objects.draft.of.filter(|_| !prompts.is_empty());
                Operation::Draft { draft: ObjectDraft { prompts, alternative, of, ..ObjectDraft::default() } }
            }
            StudioAction::Text { text, alternative } => {
                let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
                if text.chars().any(char::is_control) {
                    return Err(StudioError::Request("a text has no characters that control a terminal"));
                }
                let text = Some(text).filter(|text| !text.is_empty());
                text.as_deref().map(TextRanking::check).transpose()?;
                Operation::Draft { draft: ObjectDraft { text, alternative, ..ObjectDraft::default() } }
            }
            StudioAction::Listed { number } => {
                let list =
                    self.listed.as_ref().ok_or(StudioError::Request("this run has no list of objects"))?;
                let listed = Some(list.query(&number.to_string())?);
                Operation::Draft { draft: ObjectDraft { listed, ..ObjectDraft::default() } }
            }
            StudioAction::Refine { id } => {
                let object = objects.get(id)?;
                if object.draft.is_empty() {
                    return Err(StudioError::Request(
                        "a tool made this object: it has no prompts to take up again",
                    ));
                }
                Operation::Draft { draft: ObjectDraft { of: Some(id), ..object.draft.clone() } }
            }
            StudioAction::Keep { name } => {
                let selected = state.answer.selected.clone();
                let selected = selected.ok_or(StudioError::Request("there is no answer to keep yet"))?;
                let draft = objects.draft.clone();
                let wanted = name.unwrap_or_else(|| self.name_for(&draft, objects.next_id()));
                let (id, name) = (draft.of.unwrap_or(objects.next_id()), objects.free_name(&wanted));
                let selection = state.store.put((*selected).clone())?;
                if let Some(answer) = &state.answer.done {
                    lock(&self.kept).add(answer.clone());
                }
                Operation::Keep { id, name, draft, selection }
            }
            StudioAction::Rename { id, name } => Operation::Rename { id, name },
            StudioAction::Show { id, visible } => Operation::Show { id, visible },
            StudioAction::Lock { id, locked } => Operation::Lock { id, locked },
            StudioAction::Isolate { id } => Operation::Isolate { id },
            StudioAction::Colour { id, colour } => Operation::Colour { id, colour },
            StudioAction::Delete { id } => Operation::Delete { id },
            StudioAction::Duplicate { id } => {
                let name = objects.free_name(&objects.get(id)?.name.clone());
                Operation::Duplicate { id, copy: objects.next_id(), name }
            }
            StudioAction::Combine { id, with, how } => {
                let (selection, other) =
                    (objects.get(id)?.selection.clone(), objects.get(with)?.selection.clone());
                let other = state.store.get(&other).ok_or(LOST)?;
                let mut selected = (*state.store.get(&selection).ok_or(LOST)?).clone();
                how.apply(&mut selected.labels, &other.labels);
                Operation::Edit { id, tool: "combine".into(), selection: store(state, selected)? }
            }
            StudioAction::Grow { id, steps } => {
                let selection = objects.get(id)?.selection.clone();
                let mut selected = (*state.store.get(&selection).ok_or(LOST)?).clone();
                self.grow(&mut selected.labels, steps.clamp(-MOST_STEPS, MOST_STEPS));
                let tool = if steps < 0 { "shrink" } else { "grow" };
                Operation::Edit { id, tool: tool.into(), selection: store(state, selected)? }
            }
            StudioAction::Region { id, view, region, how, rule } => {
                if let Some(flaw) = region.flaw() {
                    return Err(StudioError::Request(flaw));
                }
                let (camera, pose) = view.view().map_err(StudioError::Request)?;
                let taken = region.splats(&self.session, &camera, &pose, rule)?;
                match id {
                    Some(id) => {
                        let selection = objects.get(id)?.selection.clone();
                        let mut selected = (*state.store.get(&selection).ok_or(LOST)?).clone();
                        how.apply(&mut selected.labels, &taken);
                        Operation::Edit { id, tool: "region".into(), selection: store(state, selected)? }
                    }
                    None => {
                        let id = objects.next_id();
                        let name = objects.free_name(&format!("object {id}"));
                        let selection = store(state, Selected::of_labels(taken))?;
                        Operation::Paint { id, name, selection }
                    }
                }
            }
            StudioAction::Appearance { id, photo, towards, share } => {
                let appearance =
                    BlendedAppearance { photo: self.lit_by(photo)?, towards: self.lit_by(towards)?, share };
                if !(0.0..=1.0).contains(&share) {
                    return Err(StudioError::Request("a share is from 0 to 1"));
                }
                Operation::Appearance { id, appearance }
            }
            StudioAction::Transients { photo, region, how } => {
                self.paint_transients(state, photo, &region, how)?
            }
            StudioAction::CutSpikes { cut } => Operation::CutSpikes { cut },
            StudioAction::StopSave { id } => return self.stop_save(state, id),
        };
        self.enter(state, JournalEntry::Apply(operation))
    }

    pub(super) fn as_taken(&self, prompts: &[ShownPrompts]) -> Result<Vec<PhotoPrompts>, StudioError> {
        let many = prompts.iter().map(|p| p.prompts.points.len() + p.prompts.boxes.len()).sum::<usize>();
        if many > MOST_PROMPTS {
            return Err(StudioError::Request("a query has 256 clicks and boxes at most"));
        }
        let with_prompts =
            prompts.iter().filter(|p| !p.prompts.points.is_empty() || !p.prompts.boxes.is_empty());
        let taken = |p: &ShownPrompts| {
            self.check_photo(p.photo)?;
            let outside = StudioError::Request("a click lies outside of its photo");
            self.session.prompts_as_taken(p.photo, &p.prompts).ok_or(outside)
        };
        with_prompts.map(taken).collect()
    }

    /// The name of a photo that has an appearance; empty for the scene's own.
    pub(super) fn lit_by(&self, photo: Option<usize>) -> Result<String, StudioError> {
        let Some(photo) = photo else { return Ok(String::new()) };
        self.check_photo(photo)?;
        if self.session.model().appearance_index(Some(photo)) != photo {
            return Err(StudioError::Request(
                "this photo took no part in the training: it has no appearance",
            ));
        }
        Ok(self.session.scene().views[photo].name.clone())
    }

    /// The name of a new object: that of the listed one, a short text that described it, or a number.
    pub(super) fn name_for(&self, draft: &ObjectDraft, id: ObjectId) -> String {
        if let Some(text) = draft.text.as_ref().filter(|text| text.chars().count() <= LONGEST_TEXT_AS_NAME) {
            return text.clone();
        }
        let listed = draft
            .listed
            .as_ref()
            .and_then(|query| self.listed.as_ref()?.objects.get(query.number.checked_sub(1)?));
        let named = listed.map(|object| object.name.clone()).filter(|name| !name.is_empty());
        named.unwrap_or_else(|| format!("object {id}"))
    }

    /// Adds the neighbours of labelled splats, or takes away those with neighbours outside.
    pub(super) fn grow(&self, labels: &mut [bool], steps: i32) {
        let splats = &self.session.model().splats;
        let graph = self.graph.get_or_init(|| NeighbourGraph::new(splats, NEIGHBOURS));
        let to = steps >= 0;
        for _ in 0..steps.abs() {
            let before = labels.to_vec();
            for i in (0..before.len()).filter(|&i| before[i] == to) {
                for edge in graph.edges(i) {
                    labels[graph.neighbour(edge)] = to;
                }
            }
        }
    }
}

pub(super) fn store(state: &mut StudioState, selected: Selected) -> Result<StoredSelection, StudioError> {
    if !selected.labels.contains(&true) {
        return Err(StudioError::Request("nothing would be left of the object"));
    }
    Ok(state.store.put(selected)?)
}
