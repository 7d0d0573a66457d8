//! Tenants: what belongs to whom, and how much of it there may be.
//!
//! Whatever a tenant takes is a [`Share`] that gives itself back when it is dropped, so nothing has to be counted
//! down by hand. Limits can change while shares are held.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use parking_lot::{Mutex, RwLock};
use serde::Deserialize;
use tokio::sync::Notify;

use super::key_file;
use crate::error::Error;

/// What a tenant may be called.
pub const NAMES: &str = "expected 1 to 64 of a-z, A-Z, 0-9, . _ -";

/// How much a tenant may take.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Quota {
    /// Open sessions.
    pub sessions: u64,
    /// Rows of rollouts that are under way.
    pub rows: u64,
    /// Bytes of earlier steps, frames, goals and handles.
    pub kept_bytes: u64,
}

/// How much a tenant may take, where it differs from the default.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QuotaOverride {
    sessions: Option<u64>,
    rows: Option<u64>,
    kept_mib: Option<u64>,
}

/// What is taken.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Amount {
    /// Sessions.
    pub sessions: u64,
    /// Rows of rollouts.
    pub rows: u64,
    /// Bytes.
    pub kept_bytes: u64,
}

/// To whom something belongs. Nobody's things are seen by nobody but the operator; the default is the operator's view,
/// which is also everybody's where there are no keys: it sees all and may take all.
#[derive(Clone, Debug, Default)]
pub struct Owner(Option<Arc<Account>>);

/// What a tenant has taken.
#[derive(Debug)]
struct Account {
    name: String,
    quota: RwLock<Quota>,
    taken: Mutex<Amount>,
    returned: Notify,
}

/// Something taken, until it is dropped.
#[derive(Debug, Default)]
pub struct Share {
    account: Option<Arc<Account>>,
    amount: Amount,
}

/// All tenants that there have been since the start.
#[derive(Debug, Default)]
pub(super) struct Tenants(RwLock<BTreeMap<String, Arc<Account>>>);

/// Whether a tenant may be called so.
pub fn is_name(name: &str) -> bool {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
    (1..=64).contains(&name.len()) && name.bytes().all(allowed)
}

impl QuotaOverride {
    /// What is wrong with it.
    pub(super) fn problem(&self) -> Option<String> {
        let Self { sessions, rows, kept_mib } = *self;
        let given = [("sessions", sessions), ("rows", rows), ("kept_mib", kept_mib)];
        let (name, _) = given.into_iter().find(|(_, number)| *number == Some(0))?;
        Some(format!("{name} is 0, expected at least 1"))
    }

    pub(super) fn over(self, default: Quota) -> Quota {
        Quota {
            sessions: self.sessions.unwrap_or(default.sessions),
            rows: self.rows.unwrap_or(default.rows),
            kept_bytes: self.kept_mib.map_or(default.kept_bytes, |mib| mib << 20),
        }
    }
}

impl Amount {
    /// A session that keeps so much.
    pub fn session(kept_bytes: u64) -> Self {
        Self { sessions: 1, rows: 0, kept_bytes }
    }

    /// Rows of a rollout.
    pub fn rows(rows: u32) -> Self {
        Self { rows: rows.into(), ..Self::default() }
    }

    /// Something kept.
    pub fn kept(kept_bytes: u64) -> Self {
        Self { kept_bytes, ..Self::default() }
    }

    fn within(self, quota: Quota) -> Result<(), Error> {
        let over = |what, limit| Err(Error::QuotaExceeded { what, limit });
        match () {
            () if self.sessions > quota.sessions => over("open sessions", quota.sessions),
            () if self.rows > quota.rows => over("rows of rollouts under way", quota.rows),
            () if self.kept_bytes > quota.kept_bytes => over("bytes kept", quota.kept_bytes),
            () => Ok(()),
        }
    }

    fn plus(self, other: Self) -> Self {
        Self {
            sessions: self.sessions + other.sessions,
            rows: self.rows + other.rows,
            kept_bytes: self.kept_bytes.saturating_add(other.kept_bytes),
        }
    }
}

impl Owner {
    /// Whether something of another owner can be seen.
    pub fn sees(&self, other: &Self) -> bool {
        match (&self.0, &other.0) {
            (None, _) => true,
            (Some(own), Some(other)) => Arc::ptr_eq(own, other),
            (Some(_), None) => false,
        }
    }

    /// Takes so much now.
    ///
    /// # Errors
    /// If it would be more than the quota.
    pub fn take(&self, amount: Amount) -> Result<Share, Error> {
        let Some(account) = &self.0 else { return Ok(Share::default()) };
        let mut taken = account.taken.lock();
        let then = taken.plus(amount);
        // What is not asked for may be over a quota that was lowered.
        let asked = Amount {
            sessions: if amount.sessions == 0 { 0 } else { then.sessions },
            rows: if amount.rows == 0 { 0 } else { then.rows },
            kept_bytes: if amount.kept_bytes == 0 { 0 } else { then.kept_bytes },
        };
        asked.within(*account.quota.read())?;
        *taken = then;
        drop(taken);
        Ok(Share { account: Some(Arc::clone(account)), amount })
    }

