//! What the header of a `.ply` declares of an element, and how many bytes an element takes that is passed over.

use super::values::{Format, Type};

/// Why the property of a header line is not understood.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PropertyError {
    #[error("`{0}` is no type of a property")]
    UnknownType(String),
    #[error("a property has a type and a name")]
    Malformed,
}

/// An element as the header declares it.
pub(crate) struct Element {
    pub name: String,
    /// Rows.
    pub count: u64,
    /// The line of the header that declares it; a line per property follows.
    pub(super) line: usize,
    pub(super) properties: Vec<(String, PropertyShape)>,
}

#[derive(Clone, Copy)]
pub(super) enum PropertyShape {
    Scalar(Type),
    /// A number of values, of this type, and the values, of that one.
    List(Type, Type),
}

impl Element {
    pub(super) fn new(name: &str, count: u64, line: usize) -> Element {
        Element { name: name.to_owned(), count, line, properties: Vec::new() }
    }

    /// Names of its properties.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.properties.iter().map(|(name, _)| name.as_str())
    }

    /// Whether it has a property of this name.
    pub(crate) fn has(&self, name: &str) -> bool {
        self.names().any(|n| n == name)
    }

    /// Adds the property of a header line without the word `property`; the number of properties.
    pub(super) fn add(&mut self, words: &[&str]) -> Result<usize, PropertyError> {
        let kind =
            |word: &str| Type::from_name(word).ok_or_else(|| PropertyError::UnknownType(word.to_owned()));
        let (name, shape) = match *words {
            ["list", count, item, name] => (name, PropertyShape::List(kind(count)?, kind(item)?)),
            [scalar, name] => (name, PropertyShape::Scalar(kind(scalar)?)),
            _ => return Err(PropertyError::Malformed),
        };
        self.properties.push((name.to_owned(), shape));
        Ok(self.properties.len())
    }

    /// Bytes of the element at the start of `body`; `None` where it is cut short.
    pub(super) fn length(&self, format: Format, body: &[u8]) -> Option<usize> {
        if self.properties.is_empty() {
            return Some(0);
        }
        if format == Format::Text {
            return lines(self.count, body);
        }
        if let Some(row) = self.fixed() {
            let length = usize::try_from(self.count.checked_mul(row)?).ok()?;
            return (length <= body.len()).then_some(length);
        }
        let mut at = 0;
        // Each row takes a byte at least, so that the body bounds the loop.
        for _ in 0..self.count {
            for (_, shape) in &self.properties {
                at += shape.length(format, body.get(at..)?)?;
            }
        }
        (at <= body.len()).then_some(at)
    }

    /// Bytes of a row, if all rows have as many.
    fn fixed(&self) -> Option<u64> {
        let size = |(_, shape): &(String, PropertyShape)| match shape {
            PropertyShape::Scalar(kind) => Some(kind.size() as u64),
            PropertyShape::List(..) => None,
        };
        self.properties.iter().map(size).sum()
    }
}

impl PropertyShape {
    fn length(self, format: Format, body: &[u8]) -> Option<usize> {
        match self {
            PropertyShape::Scalar(kind) => Some(kind.size()),
            PropertyShape::List(count, item) => {
                let n = count.value(format, body.get(..count.size())?);
                let n = (n >= 0.0 && n <= body.len() as f64).then_some(n as usize)?;
                count.size().checked_add(n.checked_mul(item.size())?)
            }
        }
    }
}

/// Bytes of so many lines that are not empty.
fn lines(count: u64, body: &[u8]) -> Option<usize> {
    let mut at = 0;
    let mut left = count;
    while left > 0 {
        let rest = body.get(at..).filter(|rest| !rest.is_empty())?;
        let length = rest.iter().position(|&b| b == b'\n').map_or(rest.len(), |end| end + 1);
        left -= u64::from(!rest[..length].trim_ascii().is_empty());
        at += length;
    }
    Some(at)
}
