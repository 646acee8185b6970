//! Files of batches.

use crate::yard::{folder, put, take};
use crate::{FuzzTarget, seal, seeds};
use prost::Message;
use segwild_farm::{
    BatchManifest, EmbeddedEngine, ErrorClass, FarmScene, FolderLimits, FolderManifest, Job, JobEngine,
    JobTable, Needs, WorkerOffer, transitions,
};
use segwild_proto::v1;

pub(super) const MANIFEST: FuzzTarget = FuzzTarget {
    name: "manifest_toml",
    seeds: || {
        let scene = seeds::scene_for("manifest_toml", "bin");
        let text = format!(
            "[budget]\ncores = 2\nmemory = \"4 GiB\"\naccelerators = 0\npatience = 600\n[defaults]\npreset = \"draft\"\n\
             attempts = 3\nsettings = {{ size = 32 }}\n[[scene]]\npath = \"{0}\"\npriority = 5\ncores = 1\n[[scene]]\n\
             path = \"{0}\"\nname = \"other\"\nuntil = 500\nmemory = \"1 GiB\"\nsettings = {{ steps = 10 }}\n",
            scene.display()
        );
        vec![text.into_bytes()]
    },
    words: &[
        "[[scene]]\n",
        "name = \"../x\"\n",
        "out = \"o/../o\"\n",
        "\"99999999 GiB\"",
        "-1",
        "nan",
        "[defaults]\n",
        "\u{feff}",
        "''",
    ],
    seal: seal::nothing,
    read: |bytes| {
        let folder = folder("manifest_toml");
        let file = folder.join("batch.toml");
        put(&file, bytes);
        let _ = BatchManifest::read(&file, &folder.join("out"), None);
    },
};

fn job(name: &str) -> Job {
    let payload = format!(
        "{{\"name\": \"{name}\", \"path\": \"/a\", \"out\": \"/b\", \"settings\": {{}}, \"until\": null}}"
    );
    let needs = Needs { cores: 1, memory_bytes: 1 << 30, accelerators: 0 };
    Job { priority: 1, ..Job::new(name, payload, needs) }
}

/// A batch of two scenes, one of which is being worked on and one of which has failed.
fn batch() -> Vec<u8> {
    let file = folder("batch_sqlite_seed").join("batch.sqlite");
    let made = || -> Result<(), segwild_farm::EngineError> {
        let engine = EmbeddedEngine::open(&file)?;
        let free = Needs { cores: 4, memory_bytes: 8 << 30, accelerators: 0 };
        let offer = WorkerOffer::all("batch 1", free, 1e9);
        for name in ["one", "two"] {
            engine.publish(&job(name))?;
        }
        engine.claim(&offer)?;
        if let Some(lease) = engine.claim(&offer)? {
            engine.fail(&lease, ErrorClass::Retryable, "no luck")?;
        }
        Ok(())
    };
    made().unwrap_or_else(|e| panic!("{e}"));
    take(&file)
}

pub(super) const BATCH: FuzzTarget = FuzzTarget {
    name: "batch_sqlite",
    seeds: || vec![batch()],
    words: &["SQLite format 3\0", "leased", "pending", "dead", "retryable", "{\"name\":", "\0\0\0\0"],
    seal: seal::nothing,
    read: |bytes| {
        let folder = folder("batch_sqlite");
        let file = folder.join("batch.sqlite");
        for beside in ["batch.sqlite-wal", "batch.sqlite-shm", "batch.sqlite-journal"] {
            // Most of the time there is none.
            let _ = std::fs::remove_file(folder.join(beside));
        }
        put(&file, bytes);
        super::run_files::open_all(&folder);
        if let Ok(engine) = EmbeddedEngine::open(&file) {
            let _ = (engine.release(None, "fuzzed"), engine.jobs(), engine.watch(0, 100), engine.jumps());
        }
    },
};

/// A digest, as text.
const DIGEST: &str = "abababababababababababababababababababababababababababababababab";

pub(super) const FARM_RECORD: FuzzTarget = FuzzTarget {
    name: "farm_record",
    seeds: || {
        use v1::job_transition::Change;
        let job = || "night/a".to_owned();
        let payload = format!("{{\"photos\": \"{DIGEST}\", \"settings\": {{\"size\": \"96\"}}}}");
        let published = v1::FarmJob { id: job(), payload, attempts: 3, cores: 1, ..v1::FarmJob::default() };
        let changes = [
            Change::Published(published),
            Change::Claimed(v1::JobClaimed { job: job(), worker: "w".into(), lease_s: 60.0 }),
            Change::Waited(v1::JobWaited { job: job(), reason: Some("in use".into()) }),
            Change::Stored(v1::JobStored { job: job(), checkpoint: DIGEST.into() }),
            Change::ClockSet(v1::ClockSet { seconds: -5.0, since: 3 }),
            Change::Failed(v1::JobFailed { job: job(), class: 1, error: "no luck".into() }),
            Change::Expired(v1::JobNamed { job: job() }),
        ];
        let transitions = changes.map(|change| v1::JobTransition { change: Some(change) }).to_vec();
        let (id, writer) = ("2".into(), "w".into());
        let record =
            v1::FarmRecord { id, after: "1".into(), transitions, writer, ..v1::FarmRecord::default() };
        vec![record.encode_to_vec()]
    },
    words: &["night/../a", "onnxruntime", "\u{ff}\u{ff}\u{ff}\u{7f}"],
    seal: seal::nothing,
    read: |bytes| {
        let mut table = JobTable::default();
        for (i, transition) in transitions(bytes, "farm", None).unwrap_or_default().iter().enumerate() {
            table.apply(transition, 1e9 + i as f64, i as u64);
        }
        for status in table.jobs() {
            let _ = FarmScene::of_job(&status.job);
        }
        let everything = Needs { cores: u32::MAX, memory_bytes: u64::MAX, accelerators: u32::MAX };
        drop(table.claim(&WorkerOffer::all("w", everything, 60.0), 2e9));
    },
};

pub(super) const FARM_FOLDER: FuzzTarget = FuzzTarget {
    name: "farm_folder",
    seeds: || {
        let entry = |path: &str| format!("{{\"path\": \"{path}\", \"digest\": \"{DIGEST}\", \"bytes\": 5}}");
        let files = [entry("images/a.jpg"), entry("sparse/0/images.bin")].join(", ");
        vec![format!("{{\"format\": 1, \"files\": [{files}]}}").into_bytes()]
    },
    words: &["../", "/etc/passwd", "C:\\\\", "con.txt", "\\u0000", "18446744073709551615"],
    seal: seal::nothing,
    read: |bytes| {
        let Ok(manifest) = FolderManifest::parse(bytes, &FolderLimits::default()) else { return };
        for file in manifest.files() {
            let inside = !file.path.starts_with('/')
                && file.path.split('/').all(|part| !matches!(part, "" | "." | ".."));
            assert!(inside, "{}", file.path);
        }
    },
};
