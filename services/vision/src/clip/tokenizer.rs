//! CLIP's tokenizer: byte pairs over lower-case words (Radford et al. 2021, section 2.4; Sennrich et al. 2016).
//!
//! A text is split into words. The bytes of a word are its first pieces, and the last one is marked as a word's end. The pair of
//! neighbours that stands first in the list of merges becomes one piece, until no pair is in the list. Texts are not normalised to
//! composed characters, which the tokenizers of Hugging Face do.

use crate::clip_file_error::TokenizerError;
use serde::Deserialize;
use std::collections::HashMap;

/// Tokens, and merges, of a tokenizer at most; CLIP has 49,408.
const MOST_ENTRIES: usize = 1 << 20;
/// Characters of a text that are read; no encoder takes as many tokens.
const MOST_CHARACTERS: usize = 1024;
/// Marks the end of a word.
const WORD_END: &str = "</w>";
const START: &str = "<|startoftext|>";
const END: &str = "<|endoftext|>";
/// Ends of English words that are words of their own.
const SHORTENED: [&str; 7] = ["'s", "'t", "'re", "'ve", "'m", "'ll", "'d"];

/// CLIP's tokenizer.
#[derive(Debug)]
pub struct ClipTokenizer {
    numbers: HashMap<String, u32>,
    /// Where each merge stands in the list, by its two pieces with a space in the middle.
    ranks: HashMap<String, usize>,
    /// The character that stands for each byte.
    characters: [char; 256],
    start: u32,
    end: u32,
}

/// `tokenizer.json`, as far as it is read.
#[derive(Deserialize)]
struct TokenizerJson {
    model: BytePairsJson,
    #[serde(default)]
    added_tokens: Vec<AddedToken>,
}

#[derive(Deserialize)]
struct BytePairsJson {
    #[serde(default)]
    vocab: HashMap<String, u32>,
    #[serde(default)]
    merges: Vec<WrittenMerge>,
}

/// A merge, in the two forms in which versions of `tokenizers` write it.
#[derive(Deserialize)]
#[serde(untagged)]
enum WrittenMerge {
    Line(String),
    Pair(String, String),
}

#[derive(Deserialize)]
struct AddedToken {
    id: u32,
    content: String,
}

impl ClipTokenizer {
    /// Reads `tokenizer.json`.
    ///
    /// # Errors
    /// When it is none of CLIP.
    pub fn of_json(bytes: &[u8]) -> Result<ClipTokenizer, TokenizerError> {
        // The vocabulary of another type of tokenizer has another form.
        #[derive(Deserialize)]
        struct TokenizerType {
            model: Option<ModelType>,
        }
        #[derive(Deserialize)]
        struct ModelType {
            #[serde(rename = "type")]
            kind: Option<String>,
        }
        let found: TokenizerType = serde_json::from_slice(bytes).map_err(TokenizerError::Json)?;
        let kind = found.model.and_then(|model| model.kind);
        if let Some(kind) = kind.filter(|kind| kind != "BPE") {
            return Err(TokenizerError::Type(kind.chars().take(40).collect()));
        }
        let TokenizerJson { model, added_tokens } =
            serde_json::from_slice(bytes).map_err(TokenizerError::Json)?;
        let mut numbers = model.vocab;
        numbers.extend(added_tokens.into_iter().map(|token| (token.content, token.id)));
        let merges = model.merges.into_iter().map(|merge| match merge {
            WrittenMerge::Line(line) => line,
            WrittenMerge::Pair(first, second) => format!("{first} {second}"),
        });
        ClipTokenizer::new(numbers, merges)
    }

    /// Reads `vocab.json` and `merges.txt`.
    ///
    /// # Errors
    /// When they are none of CLIP.
    pub fn of_parts(vocabulary: &[u8], merges: &[u8]) -> Result<ClipTokenizer, TokenizerError> {
        let numbers = serde_json::from_slice(vocabulary).map_err(TokenizerError::Json)?;
        let lines = std::str::from_utf8(merges).map_err(|_| TokenizerError::NoText)?.lines();
        let lines = lines.enumerate().filter(|(i, line)| !(*i == 0 && line.starts_with('#')));
        let lines = lines.map(|(_, line)| line.trim_end()).filter(|line| !line.is_empty());
        ClipTokenizer::new(numbers, lines.map(str::to_owned))
    }

