//! What SIGHUP does: the configuration is read again, and what can change while the server runs does.
//!
//! These are the keys and quotas, the certificates, the filter of logs, and checkpoints whose files have changed. A
//! part that cannot be used leaves that part as it was; each is told in the log.

use std::sync::Arc;

use crate::{
    app::App,
    checkpoints::Checkpoints,
    config::{
        layers::{Layered, Unusable},
        render::{Style, render},
    },
    error::told,
    logs::Logs,
    service::Service,
};

/// Settings that take effect while the server runs.
const LIVE: [&str; 4] = ["log", "tenant_max_sessions", "tenant_max_rows", "tenant_max_kept_mib"];

/// Applies a configuration to a running server. What differs from the one that it was started with and needs a restart
/// is told each time, until there is one.
pub async fn apply(app: &App, logs: &Logs, started: &Layered, new: &Layered) {
    for setting in needs_restart(started, new) {
        tracing::warn!(setting, "changed, and takes effect when the server starts anew");
    }
    if let Err(error) = logs.set(&new.config.log) {
        tracing::error!(%error, "the filter of logs stays as it was");
    }
    if let Some(access) = app.access() {
        match access.reload(new.config.quota()) {
            Ok(keys) => tracing::info!(keys, "keys read again"),
            Err(error) => tracing::error!(error = told(&error), "the keys stay as they were"),
        }
    }
    if let Some(tls) = app.tls() {
        match tls.reload() {
            Ok(()) => tracing::info!("certificates read again"),
            Err(error) => tracing::error!(error = told(&error), "the certificate stays as it was"),
        }
    }
    if let Some(service) = app.service() {
        checkpoints(&service, started).await;
    }
}

/// Tells why a configuration is not applied.
pub fn refused(problem: Unusable) {
    let problems = match problem {
        Unusable::Problems(problems) => problems,
        Unusable::Told(_) => Vec::new(),
    };
    for problem in problems {
        tracing::error!(problem, "the configuration stays as it was");
    }
}

/// Names of settings that differ and do not take effect.
fn needs_restart(started: &Layered, new: &Layered) -> Vec<String> {
    let lines = |layered: &Layered| render(&layered.matches, Style::Effective);
    let (old, new) = (lines(started), lines(new));
    let changed = old.lines().zip(new.lines()).filter(|(old, new)| old != new);
    let names = changed.filter_map(|(_, new)| new.trim_start_matches("# ").split(" = ").next());
    names.filter(|name| !LIVE.contains(name)).map(str::to_owned).collect()
}

/// Serves checkpoints whose files have changed, and new ones in the folder; sessions that are open keep theirs.
async fn checkpoints(service: &Arc<Service>, started: &Layered) {
    let folder = started.config.checkpoints();
    let named = Checkpoints { folder: None, ..folder.clone() };
    let mut files: Vec<_> = started
        .config
        .checkpoints
        .iter()
        .map(|checkpoint| (named.clone(), checkpoint.path.clone(), checkpoint.name.clone()))
        .collect();
    match folder.found() {
        Ok(found) => files.extend(found.into_iter().map(|path| (folder.clone(), path, None))),
        Err(error) => tracing::error!(%error, "the folder of checkpoints cannot be read"),
    }
    for (checkpoints, path, name) in files {
        let shown = path.display().to_string();
        match service.refresh_model(checkpoints, path, name).await {
            Ok(true) => tracing::info!(path = shown, "checkpoint loaded anew"),
            Ok(false) => {}
            Err(error) => tracing::error!(path = shown, %error, "what was served stays"),
        }
    }
}
