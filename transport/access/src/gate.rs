//! Gate: admits holders of keys, and passes their connections on.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    path::PathBuf,
    sync::{Arc, Mutex},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use flyrig_types::lock;

use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _, copy_bidirectional_with_sizes},
    net::{TcpSocket, TcpStream},
    sync::watch,
    time::{sleep, timeout},
};
use tokio_rustls::{
    TlsAcceptor, TlsConnector,
    rustls::{
        CertificateError, DigitallySignedStruct, DistinguishedName, Error as TlsError, SignatureScheme,
        client::danger::HandshakeSignatureValid,
        server::danger::{ClientCertVerified, ClientCertVerifier},
    },
};

use crate::{
    error::AccessError,
    holder::Holder,
    issue::{Authority, CertificatePair, TlsSide},
    listener::{Bounds, Connection, Listener, Serve},
    ring_folder::{Ring, fingerprint, list_time, read_holders},
    role::Role,
    tls,
};

/// Time limit of a handshake, and of the client's first message.
const PATIENCE: Duration = Duration::from_secs(5);
/// Interval between checks of the list of holders, and the longest time that a key outlives its end.
const CHECK_EVERY: Duration = Duration::from_millis(500);
/// Largest number of connections of one key at a time.
const CONNECTIONS_OF_ONE: usize = 16;
/// Largest number of admitted connections at a time.
const CONNECTIONS: usize = 512;
/// Largest number of connections and handshakes at a time: more than [`CONNECTIONS`] and the handshakes of all addresses together.
const ACCEPTED: usize = 1024;
/// Bytes copied at once from one side to the other.
const COPY_BYTES: usize = 4 << 10;
/// Bytes that the system keeps between the session and the gate.
const INNER_BUFFER: u32 = 16 << 10;
/// Validity of the certificates between gate and session, seconds; they live as long as the program.
const INNER_SECS: u64 = 20 * 365 * 86_400;

/// Certificates between a gate and the session behind it, made for each gate and known to nobody else.
pub struct Inner {
    authority: Authority,
    own: CertificatePair,
}

impl std::fmt::Debug for Inner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inner").finish_non_exhaustive()
    }
}

impl Inner {
    /// Issues new certificates.
    ///
    /// # Errors
    /// [`AccessError::System`] without random numbers.
    pub fn new() -> Result<Self, AccessError> {
        let authority = Authority::new("flyrig gate", (now_secs(), now_secs() + INNER_SECS))?.0;
        let hosts = [Ipv4Addr::LOCALHOST.to_string()];
        let own = authority.sign("flyrig session", &hosts, TlsSide::Server, (now_secs(), now_secs() + INNER_SECS))?;
        Ok(Self { authority, own })
    }

    /// Returns the authority that must have signed the certificates of the session's clients, PEM.
    #[must_use]
    pub fn authority(&self) -> &str {
        &self.authority.certificate
    }

    /// Returns the session's certificate and private key, PEM.
    #[must_use]
    pub fn certificate_and_key(&self) -> (&str, &str) {
        (&self.own.certificate, &self.own.key)
    }

    /// Returns the common name of a holder's certificate towards the session, made of role and number.
    #[must_use]
    pub fn name(role: Role, number: usize) -> String {
        format!("{}-{number}", role.name())
    }
}

/// Gate that admits holders until it is dropped.
#[derive(Debug)]
pub struct Gate {
    listener: Listener,
}

impl Gate {
    /// Starts to listen on `address` for holders of these roles, whose connections go to a session at `session`.
    ///
    /// # Errors
    /// [`AccessError::Listen`], or [`AccessError::File`] for a ring whose certificates are damaged.
    pub fn start(
        ring: &Ring,
        roles: &[Role],
        address: SocketAddr,
        inner: Inner,
        session: SocketAddr,
    ) -> Result<Self, AccessError> {
        let damaged = |problem: String| AccessError::file(ring.folder(), format!("is damaged ({problem})"));
        let chain = tls::client_verifier(&ring.authority().certificate).map_err(damaged)?;
        let list = Arc::new(List {
            folder: ring.folder().to_owned(),
            roles: roles.to_vec(),
            read_at: Mutex::default(),
            holders: Mutex::new(ring.holders().to_vec()),
            changes: watch::Sender::new(0),
        });
        let verifier = Arc::new(Admission { chain, list: Arc::clone(&list) });
        let own = ring.own();
        let server = tls::server(verifier, &own.certificate, &own.key).map_err(damaged)?;
        let bounds = Bounds { connections: ACCEPTED, per_address: true, is_streaming: true };
        let listener = Listener::bind(address, bounds).map_err(|problem| AccessError::Listen { address, problem })?;
        let shared = Arc::new(Shared {
            acceptor: TlsAcceptor::from(Arc::new(server)),
            list,
            inner,
            session,
            connections: Mutex::default(),
            refusals: Mutex::default(),
        });
        let listener = listener.start("gate", shared).map_err(AccessError::system)?;
        Ok(Self { listener })
    }

