//! Robots of other servers, which have the model's twin behind them (`peers/`): frame and action in, objects out.
//!
//! Each is spoken to in the leanest way that it documents. A body is 64 x 64 pixels, red, then green, then blue, and the
//! action as 32-bit floats; the answer is the table of objects.

use anyhow::{Result, ensure};
use base64::{Engine as _, engine::general_purpose::STANDARD};
use clap::ValueEnum;
use reqwest::{Client, Response};
use serde_json::{Value, json};

use crate::robot::picture;

/// Pixels of a side.
const SIDE: u32 = 64;

/// Which server.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum PeerKind {
    /// The session's number in 16 digits before the body, as bytes.
    Mosec,
    /// JSON with base64.
    Litserve,
    /// The binary extension of its HTTP API, and its sequences.
    Triton,
}

/// A session of a peer.
#[derive(Debug)]
pub(crate) struct Peer {
    kind: PeerKind,
    url: String,
    session: u64,
    body: Vec<u8>,
    begun: bool,
    client: Client,
}

impl Peer {
    pub(crate) fn new(kind: PeerKind, url: &str, number: u64, actions: usize) -> Self {
        let mut body = picture(SIDE, number);
        body.extend(std::iter::repeat_n(0.1f32.to_le_bytes(), actions).flatten());
        // Sequences of a run before must not be met again.
        let began = std::time::UNIX_EPOCH.elapsed().unwrap_or_default().as_millis() as u64;
        let session = (began << 8) | (number + 1);
        Self { kind, url: url.to_owned(), session, body, begun: false, client: Client::new() }
    }

    pub(crate) async fn observe(&mut self) -> Result<()> {
        let begins = !std::mem::replace(&mut self.begun, true);
        let objects = match self.kind {
            PeerKind::Mosec => {
                let mut body = format!("{:016}", self.session).into_bytes();
                body.extend(&self.body);
                let request = self.client.post(format!("{}/inference", self.url)).body(body);
                done(request.send().await?).await?.bytes().await?.len()
            }
            PeerKind::Litserve => {
                let body = STANDARD.encode(&self.body);
                let body = json!({ "session": self.session.to_string(), "body": body });
                let request = self.client.post(format!("{}/predict", self.url)).json(&body);
                let answer: Value = done(request.send().await?).await?.json().await?;
                STANDARD.decode(answer["objects"].as_str().unwrap_or_default())?.len()
            }
            PeerKind::Triton => self.infer(begins, false).await?,
        };
        ensure!(objects > 0, "{} answered no objects", self.url);
        Ok(())
    }

    pub(crate) async fn leave(self) -> Result<()> {
        if let PeerKind::Triton = self.kind {
            self.infer(false, true).await?;
        }
        Ok(())
    }

    /// A request of the inference protocol; returns the bytes of its output.
    async fn infer(&self, begins: bool, ends: bool) -> Result<usize> {
        let length = self.body.len();
        let head = json!({
            "parameters": {
                "sequence_id": self.session,
                "sequence_start": begins,
                "sequence_end": ends,
            },
            "inputs": [{
                "name": "BODY",
                "shape": [1, length],
                "datatype": "UINT8",
                "parameters": { "binary_data_size": length },
            }],
            "outputs": [{ "name": "OBJECTS", "parameters": { "binary_data": true } }],
        });
        let mut body = head.to_string().into_bytes();
        let head = body.len();
        body.extend(&self.body);
        let request = self.client.post(format!("{}/v2/models/twin/infer", self.url));
        let request = request.header("Inference-Header-Content-Length", head).body(body);
        let answer = done(request.send().await?).await?;
        let header = answer.headers().get("Inference-Header-Content-Length").cloned();
        let header = header.and_then(|length| length.to_str().ok()?.parse().ok()).unwrap_or(0);
        Ok(answer.bytes().await?.len().saturating_sub(header))
    }
}

/// An answer that says what was done.
async fn done(answer: Response) -> Result<Response> {
    let status = answer.status();
    if !status.is_success() {
        anyhow::bail!("{status}: {}", answer.text().await?);
    }
    Ok(answer)
}
