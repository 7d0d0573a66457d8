//! A configuration as a file with comments, which can be read again.
//!
//! It holds no secrets: keys and certificates are named by their paths. What a URL may carry is left out.

use clap::{Arg, ArgMatches, CommandFactory as _};

use super::{
    Config,
    layers::{place, settings},
};

/// Characters of a line of comments.
const WIDTH: usize = 100;

/// How settings are written.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Style {
    /// What is in force.
    Effective,
    /// What could be set: every line is commented out.
    Example,
}

/// The settings of a command line.
pub fn render(matches: &ArgMatches, style: Style) -> String {
    let mut text = String::new();
    let mut current = String::new();
    for arg in settings() {
        let Some((section, name)) = place(&arg) else { continue };
        if section != current {
            text += &format!("{}[{section}]\n", if current.is_empty() { "" } else { "\n" });
            current = section;
        }
        text += "\n";
        comment(&mut text, &arg);
        let value = value(&arg, matches);
        let set = value.is_some() && style == Style::Effective;
        let value = value.unwrap_or_else(|| placeholder(&arg));
        text += &format!("{}{name} = {value}\n", if set { "" } else { "# " });
    }
    text
}

/// Every setting with its default.
pub fn example() -> String {
    let command = Config::command().mut_args(|arg| arg.env(None::<&str>));
    let defaults = command.get_matches_from(["gatsbi-server"]);
    format!(
        "# Settings of gatsbi-server and their defaults: `gatsbi-server --config gatsbi.toml`. Flags go before the\n\
         # environment, and that before this file. A flag is a name here with - for _, a variable GATSBI_NAME.\n\
         # `gatsbi-server --print-config` shows what is in force.\n\n{}",
        render(&defaults, Style::Example)
    )
}

fn comment(text: &mut String, arg: &Arg) {
    let help = arg.get_long_help().or(arg.get_help()).map(ToString::to_string).unwrap_or_default();
    let mut line = String::from("#");
    for word in help.split_whitespace() {
        if line.len() + 1 + word.len() > WIDTH {
            text.push_str(&line);
            text.push('\n');
            line = String::from("#");
        }
        line.push(' ');
        line.push_str(word);
    }
    text.push_str(&line);
    text.push('\n');
}

fn value(arg: &Arg, matches: &ArgMatches) -> Option<String> {
    let raw = matches.get_raw(arg.get_id().as_str())?;
    let mut values: Vec<String> = raw.map(|raw| written(&raw.to_string_lossy())).collect();
    let many = matches!(arg.get_action(), clap::ArgAction::Append);
    if many { Some(format!("[{}]", values.join(", "))) } else { values.pop() }
}

/// A number or a truth as it is, all else as text.
fn written(raw: &str) -> String {
    let plain = raw.parse::<i64>().is_ok_and(|number| number.to_string() == raw);
    if plain || ["true", "false"].contains(&raw) {
        return raw.to_owned();
    }
    toml::Value::from(without_password(raw)).to_string()
}

/// A URL without the name and password that it may carry.
fn without_password(raw: &str) -> String {
    let Some((scheme, rest)) = raw.split_once("://") else { return raw.to_owned() };
    let end = rest.find('/').unwrap_or(rest.len());
    match rest[..end].rfind('@') {
        Some(at) => format!("{scheme}://REDACTED{}", &rest[at..]),
        None => raw.to_owned(),
    }
}

fn placeholder(arg: &Arg) -> String {
    let name = arg.get_value_names().and_then(|names| names.first());
    match name.map(ToString::to_string).unwrap_or_default() {
        number if number == "N" => number,
        text => format!("{text:?}"),
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;

    use clap::Args as _;

    use super::*;
    use crate::config::layers::{Source, read};

    /// Set, it writes what the test compares with.
    const UPDATE: &str = "GATSBI_UPDATE_CONFIG";

    fn command() -> clap::Command {
        Source::augment_args(Config::command()).mut_args(|arg| arg.env(None::<&str>))
    }

    fn given(flags: &[&str]) -> ArgMatches {
        let all = std::iter::once("gatsbi-server").chain(flags.iter().copied());
        read(command(), &all.map(OsString::from).collect::<Vec<_>>()).unwrap().matches
    }

    #[test]
    fn the_example_is_as_checked_in_and_every_line_of_it_is_understood() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/gatsbi.toml");
        if std::env::var_os(UPDATE).is_some() {
            std::fs::write(path, example()).unwrap();
        }
        let checked_in = std::fs::read_to_string(path).unwrap();
        assert!(checked_in == example(), "settings have changed; {UPDATE}=1 writes {path} anew");
        // What is absent by default has a placeholder.
        let absent = ["PATH\"", "\"URL\"", " = N"];
        let uncommented = checked_in.lines().filter_map(|line| match line.strip_prefix("# ") {
            None => Some(line),
            Some(text) => {
                let (name, _) = text.split_once(" = ")?;
                let set = !name.contains(' ') && !absent.iter().any(|it| text.ends_with(it));
                set.then_some(text)
            }
        });
        let uncommented: Vec<&str> = uncommented.collect();
        assert!(uncommented.len() > 30, "{uncommented:#?}");
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), uncommented.join("\n")).unwrap();
        let path = file.path().to_str().unwrap();
        given(&["--config", path, "--checkpoint", "a", "--checkpoint-folder", "b"]);
    }

    #[test]
    fn what_is_printed_is_read_again_and_shows_no_password() {
        let flags =
            ["--checkpoint", "a=b c", "--max-rows", "5000", "--keys", "k", "--open-metrics"];
        let printed = render(&given(&flags), Style::Effective);
        assert!(
            printed.contains("checkpoint = [\"a=b c\"]") && printed.contains("max_rows = 5000")
        );
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), &printed).unwrap();
        let again = given(&["--config", file.path().to_str().unwrap()]);
        assert_eq!(render(&again, Style::Effective), printed);
        assert_eq!(written("http://me:secret@host:1/x"), "\"http://REDACTED@host:1/x\"");
    }
}
