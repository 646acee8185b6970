//! The secret of a service.

use std::fmt;
use tonic::metadata::{Ascii, MetadataMap, MetadataValue};

/// Bytes of a token.
const TOKEN_BYTES: usize = 24;

/// Letters of a token from a file, at least.
const SHORTEST: usize = 16;

/// The scheme under which programs send a token.
const SCHEME: &str = "Bearer ";

/// A secret that a client must know.
#[derive(Clone)]
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

impl Token {
    /// A new one, by the system's generator of secrets.
    ///
    /// # Errors
    /// When the system has none.
    pub fn random() -> Result<Token, std::io::Error> {
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(|e| std::io::Error::other(e.to_string()))?;
        Ok(Token(bytes.iter().map(|b| format!("{b:02x}")).collect()))
    }

    /// One that a person chose: at least 16 letters, digits, dashes or underscores.
    pub fn of(text: &str) -> Option<Token> {
        let text = text.trim();
        let plain = text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        (plain && text.len() >= SHORTEST && text.len() <= 256).then(|| Token(text.to_owned()))
    }

    /// Its text.
    pub fn text(&self) -> &str {
        &self.0
    }

    /// Whether a client's text is the token. The time it takes says nothing about where they differ.
    pub fn is(&self, text: &str) -> bool {
        let (own, given) = (blake3::hash(self.0.as_bytes()), blake3::hash(text.as_bytes()));
        own == given
    }

    /// What a client sends as `authorization`.
    pub fn credentials(&self) -> MetadataValue<Ascii> {
        let mut value: MetadataValue<Ascii> =
            format!("{SCHEME}{}", self.0).parse().expect("a token has plain letters only");
        value.set_sensitive(true);
        value
    }

    /// Checks what a client sent.
    ///
    /// # Errors
    /// When the token is missing or another one.
    pub fn check(&self, sent: &MetadataMap) -> Result<(), UnknownToken> {
        let sent = sent.get("authorization").and_then(|value| value.to_str().ok());
        match sent.and_then(|value| value.strip_prefix(SCHEME)).is_some_and(|text| self.is(text)) {
            true => Ok(()),
            false => Err(UnknownToken),
        }
    }
}

/// A client does not know the token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UnknownToken;

impl From<UnknownToken> for tonic::Status {
    fn from(_: UnknownToken) -> tonic::Status {
        tonic::Status::unauthenticated("the token is missing or another one")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_long_and_differ() {
        let (a, b) = (Token::random().unwrap(), Token::random().unwrap());
        assert!(a.text() != b.text() && a.text().len() == 2 * TOKEN_BYTES);
        assert!(a.is(a.text()) && !a.is(b.text()) && !a.is(""));
        assert_eq!(format!("{a:?}"), "Token(..)");
        for refused in ["short", "with space and more text", "semi;colon;semi;colon", ""] {
            assert!(Token::of(refused).is_none(), "{refused}");
        }
        assert_eq!(Token::of(" a-long-enough-token\n").unwrap().text(), "a-long-enough-token");
    }

    #[test]
    fn a_call_passes_with_the_token_only() {
        let (own, other) = (Token::random().unwrap(), Token::random().unwrap());
        let mut sent = MetadataMap::new();
        assert_eq!(own.check(&sent), Err(UnknownToken));
        sent.insert("authorization", other.credentials());
        assert_eq!(own.check(&sent), Err(UnknownToken));
        sent.insert("authorization", own.credentials());
        assert_eq!(own.check(&sent), Ok(()));
        assert!(!format!("{sent:?}").contains(own.text()), "it is not logged");
    }
}
