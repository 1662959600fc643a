mod http;
mod partial;

use crate::{session::Stage, table::bytes};
use std::{
    io::{self, Read},
    path::Path,
    sync::mpsc::{RecvTimeoutError, SyncSender, channel, sync_channel},
    time::{Duration, Instant},
};
use ureq::http::{
    HeaderMap, StatusCode,
    header::{CONTENT_LENGTH, CONTENT_RANGE},
};
use zipsplat::{Error, Result};

pub use http::{Client, is_sha256};
pub use partial::{Lock, Promise, TAG, kept};

use http::{Failure, FileInfo, failure};
use partial::Partial;

/// Consecutive retries without progress.
const TRIES: u32 = 5;
const RESTARTS: u32 = 3;
/// Bytes per block, and blocks queued for the disk.
const CHUNK: usize = 1 << 18;
const WAITING: usize = 16;
const POLL: Duration = Duration::from_millis(50);

/// `sha256` replaces an unreported hash.
pub fn promise(client: &Client, url: &str, sha256: Option<&str>, stage: &Stage<'_>) -> Result<Promise> {
    let mut tries = Tries::default();
    let info = loop {
        let (asking, address) = (client.clone(), url.to_owned());
        match apart(stage, move || asking.ask(&address))? {
            Ok(info) => break info,
            Err(Failure::Lasting(error)) => return Err(error),
            Err(Failure::Passing(reason) | Failure::Restart(reason)) => {
                tries.failed(url, &reason, client.patience, stage)?
            }
        }
    };
    let sha256 = match (info.sha256, sha256.map(str::to_lowercase)) {
        (Some(hosted), Some(given)) if hosted != given => {
            return Err(Error::argument("--sha256", given, format!("{hosted}, which the host says")));
        }
        (hosted, given) => hosted.or(given),
    };
    let nothing = |what: &str, expected: &str| {
        Err(Error::argument(format!("{what} of {url}"), "none in the host's answer", expected))
    };
    match (sha256, info.size) {
        (Some(sha256), Some(size)) => Ok(Promise { url: url.to_owned(), size, sha256 }),
        (None, _) => nothing("SHA-256", "x-linked-etag, or --sha256 with the hash from a source that you trust"),
        (_, None) => nothing("size", "x-linked-size or a length"),
    }
}

/// Downloads to [`Promise::path`]. The caller holds its [`Lock`]. Another call resumes.
pub fn fetch(
    client: &Client,
    promise: &Promise,
    base: &Path,
    stage: &Stage<'_>,
    notes: &mut Vec<String>,
) -> Result<()> {
    let mut partial = Partial::open(base, promise)?;
    let (mut tries, mut restarts) = (Tries::default(), 0);
    loop {
        let before = partial.length()?;
        if before > promise.size {
            partial.clear()?;
        } else if before == promise.size {
            stage.name("check");
            return partial.finish(stage);
        }
        let stopped = load(client, promise, &mut partial, stage)?;
        let progress = partial.length()? > before;
        match stopped {
            Failure::Passing(_) if progress => tries = Tries::default(),
            Failure::Passing(reason) => tries.failed(&promise.url, &reason, client.patience, stage)?,
            Failure::Lasting(error) => return Err(error),
            Failure::Restart(reason) if restarts < RESTARTS => {
                restarts += 1;
                notes.push(format!("{}: {reason}: it is loaded from its beginning again", promise.url));
                partial.clear()?;
            }
            Failure::Restart(reason) => return Err(Error::io(&promise.url, io::Error::other(reason))),
        }
    }
}

#[derive(Default)]
struct Tries(u32);

impl Tries {
    /// Waits with exponential backoff, up to the timeout.
    fn failed(&mut self, url: &str, reason: &str, patience: Duration, stage: &Stage<'_>) -> Result<()> {
        self.0 += 1;
        if self.0 == TRIES {
            return Err(Error::io(url, io::Error::other(format!("{reason}, {TRIES} times in a row"))));
        }
        let until = Instant::now() + patience.min(Duration::from_secs(1 << (self.0 - 1)));
        while Instant::now() < until {
            stage.check()?;
            std::thread::sleep(POLL.min(patience));
        }
        Ok(())
    }
}

