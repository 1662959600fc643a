use crate::{
    download::{Client, Lock, Promise, TAG, fetch, is_sha256, kept, promise},
    options::BUILTIN,
    outputs::size_of,
    released::{self, Kind, RELEASED, Released},
    session::Session,
    table::{Table, bytes},
};
use clap::{Args, Subcommand};
use indicatif::HumanCount;
use serde_json::json;
use std::{
    io::{IsTerminal, stdin},
    path::{Path, PathBuf},
    time::Duration,
};
use zipsplat::{
    Error, Result,
    weights::{Checkpoint, DepthCheckpoint, DepthHeads, Dtype},
};

/// List, download and locate named weights
///
/// `get` stores weights in the cache folder. Every --weights option accepts their names.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat weights list
  zipsplat weights get zipsplat
  zipsplat reconstruct photos/ --weights zipsplat -o scene.ply
  zipsplat weights get da3-small
  zipsplat depth photos/ --weights da3-small -o depth/
  zipsplat convert $(zipsplat weights path zipsplat) zipsplat-bf16.safetensors --dtype bf16")]
pub struct Weights {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Get(Get),
    List(List),
    Path(Where),
}

impl Weights {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        match &self.what {
            What::Get(get) => get.run(session),
            What::List(_) => list(session),
            What::Path(Where { name }) => {
                let path = released::find(name)?.ok_or_else(|| unknown(name))?;
                session.report(&json!({ "name": name, "path": path.to_string_lossy() }), path.display())
            }
        }
    }
}

/// List built-in, cached and downloadable weights, with size and license
#[derive(Args)]
struct List {}

/// Print the path of cached weights
#[derive(Args)]
struct Where {
    /// Name, such as zipsplat or da3-small
    name: String,
}

/// Download weights, check their SHA-256, and store them in the cache folder
///
/// Shows size and license and asks for confirmation. The SHA-256 comes from the host, over an
/// encrypted connection. Weights of ZipSplat are converted to f16 safetensors. Run the command
/// again to resume, or to check for updates.
#[derive(Args)]
#[command(after_help = "Environment:
  HF_ENDPOINT     a mirror in place of https://huggingface.co
  HF_TOKEN        a token for the host; storage that it redirects to does not get it
  HF_HUB_OFFLINE  1: as --offline
  HTTPS_PROXY, ALL_PROXY, NO_PROXY, SSL_CERT_FILE  as in other programs
  ZIPSPLAT_CACHE  the cache folder [default: zipsplat in the user's cache]")]
struct Get {
    name: String,
    /// Accept license and size without confirmation
    #[arg(long, short)]
    yes: bool,
    /// Use no network: only cached or downloaded files
    #[arg(long)]
    offline: bool,
    /// Keep the downloaded file after its conversion
    #[arg(long, alias = "keep")]
    keep_download: bool,
    /// Retry after this time without data
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = parse_seconds)]
    timeout: Duration,
    /// SHA-256 of the file, for mirrors that do not report it
    #[arg(long, value_name = "HEX", value_parser = parse_sha256)]
    sha256: Option<String>,
}

/// Announced over known size, against a wrong file or a full disk.
const MOST_TIMES: u64 = 2;

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.001..=86400.0).contains(seconds));
    seconds.map(Duration::from_secs_f64).ok_or_else(|| "expected a number of seconds, up to 86400".into())
}

fn parse_sha256(text: &str) -> Result<String, String> {
    if is_sha256(text) { Ok(text.to_lowercase()) } else { Err("expected 64 hexadecimal digits".into()) }
}

fn unknown(name: &str) -> Error {
    let names: Vec<&str> = RELEASED.iter().map(|released| released.name).collect();
    Error::argument("name of weights", name, names.join(", "))
}

