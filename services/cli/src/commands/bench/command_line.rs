//! The command line that results name as what made them.

/// Flags that only say where the output goes.
const OUTPUT: [&str; 3] = ["--out", "--page", "--page-folder"];

/// The command as it was given, without the folder of the program and what only says where the output goes.
pub fn command_line() -> String {
    let mut words = vec!["segwild".to_owned()];
    let mut given = std::env::args().skip(1);
    while let Some(word) = given.next() {
        let flag = word.split('=').next().unwrap_or_default();
        if OUTPUT.contains(&word.as_str()) {
            given.next();
        } else if !OUTPUT.contains(&flag) && word != "--json" && word != "--keep" {
            words.push(word);
        }
    }
    words.join(" ")
}
