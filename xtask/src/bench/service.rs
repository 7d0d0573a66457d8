//! What sessions, batching and connections cost, in wall time: the service on one thread of the model beside the model
//! alone, a model that computes nothing, forks.

use std::collections::BTreeMap;
use std::process::Command;

use anyhow::Result;

use super::side::Side;
use super::{Arguments, PRESETS, Tools, median, progress};
use crate::server::Server;

/// Candidates and steps of the rollout that is served and computed alone.
const ROLLOUT: &str = "64 15";

/// The preset that is served: the smaller, of which the rest is the larger part.
const SERVED: &str = "tiny";

/// Figures by name.
pub(super) fn measure(tools: &Tools<'_>, arguments: &Arguments) -> Result<BTreeMap<String, f64>> {
    let seconds = if arguments.quick { 0.5 } else { 5.0 };
    let mut engine = Command::new(tools.programs.named("gatsbi-load-engine")?);
    let mut inside = Side::start("the engine", engine.arg("inside"))?;
    let mut server = Command::new(tools.programs.named("gatsbi-server")?);
    server.args(["--threads", "1", "--checkpoint"]).arg(tools.checkpoint(SERVED));
    let log = tools.folder.path().join("server.log");
    let served = Server::start(&mut server, &log, &tools.interrupt)?;
    let mut null = Command::new(tools.programs.named("gatsbi-load-engine")?);
    null.args(["null", "--threads", "1", "--max-sessions", "100000"]);
    let log = tools.folder.path().join("null.log");
    let null = Server::start(&mut null, &log, &tools.interrupt)?;
    let mut at_served = tools.load(None, &served.grpc)?;
    let mut at_null = tools.load(None, &null.grpc)?;

    let mut found: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for round in 0..=arguments.rounds {
        tools.interrupt.check()?;
        progress(&format!("round {round} of {}: the service", arguments.rounds));
        let time: f64 = if round == 0 { 0.1 } else { seconds };
        let mut put = |name: String, figure: f64| {
            // The first round is to be warm.
            found.entry(name).or_default().extend((round > 0).then_some(figure));
        };
        let file = tools.checkpoint(SERVED);
        let alone = inside.ask(&format!("imagine {} {ROLLOUT} {time}", file.display()))?[0];
        let over = at_served.ask(&format!("imagine {ROLLOUT} {time}"))?[0];
        put(format!("{SERVED}.served_over_inprocess"), over / alone);
        put(format!("{SERVED}.served_rows_per_s"), over);
        for (way, name) in [("observe", "null"), ("stream", "null_stream")] {
            let one = at_null.ask(&format!("{way} 1 {time}"))?;
            let many = at_null.ask(&format!("{way} 16 {time}"))?;
            put(format!("{name}_p50_ms"), one[1]);
            put(format!("{name}_rps_16"), many[0]);
        }
        let idle = at_null.ask(&format!("imagine 64 15 {time}"))?[0];
        put("null_rows_per_s".to_owned(), idle);
        for preset in PRESETS {
            let file = tools.checkpoint(preset);
            let fork = inside.ask(&format!("fork {} {}", file.display(), time.min(0.5)))?;
            put(format!("{preset}.fork_us"), fork[0]);
            put(format!("{preset}.session_bytes"), fork[1]);
        }
    }
    progress("");
    served.process.stop()?;
    null.process.stop()?;
    Ok(found.into_iter().map(|(name, figures)| (name, median(figures))).collect())
}
