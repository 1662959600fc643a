use crate::{
    cameras::WorldPhoto,
    heic::is_heic,
    html::data_url,
    lifted,
    options::{Network, SceneInput, refuse, refuse_all},
    outputs::{Overwrite, size_of},
    refinement::with_cameras,
    session::Session,
    table::{bytes, counted},
    video::is_video,
    viewer::{
        Config, FromPhotos, InputCamera, Ready, Requests, Served, Server, ShownFeatures, ShownScene, Studio, Watched,
        input_cameras, vertical, write_page,
    },
};
use clap::Args;
use serde_json::json;
use std::{
    io::Write,
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::atomic::Ordering,
};
use tempfile::NamedTempFile;
use zipsplat::{
    Edit, Error, Result,
    types::{Image, SaveOptions, Scene, SceneFormat, poses::CaptureView, read_world, spz_coarsening, write_atomic},
    weights::DepthCheckpoint,
};

/// View scenes, or scenes made from photos, in a browser
///
/// A slider switches between several scene files. Photos are reconstructed at any ratio, and
/// refined live with --refine. -o writes a self-contained page. Otherwise the command serves the
/// page to anyone with the printed address until Ctrl-C.
///
/// With weights of Depth Anything 3 or VGGT, each confident pixel becomes a Gaussian, at the
/// --ratios; refine these with `reconstruct --refine`.
#[derive(Args)]
#[command(
    mut_args(with_cameras),
    after_help = "Examples:
  zipsplat view scene.ply
  zipsplat view scene.ply -o scene.html
  zipsplat view scene.ply --cameras transforms.json
  zipsplat view scene.ply --features features.safetensors -o objects.html
  zipsplat view photos/ --cameras transforms.json
  zipsplat view photos/ --cameras transforms.json --refine=200
  zipsplat view photos/ --ratios 1,0.3,0.1 -o ratios.html
  zipsplat view photos/ --weights da3-small --ratios 1,0.3
  zipsplat view tenth.ply half.ply all.ply -o compared.html"
)]
pub struct View {
    /// Scenes (PLY, SPZ, SOG, .splat or glTF), or photos (PNG, JPEG, WebP; HEIC with ffmpeg),
    /// folders of photos, and videos
    #[arg(required = true, value_name = "SCENES|PHOTOS")]
    files: Vec<PathBuf>,
    #[command(flatten)]
    input: SceneInput,
    /// Page to write instead of serving it
    #[arg(long, short, value_name = "FILE.html")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Store scenes as PLY instead of SPZ: exact, up to ten times as large
    #[arg(long, alias = "exact", requires = "output")]
    lossless: bool,
    /// Cameras to show, in the first scene's world, as for render --cameras; for photos, their
    /// known cameras, or colmap to estimate them [default with --refine: colmap]
    #[arg(long, value_name = "PATH|colmap")]
    cameras: Option<PathBuf>,
    /// Folder of photos for the overlay [default: that of the camera file; with -o, none]. A
    /// written page holds thumbnails
    #[arg(long, value_name = "DIR", requires = "cameras")]
    photos: Option<PathBuf>,
    #[command(flatten)]
    world_photo: WorldPhoto,
    /// Gaussians per token of the scene's file, for the token view
    #[arg(long, alias = "group", value_name = "N")]
    gaussians_per_token: Option<NonZeroUsize>,
    /// Features of the scenes, of `lift`, one file each: a click selects an object
    #[arg(long, value_name = "FILE", num_args = 1..)]
    features: Vec<PathBuf>,
    /// Port of the server [default: a free port]
    #[arg(long, value_name = "N", default_value = "0", hide_default_value = true, conflicts_with = "output")]
    port: u16,
    /// Also open the page in the browser
    #[arg(long)]
    open: bool,
    #[command(flatten)]
    from: FromPhotos,
}

const SMALL: u32 = 640;

