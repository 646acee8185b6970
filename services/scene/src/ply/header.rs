//! The form of a `.ply` file: header, and the values of its vertices.

use super::before::Element;
use super::values::{Format, Type};
use crate::SceneError;
use std::path::Path;

struct Property {
    name: String,
    kind: Type,
    offset: usize,
}

/// More properties than any program writes; a header with more is damaged or hostile.
const MOST_PROPERTIES: usize = 1000;

/// The vertices of a `.ply`.
pub(super) struct VertexTable<'a> {
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

impl<'a> VertexTable<'a> {
    /// Reads the header, checks that the vertices it promises are there, and finds them. Elements before and after the
    /// vertices are passed over.
    pub(super) fn parse(path: &Path, bytes: &'a [u8]) -> Result<VertexTable<'a>, SceneError> {
        let invalid =
            |line: usize, reason: String| SceneError::invalid(path, format!("header line {line}"), reason);
        let mut at = 0;
        let mut number = 0;
        let mut format = None;
        let mut vertices: Option<u64> = None;
        let mut other = false;
        let mut before: Vec<Element> = Vec::new();
        let mut properties: Vec<Property> = Vec::new();
        let mut stride = 0;
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
                [] | ["comment" | "obj_info", ..] => {}
                ["format", "ascii", _] => format = Some(Format::Text),
                ["format", "binary_little_endian", _] => format = Some(Format::Little),
                ["format", "binary_big_endian", _] => format = Some(Format::Big),
                ["element", "vertex", count] => {
                    other = false;
                    let count =
                        count.parse().map_err(|_| invalid(number, format!("`{count}` is no count")))?;
                    if vertices.replace(count).is_some() {
                        return Err(invalid(number, "the vertices are declared twice".into()));
                    }
                }
                ["element", name, count] => {
                    other = true;
                    if vertices.is_none() {
                        let count =
                            count.parse().map_err(|_| invalid(number, format!("`{count}` is no count")))?;
                        before.push(Element::new(name, count));
                    }
                }
                ["property", ref words @ ..] if other && vertices.is_none() => {
                    let last = before.last_mut().map(|element| element.add(words));
                    if last.transpose().map_err(|e| invalid(number, e.to_string()))? > Some(MOST_PROPERTIES) {
                        return Err(invalid(number, format!("more than {MOST_PROPERTIES} properties")));
                    }
                }
                ["property", ..] if other => {}
                ["property", "list", .., name] => {
                    return Err(invalid(
                        number,
                        format!("vertex property `{name}` is a list, which splats do not have"),
                    ));
                }
                ["property", kind, name] if vertices.is_some() => {
                    let Some(kind) = Type::from_name(kind) else {
                        return Err(invalid(number, format!("`{kind}` is no type of a property")));
                    };
                    if properties.iter().any(|p| p.name == name) {
                        return Err(invalid(number, format!("property `{name}` is declared twice")));
                    }
                    if properties.len() == MOST_PROPERTIES {
                        return Err(invalid(number, format!("more than {MOST_PROPERTIES} properties")));
                    }
                    properties.push(Property { name: name.to_owned(), kind, offset: stride });
                    stride += kind.size();
                }
                ["end_header"] => break,
                _ => return Err(invalid(number, format!("`{}` is not understood", line.trim()))),
            }
        }
        let format = format.ok_or_else(|| invalid(number, "there is no `format` line".into()))?;
        let count = vertices.ok_or_else(|| invalid(number, "there is no `element vertex` line".into()))?;
        if properties.is_empty() && count > 0 {
            return Err(invalid(number, "the vertices have no properties".into()));
        }
        let mut lines = number;
        for element in &before {
            let Some(length) = element.length(format, &bytes[at..]) else {
                let reason = format!(
                    "the file ends within its {} `{}`, which come before the vertices",
                    element.count, element.name
                );
                return Err(SceneError::invalid(path, format!("byte {at}"), reason));
            };
            lines += bytes[at..at + length].iter().filter(|&&b| b == b'\n').count();
            at += length;
        }
        let body = &bytes[at..];
        // In text every value takes a character and a separator at least.
        let least = if format == Format::Text { 2 * properties.len() } else { stride } as u64;
        // The last line of a text need not end.
        let space = body.len() as u64 + u64::from(format == Format::Text);
        if count.saturating_mul(least) > space {
            let held = space / least.max(1);
            return Err(SceneError::Truncated {
                path: path.to_owned(),
                record: format!("vertex {} of {count}", held + 1),
                offset: at as u64 + held * least,
                needed: least,
                left: space - held * least,
            });
        }
        let rows = count as usize;
        let data = match format {
            Format::Little => Data::Little(&body[..rows * stride]),
            Format::Big => Data::Big(&body[..rows * stride]),
            Format::Text => Data::Text(parse_body(path, lines, body, rows, &properties)?),
        };
        Ok(VertexTable { properties, rows, stride, data })
    }

    pub(super) fn len(&self) -> usize {
        self.rows
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.properties.iter().map(|p| p.name.as_str())
    }

    pub(super) fn column(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name)
    }

    /// One value. An f32 goes through f64 and back without a change of bits, unless it is a signalling NaN.
    pub(super) fn value(&self, row: usize, column: usize) -> f64 {
        let property = &self.properties[column];
        let (format, bytes) = match &self.data {
            Data::Text(values) => return values[row * self.properties.len() + column],
            Data::Little(bytes) => (Format::Little, bytes),
            Data::Big(bytes) => (Format::Big, bytes),
        };
        property.kind.value(format, &bytes[row * self.stride + property.offset..])
    }

    /// Whether the values of a column need not be whole numbers.
    pub(super) fn is_float(&self, column: usize) -> bool {
        matches!(self.properties[column].kind, Type::F32 | Type::F64)
    }
}

fn parse_body(
    path: &Path,
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
            let reason = format!("the file ends after {row} of {rows} vertices");
            return Err(SceneError::invalid(path, format!("vertex {}", row + 1), reason));
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
