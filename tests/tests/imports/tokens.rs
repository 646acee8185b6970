//! A source as tokens: names, `::`, and single characters; no comments, and literals without their text.

/// What stands for a literal.
pub const LITERAL: &str = "\"\"";

/// The tokens of a source.
pub fn tokens(text: &str) -> Vec<&str> {
    let mut found = Vec::new();
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let length = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if rest.starts_with("/*") {
            block_comment(rest)
        } else if let Some(length) = literal(rest) {
            found.push(LITERAL);
            length
        } else if first == '\'' {
            // A lifetime or a label.
            1 + name(&rest[1..])
        } else if first.is_alphanumeric() || first == '_' {
            let length = name(rest);
            found.push(&rest[..length]);
            length
        } else if rest.starts_with("::") {
            found.push("::");
            2
        } else {
            if !first.is_whitespace() {
                found.push(&rest[..first.len_utf8()]);
            }
            first.len_utf8()
        };
        rest = &rest[length..];
    }
    found
}

fn name(text: &str) -> usize {
    text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len())
}

/// The length of the comment that a text starts with; comments in it have an end of their own.
fn block_comment(text: &str) -> usize {
    let (mut depth, mut at) = (0, 0);
    while at < text.len() {
        let (step, change) = match &text.as_bytes()[at..] {
            [b'/', b'*', ..] => (2, 1),
            [b'*', b'/', ..] => (2, -1),
            _ => (1, 0),
        };
        at += step;
        depth += change;
        if depth == 0 {
            break;
        }
    }
    at
}

/// The length of the string or character that a text starts with.
fn literal(text: &str) -> Option<usize> {
    let bytes = text.as_bytes();
    let prefix = bytes.iter().take_while(|b| b"bcr".contains(b)).count();
    let hashes = bytes[prefix..].iter().take_while(|&&b| b == b'#').count();
    match bytes.get(prefix + hashes) {
        Some(b'"') if bytes[..prefix].contains(&b'r') => {
            let start = prefix + hashes + 1;
            let end = format!("\"{}", "#".repeat(hashes));
            Some(text[start..].find(&end).map_or(text.len(), |n| start + n + end.len()))
        }
        Some(b'"') if hashes == 0 => {
            let mut at = prefix + 1;
            while at < bytes.len() && bytes[at] != b'"' {
                at += if bytes[at] == b'\\' { 2 } else { 1 };
            }
            Some((at + 1).min(bytes.len()))
        }
        Some(b'\'') if hashes == 0 && prefix <= 1 => character(&text[prefix..]).map(|n| prefix + n),
        _ => None,
    }
}

/// The length of the character that a text starts with; none for a lifetime, which has no second quote.
fn character(text: &str) -> Option<usize> {
    let mut letters = text.char_indices().skip(1);
    if letters.next()?.1 == '\\' {
        letters.next();
        return letters.find(|(_, c)| *c == '\'').map(|(at, _)| at + 1);
    }
    letters.next().filter(|(_, c)| *c == '\'').map(|(at, _)| at + 1)
}

#[test]
fn comments_and_the_text_of_literals_are_left_out() {
    assert_eq!(tokens("a::b(x); // crate::c"), ["a", "::", "b", "(", "x", ")", ";"]);
    assert_eq!(tokens("/* a /* b */ c */ d"), ["d"]);
    assert_eq!(tokens(r##"f("a\"b", r#"c"d"#, 'e', '\'', b"g", b'h')"##).len(), 14);
    assert_eq!(tokens("fn f<'a>(x: &'a str)"), ["fn", "f", "<", ">", "(", "x", ":", "&", "str", ")"]);
    assert_eq!(tokens("['ä', '\\u{1f}']"), ["[", LITERAL, ",", LITERAL, "]"]);
}