    fn new(
        numbers: HashMap<String, u32>,
        merges: impl Iterator<Item = String>,
    ) -> Result<ClipTokenizer, TokenizerError> {
        let mut ranks = HashMap::new();
        for (rank, merge) in merges.enumerate() {
            if rank == MOST_ENTRIES {
                return Err(TokenizerError::TooMany(MOST_ENTRIES));
            }
            let pieces = merge.split(' ').collect::<Vec<_>>();
            if !matches!(pieces[..], [first, second] if !first.is_empty() && !second.is_empty()) {
                let text = merge.chars().take(40).collect();
                return Err(TokenizerError::Merge { number: rank + 1, text });
            }
            ranks.entry(merge).or_insert(rank);
        }
        if numbers.len() > MOST_ENTRIES {
            return Err(TokenizerError::TooMany(MOST_ENTRIES));
        }
        if !ranks.keys().any(|merge| merge.ends_with(WORD_END)) {
            return Err(TokenizerError::NoWordEnds);
        }
        let token =
            |name: &str| numbers.get(name).copied().ok_or_else(|| TokenizerError::NoToken(name.into()));
        let (start, end) = (token(START)?, token(END)?);
        Ok(ClipTokenizer { numbers, ranks, characters: byte_characters(), start, end })
    }

    /// The tokens of a text, its start and end among them: `most` at most, words at the end are left out.
    ///
    /// # Errors
    /// When it has no token for a piece of the text.
    pub fn tokens(&self, text: &str, most: usize) -> Result<Vec<u32>, TokenizerError> {
        let mut tokens = vec![self.start];
        let most = most.max(2);
        for word in words(text) {
            if tokens.len() + 1 >= most {
                break;
            }
            for piece in self.pieces(&word) {
                let number = self.numbers.get(&piece).copied();
                tokens.push(number.ok_or(TokenizerError::NoToken(piece))?);
            }
        }
        tokens.truncate(most - 1);
        tokens.push(self.end);
        Ok(tokens)
    }

    /// The token that fills up what is not used of a text's length.
    pub fn filler(&self) -> u32 {
        self.end
    }

    /// A word's pieces, once nothing can be merged any more.
    fn pieces(&self, word: &str) -> Vec<String> {
        let mut pieces: Vec<String> =
            word.bytes().map(|byte| self.characters[usize::from(byte)].to_string()).collect();
        if let Some(last) = pieces.last_mut() {
            last.push_str(WORD_END);
        }
        loop {
            let rank = |pair: &[String]| self.ranks.get(&format!("{} {}", pair[0], pair[1])).copied();
            let first = pieces.windows(2).filter_map(|pair| Some((rank(pair)?, pair.to_vec()))).min();
            let Some((_, merged)) = first else { return pieces };
            let mut next = Vec::with_capacity(pieces.len());
            let mut rest = pieces.into_iter().peekable();
            while let Some(mut piece) = rest.next() {
                if piece == merged[0] && rest.peek() == Some(&merged[1]) {
                    piece.extend(rest.next());
                }
                next.push(piece);
            }
            pieces = next;
        }
    }
}

/// The character that stands for each byte in the pieces: printable ones for themselves, the others after all bytes.
fn byte_characters() -> [char; 256] {
    let mut next = 256;
    std::array::from_fn(|byte| {
        let byte = byte as u32;
        let code = match byte {
            33..=126 | 161..=172 | 174..=255 => byte,
            _ => {
                next += 1;
                next - 1
            }
        };
        char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER)
    })
}

