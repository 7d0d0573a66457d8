//! A connection to a server: models, sessions, and how calls are repeated.
//!
//! A call is repeated where that is safe: the service numbers the steps of a session and answers a repeated one from
//! what it stored, imagining changes nothing, and a request that was refused was not carried out. What is done with a
//! session is in [`crate::Session`].

use std::time::Duration;

use backon::{BackoffBuilder as _, ExponentialBuilder};
use gatsbi_proto::v1::{
    self, CreateSessionRequest, GetModelRequest, GetSessionRequest, ListModelsRequest,
    ListSessionsRequest, imagination_service_client::ImaginationServiceClient,
    model_service_client::ModelServiceClient, session_service_client::SessionServiceClient,
};
use tokio::time::Instant;
use tonic::{
    Code, Request, Response, Status,
    service::interceptor::InterceptedService,
    transport::{Channel, Endpoint},
};

use crate::{
    Mode, Model, SessionInfo,
    access::{ApiKey, Bearer, Tls},
    error::{Error, Result},
    session::Session,
};

/// How a client connects, waits and repeats. The defaults suit a robot and a server in one building.
#[derive(Clone, Debug)]
pub struct Options {
    /// For connecting; 5 s by default.
    pub connect_timeout: Duration,
    /// For a call with all its repetitions, and for each chunk of a rollout; 30 s by default. The server is told, and
    /// does not begin what would come too late.
    pub timeout: Duration,
    /// After how long without traffic the connection is tested, also between calls; 10 s by default. It counts as
    /// broken if the test is not answered within twice that time.
    pub keepalive: Duration,
    /// Largest message that is accepted; 16 MiB by default. The service's own stay below 4 MB.
    pub max_message_bytes: usize,
    /// How calls are repeated.
    pub retries: Retries,
    /// The key that the server asks for; none by default.
    pub api_key: Option<ApiKey>,
    /// How TLS is spoken, which a URL with `https://` needs; not by default.
    pub tls: Option<Tls>,
}

/// How calls are repeated. Each pause is twice as long as the one before, up to a random part of itself longer, and
/// never shorter than the server asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retries {
    /// Repetitions of a call; 0 for none, 4 by default.
    pub most: usize,
    /// The first pause; 50 ms by default.
    pub first_pause: Duration,
    /// The longest pause; 2 s by default.
    pub longest_pause: Duration,
}

/// A connection that shows the key.
pub(crate) type Keyed = InterceptedService<Channel, Bearer>;

/// A connection. Clones share it; a broken one is made anew by the next call.
#[derive(Clone, Debug)]
pub struct Client {
    channel: Keyed,
    options: Options,
}

/// What a new session is to be; the default leaves everything to the server.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NewSession {
    /// Name of the model; may be empty where the server has one only.
    pub model: String,
    /// A name of your own, at most 128 characters.
    pub label: String,
    /// Whether observing draws ([`Mode::Sample`], the default) or takes means.
    pub mode: Mode,
    /// Seed of observing; drawn by the server if absent.
    pub seed: Option<u64>,
    /// How long it may lie unused; the server's limit if absent.
    pub ttl: Option<Duration>,
}

/// Whether a call may be carried out twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Repeat {
    Harmless,
    Harmful,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            connect_timeout: Duration::from_secs(5),
            timeout: Duration::from_secs(30),
            keepalive: Duration::from_secs(10),
            max_message_bytes: 16 << 20,
            retries: Retries::default(),
            api_key: None,
            tls: None,
        }
    }
}

impl Default for Retries {
    fn default() -> Self {
        Self {
            most: 4,
            first_pause: Duration::from_millis(50),
            longest_pause: Duration::from_secs(2),
        }
    }
}

impl Client {
    /// Connects to `url`, such as `http://127.0.0.1:50051`; `http://` may be left out, and so may `https://`, which it
    /// is with [`Options::tls`].
    ///
    /// # Errors
    /// [`Error::Address`] and [`Error::Unreachable`].
    pub async fn connect(url: &str) -> Result<Self> {
        Self::connect_with(url, Options::default()).await
    }

