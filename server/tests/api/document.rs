//! The document of the REST API: served, true, and readable without anything from elsewhere.

use std::collections::BTreeSet;

use serde_json::Value as Json;

use crate::support::TestServer;

#[tokio::test]
async fn every_path_of_the_document_is_there() {
    let server = TestServer::start().await;
    let document: Json = server.get("/openapi.json").send().await.unwrap().json().await.unwrap();
    assert_eq!(document["openapi"], "3.1.0");
    let mut seen = 0;
    for (path, operations) in document["paths"].as_object().unwrap() {
        let real = path.replace("{id}", &"0".repeat(32)).replace("{model}", "huge");
        for method in operations.as_object().unwrap().keys() {
            let request = match method.as_str() {
                "get" => server.get(&real),
                "post" => server.post(&real),
                "put" => server.put(&real),
                "delete" => server.delete(&real),
                other => panic!("{other}"),
            };
            let answer = request.send().await.unwrap();
            let status = answer.status().as_u16();
            seen += 1;
            if answer.headers()["content-type"] == "text/event-stream" {
                // It is there, and does not end.
                assert_eq!(status, 200);
                continue;
            }
            let body: Json =
                serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap_or_default();
            let reason = body["reason"].as_str().unwrap_or_default();
            assert!(!["UNKNOWN_PATH", "UNKNOWN_METHOD"].contains(&reason), "{method} {path}");
            assert!(status < 500 || reason == "UNIMPLEMENTED", "{method} {path}: {status}");
        }
    }
    assert!(seen >= 27, "{seen}");
    server.app.shutdown().await;
}

#[tokio::test]
async fn the_page_needs_nothing_from_elsewhere() {
    let server = TestServer::start().await;
    let page = server.get("/docs/").send().await.unwrap();
    assert_eq!(page.status(), 200);
    let page = page.text().await.unwrap();
    let parts: BTreeSet<&str> = ["src=\"", "href=\""]
        .into_iter()
        .flat_map(|attribute| page.split(attribute).skip(1))
        .filter_map(|rest| rest.split('"').next())
        .collect();
    assert!(parts.iter().any(|part| part.contains("swagger-ui-bundle.js")), "{parts:?}");
    for part in parts {
        assert!(!part.contains("//"), "{part} is elsewhere");
        let part = part.trim_start_matches("./");
        let answer = server.get(&format!("/docs/{part}")).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{part}");
        assert!(!answer.bytes().await.unwrap().is_empty(), "{part}");
    }
    let setting = server.get("/docs/swagger-initializer.js").send().await.unwrap();
    assert!(setting.text().await.unwrap().contains("/openapi.json"));
    server.app.shutdown().await;
}
