//! The YAML that `deploy/` is written in: mappings and lists in blocks and in braces, quoted and plain scalars, text blocks,
//! anchors, aliases and merges. What it does not know is refused, with the line. Tests of the program include it by `#[path]`.

use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// The documents of a file.
pub fn documents(text: &str) -> Result<Vec<Value>, String> {
    let mut documents = Vec::new();
    let mut before = 0;
    let lines: Vec<&str> = text.lines().collect();
    for part in lines.split(|line| *line == "---") {
        let mut reader = YamlReader {
            lines: part.iter().map(ToString::to_string).collect(),
            at: 0,
            anchors: BTreeMap::new(),
        };
        let placed =
            |reader: &YamlReader, reason: String| format!("line {}: {reason}", before + reader.at + 1);
        if reader.peek().map_err(|reason| placed(&reader, reason))?.is_some() {
            let read = reader.block(0).and_then(|value| match reader.peek()? {
                None => Ok(value),
                Some((_, left)) => Err(format!("`{left}` belongs to nothing")),
            });
            documents.push(read.map_err(|reason| placed(&reader, reason))?);
        }
        before += part.len() + 1;
    }
    Ok(documents)
}

struct YamlReader {
    lines: Vec<String>,
    at: usize,
    anchors: BTreeMap<String, Value>,
}

impl YamlReader {
    /// The indentation and the text of the next line that has one, without its comment.
    fn peek(&mut self) -> Result<Option<(usize, String)>, String> {
        while let Some(line) = self.lines.get(self.at) {
            let text = without_comment(line).trim_end();
            let inner = text.trim_start();
            if inner.is_empty() {
                self.at += 1;
                continue;
            }
            if text.contains('\t') {
                return Err("it has a tab".into());
            }
            return Ok(Some((text.len() - inner.len(), inner.to_owned())));
        }
        Ok(None)
    }

    /// A mapping or a list whose lines are indented by so much.
    fn block(&mut self, indent: usize) -> Result<Value, String> {
        match self.peek()? {
            Some((_, text)) if is_item(&text) => self.list(indent),
            _ => self.mapping(indent),
        }
    }

    fn list(&mut self, indent: usize) -> Result<Value, String> {
        let mut items = Vec::new();
        while let Some((at, text)) = self.peek()? {
            if at < indent || at == indent && !is_item(&text) {
                break;
            }
            if at > indent {
                return Err(format!("`{text}` is indented too far"));
            }
            let rest = text[1..].trim_start();
            if rest.is_empty() {
                return Err("an item is empty".into());
            }
            if key_of(rest)?.is_some() {
                // A mapping that starts on the line of its item: as if the dash were a space.
                let column = at + text.len() - rest.len();
                self.lines[self.at] = " ".repeat(column) + rest;
                items.push(self.mapping(column)?);
            } else {
                self.at += 1;
                items.push(self.value(rest, indent)?);
            }
        }
        Ok(Value::Array(items))
    }

    fn mapping(&mut self, indent: usize) -> Result<Value, String> {
        let (mut map, mut merged) = (Map::new(), Map::new());
        while let Some((at, text)) = self.peek()? {
            if at < indent || is_item(&text) {
                break;
            }
            if at > indent {
                return Err(format!("`{text}` is indented too far"));
            }
            let Some((key, rest)) = key_of(&text)? else { return Err(format!("`{text}` has no key")) };
            self.at += 1;
            let value = self.value(rest.trim_start(), indent)?;
            match (key.as_str(), value) {
                ("<<", Value::Object(more)) => merged.extend(more),
                ("<<", _) => return Err("only a mapping can be merged".into()),
                (_, value) => {
                    if map.insert(key.clone(), value).is_some() {
                        return Err(format!("`{key}` is there twice"));
                    }
                }
            }
        }
        merged.extend(map);
        Ok(Value::Object(merged))
    }

    /// The value after a key or a dash, on its line or below it.
    fn value(&mut self, rest: &str, indent: usize) -> Result<Value, String> {
        if let Some(named) = rest.strip_prefix('&') {
            let (name, rest) = named.split_once(' ').unwrap_or((named, ""));
            let value = self.value(rest.trim_start(), indent)?;
            self.anchors.insert(name.to_owned(), value.clone());
            return Ok(value);
        }
        if let Some(name) = rest.strip_prefix('*') {
            return self.anchors.get(name).cloned().ok_or_else(|| format!("nothing is called &{name}"));
        }
        if rest.is_empty() {
            return match self.peek()? {
                Some((at, _)) if at > indent => self.block(at),
                Some((at, text)) if at == indent && is_item(&text) => self.list(at),
                _ => Ok(Value::Null),
            };
        }
        if rest.starts_with(['|', '>']) {
            return Ok(self.text_block(rest, indent));
        }
        if !rest.starts_with(['{', '[', '"', '\'']) {
            return plain(rest);
        }
        match flow(rest)? {
            (value, after) if after.trim().is_empty() => Ok(value),
            (_, after) => Err(format!("`{after}` follows a value")),
        }
    }