    /// Connects with other options than the defaults.
    ///
    /// # Errors
    /// [`Error::Address`] and [`Error::Unreachable`].
    pub async fn connect_with(url: &str, options: Options) -> Result<Self> {
        let channel = endpoint(url, &options)?
            .connect()
            .await
            .map_err(|source| Error::Unreachable { url: url.to_owned(), source })?;
        let bearer = Bearer(options.api_key.clone());
        Ok(Self { channel: InterceptedService::new(channel, bearer), options })
    }

    /// The models that the server serves, sorted by name.
    ///
    /// # Errors
    /// What the server refuses, and a connection that breaks; so for all calls.
    pub async fn models(&self) -> Result<Vec<Model>> {
        let answer = self
            .call(Repeat::Harmless, ListModelsRequest {}, |request| {
                let mut service = self.model_service();
                async move { service.list_models(request).await }
            })
            .await?;
        Ok(answer.models)
    }

    /// The model called `name`.
    ///
    /// # Errors
    /// `UNKNOWN_MODEL`.
    pub async fn model(&self, name: &str) -> Result<Model> {
        let request = GetModelRequest { model: name.to_owned() };
        let answer = self
            .call(Repeat::Harmless, request, |request| {
                let mut service = self.model_service();
                async move { service.get_model(request).await }
            })
            .await?;
        answer.model.ok_or_else(|| Error::Answer("a model is missing".into()))
    }

    /// Opens a session that has seen nothing. This call alone is not repeated when the connection breaks: the lost
    /// session would lie there until it expires.
    ///
    /// # Errors
    /// `UNKNOWN_MODEL`, `INVALID_FIELDS`, `TOO_MANY_SESSIONS`.
    pub async fn create_session(&self, new: NewSession) -> Result<Session> {
        let request = CreateSessionRequest {
            model: new.model,
            label: new.label,
            mode: new.mode as i32,
            seed: new.seed,
            ttl: new.ttl.map(duration).transpose()?,
            ..CreateSessionRequest::default()
        };
        let answer = self
            .call(Repeat::Harmful, request, |request| {
                let mut service = self.session_service();
                async move { service.create_session(request).await }
            })
            .await?;
        Ok(Session::new(self.clone(), answer.session.ok_or_else(no_session)?))
    }

    /// The open session `id`.
    ///
    /// # Errors
    /// `UNKNOWN_SESSION`.
    pub async fn session(&self, id: &str) -> Result<Session> {
        Ok(Session::new(self.clone(), self.session_info(id).await?))
    }

    /// All open sessions, or those with this label, sorted by id.
    ///
    /// # Errors
    /// A connection that breaks.
    pub async fn sessions(&self, label: Option<&str>) -> Result<Vec<SessionInfo>> {
        let mut sessions = Vec::new();
        let mut request = ListSessionsRequest {
            page_size: Some(1000),
            label: label.unwrap_or_default().to_owned(),
            ..ListSessionsRequest::default()
        };
        loop {
            let page = self
                .call(Repeat::Harmless, request.clone(), |request| {
                    let mut service = self.session_service();
                    async move { service.list_sessions(request).await }
                })
                .await?;
            sessions.extend(page.sessions);
            if page.next_page_token.is_empty() {
                return Ok(sessions);
            }
            request.page_token = page.next_page_token;
        }
    }

    pub(crate) async fn session_info(&self, id: &str) -> Result<SessionInfo> {
        let request = GetSessionRequest { session_id: id.to_owned() };
        let answer: v1::GetSessionResponse = self
            .call(Repeat::Harmless, request, |request| {
                let mut service = self.session_service();
                async move { service.get_session(request).await }
            })
            .await?;
        answer.session.ok_or_else(no_session)
    }

    pub(crate) fn options(&self) -> &Options {
        &self.options
    }

    pub(crate) fn model_service(&self) -> ModelServiceClient<Keyed> {
        ModelServiceClient::new(self.channel.clone())
            .max_decoding_message_size(self.options.max_message_bytes)
    }

