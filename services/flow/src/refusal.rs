//! What the disk or the system refuses: no fault of the work, which may be done later.

use crate::files::FileError;
use crate::shortage::is_shortage;
use std::error::Error;
use std::io;

/// What refused a piece of work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SystemRefusal {
    /// The disk: it is full or read-only, or a file cannot be read or written.
    Disk,
    /// The system has no file descriptor left.
    Shortage,
    /// A service elsewhere does not answer.
    Unanswered,
}

impl SystemRefusal {
    /// What an error or one of its sources was refused by; `None` where neither the disk nor the system is at fault.
    ///
    /// ```
    /// use segwild_flow::SystemRefusal;
    /// use std::io::{Error, ErrorKind};
    /// assert_eq!(SystemRefusal::of(&Error::from(ErrorKind::StorageFull)), Some(SystemRefusal::Disk));
    /// assert_eq!(SystemRefusal::of(&Error::from(ErrorKind::InvalidData)), None);
    /// ```
    pub fn of(error: &(dyn Error + 'static)) -> Option<SystemRefusal> {
        let sources = || std::iter::successors(Some(error), |&error| error.source());
        let of_system = || sources().filter_map(|error| error.downcast_ref::<io::Error>());
        if of_system().any(is_shortage) || ends_in_shortage(&error.to_string()) {
            return Some(SystemRefusal::Shortage);
        }
        if of_system().any(is_unanswered) {
            return Some(SystemRefusal::Unanswered);
        }
        let of_disk = of_system().any(is_of_disk) || sources().any(|error| error.is::<FileError>());
        of_disk.then_some(SystemRefusal::Disk)
    }
}

/// Whether the words of an error end in those of the system for a shortage. An error may keep only the words of its cause: a
/// decoder of images, a network's runtime, or a photo that a stage gave up after several attempts and that the failure of
/// the stage names. This is the one function that reads words.
fn ends_in_shortage(words: &str) -> bool {
    let code = words.strip_suffix(')').and_then(|rest| rest.rsplit_once("(os error ")).map(|(_, code)| code);
    let code = code.and_then(|code| code.parse().ok());
    code.is_some_and(|code| is_shortage(&io::Error::from_raw_os_error(code)))
}

/// Whether a program has noted that nobody answers it. From the system itself the same error comes with a number, and is
/// about a disk of the network that is not there any more.
fn is_unanswered(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::NotConnected && error.raw_os_error().is_none()
}

fn is_of_disk(error: &io::Error) -> bool {
    use io::ErrorKind::{NotConnected, QuotaExceeded, ReadOnlyFilesystem, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | ReadOnlyFilesystem | NotConnected)
}

#[cfg(test)]
mod tests {
    use super::SystemRefusal;
    use crate::files::FileError;
    use std::io::{Error, ErrorKind};
    use std::path::Path;

    #[derive(Debug, thiserror::Error)]
    #[error("photo a.jpg cannot be done")]
    struct Outer(#[source] Error);

    #[test]
    fn a_refusal_is_found_wherever_it_is_in_the_sources() {
        let of = |error: Error| SystemRefusal::of(&Outer(error));
        assert_eq!(of(ErrorKind::ReadOnlyFilesystem.into()), Some(SystemRefusal::Disk));
        assert_eq!(of(ErrorKind::NotConnected.into()), Some(SystemRefusal::Unanswered));
        assert_eq!(of(ErrorKind::NotFound.into()), None);
        assert_eq!(of(Error::other("no vision service has answered for 1 s")), None);
    }

    #[test]
    fn a_file_that_cannot_be_read_is_the_disks_fault_whatever_the_reason() {
        let file = FileError::new("read", Path::new("a"), ErrorKind::NotFound.into());
        assert_eq!(SystemRefusal::of(&file), Some(SystemRefusal::Disk));
    }

    #[cfg(unix)]
    #[test]
    fn want_of_file_descriptors_is_found_by_the_error_and_by_its_words() {
        let error = || Error::from_raw_os_error(24);
        assert_eq!(SystemRefusal::of(&Outer(error())), Some(SystemRefusal::Shortage));
        let file = FileError::new("read", Path::new("a"), error());
        assert_eq!(SystemRefusal::of(&file), Some(SystemRefusal::Shortage));
        let words = Error::other(format!("cannot read a.jpg: {}", error()));
        assert_eq!(SystemRefusal::of(&words), Some(SystemRefusal::Shortage));
        let other = Error::other("cannot read a (os error 24).jpg: it is no image");
        assert_eq!(SystemRefusal::of(&other), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_disk_of_the_network_that_is_gone_is_no_service() {
        let gone = Error::from_raw_os_error(107);
        assert_eq!(gone.kind(), ErrorKind::NotConnected);
        assert_eq!(SystemRefusal::of(&Outer(gone)), Some(SystemRefusal::Disk));
    }
}
