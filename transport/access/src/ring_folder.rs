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
    holder::{Holder, MAX_HOLDERS},
    issue::{Authority, CertificatePair, TlsSide},
    key_file::KeyFile,
    role::Role,
    secret_file::write_secret,
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
        AccessError::file(path, format!("cannot be read ({error}); make a ring with `flyrig keys new`"))
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

/// Reads the list of holders alone; the gate does so repeatedly.
pub(crate) fn read_holders(folder: &Path) -> Result<Vec<Holder>, AccessError> {
    read_list(folder).map(|list| list.holders)
}

fn read_list(folder: &Path) -> Result<List, AccessError> {
    let path = folder.join(LIST);
    let list: List = toml::from_str(&read(&path)?)
        .map_err(|error| AccessError::file(&path, format!("is no list of keys ({})", error.message())))?;
    if list.version != VERSION {
        let problem = format!("is of version {}, this program knows {VERSION}; update flyrig", list.version);
        return Err(AccessError::file(&path, problem));
    }
    Ok(list)
}

/// Returns the modification time of the list, which reveals a change.
pub(crate) fn list_time(folder: &Path) -> Option<SystemTime> {
    std::fs::metadata(folder.join(LIST)).and_then(|of| of.modified()).ok()
}

impl Ring {
    /// Creates a ring in a new folder. `hosts` are names and addresses by which other computers reach the rig.
    ///
    /// # Errors
    /// [`AccessError::Request`] for a bad name or no host, [`AccessError::File`] when the folder exists or cannot be written.
    pub fn create(folder: &Path, rig: &str, hosts: &[String], port: u16) -> Result<Self, AccessError> {
        check_name("rig", rig)?;
        if hosts.is_empty() {
            return Err(AccessError::Request(
                "a ring needs a name or address by which other computers reach the rig; give --host".to_owned(),
            ));
        }
        check_hosts(hosts)?;
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
            hosts: hosts.to_vec(),
            listen: SocketAddr::from(([0, 0, 0, 0], port)),
            holders: Vec::new(),
        };
        let now = unix_secs();
        let valid = (now, now + RING_DAYS * 86_400);
        let (authority, secret) = Authority::new(&authority_name(&list), valid)?;
        let own = authority.sign(&own_name(&list), hosts, TlsSide::Server, valid)?;
        let failed = |error: std::io::Error| match error.kind() {
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
        format!("{}-{number}", self.list.id)
    }

    pub(crate) fn own(&self) -> &CertificatePair {
        &self.own
    }

    pub(crate) fn authority(&self) -> &Authority {
        &self.authority
    }

    /// Issues a key, valid for `days`.
    ///
    /// # Errors
    /// [`AccessError::Request`] for a bad name, a name that is taken, or more holders than there is room for.
    pub fn add(&mut self, name: &str, role: Role, days: u64) -> Result<KeyFile, AccessError> {
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
        self.issue(name, role, number, days)
    }

    /// Issues a new key to a holder, valid for `days`; the old one is refused from now on.
    ///
    /// # Errors
    /// [`AccessError::Request`] when no holder of this name has a key.
    pub fn renew(&mut self, name: &str, days: u64) -> Result<KeyFile, AccessError> {
        let Some(Holder { role, number, .. }) = self.valid_holder(name).cloned() else {
            return Err(self.unknown_holder(name));
        };
        self.mark_revoked(name);
        self.issue(name, role, number, days)
    }

    /// Revokes the key of a holder; an open gate disconnects it.
    ///
    /// # Errors
    /// [`AccessError::Request`] when no holder of this name has a key.
    pub fn revoke(&mut self, name: &str) -> Result<(), AccessError> {
        if self.valid_holder(name).is_none() {
            return Err(self.unknown_holder(name));
        }
        self.mark_revoked(name);
        self.save()
    }

    /// Issues a new key to a holder that ends at a time, in seconds since 1970.
    #[cfg(test)]
    pub(crate) fn replace_validity(&mut self, name: &str, end: u64) -> KeyFile {
        let Some(Holder { role, number, .. }) = self.valid_holder(name).cloned() else { panic!("no '{name}'") };
        self.mark_revoked(name);
        self.issue_until(name, role, number, end).unwrap_or_else(|error| panic!("{error}"))
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
        self.list.holders.iter_mut().filter(|of| of.name == name).for_each(|of| of.revoked = true);
    }

    fn issue(&mut self, name: &str, role: Role, number: usize, days: u64) -> Result<KeyFile, AccessError> {
        let now = unix_secs();
        let Some(end) =
            days.checked_mul(86_400).and_then(|secs| now.checked_add(secs)).filter(|_| (1..=36_500).contains(&days))
        else {
            return Err(AccessError::Request(format!("--days {days}: use 1 to 36500")));
        };
        self.issue_until(name, role, number, end)
    }