/// The words of a text in small letters: letters together, each digit alone, other signs together.
fn words(text: &str) -> Vec<String> {
    let text: Vec<char> = text.chars().take(MOST_CHARACTERS).flat_map(char::to_lowercase).collect();
    let (mut found, mut at) = (Vec::new(), 0);
    while let Some(&first) = text.get(at) {
        let rest = &text[at..];
        let while_all = |is: &dyn Fn(char) -> bool| rest.iter().take_while(|c| is(**c)).count();
        let shortened = SHORTENED.iter().find(|end| end.chars().eq(rest.iter().copied().take(end.len())));
        let length = match shortened {
            _ if first.is_whitespace() => {
                at += 1;
                continue;
            }
            Some(end) => end.len(),
            None if first.is_alphabetic() => while_all(&char::is_alphabetic),
            None if first.is_numeric() => 1,
            None => while_all(&|c| !(c.is_whitespace() || c.is_alphabetic() || c.is_numeric())),
        };
        found.push(rest[..length].iter().collect());
        at += length;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A vocabulary with all bytes, alone and at the end of words, then one token per merge, then the two special ones.
    fn small(merges: &[&str]) -> ClipTokenizer {
        let alone = byte_characters().map(|c| c.to_string());
        let at_end = alone.clone().map(|c| c + WORD_END);
        let merged = merges.iter().map(|merge| merge.replace(' ', ""));
        let special = [START, END].map(str::to_owned);
        let all = alone.into_iter().chain(at_end).chain(merged).chain(special);
        let numbers = all.zip(0..).collect();
        ClipTokenizer::new(numbers, merges.iter().map(|merge| (*merge).to_owned())).unwrap()
    }

    #[test]
    fn tokens_are_those_of_the_true_vocabulary() {
        // An excerpt of CLIP's vocabulary and the merges that lead to it, with their true numbers and order.
        let vocabulary = r#"{"a</w>": 320, "of</w>": 539, "photo</w>": 1125, "cat</w>": 2368, "<|startoftext|>": 49406,
            "<|endoftext|>": 49407}"#;
        let merges = "#version: 0.2\no f</w>\na t</w>\np h\nt o</w>\no to</w>\nph oto</w>\nc at</w>\n";
        let tokenizer = ClipTokenizer::of_parts(vocabulary.as_bytes(), merges.as_bytes()).unwrap();
        let expected = [49406, 320, 1125, 539, 320, 2368, 49407];
        assert_eq!(tokenizer.tokens("a photo of a cat", 77).unwrap(), expected);
        assert_eq!(tokenizer.tokens("  A  Photo\tof a CAT ", 77).unwrap(), expected);
        assert_eq!(tokenizer.tokens("a photo of a cat", 4).unwrap(), [49406, 320, 1125, 49407], "cut short");
        assert_eq!(tokenizer.tokens("", 77).unwrap(), [49406, 49407]);
        let json = format!(
            r#"{{"model": {{"type": "BPE", "vocab": {vocabulary}, "merges": ["o f</w>", ["a", "t</w>"], "c at</w>"]}},
                "added_tokens": [{{"id": 7, "content": "<|endoftext|>", "special": true}}]}}"#
        );
        let tokenizer = ClipTokenizer::of_json(json.as_bytes()).unwrap();
        assert_eq!(tokenizer.tokens("a cat", 77).unwrap(), [49406, 320, 2368, 7]);
        let missing = tokenizer.tokens("dog", 77).unwrap_err();
        assert!(missing.to_string().contains("no token `d`"), "{missing}");
    }

    #[test]
    fn the_merge_that_stands_first_in_the_list_comes_first_wherever_it_is_in_the_word() {
        // `b c` comes before `a b`: `abc` is `a` and `bc`.
        assert_eq!(small(&["b c</w>", "a b"]).pieces("abc"), ["a", "bc</w>"]);
        assert_eq!(small(&["a b", "b c</w>"]).pieces("abc"), ["ab", "c</w>"]);
        // A pair at a word's end is another one than the same in its middle.
        assert_eq!(small(&["b c", "z z</w>"]).pieces("abc"), ["a", "b", "c</w>"]);
        assert_eq!(small(&["a a", "aa a</w>", "aa aa"]).pieces("aaaaa"), ["aa", "aaa</w>"]);
    }

    #[test]
    fn words_are_letters_digits_and_signs() {
        let of = |text: &str| words(text).join("|");
        assert_eq!(of("The dome's 12 windows!?"), "the|dome|'s|1|2|windows|!?");
        assert_eq!(of("we'll (see) it"), "we|'ll|(|see|)|it");
        assert_eq!(of("Fenêtre 窓"), "fenêtre|窓");
        // Other letters are bytes, each under a character of its own.
        let shown = byte_characters();
        assert_eq!((shown[usize::from(b'a')], shown[0], shown[0x20], shown[0xc3]), ('a', 'Ā', 'Ġ', 'Ã'));
        assert_eq!(small(&["a b</w>"]).pieces("é"), ["Ã", "©</w>"]);
    }

    #[test]
    fn a_damaged_tokenizer_is_refused_with_what_is_wrong() {
        let says = |found: Result<ClipTokenizer, TokenizerError>, word: &str| {
            let words = found.unwrap_err().to_string();
            assert!(words.contains(word), "{words}");
        };
        says(ClipTokenizer::of_json(b"{"), "stands beside a CLIP model");
        says(
            ClipTokenizer::of_json(br#"{"model": {"type": "Unigram", "vocab": [["a", 0.5]]}}"#),
            "`Unigram`",
        );
        says(
            ClipTokenizer::of_json(br#"{"model": {"type": "BPE", "vocab": {"a": -1}, "merges": []}}"#),
            "CLIP",
        );
        says(ClipTokenizer::of_parts(b"{}", b"\xff\xfe"), "UTF-8");
        says(ClipTokenizer::of_parts(b"{}", b"a b c\n"), "its merge 1 is `a b c`");
        says(ClipTokenizer::of_parts(b"{}", b"a b\n"), "ends a word");
        says(ClipTokenizer::of_parts(b"{\"a\": 1}", b"a b</w>\n"), "no token `<|startoftext|>`");
    }
}
