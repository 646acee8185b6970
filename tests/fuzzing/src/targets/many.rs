//! Files of batches.

use crate::yard::{folder, put, take};
use crate::{FuzzTarget, seal, seeds};
use segwild_farm::{BatchManifest, EmbeddedEngine, ErrorClass, Job, JobEngine, Needs, WorkerOffer};

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
