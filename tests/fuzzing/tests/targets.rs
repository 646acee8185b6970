//! The list of targets is the same everywhere, and changes are the same each time.

use segwild_fuzzing::TARGETS;
use segwild_fuzzing::mutate::{FuzzDice, LONGEST, change};
use std::collections::BTreeSet;
use std::path::Path;

#[test]
fn cargo_fuzz_has_every_target_and_no_other() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz");
    let names: BTreeSet<String> = TARGETS.iter().map(|target| target.name.to_owned()).collect();
    assert_eq!(names.len(), TARGETS.len(), "two targets have one name");
    let files = std::fs::read_dir(fuzz.join("fuzz_targets")).expect("the folder").flatten();
    let files: BTreeSet<String> =
        files.map(|f| f.path().file_stem().expect("a name").to_string_lossy().into_owned()).collect();
    assert_eq!(files, names);
    let manifest = std::fs::read_to_string(fuzz.join("Cargo.toml")).expect("the manifest");
    for name in &names {
        assert!(manifest.contains(&format!("[[bin]]\nname = \"{name}\"\n")), "{name} is not in its manifest");
        let wrapper =
            std::fs::read_to_string(fuzz.join(format!("fuzz_targets/{name}.rs"))).expect("the wrapper");
        assert!(wrapper.contains(&format!("feed(\"{name}\", bytes)")), "{name} feeds another target");
    }
    let kept = std::fs::read_dir(fuzz.join("corpus")).expect("the corpus").flatten();
    for folder in kept {
        let name = folder.file_name().to_string_lossy().into_owned();
        assert!(names.contains(&name), "the corpus has inputs of no target: {name}");
    }
}

#[test]
fn changes_are_the_same_each_time_and_differ_from_each_other() {
    let seeds = [b"width 640 height 480".to_vec(), vec![7; 100]];
    let some = |seed| {
        let mut dice = FuzzDice::new(seed, "target");
        (0..500).map(|_| change(&mut dice, &seeds, &["word"])).collect::<Vec<_>>()
    };
    assert_eq!(some(1), some(1));
    assert_ne!(some(1), some(2));
    let different: BTreeSet<Vec<u8>> = some(1).into_iter().collect();
    assert!(different.len() > 400, "{} of 500 differ", different.len());
    assert!(different.iter().all(|bytes| bytes.len() <= LONGEST));
    // Whatever is changed, also nothing.
    let mut dice = FuzzDice::new(1, "empty");
    for _ in 0..500 {
        change(&mut dice, &[vec![]], &[]);
        change(&mut dice, &[], &["a"]);
    }
}
