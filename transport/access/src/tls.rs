//! TLS settings of both sides.

use std::sync::Arc;

use rustls_pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _};
use tokio_rustls::rustls::{
    ClientConfig, RootCertStore, ServerConfig,
    crypto::{CryptoProvider, ring},
    server::{WebPkiClientVerifier, danger::ClientCertVerifier},
    version::TLS13,
};

/// Returns the cryptography of all connections.
pub(crate) fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

fn roots(authority: &str) -> Result<Arc<RootCertStore>, String> {
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_slice_iter(authority.as_bytes()) {
        let certificate = certificate.map_err(|error| format!("authority: {error}"))?;
        roots.add(certificate).map_err(|error| format!("authority: {error}"))?;
    }
    if roots.is_empty() { Err("authority: no certificate".to_owned()) } else { Ok(Arc::new(roots)) }
}

fn pair(certificate: &str, key: &str) -> Result<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>), String> {
    let chain = CertificateDer::pem_slice_iter(certificate.as_bytes()).collect::<Result<Vec<_>, _>>();
    let chain = chain.map_err(|error| format!("certificate: {error}"))?;
    if chain.is_empty() {
        return Err("certificate: none".to_owned());
    }
    let key = PrivateKeyDer::from_pem_slice(key.as_bytes()).map_err(|error| format!("private key: {error}"))?;
    Ok((chain, key))
}

/// Returns the settings of a client that trusts this authority alone.
pub(crate) fn client(authority: &str, certificate: &str, key: &str) -> Result<ClientConfig, String> {
    let (chain, key) = pair(certificate, key)?;
    ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&TLS13])
        .map_err(|error| error.to_string())?
        .with_root_certificates(roots(authority)?)
        .with_client_auth_cert(chain, key)
        .map_err(|error| format!("private key: {error}"))
}

/// Returns a verifier of client certificates signed by this authority.
pub(crate) fn client_verifier(authority: &str) -> Result<Arc<dyn ClientCertVerifier>, String> {
    WebPkiClientVerifier::builder_with_provider(roots(authority)?, provider())
        .build()
        .map_err(|error| error.to_string())
}

/// Returns the settings of a server whose clients `verifier` checks.
pub(crate) fn server(
    verifier: Arc<dyn ClientCertVerifier>,
    certificate: &str,
    key: &str,
) -> Result<ServerConfig, String> {
    let (chain, key) = pair(certificate, key)?;
    let mut config = ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&TLS13])
        .map_err(|error| error.to_string())?
        .with_client_cert_verifier(verifier)
        .with_single_cert(chain, key)
        .map_err(|error| format!("private key: {error}"))?;
    // A ticket would admit a holder again without its certificate.
    config.send_tls13_tickets = 0;
    Ok(config)
}
