use std::{env, io, path::PathBuf, time::Duration};
use ureq::{
    Agent, Body,
    http::{
        HeaderMap, Response, StatusCode, Uri,
        header::{ACCEPT_ENCODING, AUTHORIZATION, CONTENT_LENGTH, ETAG, LOCATION, RANGE},
    },
    tls::{PemItem, RootCerts, TlsConfig, parse_pem},
};
use zipsplat::{Error, Result};

const HUB: &str = "https://huggingface.co";
const HOPS: usize = 10;
const ROOTS: [&str; 2] = ["SSL_CERT_FILE", "REQUESTS_CA_BUNDLE"];

#[derive(Debug)]
pub enum Failure {
    /// A retry may help.
    Passing(String),
    /// A retry would fail alike.
    Lasting(Error),
    /// Local bytes differ from the host's.
    Restart(String),
}

#[derive(Clone)]
pub struct Client {
    agent: Agent,
    endpoint: String,
    token: Option<String>,
    pub patience: Duration,
}

/// The storage behind the hub's redirect reports neither.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FileInfo {
    /// Lowercase hexadecimal.
    pub sha256: Option<String>,
    pub size: Option<u64>,
}

impl FileInfo {
    /// Keeps earlier answers. Only the hub's ETag is a hash.
    fn update(&mut self, headers: &HeaderMap, is_hub: bool) {
        let etag = || text(headers, ETAG.as_str()).filter(|_| is_hub);
        let digest = text(headers, "x-linked-etag")
            .or_else(etag)
            .map(|etag| etag.trim_start_matches("W/").trim_matches('"').to_lowercase());
        self.sha256 = self.sha256.take().or(digest.filter(|digest| is_sha256(digest)));
        let size = text(headers, "x-linked-size").and_then(|size| size.parse().ok());
        self.size = self.size.or(size);
    }
}

