//! Settings of the page's server.

use std::{net::SocketAddr, path::PathBuf};

use clap::{
    Args,
    builder::{OsStringValueParser, TypedValueParser as _},
};
use serde::{Deserialize, Serialize};

use crate::error::WebError;

/// Range of the largest number of browsers.
const BROWSERS: std::ops::RangeInclusive<usize> = 1..=256;

/// Settings of the web page for browsers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Args)]
#[serde(deny_unknown_fields, default)]
pub struct WebConfig {
    /// Address of the page; port 0 takes a free port.
    #[arg(long, default_value = "127.0.0.1:8080", value_parser = checked_address)]
    pub listen: String,
    /// Listen where other computers reach the page without encryption (HTTPS); viewers need the link with its token all the same.
    #[arg(long)]
    pub insecure: bool,
    /// Certificate of the page, PEM, instead of one for this run; created together with its key where both files are missing.
    // The parser of paths refuses an empty default.
    #[arg(long, value_name = "FILE", default_value = "", hide_default_value = true,
        value_parser = OsStringValueParser::new().map(PathBuf::from))]
    pub certificate: PathBuf,
    /// Private key of the certificate, PEM.
    #[arg(long, value_name = "FILE", default_value = "", hide_default_value = true,
        value_parser = OsStringValueParser::new().map(PathBuf::from))]
    pub key: PathBuf,
    /// Name by which browsers reach this computer, besides its addresses and localhost; may be given repeatedly.
    #[arg(long = "name", value_name = "NAME")]
    pub names: Vec<String>,
    /// Largest number of browsers at a time.
    #[arg(long, default_value_t = Self::default().max_browsers)]
    pub max_browsers: usize,
}

impl Default for WebConfig {
    /// Returns settings without an address, which serve no page.
    fn default() -> Self {
        Self {
            listen: String::new(),
            insecure: false,
            certificate: PathBuf::new(),
            key: PathBuf::new(),
            names: Vec::new(),
            max_browsers: 32,
        }
    }
}

impl WebConfig {
    /// Checks every field; an empty address means no page.
    ///
    /// # Errors
    /// [`WebError::Config`] names the field and its valid values.
    pub fn validate(&self) -> Result<(), WebError> {
        if !self.listen.is_empty() {
            self.address()?;
        }
        if BROWSERS.contains(&self.max_browsers) {
            return Ok(());
        }
        let (least, most) = (BROWSERS.start(), BROWSERS.end());
        Err(WebError::Config(format!("web.max_browsers is {}, it must be in {least}..={most}", self.max_browsers)))
    }

    /// Returns the address to listen on.
    pub(crate) fn address(&self) -> Result<SocketAddr, WebError> {
        parse_address(&self.listen).map_err(|problem| WebError::Config(format!("web.listen: {problem}")))
    }
}

fn parse_address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| format!("'{text}' is no address and port, such as 127.0.0.1:8080"))
}

fn checked_address(text: &str) -> Result<String, String> {
    parse_address(text).map(|_| text.to_owned())
}