    /// Returns the address that is listened on.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.listener.address()
    }
}

fn now_secs() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

/// List of holders as read last.
#[derive(Debug)]
struct List {
    folder: PathBuf,
    roles: Vec<Role>,
    read_at: Mutex<Option<SystemTime>>,
    holders: Mutex<Vec<Holder>>,
    /// Number of changes.
    changes: watch::Sender<u64>,
}

impl List {
    fn find(&self, certificate: &CertificateDer<'_>) -> Option<Holder> {
        let print = fingerprint(certificate);
        let find = || lock(&self.holders).iter().find(|of| of.fingerprint == print).cloned();
        // The authority has signed it: an unknown holder was added just now.
        find().or_else(|| {
            self.reload();
            find()
        })
    }

    /// Reads the list again if it has changed.
    fn reload(&self) {
        let now = list_time(&self.folder);
        if now.is_none() || std::mem::replace(&mut *lock(&self.read_at), now) == now {
            return;
        }
        match read_holders(&self.folder) {
            Ok(holders) => {
                *lock(&self.holders) = holders;
                self.changes.send_modify(|count| *count += 1);
            }
            Err(error) => tracing::warn!("keys: the list cannot be read and stays as it was: {error}"),
        }
    }

    /// Returns why a certificate is not admitted, for TLS; `None` when it is.
    fn refusal(&self, certificate: &CertificateDer<'_>) -> Option<CertificateError> {
        match self.find(certificate) {
            None => Some(CertificateError::Revoked),
            Some(holder) if holder.revoked => Some(CertificateError::Revoked),
            Some(holder) if !self.roles.contains(&holder.role) => {
                Some(CertificateError::ApplicationVerificationFailure)
            }
            Some(_) => None,
        }
    }
}

/// Reloads the list periodically.
async fn follow(list: &List) {
    loop {
        sleep(CHECK_EVERY).await;
        list.reload();
    }
}

/// Verifier that checks the authority, then the list.
#[derive(Debug)]
struct Admission {
    chain: Arc<dyn ClientCertVerifier>,
    list: Arc<List>,
}

impl ClientCertVerifier for Admission {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        self.chain.root_hint_subjects()
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, TlsError> {
        let verified = self.chain.verify_client_cert(end_entity, intermediates, now)?;
        self.list.refusal(end_entity).map_or(Ok(verified), |reason| Err(TlsError::InvalidCertificate(reason)))
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        self.chain.verify_tls12_signature(message, certificate, signed)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        self.chain.verify_tls13_signature(message, certificate, signed)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.chain.supported_verify_schemes()
    }
}

/// State of all connections.
struct Shared {
    acceptor: TlsAcceptor,
    list: Arc<List>,
    inner: Inner,
    session: SocketAddr,
    /// Number of connections of each fingerprint.
    connections: Mutex<HashMap<String, usize>>,
    /// Number of refusals for each reason.
    refusals: Mutex<HashMap<&'static str, u64>>,
}

impl Shared {
    /// Logs the 1st, 2nd, 4th refusal for a reason, and so on.
    fn report_refusal(&self, who: &str, why: &'static str) {
        let mut refusals = lock(&self.refusals);
        let count = refusals.entry(why).or_default();
        *count += 1;
        if count.is_power_of_two() {
            tracing::warn!("keys: {who} was refused: {why} ({count} so far)");
        }
    }

    /// Takes one of a key's connections; `None` when all are taken.
    fn connect(self: &Arc<Self>, fingerprint: &str) -> Option<KeyPlace> {
        let mut connections = lock(&self.connections);
        let all: usize = connections.values().sum();
        let own = connections.entry(fingerprint.to_owned()).or_default();
        if *own >= CONNECTIONS_OF_ONE || all >= CONNECTIONS {
            return None;
        }
        *own += 1;
        Some(KeyPlace { shared: Arc::clone(self), fingerprint: fingerprint.to_owned() })
    }
}

/// Place among the connections of a key, given back when it is dropped.
struct KeyPlace {
    shared: Arc<Shared>,
    fingerprint: String,
}

impl Drop for KeyPlace {
    fn drop(&mut self) {
        let mut connections = lock(&self.shared.connections);
        if let Some(count) = connections.get_mut(&self.fingerprint) {
            *count -= 1;
            if *count == 0 {
                connections.remove(&self.fingerprint);
            }
        }
    }
}

impl Serve for Shared {
    async fn serve(self: Arc<Self>, connection: Connection) {
        greet(connection, self).await;
    }

    fn refuse(&self, address: IpAddr) {
        self.report_refusal(&address.to_string(), "too many connections without a key");
    }

