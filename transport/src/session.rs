//! Opening zenoh sessions: ports, keys, rules.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use flyrig_access::{AccessError, Gate, Inner, KeyFile, Probe, Ring, Role};
use serde_json::json;
use zenoh::{Session, Wait};

use crate::{TransportConfig, TransportError, access_rules, config::tls_endpoint};

/// Attempts at ports that somebody else takes in between.
const ATTEMPTS: usize = 5;

/// A session, and what guards it.
pub(crate) struct Opened {
    pub session: Session,
    /// Endpoints of programs of this computer, port 0 replaced by the real one.
    pub endpoints: Vec<String>,
    /// Admits holders of keys; lives as long as the session.
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

/// Opens a session that holders of keys of these roles may reach, where the settings name keys. `largest` bytes are the most that a
/// message to this session may have.
pub(crate) fn open(config: &TransportConfig, largest: usize, roles: &[Role]) -> Result<Opened, TransportError> {
    let ring = (config.has_keys() && !roles.is_empty()).then(|| Ring::open(&config.keys)).transpose()?;
    if let Some(ring) = ring.as_ref().filter(|ring| ring.rig() != config.rig) {
        let problem =
            format!("these are of the rig '{}', not of '{}'; name others, or rig.name", ring.rig(), config.rig);
        return Err(TransportError::config(format!("keys {}", config.keys.display()), problem));
    }
    if config.insecure && !config.listen.is_empty() {
        let listen = config.listen.join(", ");
        tracing::warn!(
            "INSECURE: whoever reaches {listen} can watch the people of rig '{}' and publish in its name",
            config.rig
        );
    }
    let connect = match &config.key {
        // zenoh would take the others for further rigs, and connect to them again and again.
        Some(key) => vec![tls_endpoint(key.address())],
        None => config.connect.clone(),
    };
    for attempt in 1.. {
        let endpoints: Vec<String> = config.listen.iter().map(|endpoint| with_free_port(endpoint)).collect();
        let behind =
            ring.as_ref().map(|ring| Ok::<_, TransportError>((ring, Inner::new()?, free_port()?))).transpose()?;
        let (mut listen, mut secured) = (endpoints.clone(), Vec::new());
        if let Some((ring, inner, port)) = &behind {
            listen.push(tls_endpoint(&SocketAddr::from((Ipv4Addr::LOCALHOST, *port)).to_string()));
            secured = behind_gate(ring, inner, roles);
        } else if let Some(key) = &config.key {
            secured = with_key(key);
        }
        let session = match zenoh::open(config.zenoh(&listen, &connect, largest, &secured)?).wait() {
            Ok(session) => session,
            // Somebody else was faster to take the port.
            Err(_) if attempt < ATTEMPTS && listen != config.listen => continue,
            Err(error) => {
                let text = format!("{error}; is another publisher running there? Choose another listen endpoint");
                return Err(TransportError::session(listen.join(", "), &text));
            }
        };
        let gate = behind.map(|(ring, inner, port)| {
            let address = ring.address(roles.first().copied().unwrap_or(Role::Viewer));
            Gate::start(ring, roles, address, inner, SocketAddr::from((Ipv4Addr::LOCALHOST, port)))
        });
        return Ok(Opened { session, endpoints, gate: gate.transpose()? });
    }
    Err(TransportError::session("listen", &"no free port"))
}

/// Starts to ask why the rig does not admit the key, where there is one.
pub(crate) fn probe(
    config: &TransportConfig,
    is_connected: impl Fn() -> bool + Send + 'static,
) -> Result<Option<Probe>, TransportError> {
    Ok(config.key.clone().map(|key| Probe::start(key, is_connected)).transpose()?)
}

fn quoted(text: &str) -> String {
    json!(STANDARD.encode(text)).to_string()
}

fn behind_gate(ring: &Ring, inner: &Inner, roles: &[Role]) -> Vec<(&'static str, String)> {
    let (certificate, key) = inner.certificate_and_key();
    vec![
        ("transport/link/tls/enable_mtls", "true".to_owned()),
        ("transport/link/tls/root_ca_certificate_base64", quoted(inner.authority())),
        ("transport/link/tls/listen_certificate_base64", quoted(certificate)),
        ("transport/link/tls/listen_private_key_base64", quoted(key)),
        // What lies in the socket cannot be overtaken by newer motion.
        ("transport/link/tls/so_sndbuf", (64 << 10).to_string()),
        ("access_control", access_rules::behind_gate(ring, roles).to_string()),
    ]
}

fn with_key(key: &KeyFile) -> Vec<(&'static str, String)> {
    vec![
        ("transport/link/tls/enable_mtls", "true".to_owned()),
        ("transport/link/tls/root_ca_certificate_base64", quoted(&key.authority)),
        ("transport/link/tls/connect_certificate_base64", quoted(&key.certificate)),
        ("transport/link/tls/connect_private_key_base64", quoted(&key.private_key)),
        ("access_control", access_rules::with_key(key).to_string()),
    ]
}

fn free_port() -> Result<u16, TransportError> {
    let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).and_then(|listener| listener.local_addr());
    free.map(|address| address.port()).map_err(|error| TransportError::session("listen", &error))
}

/// Replaces port 0: zenoh's stable interface does not tell which it took.
fn with_free_port(endpoint: &str) -> String {
    let free = || {
        let host = endpoint.strip_prefix("tcp/")?.strip_suffix(":0")?;
        let port = TcpListener::bind((host.trim_matches(['[', ']']), 0)).ok()?.local_addr().ok()?.port();
        Some(format!("tcp/{host}:{port}"))
    };
    free().unwrap_or_else(|| endpoint.to_owned())
}
