//! The document of the REST API: served, true, and readable without anything from elsewhere.

use std::collections::BTreeSet;

use gatsbi_server::api::openapi::DOCUMENT;
use serde_json::{Value as Json, json};

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

/// Whether a request is refused for what a field holds.
async fn refuses(request: reqwest::RequestBuilder, field: &str) -> bool {
    let answer = request.send().await.unwrap();
    if answer.headers()["content-type"] == "text/event-stream" {
        return false;
    }
    let status = answer.status();
    let body: Json = serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap_or_default();
    let told = body["detail"].as_str().unwrap_or_default();
    status == 400 && [" is ", ": "].iter().any(|next| told.contains(&format!("{field}{next}")))
}

#[tokio::test]
async fn bounds_of_queries_are_those_of_the_document() {
    let server = TestServer::start().await;
    let session = server.session(42).await.id;
    let mut tried = 0;
    for (path, operations) in DOCUMENT["paths"].as_object().unwrap() {
        let real = path.replace("{id}", &session);
        for (method, operation) in operations.as_object().unwrap() {
            for parameter in operation["parameters"].as_array().unwrap() {
                let (name, schema) = (parameter["name"].as_str().unwrap(), &parameter["schema"]);
                let bounds = (schema["minimum"].as_u64(), schema["maximum"].as_u64());
                let (Some(least), Some(most)) = bounds else { continue };
                let with = |value: i128| {
                    let path = format!("{real}?{name}={value}");
                    if method == "get" { server.get(&path) } else { server.post(&path) }
                };
                for (value, bad) in [
                    (i128::from(least) - 1, true),
                    (least.into(), false),
                    (i128::from(most) + 1, true),
                ] {
                    let refused = refuses(with(value), name).await;
                    assert_eq!(refused, bad, "{method} {path}?{name}={value}");
                }
                tried += 1;
            }
        }
    }
    assert!(tried >= 20, "{tried}");
    server.app.shutdown().await;
}

#[tokio::test]
async fn bounds_of_plans_are_those_of_the_document() {
    let server = TestServer::start().await;
    let session = server.seasoned(42, 1).await.id;
    // Actions alone cost something, so no model computes here.
    let costs = || json!({ "terms": [{ "action_magnitude": {} }], "risk": "RISK_WORST_SHARE" });
    let mut tried = 0;
    for (message, place) in [
        ("PlanRequest", ""),
        ("CostProgram", "costs"),
        ("RandomShooting", "random_shooting"),
        ("Cem", "cem"),
        ("Icem", "icem"),
        ("Mppi", "mppi"),
    ] {
        let fields = &DOCUMENT["components"]["schemas"][message]["properties"];
        for (name, schema) in fields.as_object().unwrap() {
            let ours = |bound: &str| schema[bound].as_f64().filter(|bound| bound.abs() < 1e6);
            let below = ours("minimum").filter(|least| *least > 0.0 || schema["format"] == "float");
            let wrong = [
                below.map(|least| least - 1.0),
                ours("maximum").map(|most| most + 1.0),
                ours("exclusiveMinimum").map(|_| 0.0),
                ours("exclusiveMaximum").map(|_| 1.0),
            ];
            for wrong in wrong.into_iter().flatten() {
                let mut body = json!({ "horizon": 1, "costs": costs() });
                let field = match place {
                    "" => name.clone(),
                    _ => format!("{place}.{name}"),
                };
                match place {
                    "" => body[name] = json!(wrong),
                    _ => body[place][name] = json!(wrong),
                }
                let request = server.post(&format!("/v1/sessions/{session}/plans"));
                let request = request.header("content-type", "application/json");
                let refused = refuses(request.body(body.to_string()), &field).await;
                assert!(refused, "{field} {wrong}");
                tried += 1;
            }
        }
    }
    assert!(tried >= 20, "{tried}");
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
