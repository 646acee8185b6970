//! Names of artefacts: the hash of everything that determines their bytes.

use std::fmt;
use std::fs::File;
use std::path::Path;

use crate::files::FileError;

/// Version of the way keys are made; part of every key.
pub const KEY_VERSION: u32 = 1;

/// The name of an artefact: same key, same bytes.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Key {
    domain: &'static str,
    hash: [u8; 32],
}

impl Key {
    /// Starts a key. The domain says what the artefact is (`masks`); it separates the keys of different
    /// artefacts made from the same parts and names their folder in the cache.
    ///
    /// ```
    /// use segwild_flow::Key;
    /// let key = Key::of("masks").part("photo", b"..jpeg..").value("size", 320).part("model", "builtin/1").finish();
    /// let same = Key::of("masks").part("model", "builtin/1").value("size", 320).part("photo", b"..jpeg..").finish();
    /// let other = Key::of("sky").part("photo", b"..jpeg..").value("size", 320).part("model", "builtin/1").finish();
    /// assert_eq!(key, same);
    /// assert_ne!(key, other);
    /// ```
    pub fn of(domain: &'static str) -> KeyBuilder {
        KeyBuilder { domain, parts: Vec::new() }
    }

    /// A key from its text, as the ledger keeps it; `None` if it is none of this domain.
    ///
    /// ```
    /// use segwild_flow::Key;
    /// let key = Key::of("masks").part("photo", b"..jpeg..").finish();
    /// assert_eq!(Key::parse("masks", &key.to_string()), Some(key));
    /// assert_eq!(Key::parse("sky", &key.to_string()), None);
    /// ```
    pub fn parse(domain: &'static str, text: &str) -> Option<Key> {
        let hex = text.strip_prefix(domain)?.strip_prefix(':')?;
        Some(Key { domain, hash: *blake3::Hash::from_hex(hex).ok()?.as_bytes() })
    }

    /// What the artefact is.
    pub fn domain(&self) -> &'static str {
        self.domain
    }

    /// The hash of all parts.
    pub fn hash(&self) -> &[u8; 32] {
        &self.hash
    }

    /// The hash as 64 hexadecimal digits.
    pub fn hex(&self) -> String {
        blake3::Hash::from_bytes(self.hash).to_hex().to_string()
    }
}

/// `domain:hash`, as the ledger keeps it.
impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.domain, self.hex())
    }
}

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.domain, &self.hex()[..12])
    }
}

/// Gathers the named parts of a key; their order does not matter.
#[derive(Clone, Debug)]
pub struct KeyBuilder {
    domain: &'static str,
    parts: Vec<(String, [u8; 32])>,
}

impl KeyBuilder {
    /// Adds bytes or text under a name.
    #[must_use]
    pub fn part(mut self, name: &str, value: impl AsRef<[u8]>) -> Self {
        self.parts.push((name.into(), *blake3::hash(value.as_ref()).as_bytes()));
        self
    }

    /// Adds a number or another value by its text.
    #[must_use]
    pub fn value(self, name: &str, value: impl fmt::Display) -> Self {
        self.part(name, value.to_string())
    }

    /// Adds another artefact on which this one depends.
    #[must_use]
    pub fn key(self, name: &str, key: &Key) -> Self {
        self.part(name, key.to_string())
    }

    /// Adds a file's bytes, read in pieces.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn file(mut self, name: &str, path: &Path) -> Result<Self, FileError> {
        let mut hasher = blake3::Hasher::new();
        File::open(path)
            .and_then(|file| hasher.update_reader(file).map(|_| ()))
            .map_err(|e| FileError::new("read", path, e))?;
        self.parts.push((name.into(), *hasher.finalize().as_bytes()));
        Ok(self)
    }

    /// The key of all parts.
    pub fn finish(mut self) -> Key {
        self.parts.sort();
        let mut hasher = blake3::Hasher::new_derive_key("segwild artefact key 1");
        hasher.update(&KEY_VERSION.to_le_bytes());
        // Every string is preceded by its length, so that no two lists of parts read the same.
        let mut text = |text: &str| {
            hasher.update(&(text.len() as u64).to_le_bytes());
            hasher.update(text.as_bytes());
        };
        text(self.domain);
        for (name, _) in &self.parts {
            text(name);
        }
        for (_, hash) in &self.parts {
            hasher.update(hash);
        }
        Key { domain: self.domain, hash: *hasher.finalize().as_bytes() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_do_not_run_into_each_other() {
        let a = Key::of("d").part("ab", "c").finish();
        let b = Key::of("d").part("a", "bc").finish();
        let c = Key::of("da").part("b", "c").finish();
        let d = Key::of("d").part("ab", "").part("", "c").finish();
        let keys = [a, b, c, d];
        for i in 0..keys.len() {
            for j in 0..i {
                assert_ne!(keys[i], keys[j], "{i} {j}");
            }
        }
    }

    #[test]
    fn a_file_is_its_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("photo");
        std::fs::write(&path, b"bytes").unwrap();
        let by_file = Key::of("d").file("photo", &path).unwrap().finish();
        assert_eq!(by_file, Key::of("d").part("photo", b"bytes").finish());
        assert!(Key::of("d").file("photo", &folder.path().join("none")).is_err());
    }
}
