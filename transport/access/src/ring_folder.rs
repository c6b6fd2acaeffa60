//! Folder of a rig's keys: authority, own certificate, list of holders.

use std::{
    io::Write as _,
    net::SocketAddr,
    path::{Path, PathBuf},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use rustls_pki_types::{CertificateDer, pem::PemObject as _};
use serde::{Deserialize, Serialize};

use crate::{
    error::AccessError,
    folder_lock::FolderLock,
    holder::{Holder, MAX_CAMERAS, MAX_HOLDERS},
    hosts::{check_hosts, host_and_port, listen_address},
    issue::{Authority, CertificatePair, TlsSide},
    key_file::KeyFile,
    role::Role,
    secret_file::{already_there, write_secret},
};

/// Default port of the gate for viewers; cameras have the next port.
pub const DEFAULT_PORT: u16 = 7450;
/// Largest number of revoked holders that stay listed.
const MAX_REVOKED: usize = 256;
/// Largest file that is read, bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Version of the format.
const VERSION: u32 = 1;
/// Validity of the certificates of authority and rig, days.
const RING_DAYS: u64 = 3650;
const LIST: &str = "ring.toml";
const AUTHORITY: [&str; 2] = ["authority.pem", "authority-key.pem"];
const OWN: [&str; 2] = ["rig.pem", "rig-key.pem"];

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    version: u32,
    rig: String,
    /// Identifier, hexadecimal, which is part of names in certificates and topics.
    id: String,
    hosts: Vec<String>,
    listen: SocketAddr,
    #[serde(default)]
    holders: Vec<Holder>,
}

/// Folder of a rig's keys.
pub struct Ring {
    folder: PathBuf,
    list: List,
    authority: Authority,
    own: CertificatePair,
}

impl std::fmt::Debug for Ring {
    /// Formats the ring without secrets.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ring").field("folder", &self.folder).field("list", &self.list).finish_non_exhaustive()
    }
}

/// Returns the SHA-256 of a certificate, hexadecimal.
pub(crate) fn fingerprint(certificate: &[u8]) -> String {
    let digest = ring::digest::digest(&ring::digest::SHA256, certificate);
    digest.as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unix_secs() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

fn read(path: &Path) -> Result<String, AccessError> {
    let of = |error: std::io::Error| {
        let fix =
            if error.kind() == std::io::ErrorKind::NotFound { "; make a ring with `flyrig keys new`" } else { "" };
        AccessError::file(path, format!("cannot be read ({error}){fix}"))
    };
    if std::fs::metadata(path).map_err(of)?.len() > MAX_BYTES {
        return Err(AccessError::file(path, "is too large for a file of a ring"));
    }
    std::fs::read_to_string(path).map_err(of)
}

/// Checks the name of a rig or holder.
fn check_name(what: &str, name: &str) -> Result<(), AccessError> {
    if (1..=64).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"_-".contains(&b)) {
        return Ok(());
    }
    Err(AccessError::Request(format!("{what} '{name}': use 1 to 64 of the characters A-Z a-z 0-9 _ -")))
}

/// Reads the list of holders alone.
pub(crate) fn read_holders(folder: &Path) -> Result<Vec<Holder>, AccessError> {
    read_list(folder).map(|list| list.holders)
}

/// Reads the text of the list; the gate does so repeatedly.
pub(crate) fn read_list_text(folder: &Path) -> Result<String, AccessError> {
    read(&folder.join(LIST))
}

/// Returns the holders in the text of a list.
pub(crate) fn parse_holders(folder: &Path, text: &str) -> Result<Vec<Holder>, AccessError> {
    parse_list(folder, text).map(|list| list.holders)
}

/// Reads the rig's certificate, PEM.
pub(crate) fn read_certificate(folder: &Path) -> Result<String, AccessError> {
    read(&folder.join(OWN[0]))
}

fn read_list(folder: &Path) -> Result<List, AccessError> {
    parse_list(folder, &read_list_text(folder)?)
}

fn parse_list(folder: &Path, text: &str) -> Result<List, AccessError> {
    let path = folder.join(LIST);
    let list: List = toml::from_str(text)
        .map_err(|error| AccessError::file(&path, format!("is no list of keys ({})", error.message())))?;
    if list.version != VERSION {
        let problem = format!("is of version {}, this program knows {VERSION}; update flyrig", list.version);
        return Err(AccessError::file(&path, problem));
    }
    Ok(list)
}

