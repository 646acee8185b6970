//! Other programs as child processes: their output goes line by line to a log and to a reader, and they end with this process.

use crate::{FileError, Phase, Stopper, files};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

/// Longest line that is taken as one.
const LONGEST_LINE: u64 = 1 << 16;
/// Lines that may wait to be read; then the child waits.
const LINES: usize = 256;
/// Time between two checks of whether the run is to stop.
const EVERY: Duration = Duration::from_millis(200);

/// Why a program did not do its work.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// It failed.
    #[error("{program} failed: {last}{}", log.as_ref().map_or_else(String::new, |log| format!("; all that it wrote is in {}", log.display())))]
    Failed {
        /// The program and its command.
        program: String,
        /// Its last line, and its exit code.
        last: String,
        /// The log, if there is one.
        log: Option<PathBuf>,
    },
    /// It cannot be started.
    #[error("{program} cannot be started: {source}")]
    Start {
        /// The program and its command.
        program: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// The log cannot be written.
    #[error(transparent)]
    Log(#[from] FileError),
    /// Stopped by the user.
    #[error("stopped")]
    Stopped,
}

/// Runs programs: where they write to, and what stops them.
pub struct ProgramRunner<'a> {
    /// The log, to whose end they write; `None`: what they write is not kept.
    pub log: Option<PathBuf>,
    /// Stops them.
    pub stopper: &'a Stopper,
}

impl ProgramRunner<'_> {
    /// Runs a program to its end. `line` is given each line of its output, without the line break.
    ///
    /// # Errors
    /// It cannot be started, it fails, the log cannot be written, or the run is stopped.
    pub fn run(
        &self,
        program: &Path,
        arguments: &[String],
        line: impl FnMut(&str),
    ) -> Result<(), ProgramError> {
        self.run_with(&[], program, arguments, line)
    }

    /// As [`ProgramRunner::run`], with more variables in the program's environment: names and values.
    ///
    /// # Errors
    /// As [`ProgramRunner::run`].
    pub fn run_with(
        &self,
        variables: &[(&str, String)],
        program: &Path,
        arguments: &[String],
        line: impl FnMut(&str),
    ) -> Result<(), ProgramError> {
        let name = named(program, arguments);
        let (status, last) = self.status(variables, program, arguments, line)?;
        if status.success() {
            return Ok(());
        }
        let how = status.code().map_or_else(|| "killed".to_owned(), |code| format!("exit code {code}"));
        Err(ProgramError::Failed { program: name, last: format!("{last} ({how})"), log: self.log.clone() })
    }

    /// As [`ProgramRunner::run`]; returns how it ended, and its last line that says something.
    fn status(
        &self,
        variables: &[(&str, String)],
        program: &Path,
        arguments: &[String],
        mut line: impl FnMut(&str),
    ) -> Result<(ExitStatus, String), ProgramError> {
        let name = named(program, arguments);
        let mut log = self.open_log()?;
        log.line(&format!("== {} {}", program.display(), arguments.join(" ")))?;
        let (mut child, output) = start(variables, program, arguments)
            .map_err(|source| ProgramError::Start { program: name.clone(), source })?;
        let (sender, receiver) = sync_channel::<String>(LINES);
        let reader = std::thread::Builder::new().name("child output".into()).spawn(move || {
            let mut output = BufReader::new(output);
            while let Some(text) = next_line(&mut output) {
                if sender.send(text).is_err() {
                    return;
                }
            }
        });
        let reader = reader.map_err(|source| {
            end(&mut child);
            ProgramError::Start { program: name.clone(), source }
        })?;
        let mut last = String::new();
        let outcome = loop {
            if self.stopper.phase() != Phase::Running {
                break Err(ProgramError::Stopped);
            }
            match receiver.recv_timeout(EVERY) {
                Ok(text) => {
                    if let Err(error) = log.line(&text) {
                        break Err(error.into());
                    }
                    line(&text);
                    if !text.trim().is_empty() {
                        last = text.trim().to_owned();
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break Ok(()),
            }
        };
        if outcome.is_err() {
            end(&mut child);
        }
        // The reader must not wait for a full channel.
        drop(receiver);
        let status = child.wait().map_err(|source| ProgramError::Start { program: name, source })?;
        // A reader that panicked has written that to stderr already.
        let _ = reader.join();
        outcome.map(|()| (status, last))
    }

    fn open_log(&self) -> Result<ProgramLog<'_>, FileError> {
        Ok(ProgramLog(match &self.log {
            Some(path) => Some((path, files::open_to_append(path)?)),
            None => None,
        }))
    }
}

/// What a program's output is added to, if it is kept.
struct ProgramLog<'a>(Option<(&'a Path, File)>);

impl ProgramLog<'_> {
    fn line(&mut self, text: &str) -> Result<(), FileError> {
        match &mut self.0 {
            Some((path, file)) => writeln!(file, "{text}").map_err(|e| FileError::new("write", path, e)),
            None => Ok(()),
        }
    }
}

/// A program in messages: its name, and its command where it has several.
fn named(program: &Path, arguments: &[String]) -> String {
    let name = program.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    match arguments.first().filter(|first| !first.starts_with('-')) {
        Some(command) => format!("{name} {command}"),
        None => name,
    }
}

/// Kills a child. One that has ended by itself is as good.
fn end(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}

