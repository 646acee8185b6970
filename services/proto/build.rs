//! Generates the messages and services of proto/ (without protoc).

use std::path::PathBuf;

/// The files, in the folder of all messages.
const FILES: [&str; 4] = [
    "segwild/v1/farm.proto",
    "segwild/v1/session.proto",
    "segwild/v1/status.proto",
    "segwild/v1/vision.proto",
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = PathBuf::from("../../proto");
    println!("cargo:rerun-if-changed={}", folder.display());
    let mut compiler = protox::Compiler::new([&folder])?;
    compiler.include_source_info(true).include_imports(true).open_files(FILES)?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(out.join("descriptors.bin"), compiler.encode_file_descriptor_set())?;
    tonic_prost_build::configure().compile_fds(compiler.file_descriptor_set())?;
    Ok(())
}
