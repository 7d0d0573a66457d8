//! Servers that end: what becomes of sessions, and of a rollout that is on its way.

use gatsbi_client::{
    Actions, Client, Code, Error, Imagination, NewSession, Options, Output, Retries, RolloutStream,
    Selection, Session,
};

use crate::{
    episode::{imagined, wanted},
    programs::{PATIENCE, Server},
    recording::{Told, episode, observation},
};

#[tokio::test]
async fn a_restarted_server_has_forgotten_sessions_and_answers_the_same() {
    let episode = episode();
    let new = || NewSession { seed: Some(8), ..NewSession::default() };
    let server = Server::start();
    let address = server.grpc.clone();
    let client = server.client().await;
    let session = client.create_session(new()).await.unwrap();
    let mut before = Vec::new();
    for t in 0..3 {
        let belief = session.observe(observation(&episode, t), &wanted()).await.unwrap();
        before.push(Told::from(&belief));
    }
    let imagined_before = imagined(&session, &episode).await;
    server.terminate();
    let (status, log) = server.wait().await;
    assert!(status.success() && !log.contains("WARN"), "{status}: {log}");

    // The same connection finds the next server at this address.
    let _server = Server::with(&["--grpc-listen", &address]);
    let error = session.observe(observation(&episode, 3), &wanted()).await.unwrap_err();
    let problem = error.problem().unwrap_or_else(|| panic!("{error:?}"));
    assert_eq!((problem.code, problem.reason.as_str()), (Code::NotFound, "UNKNOWN_SESSION"));

    let session = client.create_session(new()).await.unwrap();
    for (t, before) in before.iter().enumerate() {
        let belief = session.observe(observation(&episode, t), &wanted()).await.unwrap();
        assert_eq!(&Told::from(&belief), before);
    }
    assert_eq!(imagined(&session, &episode).await, imagined_before);
}

#[tokio::test]
async fn a_rollout_that_is_on_its_way_is_finished_first() {
    let server = Server::with(&["--grpc-listen", "127.0.0.1:0", "--drain-seconds", "300"]);
    let session = observed(&server).await;
    let mut rollout = long(&session, 2, 24).await;
    rollout.next().await.unwrap().unwrap();
    server.terminate();
    let mut last = false;
    while let Some(chunk) = rollout.next().await {
        last = chunk.unwrap().last;
    }
    assert!(last);
    let address = server.grpc.clone();
    let (status, log) = server.wait().await;
    assert!(status.success(), "{status}: {log}");
    assert!(log.contains("shutting down") && !log.contains("ERROR"), "{log}");
    let nobody = Client::connect_with(&address, without_retries()).await.unwrap_err();
    assert!(matches!(nobody, Error::Unreachable { .. }), "{nobody:?}");
}

#[tokio::test]
async fn a_rollout_that_takes_too_long_is_cut_off() {
    let server = Server::with(&["--grpc-listen", "127.0.0.1:0", "--drain-seconds", "0"]);
    let session = observed(&server).await;
    // Minutes of work.
    let mut rollout = long(&session, 1024, 256).await;
    rollout.next().await.unwrap().unwrap();
    server.terminate();
    let error = loop {
        match rollout.next().await.expect("it does not end well") {
            Ok(chunk) => assert!(!chunk.last),
            Err(error) => break error,
        }
    };
    assert!(error.may_pass(), "{error:?}");
    assert!(rollout.next().await.is_none());
    let (status, log) = server.wait().await;
    assert!(status.success(), "{status}: {log}");
    assert!(log.contains("requests were cut off"), "{log}");
    assert!(!log.contains("has not ended") && !log.contains("ERROR"), "{log}");
}

/// A session that has observed a frame, over a connection that repeats nothing.
async fn observed(server: &Server) -> Session {
    let client = Client::connect_with(&server.grpc, without_retries()).await.unwrap();
    let session = client.create_session(NewSession::default()).await.unwrap();
    session.observe(observation(&episode(), 0), &wanted()).await.unwrap();
    session
}

async fn long(session: &Session, candidates: usize, horizon: usize) -> RolloutStream {
    let shape = [candidates, horizon, 7];
    let actions = Actions::new(shape, vec![0.1; shape.iter().product()]).unwrap();
    let objects = Selection::of([Output::Objects]);
    session.imagine(Imagination::of(actions, objects)).await.unwrap()
}

fn without_retries() -> Options {
    let retries = Retries { most: 0, ..Retries::default() };
    Options { retries, timeout: PATIENCE, ..Options::default() }
}
