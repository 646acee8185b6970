//! What every store has to do, done on each.

use super::servers;
use segwild_farm::{ArtefactDigest, ArtefactError, ArtefactStore, JetStreamArtefacts, ObjectArtefacts};
use segwild_flow::process;
use std::io::Write;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Barrier;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

const LARGE: usize = 70 << 20;
/// Any number of bytes.
const ANY: RangeInclusive<u64> = 0..=u64::MAX;
/// A store takes no more memory than this for a file of any length, in bytes.
const MEMORY: u64 = 48 << 20;

/// A file of bytes that repeat nowhere.
fn file_of(path: &Path, bytes: usize, seed: u64) -> ArtefactDigest {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
    for _ in 0..bytes / 8 {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        file.write_all(&state.to_le_bytes()).unwrap();
    }
    file.write_all(&[7; 8][..bytes % 8]).unwrap();
    file.flush().unwrap();
    drop(file);
    ArtefactDigest::of_file(path).unwrap().0
}

/// Everything that a store has to do; it renews all that is stored again. `write_other` puts other bytes in the store under a digest.
fn serves(store: &dyn ArtefactStore, write_other: &dyn Fn(&ArtefactDigest, &[u8])) {
    let dir = tempfile::tempdir().unwrap();
    let (from, to) = (dir.path().join("from"), dir.path().join("below/to"));
    for (seed, bytes) in [0, 1, 4096, 128 << 10, (6 << 20) - 1, 6 << 20, 13 << 20].into_iter().enumerate() {
        let digest = file_of(&from, bytes, seed as u64);
        assert!(!store.has(&digest).unwrap(), "{bytes}");
        store.put(&digest, &from).unwrap();
        let stored = store.find(&digest).unwrap().expect("it is there");
        store.put(&digest, &from).unwrap();
        let renewed = store.find(&digest).unwrap().expect("it is there still");
        assert!(renewed.since >= stored.since && renewed.bytes == stored.bytes, "{stored:?}, {renewed:?}");
        store.get(&digest, ANY, &to).unwrap();
        assert!(std::fs::read(&from).unwrap() == std::fs::read(&to).unwrap(), "{bytes}");
    }
    is_bounded(store, &from, &to);
    refuses(store, write_other, &from, dir.path());
    lists_and_removes(store, &from);

    // Two at once, of one large file: both succeed.
    let digest = file_of(&from, 9 << 20, 77);
    let barrier = Barrier::new(2);
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                barrier.wait();
                store.put(&digest, &from).unwrap();
            });
        }
    });
    store.get(&digest, ANY, &to).unwrap();
    assert_eq!(ArtefactDigest::of_file(&to).unwrap().0, digest);
}

/// What is stored is listed with its length and its time, and what is removed is gone.
fn lists_and_removes(store: &dyn ArtefactStore, from: &Path) {
    let digest = file_of(from, 5000, 55);
    let listed = || {
        let mut found = Vec::new();
        store.list(&mut |artefact| found.push(artefact)).unwrap();
        found
    };
    let before = listed();
    store.put(&digest, from).unwrap();
    let found = store.find(&digest).unwrap().expect("it is there");
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs();
    assert!(found.digest == digest && found.bytes == 5000 && found.since.abs_diff(now) < 600, "{found:?}");
    let with = listed();
    assert!(before.len() > 6 && with.len() == before.len() + 1 && with.contains(&found), "{with:?}");
    assert!(!store.remove_older(&digest, Duration::from_secs(3600)).unwrap(), "it is young");
    assert!(store.has(&digest).unwrap());
    for there in [true, false] {
        assert_eq!(store.remove_older(&digest, Duration::ZERO).unwrap(), there);
        assert!(!store.has(&digest).unwrap());
    }
    assert_eq!(listed().len(), before.len());
    store.put(&digest, from).unwrap();
    let to = from.with_extension("again");
    store.get(&digest, ANY, &to).unwrap();
    assert_eq!(ArtefactDigest::of_file(&to).unwrap().0, digest, "it can be stored again");
}

fn is_bounded(store: &dyn ArtefactStore, from: &Path, to: &Path) {
    let digest = file_of(from, LARGE, 99);
    let peak = || process::usage().map_or(0, |usage| usage.peak_rss_bytes);
    let (before, start) = (peak(), Instant::now());
    store.put(&digest, from).unwrap();
    let put_s = start.elapsed().as_secs_f64();
    store.get(&digest, ANY, to).unwrap();
    let get_s = start.elapsed().as_secs_f64() - put_s;
    let grown = peak() - before;
    let rate = |seconds: f64| (LARGE >> 20) as f64 / seconds;
    println!(
        "{}: put {:.0} MiB/s, get {:.0} MiB/s, {} MiB of memory",
        store.name(),
        rate(put_s),
        rate(get_s),
        grown >> 20
    );
    assert!(grown < MEMORY, "{grown} bytes for a file of {LARGE}");
}

