//! What an operator can set, the defaults, and what is wrong with it.
//!
//! A setting is a flag, a variable of the environment, and a line of a file, in this order ([`layers`]); [`render`]
//! writes such a file.

pub mod layers;
pub mod render;

use std::{net::SocketAddr, path::PathBuf, str::FromStr, time::Duration};

use clap::Parser;

use crate::{
    access::tenants::Quota,
    checkpoints::Checkpoints,
    engine::{DoorSizes, EngineConfig, scheduler::Sizes},
    tls::TlsFiles,
};

/// Serves GATSBI world models to robot agents over gRPC and REST.
#[derive(Clone, Debug, Parser)]
#[command(version)]
pub struct Config {
    /// Checkpoint to serve, as PATH or NAME=PATH; may be given several times. A card beside it (the same name with
    /// the extension .md) is served with it.
    #[arg(
        long = "checkpoint",
        env = "GATSBI_CHECKPOINTS",
        value_name = "[NAME=]PATH",
        value_delimiter = ',',
        help_heading = "Models"
    )]
    pub checkpoints: Vec<CheckpointArg>,

    /// Folder of checkpoints: all that are in it are served, and relative paths of models that are loaded later start
    /// there.
    #[arg(long, env = "GATSBI_CHECKPOINT_FOLDER", value_name = "PATH", help_heading = "Models")]
    pub checkpoint_folder: Option<PathBuf>,

    /// Where models compute: cpu, or cuda:N.
    #[arg(long, env = "GATSBI_DEVICE", default_value = "cpu", help_heading = "Models")]
    pub device: DeviceArg,

    /// Address of the gRPC API.
    #[arg(
        long,
        env = "GATSBI_GRPC_LISTEN",
        default_value = "127.0.0.1:50051",
        help_heading = "Listeners"
    )]
    pub grpc_listen: SocketAddr,

    /// Address of the REST API.
    #[arg(
        long,
        env = "GATSBI_HTTP_LISTEN",
        default_value = "127.0.0.1:8080",
        help_heading = "Listeners"
    )]
    pub http_listen: SocketAddr,

    /// Address of administration: health, metrics, models. Without keys, whoever reaches it may use it.
    #[arg(
        long,
        env = "GATSBI_ADMIN_LISTEN",
        default_value = "127.0.0.1:9090",
        help_heading = "Listeners"
    )]
    pub admin_listen: SocketAddr,

    /// Allows addresses other than the loopback without keys and without certificates of clients: whoever reaches them
    /// may use them.
    #[arg(long, env = "GATSBI_ALLOW_PUBLIC", help_heading = "Listeners")]
    pub allow_public: bool,

    /// File of keys, which only its owner may read; with it every request needs a key. `gatsbi-server keys new` makes
    /// one. SIGHUP has it read again.
    #[arg(long, env = "GATSBI_KEYS", value_name = "PATH", help_heading = "Access")]
    pub keys: Option<PathBuf>,

    /// Certificate of the server with those between it and its authority, as PEM; with it every listener speaks TLS
    /// alone. SIGHUP has it read again.
    #[arg(long, env = "GATSBI_TLS_CERTIFICATE", value_name = "PATH", help_heading = "Access")]
    pub tls_certificate: Option<PathBuf>,

    /// Private key of the certificate, as PEM.
    #[arg(long, env = "GATSBI_TLS_KEY", value_name = "PATH", help_heading = "Access")]
    pub tls_key: Option<PathBuf>,

    /// Authorities, as PEM; with them a client must show a certificate that one of them has signed (mutual TLS).
    #[arg(long, env = "GATSBI_TLS_CLIENT_CA", value_name = "PATH", help_heading = "Access")]
    pub tls_client_ca: Option<PathBuf>,

    /// Lets /metrics be read without a key.
    #[arg(long, env = "GATSBI_OPEN_METRICS", help_heading = "Access")]
    pub open_metrics: bool,

    /// Open sessions of a tenant, where the file of keys says nothing else; no limit of its own if absent.
    #[arg(long, env = "GATSBI_TENANT_MAX_SESSIONS", value_name = "N", help_heading = "Access")]
    pub tenant_max_sessions: Option<u64>,

    /// Rows of rollouts that a tenant may have under way, likewise.
    #[arg(long, env = "GATSBI_TENANT_MAX_ROWS", value_name = "N", help_heading = "Access")]
    pub tenant_max_rows: Option<u64>,

    /// What a tenant may keep (earlier steps, frames, goals, handles), in MiB, likewise.
    #[arg(long, env = "GATSBI_TENANT_MAX_KEPT_MIB", value_name = "N", help_heading = "Access")]
    pub tenant_max_kept_mib: Option<u64>,

    /// Blocks that are computed at the same time on a CPU, each by threads of its own: what many candidates and many
    /// robots are answered with. More than there are idle cores makes every step slower; 0 takes half of the cores.
    #[arg(long, env = "GATSBI_WORKERS", default_value_t = 0, help_heading = "Engine")]
    pub workers: usize,

    /// CPU threads of one operation. Workers use cores better; 0 takes half of the cores.
    #[arg(long, env = "GATSBI_THREADS", default_value_t = 1, help_heading = "Engine")]
    pub threads: usize,

    /// Rows of an observe block. 1 answers a lone robot fastest; a GPU wants 16 or so. Changing it changes answers
    /// in their last bits.
    #[arg(long, env = "GATSBI_OBSERVE_BLOCK", default_value_t = 1, help_heading = "Engine")]
    pub observe_block: usize,

    /// Rows of an imagine block. Changing it changes answers in their last bits.
    #[arg(long, env = "GATSBI_IMAGINE_BLOCK", default_value_t = 8, help_heading = "Engine")]
    pub imagine_block: usize,

    /// Rows of the imagine blocks of rollouts that have at least so many rows: a row costs less among many, but a block
    /// keeps observations waiting for longer. The same as the imagine block turns it off. Changing it changes answers in
    /// their last bits.
    #[arg(long, env = "GATSBI_WIDE_BLOCK", default_value_t = 32, help_heading = "Engine")]
    pub wide_block: usize,

    /// How long rollouts may keep an observation waiting, in milliseconds; one block is always computed.
    #[arg(long, env = "GATSBI_TICK_MILLIS", default_value_t = 20, help_heading = "Engine")]
    pub tick_millis: u64,

    /// Rows of rollouts that are on their way at once, at least two blocks.
    #[arg(long, env = "GATSBI_ARENA_ROWS", default_value_t = 512, help_heading = "Engine")]
    pub arena_rows: usize,

    /// Observations that may wait for the model; more are refused.
    #[arg(long, env = "GATSBI_MAX_OBSERVES", default_value_t = 256, help_heading = "Limits")]
    pub max_observes: usize,

    /// Rows (candidates times samples) of all rollouts that may wait; more are refused.
    #[arg(long, env = "GATSBI_MAX_ROWS", default_value_t = 16_384, help_heading = "Limits")]
    pub max_rows: usize,

    /// Outputs of all rollouts that may wait to be fetched, in MiB; more are refused.
    #[arg(long, env = "GATSBI_MAX_OUTPUT_MIB", default_value_t = 1024, help_heading = "Limits")]
    pub max_output_mib: u64,

    /// Rows of one rollout.
    #[arg(long, env = "GATSBI_MAX_REQUEST_ROWS", default_value_t = 4096, help_heading = "Limits")]
    pub max_request_rows: u32,

    /// Outputs of one rollout, in MiB.
    #[arg(
        long,
        env = "GATSBI_MAX_REQUEST_OUTPUT_MIB",
        default_value_t = 256,
        help_heading = "Limits"
    )]
    pub max_request_output_mib: u64,

    /// Candidates of one rollout.
    #[arg(long, env = "GATSBI_MAX_CANDIDATES", default_value_t = 4096, help_heading = "Limits")]
    pub max_candidates: u32,

    /// Steps of one rollout.
    #[arg(long, env = "GATSBI_MAX_HORIZON", default_value_t = 256, help_heading = "Limits")]
    pub max_horizon: u32,

    /// Samples of one rollout.
    #[arg(long, env = "GATSBI_MAX_SAMPLES", default_value_t = 256, help_heading = "Limits")]
    pub max_samples: u32,

    /// Width and height of an image that is sent, in pixels.
    #[arg(long, env = "GATSBI_MAX_IMAGE_SIDE", default_value_t = 4096, help_heading = "Limits")]
    pub max_image_side: u32,

    /// Size of a request, in MiB.
    #[arg(long, env = "GATSBI_MAX_REQUEST_MIB", default_value_t = 16, help_heading = "Limits")]
    pub max_request_mib: usize,

    /// Sessions that are kept; more are refused.
    #[arg(long, env = "GATSBI_MAX_SESSIONS", default_value_t = 10_000, help_heading = "Limits")]
    pub max_sessions: usize,

    /// Earlier steps and frames that sessions keep, and rows of handles, in MiB; more are refused.
    #[arg(long, env = "GATSBI_MAX_KEPT_MIB", default_value_t = 1024, help_heading = "Limits")]
    pub max_kept_mib: u64,

    /// How long a session may lie unused, in seconds.
    #[arg(
        long,
        env = "GATSBI_SESSION_TTL_SECONDS",
        default_value_t = 3600,
        help_heading = "Limits"
    )]
    pub session_ttl_seconds: u64,

    /// How long requests may take to finish after SIGINT or SIGTERM, in seconds.
    #[arg(long, env = "GATSBI_DRAIN_SECONDS", default_value_t = 10, help_heading = "Operation")]
    pub drain_seconds: u64,

    /// What is logged, such as info or gatsbi_server=debug.
    #[arg(long, env = "GATSBI_LOG", default_value = "info", help_heading = "Operation")]
    pub log: String,

    /// How logs are written: text, or json, an object a line.
    #[arg(
        long,
        env = "GATSBI_LOG_FORMAT",
        value_enum,
        default_value = "text",
        help_heading = "Operation"
    )]
    pub log_format: LogFormat,

    /// Collector of traces (OTLP over gRPC), such as http://127.0.0.1:4317; none are sent if absent. Needs a server
    /// that was built with the feature otel.
    #[arg(long, env = "GATSBI_OTLP_ENDPOINT", value_name = "URL", help_heading = "Operation")]
    pub otlp_endpoint: Option<String>,
}