impl Ring {
    /// Creates a ring in a new folder. `hosts` are names and addresses by which other computers reach the rig.
    ///
    /// # Errors
    /// [`AccessError::Request`] for a bad name or no host, [`AccessError::File`] when the folder exists or cannot be written.
    pub fn create(folder: &Path, rig: &str, hosts: &[String], port: u16) -> Result<Self, AccessError> {
        check_name("rig", rig)?;
        let hosts = check_hosts(hosts)?;
        if port == 0 || port == u16::MAX {
            return Err(AccessError::Request(format!("--port {port}: use 1 to 65534; cameras have the port after it")));
        }
        let mut id = [0u8; 4];
        getrandom::fill(&mut id).map_err(AccessError::system)?;
        let id: String = id.iter().map(|byte| format!("{byte:02x}")).collect();
        let list = List {
            version: VERSION,
            rig: rig.to_owned(),
            id,
            listen: listen_address(&hosts, port),
            hosts,
            holders: Vec::new(),
        };
        let now = unix_secs();
        let valid = (now, now + RING_DAYS * 86_400);
        let (authority, secret) = Authority::new(&authority_name(&list), valid)?;
        let own = authority.sign(&own_name(&list), &list.hosts, TlsSide::Server, valid)?;
        let failed = |error: std::io::Error| match error.kind() {
            std::io::ErrorKind::AlreadyExists if folder.join(AUTHORITY[1]).exists() && !folder.join(LIST).exists() => {
                AccessError::file(
                    folder,
                    "holds half a ring, whose `flyrig keys new` was ended midway; delete it first",
                )
            }
            std::io::ErrorKind::AlreadyExists => {
                AccessError::file(folder, "is there already; name a new folder with --out")
            }
            _ => AccessError::file(folder, format!("cannot be made ({error})")),
        };
        std::fs::create_dir(folder).map_err(failed)?;
        let ring = Self { folder: folder.to_owned(), list, authority, own };
        let write = || {
            write_secret(&folder.join(AUTHORITY[1]), &secret)?;
            write_secret(&folder.join(AUTHORITY[0]), &ring.authority.certificate)?;
            write_secret(&folder.join(OWN[1]), &ring.own.key)?;
            write_secret(&folder.join(OWN[0]), &ring.own.certificate)?;
            ring.save()
        };
        // The folder was created just now and holds nothing else.
        write().inspect_err(|_| drop(std::fs::remove_dir_all(folder)))?;
        Ok(ring)
    }

    /// Opens a ring.
    ///
    /// # Errors
    /// [`AccessError::File`] names the file that is missing or damaged.
    pub fn open(folder: &Path) -> Result<Self, AccessError> {
        let list = read_list(folder)?;
        let pair = |names: [&str; 2]| {
            Ok::<_, AccessError>(CertificatePair {
                certificate: read(&folder.join(names[0]))?,
                key: read(&folder.join(names[1]))?,
            })
        };
        let authority = Authority::resume(&authority_name(&list), pair(AUTHORITY)?)
            .map_err(|error| AccessError::file(folder.join(AUTHORITY[1]), format!("is damaged ({error})")))?;
        Ok(Self { folder: folder.to_owned(), list, authority, own: pair(OWN)? })
    }

    /// Returns the name of the rig.
    #[must_use]
    pub fn rig(&self) -> &str {
        &self.list.rig
    }

    /// Returns the folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the names and addresses by which other computers reach the rig.
    #[must_use]
    pub fn hosts(&self) -> &[String] {
        &self.list.hosts
    }

    /// Returns all holders, revoked ones included.
    #[must_use]
    pub fn holders(&self) -> &[Holder] {
        &self.list.holders
    }

    /// Returns the address that a gate listens on: the ring's for viewers and relays, the next port for cameras.
    #[must_use]
    pub fn address(&self, role: Role) -> SocketAddr {
        let mut address = self.list.listen;
        if role == Role::Cameras {
            address.set_port(address.port().saturating_add(1));
        }
        address
    }

