//! Settings of a session.

use std::path::PathBuf;

use flyrig_access::KeyFile;
use serde::{Deserialize, Serialize};
use zenoh::Config;

use crate::{error::TransportError, keys};

/// Addresses of a rig and settings of its sessions, for both sides.
///
/// ```
/// use flyrig_transport::TransportConfig;
///
/// let mut config = TransportConfig::publisher("studio");
/// config.validate()?;
/// config.listen = vec!["tcp/0.0.0.0:7447".to_owned()];
/// assert!(config.validate().is_err(), "other computers need keys, or `insecure`");
/// # Ok::<(), flyrig_transport::TransportError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TransportConfig {
    /// Name of the rig, part of every key: 1 to 64 of `A-Z a-z 0-9 _ . -`. Configuration files state it elsewhere.
    #[serde(skip)]
    pub rig: String,
    /// Folder of the rig's keys ([`flyrig_access::Ring`]): their holders connect from other computers, through TLS, at the address in
    /// that folder. Empty: without keys.
    pub keys: PathBuf,
    /// Key that this side shows to the rig; it connects to the addresses in it. Not part of configuration files.
    #[serde(skip)]
    pub key: Option<KeyFile>,
    /// zenoh endpoints to listen on, such as `tcp/127.0.0.1:7447`; port 0 takes a free one. Programs that reach them may do everything.
    pub listen: Vec<String>,
    /// Whether to listen on addresses that other computers reach without keys: in trusted networks only.
    pub insecure: bool,
    /// zenoh endpoints of publishers or routers to connect to; retried until they answer.
    pub connect: Vec<String>,
    /// Whether rigs and viewers find each other by UDP multicast on the local network.
    pub multicast: bool,
    /// Ignored; configurations of earlier versions have it. zenoh never unmaps the shared memory of processes that are gone.
    #[serde(rename = "shared_memory", skip_serializing)]
    pub _shared_memory: Option<bool>,
    /// Publisher: largest number of subscribers with a viewpoint of their own.
    pub max_viewers: usize,
    /// Publisher: lifetime of a viewpoint that is not renewed, milliseconds. Not part of a configuration.
    #[serde(skip)]
    pub viewpoint_lease_millis: u64,
    /// Publisher: pixels per second of all viewpoints together, width * height * frame rate each; requests beyond it are refused. The
    /// default is four viewers with 512x512 pixels at 30 per second.
    pub viewpoint_pixels_per_second: u64,
    /// Receiving side: payload bytes that may wait for their reader, over all topics or cameras, 64 KiB to 4 GiB. Beyond it the largest
    /// waiting payloads are dropped and counted; a single larger message is refused.
    pub inbox_bytes: u64,
}

/// Direction of a session's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    /// Rig, relay or computer with cameras.
    Sender,
    /// Viewer, or the rig towards cameras of other computers.
    Receiver,
}

/// Largest request to a publisher (for a viewpoint or a clock), bytes.
pub(crate) const LARGEST_QUESTION: usize = 1 << 20;

/// Range of [`TransportConfig::inbox_bytes`].
const INBOX_BYTES: std::ops::RangeInclusive<u64> = 1 << 16..=1 << 32;

/// Largest [`TransportConfig::viewpoint_pixels_per_second`].
const MOST_PIXELS_PER_SECOND: u64 = 100_000_000_000;

/// Endpoint where a publisher listens by default.
const DEFAULT_ENDPOINT: &str = "tcp/127.0.0.1:7447";

impl Default for TransportConfig {
    /// Returns the settings of a publisher named "flyrig" that listens on loopback, zenoh's usual port.
    fn default() -> Self {
        Self {
            rig: "flyrig".to_owned(),
            keys: PathBuf::new(),
            key: None,
            insecure: false,
            listen: vec![DEFAULT_ENDPOINT.to_owned()],
            connect: vec![],
            multicast: false,
            _shared_memory: None,
            max_viewers: 4,
            viewpoint_lease_millis: 3000,
            viewpoint_pixels_per_second: 512 * 512 * 30 * 4,
            // Four waiting images of 1280x720 YUYV from each of 16 cameras are 118 MB.
            inbox_bytes: 256 << 20,
        }
    }
}

impl TransportConfig {
    /// Returns the settings of a publisher that listens on loopback, zenoh's usual port.
    #[must_use]
    pub fn publisher(rig: &str) -> Self {
        Self { rig: rig.to_owned(), ..Self::default() }
    }

