//! SQLite files that somebody else may have made: what their schema says is not trusted.

use rusqlite::{Connection, Error, OptionalExtension, ffi};

/// What is neither a table with pages of its own nor an index: a view, a trigger, a virtual table. How these texts begin,
/// SQLite writes itself.
const STRANGE: &str = "
SELECT CASE type WHEN 'view' THEN type WHEN 'trigger' THEN type WHEN 'table' THEN 'virtual table' ELSE 'row' END,
  substr(CAST(coalesce(name, '') AS TEXT), 1, 60)
FROM sqlite_schema WHERE NOT coalesce(
  type = 'table' AND sql LIKE 'CREATE TABLE %'
  OR type = 'index' AND (sql IS NULL OR sql LIKE 'CREATE INDEX %' OR sql LIKE 'CREATE UNIQUE INDEX %'), 0)
LIMIT 1";

/// Refuses a file whose schema has more than tables and indexes: a view or a trigger runs what its maker wrote, and may
/// never end. To be called before anything else of the file is read or written.
///
/// ```
/// use segwild_flow::database::refuse_strange_schema;
/// let connection = rusqlite::Connection::open_in_memory().unwrap();
/// connection.execute_batch("CREATE TABLE stages (name TEXT PRIMARY KEY)").unwrap();
/// assert!(refuse_strange_schema(&connection).is_ok());
/// connection.execute_batch("CREATE VIEW events AS SELECT 1").unwrap();
/// assert!(refuse_strange_schema(&connection).unwrap_err().to_string().contains("view `events`"));
/// ```
///
/// # Errors
/// In words, as a damaged file: what it has. Also SQLite's own.
pub fn refuse_strange_schema(connection: &Connection) -> rusqlite::Result<()> {
    // Functions with side effects then do not run in checks and defaults either.
    connection.pragma_update(None, "trusted_schema", false)?;
    let strange: Option<(String, String)> =
        connection.query_row(STRANGE, [], |row| Ok((row.get(0)?, row.get(1)?))).optional()?;
    match strange {
        None => Ok(()),
        Some((kind, name)) => {
            let name = name.escape_debug();
            let words = format!("it has the {kind} `{name}`, and such a file has only tables and indexes");
            Err(Error::SqliteFailure(ffi::Error::new(ffi::SQLITE_CORRUPT), Some(words)))
        }
    }
}
