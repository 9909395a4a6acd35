//! Where a coordinator is found.

use std::{fmt, path::PathBuf, str::FromStr, time::Duration};

use tonic::{
    body::Body,
    client::GrpcService,
    transport::{Channel, Endpoint},
};

/// Where a coordinator is found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Address {
    /// A socket on this machine.
    Unix(PathBuf),
    /// `host:port`, by TCP, where nothing is encrypted.
    Tcp(String),
    /// `host:port`, by TLS.
    Tls(String),
}

/// A connection to a coordinator. A clone is the same connection.
pub trait Connection:
    GrpcService<Body, ResponseBody = Body, Future: Send> + Clone + Send + Sync + 'static
{
}

impl<C> Connection for C where
    C: GrpcService<Body, ResponseBody = Body, Future: Send> + Clone + Send + Sync + 'static
{
}

/// A text that is no address of a coordinator.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no coordinator's address; one looks like https://host:7878 or unix:/path/socket")]
pub struct AddressError(String);

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let error = || AddressError(text.to_owned());
        if let Some(path) = text.strip_prefix("unix:") {
            let path = path.strip_prefix("//").unwrap_or(path);
            return if path.is_empty() { Err(error()) } else { Ok(Self::Unix(path.into())) };
        }
        let (is_tls, host) = match text.strip_prefix("https://") {
            Some(host) => (true, host),
            None => (false, text.strip_prefix("http://").ok_or_else(error)?),
        };
        let host = host.strip_suffix('/').unwrap_or(host);
        let (name, port) = host.rsplit_once(':').ok_or_else(error)?;
        let is_host = !name.is_empty() && port.parse::<u16>().is_ok();
        Endpoint::from_shared(format!("http://{host}")).map_err(|_| error())?;
        match is_host {
            true if is_tls => Ok(Self::Tls(host.to_owned())),
            true => Ok(Self::Tcp(host.to_owned())),
            false => Err(error()),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
            Self::Tcp(host) => write!(f, "http://{host}"),
            Self::Tls(host) => write!(f, "https://{host}"),
        }
    }
}

impl Address {
    /// Connects where nobody asks for a token; a channel that was connected once connects again by
    /// itself.
    pub async fn connect(&self) -> Result<Channel, tonic::transport::Error> {
        self.endpoint()?.connect().await
    }

    pub(crate) fn endpoint(&self) -> Result<Endpoint, tonic::transport::Error> {
        const WINDOW_BYTES: u32 = 1 << 22;
        Ok(Endpoint::from_shared(self.to_string())?
            .connect_timeout(Duration::from_secs(5))
            .initial_stream_window_size(WINDOW_BYTES)
            .initial_connection_window_size(WINDOW_BYTES)
            .http2_keep_alive_interval(Duration::from_secs(10))
            .keep_alive_timeout(Duration::from_secs(20)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_as_they_are_written() {
        for text in ["http://127.0.0.1:7878", "https://host:1", "http://[::1]:80", "unix:/a/b c"] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        assert_eq!("unix:///a".parse(), Ok(Address::Unix("/a".into())));
    }

    #[test]
    fn what_is_no_address_is_refused() {
        for text in ["", "host", "host:80", "http://host", "http://:80", "https://a b:80", "unix:"]
        {
            text.parse::<Address>().expect_err(text);
        }
    }
}
