//! `gatsbi-server keys new`: a new key, shown once, and what the file of keys says of it.

use std::{
    io::Write as _,
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    time::SystemTime,
};

use clap::{Args, Subcommand};

use super::{
    key::{KeyDigest, Role, new_secret},
    key_file::{Entry, KeyFile, KeyFileError, time, written},
    tenants,
};

/// What else the program does beside serving.
#[derive(Debug, Subcommand)]
pub enum Task {
    /// Keys of clients
    #[command(subcommand)]
    Keys(KeysTask),
}

/// What can be done with keys.
#[derive(Debug, Subcommand)]
pub enum KeysTask {
    /// Make a key, show it once, and say what belongs into the file of keys
    New(NewKey),
}

/// A key that is to be made.
#[derive(Debug, Args)]
pub struct NewKey {
    /// Whose it is; sessions are seen by their own tenant only
    #[arg(long, value_parser = tenant)]
    tenant: String,
    /// What it is good for: read, predict or admin
    #[arg(long)]
    role: Role,
    /// A name for people
    #[arg(long)]
    name: Option<String>,
    /// When it ends, such as 2027-01-31T00:00:00Z; never if absent
    #[arg(long, value_parser = time)]
    expires: Option<SystemTime>,
    /// Adds it to this file, which is made if it does not exist, and prints the key alone
    #[arg(long, value_name = "PATH")]
    file: Option<PathBuf>,
}

/// A key cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file that it should go into cannot be used as it is.
    #[error(transparent)]
    File(#[from] KeyFileError),
    /// It cannot be written.
    #[error("{} cannot be written", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
}

impl NewKey {
    /// Makes the key; returns what is to be shown.
    ///
    /// # Errors
    /// If it should go into a file and cannot.
    pub fn make(self) -> Result<String, KeyError> {
        let secret = new_secret();
        let Self { tenant, role, name, expires, file } = self;
        let entry = written(&Entry { tenant, role, digest: KeyDigest::of(&secret), name, expires });
        let Some(path) = file else {
            return Ok(format!(
                "# The key, which is shown this once: {secret}\n\
                 # What belongs into the file of keys (--keys), which has its digest only:\n{entry}"
            ));
        };
        if path.exists() {
            KeyFile::read(&path)?;
        }
        append(&path, &entry)
            .map_err(|source| KeyError::Unwritable { path: path.clone(), source })?;
        Ok(format!("{secret}\n"))
    }
}

fn append(path: &Path, entry: &str) -> std::io::Result<()> {
    let mut file = std::fs::OpenOptions::new().create(true).append(true).mode(0o600).open(path)?;
    // In one piece, behind a blank line, so that tables before it end.
    file.write_all(format!("\n{entry}").as_bytes())
}

fn tenant(name: &str) -> Result<String, String> {
    if tenants::is_name(name) { Ok(name.to_owned()) } else { Err(tenants::NAMES.to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_goes_into_a_file_and_opens_what_it_should() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("keys.toml");
        let new = |role| NewKey {
            tenant: "lab".to_owned(),
            role,
            name: Some("arm".to_owned()),
            expires: None,
            file: Some(path.clone()),
        };
        let first = new(Role::Read).make().unwrap();
        let second = new(Role::Admin).make().unwrap();
        let file = KeyFile::read(&path).unwrap();
        let digests: Vec<KeyDigest> = file.keys.iter().map(|key| key.digest).collect();
        assert_eq!(digests, [first.trim(), second.trim()].map(KeyDigest::of));
        let shown = NewKey { file: None, ..new(Role::Read) }.make().unwrap();
        assert!(shown.contains("gatsbi_") && shown.contains("tenant = \"lab\""), "{shown}");
        std::fs::write(&path, "[[keys]]").unwrap();
        assert!(matches!(new(Role::Read).make(), Err(KeyError::File(_))));
    }
}
