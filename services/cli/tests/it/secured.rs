//! A farm whose server encrypts and knows who connects: scenes go through it, mistakes are answered in words, and no secret is
//! written anywhere.

use crate::common::*;
use crate::farm::nats_server::NatsServer;
use crate::farm::{batch, log, manifest, worker_by};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A file of `nats/`: an operator with an account of a farm, a user of it, and a user of somebody else.
fn nats(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/nats").join(name)
}

/// A certificate for 127.0.0.1 with its key, who signed it, and somebody else.
fn tls(name: &str) -> String {
    show(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../vision/tests/it/tls").join(name))
}

/// The files below a folder.
fn files_in(folder: &Path) -> Vec<PathBuf> {
    // Some come and go while a worker lives.
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files_in(&path) } else { vec![path] }).collect()
}

#[test]
fn a_farm_by_tls_and_credentials_works_names_mistakes_and_writes_no_secret() {
    let dir = folder();
    let path = dir.path();
    let operator = std::fs::read_to_string(nats("operator.conf")).expect("it is there");
    let (certificate, key) = (tls("service.pem"), tls("service.key"));
    let conf = format!("{operator}tls {{ cert_file: \"{certificate}\", key_file: \"{key}\" }}\n");
    let conf_file = path.join("server.conf");
    std::fs::write(&conf_file, conf).expect("it writes");
    let flags = ["-c".to_owned(), show(&conf_file)];
    let Some(server) = NatsServer::start_with(path, "127.0.0.1", &flags) else { return };
    let farm = format!("tls://127.0.0.1:{}/f", server.port);
    // Kept outside of the folder that is searched for it.
    let keys = folder();
    let (farm_key, farm_secret) = (show(&keys.path().join("key")), "a secret of all machines");
    std::fs::write(&farm_key, farm_secret).expect("it writes");
    let (user, ca) = (show(&nats("farm.creds")), tls("ca.pem"));
    let access = ["--credentials", &user, "--certificates", &ca, "--farm-key", &farm_key];
    // A log of all that the client of the server has to report.
    let mut program = Command::new(env!("CARGO_BIN_EXE_segwild"));
    program.env("SEGWILD_LOG", "async_nats=trace,rustls=trace,segwild_farm=trace");
    let _worker = worker_by(program, path, &farm, "first", &access);
    let ended = batch(path, &farm, &manifest(path, &["a"]), &access).wait_with_output().expect("it ends");
    let mut printed = text(&ended.stdout) + &text(&ended.stderr);
    assert_eq!(ended.status.code(), Some(0), "{printed}");
    same_as_untouched(&path.join("night/a"));
    let status = ["status", "--farm", &farm];
    printed += &works(&[&status[..], &access].concat());
    printed += &works(&[&status[..], &access, &["--json"]].concat());

    let (other_user, other_ca, missing) = (show(&nats("other.creds")), tls("other.pem"), tls("none.pem"));
    for (credentials, certificates, words) in [
        (Some(&user), &other_ca, ["its certificate is not trusted", "--certificates"]),
        (Some(&user), &missing, ["cannot read the certificates", "none.pem"]),
        (Some(&other_user), &ca, ["it refuses who connects", "authorization"]),
        (None, &ca, ["it refuses who connects", "authorization"]),
        (Some(&ca), &ca, ["cannot read the credentials", "ca.pem"]),
    ] {
        let mut args = [&status[..], &["--certificates", certificates]].concat();
        args.extend(credentials.iter().flat_map(|file| ["--credentials", file.as_str()]));
        let output = segwild(&args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{error}");
        assert!(error.contains(&farm) && words.iter().all(|word| error.contains(word)), "{words:?}: {error}");
        printed += &error;
    }

    let written = std::fs::read_to_string(nats("farm.creds")).expect("it is there");
    let seed = written.lines().find(|line| line.starts_with("SU")).expect("a seed");
    let secrets = [seed, farm_secret];
    assert!(log(path, "first").contains("TRACE"), "the log has everything");
    for secret in secrets {
        assert!(!printed.contains(secret), "{printed}");
        for file in files_in(path) {
            let bytes = std::fs::read(&file).unwrap_or_default();
            assert!(!String::from_utf8_lossy(&bytes).contains(secret), "{} has a secret", file.display());
        }
    }
}
