//! Ends of a ring's keys and of its rig's certificate.

use std::{
    collections::BTreeMap,
    path::Path,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use rustls_pki_types::{CertificateDer, pem::PemObject as _};

use crate::{
    error::AccessError,
    holder::Holder,
    ring_folder::{read_certificate, read_holders},
};

const DAY: Duration = Duration::from_secs(86_400);
/// Days before an end at which it is logged.
const AHEAD: [u32; 3] = [30, 7, 1];

/// Ends of a ring's keys and of its rig's certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyEnds {
    /// Name of the holder whose key ends next, and the end; `None` without a valid key.
    pub next_key: Option<(String, SystemTime)>,
    /// End of the rig's certificate.
    pub certificate: SystemTime,
}

impl KeyEnds {
    /// Reads the ends of the keys that are valid at `now` from the folder of a ring.
    ///
    /// # Errors
    /// [`AccessError::File`] names the file that is missing or damaged.
    pub fn read(folder: &Path, now: SystemTime) -> Result<Self, AccessError> {
        let valid = read_holders(folder)?.into_iter().filter(|holder| !holder.revoked && holder.expires_at() > now);
        let next_key = valid.min_by_key(Holder::expires_at).map(|holder| (holder.expires_at(), holder.name));
        let certificate =
            certificate_end(&read_certificate(folder)?).map_err(|error| AccessError::file(folder, error))?;
        Ok(Self { next_key: next_key.map(|(end, name)| (name, end)), certificate })
    }
}

/// Returns the time after which a certificate (PEM) is not valid.
pub(crate) fn certificate_end(pem: &str) -> Result<SystemTime, String> {
    let damaged = |error: &dyn std::fmt::Display| format!("the rig's certificate is damaged ({error})");
    let der = CertificateDer::from_pem_slice(pem.as_bytes()).map_err(|error| damaged(&error))?;
    let (_, certificate) = x509_parser::parse_x509_certificate(&der).map_err(|error| damaged(&error))?;
    let secs = u64::try_from(certificate.validity().not_after.timestamp()).unwrap_or(0);
    Ok(UNIX_EPOCH + Duration::from_secs(secs))
}

/// Watch that announces ends 30, 7 and 1 days ahead, each once.
#[derive(Debug, Default)]
pub(crate) struct EndWatch {
    /// Days ahead that were announced last, by the fingerprint of a key; those of the rig's certificate under an empty name.
    announced: BTreeMap<String, u32>,
}

impl EndWatch {
    /// Returns the lines to log at `now`.
    pub fn due(&mut self, holders: &[Holder], certificate: Option<SystemTime>, now: SystemTime) -> Vec<String> {
        self.announced.retain(|name, _| name.is_empty() || holders.iter().any(|of| of.fingerprint == *name));
        let mut lines = Vec::new();
        for holder in holders.iter().filter(|holder| !holder.revoked) {
            if let Some(days) = self.announce(&holder.fingerprint, holder.expires_at(), now) {
                let Holder { name, expires, .. } = holder;
                lines.push(format!(
                    "keys: the key of '{name}' ends within {days}, at {expires}; make a new one with `flyrig keys renew {name}`"
                ));
            }
        }
        if let Some(end) = certificate
            && let Some(days) = self.announce("", end, now)
        {
            let end = humantime::format_rfc3339_seconds(end);
            lines.push(format!(
                "keys: the rig's certificate ends within {days}, at {end}; make new keys with `flyrig keys new` and give them to all holders"
            ));
        }
        lines
    }

    /// Returns the days to announce, in words; `None` when nothing is new, and after the end.
    fn announce(&mut self, name: &str, end: SystemTime, now: SystemTime) -> Option<String> {
        let left = end.duration_since(now).ok().filter(|left| !left.is_zero())?;
        let Some(days) = AHEAD.into_iter().rev().find(|days| left <= DAY * *days) else {
            // The clock was set back, or the end is far.
            self.announced.remove(name);
            return None;
        };
        if self.announced.get(name).is_some_and(|last| *last <= days) {
            return None;
        }
        self.announced.insert(name.to_owned(), days);
        Some(if days == 1 { "1 day".to_owned() } else { format!("{days} days") })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::{ring_folder::Ring, role::Role};

    fn ring() -> (tempfile::TempDir, Ring) {
        let folder = tempfile::tempdir().unwrap();
        let mut ring = Ring::create(&folder.path().join("keys"), "studio", &["rig.local".to_owned()], 7450).unwrap();
        ring.add("long", Role::Viewer, 300).unwrap();
        ring.add("desk", Role::Viewer, 100).unwrap();
        ring.add("gone", Role::Viewer, 50).unwrap();
        ring.revoke("gone").unwrap();
        (folder, ring)
    }

    #[test]
    fn the_next_end_is_that_of_a_valid_key() {
        let (_folder, ring) = ring();
        let now = SystemTime::now();
        let days_to = |end: SystemTime, now| end.duration_since(now).unwrap().as_secs_f64() / 86_400.0;
        let ends = KeyEnds::read(ring.folder(), now).unwrap();
        let (name, end) = ends.next_key.unwrap();
        assert!(name == "desk" && (days_to(end, now) - 100.0).abs() < 0.01, "{name}, revoked keys do not count");
        assert!((days_to(ends.certificate, now) - 3650.0).abs() < 0.01);
        let later = now + 200 * DAY;
        let ends = KeyEnds::read(ring.folder(), later).unwrap();
        assert_eq!(ends.next_key.unwrap().0, "long", "nor do those that have ended");
        assert_eq!(KeyEnds::read(ring.folder(), now + 301 * DAY).unwrap().next_key, None);
        std::fs::write(ring.folder().join("rig.pem"), "nothing").unwrap();
        assert!(KeyEnds::read(ring.folder(), now).unwrap_err().to_string().contains("certificate is damaged"));
    }

    #[test]
    fn ends_are_announced_thirty_seven_and_one_day_ahead_and_once() {
        let (_folder, ring) = ring();
        let (now, mut watch) = (SystemTime::now(), EndWatch::default());
        let certificate = now + 120 * DAY;
        let mut announced = Vec::new();
        // Twice a day for 130 days.
        for half in 0..260u32 {
            let lines = watch.due(ring.holders(), Some(certificate), now + half * DAY / 2);
            announced.extend(lines.into_iter().map(|line| (half, line)));
        }
        let of = |part: &str| -> Vec<(u32, bool)> {
            let found = announced.iter().filter(|(_, line)| line.contains(part));
            let days = |line: &str| ["30 days", "7 days", "1 day,"].iter().position(|days| line.contains(days));
            found.enumerate().map(|(n, (half, line))| (*half, days(line) == Some(n))).collect()
        };
        // Half days from the start: the key has 100 days, the certificate 120.
        assert_eq!(of("key of 'desk'"), [(140, true), (186, true), (198, true)]);
        assert_eq!(of("rig's certificate"), [(180, true), (226, true), (238, true)]);
        assert_eq!(announced.len(), 6, "{announced:?}");
        assert!(announced[0].1.contains("`flyrig keys renew desk`"), "{announced:?}");
        // A rig that starts late announces the shortest alone.
        let lines = EndWatch::default().due(ring.holders(), None, now + 99 * DAY + DAY / 2);
        assert!(lines.len() == 1 && lines[0].contains("ends within 1 day, at "), "{lines:?}");
    }
}
