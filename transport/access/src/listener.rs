//! TCP listener with bounds, shared by the gate, the web page and the metrics page.
//!
//! One thread accepts connections and serves them as tasks. A connection beyond [`Bounds::connections`], or beyond the file descriptors
//! that the rest of the process needs ([`crate::open_files`]), takes the place of one that is not established ([`crate::places`]); where
//! all are, it waits, or is disconnected for lack of a descriptor. Where [`Bounds::per_address`] is set, an address that begins too many
//! connections, or has too many handshakes under way, is disconnected at once ([`crate::limits`]); where all addresses together have too many, a
//! new handshake takes the place of one of the address that has the most.

use std::{
    future::{Future, pending},
    io::{Error, ErrorKind, Result},
    net::{IpAddr, SocketAddr, ToSocketAddrs},
    sync::{Arc, Mutex},
    thread::{Builder, JoinHandle},
    time::{Duration, Instant},
};

use flyrig_types::lock;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::{
    net::{TcpListener, TcpStream},
    runtime,
    sync::{OwnedSemaphorePermit, Semaphore, oneshot},
    time::sleep,
};

use crate::{
    limits::{Begin, Limits},
    open_files,
    places::{Places, make_room},
};

/// Pause after a connection could not be accepted: with no file descriptor left, an immediate retry only costs time.
const PAUSE: Duration = Duration::from_millis(100);
/// Connections that the system queues until they are accepted.
const BACKLOG: i32 = 1024;
/// Bytes that the system keeps per streaming connection, sent or not: enough for 20 Mbit/s with 200 ms. Linux doubles it.
const SEND_BUFFER: usize = 256 << 10;
/// Bytes of [`SEND_BUFFER`] that may be unsent: newer motion cannot overtake them.
#[cfg(target_os = "linux")]
const UNSENT: u32 = 4 << 10;

/// Bounds and socket options of a [`Listener`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Most connections served at a time; further ones end those that are not established.
    pub connections: usize,
    /// Whether connections are bounded per address until they are established.
    pub per_address: bool,
    /// Whether connections stream to viewers: small writes leave at once, and little waits unsent in the socket.
    pub is_streaming: bool,
}

/// Service behind a [`Listener`].
pub trait Serve: Send + Sync + 'static {
    /// Serves one connection until it ends.
    fn serve(self: Arc<Self>, connection: Connection) -> impl Future<Output = ()> + Send;

    /// Reports an address that was disconnected because it exceeds the bounds per address.
    fn refuse(&self, _address: IpAddr) {}

    /// Runs beside the connections; the listener ends when it returns.
    fn beside(&self) -> impl Future<Output = ()> + Send {
        pending()
    }
}

/// Connection that was accepted.
#[derive(Debug)]
pub struct Connection {
    /// The stream; it and the connection's place live independently.
    pub stream: TcpStream,
    /// Address of the other side.
    pub address: IpAddr,
    /// Place among the connections.
    pub place: ConnectionPlace,
}

/// Place of a connection among all of its listener, given back when it is dropped.
#[derive(Debug)]
pub struct ConnectionPlace {
    _permit: OwnedSemaphorePermit,
    number: u64,
    /// Places of the listener that may be taken away.
    places: Arc<Mutex<Places>>,
    /// Counts of the listener, while the connection is not established and counts by address.
    handshake: Option<(Arc<Mutex<Limits>>, IpAddr)>,
}

impl ConnectionPlace {
    /// Ends the handshake: the connection does not count against its address any more, and keeps its place.
    pub fn established(&mut self) {
        lock(&self.places).remove(self.number);
        if let Some((limits, address)) = self.handshake.take() {
            lock(&limits).end(address);
        }
    }
}

impl Drop for ConnectionPlace {
    fn drop(&mut self) {
        self.established();
    }
}

/// Address that is listened on, before connections are served.
#[derive(Debug)]
pub struct BoundListener {
    listener: std::net::TcpListener,
    address: SocketAddr,
    bounds: Bounds,
}