    async fn beside(&self) {
        follow(&self.list).await;
    }
}

/// Admits a client and passes its connection on until it ends or is refused.
async fn greet(connection: Connection, shared: Arc<Shared>) {
    let Connection { stream, address, mut place } = connection;
    let shaken = timeout(PATIENCE, shared.acceptor.accept(stream)).await;
    place.established();
    let who = address.to_string();
    let mut client = match shaken {
        Ok(Ok(client)) => client,
        Ok(Err(error)) => return shared.report_refusal(&who, describe_failure(&error)),
        Err(_) => return shared.report_refusal(&who, "it showed no key in time"),
    };
    // Newer motion cannot overtake encrypted bytes either.
    client.get_mut().1.set_buffer_limit(Some(COPY_BYTES));
    let certificate = client.get_ref().1.peer_certificates().and_then(<[_]>::first).map(|of| of.clone().into_owned());
    let Some((certificate, holder)) = certificate.and_then(|of| shared.list.find(&of).map(|holder| (of, holder)))
    else {
        return shared.report_refusal(&who, "its key was revoked");
    };
    let who = format!("'{}' at {address}", holder.name);
    let Some(_of_key) = shared.connect(&holder.fingerprint) else {
        return shared.report_refusal(&who, "all connections of its key, or of the gate, are taken");
    };
    // A client that only tries its key sends nothing.
    let mut first = [0; COPY_BYTES];
    let count = match timeout(PATIENCE, client.read(&mut first)).await {
        Ok(Ok(count)) if count > 0 => count,
        _ => return,
    };
    let session = async {
        let mut session = pass_on(&holder, &shared).await?;
        session.write_all(first.get(..count).unwrap_or_default()).await.map(|()| session)
    };
    let mut session = match session.await {
        Ok(session) => session,
        Err(error) => return tracing::warn!("keys: {who} cannot be passed on: {error}"),
    };
    tracing::info!("keys: {who} ({}) connected", holder.role.name());
    tokio::select! {
        _ = copy_bidirectional_with_sizes(&mut client, &mut session, COPY_BYTES, COPY_BYTES) => tracing::info!("keys: {who} left"),
        why = until_refused(&certificate, &holder, &shared.list) => tracing::warn!("keys: {who} was disconnected: {why}"),
    }
}

/// Waits until the holder of an open connection is no longer admitted, and returns the reason.
async fn until_refused(certificate: &CertificateDer<'_>, holder: &Holder, list: &List) -> &'static str {
    let mut changes = list.changes.subscribe();
    loop {
        if list.refusal(certificate).is_some() {
            return "its key was revoked";
        }
        // The wall clock may be set.
        if SystemTime::now() >= holder.expires_at() {
            return "its key has expired";
        }
        let _ = timeout(CHECK_EVERY, changes.changed()).await;
    }
}

/// Connects to the session under the holder's name there.
async fn pass_on(holder: &Holder, shared: &Shared) -> std::io::Result<tokio_rustls::client::TlsStream<TcpStream>> {
    let failed = |error: String| std::io::Error::other(error);
    let name = Inner::name(holder.role, holder.number);
    let pair = shared
        .inner
        .authority
        .sign(&name, &[], TlsSide::Client, (now_secs(), now_secs() + INNER_SECS))
        .map_err(|error| failed(error.to_string()))?;
    let config = tls::client(shared.inner.authority(), &pair.certificate, &pair.key).map_err(failed)?;
    let socket = TcpSocket::new_v4()?;
    socket.set_recv_buffer_size(INNER_BUFFER)?;
    let stream = socket.connect(shared.session).await?;
    stream.set_nodelay(true)?;
    let name = ServerName::IpAddress(IpAddr::from(Ipv4Addr::LOCALHOST).into());
    timeout(PATIENCE, TlsConnector::from(Arc::new(config)).connect(name, stream)).await?
}

/// Describes a failed handshake.
fn describe_failure(error: &std::io::Error) -> &'static str {
    let tls = error.get_ref().and_then(|inner| inner.downcast_ref::<TlsError>());
    match tls {
        Some(TlsError::NoCertificatesPresented) => "it has no key",
        Some(TlsError::InvalidCertificate(reason)) => match reason {
            CertificateError::Expired | CertificateError::ExpiredContext { .. } => "its key has expired",
            CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
                "its key is not valid yet; compare the computers' clocks"
            }
            CertificateError::Revoked => "its key was revoked",
            CertificateError::ApplicationVerificationFailure => "its key is for another role, which has another port",
            _ => "its key is of another rig",
        },
        Some(TlsError::AlertReceived(_)) => "it does not trust this rig: its key is of another one",
        Some(_) => "it does not speak TLS 1.3",
        None => "it hung up",
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "gate_tests.rs"]
mod tests;
