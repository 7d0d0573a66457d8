//! TLS and mutual TLS on both APIs, with certificates made for the test.

use std::{os::unix::fs::PermissionsExt as _, path::PathBuf, sync::Arc};

use gatsbi_proto::v1::{self, model_service_client::ModelServiceClient};
use gatsbi_server::config::Config;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, pem::PemObject as _};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Identity};

use crate::support::config;

/// An authority with a certificate for a server and one for a client.
struct Authority {
    folder: tempfile::TempDir,
    ca: String,
    client: (String, String),
}

impl Authority {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let ca = params.self_signed(&key).unwrap().pem();
        let issuer = Issuer::from_params(&params, &key);
        let signed = |name: &str| {
            let key = KeyPair::generate().unwrap();
            let params = CertificateParams::new(vec![name.to_owned()]).unwrap();
            (params.signed_by(&key, &issuer).unwrap().pem(), key.serialize_pem())
        };
        let ((certificate, private), client) = (signed("localhost"), signed("arm"));
        for (name, text) in [("ca.pem", &ca), ("server.pem", &certificate), ("key.pem", &private)] {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600)).unwrap();
        }
        Self { folder, ca, client }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    async fn app(&self, client_ca: bool) -> gatsbi_server::app::App {
        let config = Config {
            tls_certificate: Some(self.path("server.pem")),
            tls_key: Some(self.path("key.pem")),
            tls_client_ca: client_ca.then(|| self.path("ca.pem")),
            ..config()
        };
        gatsbi_server::app::App::start(config, gatsbi_server::app::load).await.unwrap()
    }

    async fn models(&self, address: std::net::SocketAddr, client: bool) -> Result<usize, String> {
        let tls = ClientTlsConfig::new()
            .ca_certificate(Certificate::from_pem(&self.ca))
            .domain_name("localhost");
        let identity = Identity::from_pem(&self.client.0, &self.client.1);
        let tls = if client { tls.identity(identity) } else { tls };
        let endpoint = Channel::from_shared(format!("https://{address}")).unwrap();
        let channel = endpoint.tls_config(tls).unwrap().connect().await;
        let mut models = ModelServiceClient::new(channel.map_err(|error| error.to_string())?);
        let listed = models.list_models(v1::ListModelsRequest {}).await;
        Ok(listed.map_err(|error| error.to_string())?.into_inner().models.len())
    }

    /// The first line that a path of REST answers with.
    async fn get(
        &self,
        address: std::net::SocketAddr,
        path: &str,
        client: bool,
    ) -> std::io::Result<String> {
        let mut roots = rustls::RootCertStore::empty();
        roots.add(CertificateDer::from_pem_slice(self.ca.as_bytes()).unwrap()).unwrap();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = rustls::ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots);
        let tls = if client {
            let chain = vec![CertificateDer::from_pem_slice(self.client.0.as_bytes()).unwrap()];
            let key = PrivateKeyDer::from_pem_slice(self.client.1.as_bytes()).unwrap();
            builder.with_client_auth_cert(chain, key).unwrap()
        } else {
            builder.with_no_client_auth()
        };
        let stream = tokio::net::TcpStream::connect(address).await?;
        let connector = tokio_rustls::TlsConnector::from(Arc::new(tls));
        let name = ServerName::try_from("localhost").unwrap();
        let mut stream = connector.connect(name, stream).await?;
        let head = format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
        stream.write_all(head.as_bytes()).await?;
        let mut answer = vec![0; 12];
        stream.read_exact(&mut answer).await?;
        Ok(String::from_utf8_lossy(&answer).into_owned())
    }
}

#[tokio::test]
async fn every_listener_speaks_tls_and_nothing_else() {
    let authority = Authority::new();
    let app = authority.app(false).await;
    assert_eq!(authority.models(app.grpc, false).await, Ok(1));
    assert_eq!(authority.get(app.http, "/v1/models", false).await.unwrap(), "HTTP/1.1 200");
    assert_eq!(authority.get(app.admin, "/readyz", false).await.unwrap(), "HTTP/1.1 200");
    assert!(reqwest::get(format!("http://{}/readyz", app.admin)).await.is_err());
    // Whoever connects and says nothing keeps nobody else out.
    let silent = tokio::net::TcpStream::connect(app.http).await.unwrap();
    assert_eq!(authority.get(app.http, "/v1/models", false).await.unwrap(), "HTTP/1.1 200");
    drop(silent);
    app.shutdown().await;
}

#[tokio::test]
async fn with_an_authority_for_clients_they_need_a_certificate() {
    let authority = Authority::new();
    let app = authority.app(true).await;
    assert_eq!(authority.models(app.grpc, true).await, Ok(1));
    assert_eq!(authority.get(app.http, "/v1/models", true).await.unwrap(), "HTTP/1.1 200");
    assert!(authority.models(app.grpc, false).await.is_err());
    assert!(authority.get(app.http, "/v1/models", false).await.is_err());
    let stranger = Authority { ca: authority.ca.clone(), ..Authority::new() };
    assert!(stranger.models(app.grpc, true).await.is_err());
    app.shutdown().await;
}

#[tokio::test]
async fn certificates_are_read_again() {
    let authority = Authority::new();
    let app = authority.app(false).await;
    let successor = Authority::new();
    for name in ["server.pem", "key.pem"] {
        std::fs::copy(successor.path(name), authority.path(name)).unwrap();
    }
    assert_eq!(authority.models(app.grpc, false).await, Ok(1), "not yet");
    app.tls().unwrap().reload().unwrap();
    assert_eq!(successor.models(app.grpc, false).await, Ok(1));
    assert!(authority.models(app.grpc, false).await.is_err());
    std::fs::write(authority.path("server.pem"), "nonsense").unwrap();
    assert!(app.tls().unwrap().reload().is_err());
    assert_eq!(successor.models(app.grpc, false).await, Ok(1), "as before");
    app.shutdown().await;
}
