//! HTTP server of one page: the metrics, or the progress of a calibration.

use std::{
    convert::Infallible,
    net::SocketAddr,
    sync::{Arc, Mutex},
    time::Duration,
};

use anyhow::{Context as _, Result};
use flyrig_access::{Bounds, Connection, Listener, Serve};
use flyrig_types::lock;
use hyper::{
    Method, Request, Response, StatusCode,
    body::Incoming,
    header::{CONTENT_TYPE, HeaderValue},
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::{net::TcpStream, time::timeout};

/// Time within which a client must send its request.
const PATIENCE: Duration = Duration::from_secs(1);
/// Time limit from the connection to the end of the answer.
const LONGEST: Duration = Duration::from_secs(2);
/// Largest request, bytes; the smallest bound that hyper takes.
const REQUEST_BYTES: usize = 8192;
/// Largest number of clients at a time; further ones take the place of the oldest.
const CONNECTIONS: usize = 32;

/// Server that answers HTTP requests with the text published last, in one thread.
pub struct PageServer {
    page: Arc<Page>,
    listener: Listener,
}

/// Text of the page.
struct Page {
    text: Mutex<String>,
    /// Media type.
    kind: &'static str,
}

impl Serve for Page {
    async fn serve(self: Arc<Self>, connection: Connection) {
        let Connection { stream, place: _place, .. } = connection;
        // A malformed request, or a client that reads slowly, costs that client alone.
        let _ = timeout(LONGEST, answer(stream, &self.text, self.kind)).await;
    }
}

impl PageServer {
    /// Listens on an address; port 0 takes a free one. `option` names it in errors, `kind` is the text's media type.
    ///
    /// # Errors
    /// Names the address when it is taken.
    pub fn start(option: &str, address: &str, kind: &'static str) -> Result<Self> {
        let bounds = Bounds { connections: CONNECTIONS, per_address: false, is_streaming: false };
        let listener = Listener::bind(address, bounds)
            .with_context(|| format!("{option}: cannot listen on {address}; free the port or name another one"))?;
        let page = Arc::new(Page { text: Mutex::default(), kind });
        let listener = listener.start("page", Arc::clone(&page))?;
        Ok(Self { page, listener })
    }

    /// Returns the address on which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.listener.address()
    }

    /// Sets the text of all answers from now on.
    pub fn publish(&self, text: String) {
        *lock(&self.page.text) = text;
    }
}

/// Answers one request.
async fn answer(client: TcpStream, text: &Mutex<String>, kind: &'static str) -> hyper::Result<()> {
    let service = service_fn(async |request| Ok::<_, Infallible>(page(&request, text, kind)));
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .max_buf_size(REQUEST_BYTES)
        .keep_alive(false)
        .serve_connection(TokioIo::new(client), service)
        .await
}

fn page(request: &Request<Incoming>, text: &Mutex<String>, kind: &'static str) -> Response<String> {
    if request.method() == Method::GET && matches!(request.uri().path(), "/metrics" | "/") {
        let mut response = Response::new(lock(text).clone());
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
        return response;
    }
    let mut response = Response::new("the page is at /\n".to_owned());
    *response.status_mut() = StatusCode::NOT_FOUND;
    response
}

#[cfg(test)]
mod tests {
    use std::{
        io::{ErrorKind, Read as _, Write as _},
        net::TcpStream,
        thread::Builder,
        time::Instant,
    };

    use super::*;

    fn start(address: &str) -> Result<PageServer> {
        PageServer::start("health.listen", address, "text/plain")
    }

    /// Asks until there is a whole answer: the server hangs up on a client that a pause of the machine has made slow.
    fn ask(server: &PageServer, request: &str) -> String {
        let end = Instant::now() + Duration::from_secs(90);
        loop {
            let mut client = TcpStream::connect(server.address()).unwrap();
            let mut answer = String::new();
            if client.write_all(request.as_bytes()).is_ok()
                && client.read_to_string(&mut answer).is_ok()
                && !answer.is_empty()
            {
                return answer;
            }
            assert!(Instant::now() < end, "no answer to {request}");
        }
    }

