//! Admission of requests: names of this computer, pages of this server, tokens of links.

use std::net::IpAddr;

use hyper::{
    HeaderMap,
    header::{HOST, HeaderValue, ORIGIN},
};

/// Length of a token, bytes.
const TOKEN_BYTES: usize = 16;

/// Secret of the page's link, behind `#`.
#[derive(Debug, Clone)]
pub(crate) struct Token(Option<String>);

impl Token {
    /// Token of a page that is open to all.
    pub const NONE: Self = Self(None);

    /// Creates a secret of 128 random bits.
    pub fn random() -> Result<Self, getrandom::Error> {
        let mut bytes = [0u8; TOKEN_BYTES];
        getrandom::fill(&mut bytes)?;
        Ok(Self(Some(bytes.iter().map(|byte| format!("{byte:02x}")).collect())))
    }

    /// Returns the fragment of the link.
    pub fn fragment(&self) -> String {
        self.0.as_ref().map_or_else(String::new, |token| format!("#{token}"))
    }

    /// Compares a token in a time that does not depend on where it differs.
    pub fn admits(&self, given: &str) -> bool {
        let Some(token) = &self.0 else { return true };
        let differs = token.bytes().zip(given.bytes()).fold(0u8, |differs, (a, b)| differs | (a ^ b));
        token.len() == given.len() && differs == 0
    }
}

/// Checks host and origin in the headers of a request; the error is shown to the client.
///
/// A page of another site cannot read the answers of this server, but it could open a WebSocket, or make a name of its own resolve to this
/// address. So the host must be an address, `localhost` or a configured name, and the origin must be that host with the server's scheme.
pub(crate) fn check_names(headers: &HeaderMap, scheme: &str, names: &[String]) -> Result<(), String> {
    let text = |value: &HeaderValue| value.to_str().map(str::to_owned).unwrap_or_default();
    let host = headers.get(HOST).map(text).unwrap_or_default();
    let name = host_name(&host);
    let is_address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>().is_ok();
    if !(is_address || name.eq_ignore_ascii_case("localhost") || names.iter().any(|own| own.eq_ignore_ascii_case(name)))
    {
        return Err(format!(
            "this server is not known as '{}'; start it with --name, or use its address\n",
            printable(name)
        ));
    }
    match headers.get(ORIGIN).map(text) {
        None => Ok(()),
        Some(origin) if origin.eq_ignore_ascii_case(&format!("{scheme}://{host}")) => Ok(()),
        Some(origin) => Err(format!("pages of {} may not watch\n", printable(&origin))),
    }
}

/// Returns a host without its port.
fn host_name(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    }
}

/// Returns the beginning of a text, without control characters.
fn printable(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(80).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn only_own_names_and_own_pages_pass() {
        let check = |host: &str, origin: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(HOST, host.parse().unwrap());
            if !origin.is_empty() {
                headers.insert(ORIGIN, origin.parse().unwrap());
            }
            check_names(&headers, "http", &["rig.local".to_owned()])
        };
        for (host, origin) in [
            ("127.0.0.1:8080", ""),
            ("127.0.0.1:8080", "http://127.0.0.1:8080"),
            ("localhost:8080", "http://localhost:8080"),
            ("[::1]:8080", "http://[::1]:8080"),
            ("[::1]", ""),
            ("Rig.local:80", "http://rig.local:80"),
        ] {
            assert_eq!(check(host, origin), Ok(()), "{host} {origin}");
        }
        for (host, origin) in [
            ("evil.example:8080", ""),
            ("evil.example", "http://evil.example"),
            ("127.0.0.1:8080", "http://evil.example"),
            ("127.0.0.1:8080", "http://127.0.0.1:8081"),
            ("127.0.0.1:8080", "https://127.0.0.1:8080"),
            ("localhost:8080", "null"),
            ("", ""),
            ("127.0.0.1.evil.example", ""),
        ] {
            assert!(check(host, origin).is_err(), "{host} {origin}");
        }
        assert!(check_names(&HeaderMap::new(), "http", &[]).is_err());
        let mut headers = HeaderMap::new();
        headers.insert(HOST, "127.0.0.1:8443".parse().unwrap());
        headers.insert(ORIGIN, "https://127.0.0.1:8443".parse().unwrap());
        assert_eq!(check_names(&headers, "https", &[]), Ok(()));
        assert!(check_names(&headers, "http", &[]).is_err(), "another scheme is another site");
    }

    #[test]
    fn a_token_admits_itself_alone() {
        let (token, other) = (Token::random().unwrap(), Token::random().unwrap());
        let text = token.fragment()[1..].to_owned();
        assert_eq!(text.len(), 32);
        assert!(token.admits(&text) && !other.admits(&text));
        assert!(!token.admits("") && !token.admits(&text[1..]) && !token.admits(&format!("{text}0")));
        assert!(Token::NONE.admits("") && Token::NONE.admits("anything") && Token::NONE.fragment().is_empty());
    }
}
