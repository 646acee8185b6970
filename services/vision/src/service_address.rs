//! Where services are.

use std::fmt;
use std::str::FromStr;
use tonic::transport::Endpoint;

/// The scheme of a service's address.
const SCHEME: &str = "grpc://";
/// The same by TLS.
const TLS_SCHEME: &str = "grpcs://";

/// A service's address: `grpc://HOST:PORT`, or `grpcs://HOST:PORT` by TLS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceAddress {
    tls: bool,
    host_and_port: String,
}

/// A text is no address of a service.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no address of a service: write grpc://HOST:PORT, or grpcs://HOST:PORT for TLS")]
pub struct AddressError(String);

impl ServiceAddress {
    /// The addresses of a list with commas.
    ///
    /// # Errors
    /// When one of them is none.
    pub fn list(text: &str) -> Result<Vec<ServiceAddress>, AddressError> {
        text.split(',').map(str::trim).filter(|part| !part.is_empty()).map(str::parse).collect()
    }

    /// Whether a text is meant as addresses.
    pub fn is_meant(text: &str) -> bool {
        [SCHEME, TLS_SCHEME].iter().any(|scheme| text.trim_start().starts_with(scheme))
    }

    /// Whether what is sent there is encrypted.
    pub fn is_encrypted(&self) -> bool {
        self.tls
    }

    /// The address as the transport takes it.
    pub(super) fn http(&self) -> String {
        format!("{}://{}", if self.tls { "https" } else { "http" }, self.host_and_port)
    }
}

impl FromStr for ServiceAddress {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<ServiceAddress, AddressError> {
        let wrong = || AddressError(text.to_owned());
        let plain = text.strip_prefix(SCHEME);
        let (tls, rest) =
            (plain.is_none(), plain.or_else(|| text.strip_prefix(TLS_SCHEME)).ok_or_else(wrong)?);
        let (host, port) = rest.rsplit_once(':').ok_or_else(wrong)?;
        let plain = |b: u8| b.is_ascii_alphanumeric() || b".-_[]:".contains(&b);
        if host.is_empty() || !host.bytes().all(plain) || !port.parse::<u16>().is_ok_and(|port| port > 0) {
            return Err(wrong());
        }
        let address = ServiceAddress { tls, host_and_port: rest.to_owned() };
        // What the transport would refuse is refused here, in words.
        Endpoint::from_shared(address.http()).map_err(|_| wrong())?;
        Ok(address)
    }
}

impl fmt::Display for ServiceAddress {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}{}", if self.tls { TLS_SCHEME } else { SCHEME }, self.host_and_port)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_listed_with_commas_and_others_are_refused_by_name() {
        let all = ServiceAddress::list("grpc://gpu1:50051, grpc://[::1]:7,grpcs://gpu2:443").unwrap();
        assert_eq!(
            all.iter().map(ToString::to_string).collect::<Vec<_>>(),
            ["grpc://gpu1:50051", "grpc://[::1]:7", "grpcs://gpu2:443"]
        );
        assert_eq!(
            (all[0].http().as_str(), all[2].http().as_str()),
            ("http://gpu1:50051", "https://gpu2:443")
        );
        assert!(ServiceAddress::is_meant("grpcs://a") && !ServiceAddress::is_meant("sam"));
        for wrong in [
            "gpu1:50051",
            "grpc://gpu1",
            "grpc://:1",
            "grpc://a:0",
            "grpc://a/b:1",
            "http://a:1",
            "grpcs:/a:1",
            "grpc://a@b:1",
            "grpc://[[:1",
            "grpc://a:b:1",
        ] {
            let refused = ServiceAddress::list(wrong).unwrap_err().to_string();
            assert!(refused.contains(wrong) && refused.contains("grpc://HOST:PORT"), "{refused}");
        }
        assert!(ServiceAddress::list("").unwrap().is_empty());
    }
}