    pub(crate) fn session_service(&self) -> SessionServiceClient<Keyed> {
        SessionServiceClient::new(self.channel.clone())
            .max_decoding_message_size(self.options.max_message_bytes)
    }

    pub(crate) fn imagination_service(&self) -> ImaginationServiceClient<Keyed> {
        ImaginationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(self.options.max_message_bytes)
    }

    /// Sends a request, and again as [`Retries`] says, until an answer comes or the client's time is up.
    pub(crate) async fn call<Q, A, F>(
        &self,
        repeat: Repeat,
        query: Q,
        send: impl Fn(Request<Q>) -> F,
    ) -> Result<A>
    where
        Q: Clone,
        F: Future<Output = Result<Response<A>, Status>>,
    {
        self.call_within(self.options.timeout, repeat, query, send).await
    }

    /// The same with a time of its own.
    pub(crate) async fn call_within<Q, A, F>(
        &self,
        time: Duration,
        repeat: Repeat,
        query: Q,
        send: impl Fn(Request<Q>) -> F,
    ) -> Result<A>
    where
        Q: Clone,
        F: Future<Output = Result<Response<A>, Status>>,
    {
        let deadline = Instant::now() + time;
        let mut pauses = self.options.retries.pauses();
        loop {
            let mut request = Request::new(query.clone());
            request.set_timeout(deadline.saturating_duration_since(Instant::now()));
            let answer = tokio::time::timeout_at(deadline, send(request)).await;
            let error = match answer {
                Ok(Ok(answer)) => return Ok(answer.into_inner()),
                Ok(Err(status)) if Instant::now() < deadline => Error::from(status),
                Ok(Err(_)) | Err(_) => return Err(Error::TimedOut(time)),
            };
            self.options.retries.wait(&error, repeat, &mut pauses, deadline).await.ok_or(error)?;
        }
    }
}

impl Retries {
    pub(crate) fn pauses(&self) -> impl Iterator<Item = Duration> + Send + use<> {
        ExponentialBuilder::new()
            .with_min_delay(self.first_pause)
            .with_max_delay(self.longest_pause)
            .with_max_times(self.most)
            .with_jitter()
            .build()
    }

    /// Waits until a call that failed may be repeated; returns nothing, at once, if it may not or would come too late.
    pub(crate) async fn wait(
        &self,
        error: &Error,
        repeat: Repeat,
        pauses: &mut (impl Iterator<Item = Duration> + Send),
        deadline: Instant,
    ) -> Option<()> {
        let asked = pause_asked(error, repeat)?;
        let until = Instant::now() + pauses.next()?.max(asked);
        if until >= deadline {
            return None;
        }
        tokio::time::sleep_until(until).await;
        Some(())
    }
}

/// The least pause before a call that failed so may be repeated; nothing if it may not.
fn pause_asked(error: &Error, repeat: Repeat) -> Option<Duration> {
    match error {
        Error::Broken(_) => (repeat == Repeat::Harmless).then_some(Duration::ZERO),
        Error::Refused(problem) => problem.retry_after.or_else(|| {
            let gone = problem.code == Code::Unavailable && repeat == Repeat::Harmless;
            gone.then_some(Duration::ZERO)
        }),
        _ => None,
    }
}

fn endpoint(url: &str, options: &Options) -> Result<Endpoint> {
    let wrong = || Error::Address { url: url.to_owned() };
    let scheme = if options.tls.is_some() { "https" } else { "http" };
    let whole = if url.contains("://") { url.to_owned() } else { format!("{scheme}://{url}") };
    let Ok(endpoint) = Endpoint::from_shared(whole) else { return Err(wrong()) };
    let uri = endpoint.uri();
    if uri.scheme_str() != Some(scheme) || uri.host().is_none_or(str::is_empty) || uri.path() != "/"
    {
        return Err(wrong());
    }
    let endpoint = match &options.tls {
        Some(tls) => endpoint
            .tls_config(tls.config())
            .map_err(|source| Error::Unreachable { url: url.to_owned(), source })?,
        None => endpoint,
    };
    Ok(endpoint
        .connect_timeout(options.connect_timeout)
        .http2_keep_alive_interval(options.keepalive)
        .keep_alive_timeout(options.keepalive * 2)
        .keep_alive_while_idle(true)
        .tcp_nodelay(true)
        // 64 KiB, the default, would wait for the server's leave within one frame.
        .initial_stream_window_size(4 << 20)
        .initial_connection_window_size(16 << 20))
}

