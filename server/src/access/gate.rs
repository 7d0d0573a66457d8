//! The gate before a listener: nobody's body is read, and no handler runs, before a key has let the request in.

use std::{collections::BTreeMap, fmt, sync::Arc};

use axum::{
    Router,
    extract::Request,
    http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header},
    response::{IntoResponse as _, Response},
};
use parking_lot::RwLock;
use tower::ServiceExt as _;

use super::{
    Access, Pass,
    lease::{Lease, leased},
    need::Need,
    tenants::Owner,
};
use crate::{
    api::{call::TENANT, problem},
    error::Error,
    telemetry,
};

/// What answers let a browser do: run and show what comes from here, in no frame, without guessing types or telling
/// others where it was.
const HEADERS: [(&str, &str); 5] = [
    (
        "content-security-policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; font-src 'self'; \
         connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    ),
    ("x-content-type-options", "nosniff"),
    ("x-frame-options", "DENY"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
];

/// What a request needs.
type NeedOf = Arc<dyn Fn(&Method, &Uri) -> Need + Send + Sync>;

/// The gate before one listener.
#[derive(Clone)]
pub struct Gate {
    access: Option<Arc<Access>>,
    need: NeedOf,
    /// What needs no key.
    open: Router,
    router_of: Arc<dyn Fn(Owner) -> Router + Send + Sync>,
    /// Routers of tenants that were here, by name, and everybody's where there are no keys.
    routers: Arc<RwLock<BTreeMap<String, Router>>>,
}

impl fmt::Debug for Gate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Gate").field("access", &self.access).finish_non_exhaustive()
    }
}

impl Gate {
    /// A gate before routers that `router_of` makes, one for each tenant, over what belongs to it alone; `open` is
    /// there for everybody.
    pub fn new(
        access: Option<Arc<Access>>,
        need: impl Fn(&Method, &Uri) -> Need + Send + Sync + 'static,
        open: Router,
        router_of: impl Fn(Owner) -> Router + Send + Sync + 'static,
    ) -> Self {
        Self {
            access,
            need: Arc::new(need),
            open,
            router_of: Arc::new(router_of),
            routers: Arc::default(),
        }
    }

    /// The gate as a router.
    pub fn into_router(self) -> Router {
        Router::new().fallback(move |request: Request| {
            let gate = self.clone();
            async move { gate.answer(request).await }
        })
    }

    async fn answer(&self, mut request: Request) -> Response {
        let (router, lease) = match self.admit(&mut request) {
            Ok(admitted) => admitted,
            Err(error) => return refuse(&request, &error),
        };
        let response = router.oneshot(request).await;
        let mut response = response.unwrap_or_else(|never| match never {});
        if let Some(lease) = lease {
            response = leased(response, lease);
        }
        harden(response.headers_mut());
        response
    }

    /// The router that a request may use, and for how long if not for ever.
    fn admit(&self, request: &mut Request) -> Result<(Router, Option<Lease>), Error> {
        let Some(access) = &self.access else {
            return Ok((self.router("", &Owner::default()), None));
        };
        let need = (self.need)(request.method(), request.uri());
        let Some(Pass { tenant, owner, lease }) = access.admit(bearer(request.headers()), need)?
        else {
            return Ok((self.open.clone(), None));
        };
        let name = HeaderValue::from_str(&tenant).expect("names of tenants fit into headers");
        request.headers_mut().insert(TENANT, name);
        request.headers_mut().remove(header::AUTHORIZATION);
        Ok((self.router(&tenant, &owner), Some(lease)))
    }

    fn router(&self, tenant: &str, owner: &Owner) -> Router {
        if let Some(router) = self.routers.read().get(tenant) {
            return router.clone();
        }
        let router = (self.router_of)(owner.clone());
        self.routers.write().entry(tenant.to_owned()).or_insert(router).clone()
    }
}

fn refuse(request: &Request, error: &Error) -> Response {
    let reason = problem::entry(error).reason;
    telemetry::turned_away(reason);
    tracing::debug!(path = request.uri().path(), reason, "turned away");
    let media = request.headers().get(header::CONTENT_TYPE).and_then(|it| it.to_str().ok());
    if media.is_some_and(|media| media.starts_with("application/grpc")) {
        return problem::status(error).into_http();
    }
    let mut response = error.clone().into_response();
    if response.status() == StatusCode::UNAUTHORIZED {
        let scheme = HeaderValue::from_static("Bearer realm=\"gatsbi\"");
        response.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
    }
    harden(response.headers_mut());
    response
}

fn harden(headers: &mut HeaderMap) {
    for (name, value) in HEADERS {
        // A page may know better what it needs.
        headers.entry(name).or_insert(HeaderValue::from_static(value));
    }
}

/// The key in `Authorization: Bearer KEY`.
fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, secret) = headers.get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| secret.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(all: &[(&'static str, &'static str)]) -> HeaderMap {
        all.iter().map(|(name, value)| (name.parse().unwrap(), value.parse().unwrap())).collect()
    }

    #[test]
    fn keys_are_found_in_their_header() {
        assert_eq!(bearer(&headers(&[("authorization", "Bearer abc")])), Some("abc"));
        assert_eq!(bearer(&headers(&[("authorization", "bearer  abc ")])), Some("abc"));
        for wrong in ["abc", "Basic abc", "Bearer"] {
            assert_eq!(bearer(&headers(&[("authorization", wrong)])), None, "{wrong}");
        }
    }
}
