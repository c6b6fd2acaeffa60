//! HTTPS: certificate of the page's server.

use std::{
    io::Write as _,
    net::{IpAddr, SocketAddr},
    path::Path,
    sync::Arc,
};

use rcgen::{CertificateParams, KeyPair, date_time_ymd};
use rustls_pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _};
use tokio_rustls::{TlsAcceptor, rustls};

use crate::{config::WebConfig, error::WebError};

/// Largest certificate or key file, bytes.
const MOST_BYTES: u64 = 1 << 20;
/// First and last year of a self-signed certificate, which is never renewed.
const YEARS: (i32, i32) = (2020, 2045);

/// TLS acceptor, and the fingerprint that browsers show of its certificate.
pub(crate) struct Tls {
    pub acceptor: TlsAcceptor,
    /// SHA-256 of the certificate, as browsers write it.
    pub fingerprint: String,
}

impl Tls {
    /// Reads certificate and key, or creates a self-signed certificate: in the files that the settings name, so that browsers need to accept
    /// it only once, or for this run.
    ///
    /// # Errors
    /// [`WebError::Certificate`] names the file and the fix.
    pub fn new(config: &WebConfig, address: SocketAddr) -> Result<Self, WebError> {
        let (certificate, key) = match (config.certificate.as_os_str().is_empty(), config.key.as_os_str().is_empty()) {
            (true, true) => self_signed(config, address)?,
            (false, false) => {
                let missing = [&config.certificate, &config.key].map(|file| !file.exists());
                match missing {
                    [false, false] => (read(&config.certificate)?, read(&config.key)?),
                    [true, true] => {
                        let made = self_signed(config, address)?;
                        write_new(&config.key, &made.1, true)?;
                        // A key without its certificate would be refused the next time.
                        write_new(&config.certificate, &made.0, false)
                            .inspect_err(|_| drop(std::fs::remove_file(&config.key)))?;
                        made
                    }
                    [is_certificate, _] => {
                        let file = if is_certificate { &config.certificate } else { &config.key };
                        return Err(refused(file, "is missing; give both files of a pair, or neither for a new one"));
                    }
                }
            }
            _ => {
                let problem = "web.certificate and web.key belong together; give both, or neither";
                return Err(WebError::Config(problem.to_owned()));
            }
        };
        let bad = |file: &Path, problem: String| {
            if file.as_os_str().is_empty() { WebError::Start(problem) } else { refused(file, &problem) }
        };
        let chain: Vec<CertificateDer<'static>> = CertificateDer::pem_slice_iter(certificate.as_bytes())
            .collect::<Result<_, _>>()
            .map_err(|error| bad(&config.certificate, format!("is no certificate in PEM ({error})")))?;
        let Some(first) = chain.first() else {
            return Err(bad(&config.certificate, "holds no certificate in PEM".to_owned()));
        };
        let digest = ring::digest::digest(&ring::digest::SHA256, first);
        let fingerprint = digest.as_ref().iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(":");
        let key = PrivateKeyDer::from_pem_slice(key.as_bytes())
            .map_err(|error| bad(&config.key, format!("is no private key in PEM ({error})")))?;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut settings = rustls::ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| WebError::Start(error.to_string()))?
            .with_no_client_auth()
            .with_single_cert(chain, key)
            .map_err(|error| bad(&config.key, format!("does not fit the certificate ({error})")))?;
        settings.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self { acceptor: TlsAcceptor::from(Arc::new(settings)), fingerprint })
    }
}

