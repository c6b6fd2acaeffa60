//! HTTP server of the page.

use std::{
    convert::Infallible,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use flyrig_access::{Bounds, Connection, Listener, Serve};
use flyrig_transport::TransportConfig;
use flyrig_types::{SupervisedThread, ThreadHealth, lock};
use http_body_util::Full;
use hyper::{
    HeaderMap, Method, Request, Response, StatusCode,
    body::{Bytes, Incoming},
    header::{
        ACCEPT_ENCODING, CONNECTION, CONTENT_ENCODING, CONTENT_TYPE, HeaderName, HeaderValue, SEC_WEBSOCKET_ACCEPT,
        SEC_WEBSOCKET_KEY, UPGRADE,
    },
    server::conn::http1,
    service::service_fn,
    upgrade::{OnUpgrade, Upgraded},
};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::TcpStream,
    time::timeout,
};
use tokio_rustls::TlsAcceptor;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use crate::{
    assets::asset,
    config::WebConfig,
    error::WebError,
    guard::{Token, check_names},
    hub::Hub,
    socket,
    tls::Tls,
    upstream,
};

/// Time limit of a handshake, and of the headers of a request.
const PATIENCE: Duration = Duration::from_secs(2);
/// First byte of a TLS connection.
const TLS_HANDSHAKE: u8 = 22;
/// Largest request, bytes; the smallest bound that hyper takes.
const REQUEST_BYTES: usize = 8192;
/// Time limit from the connection to the end of the answer: the largest file at 32 kB/s, a hundredth of what the stream needs.
const LONGEST: Duration = Duration::from_secs(12);
/// Largest number of connections at a time, browsers included; further ones end those that show no token.
const CONNECTIONS: usize = 512;
/// Headers of every answer: the page loads nothing from elsewhere, and no other page frames it.
const HEADERS: [(&str, &str); 5] = [
    (
        "content-security-policy",
        "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; connect-src 'self' ws: wss:; img-src data:; \
         frame-ancestors 'none'; base-uri 'none'",
    ),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
    // A newer flyrig at the same address has a newer page.
    ("cache-control", "no-cache"),
];

/// Server of the page until it is dropped.
#[derive(Debug)]
pub struct WebServer {
    listener: Listener,
    /// First configured name of this computer.
    name: Option<String>,
    token: Token,
    /// SHA-256 of the certificate; `None` without HTTPS.
    fingerprint: Option<String>,
    hub: Arc<Hub>,
    upstream: SupervisedThread,
    ended: Arc<AtomicBool>,
}

/// State shared by all connections.
struct Shared {
    hub: Arc<Hub>,
    token: Token,
    tls: Option<TlsAcceptor>,
    names: Vec<String>,
    max_browsers: usize,
}

impl WebServer {
    /// Starts to listen. The rig may start later; it is subscribed to while browsers watch.
    ///
    /// # Errors
    /// [`WebError`] for invalid settings, an unusable certificate, or an address that is taken.
    pub fn start(config: &WebConfig, transport: TransportConfig) -> Result<Self, WebError> {
        config.validate()?;
        let wanted = config.address()?;
        let is_loopback = wanted.ip().is_loopback();
        let with_tls = !config.certificate.as_os_str().is_empty()
            || !config.key.as_os_str().is_empty()
            || !is_loopback && !config.insecure;
        let tls = with_tls.then(|| Tls::new(config, reached_at(wanted))).transpose()?;
        let start = |problem: String| WebError::Start(problem);
        let token =
            if is_loopback { Token::NONE } else { Token::random().map_err(|error| start(error.to_string()))? };
        let bounds = Bounds { connections: CONNECTIONS, per_address: false, is_streaming: true };
        let listener =
            Listener::bind(wanted, bounds).map_err(|problem| WebError::Listen { address: wanted, problem })?;
        let address = listener.address();
        if !is_loopback && tls.is_none() {
            tracing::warn!(
                "the web page at {address} is not encrypted: any computer that can read this network can watch. Viewers need the whole link"
            );
        }
        let hub = Arc::<Hub>::default();
        let names = config.names.clone();
        let most = config.max_browsers;
        let (tls, fingerprint) = tls.map(|Tls { acceptor, fingerprint }| (acceptor, fingerprint)).unzip();
        let shared = Arc::new(Shared { hub: Arc::clone(&hub), token: token.clone(), tls, names, max_browsers: most });
        let listener = listener.start("web", shared).map_err(|error| start(error.to_string()))?;
        let ended = Arc::new(AtomicBool::new(false));
        let (fed, until) = (Arc::clone(&hub), Arc::clone(&ended));
        let upstream = SupervisedThread::start("web upstream", move || upstream::run(&transport, &fed, &until));
        let upstream = upstream.map_err(|error| start(error.to_string()))?;
        Ok(Self { listener, name: config.names.first().cloned(), token, fingerprint, hub, upstream, ended })
    }