/// How logs are written.
#[derive(Clone, Copy, Debug, Eq, PartialEq, clap::ValueEnum)]
pub enum LogFormat {
    /// For people.
    Text,
    /// For machines.
    Json,
}

/// A checkpoint with the name to serve it under.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct CheckpointArg {
    /// The name; the checkpoint's own if absent.
    pub name: Option<String>,
    /// The file.
    pub path: PathBuf,
}

impl FromStr for CheckpointArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, path) = match text.split_once('=') {
            Some((name, path)) => (Some(name.to_owned()), path),
            None => (None, text),
        };
        if path.is_empty() || name.as_ref().is_some_and(String::is_empty) {
            return Err("expected PATH or NAME=PATH".to_owned());
        }
        Ok(Self { name, path: path.into() })
    }
}

/// A device.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct DeviceArg(pub tch::Device);

impl FromStr for DeviceArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let cuda = text.strip_prefix("cuda:").map(str::parse::<usize>);
        match (text, cuda) {
            ("cpu", _) => Ok(Self(tch::Device::Cpu)),
            ("cuda", _) => Ok(Self(tch::Device::Cuda(0))),
            (_, Some(Ok(index))) => Ok(Self(tch::Device::Cuda(index))),
            _ => Err("expected cpu or cuda:N".to_owned()),
        }
    }
}

