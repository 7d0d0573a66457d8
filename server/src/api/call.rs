//! What a call says about itself beside its message: until when an answer is of use, and whose it is.

use std::{
    convert::Infallible,
    time::{Duration, Instant},
};

use axum::{
    extract::FromRequestParts,
    http::{HeaderMap, request::Parts},
};

use crate::service::Call;

/// Names the tenant that shares the server with others, on both APIs.
pub(crate) const TENANT: &str = "gatsbi-tenant";

/// What headers (on gRPC: metadata) say.
pub(super) fn of(headers: &HeaderMap) -> Call {
    let tenant = headers.get(TENANT).map(|name| Call::tenant_named(name.as_bytes()));
    Call { deadline: deadline(headers), tenant }
}

/// What the headers of a REST request say.
pub(super) struct Of(pub(super) Call);

impl<S: Sync> FromRequestParts<S> for Of {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(Self(of(&parts.headers)))
    }
}

/// The deadline that a call brings along: up to eight digits and a unit (gRPC over HTTP/2, `grpc-timeout`).
fn deadline(headers: &HeaderMap) -> Option<Instant> {
    let text = headers.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let number: u64 = digits.parse().ok().filter(|_| digits.len() <= 8)?;
    let timeout = match unit {
        "H" => Duration::from_secs(number * 3600),
        "M" => Duration::from_secs(number * 60),
        "S" => Duration::from_secs(number),
        "m" => Duration::from_millis(number),
        "u" => Duration::from_micros(number),
        "n" => Duration::from_nanos(number),
        _ => return None,
    };
    Instant::now().checked_add(timeout)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadlines_of_calls_are_understood() {
        let left = |text: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert("grpc-timeout", text.parse().unwrap());
            deadline(&headers).map(|at| at.duration_since(Instant::now()))
        };
        let near = |text, seconds: f64| {
            let left = left(text).unwrap().as_secs_f64();
            assert!((seconds - 1.0..=seconds).contains(&left), "{text}: {left}");
        };
        near("5S", 5.0);
        near("2H", 7200.0);
        near("3M", 180.0);
        near("2500m", 2.5);
        near("4000000u", 4.0);
        assert!(left("10n").is_some());
        for bad in ["", "5", "S", "5s", "123456789S", "-1S"] {
            assert_eq!(left(bad), None, "{bad}");
        }
        assert_eq!(deadline(&HeaderMap::new()), None);
    }
}
