//! How long an answer may go on: one that comes in parts, such as a control loop or a feed, ends when its key does.
//!
//! The gate puts every answer without a known end into [`Leased`]. When the key is gone from the file, has expired or
//! may do less than it could, the answer ends with the same error that a new request would get, in the form that its
//! reader understands, and what made it is dropped.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, SystemTime},
};

use axum::{
    body::{Body, Bytes, HttpBody},
    http::{HeaderMap, header},
    response::Response,
};
use http_body::{Frame, SizeHint};
use tokio::{sync::watch, time::sleep};

use super::{Access, key::KeyDigest, key::Role};
use crate::{
    api::problem::{self, Document},
    error::Error,
    telemetry,
};

/// The clock may be set, so nobody sleeps for longer than this.
const LOOK_AGAIN: Duration = Duration::from_secs(30);

/// What a request was let in on.
#[derive(Clone, Debug)]
pub struct Lease {
    access: Arc<Access>,
    digest: KeyDigest,
    needs: Role,
    tenant: String,
    changes: watch::Receiver<()>,
}

impl Lease {
    pub(super) fn new(
        access: &Arc<Access>,
        (digest, needs): (KeyDigest, Role),
        tenant: &str,
        changes: watch::Receiver<()>,
    ) -> Self {
        Self { access: Arc::clone(access), digest, needs, tenant: tenant.to_owned(), changes }
    }

    /// Waits until the request would not be let in any more; returns why.
    pub async fn ended(mut self) -> Error {
        loop {
            self.changes.borrow_and_update();
            let entry = match self.access.entry(&self.digest, self.needs) {
                // The same key, but what it sees is another's.
                Ok(entry) if entry.tenant != self.tenant => return Error::WrongKey,
                Ok(entry) => entry,
                Err(error) => return error,
            };
            let left = entry.expires.map(|at| at.duration_since(SystemTime::now()));
            let left = left.map_or(LOOK_AGAIN, |left| left.unwrap_or_default().min(LOOK_AGAIN));
            tokio::select! {
                // Whoever holds a lease holds its sender.
                _ = self.changes.changed() => {}
                () = sleep(left) => {}
            }
        }
    }
}

/// How an answer in parts tells of an error.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Form {
    /// In the trailers.
    Grpc,
    /// As an event called `problem`.
    Events,
    /// As the last line, `{"problem": ...}`.
    Lines,
}

impl Form {
    fn of(headers: &HeaderMap) -> Option<Self> {
        let media = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
        let forms = [
            ("application/grpc", Self::Grpc),
            ("text/event-stream", Self::Events),
            ("application/x-ndjson", Self::Lines),
        ];
        forms.into_iter().find(|(name, _)| media.starts_with(name)).map(|(_, form)| form)
    }

    fn last(self, error: &Error) -> Frame<Bytes> {
        let document = || serde_json::to_string(&Document::from(error)).expect("plain data");
        match self {
            Self::Grpc => {
                let mut trailers = HeaderMap::new();
                let written = problem::status(error).add_header(&mut trailers);
                // The messages of our errors are text, which headers can hold.
                debug_assert!(written.is_ok());
                Frame::trailers(trailers)
            }
            Self::Events => Frame::data(format!("event: problem\ndata: {}\n\n", document()).into()),
            Self::Lines => Frame::data(format!("{{\"problem\":{}}}\n", document()).into()),
        }
    }
}

/// The body of an answer that ends when its key does.
struct Leased {
    answer: Body,
    form: Form,
    ended: Option<Pin<Box<dyn Future<Output = Error> + Send>>>,
}

/// Lets an answer that comes in parts go on for no longer than its key does.
pub(super) fn leased(response: Response, lease: Lease) -> Response {
    let Some(form) = Form::of(response.headers()) else { return response };
    if response.body().is_end_stream() || response.body().size_hint().exact().is_some() {
        return response;
    }
    response.map(|answer| Body::new(Leased { answer, form, ended: Some(Box::pin(lease.ended())) }))
}

impl HttpBody for Leased {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = self.get_mut();
        if let Some(ended) = &mut this.ended
            && let Poll::Ready(error) = ended.as_mut().poll(context)
        {
            this.ended = None;
            this.answer = Body::empty();
            let reason = problem::entry(&error).reason;
            telemetry::turned_away(reason);
            tracing::info!(reason, "an answer ended with its key");
            return Poll::Ready(Some(Ok(this.form.last(&error))));
        }
        Pin::new(&mut this.answer).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.answer.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        // It may end in words of its own.
        SizeHint::default()
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use futures_util::{StreamExt as _, stream};