impl Default for Config {
    fn default() -> Self {
        // Flags alone, so that the environment of a test does not matter.
        let command =
            <Self as clap::CommandFactory>::command().mut_args(|arg| arg.env(None::<&str>));
        let matches = command.get_matches_from(["gatsbi-server"]);
        <Self as clap::FromArgMatches>::from_arg_matches(&matches)
            .expect("every flag has a default")
    }
}

impl Config {
    /// Everything that is wrong, in words; nothing if it can be used.
    pub fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut check = |holds: bool, problem: String| {
            if !holds {
                problems.push(problem);
            }
        };
        check(
            !self.checkpoints.is_empty() || self.checkpoint_folder.is_some(),
            "no --checkpoint or --checkpoint-folder is given".to_owned(),
        );
        for (flag, address) in [
            ("--grpc-listen", self.grpc_listen),
            ("--http-listen", self.http_listen),
            ("--admin-listen", self.admin_listen),
        ] {
            let guarded = self.keys.is_some() || self.tls_client_ca.is_some();
            check(
                guarded || self.allow_public || address.ip().is_loopback(),
                format!(
                    "{flag} {address} can be reached from other machines, and whoever reaches it may use it; --keys \
                     asks for keys, and --allow-public says that none is needed"
                ),
            );
        }
        check(
            self.tls_certificate.is_some() == self.tls_key.is_some(),
            "--tls-certificate and --tls-key must be given together".to_owned(),
        );
        check(
            self.tls_client_ca.is_none() || self.tls_certificate.is_some(),
            "--tls-client-ca needs --tls-certificate and --tls-key".to_owned(),
        );
        let quota = [
            ("--tenant-max-sessions", self.tenant_max_sessions),
            ("--tenant-max-rows", self.tenant_max_rows),
            ("--tenant-max-kept-mib", self.tenant_max_kept_mib),
        ];
        for (flag, limit) in quota {
            check(limit != Some(0), format!("{flag} is 0, expected at least 1"));
            check(
                limit.is_none() || self.keys.is_some(),
                format!("{flag} needs --keys: without keys there are no tenants"),
            );
        }
        let ports = [self.grpc_listen, self.http_listen, self.admin_listen];
        for (at, address) in ports.iter().enumerate() {
            check(
                address.port() == 0 || !ports[..at].contains(address),
                format!("two listeners have the address {address}"),
            );
        }
        if let Err(error) = tracing_subscriber::EnvFilter::try_new(&self.log) {
            check(false, format!("--log is {:?}: {error}", self.log));
        }
        check(
            cfg!(feature = "otel") || self.otlp_endpoint.is_none(),
            "--otlp-endpoint needs a server that was built with the feature otel".to_owned(),
        );
        for (flag, value, range) in [
            ("--workers", self.workers, 0..=1024),
            ("--threads", self.threads, 0..=1024),
            ("--observe-block", self.observe_block, 1..=1024),
            ("--imagine-block", self.imagine_block, 1..=1024),
            ("--wide-block", self.wide_block, self.imagine_block..=1024),
            ("--arena-rows", self.arena_rows, 2 * self.wide_block..=1 << 20),
            ("--max-observes", self.max_observes, 1..=1 << 20),
            ("--max-rows", self.max_rows, self.max_request_rows as usize..=1 << 24),
            ("--max-request-rows", self.max_request_rows as usize, 1..=1 << 20),
            ("--max-candidates", self.max_candidates as usize, 1..=1 << 16),
            ("--max-horizon", self.max_horizon as usize, 1..=1 << 16),
            ("--max-samples", self.max_samples as usize, 1..=1 << 16),
            ("--max-image-side", self.max_image_side as usize, 1..=1 << 14),
            ("--max-request-mib", self.max_request_mib, 1..=1 << 10),
            ("--max-output-mib", self.max_output_mib as usize, 1..=1 << 20),
            (
                "--max-request-output-mib",
                self.max_request_output_mib as usize,
                1..=self.max_output_mib as usize,
            ),
            ("--max-sessions", self.max_sessions, 1..=1 << 24),
            ("--max-kept-mib", self.max_kept_mib as usize, 1..=1 << 20),
            ("--session-ttl-seconds", self.session_ttl_seconds as usize, 1..=1 << 30),
            ("--drain-seconds", self.drain_seconds as usize, 0..=3600),
        ] {
            check(
                range.contains(&value),
                format!("{flag} is {value}, expected {} to {}", range.start(), range.end()),
            );
        }
        if let tch::Device::Cuda(index) = self.device.0 {
            let found = tch::Cuda::device_count();
            check(
                (index as i64) < found,
                format!("--device is cuda:{index}, but libtorch sees {found} CUDA devices"),
            );
        }
        problems
    }

    /// Whether other machines can reach a listener.
    pub fn is_public(&self) -> bool {
        let all = [self.grpc_listen, self.http_listen, self.admin_listen];
        all.iter().any(|address| !address.ip().is_loopback())
    }

    /// Where certificates are, if there are any.
    pub fn tls(&self) -> Option<TlsFiles> {
        Some(TlsFiles {
            certificate: self.tls_certificate.clone()?,
            key: self.tls_key.clone()?,
            client_ca: self.tls_client_ca.clone(),
        })
    }

    /// What a tenant may take, unless the file of keys says something else.
    pub fn quota(&self) -> Quota {
        Quota {
            sessions: self.tenant_max_sessions.unwrap_or(u64::MAX),
            rows: self.tenant_max_rows.unwrap_or(u64::MAX),
            kept_bytes: self.tenant_max_kept_mib.map_or(u64::MAX, |mib| mib << 20),
        }
    }

    /// Where checkpoints come from, and where they go.
    pub fn checkpoints(&self) -> Checkpoints {
        Checkpoints { folder: self.checkpoint_folder.clone(), device: self.device.0 }
    }

    /// Sizes of the engine.
    pub fn engine(&self) -> EngineConfig {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let or_half = |count: usize| if count == 0 { (cores / 2).max(1) } else { count };
        let cuda = matches!(self.device.0, tch::Device::Cuda(_));
        EngineConfig {
            // A GPU computes one block after the other anyway.
            workers: if cuda { 1 } else { or_half(self.workers) },
            threads: or_half(self.threads),
            sizes: Sizes {
                observe_block: self.observe_block,
                imagine_block: self.imagine_block,
                wide_block: self.wide_block,
                slots: self.arena_rows,
            },
            tick: Duration::from_millis(self.tick_millis),
            door: DoorSizes {
                observes: self.max_observes,
                rows: self.max_rows,
                output_bytes: self.max_output_mib << 20,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_lack_nothing_but_a_checkpoint() {
        let problem = "no --checkpoint or --checkpoint-folder is given";
        assert_eq!(Config::default().problems(), [problem]);
    }

    #[test]
    fn all_problems_are_told_at_once() {
        let config = Config {
            checkpoints: vec!["tiny=models/tiny.safetensors".parse().unwrap()],
            http_listen: "0.0.0.0:80".parse().unwrap(),
            imagine_block: 0,
            max_rows: 1,
            ..Config::default()
        };
        let problems = config.problems();
        assert_eq!(problems.len(), 3, "{problems:?}");
        assert!(problems[0].starts_with("--http-listen 0.0.0.0:80"));
        assert_eq!(problems[1], "--imagine-block is 0, expected 1 to 1024");
        assert_eq!(problems[2], "--max-rows is 1, expected 4096 to 16777216");
        let public = Config { allow_public: true, imagine_block: 1, max_rows: 4096, ..config };
        assert_eq!(public.problems(), Vec::<String>::new());
    }

    #[test]
    fn checkpoints_may_be_named() {
        let parse = |text: &str| text.parse::<CheckpointArg>();
        assert_eq!(parse("a/b.safetensors").unwrap().name, None);
        let named = parse("tiny=a/b.safetensors").unwrap();
        assert_eq!(named.name.as_deref(), Some("tiny"));
        assert_eq!(named.path, PathBuf::from("a/b.safetensors"));
        assert!(parse("tiny=").is_err() && parse("=x").is_err());
        assert!("cuda:x".parse::<DeviceArg>().is_err());
        assert_eq!("cuda:1".parse::<DeviceArg>().unwrap().0, tch::Device::Cuda(1));
    }
}
