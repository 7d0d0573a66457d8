//! Who may do what: keys, roles, tenants and their quotas.
//!
//! A key ([`key`]) belongs to a tenant and has a role; the file of keys ([`key_file`]) holds digests only. The gate
//! ([`gate`]) stands before each listener's paths and looks at the headers of a request alone: which role the path
//! needs ([`need`]), and whose key came along. It then hands the request to the tenant's own router, whose
//! [`crate::service::Service`] sees what belongs to that tenant and nothing else ([`tenants`]), so no handler can
//! forget to ask. Without a file of keys everybody may do everything, which is why the server then listens on the
//! loopback.

pub mod command;
pub mod gate;
pub mod key;
pub mod key_file;
pub mod need;
pub mod tenants;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::Arc,
    time::SystemTime,
};

use parking_lot::RwLock;

use self::{
    key_file::{Entry, KeyFile, KeyFileError},
    need::Need,
    tenants::{Owner, Quota, Tenants},
};
use crate::error::Error;

/// The keys that are in force, and the tenants that they belong to.
#[derive(Debug)]
pub struct Access {
    path: PathBuf,
    keys: RwLock<Arc<[Entry]>>,
    tenants: Tenants,
}

/// Whose request it is.
#[derive(Clone, Debug)]
pub struct Pass {
    /// Name of the tenant.
    pub tenant: String,
    /// What it owns and may take.
    pub owner: Owner,
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
        Ok(Self { path: path.to_owned(), keys: RwLock::new(file.keys.into()), tenants })
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
        Ok(count)
    }

    /// Lets a request in that brought `secret` and needs something; without a pass where it needs nothing.
    ///
    /// # Errors
    /// If there is no such key, it has expired, or its role is too low.
    pub fn admit(&self, secret: Option<&str>, need: Need) -> Result<Option<Pass>, Error> {
        let needs = match need {
            Need::Nothing => return Ok(None),
            Need::Role(role) => role,
        };
        let secret = secret.ok_or(Error::NoKey)?;
        let keys = Arc::clone(&self.keys.read());
        let entry = key::find(&keys, secret).ok_or(Error::WrongKey)?;
        if entry.expires.is_some_and(|at| at <= SystemTime::now()) {
            return Err(Error::ExpiredKey);
        }
        if entry.role < needs {
            return Err(Error::RoleTooLow { role: entry.role.name(), needs: needs.name() });
        }
        Ok(Some(Pass { tenant: entry.tenant.clone(), owner: self.tenants.owner(&entry.tenant) }))
    }

    /// Tenants with what they have taken, by name.
    pub fn taken(&self) -> BTreeMap<String, tenants::Amount> {
        self.tenants.taken()
    }
}