    /// Lines that are text, whatever they hold.
    fn text_block(&mut self, head: &str, indent: usize) -> Value {
        let mut lines: Vec<String> = Vec::new();
        let mut own = None;
        while let Some(line) = self.lines.get(self.at) {
            let deep = line.len() - line.trim_start().len();
            if !line.trim().is_empty() && deep <= indent {
                break;
            }
            let cut = *own.get_or_insert(deep);
            lines.push(line.get(cut..).unwrap_or_default().to_owned());
            self.at += 1;
        }
        Value::String(lines.join(if head.starts_with('>') { " " } else { "\n" }))
    }
}

fn is_item(text: &str) -> bool {
    text == "-" || text.starts_with("- ")
}

/// A line up to its comment: a `#` at the start or after a space, outside of quotes.
fn without_comment(line: &str) -> &str {
    let (mut quote, mut before) = (None, ' ');
    for (i, c) in line.char_indices() {
        match quote {
            Some(open) if c == open && before != '\\' => quote = None,
            Some(_) => {}
            None if c == '#' && before == ' ' => return &line[..i],
            None if matches!(c, '"' | '\'') && matches!(before, ' ' | '[' | '{' | ',') => quote = Some(c),
            None => {}
        }
        before = c;
    }
    line
}

/// The key that a line starts with, and what follows its colon; `None` where it has none.
fn key_of(text: &str) -> Result<Option<(String, &str)>, String> {
    if text.starts_with(['"', '\'']) {
        let (key, rest) = quoted(text)?;
        return Ok(rest.strip_prefix(':').map(|rest| (key, rest)));
    }
    if text.starts_with(['{', '[', '&', '*']) {
        return Ok(None);
    }
    let colon = text.find(": ").or_else(|| text.ends_with(':').then(|| text.len() - 1));
    Ok(colon.map(|at| (text[..at].to_owned(), &text[at + 1..])))
}

/// A quoted text at the start, and what follows it.
fn quoted(text: &str) -> Result<(String, &str), String> {
    let mut chars = text.char_indices();
    let Some((_, quote)) = chars.next() else { return Err("a text is missing".into()) };
    let mut value = String::new();
    while let Some((i, c)) = chars.next() {
        let after = &text[i + c.len_utf8()..];
        match c {
            '\\' if quote == '"' => match chars.next() {
                Some((_, 'n')) => value.push('\n'),
                Some((_, c @ ('"' | '\\'))) => value.push(c),
                _ => return Err(format!("`{text}` has an unknown escape")),
            },
            // Twice, it is one of the text.
            '\'' if quote == '\'' && after.starts_with('\'') => {
                chars.next();
                value.push(c);
            }
            c if c == quote => return Ok((value, after)),
            c => value.push(c),
        }
    }
    Err(format!("`{text}` is not closed"))
}

/// A value in braces, in brackets, in quotes or alone in one of them, and what follows it.
fn flow(text: &str) -> Result<(Value, &str), String> {
    let text = text.trim_start();
    if let Some(rest) = text.strip_prefix('[') {
        let mut items = Vec::new();
        let rest = entries(rest, ']', |rest| {
            let (item, rest) = flow(rest)?;
            items.push(item);
            Ok(rest)
        })?;
        return Ok((Value::Array(items), rest));
    }
    if let Some(rest) = text.strip_prefix('{') {
        let mut map = Map::new();
        let rest = entries(rest, '}', |rest| {
            let Some((key, rest)) = key_of(rest)? else { return Err(format!("`{rest}` has no key")) };
            let (value, rest) = flow(rest)?;
            match map.insert(key.clone(), value) {
                None => Ok(rest),
                Some(_) => Err(format!("`{key}` is there twice")),
            }
        })?;
        return Ok((Value::Object(map), rest));
    }
    if text.starts_with(['"', '\'']) {
        return quoted(text).map(|(text, rest)| (Value::String(text), rest));
    }
    let end = text.find([',', ']', '}']).unwrap_or(text.len());
    Ok((plain(text[..end].trim_end())?, &text[end..]))
}

/// Reads entries with commas between them up to a closing sign; returns what follows it.
fn entries<'a>(
    mut rest: &'a str,
    close: char,
    mut entry: impl FnMut(&'a str) -> Result<&'a str, String>,
) -> Result<&'a str, String> {
    loop {
        rest = rest.trim_start();
        if let Some(after) = rest.strip_prefix(close) {
            return Ok(after);
        }
        rest = entry(rest)?.trim_start();
        match rest.strip_prefix(',') {
            Some(after) => rest = after,
            None if rest.starts_with(close) => {}
            None => return Err(format!("`{close}` is missing before `{rest}`")),
        }
    }
}

/// A scalar without quotes.
fn plain(text: &str) -> Result<Value, String> {
    if text.starts_with(['!', '%', '@', '`']) || text.contains(": ") {
        return Err(format!("`{text}` needs quotes"));
    }
    let number = text.strip_prefix('-').unwrap_or(text);
    // One with leading zeros is none in JSON.
    let padded = number.len() > 1 && number.starts_with('0') && !number.starts_with("0.");
    Ok(match text {
        "" | "~" | "null" => Value::Null,
        "true" => Value::Bool(true),
        "false" => Value::Bool(false),
        _ if number.starts_with(|c: char| c.is_ascii_digit()) && !padded => {
            serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()))
        }
        _ => Value::String(text.to_owned()),
    })
}
