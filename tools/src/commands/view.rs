//! `zipsplat view`: scenes in a browser.

use crate::{
    options::SceneInput,
    outputs::Overwrite,
    session::Session,
    table::{bytes, counted},
    viewer::{Config, InputCamera, Requests, Server, ShownScene, input_cameras, vertical, write_page},
};
use clap::Args;
use serde_json::json;
use std::{
    path::{Path, PathBuf},
    sync::atomic::Ordering,
};
use zipsplat::{
    Error, Result,
    types::{Scene, SceneFormat, WriteOptions, encode_scene, poses::Frame, read_world, spz_coarsening, write_atomic},
};

/// A scene in a browser, to look around in
///
/// With -o a page in one file, which needs nothing else and asks nobody for anything: open it by a double click, or mail it.
/// Otherwise the page is served on this machine, to whoever has the address that is printed, until Ctrl-C. Several scenes stand
/// behind one slider, such as one capture at several compression ratios. No GPU of this program's is used: the browser draws, by
/// the rules of `render`.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat view scene.ply
  zipsplat view scene.ply -o scene.html
  zipsplat view scene.ply --poses transforms.json
  zipsplat view tenth.ply half.ply all.ply -o compared.html")]
pub struct View {
    /// Scenes: PLY, SPZ, .splat or glTF
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    #[command(flatten)]
    input: SceneInput,
    /// Page to write; without it the page is served
    #[arg(long, short, value_name = "FILE.html")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Keep every bit of the scenes in the page, as PLY, and not a byte or a few for each value, as SPZ: up to ten times as large
    #[arg(long, requires = "output")]
    exact: bool,
    /// Cameras to look through, in the first scene's world: transforms.json, a COLMAP model's folder, and whatever else render
    /// --cameras takes
    #[arg(long, value_name = "PATH")]
    poses: Option<PathBuf>,
    /// Folder of the photos that the cameras took, to lay over the picture [default: where the cameras' file says]
    #[arg(long, value_name = "DIR", requires = "poses", conflicts_with = "output")]
    photos: Option<PathBuf>,
    /// Photo whose camera is the scene's world [default: the one that the scene's file names]
    #[arg(long, value_name = "PHOTO", requires = "poses")]
    relative_to: Option<PathBuf>,
    /// Port to serve at [default: a free one]
    #[arg(long, value_name = "N", default_value = "0", hide_default_value = true, conflicts_with = "output")]
    port: u16,
    /// Also open the page in the browser
    #[arg(long)]
    open: bool,
}

impl View {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        if let Some(output) = &self.output {
            let html = output.extension().is_some_and(|found| found == "html" || found == "htm");
            if !html {
                return Err(Error::argument("output", output.display(), "a page, FILE.html"));
            }
            self.overwrite.check_file(output)?;
        }
        let mut scenes = Vec::new();
        for path in &self.scenes {
            scenes.push(self.input.read(session, path)?.0);
        }
        let config = self.config(session)?;
        match &self.output {
            Some(output) => self.write(session, output, &config, &scenes),
            None => self.serve(session, &config, &scenes),
        }
    }

    fn config(&self, session: &mut Session<'_>) -> Result<Config> {
        let scene = |path: &PathBuf| {
            let bytes = path.metadata().map_err(|error| Error::io(path, error))?.len();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            Ok(ShownScene { name, bytes })
        };
        let cameras = self.cameras(session)?;
        let up = vertical(&cameras);
        Ok(Config { scenes: self.scenes.iter().map(scene).collect::<Result<_>>()?, cameras, up })
    }

    fn cameras(&self, session: &mut Session<'_>) -> Result<Vec<InputCamera>> {
        let Some(poses) = &self.poses else { return Ok(Vec::new()) };
        let world = read_world(&self.scenes[0])?;
        let photo_of = |frame: &Frame| match &self.photos {
            _ if self.output.is_some() => None,
            Some(folder) => Some(folder.join(Path::new(&frame.name).file_name()?)).filter(|file| file.is_file()),
            None => frame.photo.clone(),
        };
        let (cameras, notes) = input_cameras(poses, self.relative_to.as_deref(), world.as_ref(), photo_of)?;
        notes.iter().for_each(|note| session.note(note));
        if let Some(folder) = &self.photos
            && !cameras.iter().any(InputCamera::has_photo)
        {
            let expected = format!("photos of the names in {}", poses.display());
            return Err(Error::argument("--photos", folder.display(), expected));
        }
        Ok(cameras)
    }

    fn write(&self, session: &mut Session<'_>, output: &Path, config: &Config, scenes: &[Scene]) -> Result<()> {
        let format = if self.exact { SceneFormat::Ply } else { SceneFormat::Spz };
        if let Some(note) = scenes.iter().find_map(spz_coarsening).filter(|_| !self.exact) {
            session.note(format!("{note}; --exact keeps them"));
        }
        let (encoded, _) = session.stage("pack scenes", |stage| {
            stage.each(scenes, |scene| encode_scene(scene, format, &WriteOptions::default()))
        })?;
        session
            .stage("write page", |_| write_atomic(output, |out| write_page(out, config, Requests::None, &encoded)))?;
        let written = output.metadata().map_err(|error| Error::io(output, error))?.len();
        let gaussians: Vec<usize> = scenes.iter().map(Scene::len).collect();
        let json = json!({ "output": output, "gaussians": gaussians, "bytes": written });
        let all = counted(gaussians.iter().sum(), "Gaussian");
        session.report(&json, format!("{}: {all}, {}", output.display(), bytes(written)))?;
        if self.open { open_in_browser(output) } else { Ok(()) }
    }

    fn serve(&self, session: &mut Session<'_>, config: &Config, scenes: &[Scene]) -> Result<()> {
        let server = Server::new(self.port).map_err(|error| Error::io(format!("port {}", self.port), error))?;
        let address = server.address();
        session.report(&json!({ "address": address }), format!("{address}\nCtrl-C ends it."))?;
        if self.open {
            open_in_browser(Path::new(&address))?;
        }
        let cancelled = session.cancelled();
        let served = server.serve(|path| answer(path, config, scenes), || cancelled.load(Ordering::Relaxed));
        served.map_err(|error| Error::io(address, error))
    }
}

/// The answer for a path of the page's: the page itself, a scene with all its bits, or an input camera's photo.
fn answer(path: &str, config: &Config, scenes: &[Scene]) -> Result<Option<(&'static str, Vec<u8>)>> {
    if path.is_empty() {
        let mut page = Vec::new();
        write_page(&mut page, config, Requests::Server, &[]).map_err(|error| Error::io("page", error))?;
        return Ok(Some(("text/html; charset=utf-8", page)));
    }
    let number = |folder: &str| path.strip_prefix(folder)?.parse::<usize>().ok();
    if let Some(scene) = number("scene/").and_then(|i| scenes.get(i)) {
        let bytes = encode_scene(scene, SceneFormat::Ply, &WriteOptions::default())?;
        return Ok(Some(("application/octet-stream", bytes)));
    }
    match number("photo/").and_then(|i| config.cameras.get(i)) {
        Some(camera) => Ok(camera.jpeg()?.map(|bytes| ("image/jpeg", bytes))),
        None => Ok(None),
    }
}

fn open_in_browser(what: &Path) -> Result<()> {
    open::that_detached(what).map_err(|error| Error::io("browser", error))
}