/// Cancellation abandons the thread.
fn apart<T: Send + 'static>(stage: &Stage<'_>, work: impl FnOnce() -> T + Send + 'static) -> Result<T> {
    let (send, done) = channel();
    std::thread::spawn(move || {
        let _ = send.send(work());
    });
    loop {
        match done.recv_timeout(POLL) {
            Ok(value) => return Ok(value),
            Err(RecvTimeoutError::Timeout) => stage.check()?,
            Err(RecvTimeoutError::Disconnected) => panic!("a request panicked"),
        }
    }
}

enum Event {
    /// File offset of the next bytes.
    From(u64),
    Bytes(Vec<u8>),
    End(Failure),
}

fn load(client: &Client, promise: &Promise, partial: &mut Partial, stage: &Stage<'_>) -> Result<Failure> {
    let (send, events) = sync_channel(WAITING);
    let (client, wanted, start) = (client.clone(), promise.clone(), partial.length()?);
    std::thread::spawn(move || {
        let stop = stream(&client, &wanted, start, &send);
        let _ = send.send(Event::End(stop));
    });
    let (mut at, began) = (start, Instant::now());
    loop {
        match events.recv_timeout(POLL) {
            Ok(Event::From(0)) if at > 0 => {
                partial.clear()?;
                at = 0;
            }
            Ok(Event::From(from)) => at = from,
            Ok(Event::Bytes(block)) => {
                partial.write(at, &block)?;
                at += block.len() as u64;
                let rate = at.saturating_sub(start) as f64 / began.elapsed().as_secs_f64().max(1e-3);
                stage.name(&format!("{} of {}, {}/s", bytes(at), bytes(promise.size), bytes(rate as u64)));
                stage.reach(at as f64 / promise.size as f64)?;
            }
            Ok(Event::End(stop)) => return Ok(stop),
            Err(RecvTimeoutError::Timeout) => stage.check()?,
            Err(RecvTimeoutError::Disconnected) => panic!("a request panicked"),
        }
    }
}

fn stream(client: &Client, promise: &Promise, start: u64, send: &SyncSender<Event>) -> Failure {
    let answer = client.get(&promise.url, start).and_then(|(response, info)| {
        Ok((check_answer(promise, &info, response.status(), response.headers(), start)?, response))
    });
    let (from, response) = match answer {
        Ok(answer) => answer,
        Err(failure) => return failure,
    };
    let left = || Failure::Passing("stopped".into());
    if send.send(Event::From(from)).is_err() {
        return left();
    }
    let mut body = response.into_body().into_reader().take(promise.size - from);
    loop {
        let mut block = vec![0; CHUNK];
        match body.read(&mut block) {
            Ok(0) => return Failure::Passing("the connection ended before the file".into()),
            Ok(read) => {
                block.truncate(read);
                if send.send(Event::Bytes(block)).is_err() {
                    return left();
                }
            }
            Err(error) => return failure(&promise.url, &ureq::Error::from(error), client.patience),
        }
    }
}

fn check_answer(
    promise: &Promise,
    info: &FileInfo,
    status: StatusCode,
    headers: &HeaderMap,
    start: u64,
) -> Result<u64, Failure> {
    if let Some(other) = info.sha256.as_ref().filter(|sha256| **sha256 != promise.sha256) {
        let reason = format!("the host has another file since (SHA-256 {other}): run the command again");
        return Err(Failure::Lasting(Error::format(&promise.url, None, reason)));
    }
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    let size = promise.size;
    match status {
        StatusCode::PARTIAL_CONTENT => {
            let found = text(CONTENT_RANGE).unwrap_or("none");
            let expected = format!("bytes {start}-{}/{size}", size - 1);
            if found.replace("/*", &format!("/{size}")) == expected {
                return Ok(start);
            }
            Err(Failure::Restart(format!("Content-Range: found {found}, expected {expected}")))
        }
        StatusCode::RANGE_NOT_SATISFIABLE => {
            Err(Failure::Restart(format!("the host has no bytes from {start} on (HTTP 416)")))
        }
        _ => match text(CONTENT_LENGTH).and_then(|length| length.parse::<u64>().ok()) {
            Some(length) if length != size => {
                Err(Failure::Restart(format!("Content-Length: found {length}, expected {size}")))
            }
            // The host may ignore the range.
            _ => Ok(0),
        },
    }
}
