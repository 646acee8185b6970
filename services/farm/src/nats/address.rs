//! Where a farm is.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use super::record::FarmKey;

/// The longest name of a farm: it becomes part of names that the server bounds.
const LONGEST_NAME: usize = 64;

/// A farm on NATS servers: `nats://HOST[:PORT][,HOST…]/NAME`, or `tls://`.
///
/// ```
/// use segwild_farm::FarmAddress;
/// let address: FarmAddress = "nats://queue.lan/night".parse().unwrap();
/// assert_eq!(address.name(), "night");
/// assert_eq!(address.to_string(), "nats://queue.lan:4222/night");
/// assert!("nats://queue.lan/a.b".parse::<FarmAddress>().is_err());
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FarmAddress {
    tls: bool,
    /// Host and port of each.
    hosts: Vec<String>,
    name: String,
}

/// Why a text is no address of a farm.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FarmAddressError {
    /// It starts otherwise.
    #[error("`{0}` is no farm: an address is nats://HOST:PORT/NAME, or tls://HOST:PORT/NAME")]
    Scheme(String),
    /// A user or a password is in it.
    #[error("an address has no user and no password: addresses are shown and logged; use a credentials file")]
    Secret,
    /// A host makes no sense.
    #[error("`{0}` is no host and port")]
    Host(String),
    /// The name cannot be used.
    #[error("`{0}` is no name of a farm: letters, digits, - and _, at most 64")]
    Name(String),
}

impl FarmAddress {
    /// The name of the farm on its servers.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub(super) fn tls(&self) -> bool {
        self.tls
    }

    /// The servers, as the client takes them.
    pub(super) fn servers(&self) -> Vec<String> {
        let scheme = self.scheme();
        self.hosts.iter().map(|host| format!("{scheme}://{host}")).collect()
    }

    fn scheme(&self) -> &'static str {
        if self.tls { "tls" } else { "nats" }
    }
}

impl FromStr for FarmAddress {
    type Err = FarmAddressError;

    fn from_str(text: &str) -> Result<Self, FarmAddressError> {
        let scheme = || FarmAddressError::Scheme(text.to_owned());
        if text.contains('@') {
            return Err(FarmAddressError::Secret);
        }
        let (kind, rest) = text.split_once("://").ok_or_else(scheme)?;
        let tls = match kind {
            "nats" => false,
            "tls" => true,
            _ => return Err(scheme()),
        };
        let (hosts, name) = rest.trim_end_matches('/').split_once('/').ok_or_else(scheme)?;
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if name.is_empty() || name.len() > LONGEST_NAME || !name.chars().all(plain) {
            return Err(FarmAddressError::Name(name.to_owned()));
        }
        let hosts = hosts.split(',').map(host).collect::<Result<Vec<_>, _>>()?;
        Ok(Self { tls, hosts, name: name.to_owned() })
    }
}

/// A host with its port.
fn host(text: &str) -> Result<String, FarmAddressError> {
    let wrong = || FarmAddressError::Host(text.to_owned());
    let bracketed = text.strip_prefix('[').and_then(|rest| rest.split_once(']'));
    let (host, port) = match bracketed {
        Some((inner, rest)) => {
            inner.parse::<std::net::Ipv6Addr>().map_err(|_| wrong())?;
            (format!("[{inner}]"), rest)
        }
        None => {
            let (host, port) = text.find(':').map_or((text, ""), |at| text.split_at(at));
            let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
            if host.is_empty() || !host.chars().all(plain) {
                return Err(wrong());
            }
            (host.to_owned(), port)
        }
    };
    let port = match port {
        "" => 4222,
        port => port.strip_prefix(':').and_then(|port| port.parse::<u16>().ok()).ok_or_else(wrong)?,
    };
    Ok(format!("{host}:{port}"))
}

impl fmt::Display for FarmAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}/{}", self.scheme(), self.hosts.join(","), self.name)
    }
}

/// How a farm's servers know who connects. It is the user's: no job and no run folder names it.
#[derive(Clone, Debug, Default)]
pub struct FarmAccess {
    /// A credentials file of NATS (`.creds`).
    pub credentials: Option<PathBuf>,
    /// A file with the certificates that the servers' are signed by; without it, the machine's own.
    pub certificates: Option<PathBuf>,
    /// The key that the farm's machines share: records that are not signed with it are void.
    pub key: Option<FarmKey>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_what_is_none_is_named() {
        let read = |text: &str| text.parse::<FarmAddress>();
        let cluster = read("tls://a:1,b.lan,[::1]:7/x_1/").unwrap();
        assert_eq!(cluster.to_string(), "tls://a:1,b.lan:4222,[::1]:7/x_1");
        assert_eq!(read(&cluster.to_string()), Ok(cluster));
        for (text, expected) in [
            ("a:4222/x", "no farm"),
            ("http://a/x", "no farm"),
            ("nats://a:4222", "`nats://a:4222` is no farm: an address is nats://HOST:PORT/NAME"),
            ("nats://a/", "no farm"),
            ("nats://me:secret@a/x", "credentials file"),
            ("nats://a:x/y", "`a:x`"),
            ("nats:///y", "no host"),
            ("nats://[::1/y", "`[::1`"),
            ("nats://a/b/c", "`b/c`"),
            ("nats://a/*", "`*`"),
        ] {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains(expected) && !message.contains("secret"), "{text}: {message}");
        }
    }
}
