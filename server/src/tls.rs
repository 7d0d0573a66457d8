//! TLS and mutual TLS for every listener, from files that can be read again while the server runs.

use std::{
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, SystemTime},
};

use parking_lot::RwLock;
use rustls::{
    RootCertStore, ServerConfig,
    crypto::ring,
    pki_types::{
        CertificateDer, PrivateKeyDer,
        pem::{self, PemObject as _},
    },
    server::WebPkiClientVerifier,
};
use tokio_rustls::TlsAcceptor;

/// Where certificates are.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct TlsFiles {
    /// The server's certificate, and those between it and its authority, as PEM.
    pub certificate: PathBuf,
    /// Its private key, as PEM.
    pub key: PathBuf,
    /// Authorities one of which must have signed a client's certificate; absent if clients need none.
    pub client_ca: Option<PathBuf>,
}

/// Certificates cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("{what} {} cannot be read", path.display())]
    Unreadable {
        /// What it should hold.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: pem::Error,
    },
    /// Everybody may read the private key.
    #[error("the private key {shown} can be read by everybody: chmod 600 {shown}", shown = .0.display())]
    Permissions(PathBuf),
    /// There is no certificate in a file.
    #[error("{} holds no certificate", .0.display())]
    Empty(PathBuf),
    /// It is no certificate.
    #[error("the certificate {} cannot be understood: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// It has ended.
    #[error("the certificate {} expired on {}", path.display(), prost_types::Timestamp::from(*.at))]
    Expired {
        /// The file.
        path: PathBuf,
        /// When.
        at: SystemTime,
    },
    /// It has not begun.
    #[error("the certificate {} is valid from {} only", path.display(), prost_types::Timestamp::from(*.at))]
    NotYetValid {
        /// The file.
        path: PathBuf,
        /// When it begins.
        at: SystemTime,
    },
    /// The certificate and the key do not belong together, or are of a kind that is not understood.
    #[error("the certificate {} and its private key {} cannot be used", files.certificate.display(), files.key.display())]
    Unusable {
        /// Where they are.
        files: TlsFiles,
        /// Why.
        #[source]
        source: rustls::Error,
    },
    /// The authorities of clients cannot be used.
    #[error("the authorities of clients {} cannot be used: {reason}", path.display())]
    Authorities {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

/// Certificates in force.
#[derive(Debug)]
pub struct Tls {
    files: TlsFiles,
    current: RwLock<Current>,
}

#[derive(Clone, Debug)]
struct Current {
    config: Arc<ServerConfig>,
    ends: SystemTime,
}

impl Tls {
    /// Reads certificates.
    ///
    /// # Errors
    /// [`TlsError`] says what is wrong with which file.
    pub fn load(files: TlsFiles) -> Result<Self, TlsError> {
        let current = RwLock::new(read(&files)?);
        Ok(Self { files, current })
    }

    /// Reads them again; connections that are made from then on use them.
    ///
    /// # Errors
    /// As [`Tls::load`]; what was in force stays so.
    pub fn reload(&self) -> Result<(), TlsError> {
        let current = read(&self.files)?;
        *self.current.write() = current;
        Ok(())
    }

    /// What makes TLS of a connection.
    pub fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(Arc::clone(&self.current.read().config))
    }

    /// When the server's certificate ends.
    pub fn ends(&self) -> SystemTime {
        self.current.read().ends
    }
}

fn read(files: &TlsFiles) -> Result<Current, TlsError> {
    let chain = certificates("the certificate", &files.certificate)?;
    let ends = valid_until(&files.certificate, &chain)?;
    let mode = std::fs::metadata(&files.key).map(|file| file.permissions().mode());
    if mode.is_ok_and(|mode| mode & 0o007 != 0) {
        return Err(TlsError::Permissions(files.key.clone()));
    }
    let key = PrivateKeyDer::from_pem_file(&files.key).map_err(|source| TlsError::Unreadable {
        what: "the private key",
        path: files.key.clone(),
        source,
    })?;
    let provider = Arc::new(ring::default_provider());
    let unusable = |source| TlsError::Unusable { files: files.clone(), source };
    let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
        .with_safe_default_protocol_versions()
        .map_err(unusable)?;
    let builder = match &files.client_ca {
        None => builder.with_no_client_auth(),
        Some(path) => {
            let wrong = |reason: String| TlsError::Authorities { path: path.clone(), reason };
            let mut roots = RootCertStore::empty();
            for authority in certificates("the authorities of clients", path)? {
                roots.add(authority).map_err(|error| wrong(error.to_string()))?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(roots.into(), provider);
            builder.with_client_cert_verifier(
                verifier.build().map_err(|error| wrong(error.to_string()))?,
            )
        }
    };
    let mut config = builder.with_single_cert(chain, key).map_err(unusable)?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(Current { config: Arc::new(config), ends })
}

fn certificates(what: &'static str, path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect);
    let read: Vec<_> =
        read.map_err(|source| TlsError::Unreadable { what, path: path.to_owned(), source })?;
    if read.is_empty() {
        return Err(TlsError::Empty(path.to_owned()));
    }
    Ok(read)
}

/// When the first of a chain ends, if it is valid now.
fn valid_until(path: &Path, chain: &[CertificateDer<'_>]) -> Result<SystemTime, TlsError> {
    let path = path.to_owned();
    let validity = match x509_parser::parse_x509_certificate(&chain[0]) {
        Ok((_, certificate)) => certificate.validity().clone(),
        Err(error) => return Err(TlsError::Malformed { path, reason: error.to_string() }),
    };
    let at = |time: x509_parser::time::ASN1Time| {
        SystemTime::UNIX_EPOCH + Duration::from_secs(time.timestamp().max(0) as u64)
    };
    let (begins, ends, now) = (at(validity.not_before), at(validity.not_after), SystemTime::now());
    match () {
        () if ends <= now => Err(TlsError::Expired { path, at: ends }),
        () if begins > now => Err(TlsError::NotYetValid { path, at: begins }),
        () => Ok(ends),
    }
}
