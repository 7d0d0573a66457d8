//! What is shipped beside the programs: images, dashboards, alerts and units name only what is there.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// Metrics and their kinds, as documented; that the table is true is a test of the server.
fn metrics() -> BTreeMap<String, String> {
    let table = read("docs/metrics.md");
    let rows = table.lines().filter_map(|line| line.strip_prefix("| `"));
    rows.map(|row| {
        let mut cells = row.split('|').map(str::trim);
        let name = cells.next().unwrap().trim_end_matches('`').to_owned();
        (name, cells.next().unwrap().to_owned())
    })
    .collect()
}

/// Everything in a text that is named like one of our metrics.
fn named(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
    words.filter(|word| word.starts_with("gatsbi_")).map(str::to_owned).collect()
}

fn assert_exist(place: &str, text: &str) {
    let metrics = metrics();
    for name in named(text) {
        let histogram = ["_bucket", "_sum", "_count"].iter().find_map(|it| name.strip_suffix(it));
        let known = match histogram.and_then(|name| metrics.get(name)) {
            Some(kind) => kind == "histogram",
            None => metrics.get(&name).is_some_and(|kind| kind != "histogram"),
        };
        assert!(known, "{place} asks for {name}, which no server shows");
    }
}

#[test]
fn dashboards_and_alerts_ask_for_metrics_that_exist() {
    let dashboard: Value =
        serde_json::from_str(&read("docker/grafana/dashboards/gatsbi.json")).unwrap();
    let mut asked = BTreeSet::new();
    for panel in dashboard["panels"].as_array().unwrap() {
        for target in panel["targets"].as_array().unwrap() {
            let expression = target["expr"].as_str().unwrap();
            assert_exist(panel["title"].as_str().unwrap(), expression);
            asked.extend(named(expression));
        }
    }
    let alerts = read("docker/prometheus/alerts.yml");
    assert_exist("alerts.yml", &alerts);
    let shown = |name: &String| asked.iter().any(|asked| asked.starts_with(name.as_str()));
    let unseen: Vec<String> = metrics().into_keys().filter(|name| !shown(name)).collect();
    assert_eq!(unseen, Vec::<String>::new(), "no panel shows them");
}

#[test]
fn promtool_finds_nothing_where_it_is_installed() {
    let folder = root().join("docker/prometheus");
    for arguments in [
        ["check", "rules", "alerts.yml"].as_slice(),
        &["test", "rules", "alerts_test.yml"],
        &["check", "config", "prometheus.yml"],
    ] {
        let Ok(output) = Command::new("promtool").args(arguments).current_dir(&folder).output()
        else {
            eprintln!("promtool is not installed: the rules were not checked by it");
            return;
        };
        let told = String::from_utf8_lossy(&output.stdout).into_owned()
            + &String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{arguments:?}: {told}");
    }
}

/// Instructions of the Dockerfile, each on one line.
fn instructions() -> Vec<(String, String)> {
    let text = read("docker/Dockerfile").replace("\\\n", " ");
    let lines =
        text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    let split = lines.map(|line| line.split_once(' ').unwrap());
    split.map(|(name, rest)| (name.to_owned(), rest.trim().to_owned())).collect()
}

#[test]
fn every_source_and_command_of_the_dockerfile_is_there() {
    let all = instructions();
    let of = |wanted: &str| -> Vec<&str> {
        all.iter().filter(|(name, _)| name == wanted).map(|(_, rest)| rest.as_str()).collect()
    };
    // Of the tree: files. Of the first stage: what the package was put into.
    let mut copied = 0;
    for copy in of("COPY") {
        let words: Vec<&str> = copy.split_whitespace().collect();
        if let [from, source, _] = words[..] {
            assert_eq!((from, source), ("--from=build", "/opt/gatsbi"));
        } else {
            assert!(root().join(words[0]).exists(), "COPY {copy}");
        }
        copied += 1;
    }
    assert_eq!(copied, 3);
    let help = |command: &str| {
        let arguments =
            ["run", "--quiet", "--locked", "--package", "xtask", "--", command, "--help"];
        let output =
            Command::new(env!("CARGO")).args(arguments).current_dir(root()).output().unwrap();
        assert!(output.status.success(), "there is no `cargo xtask {command}`");
        String::from_utf8(output.stdout).unwrap()
    };
    let mut ours = 0;
    for command in of("RUN").iter().flat_map(|run| run.split("&&")) {
        let words: Vec<&str> = command.split_whitespace().collect();
        match words[..] {
            ["cargo", "xtask", command, ref flags @ ..] => {
                let help = help(command);
                for flag in flags.iter().filter(|flag| flag.starts_with("--")) {
                    // The variant is given when the image is built.
                    for flag in ["cpu", "cuda"].map(|variant| flag.replace("${VARIANT}", variant)) {
                        assert!(help.contains(&flag), "cargo xtask {command} has no {flag}");
                    }
                }
                ours += 1;
            }
            ["apt-get", "update"] | ["rm", ..] => {}
            ["apt-get", "install", ref packages @ ..] => {
                // Those that CONTRIBUTING.md asks for.
                let packages: Vec<&&str> =
                    packages.iter().filter(|it| !it.starts_with("--")).collect();
                assert_eq!(packages, [&"g++", &"git", &"python3", &"python3-pip"]);
            }
            _ => panic!("RUN {command} is not known to work"),
        }
    }
    assert_eq!(ours, 2);
    let entry: Vec<String> = serde_json::from_str(of("ENTRYPOINT")[0]).unwrap();
    assert_eq!(entry, ["/opt/gatsbi/bin/gatsbi-server"]);
    let arguments: Vec<String> = serde_json::from_str(of("CMD")[0]).unwrap();
    assert!(of("COPY").iter().any(|copy| copy.ends_with(&format!(" {}", arguments[1]))));
    let user = of("USER")[0];
    assert!(user.split(':').all(|id| id.parse::<u32>().unwrap() > 0), "{user} is root");
    let toolchain = format!("rust-version = \"{}\"", "1.95");
    assert!(read("Cargo.toml").contains(&toolchain) && of("FROM")[0].starts_with("rust:1.95-"));
}