    /// Returns the names in topics of a viewer's sessions, as a zenoh key expression of one part.
    #[must_use]
    pub fn names_of(&self, number: usize) -> String {
        format!("{}.$*", self.topic_name(number))
    }

    fn topic_name(&self, number: usize) -> String {
        format!("{}{number}", self.topic_prefix())
    }

    /// Returns the part of the names in topics before the number.
    pub(crate) fn topic_prefix(&self) -> String {
        format!("{}-", self.list.id)
    }

    pub(crate) fn own(&self) -> &CertificatePair {
        &self.own
    }

    pub(crate) fn authority(&self) -> &Authority {
        &self.authority
    }

    /// Issues a key, valid for `days`. A key of role [`Role::Cameras`] may send every camera.
    ///
    /// # Errors
    /// [`AccessError::Request`] for a bad name, a name that is taken, or more holders than there is room for; [`AccessError::File`] when
    /// the folder cannot be changed.
    pub fn add(&mut self, name: &str, role: Role, days: u64) -> Result<KeyFile, AccessError> {
        self.change(|ring, lock| ring.issue_new(lock, name, (role, &[]), days, None))
    }

    /// Issues a key like [`Self::add`] and writes it to a new file, before it is listed. A key of role [`Role::Cameras`] may send these
    /// cameras; every camera where none is named.
    ///
    /// # Errors
    /// As [`Self::add`], and when the file exists or cannot be written; nothing is changed then.
    pub fn add_file(
        &mut self,
        file: &Path,
        name: &str,
        role: Role,
        cameras: &[String],
        days: u64,
    ) -> Result<KeyFile, AccessError> {
        check_cameras(role, cameras)?;
        self.change(|ring, lock| ring.issue_new(lock, name, (role, cameras), days, Some(file)))
    }

    /// Issues a new key to a holder, valid for `days` and for the same cameras; the old one is refused from now on.
    ///
    /// # Errors
    /// [`AccessError::Request`] when no holder of this name has a key, [`AccessError::File`] when the folder cannot be changed.
    pub fn renew(&mut self, name: &str, days: u64) -> Result<KeyFile, AccessError> {
        self.change(|ring, lock| ring.issue_again(lock, name, until(days)?, None))
    }

    /// Issues a new key like [`Self::renew`] and writes it to a new file, before the old one is refused.
    ///
    /// # Errors
    /// As [`Self::renew`], and when the file exists or cannot be written; the old key stays valid then.
    pub fn renew_file(&mut self, file: &Path, name: &str, days: u64) -> Result<KeyFile, AccessError> {
        self.change(|ring, lock| ring.issue_again(lock, name, until(days)?, Some(file)))
    }

    /// Revokes the key of a holder; an open gate disconnects it.
    ///
    /// # Errors
    /// [`AccessError::Request`] when no holder of this name has a key, [`AccessError::File`] when the folder cannot be changed.
    pub fn revoke(&mut self, name: &str) -> Result<(), AccessError> {
        self.change(|ring, _| {
            if ring.valid_holder(name).is_none() {
                return Err(ring.unknown_holder(name));
            }
            ring.mark_revoked(name);
            ring.save()
        })
    }

    /// Reads the list again, and removes the key file that a command left unlisted when it was ended midway.
    ///
    /// # Errors
    /// [`AccessError::File`] when the folder cannot be changed.
    pub fn refresh(&mut self) -> Result<(), AccessError> {
        self.change(|_, _| Ok(()))
    }

    /// Changes the list as it is in the folder, while no other command does; an error leaves it as it was.
    fn change<T>(
        &mut self,
        work: impl FnOnce(&mut Self, &FolderLock) -> Result<T, AccessError>,
    ) -> Result<T, AccessError> {
        let lock = FolderLock::take(&self.folder)?;
        let list = read_list(&self.folder)?;
        if list.id != self.list.id {
            return Err(AccessError::file(&self.folder, "was made anew meanwhile; try again"));
        }
        self.list = list;
        self.finish_change(&lock);
        let before = self.list.clone();
        let done = work(self, &lock);
        if done.is_err() {
            self.list = before;
        }
        done
    }