impl View {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        if let Some(output) = &self.output {
            let html = output.extension().is_some_and(|found| found == "html" || found == "htm");
            if !html {
                return Err(Error::argument("output", output.display(), "a page, FILE.html"));
            }
            self.overwrite.check_file(output)?;
        }
        if self.is_of_photos()? { self.show_photos(session) } else { self.show_scenes(session) }
    }

    fn is_of_photos(&self) -> Result<bool> {
        let is_photo =
            |path: &PathBuf| path.is_dir() || is_video(path) || is_heic(path) || Image::size_as_stored(path).is_ok();
        let photos = self.files.iter().filter(|path| is_photo(path)).count();
        if photos != 0 && photos != self.files.len() {
            let other = self.files.iter().find(|path| !is_photo(path)).map(|path| path.display().to_string());
            let found = format!("{}, which is no photo, among {}", other.unwrap_or_default(), counted(photos, "photo"));
            return Err(Error::argument("files to view", found, "scenes alone, or photos alone"));
        }
        Ok(photos != 0)
    }

    fn show_scenes(&self, session: &mut Session<'_>) -> Result<()> {
        if let Some(option) = self.from.given() {
            return Err(Error::argument(option, "scenes", "photos, which it is for"));
        }
        lifted::check_count(&self.features, &self.files)?;
        let (mut scenes, mut shown) = (Vec::new(), Vec::new());
        for (i, path) in self.files.iter().enumerate() {
            let (mut scene, _) = self.input.read(session, path)?;
            let mut features = self.features.get(i).map(|file| lifted::open(file, &scene)).transpose()?;
            // A served page draws the first Gaussians early. Tokens need the order.
            if self.output.is_none() && self.gaussians_per_token.is_none() {
                let sorted = scene.edit(&[Edit::Sort], &[])?;
                features = features.map(|features| features.of(&sorted.sources));
                scene = sorted.scene;
            }
            scenes.push(scene);
            shown.push(ShownScene {
                name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                bytes: size_of(path)?,
                group: self.gaussians_per_token.map(NonZeroUsize::get),
                features: features.as_ref().map(ShownFeatures::new),
                ..ShownScene::default()
            });
        }
        let cameras = self.cameras(session)?;
        let mut config = Config { scenes: shown, up: vertical(&cameras), cameras, ..Config::default() };
        self.show(session, &mut config, &scenes)
    }

    fn show(&self, session: &mut Session<'_>, config: &mut Config, scenes: &[Scene]) -> Result<()> {
        match &self.output {
            Some(output) => self.write(session, output, config, scenes),
            None => self.serve(session, config, scenes, None, None),
        }
    }

    fn show_photos(&self, session: &mut Session<'_>) -> Result<()> {
        let options = [
            ("--gaussians-per-token", self.gaussians_per_token.is_some()),
            ("--features", !self.features.is_empty()),
            ("--photos", self.photos.is_some()),
            ("--relative-to", self.world_photo.relative_to.is_some()),
        ];
        refuse_all(options, "photos", "a scene's file")?;
        self.input.refuse_dropping("photos", "a scene's file")?;
        if !self.from.refines() {
            self.input.antialiasing.refuse("photos without --refine", "a scene's file, or with --refine")?;
        }
        let checkpoint = match self.from.weights.open_network()? {
            Network::Tokens(checkpoint) => checkpoint,
            Network::Pixels(checkpoint) => return self.show_pixels(session, &checkpoint),
        };
        let every = self.output.is_none() && !self.from.ratios.is_empty();
        refuse("--ratios", every, "a page that is served, whose slider has every ratio", "a page that is written")?;
        let mut ready = self.from.prepare(session, checkpoint, &self.files, self.cameras.as_deref())?;
        let watched = self.from.watched(session, &ready, self.input.antialiasing)?;
        let (grid, cameras) = (ready.live.grid(), std::mem::take(&mut ready.cameras));
        let mut config = Config {
            up: vertical(&cameras),
            cameras,
            views: ready.views(self.output.is_some())?,
            grid: [grid.rows, grid.columns],
            ..Config::default()
        };
        match &self.output {
            Some(output) => self.write_ratios(session, output, &mut config, &ready, watched.as_ref()),
            None => {
                config.live = Some(ready.live.ratios());
                config.refines = watched.is_some();
                self.serve(session, &mut config, &[], Some(&ready), watched.as_ref())
            }
        }
    }

    fn show_pixels(&self, session: &mut Session<'_>, checkpoint: &DepthCheckpoint) -> Result<()> {
        let mut made = self.from.of_pixels(session, checkpoint, &self.files, self.cameras.as_deref())?;
        let cameras = std::mem::take(&mut made.cameras);
        let (mut shown, scenes): (Vec<_>, Vec<_>) = std::mem::take(&mut made.scenes).into_iter().unzip();
        let note = format!("Made before the page was: {}; --ratios says which.", counted(scenes.len(), "ratio"));
        if self.output.is_none() {
            for (shown, scene) in shown.iter_mut().zip(&scenes) {
                shown.bytes = scene.encode(SceneFormat::Ply, &SaveOptions::default(), None)?.len() as u64;
            }
        }
        let up = vertical(&cameras);
        let mut config = Config { scenes: shown, up, cameras, note: Some(note), ..Config::default() };
        self.show(session, &mut config, &scenes)
    }

    fn write_ratios(
        &self,
        session: &mut Session<'_>,
        output: &Path,
        config: &mut Config,
        ready: &Ready<'_>,
        watched: Option<&Watched>,
    ) -> Result<()> {
        let (ratios, precision) = (self.from.ratios(ready.live.grid().tokens())?, ready.live.first_precision());
        let (mut made, _) = session.stage("reconstruct", |stage| {
            stage.each(&ratios, |ratio| {
                let mut made = ready.live.make(*ratio, precision, None)?;
                made.shown.name = format!("ratio {ratio}");
                Ok(made)
            })
        })?;
        if let Some(watched) = watched {
            session.stage("refine", |stage| watched.run(ready, |done| stage.at(done)))?;
            made.extend(watched.scene());
        }
        config.note = Some(format!(
            "This file holds {}; zipsplat view with the photos makes any.",
            counted(ratios.len(), "ratio")
        ));
        let mut scenes = Vec::new();
        for one in made {
            config.scenes.push(one.shown);
            scenes.push(one.scene);
        }
        self.write(session, output, config, &scenes)
    }

    fn cameras(&self, session: &mut Session<'_>) -> Result<Vec<InputCamera>> {
        let Some(poses) = &self.cameras else { return Ok(Vec::new()) };
        let world = read_world(&self.files[0])?;
        let photo_of = |frame: &CaptureView| match &self.photos {
            Some(folder) => Some(folder.join(Path::new(&frame.name).file_name()?)).filter(|file| file.is_file()),
            // Embedded only on request.
            None if self.output.is_some() => None,
            None => frame.photo.clone(),
        };
        let (cameras, notes) = input_cameras(poses, self.world_photo.relative_to.as_deref(), world.as_ref(), photo_of)?;
        notes.iter().for_each(|note| session.note(note));
        if let Some(folder) = &self.photos
            && !cameras.iter().any(InputCamera::has_photo)
        {
            let expected = format!("photos of the names in {}", poses.display());
            return Err(Error::argument("--photos", folder.display(), expected));
        }
        Ok(cameras)
    }

    fn write(&self, session: &mut Session<'_>, output: &Path, config: &mut Config, scenes: &[Scene]) -> Result<()> {
        let format = if self.lossless { SceneFormat::Ply } else { SceneFormat::Spz };
        if let Some(note) = scenes.iter().find_map(spz_coarsening).filter(|_| !self.lossless) {
            session.note(format!("{note}; --lossless keeps them"));
        }
        let (encoded, _) = session.stage("pack scenes", |stage| {
            stage.each(scenes, |scene| scene.encode(format, &SaveOptions::default(), None))
        })?;
        for (shown, bytes) in config.scenes.iter_mut().zip(&encoded).filter(|(shown, _)| shown.bytes == 0) {
            shown.bytes = bytes.len() as u64;
        }
        let (photos, _) = session.stage("pack photos", |stage| {
            let (mut count, mut packed) = (0, 0);
            let all = config.cameras.len();
            for (i, camera) in config.cameras.iter_mut().enumerate() {
                stage.reach(i as f64 / all as f64)?;
                if let Some(jpeg) = camera.jpeg(Some(SMALL))? {
                    let address = data_url(&jpeg);
                    (count, packed) = (count + 1, packed + address.len());
                    camera.at(address);
                }
            }
            Ok((count, packed + config.views.iter().map(|view| view.photo.len()).sum::<usize>()))
        })?;
        session
            .stage("write page", |_| write_atomic(output, |out| write_page(out, config, Requests::None, &encoded)))?;
        let written = size_of(output)?;
        let gaussians: Vec<usize> = scenes.iter().map(Scene::len).collect();
        let json = json!({
            "output": output.to_string_lossy(), "gaussians": gaussians, "bytes": written, "photos": photos.0, "photo_bytes": photos.1,
        });
        let all = counted(gaussians.iter().sum(), "Gaussian");
        let mut text = format!("{}: {all}, {}", output.display(), bytes(written));
        if photos.1 != 0 {
            text += &format!(", of which {} are pictures of photos", bytes(photos.1 as u64));
        }
        session.report(&json, text)?;
        if self.open { open_in_browser(output) } else { Ok(()) }
    }

    fn serve(
        &self,
        session: &mut Session<'_>,
        config: &mut Config,
        scenes: &[Scene],
        ready: Option<&Ready<'_>>,
        watched: Option<&Watched>,
    ) -> Result<()> {
        for (i, camera) in config.cameras.iter_mut().enumerate().filter(|(_, camera)| camera.has_photo()) {
            camera.at(format!("photo/{i}"));
        }
        let server = Server::new(self.port).map_err(|error| Error::io(format!("port {}", self.port), error))?;
        let address = server.address();
        session.report(&json!({ "address": address }), format!("{address}\nCtrl-C ends it."))?;
        // Other users can read the browser's command line, not this file with the secret address.
        let redirect = self.open.then(|| redirect(&address)).transpose()?;
        redirect.as_ref().map(|file| open_in_browser(file.path())).transpose()?;
        let cancelled = session.cancelled();
        let device = ready.map(|ready| &ready.live.device);
        let studio = Studio::new(device, session.device_options(), self.from.reading.ffmpeg.clone());
        let served = Served { config, scenes, ready, watched, studio: &studio, cancelled };
        std::thread::scope(|scope| {
            if let (Some(watched), Some(ready)) = (watched, ready) {
                // The page reports failures.
                scope.spawn(|| watched.run(ready, |_| ready.live.go_on()));
            }
            let stopped = || cancelled.load(Ordering::Relaxed);
            let ended = server.serve(|path, body| served.answer(path, body), stopped);
            watched.iter().for_each(|watched| watched.stop.store(true, Ordering::Relaxed));
            ended
        })
        .map_err(|error| Error::io(address, error))
    }
}

/// Private, deleted on drop.
fn redirect(address: &str) -> Result<NamedTempFile> {
    let failed = |error| Error::io(std::env::temp_dir(), error);
    let mut file = tempfile::Builder::new().prefix("zipsplat-").suffix(".html").tempfile().map_err(failed)?;
    write!(file, "<!doctype html><meta http-equiv=refresh content=\"0; url={address}\">").map_err(failed)?;
    Ok(file)
}

fn open_in_browser(what: &Path) -> Result<()> {
    open::that_detached(what).map_err(|error| Error::io("browser", error))
}
