use crate::stamp::hex;
use http_body_util::{BodyExt, Full, LengthLimitError, Limited};
use hyper::{
    Method, Request, Response, StatusCode,
    body::{Body, Bytes, Incoming},
    header::{HOST, HeaderMap, ORIGIN},
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use std::{
    convert::Infallible,
    io::{Error, Result},
    net::{Ipv4Addr, TcpListener},
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, Sender, channel},
    },
    time::Duration,
};
use tokio::{
    runtime::Builder,
    sync::oneshot,
    task::AbortHandle,
    time::{sleep, timeout},
};

const POLL: Duration = Duration::from_millis(100);
const TOKEN_BYTES: usize = 16;
/// One request may take long.
const WORKERS: usize = 4;
/// In bytes.
const BODY: usize = 16 << 20;
/// In bytes.
const HEADER: usize = 1 << 16;
/// Timeout of a header, and of a body.
const PATIENCE: Duration = Duration::from_secs(10);
/// A new one closes the oldest connection.
const INCOMPLETE: usize = 64;

/// Loopback server with a random token before all paths.
pub struct Server {
    listener: TcpListener,
    token: String,
    port: u16,
}

pub type Answer = (&'static str, Vec<u8>);

type Reply = (StatusCode, Answer);

/// Path behind the token, a POST's body, and reply channel.
struct Job {
    path: String,
    body: Option<Bytes>,
    reply: oneshot::Sender<Reply>,
}

struct Site {
    token: String,
    port: u16,
    jobs: Sender<Job>,
}

struct Connection {
    task: AbortHandle,
    complete: Arc<AtomicBool>,
}

impl Server {
    /// A free port for 0.
    pub fn new(port: u16) -> Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))?;
        listener.set_nonblocking(true)?;
        let port = listener.local_addr()?.port();
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(Error::other)?;
        Ok(Self { listener, token: hex(&bytes), port })
    }

    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.token)
    }

    /// `answer` gets the path behind the token and the body of a POST; its errors become answers.
    pub fn serve<E: ToString>(
        &self,
        answer: impl Fn(&str, Option<&[u8]>) -> std::result::Result<Option<Answer>, E> + Sync,
        stopped: impl Fn() -> bool,
    ) -> Result<()> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let (jobs, queue) = channel();
        let queue = Mutex::new(queue);
        std::thread::scope(|scope| {
            for _ in 0..WORKERS {
                scope.spawn(|| work(&queue, &answer));
            }
            let site = Site { token: self.token.clone(), port: self.port, jobs };
            let served = runtime.block_on(self.accept(site, stopped));
            drop(runtime);
            served
        })
    }

    async fn accept(&self, site: Site, stopped: impl Fn() -> bool) -> Result<()> {
        let listener = tokio::net::TcpListener::from_std(self.listener.try_clone()?)?;
        let site = Arc::new(site);
        let mut incomplete: Vec<Connection> = Vec::new();
        while !stopped() {
            match timeout(POLL, listener.accept()).await {
                Ok(Ok((stream, _))) => {
                    incomplete.retain(|connection| !connection.is_complete());
                    if incomplete.len() == INCOMPLETE {
                        incomplete.remove(0).task.abort();
                    }
                    incomplete.push(Connection::serve(stream, site.clone()));
                }
                // Too many open files.
                Ok(Err(_)) => sleep(POLL).await,
                Err(_) => {}
            }
        }
        Ok(())
    }
}

impl Connection {
    fn serve(stream: tokio::net::TcpStream, site: Arc<Site>) -> Self {
        let complete = Arc::new(AtomicBool::new(false));
        let seen = complete.clone();
        let service = service_fn(move |request| {
            let (site, complete) = (site.clone(), seen.clone());
            async move { Ok::<_, Infallible>(response(site.reply(request, &complete).await)) }
        });
        let serving = http1::Builder::new()
            .keep_alive(false)
            .timer(TokioTimer::new())
            .header_read_timeout(PATIENCE)
            .max_buf_size(HEADER)
            .serve_connection(TokioIo::new(stream), service);
        let task = tokio::spawn(async {
            let _ = serving.await;
        });
        Self { task: task.abort_handle(), complete }
    }

    fn is_complete(&self) -> bool {
        self.complete.load(Ordering::Relaxed) || self.task.is_finished()
    }
}

