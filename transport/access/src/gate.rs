//! Gate: admits holders of keys, and passes their connections on.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    path::PathBuf,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
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
    ends::{EndWatch, certificate_end},
    error::AccessError,
    holder::{Holder, covers},
    issue::{Authority, CertificatePair, TlsSide},
    listener::{Bounds, Connection, Listener, Serve},
    ring_folder::{Ring, fingerprint, parse_holders, read_list_text},
    role::Role,
    tls,
};

/// Time limit of a handshake, and of the client's first message.
const PATIENCE: Duration = Duration::from_secs(5);
/// Interval between checks of the list of holders, and the longest time that a key outlives its end.
const CHECK_EVERY: Duration = Duration::from_millis(500);
/// Number of those checks from one look at the ends of keys to the next: a minute.
const CHECKS_OF_ENDS: u64 = 120;
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
    list: Arc<List>,
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
            topic_prefix: ring.topic_prefix(),
            certificate_end: certificate_end(&ring.own().certificate).map_err(damaged)?,
            read: Mutex::default(),
            holders: Mutex::new(ring.holders().to_vec()),
            changes: watch::Sender::new(0),
            failures: AtomicU64::new(0),
            left_out: AtomicU64::new(0),
        });
        let verifier = Arc::new(Admission { chain, list: Arc::clone(&list) });
        let own = ring.own();
        let server = tls::server(verifier, &own.certificate, &own.key).map_err(damaged)?;
        let bounds = Bounds { connections: ACCEPTED, per_address: true, is_streaming: true };
        let listener = Listener::bind(address, bounds).map_err(|problem| AccessError::Listen { address, problem })?;
        let shared = Arc::new(Shared {
            acceptor: TlsAcceptor::from(Arc::new(server)),
            list: Arc::clone(&list),
            inner,
            session,
            connections: Mutex::default(),
            refusals: Mutex::default(),
        });
        let listener = listener.start("gate", shared).map_err(AccessError::system)?;
        Ok(Self { listener, list })
    }

    /// Returns the holders as this gate knows them at any time.
    #[must_use]
    pub fn holders(&self) -> HolderList {
        HolderList(Arc::clone(&self.list))
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

/// Holders as a running gate knows them.
#[derive(Debug, Clone)]
pub struct HolderList(Arc<List>);

impl HolderList {
    /// Returns whether the holder with this name in topics may send a camera at present. Logs the 1st, 2nd, 4th message that is left out.
    #[must_use]
    pub fn may_send(&self, topic_name: &str, camera: &str) -> bool {
        let list = &*self.0;
        let number = topic_name.strip_prefix(&list.topic_prefix).and_then(|number| number.parse().ok());
        let holders = lock(&list.holders);
        let holder = holders.iter().find(|of| !of.revoked && of.role == Role::Cameras && Some(of.number) == number);
        if holder.is_some_and(|holder| covers(&holder.cameras, camera)) {
            return true;
        }
        let count = list.left_out.fetch_add(1, Ordering::Relaxed) + 1;
        if let Some(Holder { name, cameras, .. }) = holder.filter(|_| count.is_power_of_two()) {
            tracing::warn!(
                "keys: messages as camera {camera} are left out: the key of '{name}' is for {}; make one with `flyrig keys add NAME --role cameras --camera {camera}` ({count} so far)",
                cameras.join(", ")
            );
        }
        false
    }
}

/// List of holders as read last.
#[derive(Debug)]
struct List {
    folder: PathBuf,
    roles: Vec<Role>,
    /// Part before the number in the names of this ring's holders in topics.
    topic_prefix: String,
    certificate_end: SystemTime,
    /// Text that was read and understood last. Times of files would not do: two changes within their resolution look like one.
    read: Mutex<String>,
    holders: Mutex<Vec<Holder>>,
    /// Number of changes.
    changes: watch::Sender<u64>,
    /// Number of failures to read the list since it was last read.
    failures: AtomicU64,
    /// Number of messages of cameras that were left out.
    left_out: AtomicU64,
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

    /// Reads the list, and takes it over if it has changed. A list that cannot be read is tried again the next time.
    fn reload(&self) {
        let mut read = lock(&self.read);
        let changed = read_list_text(&self.folder).and_then(|text| {
            let is_new = text != *read;
            is_new.then(|| parse_holders(&self.folder, &text).map(|holders| (text, holders))).transpose()
        });
        match changed {
            Ok(changed) => {
                self.failures.store(0, Ordering::Relaxed);
                let Some((text, holders)) = changed else { return };
                *read = text;
                *lock(&self.holders) = holders;
                self.changes.send_modify(|count| *count += 1);
            }
            Err(error) => {
                let count = self.failures.fetch_add(1, Ordering::Relaxed) + 1;
                if count.is_power_of_two() {
                    tracing::warn!("keys: the list cannot be read and stays as it was ({count} times so far): {error}");
                }
            }
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

/// Reloads the list periodically, and logs the ends of keys that are near.
async fn follow(list: &List) {
    let mut ends = EndWatch::default();
    for turn in 0u64.. {
        sleep(CHECK_EVERY).await;
        list.reload();
        if turn % CHECKS_OF_ENDS == 0 {
            let of_gate = |holder: &&Holder| list.roles.contains(&holder.role);
            let holders: Vec<Holder> = lock(&list.holders).iter().filter(of_gate).cloned().collect();
            let due = ends.due(&holders, Some(list.certificate_end), SystemTime::now());
            due.iter().for_each(|line| tracing::warn!("{line}"));
        }
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
    if holder.role == Role::Cameras && holder.cameras.is_empty() {
        tracing::warn!(
            "keys: {who} may send every camera, since its key names none; revoke it, and add it with --camera"
        );
    }
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
