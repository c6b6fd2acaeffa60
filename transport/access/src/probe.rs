//! Diagnosis why a rig rejects a key.

use std::{
    io::{ErrorKind, Read as _, Write as _},
    net::{TcpStream, ToSocketAddrs as _},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread::{Builder, JoinHandle, park_timeout},
    time::Duration,
};

use flyrig_types::lock;

use rustls_pki_types::ServerName;
use tokio_rustls::rustls::{AlertDescription, CertificateError, ClientConnection, Error as TlsError, Stream};

use crate::{error::AccessError, key_file::KeyFile, role::Role, tls};

/// Time limit of an answer of the rig.
const PATIENCE: Duration = Duration::from_secs(3);
/// Time after the handshake within which a refusal arrives; silence admits.
const SILENCE: Duration = Duration::from_millis(1000);
/// Interval between two attempts.
const EVERY: Duration = Duration::from_secs(2);

impl KeyFile {
    /// Tries the key: connects to the rig's addresses in turn, shows the key, and disconnects.
    ///
    /// # Errors
    /// [`AccessError::Refused`] with the reason at the last address, when none admits the key.
    pub fn knock(&self) -> Result<(), AccessError> {
        let mut why = "the key names no address".to_owned();
        for address in &self.connect {
            match self.knock_at(address) {
                Ok(()) => return Ok(()),
                Err(problem) => why = problem,
            }
        }
        Err(AccessError::Refused(why))
    }

    /// Returns the first address where the rig admits the key, otherwise the first of all. Connects only where there are several.
    #[must_use]
    pub fn address(&self) -> &str {
        let all = self.connect.as_slice();
        let admits = |address: &&String| all.len() > 1 && self.knock_at(address).is_ok();
        all.iter().find(admits).or(all.first()).map_or("", String::as_str)
    }

    fn knock_at(&self, address: &str) -> Result<(), String> {
        let rig = &self.rig;
        let config = tls::client(&self.authority, &self.certificate, &self.private_key)?;
        let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
        let name = ServerName::try_from(host.to_owned()).map_err(|_| format!("{address} is no address"))?;
        let known: Vec<_> =
            address.to_socket_addrs().map_err(|error| format!("{address} is not known here ({error})"))?.collect();
        let mut stream = None;
        let mut problem = format!("{address} is not known here");
        for at in known {
            match TcpStream::connect_timeout(&at, PATIENCE) {
                Ok(connected) => {
                    stream = Some(connected);
                    break;
                }
                Err(error) => {
                    let source = if self.role == Role::Cameras { " and source.kind = \"network\"" } else { "" };
                    problem = format!(
                        "no rig answers at {address} ({error}); is `flyrig run` up there, with transport.keys{source}?"
                    );
                }
            }
        }
        let Some(mut stream) = stream else { return Err(problem) };
        let of = |error: std::io::Error| self.explain(address, &error);
        stream.set_read_timeout(Some(PATIENCE)).map_err(of)?;
        stream.set_write_timeout(Some(PATIENCE)).map_err(of)?;
        let mut connection = ClientConnection::new(Arc::new(config), name).map_err(|error| error.to_string())?;
        while connection.is_handshaking() {
            connection.complete_io(&mut stream).map_err(of)?;
        }
        stream.set_read_timeout(Some(SILENCE)).map_err(of)?;
        let mut tls = Stream::new(&mut connection, &mut stream);
        tls.flush().map_err(of)?;
        match tls.read(&mut [0]) {
            // The server is silent until its client writes.
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => Ok(()),
            Ok(0) => Err(format!("the rig '{rig}' at {address} hung up; try again")),
            Ok(_) => Ok(()),
            Err(error) => Err(of(error)),
        }
    }

    /// Explains a failed connection and the fix.
    fn explain(&self, address: &str, error: &std::io::Error) -> String {
        let Self { rig, holder, expires, .. } = self;
        let tls = error.get_ref().and_then(|inner| inner.downcast_ref::<TlsError>());
        let refuses = format!("the rig '{rig}' refuses the key of '{holder}'");
        match tls {
            Some(TlsError::AlertReceived(alert)) => match alert {
                AlertDescription::CertificateRevoked => {
                    format!("{refuses}: it was revoked or renewed; ask for the new one (`flyrig keys add` or `renew`)")
                }
                AlertDescription::CertificateExpired => {
                    format!("{refuses}: it expired on {expires}; ask for a new one (`flyrig keys renew {holder}`)")
                }
                AlertDescription::AccessDenied => {
                    format!("{refuses}: a key of role {} has another port than {address}", self.role.name())
                }
                AlertDescription::UnknownCA | AlertDescription::BadCertificate | AlertDescription::DecryptError => {
                    format!("{refuses}: it is of another rig")
                }
                other => format!("{refuses} ({other:?})"),
            },
            Some(TlsError::InvalidCertificate(reason)) => match reason {
                CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => format!(
                    "the certificate of the rig '{rig}' is for other names than that of {address}; make its keys with `flyrig keys new --host NAME`"
                ),
                CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
                    format!("the certificate of the rig '{rig}' has expired; compare the clocks, or make new keys")
                }
                CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
                    format!("the certificate of the rig '{rig}' is not valid yet; compare the computers' clocks")
                }
                _ => format!("{address} is not the rig '{rig}': its certificate is signed by another authority"),
            },
            Some(other) => format!("{address} does not speak as a rig with keys does ({other})"),
            None if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                format!("{address} does not answer")
            }
            None => format!("{address} hung up ({error}); is it a rig with keys?"),
        }
    }
}

/// Thread that tries a key repeatedly while there is no connection, to report why.
#[derive(Debug)]
pub struct KeyProbe {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    trouble: Mutex<Option<String>>,
    stop: AtomicBool,
}

impl KeyProbe {
    /// Starts the thread, which is idle while `is_connected`.
    ///
    /// # Errors
    /// [`AccessError::System`] when no thread can be started.
    pub fn start(key: KeyFile, is_connected: impl Fn() -> bool + Send + 'static) -> Result<Self, AccessError> {
        let shared = Arc::<Shared>::default();
        let of_thread = Arc::clone(&shared);
        let work = move || {
            while !of_thread.stop.load(Ordering::Relaxed) {
                let trouble = if is_connected() { None } else { key.knock().err().map(|error| error.to_string()) };
                *lock(&of_thread.trouble) = trouble;
                park_timeout(EVERY);
            }
        };
        let thread = Builder::new().name("flyrig-probe".to_owned()).spawn(work).map_err(AccessError::system)?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Returns why the rig rejects the key or cannot be reached; `None` once it accepts the key, and before the first answer.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        lock(&self.shared.trouble).clone()
    }
}

impl Drop for KeyProbe {
    /// Ends the thread, without waiting for an attempt under way.
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
        }
    }
}
