//! Requests and responses of HTTP/1.1 on a connection, within limits of size and time.
//!
//! `httparse` reads the head of a request. Bodies have a `Content-Length`; chunked bodies are refused. A connection is used for several requests,
//! one after the other, and is closed after a request that was refused.

use super::place::Place;
use httparse::{EMPTY_HEADER, Header, Status};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

/// Largest head of a request, in bytes.
const HEAD: usize = 8192;
/// Largest number of its headers.
const HEADERS: usize = 64;
/// Largest body of a request, in bytes.
const BODY: usize = 4096;
/// Number of bytes of a refused request that are read and dropped, so that the client can read why.
const DROPPED: usize = 1 << 16;
/// Content of a page: itself and pictures; no other address is loaded.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Time limits of a connection.
#[derive(Debug, Clone, Copy)]
pub struct Patience {
    /// Time until the first byte of a request.
    pub idle: Duration,
    /// Time from the first byte to the last.
    pub request: Duration,
    /// Time for sending the response.
    pub response: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Patience { idle: Duration::from_secs(20), request: Duration::from_secs(5), response: Duration::from_secs(60) }
    }
}

/// Method of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    Get,
    Post,
}

/// A request.
#[derive(Debug)]
pub struct Request {
    pub method: Method,
    /// Path without the query.
    pub path: String,
    pub body: Vec<u8>,
    /// False if the client wants the connection to be closed.
    pub keeps: bool,
}

/// A response.
#[derive(Debug)]
pub struct Response {
    pub status: u16,
    /// Media type of the body.
    pub media: &'static str,
    pub body: Vec<u8>,
    /// Duration of rendering, in seconds.
    pub seconds: Option<f64>,
    /// A place that is taken until the response is sent.
    pub place: Option<Place>,
}

impl Response {
    /// Creates a response with status 200.
    pub fn new(media: &'static str, body: impl Into<Vec<u8>>) -> Self {
        Response { status: 200, media, body: body.into(), seconds: None, place: None }
    }

    /// Creates a response with another status and a sentence.
    pub fn refusal(status: u16, why: &str) -> Self {
        Response { status, ..Response::new("text/plain; charset=utf-8", format!("{why}\n")) }
    }

    fn head(&self, keeps: bool) -> String {
        let reason = match self.status {
            200 => "OK",
            400 => "Bad Request",
            404 => "Not Found",
            405 => "Method Not Allowed",
            408 => "Request Timeout",
            411 => "Length Required",
            413 => "Content Too Large",
            431 => "Request Header Fields Too Large",
            501 => "Not Implemented",
            _ => "Service Unavailable",
        };
        let timing = self.seconds.map_or_else(String::new, |seconds| format!("Server-Timing: render;dur={:.1}\r\n", 1e3 * seconds));
        let connection = if keeps { "keep-alive" } else { "close" };
        let Response { status, media, body, .. } = self;
        let length = body.len();
        format!(
            "HTTP/1.1 {status} {reason}\r\nContent-Type: {media}\r\nContent-Length: {length}\r\n{timing}Cache-Control: no-store\r\n\
             Content-Security-Policy: {POLICY}\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\nConnection: {connection}\r\n\r\n"
        )
    }
}

/// Reason why there is no next request.
#[derive(Debug)]
pub enum End {
    /// The client closed the connection, or sent nothing more.
    Closed,
    /// The request is malformed, too large or too slow.
    Refused(Response),
}

impl From<io::Error> for End {
    fn from(_: io::Error) -> Self {
        End::Closed
    }
}

/// A connection to a client.
pub struct Connection {
    stream: TcpStream,
    patience: Patience,
    /// Bytes that were received and not used.
    received: Vec<u8>,
}

impl Connection {
    pub fn new(stream: TcpStream, patience: Patience) -> Self {
        Connection { stream, patience, received: Vec::new() }
    }

    /// Waits for the next request.
    pub fn next(&mut self) -> Result<Request, End> {
        if self.received.is_empty() && !self.receive(Instant::now() + self.patience.idle)? {
            return Err(End::Closed);
        }
        let until = Instant::now() + self.patience.request;
        let (head, at) = loop {
            match parsed(&self.received) {
                Ok(Some((_, at))) if at > HEAD => return Err(refused(431, "the head of the request is too long")),
                Ok(Some(found)) => break found,
                Ok(None) if self.received.len() > HEAD => return Err(refused(431, "the head of the request is too long")),
                Ok(None) => self.receive_more(until)?,
                Err(response) => return Err(End::Refused(response)),
            }
        };
        while self.received.len() < at + head.length {
            self.receive_more(until)?;
        }
        let body = self.received[at..at + head.length].to_vec();
        self.received.drain(..at + head.length);
        Ok(Request { method: head.method, path: head.path, body, keeps: head.keeps })
    }

