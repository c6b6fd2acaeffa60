//! A page of metrics for Prometheus.

use std::{
    io::{ErrorKind, Read as _, Write as _},
    net::{SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{Builder, JoinHandle},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result};

/// Longest that a client may take to ask, and longest that a piece of the answer may take.
const PATIENCE: Duration = Duration::from_secs(1);
/// Longest request that is read.
const REQUEST_BYTES: usize = 8192;
/// How often a thread looks whether it shall stop.
const LOOK: Duration = Duration::from_millis(100);
/// Clients that are served at the same time; each takes one thread for at most about two seconds, the others wait.
const THREADS: usize = 8;

/// Answers HTTP requests with the text published last. Own code rather than a crate's: the small servers that there are
/// have no time-outs for clients that dawdle, or bring an executor along.
pub struct MetricsServer {
    text: Arc<Mutex<String>>,
    stop: Arc<AtomicBool>,
    address: SocketAddr,
    threads: Vec<JoinHandle<()>>,
}

impl MetricsServer {
    /// Listens on an address; port 0 takes a free one.
    ///
    /// # Errors
    /// Names the address when it is taken.
    pub fn start(address: &str) -> Result<Self> {
        let listener =
            TcpListener::bind(address).with_context(|| format!("health.listen: cannot listen on {address}"))?;
        listener.set_nonblocking(true)?;
        let (text, stop) = (Arc::new(Mutex::new(String::new())), Arc::new(AtomicBool::new(false)));
        let address = listener.local_addr()?;
        // From here on an early return drops this and stops what has started.
        let mut this = Self { text, stop, address, threads: Vec::with_capacity(THREADS) };
        for _ in 0..THREADS {
            let (listener, text, stopped) = (listener.try_clone()?, Arc::clone(&this.text), Arc::clone(&this.stop));
            let serve = move || {
                while !stopped.load(Ordering::Relaxed) {
                    match listener.accept() {
                        Ok((client, _)) => {
                            let text = lock(&text).clone();
                            // A client that asks badly is its own loss.
                            let _ = answer(client, &text, &stopped);
                        }
                        Err(_) => std::thread::sleep(LOOK),
                    }
                }
            };
            this.threads.push(Builder::new().name("metrics".to_owned()).spawn(serve)?);
        }
        Ok(this)
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What is answered from now on.
    pub fn publish(&self, text: String) {
        *lock(&self.text) = text;
    }
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn answer(mut client: TcpStream, text: &str, stopped: &AtomicBool) -> std::io::Result<()> {
    client.set_nonblocking(false)?;
    client.set_read_timeout(Some(LOOK))?;
    client.set_write_timeout(Some(PATIENCE))?;
    let deadline = Instant::now() + PATIENCE;
    let mut request = Vec::new();
    let mut piece = [0; 512];
    while !request.windows(4).any(|window| window == b"\r\n\r\n") && request.len() < REQUEST_BYTES {
        if Instant::now() >= deadline || stopped.load(Ordering::Relaxed) {
            return Ok(());
        }
        match client.read(&mut piece) {
            Ok(0) => break,
            Ok(read) => request.extend_from_slice(&piece[..read]),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(error) => return Err(error),
        }
    }
    let (status, body) = if request.starts_with(b"GET /metrics ") || request.starts_with(b"GET / ") {
        ("200 OK", text)
    } else {
        ("404 Not Found", "the metrics are at /metrics\n")
    };
    write!(
        client,
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\nContent-Length: {}\r\n\
         Connection: close\r\n\r\n{body}",
        body.len()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(server: &MetricsServer, request: &str) -> String {
        let mut client = TcpStream::connect(server.address()).unwrap();
        client.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        client.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn clients_get_the_newest_text_and_bad_ones_do_no_harm() {
        let server = MetricsServer::start("127.0.0.1:0").unwrap();
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
        let taken = MetricsServer::start(&server.address().to_string()).err().unwrap();
        assert!(format!("{taken:#}").contains("health.listen: cannot listen on 127.0.0.1"), "{taken:#}");
    }

    #[test]
    fn a_client_that_dawdles_holds_nobody_up() {
        let server = MetricsServer::start("127.0.0.1:0").unwrap();
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
        let server = MetricsServer::start("127.0.0.1:0").unwrap();
        server.publish("flyrig_frames_total 1\n".to_owned());
        let connect = || TcpStream::connect(server.address()).unwrap();
        let silent: Vec<TcpStream> = (1..THREADS).map(|_| connect()).collect();
        // They are all being served.
        std::thread::sleep(2 * LOOK);
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
}