    /// Removes the key file of a command that was ended before the list named its key.
    fn finish_change(&self, lock: &FolderLock) {
        let Some(file) = lock.unfinished() else { return };
        let is_void = match KeyFile::read(&file, &Role::ALL) {
            Ok(key) => self.is_unlisted(&key),
            Err(_) => KeyFile::is_half(&file),
        };
        if is_void {
            let file_name = file.display();
            match std::fs::remove_file(&file) {
                Ok(()) => tracing::warn!(
                    "keys: {file_name} was removed: an earlier command was ended before its key became valid"
                ),
                Err(error) => tracing::warn!(
                    "keys: {file_name} is not valid, since an earlier command was ended midway; delete it ({error})"
                ),
            }
        }
        lock.end();
    }

    /// Returns whether a key was made by this ring and is in no list.
    fn is_unlisted(&self, key: &KeyFile) -> bool {
        let print = CertificateDer::from_pem_slice(key.certificate.as_bytes()).map(|der| fingerprint(&der));
        key.authority == self.authority.certificate
            && print.is_ok_and(|print| self.list.holders.iter().all(|of| of.fingerprint != print))
    }

    /// Issues a new key to a holder that ends at a time, in seconds since 1970.
    #[cfg(test)]
    pub(crate) fn replace_validity(&mut self, name: &str, end: u64) -> KeyFile {
        self.change(|ring, lock| ring.issue_again(lock, name, end, None)).unwrap_or_else(|error| panic!("{error}"))
    }

    fn valid_holder(&self, name: &str) -> Option<&Holder> {
        self.list.holders.iter().find(|of| of.name == name && !of.revoked)
    }

    fn unknown_holder(&self, name: &str) -> AccessError {
        let names: Vec<&str> = self.list.holders.iter().filter(|of| !of.revoked).map(|of| of.name.as_str()).collect();
        let known =
            if names.is_empty() { "there are no holders".to_owned() } else { format!("known: {}", names.join(", ")) };
        AccessError::Request(format!("'{name}' has no key; {known}"))
    }

    fn mark_revoked(&mut self, name: &str) {
        for holder in self.list.holders.iter_mut().filter(|of| of.name == name) {
            holder.revoked = true;
            holder.cameras.clear();
        }
    }

    fn issue_new(
        &mut self,
        lock: &FolderLock,
        name: &str,
        (role, cameras): (Role, &[String]),
        days: u64,
        file: Option<&Path>,
    ) -> Result<KeyFile, AccessError> {
        check_name("holder", name)?;
        if self.valid_holder(name).is_some() {
            return Err(AccessError::Request(format!(
                "'{name}' has a key already; make a new one with `flyrig keys renew {name}`, or take it away with `flyrig keys revoke {name}`"
            )));
        }
        // Numbers of revoked holders are free: those are refused by their certificates.
        let taken = |number: &usize| self.list.holders.iter().any(|of| of.number == *number && !of.revoked);
        let Some(number) = (0..MAX_HOLDERS).find(|number| !taken(number)) else {
            return Err(AccessError::Request(format!("there are {MAX_HOLDERS} keys already; revoke one")));
        };
        let rights = Rights { role, number, cameras: cameras.to_vec() };
        self.issue(lock, name, rights, until(days)?, file)
    }

    fn issue_again(
        &mut self,
        lock: &FolderLock,
        name: &str,
        end: u64,
        file: Option<&Path>,
    ) -> Result<KeyFile, AccessError> {
        let Some(Holder { role, number, cameras, .. }) = self.valid_holder(name).cloned() else {
            return Err(self.unknown_holder(name));
        };
        self.mark_revoked(name);
        self.issue(lock, name, Rights { role, number, cameras }, end, file)
    }

