//! Issuing of certificates.

use std::time::Duration;

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
    date_time_ymd,
};

use crate::error::AccessError;

/// Seconds before its issue from which a certificate is valid: clocks of computers differ.
const EARLY_SECS: u64 = 86_400;

/// Certificate and private key, PEM.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CertificatePair {
    pub certificate: String,
    pub key: String,
}

/// TlsSide of a connection that a certificate is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TlsSide {
    Server,
    Client,
}

/// Authority that signs certificates.
pub(crate) struct Authority {
    issuer: Issuer<'static, KeyPair>,
    /// Certificate of the authority, PEM.
    pub certificate: String,
}

fn parameters(name: &str, hosts: &[String], valid_secs: (u64, u64)) -> Result<CertificateParams, AccessError> {
    let mut parameters = CertificateParams::new(hosts).map_err(AccessError::system)?;
    let epoch = date_time_ymd(1970, 1, 1);
    parameters.not_before = epoch + Duration::from_secs(valid_secs.0.saturating_sub(EARLY_SECS));
    parameters.not_after = epoch + Duration::from_secs(valid_secs.1);
    parameters.distinguished_name.push(DnType::CommonName, name);
    Ok(parameters)
}

fn authority_parameters(name: &str, valid_secs: (u64, u64)) -> Result<CertificateParams, AccessError> {
    let mut parameters = parameters(name, &[], valid_secs)?;
    parameters.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    parameters.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    Ok(parameters)
}

impl Authority {
    /// Creates an authority; also returns its private key, PEM. Validity is in seconds since 1970.
    pub fn new(name: &str, valid_secs: (u64, u64)) -> Result<(Self, String), AccessError> {
        let key = KeyPair::generate().map_err(AccessError::system)?;
        let parameters = authority_parameters(name, valid_secs)?;
        let certificate = parameters.self_signed(&key).map_err(AccessError::system)?.pem();
        let secret = key.serialize_pem();
        Ok((Self { issuer: Issuer::new(parameters, key), certificate }, secret))
    }

    /// Restores an authority that was created with this name.
    pub fn resume(name: &str, pair: CertificatePair) -> Result<Self, AccessError> {
        let key = KeyPair::from_pem(&pair.key).map_err(AccessError::system)?;
        // Only its name and key identifier go into what it signs.
        Ok(Self { issuer: Issuer::new(authority_parameters(name, (0, 0))?, key), certificate: pair.certificate })
    }

    /// Signs a new certificate; validity is in seconds since 1970.
    pub fn sign(
        &self,
        name: &str,
        hosts: &[String],
        side: TlsSide,
        valid_secs: (u64, u64),
    ) -> Result<CertificatePair, AccessError> {
        let key = KeyPair::generate().map_err(AccessError::system)?;
        let mut parameters = parameters(name, hosts, valid_secs)?;
        parameters.use_authority_key_identifier_extension = true;
        parameters.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        // A holder's certificate must not pass for the rig's.
        parameters.extended_key_usages = vec![match side {
            TlsSide::Server => ExtendedKeyUsagePurpose::ServerAuth,
            TlsSide::Client => ExtendedKeyUsagePurpose::ClientAuth,
        }];
        let certificate = parameters.signed_by(&key, &self.issuer).map_err(AccessError::system)?;
        Ok(CertificatePair { certificate: certificate.pem(), key: key.serialize_pem() })
    }
}
