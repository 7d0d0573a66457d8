//! Who gets in: every method of both APIs, tried with every kind of key.
//!
//! Methods come from the descriptors and paths from the OpenAPI document, so one that is added is tried, too.

use std::time::{Duration, SystemTime};

use gatsbi_proto::v1::{self, session_service_client::SessionServiceClient};
use gatsbi_server::{
    access::{
        key::{Role, new_secret},
        need::METHODS,
    },
    config::Config,
};
use serde_json::{Value as Json, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tonic::transport::Channel;

use crate::{
    knock::{self, Answer, KeyFile, Things, methods, name},
    support::{TestServer, config, observation},
    watching::Feed,
};

const NOWHERE: &str = "00000000000000000000000000000000";

/// A server with keys.
struct Guarded {
    server: TestServer,
    file: KeyFile,
    grpc: Channel,
    admin: Channel,
    /// Name and key; the roles are those of the tenant `lab`.
    read: String,
    predict: String,
    admin_key: String,
    expired: String,
    /// Of the tenant `rival`.
    rival: String,
}

impl Guarded {
    async fn start() -> Self {
        let mut file = KeyFile::new();
        let (read, predict) = (file.key("lab", Role::Read), file.key("lab", Role::Predict));
        let admin_key = file.key("lab", Role::Admin);
        let past = SystemTime::now() - Duration::from_secs(1);
        let expired = file.key_until("lab", Role::Admin, Some(past));
        let rival = file.key("rival", Role::Predict);
        let keys = Some(file.0.path().to_owned());
        let server = TestServer::with(Config { keys, ..config() }).await;
        let connect = |address| Channel::from_shared(format!("http://{address}")).unwrap();
        let grpc = connect(server.app.grpc).connect().await.unwrap();
        let admin = connect(server.app.admin).connect().await.unwrap();
        Self { server, file, grpc, admin, read, predict, admin_key, expired, rival }
    }

    /// Names of credentials, the keys, and the role of those that are good.
    fn credentials(&self) -> [(&'static str, Option<String>, Option<Role>); 6] {
        [
            ("none", None, None),
            ("wrong", Some(new_secret()), None),
            ("expired", Some(self.expired.clone()), None),
            ("read", Some(self.read.clone()), Some(Role::Read)),
            ("predict", Some(self.predict.clone()), Some(Role::Predict)),
            ("admin", Some(self.admin_key.clone()), Some(Role::Admin)),
        ]
    }

    async fn call<Q: prost::Message, A: prost::Message + Default>(
        &self,
        key: &str,
        method: &str,
        request: &Q,
    ) -> A {
        let method = methods().into_iter().find(|it| name(it) == method).unwrap();
        let message = request.encode_to_vec().into();
        let answer = knock::grpc(&self.grpc, &method, message, Some(key)).await;
        assert_eq!(answer.code, "Ok", "{method:?} {answer:?}");
        A::decode(answer.told.as_slice()).unwrap()
    }

    /// A session that has observed a step, a goal, and handles of the tenant `lab`.
    async fn things(&self) -> Things {
        let key = &self.predict;
        let request = v1::CreateSessionRequest { seed: Some(3), ..Default::default() };
        let opened: v1::CreateSessionResponse =
            self.call(key, "SessionService/CreateSession", &request).await;
        let session = opened.session.unwrap();
        let _: v1::ObserveResponse =
            self.call(key, "SessionService/Observe", &observation(&session, 0)).await;
        let request = v1::ExportSessionRequest { session_id: session.id.clone(), at_step: None };
        let exported: v1::ExportSessionResponse =
            self.call(key, "SessionService/ExportSession", &request).await;
        let image = observation(&session, 0).observation.unwrap().image;
        let goal: v1::PutGoalResponse = self
            .call(
                key,
                "PlanningService/PutGoal",
                &v1::PutGoalRequest { image, ..Default::default() },
            )
            .await;
        let start = v1::start::From::Session(v1::SessionStart {
            session_id: session.id.clone(),
            at_step: None,
        });
        let request = v1::OpenHandlesRequest {
            starts: vec![v1::Start { from: Some(start) }],
            ..Default::default()
        };
        let handles: v1::OpenHandlesResponse =
            self.call(key, "ImaginationService/OpenHandles", &request).await;
        Things {
            session: session.id,
            goal: goal.goal.unwrap().id,
            handles: handles.handles_id,
            snapshot: exported.snapshot.to_vec(),
        }
    }

    fn rest(&self, method: &str, path: &str) -> reqwest::RequestBuilder {
        match method {
            "get" => self.server.get(path),
            "post" => self.server.post(path).json(&json!({})),
            "put" => self.server.put(path).json(&json!({})),
            "delete" => self.server.delete(path),
            other => panic!("{other}"),
        }
    }
}

/// Methods and paths of the document, with their names.
fn operations() -> Vec<(String, String, String, String)> {
    let document = &*gatsbi_server::api::openapi::DOCUMENT;
    let mut all = Vec::new();
    for (path, operations) in document["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap() {
            let tag = operation["tags"][0].as_str().unwrap_or_default().to_owned();
            let id = operation["operationId"].as_str().unwrap_or_default().to_owned();
            all.push((method.clone(), path.clone(), tag, id));
        }
    }
    all
}

/// What a credential should meet at a method that needs a role.
fn expected(credential: &str, role: Option<Role>, needs: Role) -> Option<&'static str> {
    match (credential, role) {
        ("none", _) => Some("NO_KEY"),
        ("wrong", _) => Some("WRONG_KEY"),
        ("expired", _) => Some("EXPIRED_KEY"),
        (_, Some(role)) if role < needs => Some("ROLE_TOO_LOW"),
        _ => None,
    }
}