    /// Returns the settings of a subscriber that connects to a publisher on this host.
    #[must_use]
    pub fn subscriber(rig: &str) -> Self {
        Self { rig: rig.to_owned(), listen: vec![], connect: vec![DEFAULT_ENDPOINT.to_owned()], ..Self::default() }
    }

    /// Returns the settings of a session that shows a key to the rig named in it, at the first of its addresses that admits the key.
    #[must_use]
    pub fn with_key(key: KeyFile) -> Self {
        let connect = key.connect.iter().map(|address| tls_endpoint(address)).collect();
        Self { rig: key.rig.clone(), listen: vec![], connect, key: Some(key), ..Self::default() }
    }

    /// Returns whether a ring of keys is named.
    pub(crate) fn has_keys(&self) -> bool {
        !self.keys.as_os_str().is_empty()
    }

    /// Checks names, endpoints and limits.
    ///
    /// # Errors
    /// `Config` names the setting.
    pub fn validate(&self) -> Result<(), TransportError> {
        keys::check_name("rig", &self.rig)?;
        if self.listen.is_empty() && self.connect.is_empty() && !self.multicast && !self.has_keys() {
            return Err(TransportError::config(
                "listen, connect",
                "a session without endpoints and without multicast reaches no other; give one, such as tcp/127.0.0.1:7447",
            ));
        }
        for endpoint in self.listen.iter().chain(&self.connect) {
            if !(endpoint.starts_with("tcp/") || self.key.is_some() && endpoint.starts_with(TLS)) {
                return Err(TransportError::config(
                    format!("endpoint {endpoint:?}"),
                    "write tcp/HOST:PORT; a rig with keys is reached with a key file",
                ));
            }
        }
        if self.has_keys() && self.key.is_some() {
            return Err(TransportError::config("keys", "a session either shows a key or admits holders of keys"));
        }
        if self.multicast && (self.has_keys() || self.key.is_some()) {
            return Err(TransportError::config(
                "multicast",
                "a rig with keys is not found by multicast; set it to false",
            ));
        }
        if let Some(open) = self.listen.iter().find(|endpoint| !is_loopback(endpoint)).filter(|_| !self.insecure) {
            let fix = if self.has_keys() {
                "leave it out: holders of keys connect at the address in transport.keys".to_owned()
            } else {
                format!(
                    "make keys for those who may: `flyrig keys new {} --host NAME-OF-THIS-COMPUTER`, and transport.keys = \"{}-keys\"; or set \
                     transport.insecure = true (--insecure) in a trusted network",
                    self.rig, self.rig
                )
            };
            return Err(TransportError::config(
                format!("listen {open:?}"),
                format!("any program that reaches this computer could watch the people; {fix}"),
            ));
        }
        if !(100..=600_000).contains(&self.viewpoint_lease_millis) {
            return Err(TransportError::config(
                "viewpoint_lease_millis",
                format!("is {}, expected 100 to 600000", self.viewpoint_lease_millis),
            ));
        }
        if self.viewpoint_pixels_per_second > MOST_PIXELS_PER_SECOND {
            return Err(TransportError::config(
                "viewpoint_pixels_per_second",
                format!("is {}, at most {MOST_PIXELS_PER_SECOND}", self.viewpoint_pixels_per_second),
            ));
        }
        if !INBOX_BYTES.contains(&self.inbox_bytes) {
            let (min, max) = (INBOX_BYTES.start(), INBOX_BYTES.end());
            return Err(TransportError::config(
                "inbox_bytes",
                format!("is {}, expected {min} to {max}", self.inbox_bytes),
            ));
        }
        if self.max_viewers > 64 {
            return Err(TransportError::config("max_viewers", format!("is {}, at most 64", self.max_viewers)));
        }
        Ok(())
    }