    /// Returns the address that is listened on.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.listener.address()
    }

    /// Returns the link to the page, with its token where one is needed, at the first configured name of this computer or at its address.
    #[must_use]
    pub fn link(&self) -> String {
        let scheme = if self.fingerprint.is_some() { "https" } else { "http" };
        let host = match &self.name {
            Some(name) if self.address().ip().is_unspecified() => format!("{name}:{}", self.address().port()),
            _ => reached_at(self.address()).to_string(),
        };
        format!("{scheme}://{host}/{}", self.token.fragment())
    }

    /// Returns the SHA-256 of the server's certificate, as browsers write it; `None` without HTTPS.
    #[must_use]
    pub fn fingerprint(&self) -> Option<&str> {
        self.fingerprint.as_deref()
    }

    /// Returns the number of browsers that watch.
    #[must_use]
    pub fn browsers(&self) -> usize {
        self.hub.browsers()
    }

    /// Returns the health of the thread that receives from the rig.
    #[must_use]
    pub fn thread(&self) -> ThreadHealth {
        self.upstream.health()
    }
}

impl Drop for WebServer {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        self.upstream.join();
    }
}

/// Returns an address, or for one that means all interfaces, that by which this computer reaches others; nothing is sent to find it.
fn reached_at(address: SocketAddr) -> SocketAddr {
    if !address.ip().is_unspecified() {
        return address;
    }
    let elsewhere = if address.is_ipv4() { "192.0.2.1:9" } else { "[2001:db8::1]:9" };
    let routed = UdpSocket::bind((address.ip(), 0)).and_then(|socket| {
        socket.connect(elsewhere)?;
        socket.local_addr()
    });
    let own = routed.map(|own| own.ip()).ok().or_else(|| reachable(address.is_ipv4(), interfaces()));
    // Without a network there is loopback alone.
    let loopback: IpAddr = if address.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() };
    SocketAddr::new(own.unwrap_or(loopback), address.port())
}

/// Returns the addresses of this computer's interfaces that are up: a network without a gateway has no route that names one.
fn interfaces() -> Vec<IpAddr> {
    #[cfg(unix)]
    let of_all = pnet_datalink::interfaces()
        .into_iter()
        .filter(pnet_datalink::NetworkInterface::is_up)
        .flat_map(|interface| interface.ips)
        .map(|network| network.ip())
        .collect();
    #[cfg(not(unix))]
    let of_all = Vec::new();
    of_all
}

/// Returns the first address that other computers may reach. Link-local addresses need the name of the link, which browsers do not accept.
fn reachable(is_ipv4: bool, addresses: Vec<IpAddr>) -> Option<IpAddr> {
    addresses.into_iter().find(|address| match address {
        IpAddr::V4(v4) => is_ipv4 && !v4.is_loopback(),
        IpAddr::V6(v6) => !is_ipv4 && !v6.is_loopback() && !v6.is_unicast_link_local(),
    })
}

