use sha2::{Digest, Sha256};
use std::{
    collections::VecDeque,
    io::{BufRead, BufReader, Read, Write},
    net::{TcpListener, TcpStream},
    sync::{Arc, Mutex, MutexGuard},
};

#[derive(Clone, Copy, Debug)]
pub enum Act {
    Cut(usize),
    Stall(usize),
    /// As [`Act::Cut`]; the hub's file changes.
    Swap(usize),
    Ignore,
    Shift,
    Status(u16),
}

pub struct State {
    pub file: Vec<u8>,
    pub etag: Option<String>,
    pub size: Option<u64>,
    pub acts: VecDeque<Act>,
    pub refuses: Option<u16>,
    /// Method, path, range and presence of a token.
    pub requests: Vec<[String; 4]>,
    storage: u16,
}

pub struct Host {
    pub port: u16,
    state: Arc<Mutex<State>>,
}

pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Host {
    /// `acts` are the first requests' faults.
    pub fn new(file: Vec<u8>, acts: &[Act]) -> Self {
        let [hub, storage] = [0, 1].map(|_| TcpListener::bind("127.0.0.1:0").expect("a port"));
        let port = |listener: &TcpListener| listener.local_addr().expect("an address").port();
        let state = State {
            etag: Some(sha256(&file)),
            size: None,
            file,
            acts: acts.iter().copied().collect(),
            refuses: None,
            requests: Vec::new(),
            storage: port(&storage),
        };
        let host = Self { port: port(&hub), state: Arc::new(Mutex::new(state)) };
        for listener in [hub, storage] {
            let state = host.state.clone();
            std::thread::spawn(move || {
                for stream in listener.incoming().flatten() {
                    let state = state.clone();
                    std::thread::spawn(move || drop(serve(stream, &state)));
                }
            });
        }
        host
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no server panicked")
    }

    /// Empty for the whole file.
    pub fn ranges(&self) -> Vec<String> {
        let state = self.state();
        state.requests.iter().filter(|request| request[1] == "/blob").map(|request| request[2].clone()).collect()
    }
}

fn serve(stream: TcpStream, state: &Mutex<State>) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream);
    let (mut line, mut range, mut token) = (String::new(), String::new(), false);
    reader.read_line(&mut line)?;
    loop {
        let mut header = String::new();
        reader.read_line(&mut header)?;
        match header.trim().split_once(": ").map(|(name, value)| (name.to_lowercase(), value)) {
            Some((name, value)) if name == "range" => range = value.to_owned(),
            Some((name, value)) if name == "authorization" => token = value == "Bearer secret",
            Some(_) => {}
            None => break,
        }
    }
    let words: Vec<String> = line.split(' ').map(str::to_owned).collect();
    let [method, path] = [words[0].clone(), words[1].clone()];
    state.lock().unwrap().requests.push([method.clone(), path.clone(), range.clone(), token.to_string()]);
    if method == "CONNECT" {
        reader.get_mut().write_all(b"HTTP/1.1 200 OK\r\n\r\n")?;
        return serve(reader.into_inner(), state);
    }
    let head = if path == "/blob" { None } else { Some(hub(&path, &state.lock().unwrap())) };
    match head {
        Some(head) => reader.get_mut().write_all(head.as_bytes()),
        None => blob(reader.get_mut(), range.strip_prefix("bytes=").and_then(|range| range.strip_suffix('-')), state),
    }
}

/// Redirects within the hub first, as for renames.
fn hub(path: &str, state: &State) -> String {
    let end = "Content-Length: 0\r\nConnection: close\r\n\r\n";
    if let Some(status) = state.refuses {
        return format!("HTTP/1.1 {status} No\r\n{end}");
    }
    match path {
        "/veichta/zipsplat/resolve/main/zipsplat-da3g-252p.tar"
        | "/depth-anything/DA3-SMALL/resolve/main/model.safetensors"
        | "/depth-anything/DA3-LARGE-1.1/resolve/main/model.safetensors"
        | "/facebook/VGGT-1B/resolve/main/model.safetensors" => {
            format!("HTTP/1.1 307 Moved\r\nLocation: /renamed/zipsplat.tar\r\n{end}")
        }
        "/renamed/zipsplat.tar" => {
            let etag = state.etag.as_ref().map(|etag| format!("X-Linked-Etag: \"{etag}\"\r\n")).unwrap_or_default();
            let size = state.size.unwrap_or(state.file.len() as u64);
            let place = format!("http://127.0.0.1:{}/blob", state.storage);
            format!("HTTP/1.1 302 Found\r\n{etag}X-Linked-Size: {size}\r\nLocation: {place}\r\n{end}")
        }
        _ => format!("HTTP/1.1 404 Not Found\r\n{end}"),
    }
}

/// As in the real storage, without ETag and Last-Modified.
fn blob(stream: &mut TcpStream, start: Option<&str>, state: &Mutex<State>) -> std::io::Result<()> {
    let (act, file) = {
        let mut state = state.lock().unwrap();
        (state.acts.pop_front(), state.file.clone())
    };
    if let Some(Act::Status(status)) = act {
        return write!(stream, "HTTP/1.1 {status} No\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    }
    let start = start.filter(|_| !matches!(act, Some(Act::Ignore))).map(|start| start.parse().expect("a number"));
    let bytes = &file[start.unwrap_or(0)..];
    let first = start.map(|start: usize| if matches!(act, Some(Act::Shift)) { start - 1 } else { start });
    let (status, range) = match first {
        Some(first) => ("206 Partial", format!("Content-Range: bytes {first}-{}/{}\r\n", file.len() - 1, file.len())),
        None => ("200 OK", String::new()),
    };
    write!(stream, "HTTP/1.1 {status}\r\n{range}Content-Length: {}\r\nConnection: close\r\n\r\n", bytes.len())?;
    match act {
        Some(Act::Cut(count)) => stream.write_all(&bytes[..count]),
        Some(Act::Swap(count)) => {
            state.lock().unwrap().etag = Some("0".repeat(64));
            stream.write_all(&bytes[..count])
        }
        Some(Act::Stall(count)) => {
            stream.write_all(&bytes[..count])?;
            stream.read(&mut [0]).map(drop)
        }
        _ => stream.write_all(bytes),
    }
}
