//! The journal and its document: operations undo, survive a kill, and are not shared by two processes.

use segwild_pipeline::BlendedAppearance;
use segwild_studio::document::{
    Document, DocumentError, Journal, JournalEntry, JournalError, ObjectDraft, Operation, StoredSelection,
};
use std::path::Path;

fn selection(splats: usize) -> StoredSelection {
    StoredSelection { hash: format!("{splats:032x}"), splats }
}

fn lit(photo: &str) -> BlendedAppearance {
    BlendedAppearance { photo: photo.into(), ..BlendedAppearance::default() }
}

fn paint(id: u32) -> Operation {
    Operation::Paint { id, name: format!("object {id}"), selection: selection(id as usize) }
}

/// Every kind of operation.
fn all() -> Vec<Operation> {
    let draft = ObjectDraft { alternative: 1, ..ObjectDraft::default() };
    vec![
        paint(1),
        Operation::Draft { draft: draft.clone() },
        Operation::Keep { id: 2, name: "statue".into(), draft, selection: selection(7) },
        Operation::Rename { id: 2, name: "liberty".into() },
        Operation::Show { id: 2, visible: false },
        Operation::Colour { id: 1, colour: 3 },
        Operation::Duplicate { id: 2, copy: 3, name: "liberty 2".into() },
        Operation::Edit { id: 3, tool: "grow".into(), selection: selection(9) },
        Operation::Appearance { id: Some(3), appearance: lit("night.jpg") },
        Operation::Appearance { id: None, appearance: lit("day.jpg") },
        Operation::CutSpikes { cut: false },
        Operation::Transients { photo: "day.jpg".into(), mask: "a".into(), before: "b".into() },
        Operation::Transients { photo: "day.jpg".into(), mask: "c".into(), before: "b".into() },
        Operation::Isolate { id: Some(2) },
        Operation::Delete { id: 2 },
        Operation::Lock { id: 1, locked: true },
    ]
}

#[test]
fn everything_can_be_undone_and_done_again() {
    let mut document = Document::default();
    let mut states = vec![document.objects().clone()];
    for operation in all() {
        document.enter(&JournalEntry::Apply(operation)).unwrap();
        states.push(document.objects().clone());
    }
    for state in states.iter().rev().skip(1) {
        document.enter(&JournalEntry::Undo).unwrap();
        assert_eq!(document.objects(), state);
    }
    assert_eq!(document.enter(&JournalEntry::Undo), Err(DocumentError::NothingToUndo));
    for state in &states[1..] {
        document.enter(&JournalEntry::Redo).unwrap();
        assert_eq!(document.objects(), state);
    }
    assert_eq!(document.enter(&JournalEntry::Redo), Err(DocumentError::NothingToRedo));
}

#[test]
fn an_operation_that_does_not_fit_changes_nothing() {
    let mut document = Document::default();
    let mut enter = |operation| document.enter(&JournalEntry::Apply(operation));
    enter(paint(1)).unwrap();
    enter(Operation::Lock { id: 1, locked: true }).unwrap();
    let refused = [
        Operation::Rename { id: 1, name: "x".into() },
        Operation::Delete { id: 1 },
        Operation::Edit { id: 1, tool: "grow".into(), selection: selection(2) },
        Operation::Rename { id: 9, name: "x".into() },
        Operation::Isolate { id: Some(9) },
        Operation::Colour { id: 1, colour: 200 },
        paint(1),
        Operation::Paint { id: 2, name: "Object 1".into(), selection: selection(2) },
        Operation::Paint { id: 2, name: " ".into(), selection: selection(2) },
        Operation::Paint { id: 2, name: "a\u{1b}[2J".into(), selection: selection(2) },
        Operation::Paint { id: 2, name: "x".repeat(81), selection: selection(2) },
    ];
    for operation in refused {
        assert!(enter(operation.clone()).is_err(), "{operation:?}");
    }
    assert_eq!(document.objects().all.len(), 1);
    assert_eq!(document.undo_label(), Some("lock"));
}