fn duration(ttl: Duration) -> Result<prost_types::Duration> {
    let Ok(duration) = ttl.try_into() else {
        return Err(Error::input("ttl", format!("{} s", ttl.as_secs()), "less than 2^63 seconds"));
    };
    Ok(duration)
}

fn no_session() -> Error {
    Error::Answer("a session is missing".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Problem;

    fn refused(code: Code, retry_after: Option<Duration>) -> Error {
        Error::Refused(Box::new(Problem {
            code,
            reason: String::new(),
            message: String::new(),
            fields: Vec::new(),
            retry_after,
        }))
    }

    fn broken() -> Error {
        let cause = std::io::Error::from(std::io::ErrorKind::BrokenPipe);
        Error::Broken(Box::new(Status::from_error(cause.into())))
    }

    #[test]
    fn addresses_are_checked() {
        let options = Options::default();
        for right in ["http://127.0.0.1:50051", "127.0.0.1:50051", "robot.local:80", "[::1]:50051"]
        {
            assert!(endpoint(right, &options).is_ok(), "{right}");
        }
        for wrong in ["", "https://robot:1", "http://", "file:///tmp", "a b", "http://robot/v1"] {
            let error = endpoint(wrong, &options).unwrap_err();
            assert!(matches!(error, Error::Address { .. }), "{wrong}: {error}");
        }
    }

    #[test]
    fn only_what_is_safe_or_was_refused_is_repeated() {
        let half = Duration::from_millis(500);
        for (error, harmless, harmful) in [
            (broken(), Some(Duration::ZERO), None),
            (refused(Code::Unavailable, None), Some(Duration::ZERO), None),
            (refused(Code::Unavailable, Some(half)), Some(half), Some(half)),
            (refused(Code::ResourceExhausted, Some(half)), Some(half), Some(half)),
            (refused(Code::ResourceExhausted, None), None, None),
            (refused(Code::InvalidArgument, None), None, None),
            (refused(Code::DeadlineExceeded, None), None, None),
            (Error::TimedOut(half), None, None),
        ] {
            assert_eq!(pause_asked(&error, Repeat::Harmless), harmless, "{error:?}");
            assert_eq!(pause_asked(&error, Repeat::Harmful), harmful, "{error:?}");
        }
    }

    #[test]
    fn pauses_grow_to_a_limit_and_end() {
        let retries = Retries {
            most: 5,
            first_pause: Duration::from_millis(100),
            longest_pause: Duration::from_millis(400),
        };
        let pauses: Vec<_> = retries.pauses().map(|pause| pause.as_millis()).collect();
        for (pause, least) in pauses.iter().zip([100, 200, 400, 400, 400]) {
            assert!((least..=2 * least).contains(pause), "{pauses:?}");
        }
        assert_eq!(pauses.len(), 5);
        assert_eq!(Retries { most: 0, ..retries }.pauses().count(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn a_repetition_waits_as_long_as_the_server_asks_and_never_past_the_deadline() {
        let retries = Retries::default();
        let error = refused(Code::ResourceExhausted, Some(Duration::from_secs(1)));
        let wait = |within| {
            let error = &error;
            async move {
                let began = Instant::now();
                let mut pauses = retries.pauses();
                let again = retries.wait(error, Repeat::Harmful, &mut pauses, began + within).await;
                (again.is_some(), began.elapsed())
            }
        };
        let (again, waited) = wait(Duration::from_secs(5)).await;
        assert!(again && waited >= Duration::from_secs(1), "{waited:?}");
        let (again, waited) = wait(Duration::from_millis(900)).await;
        assert!(!again && waited.is_zero(), "{waited:?}");
    }
}