impl Get {
    fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let released = Released::named(&self.name).ok_or_else(|| unknown(&self.name))?;
        let folder = released::folder()?;
        let pinned = |path: &PathBuf| match (&self.sha256, path.file_name()) {
            (Some(sha256), Some(name)) => name.to_string_lossy().contains(&format!("-{}", &sha256[..TAG])),
            _ => true,
        };
        let cached = released.cached(&folder).into_iter().find(pinned);
        if let Some(by) = self.offline.then_some("--offline").or(is_offline().then_some("HF_HUB_OFFLINE")) {
            return match (cached, released.loaded(&folder).into_iter().find(pinned)) {
                (Some(path), _) => report(session, released, &path),
                (None, Some(archive)) => {
                    let _lock = lock(session, released, &folder)?;
                    self.convert(session, released, &archive)
                }
                (None, None) => {
                    let found = format!("none in {}, and no network by {by}", folder.display());
                    let expected = format!("`{}` with a network, once", released.command());
                    Err(Error::argument(format!("weights {}", self.name), found, expected))
                }
            };
        }
        let client = Client::from_environment(self.timeout)?;
        let url = released.address(&client);
        let asked = session.stage("ask the host", |stage| promise(&client, &url, self.sha256.as_deref(), stage));
        let promise = match (asked, cached) {
            (Ok((promise, _)), _) => promise,
            (Err(error @ Error::Io { .. }), Some(path)) => {
                session.note(format!("{error}: whether there are newer weights is not known"));
                return report(session, released, &path);
            }
            (Err(error), _) => return Err(error),
        };
        if promise.size / MOST_TIMES > released.bytes {
            let expected = format!("about {}", bytes(released.bytes));
            return Err(Error::argument(format!("size of {url}"), bytes(promise.size), expected));
        }
        let loaded = promise.path(&released.base(&folder));
        let converted = released.converted(&loaded);
        let is_converted = || converted.is_file() && converted != loaded;
        let is_loaded = || loaded.metadata().is_ok_and(|found| found.len() == promise.size);
        if !is_converted() && !is_loaded() {
            self.consent(session, released, &promise, &released.base(&folder), &folder)?;
        }
        std::fs::create_dir_all(&folder).map_err(|error| Error::io(&folder, error))?;
        let _lock = lock(session, released, &folder)?;
        // Another process may have finished meanwhile.
        if is_converted() {
            return report(session, released, &converted);
        }
        if !is_loaded() {
            self.load(session, released, &client, &promise, &folder)?;
        }
        self.convert(session, released, &loaded)
    }

    fn load(
        &self,
        session: &mut Session<'_>,
        released: &Released,
        client: &Client,
        promise: &Promise,
        folder: &Path,
    ) -> Result<()> {
        let base = released.base(folder);
        let mut notes = Vec::new();
        let fetched = session.stage("load", |stage| fetch(client, promise, &base, stage, &mut notes));
        notes.iter().for_each(|note| session.note(note));
        if let (Err(_), Some((there, _))) = (&fetched, kept(&base)) {
            let command = released.command();
            session.note(format!(
                "{} of {} are kept: `{command}` goes on from there",
                bytes(there),
                bytes(promise.size)
            ));
        }
        fetched.map(drop)
    }

    fn consent(
        &self,
        session: &mut Session<'_>,
        released: &Released,
        promise: &Promise,
        base: &Path,
        folder: &Path,
    ) -> Result<()> {
        let there = match kept(base) {
            Some((there, known)) if known.sha256 == promise.sha256 => format!(" ({} are there)", bytes(there)),
            Some(_) => " (what is there is of an older file and is dropped)".into(),
            None => String::new(),
        };
        if let Some(older) = released.cached(folder).first() {
            session.note(format!("the host has newer weights than {}, which stays where it is", older.display()));
        }
        let Released { name, what, license: (license, terms), .. } = released;
        let size = bytes(promise.size);
        let offer = format!("{name}: {what}; {size} from {}{there}; license {license}: {terms}", promise.url);
        if self.yes {
            session.note(offer);
            return Ok(());
        }
        if !stdin().is_terminal() {
            let expected = format!("--yes, which accepts the license {license} ({terms}) and loads {size}");
            return Err(Error::argument("consent", "no --yes, and no terminal to ask on", expected));
        }
        let answer = session.ask(&format!("{offer}\nLoad it to {}? [y/N] ", folder.display()))?;
        let agrees = ["y", "yes"].contains(&answer.trim().to_lowercase().as_str());
        if agrees { Ok(()) } else { Err(Error::Cancelled) }
    }

    fn convert(&self, session: &mut Session<'_>, released: &Released, archive: &Path) -> Result<()> {
        let converted = released.converted(archive);
        if released.kind == Kind::Depth {
            // Rejects unusable files early.
            DepthCheckpoint::open(archive, DepthHeads::default())?;
            return report(session, released, archive);
        }
        let checkpoint = Checkpoint::open(archive, None)?;
        session.stage("convert", |stage| checkpoint.save_with(&converted, Dtype::F16, |done| stage.at(done)))?;
        drop(checkpoint);
        if !self.keep_download {
            std::fs::remove_file(archive).map_err(|error| Error::io(archive, error))?;
        }
        report(session, released, &converted)
    }
}

fn lock(session: &Session<'_>, released: &Released, folder: &Path) -> Result<Lock> {
    Ok(session.stage("wait for another process", |stage| Lock::new(&released.base(folder), stage))?.0)
}

fn is_offline() -> bool {
    let value = std::env::var("HF_HUB_OFFLINE").unwrap_or_default().to_lowercase();
    ["1", "true", "yes", "on"].contains(&value.as_str())
}

fn report(session: &mut Session<'_>, released: &Released, path: &Path) -> Result<()> {
    let Released { name, license: (license, _), .. } = released;
    let size = size_of(path)?;
    let json = json!({ "name": name, "path": path.to_string_lossy(), "bytes": size, "license": license });
    let kept = if released.kind == Kind::Tokens { ", f16" } else { "" };
    session.report(&json, format!("{}: {}{kept}; --weights {name} takes it", path.display(), bytes(size)))
}

fn list(session: &mut Session<'_>) -> Result<()> {
    let folder = released::folder()?;
    let mut table = Table::new(4, &["weights", "size", "license", "where", "what"]);
    let mut rows = Vec::new();
    if let Ok(embedded) = Checkpoint::builtin() {
        let what =
            format!("{} parameters, a demonstration", HumanCount(embedded.architecture().parameter_count() as u64));
        table.row([BUILTIN.into(), bytes(embedded.bytes()), "Apache-2.0".into(), "built in".into(), what.clone()]);
        rows.push(json!({
            "name": BUILTIN, "state": "built in", "bytes": embedded.bytes(), "license": "Apache-2.0", "path": null, "what": what,
        }));
    }
    for released in &RELEASED {
        let Released { name, what, license: (license, _), .. } = released;
        let cached = released.cached(&folder).into_iter().next();
        let (state, size, place) = match (&cached, kept(&released.base(&folder))) {
            (Some(path), _) => ("cached", size_of(path)?, path.display().to_string()),
            (None, Some((there, promise))) => {
                let place = format!("{} of it; `{}` goes on", bytes(there), released.command());
                ("begun", promise.size, place)
            }
            (None, None) => ("to get", released.bytes, format!("`{}`", released.command())),
        };
        table.row([(*name).into(), bytes(size), (*license).into(), place, (*what).into()]);
        rows.push(json!({
            "name": name, "state": state, "bytes": size, "license": license, "path": cached.map(|path| path.display().to_string()), "what": what,
            "command": released.command(),
        }));
    }
    session.report(&rows, table)
}
