//! What many tests read and one of them makes: once per build, whether the tests run in one process or in many.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// A folder that `make` has filled: by whichever test comes first, while the others wait. It is made again when the test
/// program or one of `programs` is built again; what earlier builds left is removed.
pub fn made_once(name: &str, programs: &[&Path], make: impl FnOnce(&Path)) -> PathBuf {
    let own = std::env::current_exe().expect("the test program has a path");
    let built = |program: &Path| {
        let file = fs::metadata(program).expect("the program is there");
        let time = file.modified().expect("it has a time").duration_since(UNIX_EPOCH).expect("after 1970");
        format!("{}-{}", time.as_nanos(), file.len())
    };
    let build: Vec<String> = [&*own].iter().chain(programs).map(|program| built(program)).collect();
    let all = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let folder = all.join(build.join("-"));
    fs::create_dir_all(&folder).expect("a folder");
    for other in fs::read_dir(&all).expect("it was made").flatten().map(|entry| entry.path()) {
        if other != folder {
            let _ = fs::remove_dir_all(other);
        }
    }
    let lock = File::create(folder.join("lock")).expect("a file");
    lock.lock().expect("a lock");
    let (filled, done) = (folder.join("filled"), folder.join("done"));
    if !done.exists() {
        // A test that was stopped may have left half of it.
        let _ = fs::remove_dir_all(&filled);
        fs::create_dir(&filled).expect("a folder");
        make(&filled);
        File::create(done).expect("a file");
    }
    filled
}
