//! Opening of zenoh sessions: ports, keys, rules.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use flyrig_access::{AccessError, Gate, Inner, KeyFile, KeyProbe, Ring, Role};
use serde_json::json;
use zenoh::{Session, Wait};

use crate::{
    error::TransportError,
    session::{
        access_rules,
        config::{Side, TransportConfig, is_loopback, tls_endpoint},
        network_threads::check_network_threads,
    },
};

/// Bytes that the system keeps between a session and its gate.
const SEND_BUFFER: u32 = 16 << 10;
/// Bytes that the system of a key's holder keeps unread: enough for 20 Mbit/s with 200 ms. The system's own choice grows too slowly for
/// a template.
const RECEIVE_BUFFER: u32 = 512 << 10;
/// Attempts at free ports, which another program may take in between.
const ATTEMPTS: usize = 5;

/// Session with its gate.
pub(crate) struct Opened {
    pub session: Session,
    /// Endpoints for programs of this computer, port 0 replaced by the actual one.
    pub endpoints: Vec<String>,
    /// Gate that admits holders of keys; lives as long as the session.
    pub gate: Option<Gate>,
}

impl From<AccessError> for TransportError {
    fn from(error: AccessError) -> Self {
        match error {
            AccessError::Listen { .. } | AccessError::System(_) => Self::session("keys", &error),
            _ => Self::config("keys", error.to_string()),
        }
    }
}

/// Opens a session of a rig, viewer or computer with cameras. Holders of keys of these roles may reach it where the settings name keys.
/// `largest` bounds the messages to this session, bytes.
pub(crate) fn open(
    config: &TransportConfig,
    side: Side,
    largest: usize,
    roles: &[Role],
) -> Result<Opened, TransportError> {
    let ring = (config.has_keys() && !roles.is_empty()).then(|| Ring::open(&config.keys)).transpose()?;
    if let Some(ring) = ring.as_ref().filter(|ring| ring.rig() != config.rig) {
        let problem =
            format!("these are of the rig '{}', not of '{}'; name others, or rig.name", ring.rig(), config.rig);
        return Err(TransportError::config(format!("keys {}", config.keys.display()), problem));
    }
    if let Some(listen) = config.listen.iter().find(|endpoint| !is_loopback(endpoint)) {
        tracing::warn!(
            "INSECURE: any program that reaches {listen} can watch the people of rig '{}' and publish in its name",
            config.rig
        );
    }
    let connect = match &config.key {
        // zenoh would take the other addresses for further rigs, and connect to them repeatedly.
        Some(key) => vec![tls_endpoint(key.address())],
        None => config.connect.clone(),
    };
    if ring.is_some() || config.key.is_some() {
        check_network_threads();
    }
    for attempt in 1.. {
        let endpoints: Vec<String> = config.listen.iter().map(|endpoint| with_free_port(endpoint)).collect();
        let behind =
            ring.as_ref().map(|ring| Ok::<_, TransportError>((ring, Inner::new()?, free_port()?))).transpose()?;
        let mut listen = endpoints.clone();
        listen.extend(behind.iter().map(|(.., port)| tls_endpoint(&at_session(*port).to_string())));
        let settings = secured(behind.as_ref().map(|(ring, inner, _)| (*ring, inner)), roles, config.key.as_ref());
        let session = match zenoh::open(config.zenoh(side, &listen, &connect, largest, &settings)?).wait() {
            Ok(session) => session,
            // Another program was faster to take the port.
            Err(_) if attempt < ATTEMPTS && listen != config.listen => continue,
            Err(error) => {
                let text = format!("{error}; is another publisher running there? Choose another listen endpoint");
                return Err(TransportError::session(listen.join(", "), &text));
            }
        };
        let gate = behind.map(|(ring, inner, port)| {
            let address = ring.address(roles.first().copied().unwrap_or(Role::Viewer));
            Gate::start(ring, roles, address, inner, at_session(port))
        });
        return Ok(Opened { session, endpoints, gate: gate.transpose()? });
    }
    Err(TransportError::session("listen", &"no free port"))
}

/// Starts to probe why the rig rejects the key, where there is one.
pub(crate) fn probe(
    config: &TransportConfig,
    is_connected: impl Fn() -> bool + Send + 'static,
) -> Result<Option<KeyProbe>, TransportError> {
    Ok(config.key.clone().map(|key| KeyProbe::start(key, is_connected)).transpose()?)
}

/// Returns the address of the session behind a gate.
fn at_session(port: u16) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::LOCALHOST, port))
}

/// Returns zenoh's settings of a session behind a gate, or of one that shows a key.
fn secured(behind: Option<(&Ring, &Inner)>, roles: &[Role], key: Option<&KeyFile>) -> Vec<(&'static str, String)> {
    let base64 = |text: &str| json!(STANDARD.encode(text)).to_string();
    let (authority, mut settings, rules) = match (behind, key) {
        (Some((ring, inner)), _) => {
            let (certificate, secret) = inner.certificate_and_key();
            let settings = vec![
                ("transport/link/tls/listen_certificate_base64", base64(certificate)),
                ("transport/link/tls/listen_private_key_base64", base64(secret)),
                // Newer motion cannot overtake bytes in the socket.
                ("transport/link/tls/so_sndbuf", SEND_BUFFER.to_string()),
            ];
            (inner.authority(), settings, access_rules::behind_gate(ring, roles))
        }
        (None, Some(key)) => {
            let settings = vec![
                ("transport/link/tls/connect_certificate_base64", base64(&key.certificate)),
                ("transport/link/tls/connect_private_key_base64", base64(&key.private_key)),
                ("transport/link/tls/so_rcvbuf", RECEIVE_BUFFER.to_string()),
            ];
            (key.authority.as_str(), settings, access_rules::with_key(key))
        }
        (None, None) => return Vec::new(),
    };
    settings.extend([
        ("transport/link/tls/enable_mtls", "true".to_owned()),
        ("transport/link/tls/root_ca_certificate_base64", base64(authority)),
        ("access_control", rules.to_string()),
    ]);
    settings
}

fn free_port() -> Result<u16, TransportError> {
    let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).and_then(|listener| listener.local_addr());
    free.map(|address| address.port()).map_err(|error| TransportError::session("listen", &error))
}

/// Replaces port 0 by a free port: zenoh's stable interface does not report the port that it takes.
fn with_free_port(endpoint: &str) -> String {
    let free = || {
        let host = endpoint.strip_prefix("tcp/")?.strip_suffix(":0")?;
        let port = TcpListener::bind((host.trim_matches(['[', ']']), 0)).ok()?.local_addr().ok()?.port();
        Some(format!("tcp/{host}:{port}"))
    };
    free().unwrap_or_else(|| endpoint.to_owned())
}
