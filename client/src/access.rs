//! How a client shows who it is, and knows that the server is the right one.

use std::{fmt, str::FromStr};

use tonic::{
    Request, Status,
    metadata::{Ascii, MetadataValue},
    service::Interceptor,
    transport::{Certificate, ClientTlsConfig, Identity},
};

use crate::error::{Error, Result};

/// A key, which never shows in debugging.
#[derive(Clone, PartialEq, Eq)]
pub struct ApiKey(MetadataValue<Ascii>);

impl ApiKey {
    /// The key as the operator gave it.
    ///
    /// # Errors
    /// If it has characters that no key has.
    pub fn new(key: &str) -> Result<Self> {
        let bearer = format!("Bearer {}", key.trim()).parse::<MetadataValue<Ascii>>();
        let Ok(mut bearer) = bearer else {
            return Err(Error::input("api_key", "something else", "printable ASCII characters"));
        };
        bearer.set_sensitive(true);
        Ok(Self(bearer))
    }
}

impl FromStr for ApiKey {
    type Err = Error;

    fn from_str(key: &str) -> Result<Self> {
        Self::new(key)
    }
}

impl fmt::Debug for ApiKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ApiKey(..)")
    }
}

/// How TLS is spoken, all as PEM.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Tls {
    /// Authorities, one of which has signed the server's certificate.
    pub ca: Vec<u8>,
    /// The client's own certificate and its private key, where the server asks for one.
    pub identity: Option<(Vec<u8>, Vec<u8>)>,
    /// The name in the server's certificate, where it is not that of the address.
    pub server_name: Option<String>,
}

impl fmt::Debug for Tls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (identity, name) = (self.identity.is_some(), &self.server_name);
        f.debug_struct("Tls")
            .field("identity", &identity)
            .field("server_name", name)
            .finish_non_exhaustive()
    }
}

impl Tls {
    pub(crate) fn config(&self) -> ClientTlsConfig {
        let config = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.ca));
        let config = match &self.identity {
            Some((certificate, key)) => config.identity(Identity::from_pem(certificate, key)),
            None => config,
        };
        match &self.server_name {
            Some(name) => config.domain_name(name),
            None => config,
        }
    }
}

/// Adds the key to every call, if there is one.
#[derive(Clone, Debug)]
pub(crate) struct Bearer(pub(crate) Option<ApiKey>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> std::result::Result<Request<()>, Status> {
        if let Some(ApiKey(bearer)) = &self.0 {
            request.metadata_mut().insert("authorization", bearer.clone());
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_do_not_show() {
        let key = ApiKey::new(" gatsbi_secret\n").unwrap();
        assert_eq!(format!("{key:?}"), "ApiKey(..)");
        let request = Bearer(Some(key)).call(Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer gatsbi_secret");
        assert!(!format!("{request:?}").contains("secret"), "{request:?}");
        assert!(ApiKey::new("a\nb").is_err());
        let tls = Tls { identity: Some((Vec::new(), b"secret".to_vec())), ..Tls::default() };
        assert!(!format!("{tls:?}").contains("115"), "{tls:?}");
    }
}
