//! How a coordinator is reached by those who may: its address, the authority that vouches for it,
//! and a token that says what the caller may do. An access file has all three.

use std::{
    error::Error,
    fmt, fs,
    path::PathBuf,
    sync::Arc,
    task::{Context, Poll},
};

use hyper_util::client::legacy::connect::HttpConnector;
use tonic::{
    body::Body,
    codegen::{
        Service,
        http::{self, HeaderValue, Uri, header::AUTHORIZATION},
    },
    transport::{Certificate, Channel, ClientTlsConfig},
};

use crate::Address;

/// The name in every coordinator's certificate: the farm's own authority is what is trusted,
/// whatever the address.
pub const CERTIFIED_NAME: &str = "rtfarm";

/// What an access file begins with.
const HEAD: &str = "rtfarm access 1";

/// How a coordinator is reached. It shows its token to nobody but the coordinator.
#[derive(Clone, PartialEq, Eq)]
pub struct Access {
    address: Address,
    secret: Option<Arc<Secret>>,
    /// The access file, which is looked into again for each connection.
    file: Option<PathBuf>,
}

#[derive(PartialEq, Eq)]
struct Secret {
    /// The authority's certificate, as PEM.
    authority: String,
    token: String,
}

/// A text that is no access file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("it is no access file of a farm; `coordinator --state DIR` writes them into DIR/access")]
pub struct AccessError;

/// What keeps a coordinator from being reached.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// Nobody answers, or not as who is expected.
    #[error("{0}")]
    Transport(String),
    /// The address is one of TLS, and nobody vouches for it.
    #[error("an address with https:// needs an access file, which --access FILE names")]
    NoAuthority,
}

impl From<tonic::transport::Error> for ConnectError {
    /// Keeps the innermost reason: those around it say the same again, or nothing.
    fn from(error: tonic::transport::Error) -> Self {
        let mut reason: &dyn Error = &error;
        while let Some(source) = reason.source() {
            reason = source;
        }
        Self::Transport(reason.to_string())
    }
}

impl From<Address> for Access {
    fn from(address: Address) -> Self {
        Self { address, secret: None, file: None }
    }
}

impl fmt::Debug for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Access").field("address", &self.address).finish_non_exhaustive()
    }
}

impl Access {
    /// With this certificate of an authority, as PEM, and this token.
    pub fn new(address: Address, authority: String, token: String) -> Self {
        Self { address, secret: Some(Arc::new(Secret { authority, token })), file: None }
    }

    /// Reads an access file.
    pub fn read(text: &str) -> Result<Self, AccessError> {
        let mut lines = text.splitn(4, '\n');
        let mut next = || lines.next().ok_or(AccessError);
        if next()? != HEAD {
            return Err(AccessError);
        }
        let address = next()?.strip_prefix("address ").ok_or(AccessError)?;
        let token = next()?.strip_prefix("token ").ok_or(AccessError)?;
        let authority = next()?;
        let address = address.parse().map_err(|_| AccessError)?;
        let has_token = HeaderValue::from_str(token).is_ok();
        if !has_token || !authority.starts_with("-----BEGIN CERTIFICATE-----") {
            return Err(AccessError);
        }
        Ok(Self::new(address, authority.to_owned(), token.to_owned()))
    }

    /// The text of an access file; `None` without a token.
    pub fn text(&self) -> Option<String> {
        let Secret { authority, token } = self.secret.as_deref()?;
        Some(format!("{HEAD}\naddress {}\ntoken {token}\n{authority}", self.address))
    }

    /// The same at another address.
    #[must_use]
    pub fn at(self, address: Address) -> Self {
        Self { address, ..self }
    }

    /// The same, and wherever this access file says that the coordinator is when a connection is
    /// made: it may come back elsewhere.
    #[must_use]
    pub fn kept_in(self, file: PathBuf) -> Self {
        Self { file: Some(file), ..self }
    }