impl Serve for Shared {
    async fn serve(self: Arc<Self>, connection: Connection) {
        let Connection { stream, mut place, .. } = connection;
        // A malformed request, or a client that reads slowly, costs that client alone.
        if let Ok(Some(upgraded)) = timeout(LONGEST, greet(stream, &self)).await {
            socket::serve(upgraded, &self.hub, &self.token, self.max_browsers, &mut place).await;
        }
    }
}

/// Answers a client, through TLS where there is a certificate; returns its WebSocket where it asked for one.
async fn greet(client: TcpStream, shared: &Arc<Shared>) -> Option<Upgraded> {
    let Some(tls) = shared.tls.clone() else { return answer(client, shared).await };
    let mut first = [0];
    match timeout(PATIENCE, client.peek(&mut first)).await {
        Ok(Ok(1)) if first == [TLS_HANDSHAKE] => {}
        Ok(Ok(1)) => {
            let _ = refuse_http(client).await;
            return None;
        }
        _ => return None,
    }
    match timeout(PATIENCE, tls.accept(client)).await {
        Ok(Ok(client)) => answer(client, shared).await,
        _ => None,
    }
}

/// Answers a browser that speaks HTTP where HTTPS is expected.
async fn refuse_http(client: TcpStream) -> hyper::Result<()> {
    let text = "this server speaks HTTPS: write https:// before its address\n";
    let service = service_fn(async |_: Request<Incoming>| {
        Ok::<_, Infallible>(page(
            StatusCode::BAD_REQUEST,
            "text/plain; charset=utf-8",
            Bytes::from_static(text.as_bytes()),
        ))
    });
    let mut connection = http1::Builder::new();
    connection.timer(TokioTimer::new()).header_read_timeout(PATIENCE).max_buf_size(REQUEST_BYTES).keep_alive(false);
    connection.serve_connection(TokioIo::new(client), service).await
}

