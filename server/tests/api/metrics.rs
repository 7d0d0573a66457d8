//! The table of metrics in the documentation, against what a server shows.

use std::collections::{BTreeMap, BTreeSet};

use crate::support::{TestServer, named, observation, rollout};

/// Kind and labels of each metric in the table.
fn documented() -> BTreeMap<String, (String, BTreeSet<String>)> {
    let text = include_str!("../../../docs/metrics.md");
    let rows = text.lines().filter_map(|line| {
        let cells: Vec<&str> = line.strip_prefix("| `")?.split('|').map(str::trim).collect();
        let labels = cells[2].split(", ").filter(|label| !label.is_empty());
        let labels = labels.map(str::to_owned).collect();
        Some((cells[0].trim_end_matches('`').to_owned(), (cells[1].to_owned(), labels)))
    });
    rows.collect()
}

#[test]
fn the_table_is_that_of_the_code() {
    let text = include_str!("../../../docs/metrics.md");
    let described = gatsbi_server::telemetry::described();
    assert_eq!(documented().len(), described.len());
    for (name, kind, what) in described {
        let row = text.lines().find(|line| line.starts_with(&format!("| `{name}` | {kind} | ")));
        assert!(
            row.is_some_and(|row| row.ends_with(&format!("| {what} |"))),
            "{name} {kind} {what}"
        );
    }
}

#[tokio::test]
async fn what_a_server_shows_is_in_the_table() {
    let server = TestServer::with(named("metered")).await;
    let session = server.seasoned(1, 2).await;
    server.imagine(rollout(&session, 2, 2)).await.unwrap();
    server.observe(observation(&session, 9)).await.unwrap_err();
    let shown = server.admin("/metrics").await.text().await.unwrap();
    for failure in ["panicked", "not_finite"] {
        let labels = format!("{{model=\"metered\",failure=\"{failure}\"}}");
        let line = format!("gatsbi_model_failures_total{labels} 0");
        assert!(shown.lines().any(|it| it == line), "{line}: alerts need it before it counts");
    }
    let documented = documented();
    let mut kinds = BTreeSet::new();
    for line in shown.lines().filter(|line| !line.is_empty()) {
        if let Some(typed) = line.strip_prefix("# TYPE ") {
            let (name, kind) = typed.split_once(' ').unwrap();
            assert_eq!(documented[name].0, kind, "{name}");
            kinds.insert(kind.to_owned());
            continue;
        }
        if line.starts_with('#') {
            continue;
        }
        let name = line.split(['{', ' ']).next().unwrap();
        let known = ["_bucket", "_sum", "_count", ""]
            .iter()
            .find_map(|suffix| documented.get(name.strip_suffix(suffix)?));
        let (_, labels) = known.unwrap_or_else(|| panic!("{line} is not documented"));
        let given = line.split_once('{').map_or("", |(_, rest)| rest.split_once('}').unwrap().0);
        for label in given.split("\",").filter(|label| !label.is_empty()) {
            let label = label.split('=').next().unwrap();
            assert!(label == "le" || labels.contains(label), "{label} of {line}");
        }
    }
    assert_eq!(kinds.len(), 3, "{kinds:?}");
    server.app.shutdown().await;
}
