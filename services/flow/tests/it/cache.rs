//! The cache's promises.

use std::fs;
use std::thread;

use segwild_flow::{Cache, CacheError, Key, MakeError, Origin, codec};

fn key(name: &str) -> Key {
    Key::of("masks").part("photo", name).finish()
}

#[derive(Debug, thiserror::Error)]
#[error("no network")]
struct NoNetwork;

#[test]
fn what_is_put_is_got_by_another_handle() {
    let folder = tempfile::tempdir().unwrap();
    Cache::open(folder.path()).unwrap().put(&key("a"), b"bytes").unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    assert_eq!(cache.get(&key("a")).unwrap().unwrap(), b"bytes");
    assert_eq!(cache.get(&key("b")).unwrap(), None);
    let counters = cache.counters();
    assert_eq!((counters.hits, counters.misses, counters.corrupt, counters.bytes_read), (1, 1, 0, 5));
    assert_eq!(fs::read_dir(folder.path().join("tmp")).unwrap().count(), 0, "nothing is left aside");
}

#[test]
fn every_kind_of_damage_is_a_miss_and_is_repaired() {
    type DamageBytes = fn(&mut Vec<u8>);
    let damages: [(&str, DamageBytes); 5] = [
        ("a flipped bit", |b| *b.last_mut().unwrap() ^= 1),
        ("torn", |b| b.truncate(b.len() / 2)),
        ("empty", |b| b.clear()),
        ("zeros, as after a power cut", |b| b.fill(0)),
        ("longer", |b| b.push(0)),
    ];
    for (what, damage) in damages {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(folder.path()).unwrap();
        let value = vec![3.5f32; 1000];
        let make = || Ok::<_, NoNetwork>(value.clone());
        assert_eq!(cache.get_or_make(&key("a"), "values/1", make).unwrap().1, Origin::Made);
        let path = cache.path(&key("a"));
        let mut bytes = fs::read(&path).unwrap();
        damage(&mut bytes);
        fs::write(&path, bytes).unwrap();
        assert_eq!(
            cache.get_or_make(&key("a"), "values/1", make).unwrap(),
            (value.clone(), Origin::Made),
            "{what}"
        );
        assert_eq!(
            cache.get_or_make(&key("a"), "values/1", make).unwrap(),
            (value.clone(), Origin::Cache),
            "{what}"
        );
        let counters = cache.counters();
        assert_eq!((counters.corrupt, counters.hits, counters.misses), (1, 1, 2), "{what}");
        assert_eq!(
            fs::read_dir(folder.path().join("corrupt")).unwrap().count(),
            1,
            "{what}: kept for inspection"
        );

        // Bytes without a type have no other guard than the cache's own.
        cache.put(&key("raw"), &[7; 1000]).unwrap();
        let path = cache.path(&key("raw"));
        let mut bytes = fs::read(&path).unwrap();
        damage(&mut bytes);
        fs::write(&path, bytes).unwrap();
        assert_eq!(cache.get(&key("raw")).unwrap(), None, "{what}");
        assert!(!cache.contains(&key("raw")), "{what}: moved aside");
    }
}

#[test]
fn a_typed_artefact_has_the_bytes_of_its_record() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    let values: Vec<f32> = (0..100_000).map(|i| i as f32).collect();
    let record = codec::encode("values/1", &values).unwrap();
    cache.put(&key("whole"), &record).unwrap();
    cache.put_typed(&key("streamed"), "values/1", &values).unwrap();
    let file = |name: &str| fs::read(cache.path(&key(name))).unwrap();
    assert!(file("whole") == file("streamed"));
    assert_eq!(cache.counters().bytes_written, 2 * record.len() as u64);
    assert_eq!(cache.get(&key("streamed")).unwrap(), Some(record));
    assert_eq!(fs::read_dir(folder.path().join("tmp")).unwrap().count(), 0, "nothing is left aside");
}

#[test]
fn another_kind_under_the_key_is_damage() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    cache.put_typed(&key("a"), "values/1", &1u32).unwrap();
    assert_eq!(cache.get_typed::<u32>(&key("a"), "values/2").unwrap(), None);
    assert_eq!(cache.counters().corrupt, 1);
}

#[test]
fn what_cannot_be_made_is_not_stored() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    let made = cache.get_or_make::<u32, _>(&key("a"), "values/1", || Err(NoNetwork));
    assert!(matches!(made, Err(MakeError::Make(NoNetwork))));
    assert!(!cache.contains(&key("a")));
}

#[test]
fn writers_and_readers_of_one_key_do_not_meet() {
    let folder = tempfile::tempdir().unwrap();
    let value: Vec<u32> = (0..20_000).collect();
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                // A handle each, as if in processes of their own.
                let cache = Cache::open(folder.path()).unwrap();
                for _ in 0..10 {
                    cache.put_typed(&key("a"), "values/1", &value).unwrap();
                    assert!(cache.get_typed::<Vec<u32>>(&key("a"), "values/1").unwrap().unwrap() == value);
                }
                assert_eq!((cache.counters().corrupt, cache.counters().hits), (0, 10));
            });
        }
    });
}

#[test]
fn a_folder_that_cannot_be_written_is_reported_and_still_read() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::open(folder.path().join("cache")).unwrap();
    cache.put(&key("a"), b"kept").unwrap();
    let all: Vec<_> = [cache.root().to_path_buf(), cache.root().join("tmp")]
        .into_iter()
        .chain(cache.path(&key("a")).ancestors().skip(1).take(2).map(|p| p.to_path_buf()))
        .collect();
    let mode =
        |mode| all.iter().for_each(|p| fs::set_permissions(p, fs::Permissions::from_mode(mode)).unwrap());
    mode(0o555);
    if fs::write(cache.root().join("probe"), b"").is_ok() {
        mode(0o755);
        eprintln!(
            "skipped: a_folder_that_cannot_be_written_is_reported_and_still_read: this user may write anywhere"
        );
        return;
    }
    let error = cache.put(&key("b"), b"lost").unwrap_err();
    assert!(error.to_string().contains("permission denied"), "{error}");
    assert_eq!(cache.get(&key("a")).unwrap().unwrap(), b"kept");
    mode(0o755);
}

#[test]
fn a_cache_in_the_way_of_a_file_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("file"), b"x").unwrap();
    let Err(CacheError::File(error)) = Cache::open(folder.path().join("file/cache")) else {
        panic!("opened a cache below a file");
    };
    assert!(error.to_string().starts_with("cannot create the cache folder"), "{error}");
}

#[test]
fn damage_is_reported_once_and_remembered() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    let (report, reports) = std::sync::mpsc::channel();
    cache.clone().on_damage(move |key, reason| report.send(format!("{key} {reason}")).unwrap());
    cache.put(&key("a"), b"bytes").unwrap();
    for _ in 0..2 {
        fs::write(cache.path(&key("a")), "torn").unwrap();
        assert_eq!(cache.get(&key("a")).unwrap(), None);
    }
    assert!(cache.was_damaged(&key("a")) && !cache.was_damaged(&key("b")));
    let words: Vec<String> = reports.try_iter().collect();
    assert_eq!(words, [format!("{} it is shorter than its header", key("a"))]);
}