/// Starts a program whose output and errors come through one pipe, and which ends when this process does.
fn start(
    variables: &[(&str, String)],
    program: &Path,
    arguments: &[String],
) -> std::io::Result<(Child, std::io::PipeReader)> {
    let (output, input) = std::io::pipe()?;
    let mut command = ending_with_parent(program);
    command.envs(variables.iter().map(|(name, value)| (name, value)));
    command.args(arguments).stdin(Stdio::null()).stdout(input.try_clone()?).stderr(input);
    // Ctrl-C in the terminal is for this process, which ends the child itself.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    Ok((command.spawn()?, output))
}

/// The command of a program that the system kills when the thread that started it ends. Where there is no `setpriv`, the child of
/// a killed process ends at its next line of output.
fn ending_with_parent(program: &Path) -> Command {
    match find_program("setpriv").filter(|_| cfg!(target_os = "linux")) {
        Some(setpriv) => {
            let mut command = Command::new(setpriv);
            command.args(["--pdeathsig", "KILL", "--"]).arg(program);
            command
        }
        None => Command::new(program),
    }
}

/// What a program writes, output and errors.
///
/// # Errors
/// It cannot be started.
pub fn program_output(program: &Path, arguments: &[&str]) -> std::io::Result<String> {
    let output = ending_with_parent(program).args(arguments).stdin(Stdio::null()).output()?;
    let text = [output.stdout, output.stderr].concat();
    Ok(String::from_utf8_lossy(&text).into_owned())
}

/// The file of a program on the `PATH`; folders that are relative there are left out, since they may be anybody's.
pub fn find_program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let absolute = std::env::split_paths(&path).filter(|folder| folder.is_absolute());
    absolute
        .map(|folder| folder.join(name).with_extension(std::env::consts::EXE_EXTENSION))
        .find(|file| file.is_file())
}

/// The next line of a program's output, in which carriage returns end lines too; a long one in parts.
fn next_line(output: &mut impl BufRead) -> Option<String> {
    let mut bytes = Vec::new();
    let read = output.take(LONGEST_LINE).read_until(b'\n', &mut bytes).ok()?;
    if read == 0 {
        return None;
    }
    let text = String::from_utf8_lossy(&bytes);
    let text = text.trim_end_matches(['\n', '\r']);
    Some(text.rsplit('\r').next().unwrap_or(text).to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    fn shell(script: &str, stopper: &Stopper) -> (Result<(), ProgramError>, Vec<String>, String) {
        let dir = tempfile::tempdir().unwrap();
        let programs = ProgramRunner { log: Some(dir.path().join("log")), stopper };
        let mut lines = Vec::new();
        let done = programs
            .run(Path::new("/bin/sh"), &["-c".into(), script.into()], |line| lines.push(line.to_owned()));
        (done, lines, std::fs::read_to_string(dir.path().join("log")).unwrap())
    }

    #[test]
    fn output_and_errors_come_line_by_line_and_stand_in_the_log() {
        let (done, lines, log) =
            shell("echo one; echo two >&2; printf '10%%\\r20%%\\n'; printf last", &Stopper::new());
        done.unwrap();
        assert_eq!(lines, ["one", "two", "20%", "last"]);
        assert!(log.starts_with("== /bin/sh -c") && log.ends_with("one\ntwo\n20%\nlast\n"), "{log}");
    }

    #[test]
    fn a_program_has_the_variables_that_it_is_given() {
        let (stopper, mut lines) = (Stopper::new(), Vec::new());
        let programs = ProgramRunner { log: None, stopper: &stopper };
        let arguments = ["-c".to_owned(), "echo $OMP_NUM_THREADS of $HOME".to_owned()];
        let variables = [("OMP_NUM_THREADS", "3".to_owned()), ("HOME", "/here".to_owned())];
        let line = |line: &str| lines.push(line.to_owned());
        programs.run_with(&variables, Path::new("/bin/sh"), &arguments, line).unwrap();
        assert_eq!(lines, ["3 of /here"]);
    }

    #[test]
    fn a_failure_names_the_last_line_and_the_log() {
        let (done, _, _) = shell("echo too dark; echo; exit 3", &Stopper::new());
        let message = done.unwrap_err().to_string();
        assert!(
            message.contains("sh failed: too dark (exit code 3)") && message.contains("/log"),
            "{message}"
        );
    }

    #[test]
    fn a_stop_ends_a_child_that_is_silent() {
        let stopper = Stopper::new();
        let (asks, began) = (stopper.clone(), Instant::now());
        let stops = std::thread::spawn(move || {
            std::thread::park_timeout(Duration::from_millis(100));
            asks.stop();
        });
        let (done, _, _) = shell("exec sleep 600", &stopper);
        stops.join().unwrap();
        assert!(matches!(done, Err(ProgramError::Stopped)), "{done:?}");
        assert!(began.elapsed() < Duration::from_secs(60));
    }

    #[test]
    fn a_line_without_end_takes_no_memory_without_end() {
        let (done, lines, _) = shell("head -c 1000000 /dev/zero | tr '\\0' x", &Stopper::new());
        done.unwrap();
        assert_eq!(lines.iter().map(String::len).sum::<usize>(), 1_000_000);
        assert!(lines.iter().all(|line| line.len() as u64 <= LONGEST_LINE));
    }
}
