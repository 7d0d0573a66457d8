//! Keys and certificates as a lab would set them up: made by the program, shown by the client and the command line.

use std::{
    fs,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
};

use gatsbi_client::{ApiKey, Client, Code, Error, NewSession, Options, Tls};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};

use crate::programs::{PATIENCE, Server, gatsbi, run};

/// Writes a file that its owner alone may read.
fn write(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, text).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    path
}

/// An authority, and certificates of a server and a client that it has signed.
fn certificates(folder: &Path) {
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    write(folder, "ca.pem", &params.self_signed(&key).unwrap().pem());
    let issuer = Issuer::from_params(&params, &key);
    for (name, subject) in [("server", "127.0.0.1"), ("client", "arm")] {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec![subject.to_owned()]).unwrap();
        let signed = params.signed_by(&key, &issuer).unwrap();
        write(folder, &format!("{name}.pem"), &signed.pem());
        write(folder, &format!("{name}.key"), &key.serialize_pem());
    }
}

#[tokio::test]
async fn a_lab_with_keys_and_certificates() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    certificates(folder);
    let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let keys = path("keys.toml");
    let new_key = |tenant: &str, role: &str| {
        let made = ["keys", "new", "--tenant", tenant, "--role", role, "--file", &keys];
        run("gatsbi-server", &made).done().trim().to_owned()
    };
    let (key, reader, rival) =
        (new_key("lab", "predict"), new_key("lab", "read"), new_key("rival", "predict"));
    let server = Server::with(&[
        "--grpc-listen",
        "127.0.0.1:0",
        "--keys",
        &keys,
        "--tls-certificate",
        &path("server.pem"),
        "--tls-key",
        &path("server.key"),
        "--tls-client-ca",
        &path("ca.pem"),
    ]);
    let read = |name: &str| fs::read(folder.join(name)).unwrap();
    let identity = Some((read("client.pem"), read("client.key")));
    let tls = Tls { ca: read("ca.pem"), identity, server_name: None };
    let connect = |key: &str| {
        let api_key = Some(ApiKey::new(key).unwrap());
        let tls = Some(tls.clone());
        let options = Options { timeout: PATIENCE, api_key, tls, ..Options::default() };
        let address = server.grpc.clone();
        async move { Client::connect_with(&address, options).await.unwrap() }
    };
    let session = connect(&key).await.create_session(NewSession::default()).await.unwrap();
    let refusal = |error: Error| match error {
        Error::Refused(problem) => (problem.code, problem.reason),
        other => panic!("{other:?}"),
    };
    let others = connect(&rival).await.session(session.id()).await.unwrap_err();
    assert_eq!(refusal(others), (Code::NotFound, "UNKNOWN_SESSION".to_owned()));
    let reads = connect(&reader).await;
    assert_eq!(reads.session(session.id()).await.unwrap().id(), session.id());
    let refused = reads.create_session(NewSession::default()).await.unwrap_err();
    assert_eq!(refusal(refused), (Code::PermissionDenied, "ROLE_TOO_LOW".to_owned()));

    let (ca, certificate, private) = (path("ca.pem"), path("client.pem"), path("client.key"));
    let line = |more: &[&str]| {
        gatsbi(&[&["--server", &server.grpc, "--ca", &ca, "--json", "models"], more].concat())
    };
    let own = ["--certificate", certificate.as_str(), "--key", &private];
    assert!(line(&[&own, ["--api-key", &key].as_slice()].concat()).done().contains("tiny"));
    assert_eq!(line(&own).error()["reason"], "NO_KEY");
    assert_eq!(line(&["--api-key", &key]).code, Some(4), "it has no certificate");
    let plain = gatsbi(&["--server", &server.grpc, "--api-key", &key, "--json", "models"]);
    assert_eq!(plain.code, Some(4), "it speaks no TLS");
    assert!(!server.log().contains(&key), "{}", server.log());
}