#[test]
fn settings_of_the_image_and_the_unit_name_places_of_the_package() {
    let settings = read("docker/gatsbi.toml");
    let checkpoint = settings.split('"').find(|word| word.ends_with(".safetensors")).unwrap();
    let name = checkpoint.strip_prefix("/opt/gatsbi/share/checkpoints/").unwrap();
    assert!(root().join("models/checkpoints").join(name).exists(), "{name}");
    let unit = read("docker/gatsbi.service");
    let package = read("xtask/src/package.rs");
    for place in [
        "bin",
        "share/checkpoints",
        "etc/gatsbi.toml",
        "systemd/gatsbi.service",
        "share/doc/operating.md",
    ] {
        assert!(unit.contains(&format!("/opt/gatsbi/{place}")), "{place}");
        assert!(package.contains(&format!("\"{place}")), "{place}");
    }
}

#[test]
fn links_of_packaged_documents_lead_to_the_package() {
    let package = read("xtask/src/package.rs");
    // Source and place, a pair a line.
    let pairs = package.lines().filter_map(|line| {
        let mut words = line.trim().strip_prefix("(\"")?.split('"');
        Some((words.next()?, words.nth(1)?))
    });
    let places: Vec<_> =
        pairs.filter_map(|pair| pair.1.strip_prefix("share/doc/").zip(Some(pair.0))).collect();
    assert_eq!(places.len(), 2, "{places:?}");
    for (place, source) in &places {
        let text = read(source);
        let links = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        for link in links.filter(|link| !link.starts_with("https://") && !link.starts_with('#')) {
            let page = link.split('#').next();
            assert!(places.iter().any(|(place, _)| Some(*place) == page), "{place}: {link}");
        }
    }
}

#[test]
fn the_unit_leaves_the_server_what_it_needs() {
    let unit = read("docker/gatsbi.service");
    let mut denied = false;
    // The first line lets calls in; each one after it takes some away or gives them back.
    for line in unit.lines().filter_map(|line| line.strip_prefix("SystemCallFilter=")) {
        match line.strip_prefix('~') {
            Some(calls) => denied |= calls.split(' ').any(|it| it == "@resources"),
            None => denied &= line.split(' ').all(|it| it != "sched_setaffinity"),
        }
    }
    assert!(!denied, "MKL calls sched_setaffinity while a checkpoint loads");
    let hidden = unit.lines().any(|line| line == "ProcSubset=pid");
    assert!(!hidden, "without /proc/cpuinfo libtorch takes its slowest kernels");
}

#[test]
fn a_container_is_given_longer_than_draining_takes() {
    let seconds = |text: &str, before: &str| -> u64 {
        let rest = text.split_once(before).unwrap_or_else(|| panic!("no {before}")).1;
        rest.chars().take_while(char::is_ascii_digit).collect::<String>().parse().unwrap()
    };
    let drain = seconds(&read("server/gatsbi.toml"), "# drain_seconds = ");
    let engine = seconds(&read("server/src/app.rs"), "ENGINE_END: Duration = Duration::from_secs(");
    assert!(!read("docker/gatsbi.toml").contains("drain_seconds"));
    for (file, grace) in [
        ("docker/compose.yaml", "stop_grace_period: "),
        ("docker/gatsbi.service", "TimeoutStopSec="),
    ] {
        assert!(seconds(&read(file), grace) > drain + engine, "{file}");
    }
}

#[test]
fn compose_mounts_what_is_there() {
    let compose = read("docker/compose.yaml");
    let mounted = compose.split(['"', ' ']).filter_map(|word| word.strip_prefix("./"));
    let mut seen = 0;
    for mount in mounted {
        let source = mount.split(':').next().unwrap();
        let made_by_people = source == "keys.toml";
        assert!(made_by_people || root().join("docker").join(source).exists(), "{source}");
        seen += 1;
    }
    assert_eq!(seen, 4);
}
