//! Writes the good inputs of every target into `FOLDER/TARGET`, for `cargo fuzz` to start with.

use std::path::Path;
use std::process::ExitCode;

fn write(folder: &Path) -> std::io::Result<()> {
    for target in segwild_fuzzing::TARGETS {
        let own = folder.join(target.name);
        std::fs::create_dir_all(&own)?;
        for (i, seed) in (target.seeds)().iter().enumerate() {
            std::fs::write(own.join(format!("seed-{i}")), seed)?;
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    let Some(folder) = std::env::args().nth(1) else {
        eprintln!("error: seeds FOLDER");
        return ExitCode::from(2);
    };
    match write(Path::new(&folder)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {folder}: {error}");
            ExitCode::FAILURE
        }
    }
}
