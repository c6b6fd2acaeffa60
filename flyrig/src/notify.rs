//! systemd is told that the rig is ready and alive (`Type=notify`); without systemd nothing happens.

/// The socket of the service manager, if there is one.
pub struct ServiceManager {
    #[cfg(target_os = "linux")]
    socket: Option<(std::os::unix::net::UnixDatagram, std::os::unix::net::SocketAddr)>,
}

impl ServiceManager {
    /// From `$NOTIFY_SOCKET`.
    #[cfg(target_os = "linux")]
    pub fn from_env() -> Self {
        let socket = std::env::var("NOTIFY_SOCKET").ok().and_then(|address| Self::connect(&address));
        Self { socket }
    }

    #[cfg(target_os = "linux")]
    fn connect(address: &str) -> Option<(std::os::unix::net::UnixDatagram, std::os::unix::net::SocketAddr)> {
        use std::os::{
            linux::net::SocketAddrExt as _,
            unix::net::{SocketAddr, UnixDatagram},
        };
        let to = match address.strip_prefix('@') {
            Some(name) => SocketAddr::from_abstract_name(name),
            None => SocketAddr::from_pathname(address),
        };
        let socket = UnixDatagram::unbound().ok()?;
        socket.set_nonblocking(true).ok()?;
        Some((socket, to.ok()?))
    }

    /// Tells a state, like `READY=1`. A manager that does not listen must not hold the rig up.
    #[cfg(target_os = "linux")]
    pub fn tell(&self, state: &str) {
        if let Some((socket, to)) = &self.socket
            && let Err(error) = socket.send_to_addr(state.as_bytes(), to)
        {
            tracing::debug!("the service manager was not told {state}: {error}");
        }
    }

    /// Only Linux has systemd.
    #[cfg(not(target_os = "linux"))]
    pub fn from_env() -> Self {
        Self {}
    }

    /// Only Linux has systemd.
    #[cfg(not(target_os = "linux"))]
    pub fn tell(&self, _state: &str) {}
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::os::unix::net::UnixDatagram;

    use super::*;

    #[test]
    fn states_arrive_at_the_socket() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let manager = UnixDatagram::bind(&path).unwrap();
        let service = ServiceManager { socket: ServiceManager::connect(path.to_str().unwrap()) };
        service.tell("READY=1");
        let mut bytes = [0; 64];
        let length = manager.recv(&mut bytes).unwrap();
        assert_eq!(&bytes[..length], b"READY=1");
        drop(manager);
        service.tell("WATCHDOG=1");
        ServiceManager { socket: None }.tell("READY=1");
    }

    #[test]
    fn the_service_file_starts_what_there_is() {
        use clap::Parser as _;
        let service = include_str!("../../packaging/flyrig.service");
        let start = service.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let cli = crate::cli::Cli::try_parse_from(start.split_whitespace()).unwrap();
        assert!(matches!(cli.command, crate::cli::Command::Run { .. }));
        assert!(service.contains("Type=notify") && service.contains("WatchdogSec="));
    }
}
