//! Who may do what: keys, roles, tenants and their quotas.
//!
//! A key ([`key`]) belongs to a tenant and has a role; the file of keys ([`key_file`]) holds digests only. The gate
//! ([`gate`]) stands before each listener's paths and looks at the headers of a request alone: which role the path
//! needs ([`need`]), and whose key came along. It then hands the request to the tenant's own router, whose
//! [`crate::service::Service`] sees what belongs to that tenant and nothing else ([`tenants`]), so no handler can
//! forget to ask. What is let in and goes on ends with its key ([`lease`]). Without a file of keys everybody may do everything, which is why the server then listens on the
//! loopback.

pub mod command;
pub mod gate;
pub mod key;
pub mod key_file;
pub mod lease;
pub mod need;
pub mod tenants;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::Arc,
    time::SystemTime,
};

use parking_lot::RwLock;
use tokio::sync::watch;

use self::{
    key::{KeyDigest, Role},
    key_file::{Entry, KeyFile, KeyFileError},
    lease::Lease,
    need::Need,
    tenants::{Owner, Quota, Tenants},
};
use crate::error::Error;

/// The keys that are in force, and the tenants that they belong to.
#[derive(Debug)]
pub struct Access {
    path: PathBuf,
    keys: RwLock<Arc<[Entry]>>,
    changes: watch::Sender<()>,
    tenants: Tenants,
}

/// Whose request it is.
#[derive(Clone, Debug)]
pub struct Pass {
    /// Name of the tenant.
    pub tenant: String,
    /// What it owns and may take.
    pub owner: Owner,
    /// For how long.
    pub lease: Lease,
}

impl Access {
    /// Reads a file of keys. Tenants have `quota` where the file says nothing else.
    ///
    /// # Errors
    /// If the file cannot be used, with all that is wrong.
    pub fn load(path: &Path, quota: Quota) -> Result<Self, KeyFileError> {
        let file = KeyFile::read(path)?;
        let tenants = Tenants::default();
        tenants.set(&file.tenants(), &file.quotas, quota);
        tracing::info!(path = %path.display(), keys = file.keys.len(), "keys read");
        let (keys, changes) = (RwLock::new(file.keys.into()), watch::Sender::new(()));
        Ok(Self { path: path.to_owned(), keys, changes, tenants })
    }

    /// Reads the file again; from then on its keys and quotas are in force.
    ///
    /// # Errors
    /// If the file cannot be used. The keys stay as they are then.
    pub fn reload(&self, quota: Quota) -> Result<usize, KeyFileError> {
        let file = KeyFile::read(&self.path)?;
        self.tenants.set(&file.tenants(), &file.quotas, quota);
        let count = file.keys.len();
        *self.keys.write() = file.keys.into();
        self.changes.send_replace(());
        Ok(count)
    }

    /// Lets a request in that brought `secret` and needs something; without a pass where it needs nothing.
    ///
    /// # Errors
    /// If there is no such key, it has expired, or its role is too low.
    pub fn admit(
        self: &Arc<Self>,
        secret: Option<&str>,
        need: Need,
    ) -> Result<Option<Pass>, Error> {
        let needs = match need {
            Need::Nothing => return Ok(None),
            Need::Role(role) => role,
        };
        let digest = KeyDigest::of(secret.ok_or(Error::NoKey)?);
        // Before the keys are looked at, so that no change is missed.
        let changes = self.changes.subscribe();
        let Entry { tenant, .. } = self.entry(&digest, needs)?;
        let owner = self.tenants.owner(&tenant);
        let lease = Lease::new(self, (digest, needs), &tenant, changes);
        Ok(Some(Pass { tenant, owner, lease }))
    }

    /// The key that has a digest, if it is good for something now.
    fn entry(&self, digest: &KeyDigest, needs: Role) -> Result<Entry, Error> {
        let keys = Arc::clone(&self.keys.read());
        let entry = key::find(&keys, digest).ok_or(Error::WrongKey)?;
        if entry.expires.is_some_and(|at| at <= SystemTime::now()) {
            return Err(Error::ExpiredKey);
        }
        if entry.role < needs {
            return Err(Error::RoleTooLow { role: entry.role.name(), needs: needs.name() });
        }
        Ok(entry.clone())
    }

    /// Tenants with what they have taken, by name.
    pub fn taken(&self) -> BTreeMap<String, tenants::Amount> {
        self.tenants.taken()
    }
}