    /// Receives bytes; false at the end of the stream, or if none came until then.
    fn receive(&mut self, until: Instant) -> io::Result<bool> {
        let mut bytes = [0; 4096];
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(false);
            }
            self.stream.set_read_timeout(Some(left))?;
            match self.stream.read(&mut bytes) {
                Ok(n) => {
                    self.received.extend_from_slice(&bytes[..n]);
                    return Ok(n > 0);
                }
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {}
                Err(e) => return Err(e),
            }
        }
    }

    /// Receives bytes of a request that has begun.
    fn receive_more(&mut self, until: Instant) -> Result<(), End> {
        match self.receive(until)? {
            true => Ok(()),
            false if until > Instant::now() => Err(End::Closed),
            false => Err(refused(408, "the request took too long")),
        }
    }

    /// True if the client has closed the connection. It may still send the next request.
    pub fn is_closed(&self) -> bool {
        let peek = || {
            self.stream.set_nonblocking(true)?;
            let peeked = self.stream.peek(&mut [0]);
            self.stream.set_nonblocking(false)?;
            peeked
        };
        match peek() {
            Ok(bytes) => bytes == 0,
            Err(e) => e.kind() != ErrorKind::WouldBlock,
        }
    }

    /// Sends a response.
    pub fn send(&mut self, response: &Response, keeps: bool) -> io::Result<()> {
        let until = Instant::now() + self.patience.response;
        let head = response.head(keeps);
        for mut bytes in [head.as_bytes(), &response.body] {
            while !bytes.is_empty() {
                let left = until.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return Err(ErrorKind::TimedOut.into());
                }
                self.stream.set_write_timeout(Some(left))?;
                match self.stream.write(bytes) {
                    Ok(0) => return Err(ErrorKind::WriteZero.into()),
                    Ok(n) => bytes = &bytes[n..],
                    Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {}
                    Err(e) => return Err(e),
                }
            }
        }
        Ok(())
    }

    /// Sends the last response and closes the connection. Bytes that the client still sends are dropped for a moment: the system would withdraw the
    /// response if they were not read.
    pub fn refuse(mut self, response: &Response) {
        let mut finish = || -> io::Result<()> {
            self.send(response, false)?;
            self.stream.shutdown(Shutdown::Write)?;
            let (until, mut dropped) = (Instant::now() + Duration::from_secs(1), 0);
            while dropped < DROPPED && self.receive(until)? {
                dropped += self.received.len();
                self.received.clear();
            }
            Ok(())
        };
        // A client that has gone needs no answer.
        drop(finish());
    }
}

/// Head of a request.
struct Head {
    method: Method,
    path: String,
    length: usize,
    keeps: bool,
}

/// Parses the head of a request. Returns it with its length in bytes; `None` if it is not complete.
fn parsed(bytes: &[u8]) -> Result<Option<(Head, usize)>, Response> {
    let mut headers = [EMPTY_HEADER; HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    let at = match request.parse(bytes) {
        Ok(Status::Complete(at)) => at,
        Ok(Status::Partial) => return Ok(None),
        Err(httparse::Error::TooManyHeaders) => return Err(Response::refusal(431, "the request has too many headers")),
        Err(e) => return Err(Response::refusal(400, &format!("this is not a request of HTTP/1.1: {e}"))),
    };
    let method = match request.method {
        Some("GET") => Method::Get,
        Some("POST") => Method::Post,
        _ => return Err(Response::refusal(405, "expected GET or POST")),
    };
    let path = request.path.unwrap_or_default().split('?').next().unwrap_or_default().to_owned();
    let one_dot_one = request.version == Some(1);
    let headers: &[Header<'_>] = request.headers;
    let values =
        |name: &'static str| headers.iter().filter(move |header| header.name.eq_ignore_ascii_case(name)).map(|header| header.value);
    if values("transfer-encoding").next().is_some() {
        return Err(Response::refusal(501, "expected a body with a Content-Length"));
    }
    let mut lengths = values("content-length");
    let length = match (lengths.next(), lengths.next(), method) {
        (None, _, Method::Get) => 0,
        (None, _, Method::Post) => return Err(Response::refusal(411, "expected a Content-Length")),
        (Some(digits), None, _) => length(digits)?,
        (Some(_), Some(_), _) => return Err(Response::refusal(400, "there are several values of Content-Length")),
    };
    let says = |what: &str| values("connection").any(|value| value.eq_ignore_ascii_case(what.as_bytes()));
    let keeps = if one_dot_one { !says("close") } else { says("keep-alive") };
    Ok(Some((Head { method, path, length, keeps }, at)))
}

/// Parses a `Content-Length`.
fn length(digits: &[u8]) -> Result<usize, Response> {
    if digits.is_empty() || !digits.iter().all(u8::is_ascii_digit) {
        return Err(Response::refusal(400, "Content-Length is not a number"));
    }
    // A number that does not fit is too large as well.
    let length = std::str::from_utf8(digits).ok().and_then(|digits| digits.parse().ok()).unwrap_or(usize::MAX);
    if length <= BODY { Ok(length) } else { Err(Response::refusal(413, &format!("a body has at most {BODY} bytes"))) }
}

fn refused(status: u16, why: &str) -> End {
    End::Refused(Response::refusal(status, why))
}
