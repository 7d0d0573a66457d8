//! From flags, environment and file to a configuration: a flag goes before the environment, that before the file, and
//! the file before the default. All that is wrong in any of them is told at once.
//!
//! The file has a section for each heading of `--help`, and in it the flags' names with `_` for `-`. Its values become
//! the defaults of the flags, so whatever understands a flag understands the file.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
};

use clap::{Arg, ArgAction, ArgMatches, Args, Command, CommandFactory as _, FromArgMatches as _};

use super::Config;

/// Where a configuration comes from.
#[derive(Clone, Debug, Args)]
pub struct Source {
    /// File of settings (TOML); flags and the environment go before it. SIGHUP has it read again.
    #[arg(long, env = "GATSBI_CONFIG", value_name = "PATH")]
    pub config: Option<PathBuf>,
}

/// A configuration with how it was given.
#[derive(Debug)]
pub struct Layered {
    /// The configuration.
    pub config: Config,
    /// How it was given, for what else the command has.
    pub matches: ArgMatches,
}

/// The command line asks for something else, or something is wrong.
#[derive(Debug)]
pub enum Unusable {
    /// Help or the version was asked for.
    Told(clap::Error),
    /// All that is wrong, a sentence each.
    Problems(Vec<String>),
}

/// Reads what a command that has all of [`Config`] and [`Source`] is given.
///
/// # Errors
/// [`Unusable`].
pub fn read(mut command: Command, arguments: &[OsString]) -> Result<Layered, Unusable> {
    let mut problems = Vec::new();
    if let Some(path) = file_named(&command, arguments) {
        match lines(&path) {
            Ok(lines) => command = with_file(command, &path, lines, &mut problems),
            Err(problem) => problems.push(problem),
        }
    }
    command = with_environment(command, &mut problems);
    let matches = match command.try_get_matches_from(arguments) {
        Ok(matches) => matches,
        Err(error) if !error.use_stderr() => return Err(Unusable::Told(error)),
        Err(error) => {
            problems.push(sentence(&error));
            return Err(Unusable::Problems(problems));
        }
    };
    let config = match Config::from_arg_matches(&matches) {
        Ok(config) => config,
        Err(error) => {
            problems.push(sentence(&error));
            return Err(Unusable::Problems(problems));
        }
    };
    if matches.subcommand().is_none() {
        problems.extend(config.problems());
    }
    if problems.is_empty() {
        Ok(Layered { config, matches })
    } else {
        Err(Unusable::Problems(problems))
    }
}

/// The section of the file and the name in it of a flag; none for what cannot stand in a file.
pub(super) fn place(arg: &Arg) -> Option<(String, String)> {
    let section = arg.get_help_heading()?.to_lowercase();
    Some((section, arg.get_long()?.replace('-', "_")))
}

/// The settings, in the order of `--help`.
pub(super) fn settings() -> Vec<Arg> {
    Config::command().get_arguments().filter(|arg| place(arg).is_some()).cloned().collect()
}

fn file_named(command: &Command, arguments: &[OsString]) -> Option<PathBuf> {
    let lenient = command.clone().ignore_errors(true).try_get_matches_from(arguments);
    lenient.ok()?.try_get_one::<PathBuf>("config").ok()?.cloned()
}

/// Section, name and values of each line.
fn lines(path: &Path) -> Result<Vec<(String, String, toml::Value)>, String> {
    let shown = path.display();
    let text = std::fs::read_to_string(path)
        .map_err(|error| format!("the configuration {shown} cannot be read: {error}"))?;
    let table: toml::Table = toml::from_str(&text).map_err(|error| {
        let line = error.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
        format!("the configuration {shown} is no TOML: line {line}: {}", error.message())
    })?;
    let mut lines = Vec::new();
    for (section, value) in table {
        match value {
            toml::Value::Table(table) => {
                lines.extend(table.into_iter().map(|(name, value)| (section.clone(), name, value)));
            }
            value => lines.push((String::new(), section, value)),
        }
    }
    Ok(lines)
}

/// The command with the values of a file as defaults.
fn with_file(
    mut command: Command,
    path: &Path,
    lines: Vec<(String, String, toml::Value)>,
    problems: &mut Vec<String>,
) -> Command {
    let known = settings();
    for (section, name, value) in lines {
        let place_told =
            if section.is_empty() { name.clone() } else { format!("[{section}] {name}") };
        let here = format!("{}: {place_told}", path.display());
        let place_of = |arg: &&Arg| place(arg) == Some((section.clone(), name.clone()));
        let Some(arg) = known.iter().find(place_of) else {
            let elsewhere = known.iter().filter_map(place).find(|(_, known)| *known == name);
            let hint =
                elsewhere.map_or_else(String::new, |(it, _)| format!("; it belongs to [{it}]"));
            problems.push(format!("{here} is not a setting{hint}"));
            continue;
        };
        let Some(values) = words(&value) else {
            problems.push(format!("{here} is {}, expected a plain value", value.type_str()));
            continue;
        };
        match check(arg, &values) {
            Ok(()) => {
                command = command.mut_arg(arg.get_id().as_str(), |arg| arg.default_values(values));
            }
            Err(problem) => problems.push(format!("{here}: {problem}")),
        }
    }
    command
}

