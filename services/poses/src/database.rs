//! COLMAP's database, read only: which photos have features, and which pairs show the same.

use crate::PosesError;
use rusqlite::{Connection, OpenFlags};
use segwild_flow::database::refuse_strange_schema;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// COLMAP numbers a pair as `smaller * PAIR + larger` of the ids of its images (`Database::kMaxNumImages`).
const PAIR: i64 = 2_147_483_647;

/// A photo in the database.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ImageRow {
    id: i64,
    /// Its camera.
    pub camera: i64,
    /// Its features; `None` where they were not computed.
    pub features: Option<u64>,
}

/// The pair of a photo that agrees best: the other photo, and how many of its features.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct BestPair {
    pub other: String,
    pub matches: u64,
}

/// COLMAP's database.
pub(crate) struct Database {
    path: PathBuf,
    connection: Connection,
}

impl Database {
    /// Opens it; `None` where there is none.
    pub fn open(path: &Path) -> Result<Option<Database>, PosesError> {
        if !path.is_file() {
            return Ok(None);
        }
        let failed = |source| PosesError::Database { path: path.to_owned(), source };
        let connection =
            Connection::open_with_flags(path, OpenFlags::SQLITE_OPEN_READ_ONLY).map_err(failed)?;
        // COLMAP makes tables and indexes.
        refuse_strange_schema(&connection).map_err(failed)?;
        Ok(Some(Database { path: path.to_owned(), connection }))
    }

    fn failed(&self) -> impl Fn(rusqlite::Error) -> PosesError + '_ {
        |source| PosesError::Database { path: self.path.clone(), source }
    }

    /// The photos, by name; none where COLMAP has not made its tables yet.
    pub fn images(&self) -> Result<BTreeMap<String, ImageRow>, PosesError> {
        let made = "SELECT EXISTS (SELECT 1 FROM sqlite_master WHERE name = 'descriptors')";
        if !self.connection.query_row(made, [], |row| row.get::<_, bool>(0)).map_err(self.failed())? {
            return Ok(BTreeMap::new());
        }
        // COLMAP takes a photo for done once it has both.
        let sql = "SELECT name, images.image_id, camera_id, MIN(keypoints.rows, descriptors.rows) FROM images
                   LEFT JOIN keypoints ON keypoints.image_id = images.image_id
                   LEFT JOIN descriptors ON descriptors.image_id = images.image_id";
        let mut statement = self.connection.prepare(sql).map_err(self.failed())?;
        let rows = statement.query_map([], |row| {
            let features: Option<i64> = row.get(3)?;
            let features = features.map(|rows| rows.max(0) as u64);
            Ok((row.get(0)?, ImageRow { id: row.get(1)?, camera: row.get(2)?, features }))
        });
        rows.and_then(Iterator::collect).map_err(self.failed())
    }

    /// For each photo, the pair whose matches agree in one geometry most; photos without one are left out.
    pub fn best_pairs(
        &self,
        images: &BTreeMap<String, ImageRow>,
    ) -> Result<HashMap<String, BestPair>, PosesError> {
        let names: HashMap<i64, &String> = images.iter().map(|(name, row)| (row.id, name)).collect();
        let sql = "SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0 ORDER BY rows, pair_id";
        let mut statement = self.connection.prepare(sql).map_err(self.failed())?;
        let rows = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?))).map_err(self.failed())?;
        let mut best = HashMap::new();
        for row in rows {
            let (pair, matches): (i64, i64) = row.map_err(self.failed())?;
            let (Some(a), Some(b)) = (names.get(&(pair / PAIR)), names.get(&(pair % PAIR))) else { continue };
            // The last one that is inserted has most.
            for (name, other) in [(a, b), (b, a)] {
                best.insert((*name).clone(), BestPair { other: (*other).clone(), matches: matches as u64 });
            }
        }
        Ok(best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A database as COLMAP 3.8 makes it, as far as it is read here.
    fn database(dir: &Path) -> PathBuf {
        let path = dir.join("colmap.db");
        let connection = Connection::open(&path).unwrap();
        connection
            .execute_batch(
                "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
                 CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER);
                 CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, rows INTEGER);
                 CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);
                 INSERT INTO images VALUES (1, 'a.jpg', 7), (2, 'b.jpg', 7), (3, 'c.jpg', 8);
                 INSERT INTO keypoints VALUES (1, 900), (2, 800);
                 INSERT INTO descriptors VALUES (1, 900);
                 INSERT INTO two_view_geometries VALUES (2147483649, 40), (2147483650, 16), (4294967297, 0);",
            )
            .unwrap();
        path
    }

    #[test]
    fn photos_have_features_once_both_tables_have_them() {
        let dir = tempfile::tempdir().unwrap();
        let images = Database::open(&database(dir.path())).unwrap().unwrap().images().unwrap();
        let features: Vec<Option<u64>> = images.values().map(|row| row.features).collect();
        assert_eq!(features, [Some(900), None, None]);
        assert_eq!(images["b.jpg"].camera, 7);
    }

    #[test]
    fn the_best_pair_of_a_photo_is_the_one_with_most_matches() {
        let dir = tempfile::tempdir().unwrap();
        let database = Database::open(&database(dir.path())).unwrap().unwrap();
        let best = database.best_pairs(&database.images().unwrap()).unwrap();
        assert_eq!(best["a.jpg"], BestPair { other: "b.jpg".into(), matches: 40 });
        assert_eq!(best["c.jpg"], BestPair { other: "a.jpg".into(), matches: 16 });
    }

    #[test]
    fn a_database_that_is_empty_or_missing_has_no_photos() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("colmap.db");
        assert!(Database::open(&path).unwrap().is_none());
        Connection::open(&path).unwrap().execute_batch("CREATE TABLE cameras (id INTEGER)").unwrap();
        assert!(Database::open(&path).unwrap().unwrap().images().unwrap().is_empty());
        std::fs::write(&path, "no database at all, whatever its name says").unwrap();
        let refused = Database::open(&path).and_then(|database| database.unwrap().images());
        assert!(refused.unwrap_err().to_string().contains("colmap.db"));
    }

    #[test]
    fn a_view_in_somebody_elses_database_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = database(dir.path());
        let view = "DROP TABLE images; CREATE VIEW images AS SELECT 1 AS image_id, 'a' AS name;";
        Connection::open(&path).unwrap().execute_batch(view).unwrap();
        let message = Database::open(&path).map(drop).unwrap_err().to_string();
        assert!(message.contains("view `images`") && message.contains("remove the folder"), "{message}");
    }

    #[test]
    fn an_index_in_colmaps_own_database_is_no_reason_to_refuse_it() {
        let dir = tempfile::tempdir().unwrap();
        let path = database(dir.path());
        let index = "CREATE UNIQUE INDEX IF NOT EXISTS index_name ON images (name);
                     CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL);";
        Connection::open(&path).unwrap().execute_batch(index).unwrap();
        assert_eq!(Database::open(&path).unwrap().unwrap().images().unwrap().len(), 3);
    }
}