fn cell(answer: &Answer) -> String {
    if answer.is_turned_away() { format!("{} {}", answer.code, answer.reason) } else { "in".into() }
}

fn check(place: &str, credential: &str, answer: &Answer, expected: Option<&str>) {
    match expected {
        Some(reason) => assert_eq!(answer.reason, reason, "{place} with {credential}: {answer:?}"),
        None => assert!(!answer.is_turned_away(), "{place} with {credential}: {answer:?}"),
    }
}

#[tokio::test]
async fn every_method_asks_for_a_key_with_its_role() {
    let guarded = Guarded::start().await;
    let things = Things {
        session: NOWHERE.to_owned(),
        goal: NOWHERE.to_owned(),
        handles: NOWHERE.to_owned(),
        snapshot: Vec::new(),
    };
    let mut table = Vec::new();
    let all = methods();
    assert_eq!(all.len(), METHODS.len(), "every method says which role it needs");
    for method in &all {
        let place = name(method);
        let (_, needs) = METHODS.iter().find(|(known, _)| *known == place).unwrap();
        let channel = if place.starts_with("Admin") { &guarded.admin } else { &guarded.grpc };
        let mut line = format!("grpc {place:<35}");
        for (credential, key, role) in guarded.credentials() {
            let message = knock::request(method, &things);
            let answer = knock::grpc(channel, method, message, key.as_deref()).await;
            check(&place, credential, &answer, expected(credential, role, *needs));
            line += &format!("| {credential}: {} ", cell(&answer));
        }
        table.push(line);
    }
    for (method, path, tag, id) in operations() {
        let needs = METHODS.iter().find(|(known, _)| *known == format!("{tag}/{id}"));
        // Paths beside the methods of the wire show pictures: they look, unless they make rollouts.
        let looks = method == "get" && !path.contains("/rollout");
        let needs = needs.map_or(if looks { Role::Read } else { Role::Predict }, |(_, role)| *role);
        let real = path.replace("{id}", NOWHERE).replace("{model}", "tiny");
        let mut line = format!("rest {:<35}", format!("{} {path}", method.to_uppercase()));
        for (credential, key, role) in guarded.credentials() {
            let answer = knock::rest(guarded.rest(&method, &real), key.as_deref()).await;
            check(&line, credential, &answer, expected(credential, role, needs));
            line += &format!("| {credential}: {} ", cell(&answer));
        }
        table.push(line);
    }
    let client = reqwest::Client::new();
    for (method, path) in [
        ("POST", "/v1/models"),
        ("PUT", "/v1/models/x"),
        ("DELETE", "/v1/models/x"),
        ("GET", "/metrics"),
    ] {
        let mut line = format!("admin {:<34}", format!("{method} {path}"));
        for (credential, key, role) in guarded.credentials() {
            let url = format!("http://{}{path}", guarded.server.app.admin);
            let request = client.request(method.parse().unwrap(), url).body("{}");
            let answer = knock::rest(request, key.as_deref()).await;
            check(&line, credential, &answer, expected(credential, role, Role::Admin));
            line += &format!("| {credential}: {} ", cell(&answer));
        }
        table.push(line);
    }
    let table: Vec<&str> = table.iter().map(|line| line.trim_end()).collect();
    insta::assert_snapshot!(table.join("\n"));
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn what_is_anothers_looks_as_if_it_did_not_exist() {
    let guarded = Guarded::start().await;
    let invented = |id: &str| {
        format!("{:x}{}", (u8::from_str_radix(&id[..1], 16).unwrap() + 1) % 16, &id[1..])
    };
    for method in methods().iter().filter(|method| !name(method).starts_with("Admin")) {
        let place = name(method);
        let own = guarded.things().await;
        let none = Things {
            session: invented(&own.session),
            goal: invented(&own.goal),
            handles: invented(&own.handles),
            snapshot: own.snapshot.clone(),
        };
        if knock::request(method, &own) == knock::request(method, &none) {
            continue;
        }
        let rival = Some(guarded.rival.as_str());
        let others = knock::grpc(&guarded.grpc, method, knock::request(method, &own), rival).await;
        let nobodys =
            knock::grpc(&guarded.grpc, method, knock::request(method, &none), rival).await;
        let told = others
            .with(&own.session, &none.session)
            .with(&own.goal, &none.goal)
            .with(&own.handles, &none.handles);
        assert_eq!(told, nobodys, "{place}");
        let said = String::from_utf8_lossy(&others.told).into_owned();
        assert!(
            others.reason.starts_with("UNKNOWN_") || said.contains("UNKNOWN_"),
            "{place}: {said}"
        );
        let key = Some(guarded.predict.as_str());
        let owners = knock::grpc(&guarded.grpc, method, knock::request(method, &own), key).await;
        let said = String::from_utf8_lossy(&owners.told).into_owned();
        assert!(
            !owners.reason.starts_with("UNKNOWN_") && !said.contains("UNKNOWN_"),
            "{place}: {said}"
        );
    }
    for (method, path, ..) in operations() {
        if !path.contains("{id}") {
            continue;
        }
        let own = guarded.things().await;
        let id = if path.contains("/goals/") { &own.goal } else { &own.session };
        let none = invented(id);
        let request = |id: &str| {
            let path = path.replace("{id}", id);
            if method == "put" && path.ends_with("/snapshot") {
                let octets = ("content-type", "application/octet-stream");
                let request = guarded.server.put(&path).header(octets.0, octets.1);
                return request.body(own.snapshot.clone());
            }
            guarded.rest(&method, &path)
        };
        let rival = Some(guarded.rival.as_str());
        let others = knock::rest(request(id), rival).await;
        let nobodys = knock::rest(request(&none), rival).await;
        assert_eq!(others.with(id, &none), nobodys, "{method} {path}");
        assert!(others.reason.starts_with("UNKNOWN_"), "{method} {path}: {others:?}");
        let owners = knock::rest(request(id), Some(&guarded.predict)).await;
        assert!(!owners.reason.starts_with("UNKNOWN_"), "{method} {path}: {owners:?}");
    }
    let listed = |key: &str| guarded.server.get("/v1/sessions").bearer_auth(key).send();
    let rivals: Json = listed(&guarded.rival).await.unwrap().json().await.unwrap();
    assert_eq!(rivals["sessions"].as_array().map_or(0, Vec::len), 0, "{rivals}");
    let own: Json = listed(&guarded.read).await.unwrap().json().await.unwrap();
    assert!(own["sessions"].as_array().unwrap().len() > 10);
    let mut sessions = SessionServiceClient::new(guarded.grpc.clone());
    let mut call = tonic::Request::new(v1::ListSessionsRequest::default());
    let key = format!("Bearer {}", guarded.rival).parse().unwrap();
    call.metadata_mut().insert("authorization", key);
    assert!(sessions.list_sessions(call).await.unwrap().into_inner().sessions.is_empty());
    let overview = async |key: &str| {
        let feed = guarded.server.get("/v1/live?thumbnails=true").bearer_auth(key).send().await;
        let (name, told) = Feed::of(feed.unwrap()).next().await.unwrap();
        assert_eq!(name, "overview");
        (told["sessions"].as_array().unwrap().len(), told["open_sessions"].as_u64().unwrap())
    };
    assert_eq!(overview(&guarded.rival).await, (0, 0));
    let (listed, open) = overview(&guarded.read).await;
    assert!(listed > 10 && open > 10, "{listed} {open}");
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn a_goal_of_another_tenant_cannot_be_planned_for() {
    let guarded = Guarded::start().await;
    let things = guarded.things().await;
    let post = |path: String, key: &str, body: Json| {
        guarded.server.post(&path).bearer_auth(key.to_owned()).json(&body).send()
    };
    let opened: Json = post("/v1/sessions".into(), &guarded.rival, json!({ "seed": 1 }))
        .await
        .unwrap()
        .json()
        .await
        .unwrap();
    let session = opened["session"]["id"].as_str().unwrap();
    let costs = |goal: &str| {
        json!({
            "actions": { "dtype": "DATA_TYPE_F32", "shape": [1, 1, 7], "values": [0, 0, 0, 0, 0, 0, 0] },
            "costs": { "terms": [{ "goal_image": { "goal_id": goal } }] },
        })
    };
    let path = format!("/v1/sessions/{session}/scores");
    let others = post(path.clone(), &guarded.rival, costs(&things.goal)).await.unwrap();
    let others: Json = others.json().await.unwrap();
    let nobodys: Json =
        post(path, &guarded.rival, costs(NOWHERE)).await.unwrap().json().await.unwrap();
    assert_eq!(others["reason"], "UNKNOWN_GOAL", "{others}");
    assert_eq!(others.to_string().replace(&things.goal, NOWHERE), nobodys.to_string());
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn a_request_is_turned_away_before_its_body_is_there() {
    let guarded = Guarded::start().await;
    let mut stream = tokio::net::TcpStream::connect(guarded.server.app.http).await.unwrap();
    let head = "POST /v1/sessions HTTP/1.1\r\nhost: x\r\ncontent-length: 1000000\r\n\r\n";
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut answer = [0; 12];
    tokio::time::timeout(Duration::from_secs(20), stream.read_exact(&mut answer))
        .await
        .unwrap()
        .unwrap();
    assert_eq!(&answer, b"HTTP/1.1 401");
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn health_and_the_document_are_open_and_answers_are_strict() {
    let guarded = Guarded::start().await;
    for path in ["/healthz", "/readyz"] {
        assert_eq!(guarded.server.admin(path).await.status(), 200, "{path}");
    }
    for path in ["/openapi.json", "/docs/"] {
        let answer = guarded.server.get(path).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{path}");
        let header = |name: &str| answer.headers()[name].to_str().unwrap().to_owned();
        let csp = header("content-security-policy");
        assert!(csp.contains("default-src 'none'") && csp.contains("frame-ancestors 'none'"));
        assert!(!csp.contains("unsafe"), "{csp}");
        assert_eq!(header("x-content-type-options"), "nosniff");
        assert_eq!(header("referrer-policy"), "no-referrer");
        assert_eq!(header("x-frame-options"), "DENY");
        assert_eq!(header("cross-origin-resource-policy"), "same-origin");
        let page = answer.text().await.unwrap();
        // What the policy would not let a browser run or show.
        for inline in ["<script>", "<style>", " style=", " onload=", " onclick="] {
            assert!(path == "/openapi.json" || !page.contains(inline), "{path} has {inline}");
        }
    }
    let turned_away = guarded.server.get("/v1/models").send().await.unwrap();
    assert_eq!(turned_away.headers()["www-authenticate"], "Bearer realm=\"gatsbi\"");
    let health = tonic_health::pb::health_client::HealthClient::new(guarded.grpc.clone())
        .check(tonic_health::pb::HealthCheckRequest { service: String::new() })
        .await;
    assert!(health.is_ok(), "{health:?}");
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn open_metrics_open_nothing_else() {
    let mut file = KeyFile::new();
    file.key("lab", Role::Admin);
    let keys = Some(file.0.path().to_owned());
    let server = TestServer::with(Config { keys, open_metrics: true, ..config() }).await;
    let admin = format!("http://{}", server.app.admin);
    let client = reqwest::Client::new();
    let status = async |request: reqwest::RequestBuilder| request.send().await.unwrap().status();
    assert_eq!(status(client.get(format!("{admin}/metrics"))).await, 200);
    for request in [
        client.post(format!("{admin}/v1/models")).json(&json!({ "path": "x" })),
        client.post(format!("{admin}/metrics")),
        server.get("/v1/models"),
    ] {
        assert_eq!(status(request).await, 401);
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn keys_change_while_the_server_runs() {
    let mut guarded = Guarded::start().await;
    let models = |server: &TestServer, key: &str| server.get("/v1/models").bearer_auth(key).send();
    let late = guarded.file.key("late", Role::Read);
    assert_eq!(models(&guarded.server, &late).await.unwrap().status(), 401);
    let access = guarded.server.app.access().unwrap();
    access.reload(config().quota()).unwrap();
    assert_eq!(models(&guarded.server, &late).await.unwrap().status(), 200);
    guarded.file.write("nonsense");
    assert!(access.reload(config().quota()).is_err());
    assert_eq!(models(&guarded.server, &late).await.unwrap().status(), 200, "as before");
    guarded.server.app.shutdown().await;
}