/// The command without the variables that cannot be understood.
fn with_environment(mut command: Command, problems: &mut Vec<String>) -> Command {
    for arg in settings() {
        let variable = arg.get_env().map(|name| name.to_string_lossy().into_owned());
        let Some(variable) = variable else { continue };
        let Ok(value) = std::env::var(&variable) else { continue };
        if let Err(problem) = check(&arg, &[value]) {
            problems.push(format!("{variable}: {problem}"));
            command = command.mut_arg(arg.get_id().as_str(), |arg| arg.env(None::<&str>));
        }
    }
    command
}

/// Whether a flag would understand values.
fn check(arg: &Arg, values: &[String]) -> Result<(), String> {
    let long = arg.get_long().unwrap_or_default();
    let mut alone = arg.clone().env(None::<&str>).default_values(Vec::<&str>::new());
    if matches!(arg.get_action(), ArgAction::SetTrue) {
        // As a flag it takes no value, elsewhere true or false.
        alone = alone.action(ArgAction::Set);
    }
    let given = values.iter().map(|value| format!("--{long}={value}"));
    let given = std::iter::once(String::new()).chain(given);
    let tried = Command::new("").disable_help_flag(true).arg(alone).try_get_matches_from(given);
    tried.map(|_| ()).map_err(|error| sentence(&error))
}

/// A value of the file as words of a command line.
fn words(value: &toml::Value) -> Option<Vec<String>> {
    match value {
        toml::Value::String(text) => Some(vec![text.clone()]),
        toml::Value::Integer(number) => Some(vec![number.to_string()]),
        toml::Value::Float(number) => Some(vec![number.to_string()]),
        toml::Value::Boolean(yes) => Some(vec![yes.to_string()]),
        toml::Value::Array(values) => {
            let plain = values.iter().map(|value| words(value)?.pop());
            plain.collect()
        }
        toml::Value::Datetime(_) | toml::Value::Table(_) => None,
    }
}

/// What clap says, without how it should be called.
fn sentence(error: &clap::Error) -> String {
    let text = error.to_string();
    let first = text.lines().next().unwrap_or_default();
    first.strip_prefix("error: ").unwrap_or(first).to_owned()
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn command() -> Command {
        // Flags and file alone, so that the environment of a test does not matter.
        let command = Source::augment_args(Config::command());
        command.mut_args(|arg| arg.env(None::<&str>))
    }

    fn read_file(text: &str, flags: &[&str]) -> Result<Config, Vec<String>> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        let mut arguments = vec!["gatsbi-server".into(), "--config".into(), file.path().into()];
        arguments.extend(flags.iter().map(OsString::from));
        match read(command(), &arguments) {
            Ok(layered) => Ok(layered.config),
            Err(Unusable::Problems(problems)) => Err(problems),
            Err(Unusable::Told(error)) => panic!("{error}"),
        }
    }

    #[test]
    fn a_flag_goes_before_the_file_and_the_file_before_the_default() {
        let text = "[models]\ncheckpoint = [\"a=b\", \"c\"]\n[limits]\nmax_rows = 5000\n\
                    max_sessions = 3\n[listeners]\nallow_public = true\nhttp_listen = \"0.0.0.0:80\"\n";
        let config = read_file(text, &["--max-rows", "6000"]).unwrap();
        assert_eq!((config.max_rows, config.max_sessions, config.max_observes), (6000, 3, 256));
        assert!(config.allow_public && config.http_listen.port() == 80);
        assert_eq!(config.checkpoints.len(), 2);
        assert_eq!(config.checkpoints[0].name.as_deref(), Some("a"));
        let flags = ["--checkpoint", "other"];
        assert_eq!(read_file(text, &flags).unwrap().checkpoints.len(), 1);
    }

    #[test]
    fn settings_of_the_image_are_understood() {
        let config = read_file(include_str!("../../../docker/gatsbi.toml"), &[]).unwrap();
        assert!(config.is_public() && config.open_metrics && config.keys.is_some());
        assert_eq!(config.checkpoints.len(), 1);
    }

    #[test]
    fn all_that_is_wrong_is_told_at_once() {
        let text = "threads = 2\n[limits]\nmax_rows = \"many\"\nmax_sessions = 0\nthreads = 2\n\
                    [listeners]\nallow_public = 7\n[engine]\ntick_millis = {}\n";
        let problems = read_file(text, &[]).unwrap_err();
        let told = problems.join("\n");
        for part in [
            ": threads is not a setting; it belongs to [engine]",
            "[limits] threads is not a setting; it belongs to [engine]",
            "[limits] max_rows: invalid value 'many' for '--max-rows <MAX_ROWS>'",
            "[listeners] allow_public: invalid value '7'",
            "[engine] tick_millis is table, expected a plain value",
            "--max-sessions is 0, expected 1 to",
            "no --checkpoint",
        ] {
            assert!(told.contains(part), "{part}\n{told}");
        }
        assert_eq!(problems.len(), 7, "{told}");
    }

    #[test]
    fn a_file_that_cannot_be_read_is_one_sentence() {
        let told = read_file("[limits\n", &[]).unwrap_err().remove(0);
        assert!(told.contains("is no TOML: line 1"), "{told}");
        let arguments = ["gatsbi-server", "--config", "/nowhere.toml"].map(OsString::from);
        let Err(Unusable::Problems(problems)) = read(command(), &arguments) else { panic!() };
        assert!(problems[0].contains("/nowhere.toml cannot be read"), "{problems:?}");
    }
}