    use super::*;
    use crate::access::{
        key::new_secret,
        key_file::{Entry, written},
        need::Need,
        tenants::Quota,
    };

    const QUOTA: Quota = Quota { sessions: 1, rows: 1, kept_bytes: 1 };

    struct Keys {
        _folder: tempfile::TempDir,
        path: PathBuf,
        secret: String,
    }

    impl Keys {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("keys.toml");
            Self { _folder: folder, path, secret: new_secret() }
        }

        /// Replaces what is in the file.
        fn hold(&self, tenant: &str, role: Role, secret: &str, lasts: Option<Duration>) {
            use std::os::unix::fs::PermissionsExt as _;
            let digest = KeyDigest::of(secret);
            let expires = lasts.map(|lasts| SystemTime::now() + lasts);
            let tenant = tenant.to_owned();
            let entry = written(&Entry { tenant, role, digest, name: None, expires });
            std::fs::write(&self.path, entry).unwrap();
            let owners = std::fs::Permissions::from_mode(0o600);
            std::fs::set_permissions(&self.path, owners).unwrap();
        }

        fn access(&self) -> Arc<Access> {
            Arc::new(Access::load(&self.path, QUOTA).unwrap())
        }

        fn lease(&self, access: &Arc<Access>) -> Lease {
            let pass = access.admit(Some(&self.secret), Need::Role(Role::Predict)).unwrap();
            pass.unwrap().lease
        }
    }

    async fn soon<T>(answer: impl Future<Output = T>) -> T {
        tokio::time::timeout(Duration::from_secs(20), answer).await.expect("it ends soon")
    }

    #[tokio::test]
    async fn a_lease_ends_when_its_key_would_not_be_let_in_any_more() {
        let keys = Keys::new();
        let secret = keys.secret.clone();
        let changes: [(&str, Role, &str, Error); 3] = [
            ("lab", Role::Predict, "another", Error::WrongKey),
            ("rival", Role::Predict, &secret, Error::WrongKey),
            ("lab", Role::Read, &secret, Error::RoleTooLow { role: "read", needs: "predict" }),
        ];
        for (tenant, role, now, expected) in changes {
            keys.hold("lab", Role::Predict, &secret, None);
            let access = keys.access();
            let ended = tokio::spawn(keys.lease(&access).ended());
            // The same key again, now with an end and a higher role, changes nothing.
            keys.hold("lab", Role::Admin, &secret, Some(Duration::from_hours(1)));
            access.reload(QUOTA).unwrap();
            tokio::task::yield_now().await;
            assert!(!ended.is_finished());
            keys.hold(tenant, role, now, None);
            access.reload(QUOTA).unwrap();
            assert_eq!(soon(ended).await.unwrap(), expected);
        }
        keys.hold("lab", Role::Predict, &secret, Some(Duration::from_millis(200)));
        let access = keys.access();
        assert_eq!(soon(keys.lease(&access).ended()).await, Error::ExpiredKey);
    }

    #[tokio::test]
    async fn an_answer_in_parts_ends_in_the_words_of_its_form() {
        for (media, form) in [
            ("application/grpc", Form::Grpc),
            ("text/event-stream", Form::Events),
            ("application/x-ndjson", Form::Lines),
        ] {
            let keys = Keys::new();
            keys.hold("lab", Role::Predict, &keys.secret, None);
            let access = keys.access();
            let parts = stream::iter([Ok::<_, Error>("part")]).chain(stream::pending());
            let response = Response::builder().header(header::CONTENT_TYPE, media);
            let response = response.body(Body::from_stream(parts)).unwrap();
            let mut body = leased(response, keys.lease(&access)).into_body();
            let mut next = async || {
                let frame = std::future::poll_fn(|cx| Pin::new(&mut body).poll_frame(cx));
                soon(frame).await.map(Result::unwrap)
            };
            assert_eq!(next().await.unwrap().into_data().unwrap(), "part");
            keys.hold("lab", Role::Predict, "another", None);
            access.reload(QUOTA).unwrap();
            let last = next().await.unwrap();
            match form {
                Form::Grpc => assert_eq!(last.trailers_ref().unwrap()["grpc-status"], "16"),
                Form::Events | Form::Lines => {
                    let told = String::from_utf8(last.into_data().unwrap().to_vec()).unwrap();
                    assert!(told.contains("\"reason\":\"WRONG_KEY\"") && told.ends_with('\n'));
                    assert_eq!(told.starts_with("event: problem\n"), form == Form::Events);
                }
            }
            assert!(next().await.is_none());
        }
    }
}
