//! The command line that results name as what made them.

/// The command as it was given, without the folder of the program and what only says where the output goes.
pub fn command_line() -> String {
    let mut words = vec!["segwild".to_owned()];
    let mut given = std::env::args().skip(1);
    while let Some(word) = given.next() {
        if word == "--out" || word == "--page" {
            given.next();
        } else if !["--out=", "--page="].iter().any(|p| word.starts_with(p))
            && word != "--json"
            && word != "--keep"
        {
            words.push(word);
        }
    }
    words.join(" ")
}