    /// Takes so much as soon as enough was given back.
    ///
    /// # Errors
    /// If it is more than the quota by itself.
    pub async fn take_when_free(&self, amount: Amount) -> Result<Share, Error> {
        loop {
            let Some(account) = &self.0 else { return Ok(Share::default()) };
            let returned = account.returned.notified();
            amount.within(*account.quota.read())?;
            if let Ok(share) = self.take(amount) {
                return Ok(share);
            }
            returned.await;
        }
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let Some(account) = &self.account else { return };
        let mut taken = account.taken.lock();
        taken.sessions -= self.amount.sessions;
        taken.rows -= self.amount.rows;
        taken.kept_bytes -= self.amount.kept_bytes;
        drop(taken);
        account.returned.notify_waiters();
    }
}

impl Tenants {
    /// Sets the quotas of tenants; those that have no key any more keep what they have.
    pub(super) fn set(
        &self,
        names: &BTreeSet<String>,
        quotas: &BTreeMap<String, QuotaOverride>,
        default: Quota,
    ) {
        let mut accounts = self.0.write();
        for name in names {
            let quota = key_file::quota(default, quotas, name);
            if let Some(account) = accounts.get(name) {
                *account.quota.write() = quota;
            } else {
                let account = Account {
                    name: name.clone(),
                    quota: RwLock::new(quota),
                    taken: Mutex::default(),
                    returned: Notify::new(),
                };
                accounts.insert(name.clone(), Arc::new(account));
            }
        }
        for account in accounts.values() {
            account.returned.notify_waiters();
        }
    }

    /// A tenant that has a key.
    pub(super) fn owner(&self, name: &str) -> Owner {
        let account = self.0.read().get(name).cloned();
        Owner(Some(account.expect("keys and their tenants are read together")))
    }

    pub(super) fn taken(&self) -> BTreeMap<String, Amount> {
        let accounts = self.0.read();
        accounts.values().map(|account| (account.name.clone(), *account.taken.lock())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUOTA: Quota = Quota { sessions: 2, rows: 10, kept_bytes: 100 };

    fn tenants(names: &[&str], quota: Quota) -> Tenants {
        let tenants = Tenants::default();
        let names = names.iter().map(|name| (*name).to_owned()).collect();
        tenants.set(&names, &BTreeMap::new(), quota);
        tenants
    }

    #[test]
    fn a_tenant_sees_its_own_and_the_operator_all() {
        let tenants = tenants(&["a", "b"], QUOTA);
        let (a, b, operator) = (tenants.owner("a"), tenants.owner("b"), Owner::default());
        assert!(a.sees(&tenants.owner("a")) && !a.sees(&b) && !a.sees(&operator));
        assert!(operator.sees(&a) && operator.sees(&operator));
    }

    #[test]
    fn what_is_taken_comes_back_and_limits_may_change() {
        let tenants = tenants(&["a"], QUOTA);
        let owner = tenants.owner("a");
        let first = owner.take(Amount::session(60)).unwrap();
        let refused = owner.take(Amount::session(60)).unwrap_err();
        assert_eq!(refused, Error::QuotaExceeded { what: "bytes kept", limit: 100 });
        let second = owner.take(Amount::session(0)).unwrap();
        let refused = owner.take(Amount::session(0)).unwrap_err();
        assert_eq!(refused, Error::QuotaExceeded { what: "open sessions", limit: 2 });
        let names = ["a".to_owned()].into();
        tenants.set(&names, &BTreeMap::new(), Quota { sessions: 1, ..QUOTA });
        drop(first);
        assert!(owner.take(Amount::session(0)).is_err(), "one is open, and one may be");
        assert!(owner.take(Amount::rows(10)).is_ok(), "sessions have nothing to do with rows");
        drop(second);
        assert_eq!(tenants.taken()["a"], Amount::default());
        owner.take(Amount::session(100)).unwrap();
    }

    #[tokio::test]
    async fn bulk_work_waits_for_rows_unless_there_can_never_be_enough() {
        let owner = tenants(&["a"], QUOTA).owner("a");
        assert!(owner.take_when_free(Amount::rows(11)).await.is_err());
        let share = owner.take(Amount::rows(6)).unwrap();
        let waiting = owner.take_when_free(Amount::rows(5));
        let giving = async {
            tokio::task::yield_now().await;
            drop(share);
        };
        let (taken, ()) = tokio::join!(waiting, giving);
        taken.unwrap();
    }

    #[test]
    fn names_of_tenants_fit_into_headers() {
        assert!(is_name("lab-1.arm_2") && is_name(&"x".repeat(64)));
        for wrong in ["", "a b", "ä", "a\n", &"x".repeat(65)] {
            assert!(!is_name(wrong), "{wrong:?}");
        }
    }
}
