//! JSON payloads: every one states its schema version.

use serde::{Deserialize, Serialize};

use crate::{error::TransportError, schema::SCHEMA_VERSION};

/// Largest JSON payload that is read, bytes.
pub(crate) const MAX_JSON_BYTES: usize = 1 << 18;

/// Message with its version first, so that a reader can check it before it parses the rest.
#[derive(Serialize)]
struct Versioned<'a, T> {
    schema_version: u16,
    #[serde(flatten)]
    body: &'a T,
}

#[derive(Deserialize)]
struct VersionOnly {
    schema_version: u64,
}

/// Encodes a message as JSON with its schema version.
pub(crate) fn to_json<T: Serialize>(topic: &str, body: &T) -> Result<Vec<u8>, TransportError> {
    let bytes = serde_json::to_vec(&Versioned { schema_version: SCHEMA_VERSION, body })
        .map_err(|error| TransportError::config(topic, error.to_string()))?;
    if bytes.len() > MAX_JSON_BYTES {
        return Err(TransportError::config(topic, format!("{} bytes of JSON, at most {MAX_JSON_BYTES}", bytes.len())));
    }
    Ok(bytes)
}

/// Decodes a message from JSON of this schema version.
pub(crate) fn from_json<T: serde::de::DeserializeOwned>(topic: &str, bytes: &[u8]) -> Result<T, TransportError> {
    if bytes.len() > MAX_JSON_BYTES {
        let len = bytes.len();
        return Err(TransportError::malformed(topic, format!("{len} bytes of JSON, at most {MAX_JSON_BYTES}")));
    }
    let refuse = |error: serde_json::Error| TransportError::malformed(topic, error.to_string());
    let version: VersionOnly = serde_json::from_slice(bytes).map_err(refuse)?;
    if version.schema_version != u64::from(SCHEMA_VERSION) {
        return Err(TransportError::version(topic, version.schema_version));
    }
    serde_json::from_slice(bytes).map_err(refuse)
}
