//! What went wrong, in one sentence or as JSON, and as which exit code.

use std::{fmt, io::Write as _, process::ExitCode};

use gatsbi_client::Error;
use serde_json::json;

/// A wrong command line or file, found before the server was asked.
#[derive(Debug)]
pub(crate) struct Misuse(pub(crate) String);

impl fmt::Display for Misuse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Misuse {}

/// Ends a function with a [`Misuse`].
macro_rules! misuse {
    ($($sentence:tt)*) => {
        return Err($crate::failure::Misuse(format!($($sentence)*)).into())
    };
}
pub(crate) use misuse;

/// Prints an error to standard error; returns the program's exit code.
pub(crate) fn report(error: &anyhow::Error, json: bool) -> ExitCode {
    let code = exit_code(error);
    let line =
        if json { record(error, code).to_string() } else { format!("error: {}", sentence(error)) };
    // Nobody can be told that standard error cannot be written.
    let _ = writeln!(std::io::stderr(), "{line}");
    ExitCode::from(code)
}

fn exit_code(error: &anyhow::Error) -> u8 {
    for cause in error.chain() {
        if let Some(error) = cause.downcast_ref::<Error>() {
            return match error {
                error if error.may_pass() => 4,
                Error::Refused(_) => 3,
                Error::Address { .. } | Error::Input { .. } => 2,
                _ => 1,
            };
        }
        if cause.is::<Misuse>() || cause.is::<gatsbi_episodes::Error>() {
            return 2;
        }
    }
    1
}

fn sentence(error: &anyhow::Error) -> String {
    if let Some(error @ Error::Unreachable { source, .. }) = error.downcast_ref() {
        // Only the innermost cause says something: Connection refused, for instance.
        let mut cause: &dyn std::error::Error = source;
        while let Some(deeper) = cause.source() {
            cause = deeper;
        }
        return format!("{error} ({cause}): start one, or say with --server where it is");
    }
    format!("{error:#}")
}

fn record(error: &anyhow::Error, code: u8) -> serde_json::Value {
    let problem = error.downcast_ref::<Error>().and_then(Error::problem);
    let fields = problem.map_or(&[][..], |problem| &problem.fields);
    let fields: Vec<_> = fields
        .iter()
        .map(|field| json!({ "field": field.field, "description": field.description }))
        .collect();
    json!({ "error": {
        "exit_code": code,
        "reason": problem.map(|problem| &problem.reason),
        "message": sentence(error),
        "fields": fields,
    } })
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use anyhow::Context as _;
    use gatsbi_client::{Code, FieldProblem, Problem};

    use super::*;

    fn refused(code: Code) -> anyhow::Error {
        Error::Refused(Box::new(Problem {
            code,
            reason: "INVALID_FIELDS".into(),
            message: "observation.action is 6 numbers, expected 7 numbers".into(),
            fields: vec![FieldProblem {
                field: "observation.action".into(),
                description: "is 6 numbers, expected 7 numbers".into(),
            }],
            retry_after: None,
        }))
        .into()
    }

    #[test]
    fn exit_codes_tell_whose_turn_it_is() {
        let misuse = || -> anyhow::Result<()> { misuse!("--index {} is too large", 7) };
        let no_file = gatsbi_episodes::Dataset::open("no such file").unwrap_err();
        let written: anyhow::Result<()> = Err(std::io::Error::other("full")).context("picture");
        for (error, code) in [
            (refused(Code::InvalidArgument), 3),
            (refused(Code::Unavailable), 4),
            (Error::TimedOut(Duration::from_secs(1)).into(), 4),
            (Error::Address { url: "x".into() }.into(), 2),
            (misuse().unwrap_err(), 2),
            (anyhow::Error::from(no_file).context("--episode"), 2),
            (written.unwrap_err(), 1),
        ] {
            assert_eq!(exit_code(&error), code, "{error:#}");
        }
    }

    #[test]
    fn machines_get_the_fields() {
        let error = record(&refused(Code::InvalidArgument), 3);
        assert_eq!(error["error"]["fields"][0]["field"], "observation.action");
        assert_eq!(error["error"]["reason"], "INVALID_FIELDS");
        assert_eq!(error["error"]["exit_code"], 3);
    }
}