    /// Signs a key that ends at a time, in seconds since 1970; writes it to the file, then lists it.
    fn issue(
        &mut self,
        lock: &FolderLock,
        name: &str,
        rights: Rights,
        end: u64,
        file: Option<&Path>,
    ) -> Result<KeyFile, AccessError> {
        let pair = self.authority.sign(name, &[], TlsSide::Client, (unix_secs(), end))?;
        let der = CertificateDer::from_pem_slice(pair.certificate.as_bytes()).map_err(AccessError::system)?;
        let expires = humantime::format_rfc3339_seconds(UNIX_EPOCH + Duration::from_secs(end)).to_string();
        let (fingerprint, Rights { role, number, cameras }) = (fingerprint(&der), rights);
        let holder = Holder { name: name.to_owned(), role, number, cameras, expires, fingerprint, revoked: false };
        let port = self.address(role).port();
        let connect = self.list.hosts.iter().map(|host| host_and_port(host, port)).collect();
        let topic_name = self.topic_name(number);
        let authority = self.authority.certificate.clone();
        let key = KeyFile::new(&self.list.rig, &holder, topic_name, connect, own_name(&self.list), authority, pair);
        self.list.holders.push(holder);
        self.forget_oldest();
        let Some(file) = file else { return self.save().map(|()| key) };
        // Also before the note: a file that is there already is no half of this key.
        if file.exists() {
            return Err(already_there(file));
        }
        lock.begin(file).inspect_err(|_| lock.end())?;
        let written = key.write_new(file).and_then(|()| self.save().inspect_err(|_| drop(std::fs::remove_file(file))));
        lock.end();
        written.map(|()| key)
    }

    /// Forgets the holders revoked longest ago: holders that are not listed are refused as well.
    fn forget_oldest(&mut self) {
        let mut over = self.list.holders.iter().filter(|of| of.revoked).count().saturating_sub(MAX_REVOKED);
        self.list.holders.retain(|of| {
            let is_forgotten = of.revoked && over > 0;
            over -= usize::from(is_forgotten);
            !is_forgotten
        });
    }

    fn save(&self) -> Result<(), AccessError> {
        let path = self.folder.join(LIST);
        let body = toml::to_string(&self.list).map_err(AccessError::system)?;
        let text = format!(
            "# Keys of the rig '{}'. `flyrig keys` writes this file. `listen` may be changed: keys that were given away name its port.\n{body}",
            self.list.rig
        );
        if text.len() as u64 > MAX_BYTES {
            return Err(AccessError::file(&path, "would become too large; revoke keys, or give them fewer cameras"));
        }
        // A revocation outlasts a power failure.
        let write = |out: &mut std::io::BufWriter<std::fs::File>| {
            out.write_all(text.as_bytes())?;
            out.flush()?;
            out.get_ref().sync_all()
        };
        flyrig_types::write_whole(&path, write)
            .map_err(|error| AccessError::file(&path, format!("cannot be written ({error})")))
    }
}

/// Returns the name in the certificate of the authority.
fn authority_name(list: &List) -> String {
    format!("flyrig authority of {} {}", list.rig, list.id)
}

/// Returns the name in the rig's certificate. It is no host name, so no public authority signs it.
fn own_name(list: &List) -> String {
    format!("flyrig rig {} {}", list.rig, list.id)
}

/// Rights of a new key.
struct Rights {
    role: Role,
    number: usize,
    cameras: Vec<String>,
}

/// Returns the end of a key that is valid for `days` from now on, seconds since 1970.
fn until(days: u64) -> Result<u64, AccessError> {
    let is_good = (1..=36_500).contains(&days);
    days.checked_mul(86_400)
        .and_then(|secs| unix_secs().checked_add(secs))
        .filter(|_| is_good)
        .ok_or_else(|| AccessError::Request(format!("--days {days}: use 1 to 36500")))
}

/// Checks the cameras of a new key.
fn check_cameras(role: Role, cameras: &[String]) -> Result<(), AccessError> {
    if !cameras.is_empty() && role != Role::Cameras {
        let text = format!("--camera: a key of role {} sends no cameras; add --role cameras", role.name());
        return Err(AccessError::Request(text));
    }
    if cameras.len() > MAX_CAMERAS {
        let text = format!("--camera: {} are too many; give at most {MAX_CAMERAS}", cameras.len());
        return Err(AccessError::Request(text));
    }
    let is_good = |name: &String| {
        (1..=64).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"_.-".contains(&b))
    };
    match cameras.iter().find(|name| !is_good(name)) {
        None => Ok(()),
        Some(name) => {
            let shown: String = name.chars().take(100).flat_map(char::escape_debug).collect();
            Err(AccessError::Request(format!("--camera '{shown}': use 1 to 64 of the characters A-Z a-z 0-9 _ . -")))
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "ring_folder_tests.rs"]
mod tests;
