//! HTTP server of one page: the metrics, or the progress of a calibration.

use std::{
    convert::Infallible,
    net::{SocketAddr, TcpListener},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    thread::{Builder, JoinHandle},
    time::Duration,
};

use anyhow::{Context as _, Result};
use hyper::{
    Method, Request, Response, StatusCode,
    body::Incoming,
    header::{CONTENT_TYPE, HeaderValue},
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::{
    net::TcpStream,
    runtime,
    sync::{Semaphore, oneshot},
    time::{sleep, timeout},
};

/// Time within which a client must send its request.
const PATIENCE: Duration = Duration::from_secs(1);
/// Time from the connection to the end of the answer.
const LONGEST: Duration = Duration::from_secs(2);
/// Largest request that is read, bytes: the smallest bound that hyper accepts.
const REQUEST_BYTES: usize = 8192;
/// Largest number of clients that are served at the same time; others wait in the system's queue.
const CONNECTIONS: usize = 32;
/// Pause after a connection could not be accepted: without a free file descriptor, trying at once only costs time.
const PAUSE: Duration = Duration::from_millis(100);

/// Server that answers HTTP requests with the text published last, in one thread.
pub struct PageServer {
    text: Arc<Mutex<String>>,
    address: SocketAddr,
    /// Sender whose drop ends the thread.
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl PageServer {
    /// Listens on an address; port 0 takes a free one. `option` names it in errors, `kind` is the text's media type.
    ///
    /// # Errors
    /// Names the address when it is taken.
    pub fn start(option: &str, address: &str, kind: &'static str) -> Result<Self> {
        let listener = TcpListener::bind(address).with_context(|| format!("{option}: cannot listen on {address}"))?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
        let text = Arc::new(Mutex::new(String::new()));
        let (stop, stopped) = oneshot::channel();
        let of_thread = Arc::clone(&text);
        let work = move || {
            // Open connections end with the runtime.
            runtime.block_on(async {
                tokio::select! {
                    _ = stopped => {}
                    ended = serve(listener, &of_thread, kind) => if let Err(error) = ended {
                        tracing::error!("the page has ended: {error}");
                    }
                }
            });
        };
        let thread = Builder::new().name("page".to_owned()).spawn(work)?;
        Ok(Self { text, address, stop: Some(stop), thread: Some(thread) })
    }

    /// Returns the address on which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Sets the text of all answers from now on.
    pub fn publish(&self, text: String) {
        *lock(&self.text) = text;
    }
}

impl Drop for PageServer {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Accepts clients, no more than [`CONNECTIONS`] at a time, and answers each in a task.
async fn serve(listener: TcpListener, text: &Arc<Mutex<String>>, kind: &'static str) -> std::io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    while let Ok(place) = Arc::clone(&places).acquire_owned().await {
        match listener.accept().await {
            Ok((client, _)) => {
                let text = Arc::clone(text);
                tokio::spawn(async move {
                    let _place = place;
                    // A client that asks badly or reads slowly is its own loss.
                    let _ = timeout(LONGEST, answer(client, &text, kind)).await;
                });
            }
            Err(_) => sleep(PAUSE).await,
        }
    }
    Ok(())
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
    };

    use super::*;

    fn start(address: &str) -> Result<PageServer> {
        PageServer::start("health.listen", address, "text/plain")
    }

    fn ask(server: &PageServer, request: &str) -> String {
        let mut client = TcpStream::connect(server.address()).unwrap();
        client.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        client.read_to_string(&mut answer).unwrap();
        answer
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
    fn a_client_that_dawdles_holds_nobody_up() {
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
        let silent: Vec<TcpStream> = (1..CONNECTIONS).map(|_| connect()).collect();
        // They are all being served.
        std::thread::sleep(2 * PAUSE);
        let answer = ask(&server, "GET /metrics HTTP/1.1\r\n\r\n");
        assert!(answer.ends_with("flyrig_frames_total 1\n"), "{answer}");
        for client in &silent {
            client.set_nonblocking(true).unwrap();
            let error = (&*client).read(&mut [0]).map_err(|error| error.kind());
            assert_eq!(
                error,
                Err(ErrorKind::WouldBlock),
                "it was answered before the server gave up on the silent ones"
            );
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
        std::thread::sleep(LONGEST + PATIENCE);
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