impl Site {
    async fn reply(&self, request: Request<Incoming>, complete: &AtomicBool) -> Reply {
        if !is_own(request.headers(), self.port) {
            return text(StatusCode::FORBIDDEN, "not from this page");
        }
        let is_post = request.method() == Method::POST;
        if !is_post && ![Method::GET, Method::HEAD].contains(request.method()) {
            return text(StatusCode::METHOD_NOT_ALLOWED, "only GET, HEAD and POST");
        }
        let path = request.uri().path_and_query().and_then(|path| path.as_str().strip_prefix('/'));
        let path = path.and_then(|path| path.strip_prefix(self.token.as_str())?.strip_prefix('/'));
        let Some(path) = path.map(str::to_owned) else {
            return text(StatusCode::NOT_FOUND, "nothing here");
        };
        let body = if is_post {
            match read(request.into_body()).await {
                Ok(body) => Some(body),
                Err(refusal) => return refusal,
            }
        } else {
            None
        };
        complete.store(true, Ordering::Relaxed);
        let (reply, answered) = oneshot::channel();
        let failed = || text(StatusCode::INTERNAL_SERVER_ERROR, "the server ends");
        match self.jobs.send(Job { path, body, reply }) {
            Ok(()) => answered.await.unwrap_or_else(|_| failed()),
            Err(_) => failed(),
        }
    }
}

async fn read(body: Incoming) -> std::result::Result<Bytes, Reply> {
    let too_large = || text(StatusCode::PAYLOAD_TOO_LARGE, "the body is too large");
    if body.size_hint().lower() > BODY as u64 {
        return Err(too_large());
    }
    match timeout(PATIENCE, Limited::new(body, BODY).collect()).await {
        Ok(Ok(body)) => Ok(body.to_bytes()),
        Ok(Err(error)) if error.is::<LengthLimitError>() => Err(too_large()),
        Ok(Err(error)) => Err(text(StatusCode::BAD_REQUEST, &error.to_string())),
        Err(_) => Err(text(StatusCode::REQUEST_TIMEOUT, "the body is incomplete")),
    }
}

fn work<E: ToString>(
    queue: &Mutex<Receiver<Job>>,
    answer: impl Fn(&str, Option<&[u8]>) -> std::result::Result<Option<Answer>, E>,
) {
    let next = || queue.lock().expect("no panic while it is locked").recv();
    while let Ok(Job { path, body, reply }) = next() {
        if reply.is_closed() {
            continue;
        }
        let answered = catch_unwind(AssertUnwindSafe(|| answer(&path, body.as_deref())));
        let _ = reply.send(match answered {
            Ok(Ok(Some(found))) => (StatusCode::OK, found),
            Ok(Ok(None)) if body.is_some() => text(StatusCode::METHOD_NOT_ALLOWED, "takes no POST"),
            Ok(Ok(None)) => text(StatusCode::NOT_FOUND, "nothing here"),
            Ok(Err(error)) => text(StatusCode::INTERNAL_SERVER_ERROR, &error.to_string()),
            Err(_) => text(StatusCode::INTERNAL_SERVER_ERROR, "this request failed, a defect of zipsplat"),
        });
    }
}

/// Whether a request to this machine's name is from our own page. Browsers omit port 80.
fn is_own(headers: &HeaderMap, port: u16) -> bool {
    let is_here = |authority: &str| {
        let (name, given) = authority.split_once(':').unwrap_or((authority, "80"));
        ["127.0.0.1", "localhost"].contains(&name) && given == port.to_string()
    };
    let all =
        |name, holds: &dyn Fn(&str) -> bool| headers.get_all(name).iter().all(|value| value.to_str().is_ok_and(holds));
    headers.get_all(HOST).iter().count() == 1
        && all(HOST, &is_here)
        && all(ORIGIN, &|origin| origin.strip_prefix("http://").is_some_and(is_here))
}

fn text(status: StatusCode, words: &str) -> Reply {
    (status, ("text/plain; charset=utf-8", words.as_bytes().to_vec()))
}

fn response((status, (kind, bytes)): Reply) -> Response<Full<Bytes>> {
    let headers = [
        ("Content-Type", kind),
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
        ("X-Frame-Options", "DENY"),
    ];
    let builder =
        headers.iter().fold(Response::builder().status(status), |builder, (name, value)| builder.header(*name, *value));
    builder.body(Full::new(bytes.into())).expect("constant headers are valid")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn browsers_omit_port_80() {
        let is_own = |host: &str, origin: &str, port| {
            let headers = [(HOST, host.parse().unwrap()), (ORIGIN, origin.parse().unwrap())];
            super::is_own(&headers.into_iter().collect(), port)
        };
        assert!(is_own("127.0.0.1", "http://127.0.0.1", 80));
        assert!(is_own("localhost:80", "http://localhost", 80));
        assert!(is_own("127.0.0.1:8080", "http://localhost:8080", 8080));
        assert!(!is_own("127.0.0.1", "http://127.0.0.1", 8080));
        assert!(!is_own("127.0.0.1:8080", "http://127.0.0.1", 8080));
        assert!(!is_own("example.org", "http://127.0.0.1", 80));
        assert!(!is_own("127.0.0.1", "http://example.org", 80));
    }
}
