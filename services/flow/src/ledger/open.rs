//! How a ledger's file is opened: tables made or checked.

use std::path::Path;
use std::time::Duration;

use rusqlite::{Connection, OpenFlags};

use super::error::LedgerError;
use super::schema::{APPLICATION, LIVE_TABLES, SCHEMA_VERSION, TABLES};
use crate::database::refuse_strange_schema;

// Opening for reading without a lock is what a status command does; writing through such a handle is refused.
const READ_FLAGS: OpenFlags =
    OpenFlags::SQLITE_OPEN_READ_ONLY.union(OpenFlags::SQLITE_OPEN_NO_MUTEX).union(OpenFlags::SQLITE_OPEN_URI);

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
    connection.execute_batch(LIVE_TABLES).map_err(error)
}

/// Refuses files that are not a ledger of this version.
pub(super) fn check(connection: &Connection, path: &Path) -> Result<(), LedgerError> {
    let error = |e| LedgerError::sqlite(path, e);
    refuse_strange_schema(connection).map_err(error)?;
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
