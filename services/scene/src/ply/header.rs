//! The form of a `.ply` file: its header, and the values of its elements.

use super::element::{Element, PropertyShape};
use super::values::{Format, Type};
use crate::SceneError;
use std::path::Path;

/// A property of the rows of a table.
struct Property {
    name: String,
    kind: Type,
    offset: usize,
}

/// More properties than any program writes; a header with more is damaged or hostile.
const MOST_PROPERTIES: usize = 1000;
/// Most comment lines that are kept, and elements: programs write a few of each.
const MOST_COMMENTS: usize = 100;
const MOST_ELEMENTS: usize = 100;

/// The header of a `.ply`: what it declares, in the order in which it is stored.
pub(crate) struct Header {
    format: Format,
    /// The comments, without the word `comment` or `obj_info`.
    pub(crate) comments: Vec<String>,
    elements: Vec<Element>,
    /// Lines of the header, and its bytes.
    lines: usize,
    length: usize,
}

impl Header {
    /// Reads the header at the start of a file.
    pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<Header, SceneError> {
        let invalid =
            |line: usize, reason: String| SceneError::invalid(path, format!("header line {line}"), reason);
        let mut at = 0;
        let mut number = 0;
        let mut format = None;
        let mut comments = Vec::new();
        let mut elements: Vec<Element> = Vec::new();
        loop {
            number += 1;
            let rest = &bytes[at..];
            // A line of a header is short; a file without line ends is not searched to its end.
            let Some(length) = rest.iter().take(4096).position(|&b| b == b'\n') else {
                return Err(invalid(
                    number,
                    "the header does not end; this is no PLY file, or it is cut short".into(),
                ));
            };
            let line = String::from_utf8_lossy(&rest[..length]);
            at += length + 1;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words[..] {
                ["ply"] if number == 1 => {}
                _ if number == 1 => return Err(invalid(1, "the file does not begin with `ply`".into())),
                ["comment" | "obj_info", ref words @ ..] if comments.len() < MOST_COMMENTS => {
                    comments.push(words.join(" "));
                }
                [] | ["comment" | "obj_info", ..] => {}
                ["format", "ascii", _] => format = Some(Format::Text),
                ["format", "binary_little_endian", _] => format = Some(Format::Little),
                ["format", "binary_big_endian", _] => format = Some(Format::Big),
                ["element", name, count] => {
                    let count =
                        count.parse().map_err(|_| invalid(number, format!("`{count}` is no count")))?;
                    if elements.iter().any(|element| element.name == name) {
                        return Err(invalid(number, format!("the element `{name}` is declared twice")));
                    }
                    if elements.len() == MOST_ELEMENTS {
                        return Err(invalid(number, format!("more than {MOST_ELEMENTS} elements")));
                    }
                    elements.push(Element::new(name, count, number));
                }
                ["property", ref words @ ..] if !elements.is_empty() => {
                    let last = elements.last_mut().map(|element| element.add(words));
                    if last.transpose().map_err(|e| invalid(number, e.to_string()))? > Some(MOST_PROPERTIES) {
                        return Err(invalid(number, format!("more than {MOST_PROPERTIES} properties")));
                    }
                }
                ["end_header"] => break,
                _ => return Err(invalid(number, format!("`{}` is not understood", line.trim()))),
            }
        }
        let format = format.ok_or_else(|| invalid(number, "there is no `format` line".into()))?;
        Ok(Header { format, comments, elements, lines: number, length: at })
    }