/// Serves connections on a thread of its own until it is dropped; open connections end with it.
#[derive(Debug)]
pub struct Listener {
    address: SocketAddr,
    /// Ends the thread when it is dropped.
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Listener {
    /// Listens on the first usable of these addresses; port 0 takes a free one. Connections wait until [`BoundListener::start`].
    ///
    /// # Errors
    /// Error of the operating system for the last address.
    pub fn bind(addresses: impl ToSocketAddrs, bounds: Bounds) -> Result<BoundListener> {
        let mut result = Err(Error::new(ErrorKind::InvalidInput, "no address to listen on"));
        for address in addresses.to_socket_addrs()? {
            result = listen(address, bounds);
            if result.is_ok() {
                break;
            }
        }
        let listener = result?;
        let address = listener.local_addr()?;
        Ok(BoundListener { listener, address, bounds })
    }

    /// Returns the address that is listened on.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl BoundListener {
    /// Returns the address that is listened on.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves connections on a thread of this name.
    ///
    /// # Errors
    /// When the system starts no thread or runtime.
    pub fn start(self, thread: &str, service: Arc<impl Serve>) -> Result<Listener> {
        self.start_with(thread, service, open_files::admit)
    }

    /// Serves connections that `admit` lets in; others only in place of those that are not established.
    fn start_with(
        self,
        thread: &str,
        service: Arc<impl Serve>,
        admit: impl Fn() -> bool + Send + 'static,
    ) -> Result<Listener> {
        let Self { listener, address, bounds } = self;
        let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
        let listener = {
            let _inside = runtime.enter();
            TcpListener::from_std(listener)?
        };
        let (stop, stopped) = oneshot::channel::<()>();
        let work = move || {
            runtime.block_on(async {
                tokio::select! {
                    () = accept(&listener, bounds, &service, admit) => {}
                    () = service.beside() => {}
                    _ = stopped => {}
                }
            });
            // Messages under way are dropped with their tasks.
            runtime.shutdown_timeout(PAUSE);
        };
        let thread = Builder::new().name(thread.to_owned()).spawn(work)?;
        Ok(Listener { address, stop: Some(stop), thread: Some(thread) })
    }
}

fn listen(address: SocketAddr, bounds: Bounds) -> Result<std::net::TcpListener> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, Some(Protocol::TCP))?;
    socket.set_reuse_address(cfg!(unix))?;
    if bounds.is_streaming {
        // Connections inherit it.
        socket.set_send_buffer_size(SEND_BUFFER)?;
    }
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    socket.set_nonblocking(true)?;
    Ok(socket.into())
}