    fn issue_until(&mut self, name: &str, role: Role, number: usize, end: u64) -> Result<KeyFile, AccessError> {
        let pair = self.authority.sign(name, &[], TlsSide::Client, (unix_secs(), end))?;
        let der = CertificateDer::from_pem_slice(pair.certificate.as_bytes()).map_err(AccessError::system)?;
        let expires = humantime::format_rfc3339_seconds(UNIX_EPOCH + Duration::from_secs(end)).to_string();
        let holder =
            Holder { name: name.to_owned(), role, number, expires, fingerprint: fingerprint(&der), revoked: false };
        let port = self.address(role).port();
        let connect = self.list.hosts.iter().map(|host| host_and_port(host, port)).collect();
        let topic_name = self.topic_name(number);
        let authority = self.authority.certificate.clone();
        let file = KeyFile::new(&self.list.rig, &holder, topic_name, connect, own_name(&self.list), authority, pair);
        self.list.holders.push(holder);
        self.forget_oldest();
        self.save()?;
        Ok(file)
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
        flyrig_types::write_whole(&path, |out| out.write_all(text.as_bytes()))
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

fn check_hosts(hosts: &[String]) -> Result<(), AccessError> {
    let good = |host: &String| {
        host.parse::<std::net::IpAddr>().is_ok()
            || (1..=253).contains(&host.len()) && host.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.".contains(&b))
    };
    match hosts.iter().find(|host| !good(host)) {
        None => Ok(()),
        Some(host) => Err(AccessError::Request(format!(
            "--host {host}: give a name or address without a port, such as rig.local or 10.0.0.5"
        ))),
    }
}

fn host_and_port(host: &str, port: u16) -> String {
    if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn new_ring() -> (tempfile::TempDir, Ring) {
        let folder = tempfile::tempdir().unwrap();
        let ring = Ring::create(&folder.path().join("keys"), "studio", &["rig.local".to_owned()], 7450).unwrap();
        (folder, ring)
    }

    #[test]
    fn a_ring_and_its_keys_come_back_as_they_were_made() {
        let (folder, mut ring) = new_ring();
        let desk = ring.add("desk", Role::Viewer, 30).unwrap();
        let cameras = ring.add("left-pc", Role::Cameras, 30).unwrap();
        assert_eq!(desk.connect, ["rig.local:7450"]);
        assert_eq!(cameras.connect, ["rig.local:7451"]);
        assert_ne!(desk.private_key, cameras.private_key);
        let file = folder.path().join("desk.key");
        desk.write_new(&file).unwrap();
        assert_eq!(KeyFile::read(&file, &Role::ALL).unwrap(), desk);
        assert!(!format!("{desk:?} {ring:?}").contains("PRIVATE"));
        let again = Ring::open(ring.folder()).unwrap();
        assert_eq!(again.holders(), ring.holders());
        assert_eq!(again.authority().certificate, ring.authority().certificate);
        #[cfg(unix)]
        for secret in [file, ring.folder().join(AUTHORITY[1]), ring.folder().join(OWN[1])] {
            let mode = std::fs::metadata(&secret).unwrap().permissions();
            assert_eq!(std::os::unix::fs::PermissionsExt::mode(&mode) & 0o777, 0o600, "{}", secret.display());
        }
        // IPv6 addresses are written as such.
        let hosts = ["fd00::1".to_owned(), "10.0.0.5".to_owned()];
        let mut six = Ring::create(&folder.path().join("six"), "studio", &hosts, 9000).unwrap();
        assert_eq!(six.add("a", Role::Relay, 1).unwrap().connect, ["[fd00::1]:9000", "10.0.0.5:9000"]);
    }

    #[test]
    fn numbers_are_given_once_and_again_after_they_were_revoked() {
        let (_folder, mut ring) = new_ring();
        let names: Vec<String> =
            (0..4).map(|n| ring.add(&format!("v{n}"), Role::Viewer, 1).unwrap().topic_name).collect();
        assert!(names.iter().enumerate().all(|(n, name)| name.ends_with(&format!("-{n}"))), "{names:?}");
        ring.revoke("v1").unwrap();
        assert_eq!(ring.add("v4", Role::Viewer, 1).unwrap().topic_name, names[1]);
        assert_eq!(ring.renew("v2", 1).unwrap().topic_name, names[2]);
        // The same name again, after it was revoked.
        assert!(ring.add("v1", Role::Viewer, 1).unwrap().topic_name.ends_with("-4"));
        let valid: Vec<_> =
            ring.holders().iter().filter(|of| !of.revoked).map(|of| (of.name.as_str(), of.number)).collect();
        assert_eq!(valid, [("v0", 0), ("v3", 3), ("v4", 1), ("v2", 2), ("v1", 4)]);
        for _ in 0..2 * MAX_REVOKED {
            ring.renew("v0", 1).unwrap();
        }
        assert_eq!(ring.holders().len(), 5 + MAX_REVOKED, "the list does not grow for ever");
        assert_eq!(Ring::open(ring.folder()).unwrap().holders(), ring.holders());
        let prints: std::collections::BTreeSet<_> = ring.holders().iter().map(|of| of.fingerprint.clone()).collect();
        assert_eq!(prints.len(), ring.holders().len());
    }

    #[test]
    fn requests_that_are_not_possible_are_refused_in_words_and_change_nothing() {
        let (folder, mut ring) = new_ring();
        ring.add("desk", Role::Viewer, 1).unwrap();
        let before = std::fs::read(ring.folder().join(LIST)).unwrap();
        let words = |result: Result<(), AccessError>| result.unwrap_err().to_string();
        for (result, part) in [
            (ring.add("desk", Role::Cameras, 1).map(drop), "flyrig keys renew desk"),
            (ring.add("a/b", Role::Viewer, 1).map(drop), "holder 'a/b'"),
            (ring.add("", Role::Viewer, 1).map(drop), "holder ''"),
            (ring.add("x", Role::Viewer, 0).map(drop), "--days 0"),
            (ring.add("x", Role::Viewer, u64::MAX).map(drop), "use 1 to 36500"),
            (ring.renew("x", 1).map(drop), "'x' has no key; known: desk"),
            (ring.revoke("x"), "'x' has no key; known: desk"),
        ] {
            let text = words(result);
            assert!(text.contains(part), "{text}");
        }
        assert_eq!(std::fs::read(ring.folder().join(LIST)).unwrap(), before);
        let new = |name: &str, rig: &str, hosts: &[&str], port| {
            let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
            words(Ring::create(&folder.path().join(name), rig, &hosts, port).map(drop))
        };
        assert!(new("keys", "studio", &["a"], 1).contains("is there already"));
        assert!(new("b", "stu dio", &["a"], 1).contains("rig 'stu dio'"));
        assert!(new("b", "studio", &[], 1).contains("--host"));
        assert!(new("b", "studio", &["a:7450"], 1).contains("without a port"));
        assert!(new("b", "studio", &["a"], 0).contains("--port 0"));
        assert!(new("none/b", "studio", &["a"], 1).contains("cannot be made"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half-made stays");
    }

    #[test]
    fn damaged_rings_and_keys_are_named() {
        let (folder, mut ring) = new_ring();
        let key = folder.path().join("desk.key");
        ring.add("desk", Role::Viewer, 1).unwrap().write_new(&key).unwrap();
        let good = std::fs::read_to_string(&key).unwrap();
        let words = |text: &[u8]| {
            std::fs::write(&key, text).unwrap();
            KeyFile::read(&key, &Role::ALL).unwrap_err().to_string()
        };
        for (text, part) in [
            (String::new(), "is no key"),
            ("x = ".to_owned(), "is no key"),
            (good.replace("version = 1", "version = 2"), "version 2, this program knows 1; update"),
            (good.replace("connect = [\"rig.local:7450\"]", "connect = []"), "is damaged"),
            (good.replace("topic_name = \"", "topic_name = \"*/"), "is damaged"),
            (good.replace("role = \"viewer\"", "role = \"king\""), "is damaged"),
            (good.replacen("BEGIN CERTIFICATE", "BEGIN CERT", 1), "is damaged"),
            (good.replace("BEGIN PRIVATE", "BEGIN PUBLIC"), "is damaged"),
        ] {
            let error = words(text.as_bytes());
            assert!(error.contains("desk.key") && error.contains(part), "{part}: {error}");
        }
        assert!(words(&[0xff; 100]).contains("is no key"));
        assert!(words(&vec![b'#'; 100_000]).contains("too large"));
        std::fs::write(&key, &good).unwrap();
        assert!(KeyFile::read(&key, &[Role::Cameras]).unwrap_err().to_string().contains("is a key of role viewer"));
        // Every byte of a key and of a list, changed: an error or a key, never a panic.
        let list = ring.folder().join(LIST);
        let listed = std::fs::read(&list).unwrap();
        for n in (0..good.len()).step_by(7) {
            let mut bytes = good.clone().into_bytes();
            bytes[n] = bytes[n].wrapping_add(n as u8 | 1);
            std::fs::write(&key, &bytes).unwrap();
            let _ = KeyFile::read(&key, &Role::ALL);
        }
        for n in 0..listed.len() {
            let mut bytes = listed.clone();
            bytes[n] = bytes[n].wrapping_add(n as u8 | 1);
            std::fs::write(&list, &bytes).unwrap();
            let _ = Ring::open(ring.folder());
        }
        std::fs::write(&list, "version = 1").unwrap();
        assert!(Ring::open(ring.folder()).unwrap_err().to_string().contains("ring.toml: is no list of keys"));
        std::fs::write(&list, &listed).unwrap();
        std::fs::write(ring.folder().join(AUTHORITY[1]), "nothing").unwrap();
        assert!(Ring::open(ring.folder()).unwrap_err().to_string().contains("authority-key.pem: is damaged"));
        std::fs::remove_file(ring.folder().join(OWN[0])).unwrap();
        std::fs::write(ring.folder().join(AUTHORITY[1]), "").unwrap();
        assert!(Ring::open(&folder.path().join("none")).unwrap_err().to_string().contains("flyrig keys new"));
    }
}
