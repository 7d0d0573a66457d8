//! The file of keys: whose they are, what they are good for, and what tenants may take.
//!
//! It holds no secrets, only their digests, but whoever can write it can let anybody in; so it must belong to its
//! reader alone.

use std::{
    collections::{BTreeMap, BTreeSet},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    time::SystemTime,
};

use serde::Deserialize;

use super::{
    key::{KeyDigest, Role},
    tenants::{self, Quota, QuotaOverride},
};

/// A key in the file.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Whose it is.
    pub tenant: String,
    /// What it is good for.
    pub role: Role,
    /// Its digest.
    pub digest: KeyDigest,
    /// A name for people.
    pub name: Option<String>,
    /// When it ends.
    pub expires: Option<SystemTime>,
}

/// What a file of keys says.
#[derive(Debug)]
pub struct KeyFile {
    /// The keys.
    pub keys: Vec<Entry>,
    /// What tenants may take, where it is not the default.
    pub quotas: BTreeMap<String, QuotaOverride>,
}

/// A file of keys cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KeyFileError {
    /// It cannot be read.
    #[error("the file of keys {} cannot be read", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// Others than its owner may read or write it.
    #[error(
        "the file of keys {shown} has permissions {mode:04o}, expected 0600: chmod 600 {shown}",
        shown = path.display()
    )]
    Permissions {
        /// The file.
        path: PathBuf,
        /// Its permissions.
        mode: u32,
    },
    /// What is in it is wrong.
    #[error("the file of keys {} cannot be used: {}", path.display(), problems.join("; "))]
    Wrong {
        /// The file.
        path: PathBuf,
        /// All that is wrong.
        problems: Vec<String>,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    #[serde(default)]
    keys: Vec<WrittenKey>,
    #[serde(default)]
    tenants: BTreeMap<String, QuotaOverride>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenKey {
    tenant: String,
    role: String,
    sha256: String,
    name: Option<String>,
    expires: Option<toml::value::Datetime>,
}

impl KeyFile {
    /// Reads the file.
    ///
    /// # Errors
    /// [`KeyFileError`].
    pub fn read(path: &Path) -> Result<Self, KeyFileError> {
        let unreadable = |source| KeyFileError::Unreadable { path: path.to_owned(), source };
        let mode = std::fs::metadata(path).map_err(unreadable)?.permissions().mode() & 0o7777;
        if mode & 0o077 != 0 {
            return Err(KeyFileError::Permissions { path: path.to_owned(), mode });
        }
        let text = std::fs::read_to_string(path).map_err(unreadable)?;
        let wrong = |problems| KeyFileError::Wrong { path: path.to_owned(), problems };
        // The parser's own rendering shows the line at fault, which may hold a key put there by mistake.
        let written: Written = toml::from_str(&text).map_err(|error| {
            let line = error.span().map_or(0, |span| text[..span.start].lines().count().max(1));
            wrong(vec![format!("line {line}: {}", error.message())])
        })?;
        Self::checked(written).map_err(wrong)
    }

    /// The tenants that have keys.
    pub fn tenants(&self) -> BTreeSet<String> {
        self.keys.iter().map(|key| key.tenant.clone()).collect()
    }

    fn checked(written: Written) -> Result<Self, Vec<String>> {
        let mut problems = Vec::new();
        let mut keys: Vec<Entry> = Vec::new();
        if written.keys.is_empty() {
            problems.push("it has no keys; `gatsbi-server keys new` makes one".to_owned());
        }
        for (at, key) in written.keys.into_iter().enumerate() {
            let mut problem = |field: &str, found: &str, expected: &str| {
                problems.push(format!("keys[{at}].{field} is {found:.40?}, {expected}"));
            };
            if !tenants::is_name(&key.tenant) {
                problem("tenant", &key.tenant, tenants::NAMES);
            }
            let role = key.role.parse().map_err(|expected: String| {
                problem("role", &key.role, &expected);
            });
            let digest = key.sha256.parse().map_err(|expected: String| {
                // Whoever pasted the key itself should not find it in a log.
                problem("sha256", "something else", &expected);
            });
            let expires = key.expires.map(|at| at.to_string());
            let expires = expires.as_deref().map(time).transpose().map_err(|expected| {
                problem("expires", expires.as_deref().unwrap_or(""), &expected);
            });
            let (Ok(role), Ok(digest), Ok(expires)) = (role, digest, expires) else { continue };
            if keys.iter().any(|other| other.digest == digest) {
                problem("sha256", "that of another key", "expected each key once");
            }
            keys.push(Entry { tenant: key.tenant, role, digest, name: key.name, expires });
        }
        for (tenant, quota) in &written.tenants {
            if !keys.iter().any(|key| key.tenant == *tenant) {
                problems.push(format!("tenants.{tenant:.64} has no key"));
            }
            problems.extend(quota.problem().map(|what| format!("tenants.{tenant:.64}.{what}")));
        }
        if problems.is_empty() {
            return Ok(Self { keys, quotas: written.tenants });
        }
        Err(problems)
    }
}

/// A moment as RFC 3339 has it.
pub fn time(text: &str) -> Result<SystemTime, String> {
    let expected = || "expected a time such as 2027-01-31T00:00:00Z".to_owned();
    let time: prost_types::Timestamp = text.parse().map_err(|_not_a_time| expected())?;
    time.try_into().map_err(|_out_of_range| expected())
}

/// An entry as it is written, ready to be put into the file.
pub fn written(entry: &Entry) -> String {
    let mut text =
        format!("[[keys]]\ntenant = {:?}\nrole = {:?}\n", entry.tenant, entry.role.name());
    if let Some(name) = &entry.name {
        text += &format!("name = {}\n", toml::Value::from(name.as_str()));
    }
    text += &format!("sha256 = \"{}\"\n", entry.digest);
    if let Some(expires) = entry.expires {
        text += &format!("expires = {}\n", prost_types::Timestamp::from(expires));
    }
    text
}

/// The default for tenants that the file says nothing about, with what it does say.
pub fn quota(default: Quota, quotas: &BTreeMap<String, QuotaOverride>, tenant: &str) -> Quota {
    quotas.get(tenant).map_or(default, |quota| quota.over(default))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::access::key::new_secret;

    fn read(text: &str) -> Result<KeyFile, KeyFileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("keys.toml");
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        KeyFile::read(&path)
    }

    #[test]
    fn what_is_written_is_read() {
        let second = SystemTime::UNIX_EPOCH + Duration::from_secs(1_900_000_000);
        let entry = Entry {
            tenant: "lab".to_owned(),
            role: Role::Predict,
            digest: KeyDigest::of(&new_secret()),
            name: Some("the \"red\" arm".to_owned()),
            expires: Some(second),
        };
        let text = format!("{}\n[tenants.lab]\nsessions = 3\n", written(&entry));
        let file = read(&text).unwrap();
        let found = &file.keys[0];
        assert_eq!((&found.name, found.expires), (&entry.name, entry.expires));
        assert_eq!((found.digest, found.role), (entry.digest, entry.role));
        let default = Quota { sessions: 9, rows: 8, kept_bytes: 7 };
        assert_eq!(quota(default, &file.quotas, "lab"), Quota { sessions: 3, ..default });
        assert_eq!(quota(default, &file.quotas, "other"), default);
    }

    #[test]
    fn all_that_is_wrong_is_told_and_no_secret() {
        let secret = new_secret();
        let text = format!(
            "[[keys]]\ntenant = \"a b\"\nrole = \"root\"\nsha256 = \"{secret}\"\n\
             [tenants.nobody]\nsessions = 0\n"
        );
        let told = read(&text).unwrap_err().to_string();
        for part in [
            "keys[0].tenant is \"a b\"",
            "keys[0].role is \"root\", expected read, predict or admin",
            "keys[0].sha256 is \"something else\"",
            "tenants.nobody has no key",
            "tenants.nobody.sessions is 0, expected at least 1",
        ] {
            assert!(told.contains(part), "{told}");
        }
        assert!(!told.contains(&secret), "{told}");
        let unknown = format!("[[keys]]\nsecret = \"{secret}\"\n");
        let told = read(&unknown).unwrap_err().to_string();
        assert!(told.contains("line 1") && told.contains("unknown field"), "{told}");
        assert!(!told.contains(&secret), "{told}");
    }

    #[test]
    fn others_may_not_read_it() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::set_permissions(file.path(), std::fs::Permissions::from_mode(0o640)).unwrap();
        let told = KeyFile::read(file.path()).unwrap_err().to_string();
        assert!(told.contains("has permissions 0640, expected 0600"), "{told}");
        let told = KeyFile::read(Path::new("/nowhere")).unwrap_err().to_string();
        assert!(told.contains("/nowhere cannot be read"), "{told}");
    }
}
