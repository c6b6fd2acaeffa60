//! Key file of a holder.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{
    error::AccessError,
    holder::{Holder, covers},
    issue::CertificatePair,
    role::Role,
    secret_file::write_secret,
    tls,
};

/// Largest key file that is read, bytes.
const MAX_KEY_FILE_BYTES: u64 = 64 << 10;
/// Beginning of every key file.
const BEGINNING: &str = "# Key of '";
/// Version of the format.
const VERSION: u32 = 1;

/// Key of one holder: name and role, addresses of the rig, certificate and private key.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyFile {
    /// Version of the format.
    pub version: u32,
    /// Name of the rig.
    pub rig: String,
    /// Name of the holder.
    pub holder: String,
    /// Role of the holder.
    pub role: Role,
    /// Cameras that a holder of role [`Role::Cameras`] may send; every camera where none is named, as in older keys.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<String>,
    /// Name in topics: the ring's identifier and the holder's number.
    pub topic_name: String,
    /// Addresses of the rig, `HOST:PORT`.
    pub connect: Vec<String>,
    /// Time after which the key is refused, RFC 3339.
    pub expires: String,
    /// Name in the rig's certificate, which is unique to the rig.
    pub rig_certificate_name: String,
    /// Authority that signed the rig's certificate, PEM.
    pub authority: String,
    /// Certificate of the holder, PEM.
    pub certificate: String,
    /// Private key of the holder, PEM.
    pub private_key: String,
}

impl std::fmt::Debug for KeyFile {
    /// Formats the key without its secret.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("KeyFile")
            .field("rig", &self.rig)
            .field("holder", &self.holder)
            .field("role", &self.role)
            .field("expires", &self.expires)
            .finish_non_exhaustive()
    }
}

impl KeyFile {
    pub(crate) fn new(
        rig: &str,
        holder: &Holder,
        topic_name: String,
        connect: Vec<String>,
        rig_certificate_name: String,
        authority: String,
        pair: CertificatePair,
    ) -> Self {
        Self {
            version: VERSION,
            rig: rig.to_owned(),
            holder: holder.name.clone(),
            role: holder.role,
            cameras: holder.cameras.clone(),
            topic_name,
            connect,
            expires: holder.expires.clone(),
            rig_certificate_name,
            authority,
            certificate: pair.certificate,
            private_key: pair.key,
        }
    }

    /// Reads a key file whose holder has one of these roles.
    ///
    /// # Errors
    /// [`AccessError::File`] when the file cannot be read or is no key, or the key is of a newer flyrig or of another role.
    pub fn read(path: &Path, roles: &[Role]) -> Result<Self, AccessError> {
        let key = Self::read_any(path)?;
        if roles.contains(&key.role) {
            return Ok(key);
        }
        let wanted: Vec<&str> = roles.iter().map(|role| role.name()).collect();
        let problem =
            format!("is a key of role {}; this command takes one of role {}", key.role.name(), wanted.join(" or "));
        Err(AccessError::file(path, problem))
    }

    fn read_any(path: &Path) -> Result<Self, AccessError> {
        let bad = |problem: String| AccessError::file(path, problem);
        let of = |error: std::io::Error| bad(format!("cannot be read ({error})"));
        if std::fs::metadata(path).map_err(of)?.len() > MAX_KEY_FILE_BYTES {
            return Err(bad("is too large for a key; give a file of `flyrig keys add`".to_owned()));
        }
        let text = std::fs::read(path).map_err(of)?;
        let none = "is no key; give a file of `flyrig keys add`";
        let text = String::from_utf8(text).map_err(|_| bad(none.to_owned()))?;
        let table: toml::Table = text.parse().map_err(|_| bad(none.to_owned()))?;
        if !table.contains_key("private_key") {
            return Err(bad(none.to_owned()));
        }
        match table.get("version").and_then(toml::Value::as_integer) {
            Some(version) if version == i64::from(VERSION) => {}
            Some(version) => {
                return Err(bad(format!("is a key of version {version}, this program knows {VERSION}; update flyrig")));
            }
            None => return Err(bad(none.to_owned())),
        }
        let key: Self = toml::from_str(&text).map_err(|error| bad(format!("is damaged ({})", error.message())))?;
        key.check().map_err(|problem| bad(format!("is damaged ({problem}); ask for it again")))?;
        Ok(key)
    }

    /// Returns whether a file holds the beginning of a key, or nothing yet, as [`Self::write_new`] leaves it when its process is ended.
    pub(crate) fn is_half(path: &Path) -> bool {
        let is_beginning =
            |text: Vec<u8>| text.starts_with(BEGINNING.as_bytes()) || BEGINNING.as_bytes().starts_with(&text);
        std::fs::read(path).is_ok_and(is_beginning) && Self::read_any(path).is_err()
    }

    /// Checks the fields that other modules rely on.
    fn check(&self) -> Result<(), String> {
        let is_name = |text: &str| {
            !text.is_empty()
                && text.len() <= 64
                && text.bytes().all(|b| b.is_ascii_alphanumeric() || b"_-".contains(&b))
        };
        if !is_name(&self.rig) || !is_name(&self.topic_name) || self.connect.is_empty() || self.connect.len() > 64 {
            return Err("rig, topic_name or connect".to_owned());
        }
        if self.rig_certificate_name.is_empty() {
            return Err("rig_certificate_name".to_owned());
        }
        tls::client(&self.authority, &self.certificate, &self.private_key).map(|_| ())
    }

    /// Returns whether the rig takes this camera from the holder.
    #[must_use]
    pub fn may_send(&self, camera: &str) -> bool {
        self.role == Role::Cameras && covers(&self.cameras, camera)
    }

    /// Writes a file that only its owner may read.
    ///
    /// # Errors
    /// [`AccessError::File`], also when the file exists already.
    pub fn write_new(&self, path: &Path) -> Result<(), AccessError> {
        let body = toml::to_string(self).map_err(AccessError::system)?;
        let text = format!(
            "{BEGINNING}{}' ({}) to the rig '{}', valid until {}.\n# Keep it secret: its holder connects as '{}'.\n{body}",
            self.holder,
            self.role.name(),
            self.rig,
            self.expires,
            self.holder
        );
        write_secret(path, &text)
    }
}
