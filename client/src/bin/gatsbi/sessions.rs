//! `gatsbi session new | show | list | delete`.

use std::time::{Duration, SystemTime};

use clap::{Args, Subcommand, ValueEnum};
use gatsbi_client::{Mode, NewSession, SessionInfo};
use serde_json::json;

use crate::{
    Shared,
    models::short,
    print::{self, from_now, pairs, print, print_json, table},
    seconds,
};

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Open a session
    New(New),
    /// Show a session
    Show {
        /// Its id
        id: String,
    },
    /// List the open sessions
    List {
        /// Only those with this label
        #[arg(long)]
        label: Option<String>,
    },
    /// Close a session; its belief is forgotten
    Delete {
        /// Its id
        id: String,
    },
}

#[derive(Debug, Args)]
pub(crate) struct New {
    /// Name of the model; may be left out where the server has one only
    #[arg(long, default_value = "", hide_default_value = true)]
    model: String,
    /// A name of your own for the session
    #[arg(long, default_value = "", hide_default_value = true)]
    label: String,
    /// Whether observing draws random numbers or takes means
    #[arg(long, value_enum, default_value_t = Drawing::Sample)]
    mode: Drawing,
    /// Seed of the random numbers; drawn by the server if left out
    #[arg(long)]
    seed: Option<u64>,
    /// How long it may lie unused; the server's limit if left out
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    ttl: Option<Duration>,
    /// Print the id alone, for scripts
    #[arg(long, conflicts_with = "json")]
    id: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Drawing {
    Sample,
    Mean,
}

pub(crate) async fn run(shared: &Shared, command: Command) -> anyhow::Result<()> {
    match command {
        Command::New(new) => open(shared, new).await,
        Command::Show { id } => show(shared, shared.session(&id).await?.info()),
        Command::List { label } => list(shared, label.as_deref()).await,
        Command::Delete { id } => {
            shared.session(&id).await?.delete().await?;
            if shared.json { print_json(&json!({})) } else { print(&format!("closed {id}\n")) }
        }
    }
}

async fn open(shared: &Shared, new: New) -> anyhow::Result<()> {
    let mode = match new.mode {
        Drawing::Sample => Mode::Sample,
        Drawing::Mean => Mode::Mean,
    };
    let New { model, label, seed, ttl, .. } = new;
    let request = NewSession { model, label, mode, seed, ttl };
    let session = shared.client().await?.create_session(request).await?;
    if new.id { print(&format!("{}\n", session.id())) } else { show(shared, session.info()) }
}

async fn list(shared: &Shared, label: Option<&str>) -> anyhow::Result<()> {
    let sessions = shared.client().await?.sessions(label).await?;
    if shared.json {
        let sessions: Vec<_> = sessions.iter().map(print::json).collect::<Result<_, _>>()?;
        return print_json(&json!({ "sessions": sessions }));
    }
    let titles = ["<id", "<label", "<model", "steps", "<used", "<expires"];
    let rows = sessions.iter().map(|session| {
        vec![
            session.id.clone(),
            if session.label.is_empty() { "-".into() } else { session.label.clone() },
            session.model.clone(),
            session.next_step.to_string(),
            when(session.used_at),
            when(session.expires_at),
        ]
    });
    print(&table(&titles, rows))
}

fn show(shared: &Shared, session: &SessionInfo) -> anyhow::Result<()> {
    if shared.json {
        return print_json(&print::json(session)?);
    }
    let mode = match session.mode() {
        Mode::Mean => "means".to_owned(),
        Mode::Sample | Mode::Unspecified => format!("drawn with seed {}", session.seed),
    };
    print(&pairs([
        ("session", session.id.clone()),
        ("label", session.label.clone()),
        ("model", format!("{}, checkpoint {}", session.model, short(&session.model_hash))),
        ("next step", session.next_step.to_string()),
        ("observing", mode),
        ("opened", when(session.created_at)),
        ("used", when(session.used_at)),
        ("expires", when(session.expires_at)),
        ("holds", format!("{} bytes", session.bytes)),
    ]))
}

/// A time of the wire relative to now.
fn when(time: Option<prost_types::Timestamp>) -> String {
    let time = time.and_then(|time| SystemTime::try_from(time).ok());
    time.map_or_else(|| "-".to_owned(), from_now)
}
