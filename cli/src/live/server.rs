//! The server of a live page: connections from this machine, each with a thread, and the secret of the address.

use super::http::{Connection, End, Patience, Request, Response};
use super::place::Places;
use plenoxel::error::{Error, Result};
use std::fmt::Write;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::thread;
use std::time::Duration;

/// Largest number of connections.
const CONNECTIONS: usize = 128;
/// Number of random bytes in the address.
const SECRET: usize = 16;
/// Stack of the thread of a connection, in bytes.
const STACK: usize = 1 << 20;

/// Answers to requests, by path.
pub trait Site: Send + Sync + 'static {
    /// Answers a request for `path`, which is the path behind the secret. `gone` is true once the client has closed the connection.
    fn answer(&self, path: &str, request: &Request, gone: &dyn Fn() -> bool) -> Response;
}

/// A port of this machine with a secret, from which no requests are answered yet.
pub struct Door {
    listener: TcpListener,
    address: SocketAddr,
    /// Path of the page, `/<random digits>/`.
    root: String,
    pub patience: Patience,
}

impl Door {
    /// Reserves a port on 127.0.0.1; 0 for any free port.
    ///
    /// Errors: the port is in use or not allowed.
    pub fn open(port: u16) -> Result<Self> {
        let place = format!("127.0.0.1:{port}");
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(|e| match e.kind() {
            ErrorKind::AddrInUse => Error::usage("--port", format!("port {port} is in use"), "choose another, or 0 for any free port"),
            ErrorKind::PermissionDenied => Error::usage(
                "--port",
                format!("port {port} is reserved for the system"),
                "choose a port above 1023, or 0 for any free port",
            ),
            _ => Error::io(&place, e, "opening the port"),
        })?;
        let address = listener.local_addr().map_err(|e| Error::io(&place, e, "opening the port"))?;
        let mut secret = [0; SECRET];
        getrandom::fill(&mut secret).map_err(|e| Error::io(&place, e.into(), "drawing a random address"))?;
        let mut root = "/".to_owned();
        for byte in secret {
            // Writing to a string does not fail.
            let _ = write!(root, "{byte:02x}");
        }
        Ok(Door { listener, address, root: root + "/", patience: Patience::default() })
    }

    /// Address of the page.
    pub fn address(&self) -> String {
        format!("http://{}{}", self.address, self.root)
    }

    /// Starts to answer requests.
    ///
    /// Errors: the system cannot start a thread.
    pub fn serve(self, site: impl Site) -> Result<Server> {
        let ends = Arc::new(AtomicBool::new(false));
        let server = Server { ends: ends.clone(), address: self.address };
        let spawned = thread::Builder::new().name("server".to_owned()).spawn(move || self.accept(Arc::new(site), &ends));
        spawned.map_err(|e| Error::io(server.address.to_string(), e, "starting the thread of the server"))?;
        Ok(server)
    }

    fn accept(self, site: Arc<dyn Site>, ends: &AtomicBool) {
        let (root, places): (Arc<str>, _) = (self.root.into(), Places::new(CONNECTIONS));
        for stream in self.listener.incoming() {
            if ends.load(SeqCst) {
                return;
            }
            let Ok(stream) = stream else {
                // Too many open files, for example.
                thread::sleep(Duration::from_millis(50));
                continue;
            };
            let Some(place) = places.take() else {
                drop(Connection::new(stream, self.patience).send(&Response::refusal(503, "there are too many connections"), false));
                continue;
            };
            let (site, root, patience) = (site.clone(), root.clone(), self.patience);
            let visit = move || {
                serve(stream, patience, &root, &*site);
                drop(place);
            };
            // Without a thread, the connection is closed.
            drop(thread::Builder::new().stack_size(STACK).spawn(visit));
        }
    }
}

/// A server. It ends when it is dropped.
pub struct Server {
    ends: Arc<AtomicBool>,
    address: SocketAddr,
}

impl Drop for Server {
    fn drop(&mut self) {
        self.ends.store(true, SeqCst);
        // Wakes the thread that waits for connections.
        drop(TcpStream::connect(self.address));
    }
}

/// Answers the requests of a connection.
fn serve(stream: TcpStream, patience: Patience, root: &str, site: &dyn Site) {
    // Small responses are sent at once.
    drop(stream.set_nodelay(true));
    let mut connection = Connection::new(stream, patience);
    loop {
        let request = match connection.next() {
            Ok(request) => request,
            Err(End::Closed) => return,
            Err(End::Refused(response)) => return connection.refuse(&response),
        };
        let Some(path) = behind(root, &request.path) else {
            return connection.refuse(&Response::refusal(404, "not found: open the address that the program printed"));
        };
        let response = site.answer(path, &request, &|| connection.is_closed());
        let sent = connection.send(&response, request.keeps);
        drop(response.place);
        if sent.is_err() || !request.keeps {
            return;
        }
    }
}

/// The path behind the secret. The time of the comparison does not tell how much of the secret is right.
fn behind<'p>(root: &str, path: &'p str) -> Option<&'p str> {
    let (begin, rest) = path.split_at_checked(root.len())?;
    let difference = root.bytes().zip(begin.bytes()).fold(0, |difference, (a, b)| difference | (a ^ b));
    (difference == 0).then_some(rest)
}