async fn answer<C>(client: C, shared: &Arc<Shared>) -> Option<Upgraded>
where
    C: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let upgrade = Arc::<Mutex<Option<OnUpgrade>>>::default();
    let (shared, to_upgrade) = (Arc::clone(shared), Arc::clone(&upgrade));
    let service = service_fn(move |request| {
        let response = respond(request, &shared, &to_upgrade);
        async move { Ok::<_, Infallible>(response) }
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .max_buf_size(REQUEST_BYTES)
        .serve_connection(TokioIo::new(client), service)
        .with_upgrades()
        .await
        .ok()?;
    let upgrade = lock(&upgrade).take()?;
    upgrade.await.ok()
}

/// Answers a request; one for the WebSocket leaves its upgrade in `to_upgrade`.
fn respond(
    mut request: Request<Incoming>,
    shared: &Shared,
    to_upgrade: &Mutex<Option<OnUpgrade>>,
) -> Response<Full<Bytes>> {
    let scheme = if shared.tls.is_some() { "https" } else { "http" };
    if let Err(reason) = check_names(request.headers(), scheme, &shared.names) {
        return page(StatusCode::FORBIDDEN, "text/plain; charset=utf-8", Bytes::from(reason));
    }
    let text =
        |status, text: &'static str| page(status, "text/plain; charset=utf-8", Bytes::from_static(text.as_bytes()));
    if request.method() != Method::GET && request.method() != Method::HEAD {
        return text(StatusCode::METHOD_NOT_ALLOWED, "only GET is supported\n");
    }
    if request.uri().path() == "/stream" {
        let is_upgrade =
            request.headers().get(UPGRADE).is_some_and(|value| value.as_bytes().eq_ignore_ascii_case(b"websocket"));
        let key = request
            .headers()
            .get(SEC_WEBSOCKET_KEY)
            .filter(|_| is_upgrade)
            .map(|key| derive_accept_key(key.as_bytes()));
        let Some(accept) = key.and_then(|key| HeaderValue::from_str(&key).ok()) else {
            return text(StatusCode::UPGRADE_REQUIRED, "this address is for the page's WebSocket\n");
        };
        *lock(to_upgrade) = Some(hyper::upgrade::on(&mut request));
        let mut response = Response::new(Full::default());
        *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
        let headers = response.headers_mut();
        headers.insert(UPGRADE, HeaderValue::from_static("websocket"));
        headers.insert(CONNECTION, HeaderValue::from_static("Upgrade"));
        headers.insert(SEC_WEBSOCKET_ACCEPT, accept);
        return response;
    }
    match asset(request.uri().path()) {
        Some(asset) if takes_gzip(request.headers()) => {
            let mut response = page(StatusCode::OK, asset.kind, asset.packed.clone());
            response.headers_mut().insert(CONTENT_ENCODING, HeaderValue::from_static("gzip"));
            response
        }
        Some(asset) => page(StatusCode::OK, asset.kind, asset.bytes.clone()),
        None => text(StatusCode::NOT_FOUND, "there is nothing here; the page is at /\n"),
    }
}

/// Returns whether the client takes answers that are compressed by gzip.
fn takes_gzip(headers: &HeaderMap) -> bool {
    let named = |coding: &str| {
        let (name, weight) = coding.split_once(';').unwrap_or((coding, ""));
        let refused = weight
            .trim()
            .strip_prefix("q=")
            .is_some_and(|weight| weight.trim().parse::<f64>().is_ok_and(|weight| weight <= 0.0));
        name.trim().eq_ignore_ascii_case("gzip") && !refused
    };
    headers
        .get_all(ACCEPT_ENCODING)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .any(|value| value.split(',').any(named))
}

fn page(status: StatusCode, kind: &'static str, body: Bytes) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(body));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    // The connection makes room for the next one.
    headers.insert(CONNECTION, HeaderValue::from_static("close"));
    for (name, value) in HEADERS {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    response
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::io::Read as _;

    use super::*;

    #[test]
    fn gzip_is_used_where_the_client_takes_it() {
        let takes = |value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(ACCEPT_ENCODING, HeaderValue::from_static(value));
            takes_gzip(&headers)
        };
        for value in ["gzip", "gzip, deflate, br, zstd", "br;q=1.0, GZIP;q=0.5", "deflate,gzip;q=x"] {
            assert!(takes(value), "{value}");
        }
        for value in ["", "identity", "br", "gzip;q=0", "gzip; q=0.000", "gzip2"] {
            assert!(!takes(value), "{value}");
        }
        assert!(!takes_gzip(&HeaderMap::new()));
        for path in ["/", "/page.js", "/page.wasm", "/kernels.json"] {
            let asset = asset(path).unwrap();
            let mut bytes = Vec::new();
            flate2::read::GzDecoder::new(&*asset.packed).read_to_end(&mut bytes).unwrap();
            assert!(bytes == asset.bytes && asset.packed.len() < asset.bytes.len() / 2, "{path}");
        }
    }

    #[test]
    fn a_slow_line_has_time_for_the_largest_file() {
        let largest = ["/", "/page.js", "/page.wasm", "/kernels.json"].map(|path| asset(path).unwrap().bytes.len());
        let bytes_per_second = *largest.iter().max().unwrap() as f64 / (LONGEST - PATIENCE / 2).as_secs_f64();
        assert!(bytes_per_second < 34e3, "{bytes_per_second}");
    }

    #[test]
    fn an_address_that_others_reach_is_found_without_a_route() {
        let of = |texts: &[&str]| texts.iter().map(|text| text.parse().unwrap()).collect::<Vec<IpAddr>>();
        let all = of(&["127.0.0.1", "::1", "fe80::1", "10.0.0.5", "fd00::5", "10.0.0.6"]);
        assert_eq!(reachable(true, all.clone()), Some("10.0.0.5".parse().unwrap()));
        assert_eq!(reachable(false, all), Some("fd00::5".parse().unwrap()));
        assert_eq!(reachable(true, of(&["127.0.0.1", "fd00::5"])), None);
        assert_eq!(reached_at("10.1.2.3:80".parse().unwrap()), "10.1.2.3:80".parse().unwrap());
        #[cfg(unix)]
        assert!(interfaces().iter().any(IpAddr::is_loopback));
    }
}
