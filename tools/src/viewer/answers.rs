use super::{
    Config, Live, Requests, Studio, Watched,
    live::LiveScene,
    page::{ShownScene, write_page},
    photos::Ready,
    recording::Wanted,
    server::Answer,
};
use serde_json::json;
use std::sync::atomic::{AtomicBool, Ordering};
use zipsplat::{
    Error, Result,
    ops::Precision,
    types::{SaveOptions, Scene, SceneFormat},
};

const BYTES: &str = "application/octet-stream";
const JSON: &str = "application/json";

pub struct Served<'a> {
    pub config: &'a Config,
    pub scenes: &'a [Scene],
    pub ready: Option<&'a Ready<'a>>,
    pub watched: Option<&'a Watched>,
    pub studio: &'a Studio,
    pub cancelled: &'a AtomicBool,
}

impl Served<'_> {
    /// `None` for unknown paths. Requests with side effects have a `body`.
    pub fn answer(&self, path: &str, body: Option<&[u8]>) -> Result<Option<Answer>> {
        match (path, body) {
            ("record", Some(body)) => self.record(body).map(Some),
            ("refining/stop", Some(_)) => Ok(self.watched.map(|watched| {
                watched.stop.store(true, Ordering::Relaxed);
                (JSON, b"{}".to_vec())
            })),
            (_, Some(_)) => Ok(None),
            ("", None) => self.page().map(Some),
            ("recording", None) => Ok(Some((JSON, json!({ "done": self.studio.done() }).to_string().into_bytes()))),
            ("refining", None) => Ok(self.watched.map(|watched| (JSON, watched.state()))),
            _ if path.starts_with("photo/") => self.photo(path),
            _ if path.starts_with("view/") => self.view(path),
            _ if path.starts_with("scene/") => {
                let Some(scene) = number(path, "scene/").and_then(|i| self.scenes.get(i)) else { return Ok(None) };
                Ok(Some((BYTES, scene.encode(SceneFormat::Ply, &SaveOptions::default(), None)?)))
            }
            _ if path.starts_with("features/") => {
                let shown = number(path, "features/").and_then(|i| self.config.scenes.get(i));
                Ok(shown.and_then(|shown| shown.features.as_ref()).map(|features| (BYTES, features.bytes.clone())))
            }
            _ => match self.made(path, false)? {
                Some(made) => Ok(Some((BYTES, made.encode()?))),
                None => Ok(None),
            },
        }
    }

    fn page(&self) -> Result<Answer> {
        let mut page = Vec::new();
        write_page(&mut page, self.config, Requests::Server, &[]).map_err(|error| Error::io("page", error))?;
        Ok(("text/html; charset=utf-8", page))
    }

    fn photo(&self, path: &str) -> Result<Option<Answer>> {
        let camera = number(path, "photo/").and_then(|i| self.config.cameras.get(i));
        let photo = camera.map(|camera| camera.jpeg(None)).transpose()?.flatten();
        Ok(photo.map(|bytes| ("image/jpeg", bytes)))
    }

    fn view(&self, path: &str) -> Result<Option<Answer>> {
        let (Some(ready), Some(i)) = (self.ready, number(path, "view/")) else { return Ok(None) };
        (i < ready.names.len()).then(|| Ok(("image/jpeg", ready.view(i)?))).transpose()
    }

    /// Scene at `refined` or `made/RATIO/PRECISION?NUMBER`. Higher numbers overtake it unless
    /// `kept`.
    fn made(&self, path: &str, kept: bool) -> Result<Option<LiveScene>> {
        if path == "refined" {
            return Ok(self.watched.and_then(Watched::scene));
        }
        let (Some(live), Some(asked)) = (self.live(), path.strip_prefix("made/").and_then(asked)) else {
            return Ok(None);
        };
        let (ratio, precision, number) = asked;
        if kept { live.make_unless(ratio, precision, || false) } else { live.make(ratio, precision, number) }.map(Some)
    }

    fn record(&self, body: &[u8]) -> Result<Answer> {
        let wanted: Wanted = serde_json::from_slice(body)
            .map_err(|error| Error::argument("recording", error, "a camera path, as the page sends it"))?;
        let missing = || Error::argument("scene to record", &wanted.scene, "one that this page was served");
        let made = match number(&wanted.scene, "scene/").and_then(|i| self.scenes.get(i)) {
            Some(scene) => LiveScene { scene: scene.clone(), shown: ShownScene::default() },
            None => self.made(&wanted.scene, true)?.ok_or_else(missing)?,
        };
        self.studio.record(&made.scene, &wanted, self.cancelled)
    }

    fn live(&self) -> Option<&Live<'_>> {
        self.ready.map(|ready| &ready.live)
    }
}

fn number(path: &str, folder: &str) -> Option<usize> {
    path.strip_prefix(folder)?.parse().ok()
}

/// `RATIO/PRECISION[?NUMBER]`.
fn asked(words: &str) -> Option<(f64, Precision, Option<u64>)> {
    let (words, number) = words.split_once('?').map_or((words, None), |(words, number)| (words, Some(number)));
    let (ratio, name) = words.split_once('/')?;
    let precision = Precision::ALL.into_iter().find(|precision| precision.name() == name)?;
    Some((ratio.parse().ok()?, precision, number.map(str::parse).transpose().ok()?))
}
