//! What a tenant may take, and that it takes it from nobody else.

use gatsbi_server::{access::key::Role, config::Config};
use serde_json::{Value as Json, json};

use crate::{
    knock::KeyFile,
    support::{ACTION, TestServer, config},
};

async fn post(server: &TestServer, key: &str, path: &str, body: Json) -> (u16, Json) {
    let answer = server.post(path).bearer_auth(key).json(&body).send().await.unwrap();
    (answer.status().as_u16(), answer.json().await.unwrap_or_default())
}

#[tokio::test]
async fn a_tenant_takes_its_quota_and_no_more() {
    let mut file = KeyFile::new();
    let (small, large) = (file.key("small", Role::Predict), file.key("large", Role::Predict));
    file.write("[tenants.large]\nsessions = 100\nrows = 100\nkept_mib = 100\n");
    let keys = Some(file.0.path().to_owned());
    let server = TestServer::with(Config {
        keys,
        tenant_max_sessions: Some(2),
        tenant_max_rows: Some(8),
        tenant_max_kept_mib: Some(1),
        ..config()
    })
    .await;
    let open = |keep: u32| json!({ "seed": 1, "keep_frames": keep });
    let (status, first) = post(&server, &small, "/v1/sessions", open(0)).await;
    assert_eq!(status, 201, "{first}");
    // 48 KiB a frame: 40 are more than 1 MiB.
    let (status, problem) = post(&server, &small, "/v1/sessions", open(40)).await;
    assert_eq!((status, problem["reason"].as_str()), (429, Some("QUOTA_EXCEEDED")), "{problem}");
    assert_eq!(problem["detail"], "this tenant may have no more than 1048576 bytes kept");
    assert_eq!(post(&server, &small, "/v1/sessions", open(0)).await.0, 201);
    let (status, problem) = post(&server, &small, "/v1/sessions", open(0)).await;
    assert_eq!(status, 429);
    assert_eq!(problem["detail"], "this tenant may have no more than 2 open sessions");
    for _ in 0..3 {
        assert_eq!(post(&server, &large, "/v1/sessions", open(40)).await.0, 201);
    }

    let id = first["session"]["id"].as_str().unwrap();
    let image = json!({ "pixels": { "dtype": "DATA_TYPE_F32", "shape": [2, 2, 3], "values": vec![0.5; 12] } });
    let step = json!({ "observation": { "step": 0, "image": image, "action": vec![0.0; ACTION] } });
    let (status, seen) =
        post(&server, &small, &format!("/v1/sessions/{id}/observations"), step).await;
    assert_eq!(status, 200, "{seen}");
    let rollout = |candidates: usize| {
        let values = vec![0.0; candidates * ACTION];
        json!({ "actions": { "dtype": "DATA_TYPE_F32", "shape": [candidates, 1, ACTION], "values": values },
            "outputs": { "outputs": ["OUTPUT_OBJECTS"] } })
    };
    let path = format!("/v1/sessions/{id}/rollouts");
    let (status, problem) = post(&server, &small, &path, rollout(9)).await;
    assert_eq!(status, 429, "{problem}");
    assert_eq!(problem["detail"], "this tenant may have no more than 8 rows of rollouts under way");
    for _ in 0..3 {
        // Rows come back when a rollout has ended.
        assert_eq!(post(&server, &small, &path, rollout(8)).await.0, 200);
    }
    let deleted = server.delete(&format!("/v1/sessions/{id}")).bearer_auth(&small).send().await;
    assert_eq!(deleted.unwrap().status(), 200);
    assert_eq!(post(&server, &small, "/v1/sessions", open(0)).await.0, 201);
    server.app.shutdown().await;
}