fn refuses(store: &dyn ArtefactStore, write_other: &dyn Fn(&ArtefactDigest, &[u8]), from: &Path, dir: &Path) {
    let to = dir.join("refused/file");
    let unknown = ArtefactDigest::of(b"never stored");
    let error = store.get(&unknown, ANY, &to).unwrap_err();
    assert!(matches!(error, ArtefactError::Missing { digest, .. } if digest == unknown), "{error}");
    // A file that is not what it is to be is not stored.
    for bytes in [10, 14 << 20] {
        file_of(from, bytes, 5);
        let error = store.put(&unknown, from).unwrap_err();
        assert!(matches!(error, ArtefactError::Changed { .. }), "{error}");
        assert!(!store.has(&unknown).unwrap(), "{bytes}");
    }
    // What the store delivers is not what it is to be.
    let digest = ArtefactDigest::of(b"the right bytes");
    write_other(&digest, b"other bytes");
    assert!(store.has(&digest).unwrap());
    let error = store.get(&digest, ANY, &to).unwrap_err();
    assert!(error.to_string().contains(&digest.to_string()), "{error}");
    let found = ArtefactDigest::of(b"other bytes");
    assert!(matches!(error, ArtefactError::Damaged { found: f, .. } if f == found), "{error}");
    assert_eq!(std::fs::read_dir(dir.join("refused")).unwrap().count(), 0, "nothing is left of it");
    // It is longer, or shorter, than it may be.
    let digest = file_of(from, 300_000, 6);
    store.put(&digest, from).unwrap();
    let long = store.get(&digest, 0..=299_999, &to).unwrap_err();
    assert!(matches!(long, ArtefactError::Long { most: 299_999, .. }), "{long}");
    let short = store.get(&digest, 300_001..=300_001, &to).unwrap_err();
    assert!(matches!(short, ArtefactError::Short { received: 300_000, .. }), "{short}");
    assert_eq!(std::fs::read_dir(dir.join("refused")).unwrap().count(), 0, "nothing is left of them");
    // A file that was there stays.
    let digest = ArtefactDigest::of(b"the right bytes");
    std::fs::write(&to, "before").unwrap();
    store.get(&digest, ANY, &to).unwrap_err();
    assert_eq!(std::fs::read(&to).unwrap(), b"before");
}

/// Where a store of objects has an artefact.
fn key(digest: &ArtefactDigest) -> String {
    format!("{}/{digest}", &digest.to_string()[..2])
}

#[test]
fn a_shared_folder_serves() {
    let dir = tempfile::tempdir().unwrap();
    let shared = dir.path().join("shared farm");
    let store = ObjectArtefacts::open(&format!("file://{}", shared.display())).unwrap();
    serves(&store.renewing_after(Duration::ZERO), &|digest, bytes| {
        let path = shared.join(key(digest));
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    });
    // Another process finds it by a plain path.
    let again = ObjectArtefacts::open(&shared.display().to_string()).unwrap();
    assert!(again.has(&ArtefactDigest::of(b"the right bytes")).unwrap());
}

#[test]
fn a_bucket_of_jetstream_serves() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = servers::nats(dir.path()) else {
        return println!("skipped: a_bucket_of_jetstream_serves: no nats-server");
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let client = runtime.block_on(async_nats::connect(&server.url)).unwrap();
    let context = {
        let _inside = runtime.enter();
        async_nats::jetstream::new(client)
    };
    let open = || JetStreamArtefacts::open(context.clone(), "artefacts", runtime.handle().clone()).unwrap();
    serves(&open().renewing_after(Duration::ZERO), &|digest, bytes| {
        runtime.block_on(async {
            let bucket = context.get_object_store("artefacts").await.unwrap();
            bucket.put(digest.to_string().as_str(), &mut &bytes[..]).await.unwrap();
        });
    });
    assert!(open().has(&ArtefactDigest::of(b"the right bytes")).unwrap(), "it is opened, not made");
}

/// Set in the process that has the credentials in its environment.
const OWN_PROCESS: &str = "SEGWILD_TEST_S3";

#[test]
fn a_bucket_of_s3_serves() {
    if let Ok(url) = std::env::var(OWN_PROCESS) {
        let store = ObjectArtefacts::open("s3://farm/some/prefix").unwrap();
        return serves(&store.renewing_after(Duration::ZERO), &|digest, bytes| {
            servers::put(&url, &format!("/farm/some/prefix/{}", key(digest)), bytes);
        });
    }
    let Some(server) = servers::s3() else {
        return println!("skipped: a_bucket_of_s3_serves: no moto_server");
    };
    let output = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "artefacts::stores::a_bucket_of_s3_serves", "--nocapture"])
        .env(OWN_PROCESS, &server.url)
        .env("AWS_ENDPOINT_URL", &server.url)
        .env("AWS_REGION", "us-east-1")
        .env("AWS_ACCESS_KEY_ID", "key-of-the-test")
        .env("AWS_SECRET_ACCESS_KEY", "secret-of-the-test")
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (out, error) = (text(&output.stdout), text(&output.stderr));
    println!("{out}");
    assert!(output.status.success() && out.contains("1 passed"), "{out}\n{error}");
    assert!(!(out + &error).contains("secret-of-the-test"));
}

#[test]
fn addresses_that_make_no_sense_are_refused() {
    for address in
        ["", "ftp://host/folder", "s3://", "s3:///prefix", "s3://key:secret@bucket", "file://host/x"]
    {
        let error = ObjectArtefacts::open(address).unwrap_err();
        assert!(matches!(error, ArtefactError::Address { .. }), "{address}: {error}");
    }
}
