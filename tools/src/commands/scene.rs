use crate::{
    options::Size,
    outputs::{self, Overwrite},
    procedural::{Options, Photos, Setup, WideLens, WideModel, files, shards, write_folder, write_wide},
    session::Session,
    table::counted,
};
use clap::Args;
use serde_json::json;
use std::{
    io::{BufWriter, ErrorKind, Write},
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::atomic::Ordering,
    time::Instant,
};
use zipsplat::{
    Error, Result,
    types::{Origin, Pose, SaveOptions, World, write_atomic},
};

/// About one scene of 10 views at 126x126.
const BUFFER: usize = 1 << 20;

/// Generate procedural scenes: photos with exact depth and cameras
///
/// Writes images/000.png, depth/000.npy (f32, 0 in the sky), labels/000.png (number of the visible
/// surface, the largest first; 255: sky and others) and so on, transforms.json, points.ply with
/// visible points, and scene.json. The world is the first photo's camera, x right, y down, z
/// forward; the unit is the median visible distance from it.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat scene --seed 7 --views 24 -o scene/
  zipsplat scene --shards - --views 10 --size 126x126 --textures crops/ | python train.py
  zipsplat scene --shards unseen.bin --first-seed 1000000 --scenes 100")]
pub struct Scene {
    /// Seed of the scene; with --shards of the first
    #[arg(long, visible_alias = "first-seed", value_name = "N", default_value = "0")]
    seed: u64,
    /// Photos of a scene
    #[arg(long, value_name = "N", default_value = "24")]
    views: usize,
    /// Size of the photos
    #[arg(long, value_name = "WxH", default_value = "252x252")]
    size: Size,
    /// Square photo crops with a manifest.json; permissively licensed ones become surfaces
    #[arg(long, value_name = "FOLDER")]
    textures: Option<PathBuf>,
    /// Four rays per pixel; otherwise three at edges and one elsewhere
    #[arg(long)]
    supersample: bool,
    /// Also write splats.ply: one Gaussian per surface pixel, from exact depth
    #[arg(long, conflicts_with = "shards")]
    splats: bool,
    /// Photos of a wide lens, without depth
    #[arg(long, value_enum, value_name = "MODEL", requires = "wide_size", conflicts_with = "shards")]
    camera_model: Option<WideModel>,
    /// Size of the photos of --camera-model; --size is that of the photos that choose the path
    #[arg(long, value_name = "WxH", requires = "camera_model")]
    wide_size: Option<Size>,
    /// Folder to write to, created if missing
    #[arg(long, short, value_name = "FOLDER", required_unless_present = "shards", conflicts_with = "shards")]
    output: Option<PathBuf>,
    /// Stream scenes as flat binary for training, to a file or with - to standard output
    #[arg(long, value_name = "FILE|-")]
    shards: Option<PathBuf>,
    /// Number of streamed scenes [default: until the reader closes the pipe]
    #[arg(long, value_name = "N", requires = "shards")]
    scenes: Option<u64>,
    #[command(flatten)]
    overwrite: Overwrite,
}

impl Scene {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let options = Options {
            views: self.views,
            width: self.size.0,
            height: self.size.1,
            supersample: self.supersample,
            random_first: self.shards.is_some(),
        };
        options.validate()?;
        let photos = self.textures.as_deref().map_or_else(|| Ok(Photos::default()), Photos::open)?;
        match (&self.shards, &self.output) {
            (Some(path), _) => self.stream(path, &options, &photos, session),
            (None, Some(folder)) => self.write(folder, &options, &photos, session),
            (None, None) => Err(Error::argument("output", "nothing", "a folder or --shards")),
        }
    }

    fn write(&self, folder: &Path, options: &Options, photos: &Photos, session: &mut Session<'_>) -> Result<()> {
        outputs::check_folder(folder)?;
        let splats = self.splats.then(|| folder.join("splats.ply"));
        self.overwrite.check_replaced(files(folder, self.views).into_iter().chain(splats.clone()))?;
        let wide = self.camera_model.zip(self.wide_size);
        let wide = wide.map(|(model, Size(width, height))| WideLens::new(model, width, height)).transpose()?;
        let ((capture, wide), took) = session.stage("take photos", |stage| {
            let go_on = || stage.check();
            let setup = Setup::new(self.seed, options, photos, &go_on)?;
            let images = wide.as_ref().map(|lens| setup.shoot_wide(lens, photos, &go_on)).transpose()?;
            Ok((setup.shoot(photos, &go_on)?, wide.zip(images)))
        })?;
        session.stage("write", |_| {
            write_folder(folder, &capture, &photos.crops)?;
            wide.map_or(Ok(()), |(lens, images)| write_wide(folder, &capture, &lens, &images))?;
            let Some(path) = splats else { return Ok(()) };
            let world = World::from(Origin::Cameras(Pose::IDENTITY));
            let (splats, options) = (capture.splats(), SaveOptions::default());
            outputs::save_scene(&path, &splats, &options, Some(&world)).map(drop)
        })?;
        let seconds = took.as_secs_f64();
        let json = json!({
            "output": folder.to_string_lossy(), "seed": self.seed, "family": capture.family, "path": capture.path,
            "views": self.views, "seconds": seconds,
        });
        let text = format!(
            "{}: {} of a {} on {}, {seconds:.2} s without writing",
            folder.display(),
            counted(self.views, "photo"),
            capture.family,
            capture.path
        );
        session.report(&json, text)
    }

    fn stream(&self, path: &Path, options: &Options, photos: &Photos, session: &mut Session<'_>) -> Result<()> {
        let to_stdout = path == Path::new("-");
        // A pipe ends with its reader; a file would fill the disk.
        let is_pipe = to_stdout || path.metadata().is_ok_and(|found| !found.is_file() && !found.is_dir());
        if self.scenes.is_none() && !is_pipe {
            return Err(Error::argument("--scenes", "nothing", "a number, as the stream goes to a file"));
        }
        let end = self.scenes.map_or(u64::MAX, |scenes| self.seed.saturating_add(scenes));
        let (started, cancelled, mut count) = (Instant::now(), session.cancelled(), 0);
        let mut write = |out: &mut dyn Write| {
            let written = |done| {
                count = done;
                if cancelled.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            shards::write(BufWriter::with_capacity(BUFFER, out), self.seed..end, options, photos, written)
        };
        let result = if to_stdout {
            write(session.take_output()).map_err(|source| Error::io("standard output", source))
        } else {
            self.overwrite.check_file(path)?;
            write_atomic(path, write)
        };
        match result {
            Err(Error::Io { source, .. }) if source.kind() == ErrorKind::BrokenPipe => {}
            Err(Error::Io { source, .. }) if source.kind() == ErrorKind::Interrupted => return Err(Error::Cancelled),
            other => other?,
        }
        let rate = count as f64 / started.elapsed().as_secs_f64();
        let text = format!("{}: {}, {rate:.1} a second", path.display(), counted(count as usize, "scene"));
        session.report(&json!({"output": path.to_string_lossy(), "scenes": count, "scenes_per_second": rate}), text)
    }
}