pub fn is_sha256(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

impl Client {
    /// Reads the environment: `HF_ENDPOINT` names a mirror, `HF_TOKEN` a token for the hub only,
    /// `HTTPS_PROXY`, `ALL_PROXY` and `NO_PROXY` a proxy, `SSL_CERT_FILE` root certificates.
    pub fn from_environment(patience: Duration) -> Result<Self> {
        let set = |name: &str| env::var(name).ok().filter(|value| !value.trim().is_empty());
        let endpoint = set("HF_ENDPOINT").map_or(HUB.into(), |mirror| mirror.trim().trim_end_matches('/').to_owned());
        if origin(&endpoint).is_none() {
            return Err(Error::argument("HF_ENDPOINT", endpoint, format!("an address such as {HUB}")));
        }
        let roots = ROOTS.iter().find_map(|name| set(name)).map(|path| root_certificates(PathBuf::from(path)));
        let config = Agent::config_builder()
            .user_agent(concat!("zipsplat/", env!("CARGO_PKG_VERSION")))
            // Followed here, to read the hub's headers and withhold the token.
            .max_redirects(0)
            .max_redirects_will_error(false)
            .http_status_as_error(false)
            .tls_config(TlsConfig::builder().root_certs(roots.transpose()?.unwrap_or(RootCerts::WebPki)).build())
            .timeout_resolve(Some(patience))
            .timeout_connect(Some(patience))
            // A total timeout does not suit gigabytes.
            .timeout_per_read(Some(patience))
            .timeout_per_write(Some(patience))
            .build();
        Ok(Self { agent: config.into(), endpoint, token: set("HF_TOKEN"), patience })
    }

    pub fn address(&self, repository: &str, revision: &str, file: &str) -> String {
        format!("{}/{repository}/resolve/{revision}/{file}", self.endpoint)
    }

    pub fn ask(&self, url: &str) -> Result<FileInfo, Failure> {
        let (response, mut info) = self.follow(true, url, 0)?;
        if info.size.is_none() && response.status() == StatusCode::OK {
            info.size = text(response.headers(), CONTENT_LENGTH.as_str()).and_then(|length| length.parse().ok());
        }
        Ok(info)
    }

    /// Requests bytes from `start` on. Returns an answer of status 200, 206 or 416, and the hub's
    /// hash and size.
    pub fn get(&self, url: &str, start: u64) -> Result<(Response<Body>, FileInfo), Failure> {
        self.follow(false, url, start)
    }

    fn follow(&self, head: bool, url: &str, start: u64) -> Result<(Response<Body>, FileInfo), Failure> {
        let (mut at, mut info) = (url.to_owned(), FileInfo::default());
        for _ in 0..HOPS {
            let response = self.send(head, &at, start).map_err(|error| failure(url, &error, self.patience))?;
            info.update(response.headers(), origin(&at) == origin(&self.endpoint));
            if !response.status().is_redirection() {
                check_status(url, response.status(), self.token.is_some())?;
                return Ok((response, info));
            }
            if head && info.sha256.is_some() && info.size.is_some() {
                return Ok((response, info));
            }
            let location = text(response.headers(), LOCATION.as_str()).unwrap_or_default();
            at = redirected(&at, location).ok_or_else(|| {
                lasting(url, io::ErrorKind::Other, format!("redirects to '{location}', expected an https address"))
            })?;
        }
        Err(lasting(url, io::ErrorKind::Other, format!("more than {HOPS} redirects")))
    }

    fn send(&self, head: bool, url: &str, start: u64) -> std::result::Result<Response<Body>, ureq::Error> {
        let mut request = if head { self.agent.head(url) } else { self.agent.get(url) };
        request = request.header(ACCEPT_ENCODING, "identity");
        if start > 0 {
            request = request.header(RANGE, format!("bytes={start}-"));
        }
        match &self.token {
            Some(token) if origin(url) == origin(&self.endpoint) => {
                request.header(AUTHORIZATION, format!("Bearer {token}")).call()
            }
            _ => request.call(),
        }
    }
}

fn root_certificates(path: PathBuf) -> Result<RootCerts> {
    let pem = std::fs::read(&path).map_err(|error| Error::io(&path, error))?;
    let mut certificates = Vec::new();
    for item in parse_pem(&pem) {
        match item.map_err(|error| Error::format(&path, None, error.to_string()))? {
            PemItem::Certificate(certificate) => certificates.push(certificate),
            _ => continue,
        }
    }
    Ok(RootCerts::new_with_certs(&certificates))
}

fn origin(url: &str) -> Option<(String, String)> {
    let uri: Uri = url.parse().ok()?;
    let scheme = uri.scheme_str().filter(|scheme| ["http", "https"].contains(scheme))?;
    Some((scheme.to_owned(), uri.authority()?.as_str().to_lowercase()))
}

/// `None` if it would end encryption.
fn redirected(from: &str, location: &str) -> Option<String> {
    let (scheme, authority) = origin(from)?;
    let to = match location {
        absolute if origin(absolute).is_some() => absolute.to_owned(),
        path if path.starts_with('/') && !path.starts_with("//") => {
            format!("{scheme}://{authority}{path}")
        }
        _ => return None,
    };
    let (new_scheme, _) = origin(&to)?;
    (scheme == "http" || new_scheme == "https").then_some(to)
}

fn lasting(url: &str, kind: io::ErrorKind, reason: String) -> Failure {
    Failure::Lasting(Error::io(url, io::Error::new(kind, reason)))
}

fn check_status(url: &str, status: StatusCode, has_token: bool) -> Result<(), Failure> {
    match status.as_u16() {
        200 | 206 | 416 => Ok(()),
        code @ (401 | 403) => {
            let token =
                if has_token { "the token in HF_TOKEN may not read it" } else { "it may want a token in HF_TOKEN" };
            Err(lasting(url, io::ErrorKind::PermissionDenied, format!("the host refuses it (HTTP {code}): {token}")))
        }
        404 => Err(lasting(url, io::ErrorKind::NotFound, "the host has no such file (HTTP 404)".into())),
        code @ (408 | 425 | 429 | 500..) => {
            Err(Failure::Passing(format!("the host cannot serve it now (HTTP {code})")))
        }
        code => Err(lasting(url, io::ErrorKind::Other, format!("found HTTP {code}, expected the file"))),
    }
}

pub fn failure(url: &str, error: &ureq::Error, patience: Duration) -> Failure {
    match error {
        ureq::Error::Timeout(_) => Failure::Passing(format!("nothing came for {} s", patience.as_secs_f64())),
        ureq::Error::HostNotFound => Failure::Passing("the host's name cannot be resolved".into()),
        ureq::Error::Io(error) => Failure::Passing(error.to_string()),
        ureq::Error::ConnectionFailed | ureq::Error::ConnectProxyFailed(_) | ureq::Error::Protocol(_) => {
            Failure::Passing(error.to_string())
        }
        _ => lasting(url, io::ErrorKind::Other, error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redirects_stay_encrypted() {
        let hub = "https://hub.example/a/b";
        for (from, location, to) in [
            (hub, "/c?d", Some("https://hub.example/c?d")),
            (hub, "https://cdn.example/x", Some("https://cdn.example/x")),
            (hub, "http://cdn.example/x", None),
            (hub, "//cdn.example/x", None),
            (hub, "ftp://cdn.example/x", None),
            (hub, "x", None),
            (hub, "", None),
            ("http://127.0.0.1:1/a", "/b", Some("http://127.0.0.1:1/b")),
        ] {
            assert_eq!(redirected(from, location).as_deref(), to, "{location}");
        }
    }

    #[test]
    fn hashes_are_heard_from_the_hub_first() {
        let headers = |pairs: &[(&'static str, String)]| {
            pairs.iter().map(|(name, value)| (name.parse().unwrap(), value.parse().unwrap())).collect::<HeaderMap>()
        };
        let digest = |digit: &str| digit.repeat(64);
        let mut info = FileInfo::default();
        info.update(&headers(&[("etag", "\"abc\"".into())]), true);
        assert_eq!(info, FileInfo::default(), "an ETag that is no SHA-256");
        info.update(&headers(&[("etag", digest("c"))]), false);
        assert_eq!(info, FileInfo::default(), "the storage's own name for a file");
        let linked = [("x-linked-etag", format!("\"{}\"", digest("A"))), ("x-linked-size", "7".into())];
        info.update(&headers(&linked), true);
        info.update(&headers(&[("etag", format!("\"{}\"", digest("b")))]), true);
        assert_eq!(info, FileInfo { sha256: Some(digest("a")), size: Some(7) });
    }
}
