//! Why services do not serve.

use crate::service_address::{AddressError, ServiceAddress};
use crate::service_tls::TlsFileError;
use std::path::PathBuf;

/// Why services do not serve.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// An address is none.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// The file of the token cannot be used.
    #[error("{}: {reason}", file.display())]
    Token {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        #[source]
        reason: TokenFileError,
    },
    /// The file of trusted certificates cannot be used.
    #[error("the certificates of vision services: {0}")]
    Certificates(#[from] TlsFileError),
    /// What is sent to a service cannot be encrypted.
    #[error("there is no TLS with the vision service {address}: {reason}")]
    NoTls {
        /// Where.
        address: ServiceAddress,
        /// What is wrong.
        reason: String,
    },
    /// No thread can be had for connections.
    #[error("no connection can be had: {0}")]
    Start(std::io::Error),
    /// None of them answers. The same command continues when one does.
    #[error("no vision service has answered for {seconds} s: {reasons}")]
    Gone {
        /// How long they were waited for.
        seconds: u64,
        /// What is known against each.
        reasons: String,
        /// What it is for a run: no photo's fault.
        #[source]
        kind: std::io::Error,
    },
    /// Two have different models, so that a photo's masks would depend on which one answers.
    #[error("{one} and {other} have different models: use services with the same one")]
    Differ {
        /// One.
        one: ServiceAddress,
        /// The other one.
        other: ServiceAddress,
    },
    /// A service refuses a call, or fails at it again and again.
    #[error("the vision service {address} refuses: {reason}")]
    Refused {
        /// Where.
        address: ServiceAddress,
        /// Its words.
        reason: String,
    },
    /// An answer is not what it should be.
    #[error("the vision service {address} answers wrongly: {reason}")]
    Answer {
        /// Where.
        address: ServiceAddress,
        /// What is wrong.
        reason: String,
    },
}

/// Why a file holds no token.
#[derive(Debug, thiserror::Error)]
pub enum TokenFileError {
    /// It cannot be read.
    #[error("cannot be read: {0}")]
    Read(#[from] std::io::Error),
    /// Its text is none.
    #[error("a token has 16 letters, digits, dashes or underscores at least")]
    NoToken,
}