    /// The element of a name.
    pub(crate) fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|element| element.name == name)
    }

    /// The rows of an element, after a check that those it promises are there. Elements before and after it are passed over.
    ///
    /// # Errors
    /// When there is no such element, it is cut short, or its values are no numbers.
    pub(crate) fn table<'a>(
        &self,
        path: &Path,
        bytes: &'a [u8],
        name: &str,
    ) -> Result<ElementTable<'a>, SceneError> {
        let invalid =
            |line: usize, reason: String| SceneError::invalid(path, format!("header line {line}"), reason);
        let Some(index) = self.elements.iter().position(|element| element.name == name) else {
            return Err(invalid(self.lines, format!("there is no `element {name}` line")));
        };
        let element = &self.elements[index];
        let count = element.count;
        let mut properties: Vec<Property> = Vec::new();
        let mut stride = 0;
        for (i, (name, shape)) in element.properties.iter().enumerate() {
            let line = element.line + i + 1;
            let PropertyShape::Scalar(kind) = *shape else {
                return Err(invalid(
                    line,
                    format!("{} property `{name}` is a list, which splats do not have", element.name),
                ));
            };
            if properties.iter().any(|p| p.name == *name) {
                return Err(invalid(line, format!("property `{name}` is declared twice")));
            }
            properties.push(Property { name: name.clone(), kind, offset: stride });
            stride += kind.size();
        }
        if properties.is_empty() && count > 0 {
            return Err(invalid(element.line, format!("the element `{name}` has no properties")));
        }
        let (mut at, mut lines) = (self.length, self.lines);
        for element in &self.elements[..index] {
            let Some(length) = element.length(self.format, &bytes[at..]) else {
                let reason = format!(
                    "the file ends within its {} `{}`, which come before `{name}`",
                    element.count, element.name
                );
                return Err(SceneError::invalid(path, format!("byte {at}"), reason));
            };
            lines += bytes[at..at + length].iter().filter(|&&b| b == b'\n').count();
            at += length;
        }
        let body = &bytes[at..];
        // In text every value takes a character and a separator at least.
        let least = if self.format == Format::Text { 2 * properties.len() } else { stride } as u64;
        // The last line of a text need not end.
        let space = body.len() as u64 + u64::from(self.format == Format::Text);
        if count.saturating_mul(least) > space {
            let held = space / least.max(1);
            return Err(SceneError::Truncated {
                path: path.to_owned(),
                record: format!("{name} {} of {count}", held + 1),
                offset: at as u64 + held * least,
                needed: least,
                left: space - held * least,
            });
        }
        let rows = count as usize;
        let data = match self.format {
            Format::Little => Data::Little(&body[..rows * stride]),
            Format::Big => Data::Big(&body[..rows * stride]),
            Format::Text => Data::Text(parse_body(path, name, lines, body, rows, &properties)?),
        };
        Ok(ElementTable { properties, rows, stride, data })
    }
}

/// The rows of an element.
pub(crate) struct ElementTable<'a> {
    properties: Vec<Property>,
    rows: usize,
    stride: usize,
    data: Data<'a>,
}

enum Data<'a> {
    Little(&'a [u8]),
    Big(&'a [u8]),
    Text(Vec<f64>),
}

impl<'a> ElementTable<'a> {
    /// The vertices of a file.
    pub(crate) fn vertices(path: &Path, bytes: &'a [u8]) -> Result<ElementTable<'a>, SceneError> {
        Header::parse(path, bytes)?.table(path, bytes, "vertex")
    }

    pub(crate) fn len(&self) -> usize {
        self.rows
    }

    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.properties.iter().map(|p| p.name.as_str())
    }

    pub(crate) fn column(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name)
    }

    /// One value. An f32 goes through f64 and back without a change of bits, unless it is a signalling NaN.
    pub(crate) fn value(&self, row: usize, column: usize) -> f64 {
        let property = &self.properties[column];
        let (format, bytes) = match &self.data {
            Data::Text(values) => return values[row * self.properties.len() + column],
            Data::Little(bytes) => (Format::Little, bytes),
            Data::Big(bytes) => (Format::Big, bytes),
        };
        property.kind.value(format, &bytes[row * self.stride + property.offset..])
    }

    /// Whether the values of a column need not be whole numbers.
    pub(crate) fn is_float(&self, column: usize) -> bool {
        matches!(self.properties[column].kind, Type::F32 | Type::F64)
    }
}

fn parse_body(
    path: &Path,
    element: &str,
    header_lines: usize,
    body: &[u8],
    rows: usize,
    properties: &[Property],
) -> Result<Vec<f64>, SceneError> {
    let text = std::str::from_utf8(body).map_err(|e| {
        SceneError::invalid(path, format!("byte {}", e.valid_up_to()), "the text is not UTF-8")
    })?;
    let mut values = Vec::with_capacity(rows * properties.len());
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
    for row in 0..rows {
        let Some((i, line)) = lines.next() else {
            let reason = format!("the file ends after {row} of {rows} rows");
            return Err(SceneError::invalid(path, format!("{element} {}", row + 1), reason));
        };
        let mut words = line.split_whitespace();
        for property in properties {
            let word = words.next().unwrap_or("");
            let Some(value) = property.kind.parse(word) else {
                let reason = format!("`{word}` is no value of `{}`", property.name);
                return Err(SceneError::invalid(path, format!("line {}", header_lines + i + 1), reason));
            };
            values.push(value);
        }
    }
    Ok(values)
}