async fn accept(listener: &TcpListener, bounds: Bounds, service: &Arc<impl Serve>, admit: impl Fn() -> bool) {
    let permits = Arc::new(Semaphore::new(bounds.connections));
    let limits = bounds.per_address.then(|| Arc::new(Mutex::new(Limits::default())));
    let places = Arc::<Mutex<Places>>::default();
    let mut refused = 0;
    for number in 0.. {
        let Ok((stream, address)) = listener.accept().await else {
            make_room(&places).await;
            sleep(PAUSE).await;
            continue;
        };
        let address = address.ip();
        if !admit() && !make_room(&places).await {
            refused += 1;
            // The 1st, 2nd, 4th ...: a flood must not fill the disk.
            if u64::is_power_of_two(refused) {
                tracing::warn!(
                    "{address} is not admitted ({refused} so far): too few file descriptors are left; raise the limit (ulimit -n)"
                );
            }
            continue;
        }
        if let Some(limits) = &limits {
            let begin = || lock(limits).begin(address, Instant::now());
            let mut begun = begin();
            // Silent handshakes of many addresses keep nobody out either.
            while begun == Begin::Full && make_room(&places).await {
                begun = begin();
            }
            if begun != Begin::Begun {
                service.refuse(address);
                continue;
            }
        }
        let handshake = limits.clone().map(|limits| (limits, address));
        let free = || Arc::clone(&permits).acquire_owned();
        let permit = tokio::select! {
            biased;
            permit = free() => permit,
            _ = make_room(&places) => free().await,
        };
        let Ok(permit) = permit else { return };
        if bounds.is_streaming {
            let _ = stream.set_nodelay(true);
            #[cfg(target_os = "linux")]
            let _ = socket2::SockRef::from(&stream).set_tcp_notsent_lowat(UNSENT);
        }
        let place = ConnectionPlace { _permit: permit, number, places: Arc::clone(&places), handshake };
        let task = tokio::spawn(Arc::clone(service).serve(Connection { stream, address, place }));
        // The task runs in this thread, so it has not ended yet.
        lock(&places).add(number, address, task.abort_handle());
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::{
        io::{Read as _, Write as _},
        net::{Ipv4Addr, TcpStream as Client},
    };

    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    /// Far longer than any answer takes.
    const PATIENCE: Duration = Duration::from_secs(60);

    /// Answers a byte with itself plus one, then holds the connection; counts refusals.
    #[derive(Default)]
    struct Echo(Mutex<usize>);

    impl Serve for Echo {
        async fn serve(self: Arc<Self>, mut connection: Connection) {
            let mut byte = [0];
            while connection.stream.read_exact(&mut byte).await.is_ok() {
                connection.place.established();
                let _ = connection.stream.write_all(&[byte[0] + 1]).await;
            }
        }

        fn refuse(&self, _address: IpAddr) {
            *self.0.lock().unwrap() += 1;
        }
    }

    fn start(connections: usize, per_address: bool) -> (Arc<Echo>, Listener) {
        start_with(connections, per_address, || true)
    }

    fn start_with(
        connections: usize,
        per_address: bool,
        admit: impl Fn() -> bool + Send + 'static,
    ) -> (Arc<Echo>, Listener) {
        let bounds = Bounds { connections, per_address, is_streaming: true };
        let service = Arc::<Echo>::default();
        let bound = Listener::bind((Ipv4Addr::LOCALHOST, 0), bounds).unwrap();
        let listener = bound.start_with("echo", Arc::clone(&service), admit).unwrap();
        (service, listener)
    }

    fn connect(listener: &Listener) -> Client {
        let client = Client::connect(listener.address()).unwrap();
        client.set_read_timeout(Some(PATIENCE)).unwrap();
        client
    }

    fn is_answered(client: &mut Client) -> bool {
        let mut byte = [0];
        client.write_all(&[7]).is_ok() && client.read_exact(&mut byte).is_ok() && byte == [8]
    }

    /// Returns whether the listener has ended a connection on which nothing was said.
    fn has_ended(client: &mut Client) -> bool {
        !matches!(client.read(&mut [0]), Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut))
    }

    #[test]
    fn silent_connections_make_room_for_new_ones() {
        let (_, listener) = start(3, false);
        let mut established = connect(&listener);
        assert!(is_answered(&mut established));
        let mut silent: Vec<Client> = (0..50).map(|_| connect(&listener)).collect();
        for _ in 0..20 {
            assert!(is_answered(&mut connect(&listener)));
        }
        assert!(silent[..48].iter_mut().all(has_ended), "the oldest ones make room");
        assert!(is_answered(&mut established), "one that is established stays");
    }

    #[test]
    fn without_file_descriptors_a_new_connection_takes_the_place_of_a_silent_one_or_none() {
        let left = Mutex::new(3);
        let admit = move || {
            let mut left = left.lock().unwrap();
            *left -= i32::from(*left > 0);
            *left > 0
        };
        let (_, listener) = start_with(100, false, admit);
        let mut established = connect(&listener);
        assert!(is_answered(&mut established));
        let mut silent = connect(&listener);
        std::thread::sleep(Duration::from_millis(100));
        let mut new = connect(&listener);
        assert!(is_answered(&mut new));
        assert!(has_ended(&mut silent));
        assert!(has_ended(&mut connect(&listener)) && is_answered(&mut established) && is_answered(&mut new));
    }

    #[test]
    fn connections_beyond_the_bound_wait_for_a_place() {
        let (_, listener) = start(2, false);
        let mut open: Vec<Client> = (0..2).map(|_| connect(&listener)).collect();
        assert!(is_answered(&mut open[0]) && is_answered(&mut open[1]));
        open.push(connect(&listener));
        open[2].set_read_timeout(Some(Duration::from_millis(300))).unwrap();
        assert!(!is_answered(&mut open[2]));
        drop(open.remove(0));
        open[1].set_read_timeout(Some(PATIENCE)).unwrap();
        let mut byte = [0];
        open[1].read_exact(&mut byte).unwrap();
        assert_eq!(byte, [8], "the byte that waited");
        let address = listener.address();
        drop(listener);
        assert!(Client::connect(address).is_err(), "a listener that was dropped listens no more");
    }

    #[test]
    fn one_address_has_its_share_of_handshakes() {
        let (service, listener) = start(100, true);
        let mut open: Vec<Client> = (0..30).map(|_| connect(&listener)).collect();
        let end = Instant::now() + PATIENCE;
        while *service.0.lock().unwrap() < 14 && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(10));
        }
        assert_eq!(*service.0.lock().unwrap(), 14, "16 of 30 handshakes are under way");
        // An established connection counts no more.
        assert!(is_answered(&mut open[0]));
        assert!(is_answered(&mut connect(&listener)));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn silent_handshakes_of_many_addresses_keep_nobody_out() {
        let from = |listener: &Listener, source: [u8; 4]| -> Client {
            let socket = Socket::new(Domain::IPV4, Type::STREAM, Some(Protocol::TCP)).unwrap();
            socket.bind(&SocketAddr::from((source, 0)).into()).unwrap();
            socket.connect(&listener.address().into()).unwrap();
            socket.set_read_timeout(Some(PATIENCE)).unwrap();
            socket.into()
        };
        let (_, listener) = start(1000, true);
        let mut silent: Vec<Client> =
            (0..20).flat_map(|host| [host; 16]).map(|host| from(&listener, [127, 1, host, 1])).collect();
        assert!(is_answered(&mut from(&listener, [127, 0, 0, 2])));
        silent.iter().for_each(|client| client.set_nonblocking(true).unwrap());
        let mut ended = || silent.iter_mut().filter_map(|client| has_ended(client).then_some(())).count();
        // The last of them may end a moment after the answer.
        let end = Instant::now() + PATIENCE;
        while ended() < 320 + 1 - 256 && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(10));
        }
        assert_eq!(ended(), 320 + 1 - 256, "one more is answered, and its handshake over");
    }
}
