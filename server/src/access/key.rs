//! Keys: 256 random bits that a client shows, of which the server knows the digest only.
//!
//! So much randomness cannot be guessed or looked up in tables, so a plain SHA-256 keeps it as safe as a slow,
//! salted digest would, at no cost per request.

use std::{fmt, str::FromStr};

use base64::{Engine as _, prelude::BASE64_URL_SAFE_NO_PAD};
use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

use super::key_file::Entry;

/// Every key begins with it, so that people and scanners know one when they see it.
const PREFIX: &str = "gatsbi_";

/// What a key is good for; a higher one includes those below it.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum Role {
    /// Looking: models, sessions, snapshots.
    Read,
    /// Working: sessions of its own, observing, imagining, planning.
    Predict,
    /// Administration: models loaded, swapped and unloaded, metrics.
    Admin,
}

impl Role {
    /// All roles, from the lowest.
    pub const ALL: [Self; 3] = [Self::Read, Self::Predict, Self::Admin];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Predict => "predict",
            Self::Admin => "admin",
        }
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let role = Self::ALL.into_iter().find(|role| role.name() == text);
        role.ok_or_else(|| "expected read, predict or admin".to_owned())
    }
}

/// Digest of a key.
#[derive(Clone, Copy, Eq, PartialEq)]
pub struct KeyDigest([u8; 32]);

impl KeyDigest {
    /// The digest of a key.
    pub fn of(secret: &str) -> Self {
        Self(Sha256::digest(secret).into())
    }
}

impl fmt::Debug for KeyDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("KeyDigest(..)")
    }
}

impl fmt::Display for KeyDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl FromStr for KeyDigest {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || "expected the 64 hexadecimal digits of a SHA-256".to_owned();
        let mut digest = [0; 32];
        let digits = text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        for (at, byte) in digest.iter_mut().enumerate().take(if digits { 32 } else { 0 }) {
            let pair = &text[2 * at..2 * at + 2];
            *byte = u8::from_str_radix(pair, 16).map_err(|_not_hexadecimal| wrong())?;
        }
        if digits { Ok(Self(digest)) } else { Err(wrong()) }
    }
}

/// A new key, to be shown once.
pub fn new_secret() -> String {
    format!("{PREFIX}{}", BASE64_URL_SAFE_NO_PAD.encode(rand::random::<[u8; 32]>()))
}

/// The entry of the key with a digest. Every entry is compared, each in a time that does not depend on where it differs.
pub(super) fn find<'a>(entries: &'a [Entry], digest: &KeyDigest) -> Option<&'a Entry> {
    let mut found = None;
    for entry in entries {
        if bool::from(entry.digest.0.ct_eq(&digest.0)) {
            found = Some(entry);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roles_include_those_below() {
        assert!(Role::Read < Role::Predict && Role::Predict < Role::Admin);
        for role in Role::ALL {
            assert_eq!(role.name().parse(), Ok(role));
        }
        assert!("root".parse::<Role>().is_err());
    }

    #[test]
    fn a_key_is_found_by_its_digest_which_does_not_show_in_debugging() {
        let (secret, other) = (new_secret(), new_secret());
        assert_ne!(secret, other);
        assert_eq!(secret.len(), PREFIX.len() + 43);
        let digest = KeyDigest::of(&secret);
        assert_eq!(digest.to_string().parse(), Ok(digest));
        for wrong in ["", "00", &"g".repeat(64), &"é".repeat(32)] {
            assert!(wrong.parse::<KeyDigest>().is_err(), "{wrong}");
        }
        let entry = |secret: &str| Entry {
            tenant: "lab".to_owned(),
            role: Role::Read,
            digest: KeyDigest::of(secret),
            name: None,
            expires: None,
        };
        let entries = [entry(&other), entry(&secret)];
        assert_eq!(find(&entries, &KeyDigest::of(&secret)).unwrap().digest, digest);
        assert!(find(&entries, &KeyDigest::of(&new_secret())).is_none());
        let shown = format!("{:?}", entries[1]);
        assert!(!shown.contains(&digest.to_string()[..8]), "{shown}");
    }
}