    /// Returns the zenoh configuration. `largest` bounds the messages to this session, bytes: zenoh ends a connection with a larger one
    /// before the message is assembled. `others` are further settings, which keys need.
    pub(crate) fn zenoh(
        &self,
        side: Side,
        listen: &[String],
        connect: &[String],
        largest: usize,
        others: &[(&'static str, String)],
    ) -> Result<Config, TransportError> {
        let list = |endpoints: &[String]| serde_json::json!(endpoints).to_string();
        // A zenoh router passes nothing from peer to peer, but all between its peers and other routers: a sender that connects to one is one.
        // Rules of access are those of peers.
        let is_router = side == Side::Sender && !connect.is_empty() && self.key.is_none() && !self.has_keys();
        let settings = [
            ("mode", if is_router { "\"router\"" } else { "\"peer\"" }.to_owned()),
            // What a router would do besides: stamp messages by the wall clock, and wait at its start.
            ("timestamping/enabled", "false".to_owned()),
            ("scouting/delay", "0".to_owned()),
            ("listen/endpoints", list(listen)),
            ("connect/endpoints", list(connect)),
            ("connect/timeout_ms", "-1".to_owned()),
            ("connect/exit_on_failure", "false".to_owned()),
            ("connect/retry", r#"{"period_init_ms":100,"period_max_ms":1000,"period_increase_factor":2}"#.to_owned()),
            // The other side may start much later.
            ("open/return_conditions/connect_scouted", "false".to_owned()),
            ("scouting/multicast/enabled", self.multicast.to_string()),
            // Gossip would connect the viewers of one rig to each other for nothing.
            ("scouting/gossip/enabled", self.multicast.to_string()),
            // zenoh's 2 batches of 64 KiB overflow when several images leave at once; 8 hold two frames of four views.
            ("transport/link/tx/queue/size/data", "8".to_owned()),
            // Chunks of a template that are queried at once: one that finds no room is missing for seconds.
            ("transport/link/tx/queue/size/data_high", "8".to_owned()),
            ("transport/link/rx/max_message_size", largest.to_string()),
        ];
        let mut config = Config::default();
        for (key, value) in settings.iter().chain(others) {
            config.insert_json5(key, value).map_err(|error| TransportError::config(*key, error.to_string()))?;
        }
        Ok(config)
    }
}

/// Prefix of the endpoints of rigs with keys.
const TLS: &str = "tls/";

/// Returns the endpoint of a rig with keys. zenoh takes the part before the last colon for the name in the rig's certificate, and knows
/// no address in brackets.
pub(crate) fn tls_endpoint(address: &str) -> String {
    format!("{TLS}{}", address.replace(['[', ']'], ""))
}

/// Returns whether only programs of this computer reach an endpoint.
pub(crate) fn is_loopback(endpoint: &str) -> bool {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, address)| address);
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
    host.eq_ignore_ascii_case("localhost") || host.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_is_known_to_zenoh() {
        for config in [TransportConfig::publisher("a"), TransportConfig::subscriber("a")] {
            config.validate().unwrap();
            for side in [Side::Sender, Side::Receiver] {
                config.zenoh(side, &config.listen, &config.connect, LARGEST_QUESTION, &[]).unwrap();
            }
        }
    }

    #[test]
    fn bad_settings_are_named() {
        let good = TransportConfig::publisher("a");
        let refused = |config: TransportConfig| config.validate().unwrap_err().to_string();
        assert!(refused(TransportConfig { rig: "a/**".into(), ..good.clone() }).contains("a/**"));
        assert!(refused(TransportConfig { rig: String::new(), ..good.clone() }).contains("rig"));
        assert!(refused(TransportConfig { listen: vec!["udp/1.2.3.4:5".into()], ..good.clone() }).contains("udp/"));
        assert!(refused(TransportConfig { listen: vec![], ..good.clone() }).contains("reaches no other"));
        for open in ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.1:7447", "tcp/studio:7447"] {
            let listen = vec![open.to_owned()];
            let reason = refused(TransportConfig { listen: listen.clone(), ..good.clone() });
            assert!(
                reason.contains("flyrig keys new a --host") && reason.contains("transport.insecure = true"),
                "{reason}"
            );
            let keys = PathBuf::from("a-keys");
            assert!(refused(TransportConfig { listen: listen.clone(), keys, ..good.clone() }).contains("leave it out"));
            TransportConfig { listen, insecure: true, ..good.clone() }.validate().unwrap();
        }
        for own in ["tcp/127.0.0.1:0", "tcp/[::1]:7447", "tcp/localhost:7447"] {
            TransportConfig { listen: vec![own.to_owned()], ..good.clone() }.validate().unwrap();
        }
        let keys = PathBuf::from("a-keys");
        assert!(refused(TransportConfig { multicast: true, keys: keys.clone(), ..good.clone() }).contains("multicast"));
        TransportConfig { listen: vec![], keys, ..good.clone() }.validate().unwrap();
        assert!(refused(TransportConfig { connect: vec!["tls/a:1".into()], ..good.clone() }).contains("key file"));
        assert!(refused(TransportConfig { viewpoint_lease_millis: 0, ..good.clone() }).contains("lease"));
        for inbox_bytes in [0, 1000, u64::MAX] {
            assert!(refused(TransportConfig { inbox_bytes, ..good.clone() }).contains("inbox_bytes"));
        }
        assert!(refused(TransportConfig { max_viewers: 1000, ..good }).contains("max_viewers"));
    }
}