#[test]
fn the_number_of_a_deleted_object_is_never_used_again() {
    let mut document = Document::default();
    for operation in [paint(1), Operation::Delete { id: 1 }] {
        document.enter(&JournalEntry::Apply(operation)).unwrap();
    }
    assert_eq!(document.objects().next_id(), 2);
}

#[test]
fn the_largest_number_in_a_journal_of_somebody_else_leaves_no_further_one_and_ends_nothing() {
    let mut document = Document::default();
    document.enter(&JournalEntry::Apply(paint(u32::MAX))).unwrap();
    let next = document.objects().next_id();
    assert!(document.enter(&JournalEntry::Apply(paint(next))).is_err());
}

fn written(path: &Path) -> Document {
    let mut opened = Journal::open(path, "scene").unwrap();
    for operation in all() {
        let entry = JournalEntry::Apply(operation);
        opened.document.enter(&entry).unwrap();
        opened.journal.append(&entry).unwrap();
    }
    for entry in [JournalEntry::Undo, JournalEntry::Undo, JournalEntry::Redo] {
        opened.document.enter(&entry).unwrap();
        opened.journal.append(&entry).unwrap();
    }
    opened.document
}

#[test]
fn a_journal_that_a_kill_cut_anywhere_opens_with_every_whole_line() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("session.jsonl");
    let whole = written(&path);
    assert_eq!(Journal::open(&path, "scene").unwrap().document.objects(), whole.objects());
    let bytes = std::fs::read(&path).unwrap();
    let ends: Vec<usize> = (0..bytes.len()).filter(|&i| bytes[i] == b'\n').map(|i| i + 1).collect();
    for cut in (0..bytes.len()).step_by(23) {
        std::fs::write(&path, &bytes[..cut]).unwrap();
        let mut opened = Journal::open(&path, "scene").unwrap();
        assert_eq!(opened.skipped, 0, "cut at {cut}");
        if cut >= ends[0] {
            let lines = ends.iter().filter(|end| **end <= cut).count() - 1;
            // What comes next is on a line of its own.
            opened.journal.append(&JournalEntry::Apply(Operation::CutSpikes { cut: true })).unwrap();
            let text = std::fs::read_to_string(&path).unwrap();
            assert_eq!(text.lines().count(), lines + 2, "cut at {cut}");
            assert!(
                text.lines().all(|line| serde_json::from_str::<serde_json::Value>(line).is_ok()),
                "{cut}"
            );
        }
    }
}

#[test]
fn two_processes_do_not_write_one_journal() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("session.jsonl");
    let first = Journal::open(&path, "scene").unwrap();
    assert!(matches!(Journal::open(&path, "scene"), Err(JournalError::Busy(_))));
    drop(first);
    assert!(Journal::open(&path, "scene").is_ok());
}

#[test]
fn a_journal_of_another_training_is_put_aside_and_of_a_later_version_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("session.jsonl");
    let before = written(&path);
    let opened = Journal::open(&path, "another").unwrap();
    assert_eq!(opened.earlier.unwrap().objects(), before.objects());
    assert!(opened.document.objects().all.is_empty());
    assert!(dir.path().join("session-1.jsonl").is_file());
    drop(opened.journal);
    std::fs::write(&path, "{\"segwild_session\":99,\"scene\":\"another\"}\n").unwrap();
    assert!(matches!(Journal::open(&path, "another"), Err(JournalError::Version { found: 99, .. })));
    assert!(path.is_file());
}

#[test]
fn a_journal_that_is_full_refuses_what_could_not_be_read_again() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("session.jsonl");
    let mut journal = Journal::open(&path, "scene").unwrap().journal;
    // A hole in the file takes no space.
    let most = 256 << 20;
    std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(most).unwrap();
    let error = journal.append(&JournalEntry::Apply(paint(1))).unwrap_err();
    assert!(
        error.to_string().contains("it is full") && error.to_string().contains("rename the file"),
        "{error}"
    );
    assert_eq!(std::fs::metadata(&path).unwrap().len(), most);
}
