//! TLS of vision services: who a service is, and whose certificates a client trusts. By rustls and ring, as everywhere.

use std::error::Error;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity, Server, ServerTlsConfig};

/// Most bytes of a file of certificates or of a key: those of a whole system are 200 KiB.
const MOST_PEM: u64 = 4 << 20;
/// How a certificate starts in a PEM file.
const CERTIFICATE: &str = "-----BEGIN CERTIFICATE-----";
/// How the line of a private key ends, whatever kind of key it is.
const PRIVATE_KEY: &str = "PRIVATE KEY-----";
/// A client that has not agreed on keys after this time is left.
const HANDSHAKE: Duration = Duration::from_secs(10);

/// The certificate of a service and its private key.
#[derive(Clone)]
pub struct ServiceIdentity(Identity);

impl fmt::Debug for ServiceIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ServiceIdentity")
    }
}

/// Certificates of who may have signed those of services.
#[derive(Clone, Debug)]
pub struct TrustedCertificates(Certificate);

/// Why files of certificates or keys cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TlsFileError {
    /// It cannot be read.
    #[error("cannot read {}: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// It has no certificate.
    #[error("{} has no certificate: it is to be a PEM file", file.display())]
    NoCertificate {
        /// The file.
        file: PathBuf,
    },
    /// It has no private key.
    #[error("{} has no private key: it is to be a PEM file, and not encrypted", file.display())]
    NoKey {
        /// The file.
        file: PathBuf,
    },
    /// They are not of each other, or of a kind that is not known.
    #[error("the certificate {} and the key {} cannot be used together: {reason}", certificate.display(), key.display())]
    Unfit {
        /// The file of the certificate.
        certificate: PathBuf,
        /// The file of the key.
        key: PathBuf,
        /// What is wrong with them.
        reason: String,
    },
}

impl ServiceIdentity {
    /// Reads the certificate of a service, with those between it and who signed it, and its private key: both PEM files.
    ///
    /// # Errors
    /// When one cannot be read, or they do not fit.
    pub fn read(certificate: &Path, key: &Path) -> Result<ServiceIdentity, TlsFileError> {
        let certificates = pem(certificate)?;
        if !certificates.contains(CERTIFICATE) {
            return Err(TlsFileError::NoCertificate { file: certificate.to_owned() });
        }
        let secret = pem(key)?;
        if !secret.contains(PRIVATE_KEY) {
            return Err(TlsFileError::NoKey { file: key.to_owned() });
        }
        let identity = ServiceIdentity(Identity::from_pem(certificates, secret));
        match Server::builder().tls_config(identity.config()) {
            Ok(_) => Ok(identity),
            Err(error) => Err(TlsFileError::Unfit {
                certificate: certificate.to_owned(),
                key: key.to_owned(),
                reason: innermost(&error).to_string(),
            }),
        }
    }

    /// What a server with this identity needs.
    pub(crate) fn config(&self) -> ServerTlsConfig {
        ServerTlsConfig::new().identity(self.0.clone()).timeout(HANDSHAKE)
    }
}

impl TrustedCertificates {
    /// Reads certificates of a PEM file.
    ///
    /// # Errors
    /// When it cannot be read, or has none.
    pub fn read(file: &Path) -> Result<TrustedCertificates, TlsFileError> {
        let text = pem(file)?;
        if !text.contains(CERTIFICATE) {
            return Err(TlsFileError::NoCertificate { file: file.to_owned() });
        }
        Ok(TrustedCertificates(Certificate::from_pem(text)))
    }
}

fn pem(file: &Path) -> Result<String, TlsFileError> {
    let failed = |source| TlsFileError::Read { file: file.to_owned(), source };
    let bytes = segwild_files::read_within(file, MOST_PEM).map_err(failed)?;
    // What is no text has no certificate.
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// An endpoint by TLS: it trusts these certificates and no others, or, without them, those of the system.
///
/// # Errors
/// When the certificates cannot be read, or the system has none.
pub(crate) fn encrypted(
    endpoint: Endpoint,
    trusted: Option<&TrustedCertificates>,
) -> Result<Endpoint, tonic::transport::Error> {
    let config = ClientTlsConfig::new().timeout(HANDSHAKE);
    endpoint.tls_config(match trusted {
        Some(trusted) => config.ca_certificate(trusted.0.clone()),
        None => config.with_native_roots(),
    })
}

/// The cause of an error that no other one caused: those around it report only that there is one.
pub(crate) fn innermost<'a>(error: &'a (dyn Error + 'static)) -> &'a (dyn Error + 'static) {
    let mut inner = error;
    while let Some(source) = inner.source() {
        inner = source;
    }
    inner
}
