//! Names in messages: a sentence names a few of many.

/// How many names a sentence has.
const NAMED: usize = 3;

/// The first three of some names, for a sentence that has their number: `a, b, c, ...`.
pub fn first_named(names: &[impl AsRef<str>]) -> String {
    let more = if names.len() > NAMED { ", ..." } else { "" };
    joined(names) + more
}

/// The first three of some names and the number of the others: `a, b, c and 4 more`.
pub fn named_and_counted(names: &[impl AsRef<str>]) -> String {
    let more = names.len().saturating_sub(NAMED);
    let counted = if more > 0 { format!(" and {more} more") } else { String::new() };
    joined(names) + &counted
}

/// What happened to photos, a phrase each. Of more than three the first two stay, and a phrase counts the others.
pub fn few_of_photos(mut phrases: Vec<String>) -> Vec<String> {
    if phrases.len() > NAMED {
        let others = phrases.split_off(2).len();
        phrases = vec![format!("{} and {others} more photos", phrases.join(", "))];
    }
    phrases
}

fn joined(names: &[impl AsRef<str>]) -> String {
    let names: Vec<&str> = names.iter().take(NAMED).map(|name| name.as_ref()).collect();
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_names_three_and_says_that_there_are_more() {
        assert_eq!(first_named(&["a", "b", "c"]), "a, b, c");
        assert_eq!(first_named(&["a", "b", "c", "d"]), "a, b, c, ...");
        assert_eq!(named_and_counted(&["a", "b", "c"]), "a, b, c");
        assert_eq!(named_and_counted(&["a", "b", "c", "d", "e"]), "a, b, c and 2 more");
        let of = |count: usize| (0..count).map(|i| format!("{i} is new")).collect::<Vec<_>>();
        assert_eq!(few_of_photos(of(3)), of(3));
        assert_eq!(few_of_photos(of(4)), ["0 is new, 1 is new and 2 more photos"]);
    }
}