    /// Where the coordinator is.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// What the coordinator is shown, if it is anything.
    pub fn token(&self) -> Option<&str> {
        self.secret.as_deref().map(|secret| secret.token.as_str())
    }

    /// Connects; what was connected once connects again by itself.
    pub async fn connect(&self) -> Result<Reached, ConnectError> {
        let endpoint = self.address.endpoint()?;
        let (endpoint, token) = match (&self.address, self.secret.as_deref()) {
            // A token goes to nobody whose certificate was not seen.
            (Address::Tls(_), Some(Secret { authority, token })) => {
                let tls = ClientTlsConfig::new()
                    .ca_certificate(Certificate::from_pem(authority))
                    .domain_name(CERTIFIED_NAME);
                let token = HeaderValue::from_str(&format!("Bearer {token}")).ok();
                (endpoint.tls_config(tls)?, token)
            }
            (Address::Tls(_), None) => return Err(ConnectError::NoAuthority),
            _ => (endpoint, None),
        };
        let token = token.map(|mut token| {
            token.set_sensitive(true);
            token
        });
        let channel = match self.file.clone() {
            Some(file) => endpoint.connect_with_connector(Dialer::new(file)).await?,
            None => endpoint.connect().await?,
        };
        Ok(Reached { channel, token })
    }
}

/// Calls where an access file says that the coordinator is.
#[derive(Clone)]
struct Dialer {
    http: HttpConnector,
    file: PathBuf,
}

impl Dialer {
    fn new(file: PathBuf) -> Self {
        let mut http = HttpConnector::new();
        // TLS is spoken above it.
        http.enforce_http(false);
        http.set_nodelay(true);
        Self { http, file }
    }

    /// The address in the file, if it is one.
    fn address(&self) -> Option<Uri> {
        let access = Access::read(&fs::read_to_string(&self.file).ok()?).ok()?;
        Some(access.address.endpoint().ok()?.uri().clone())
    }
}

impl Service<Uri> for Dialer {
    type Response = <HttpConnector as Service<Uri>>::Response;
    type Error = <HttpConnector as Service<Uri>>::Error;
    type Future = <HttpConnector as Service<Uri>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.http.poll_ready(context)
    }

    fn call(&mut self, address: Uri) -> Self::Future {
        let address = self.address().unwrap_or(address);
        self.http.call(address)
    }
}

/// A connection to a coordinator, which is shown the token with every call. A clone is the same
/// connection.
#[derive(Debug, Clone)]
pub struct Reached {
    channel: Channel,
    token: Option<HeaderValue>,
}

impl Service<http::Request<Body>> for Reached {
    type Response = http::Response<Body>;
    type Error = tonic::transport::Error;
    type Future = <Channel as Service<http::Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        Service::poll_ready(&mut self.channel, context)
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        if let Some(token) = &self.token {
            request.headers_mut().insert(AUTHORIZATION, token.clone());
        }
        Service::call(&mut self.channel, request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AUTHORITY: &str = "-----BEGIN CERTIFICATE-----\nabc\n-----END CERTIFICATE-----\n";

    #[test]
    fn an_access_file_is_read_as_it_is_written_and_shows_its_token_to_nobody() {
        let address: Address = "https://host:1".parse().unwrap();
        let access = Access::new(address, AUTHORITY.to_owned(), "secret".to_owned());
        let text = access.text().unwrap();
        assert_eq!(Access::read(&text), Ok(access.clone()));
        assert!(!format!("{access:?}").contains("secret"));
        let there = access.at("https://there:2".parse().unwrap());
        assert_eq!(
            (there.address().to_string().as_str(), there.token()),
            ("https://there:2", Some("secret"))
        );
        for bad in
            ["", "rtfarm access 1", "rtfarm access 2\n", "rtfarm access 1\naddress x\ntoken y\nz"]
        {
            assert_eq!(Access::read(bad), Err(AccessError));
        }
        let foreign = text.replace("token secret", "token a\u{7}b");
        assert_eq!(Access::read(&foreign), Err(AccessError));
    }
}
