//! Names and addresses by which other computers reach a rig.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use crate::error::AccessError;

/// Largest number of hosts: a key file holds no more.
pub(crate) const MAX_HOSTS: usize = 64;

/// Returns the hosts as certificates and key files state them: addresses without brackets.
///
/// # Errors
/// [`AccessError::Request`] names the host that is not usable.
pub(crate) fn check_hosts(hosts: &[String]) -> Result<Vec<String>, AccessError> {
    if hosts.is_empty() {
        return Err(AccessError::Request(
            "a ring needs a name or address by which other computers reach the rig; give --host".to_owned(),
        ));
    }
    if hosts.len() > MAX_HOSTS {
        return Err(AccessError::Request(format!("--host: {} are too many; give at most {MAX_HOSTS}", hosts.len())));
    }
    hosts.iter().map(|host| check_host(host)).collect()
}

fn check_host(host: &str) -> Result<String, AccessError> {
    let bad = |why: &str| {
        let shown: String = host.chars().take(100).flat_map(char::escape_debug).collect();
        AccessError::Request(format!("--host {shown}: {why}"))
    };
    let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    let (address, zone) = bare.split_once('%').map_or((bare, None), |(address, zone)| (address, Some(zone)));
    if let Ok(address) = address.parse::<IpAddr>() {
        let is_local = matches!(address, IpAddr::V6(v6) if v6.is_unicast_link_local());
        if is_local || zone.is_some() {
            return Err(bad(
                "other computers cannot use a link-local address or a zone, which name a network interface of one \
                 computer; give a name, or an address such as fd00::5",
            ));
        }
        if address.is_unspecified() || address.is_multicast() {
            return Err(bad("no computer is reached at this address; give this computer's own name or address"));
        }
        return Ok(address.to_string());
    }
    let is_name =
        (1..=253).contains(&bare.len()) && bare.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.".contains(&b));
    if is_name && bare == host {
        return Ok(host.to_owned());
    }
    Err(bad("give a name or address without a port, such as rig.local, 10.0.0.5 or fd00::5"))
}

/// Returns the address to listen on for these hosts: all addresses of the computer, those of IPv6 as well if a host is one.
pub(crate) fn listen_address(hosts: &[String], port: u16) -> SocketAddr {
    let is_v6 = |host: &String| host.parse::<Ipv6Addr>().is_ok();
    match hosts.iter().any(is_v6) {
        true => (Ipv6Addr::UNSPECIFIED, port).into(),
        false => (Ipv4Addr::UNSPECIFIED, port).into(),
    }
}

/// Returns `HOST:PORT`, IPv6 addresses in brackets.
pub(crate) fn host_and_port(host: &str, port: u16) -> String {
    if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
}
