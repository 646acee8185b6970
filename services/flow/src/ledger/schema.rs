//! The ledger's tables and their version.

/// Version of the tables. Another one is refused: there is nothing to guess about what a run has done.
pub const SCHEMA_VERSION: i64 = 1;

/// Marks the file as ours (`PRAGMA application_id`): "SGWL".
pub(super) const APPLICATION: i64 = 0x5347_574C;

pub(super) const TABLES: &str = "
CREATE TABLE stages (
  name TEXT PRIMARY KEY, key TEXT NOT NULL, state TEXT NOT NULL, started REAL, ended REAL, cpu_s REAL,
  error TEXT, runs INTEGER NOT NULL
);
CREATE TABLE views (
  stage TEXT NOT NULL, view TEXT NOT NULL, key TEXT NOT NULL, state TEXT NOT NULL, attempts INTEGER NOT NULL,
  seconds REAL, error TEXT, time REAL NOT NULL, PRIMARY KEY (stage, view)
) WITHOUT ROWID;
CREATE TABLE checkpoints (
  stage TEXT NOT NULL, key TEXT NOT NULL, step INTEGER NOT NULL, file TEXT NOT NULL, digest TEXT NOT NULL,
  time REAL NOT NULL, PRIMARY KEY (stage, key, step)
) WITHOUT ROWID;
CREATE TABLE events (
  id INTEGER PRIMARY KEY, time REAL NOT NULL, level TEXT NOT NULL, stage TEXT, message TEXT NOT NULL
);
CREATE TABLE settings (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
";

/// The tables of the live view: an addition that older versions of the program ignore.
pub(super) const LIVE_TABLES: &str = "
CREATE TABLE IF NOT EXISTS live (
  id INTEGER PRIMARY KEY CHECK (id = 1), time REAL NOT NULL, pid INTEGER NOT NULL, began REAL NOT NULL,
  moved REAL NOT NULL, rss_bytes INTEGER, peak_rss_bytes INTEGER, threads INTEGER, cpu_s REAL,
  cache_hits INTEGER NOT NULL, cache_misses INTEGER NOT NULL, cache_corrupt INTEGER NOT NULL,
  cache_bytes_read INTEGER NOT NULL, cache_bytes_written INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS actors (
  name TEXT PRIMARY KEY, place INTEGER NOT NULL, exit TEXT NOT NULL, error TEXT, messages INTEGER NOT NULL,
  retries INTEGER NOT NULL, restarts INTEGER NOT NULL, quarantined INTEGER NOT NULL, last_error TEXT,
  starting_s REAL NOT NULL, busy_s REAL NOT NULL, waiting_s REAL NOT NULL, blocked_s REAL NOT NULL,
  back_off_s REAL NOT NULL, cpu_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS workers (
  actor TEXT NOT NULL, worker INTEGER NOT NULL, state TEXT NOT NULL, item TEXT NOT NULL, since REAL NOT NULL,
  stuck INTEGER NOT NULL, PRIMARY KEY (actor, worker)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS mailboxes (
  name TEXT PRIMARY KEY, place INTEGER NOT NULL, depth INTEGER NOT NULL, bytes INTEGER NOT NULL,
  capacity INTEGER NOT NULL, capacity_bytes INTEGER NOT NULL, high_water INTEGER NOT NULL,
  high_water_bytes INTEGER NOT NULL, sent INTEGER NOT NULL, received INTEGER NOT NULL,
  held_back INTEGER NOT NULL, waiting_senders INTEGER NOT NULL, back_pressure_s REAL NOT NULL,
  closed INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS progress (
  stage TEXT PRIMARY KEY, place INTEGER NOT NULL, done INTEGER NOT NULL, total INTEGER, rate REAL NOT NULL,
  eta_s REAL
);
CREATE TABLE IF NOT EXISTS parts (stage TEXT PRIMARY KEY, part TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS metrics (
  stage TEXT NOT NULL, name TEXT NOT NULL, value REAL NOT NULL, step INTEGER, PRIMARY KEY (stage, name)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS samples (
  time REAL PRIMARY KEY, rss_bytes INTEGER, cpu_s REAL, done INTEGER NOT NULL, rate REAL NOT NULL,
  depth INTEGER NOT NULL, back_pressure_s REAL NOT NULL
) WITHOUT ROWID;
";
