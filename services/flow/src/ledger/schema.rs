//! The ledger's tables and their version.

use std::path::Path;
use std::time::Duration;

use rusqlite::Connection;

use super::{LedgerError, READ_FLAGS};

/// Version of the tables. Another one is refused: there is nothing to guess about what a run has done.
pub const SCHEMA_VERSION: i64 = 1;

/// Marks the file as ours (`PRAGMA application_id`): "SGWL".
const APPLICATION: i64 = 0x5347_574C;

const TABLES: &str = "
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

fn number(connection: &Connection, pragma: &str) -> rusqlite::Result<i64> {
    connection.pragma_query_value(None, pragma, |row| row.get(0))
}

/// Makes the tables in a new file, or checks those of an old one.
pub(super) fn prepare(connection: &mut Connection, path: &Path) -> Result<(), LedgerError> {
    let error = |e| LedgerError::sqlite(path, e);
    let tables: i64 =
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0)).map_err(error)?;
    let new = tables == 0 && number(connection, "user_version").map_err(error)? == 0;
    if !new {
        check(connection, path)?;
    }
    connection.pragma_update(None, "journal_mode", "WAL").map_err(error)?;
    if new {
        // All or nothing: a kill leaves an empty file, which is new again.
        let mut make = || {
            let transaction = connection.transaction()?;
            transaction.execute_batch(TABLES)?;
            transaction.pragma_update(None, "application_id", APPLICATION)?;
            transaction.pragma_update(None, "user_version", SCHEMA_VERSION)?;
            transaction.commit()
        };
        make().map_err(error)?;
    }
    // An addition that older versions of the program ignore.
    connection.execute_batch(super::live_rows::TABLES).map_err(error)
}

/// Refuses files that are not a ledger of this version.
pub(super) fn check(connection: &Connection, path: &Path) -> Result<(), LedgerError> {
    let error = |e| LedgerError::sqlite(path, e);
    if number(connection, "application_id").map_err(error)? != APPLICATION {
        let reason = "another program's database".into();
        return Err(LedgerError::Damaged { path: path.to_path_buf(), reason });
    }
    let found = number(connection, "user_version").map_err(error)?;
    if found != SCHEMA_VERSION {
        return Err(LedgerError::Version { path: path.to_path_buf(), found });
    }
    Ok(())
}

/// Opens for reading. In a folder that cannot be written SQLite cannot keep its shared memory; where no writer
/// left anything unmerged, the file is then read as it is.
pub(super) fn open_for_reading(path: &Path) -> Result<Connection, LedgerError> {
    let error = |e| LedgerError::sqlite(path, e);
    let connection = Connection::open_with_flags(path, READ_FLAGS).map_err(error)?;
    connection.busy_timeout(Duration::from_secs(10)).map_err(error)?;
    let Err(first) = number(&connection, "user_version") else { return Ok(connection) };
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    let unmerged = std::fs::metadata(Path::new(&log)).is_ok_and(|m| m.len() > 0);
    let cannot_open = matches!(
        first.sqlite_error_code(),
        Some(rusqlite::ErrorCode::CannotOpen | rusqlite::ErrorCode::ReadOnly)
    );
    if unmerged || !cannot_open {
        return Err(error(first));
    }
    let escaped = path.to_string_lossy().replace('%', "%25").replace('?', "%3f").replace('#', "%23");
    let connection =
        Connection::open_with_flags(format!("file:{escaped}?immutable=1"), READ_FLAGS).map_err(error)?;
    number(&connection, "user_version").map_err(error)?;
    Ok(connection)
}