/// Creates a certificate for this computer's names, and its key, PEM.
fn self_signed(config: &WebConfig, address: SocketAddr) -> Result<(String, String), WebError> {
    let failed = |error: rcgen::Error| WebError::Start(format!("no certificate can be made ({error})"));
    let own = [IpAddr::from([127, 0, 0, 1]), address.ip()].map(|ip| ip.to_string());
    let mut names = vec!["localhost".to_owned()];
    names.extend(own.into_iter().chain(config.names.iter().cloned()));
    names.dedup();
    let key = KeyPair::generate().map_err(failed)?;
    let mut parameters = CertificateParams::new(names).map_err(failed)?;
    (parameters.not_before, parameters.not_after) = (date_time_ymd(YEARS.0, 1, 1), date_time_ymd(YEARS.1, 1, 1));
    parameters.distinguished_name.push(rcgen::DnType::CommonName, "flyrig");
    let certificate = parameters.self_signed(&key).map_err(failed)?;
    Ok((certificate.pem(), key.serialize_pem()))
}

fn refused(file: &Path, problem: &str) -> WebError {
    WebError::Certificate { file: file.to_owned(), problem: problem.to_owned() }
}

fn read(file: &Path) -> Result<String, WebError> {
    let of = |error: std::io::Error| refused(file, &format!("cannot be read ({error})"));
    if std::fs::metadata(file).map_err(of)?.len() > MOST_BYTES {
        return Err(refused(file, "is too large for a certificate or a key"));
    }
    std::fs::read_to_string(file).map_err(of)
}

/// Writes a new file; a secret one is for its owner alone.
fn write_new(file: &Path, text: &str, is_secret: bool) -> Result<(), WebError> {
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, if is_secret { 0o600 } else { 0o644 });
    let written = options
        .open(file)
        .and_then(|mut out| out.write_all(text.as_bytes()).inspect_err(|_| drop(std::fs::remove_file(file))));
    written.map_err(|error| refused(file, &format!("cannot be written ({error})")))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn config(folder: &Path) -> WebConfig {
        WebConfig { certificate: folder.join("cert.pem"), key: folder.join("key.pem"), ..WebConfig::default() }
    }

    fn start(config: &WebConfig) -> Result<Tls, String> {
        Tls::new(config, SocketAddr::from(([0, 0, 0, 0], 8443))).map_err(|error| error.to_string())
    }

    #[test]
    fn a_certificate_is_made_once_and_kept() {
        let folder = tempfile::tempdir().unwrap();
        let config = config(folder.path());
        let made = start(&config).unwrap();
        assert_eq!(made.fingerprint.len(), 95);
        assert_eq!(start(&config).unwrap().fingerprint, made.fingerprint, "browsers know it");
        assert_ne!(start(&WebConfig::default()).unwrap().fingerprint, made.fingerprint, "one for this run alone");
        #[cfg(unix)]
        {
            let mode = std::fs::metadata(&config.key).unwrap().permissions();
            assert_eq!(std::os::unix::fs::PermissionsExt::mode(&mode) & 0o777, 0o600);
        }
    }

    #[test]
    fn wrong_files_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let (one, other) = (config(folder.path()), WebConfig::default());
        let half = WebConfig { key: Default::default(), ..one.clone() };
        assert!(start(&half).err().unwrap().contains("web.certificate and web.key belong together"));
        start(&one).unwrap();
        let other_key = self_signed(&other, SocketAddr::from(([127, 0, 0, 1], 1))).unwrap().1;
        for (key, words) in [(other_key.as_str(), "key.pem: does not fit"), ("text", "key.pem: is no private key")] {
            std::fs::write(&one.key, key).unwrap();
            let error = start(&one).err().unwrap();
            assert!(error.contains(words), "{error}");
        }
        std::fs::write(&one.certificate, "").unwrap();
        assert!(start(&one).err().unwrap().contains("cert.pem: holds no certificate"));
        std::fs::remove_file(&one.certificate).unwrap();
        assert!(start(&one).err().unwrap().contains("cert.pem: is missing"));
        std::fs::remove_file(&one.key).unwrap();
        let nowhere = config(&folder.path().join("none"));
        assert!(start(&nowhere).err().unwrap().contains("key.pem: cannot be written"));
        // Nothing is left of half a pair.
        let split = WebConfig { certificate: folder.path().join("none/cert.pem"), ..one };
        assert!(start(&split).err().unwrap().contains("cert.pem: cannot be written") && !split.key.exists());
    }
}
