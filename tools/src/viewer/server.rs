//! Hands a page and what it asks for to browsers on this machine, and to nobody else.

use std::{
    io::{Error, Read, Result},
    net::{Ipv4Addr, SocketAddr},
    panic::resume_unwind,
    time::Duration,
};
use tiny_http::{Header, Method, Request, Response, StatusCode};

/// The time after which a wait for a request looks for Ctrl-C.
const POLL: Duration = Duration::from_millis(100);
const TOKEN_BYTES: usize = 16;
/// Requests that are answered at once: one may take long, and the page goes on asking.
const THREADS: usize = 4;
/// Most bytes of what a page sends.
const MOST: u64 = 16 << 20;

/// A server on the loopback interface whose paths all begin with a random token.
pub struct Server {
    http: tiny_http::Server,
    token: String,
    port: u16,
}

/// An answer's kind, such as `text/html`, and its bytes.
pub type Answer = (&'static str, Vec<u8>);

impl Server {
    /// A server at `port`, or at a free one for 0.
    ///
    /// # Errors
    /// A port that is taken or may not be used.
    pub fn new(port: u16) -> Result<Self> {
        let http = tiny_http::Server::http((Ipv4Addr::LOCALHOST, port)).map_err(Error::other)?;
        let port = http.server_addr().to_ip().map_or(port, |address: SocketAddr| address.port());
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(Error::other)?;
        let token = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { http, token, port })
    }

    /// The address of the page.
    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.token)
    }

    /// Answers requests with what `answer` has at the path behind the token, until `stopped`, several at once. What a page sends is
    /// its second argument, none where it only asks. An error of `answer` is answered with its words.
    ///
    /// # Errors
    /// The error of a socket that can receive no further request.
    pub fn serve<E: ToString>(
        &self,
        answer: impl Fn(&str, Option<&[u8]>) -> std::result::Result<Option<Answer>, E> + Sync,
        stopped: impl Fn() -> bool + Sync,
    ) -> Result<()> {
        let serve = || {
            while !stopped() {
                if let Some(mut request) = self.http.recv_timeout(POLL)? {
                    let (status, (kind, bytes)) = self.answer(&mut request, &answer);
                    // A browser that went away is no reason to stop.
                    let _ = request.respond(response(status, kind, bytes));
                }
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..THREADS).map(|_| scope.spawn(serve)).collect();
            threads.into_iter().try_for_each(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)))
        })
    }

    fn answer<E: ToString>(
        &self,
        request: &mut Request,
        answer: impl Fn(&str, Option<&[u8]>) -> std::result::Result<Option<Answer>, E>,
    ) -> (u16, Answer) {
        let refused = |status, why: &str| (status, ("text/plain; charset=utf-8", why.as_bytes().to_vec()));
        if !self.is_own(request) {
            return refused(403, "not from this page");
        }
        let sent = *request.method() == Method::Post;
        if !sent && !matches!(request.method(), Method::Get | Method::Head) {
            return refused(405, "only GET, HEAD and POST");
        }
        let path = request.url().strip_prefix('/').and_then(|path| path.strip_prefix(self.token.as_str()));
        let Some(path) = path.and_then(|path| path.strip_prefix('/')).map(str::to_owned) else {
            return refused(404, "nothing here");
        };
        let mut body = Vec::new();
        if sent && !matches!(request.as_reader().take(MOST + 1).read_to_end(&mut body), Ok(read) if read as u64 <= MOST)
        {
            return refused(413, "too much at once");
        }
        match answer(&path, sent.then_some(&body[..])) {
            Ok(Some(found)) => (200, found),
            Err(error) => refused(500, &error.to_string()),
            Ok(None) if sent => refused(405, "nothing here takes that"),
            Ok(None) => refused(404, "nothing here"),
        }
    }

    /// True where a browser asks for this machine by its own name, which pages of others cannot make it do, and on behalf of no page
    /// but ours.
    fn is_own(&self, request: &Request) -> bool {
        let names = ["127.0.0.1", "localhost"].map(|name| format!("{name}:{}", self.port));
        let all = |field: &'static str, holds: &dyn Fn(&str) -> bool| {
            let mut values = request.headers().iter().filter(|header| header.field.equiv(field));
            values.all(|header| holds(header.value.as_str()))
        };
        let hosts = request.headers().iter().filter(|header| header.field.equiv("Host")).count();
        hosts == 1
            && all("Host", &|host| names.iter().any(|name| name == host))
            && all("Origin", &|origin| names.iter().any(|name| origin.strip_prefix("http://") == Some(name)))
    }
}

fn response(status: u16, kind: &str, bytes: Vec<u8>) -> Response<std::io::Cursor<Vec<u8>>> {
    let headers = [
        ("Content-Type", kind),
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
        ("X-Frame-Options", "DENY"),
    ];
    let header = |(name, value): (&str, &str)| Header::from_bytes(name, value).expect("these are fit for headers");
    let length = bytes.len();
    let headers = headers.map(header).into();
    let body = std::io::Cursor::new(bytes);
    // A length that is known is sent: the page shows how much of it is there.
    Response::new(StatusCode(status), headers, body, Some(length), None).with_chunked_threshold(usize::MAX)
}