    #[test]
    fn clients_get_the_newest_text_and_bad_ones_do_no_harm() {
        let server = start("127.0.0.1:0").unwrap();
        server.publish("flyrig_frames_total 1\n".to_owned());
        // Gone before the answer.
        drop(TcpStream::connect(server.address()).unwrap());
        let answer = ask(&server, "GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n");
        assert!(
            answer.starts_with("HTTP/1.1 200 OK\r\n") && answer.ends_with("\r\n\r\nflyrig_frames_total 1\n"),
            "{answer}"
        );
        assert!(ask(&server, "GET /secrets HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 404"));
        server.publish("flyrig_frames_total 2\n".to_owned());
        assert!(ask(&server, "GET / HTTP/1.0\r\n\r\n").ends_with("flyrig_frames_total 2\n"));
        let taken = start(&server.address().to_string()).err().unwrap();
        assert!(format!("{taken:#}").contains("health.listen: cannot listen on 127.0.0.1"), "{taken:#}");
    }

    #[test]
    fn a_slow_client_delays_no_other() {
        let server = start("127.0.0.1:0").unwrap();
        server.publish("flyrig_frames_total 1\n".to_owned());
        let mut slow = TcpStream::connect(server.address()).unwrap();
        let writer = Builder::new().name("slow client".to_owned()).spawn(move || {
            // Never a whole request, never silent for long; ends when the server has had enough.
            for _ in 0..10_000 {
                if slow.write_all(b"G").is_err() {
                    return true;
                }
                std::thread::sleep(Duration::from_millis(50));
            }
            false
        });
        let writer = writer.unwrap();
        assert!(ask(&server, "GET /metrics HTTP/1.1\r\n\r\n").ends_with("flyrig_frames_total 1\n"));
        assert!(writer.join().unwrap(), "the server hung up");
    }

    #[test]
    fn clients_are_answered_while_others_keep_their_connection_open() {
        let server = start("127.0.0.1:0").unwrap();
        server.publish("flyrig_frames_total 1\n".to_owned());
        let connect = || TcpStream::connect(server.address()).unwrap();
        let end = Instant::now() + Duration::from_secs(90);
        loop {
            let begun = Instant::now();
            let silent: Vec<TcpStream> = (1..CONNECTIONS).map(|_| connect()).collect();
            // They are all being served.
            std::thread::sleep(Duration::from_millis(200));
            let answer = ask(&server, "GET /metrics HTTP/1.1\r\n\r\n");
            assert!(answer.ends_with("flyrig_frames_total 1\n"), "{answer}");
            let is_open = |client: &TcpStream| {
                client.set_nonblocking(true).unwrap();
                let mut client = client;
                client.read(&mut [0]).map_err(|error| error.kind()) == Err(ErrorKind::WouldBlock)
            };
            if silent.iter().all(is_open) {
                break;
            }
            // On a machine that is too slow for that it is tried again.
            assert!(begun.elapsed() >= PATIENCE, "it was answered before the server gave up on the silent ones");
            assert!(Instant::now() < end, "it is never answered before the server gives up on the silent ones");
        }
    }

    #[test]
    fn a_client_that_does_not_read_is_hung_up_on() {
        let server = start("127.0.0.1:0").unwrap();
        // More than the buffers of both ends hold.
        let text = "flyrig_frames_total 1\n".repeat(2_000_000);
        server.publish(text.clone());
        let mut deaf = TcpStream::connect(server.address()).unwrap();
        deaf.write_all(b"GET /metrics HTTP/1.1\r\n\r\n").unwrap();
        std::thread::sleep(LONGEST + 6 * PATIENCE);
        let mut answer = Vec::new();
        let _ = deaf.read_to_end(&mut answer);
        assert!(answer.len() < text.len(), "the rest was never sent");
    }

    #[test]
    fn a_request_without_end_is_refused() {
        let server = start("127.0.0.1:0").unwrap();
        let mut endless = TcpStream::connect(server.address()).unwrap();
        let (mut sent, most) = (0, 64 << 20);
        while sent < most && endless.write_all(&[b'G'; 4096]).is_ok() {
            sent += 4096;
        }
        assert!(sent < most, "{sent} bytes were taken");
    }

    #[test]
    fn the_server_ends_with_its_owner() {
        let server = start("127.0.0.1:0").unwrap();
        let (address, _silent) = (server.address(), TcpStream::connect(server.address()).unwrap());
        drop(server);
        assert!(TcpStream::connect(address).is_err());
    }
}
