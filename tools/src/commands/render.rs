use crate::{
    animation::{self, Animation, MAX_FPS},
    cameras::CameraArgs,
    color,
    explain::Explanation,
    lifted, npy,
    options::{SceneInput, parse_length},
    outputs::{self, DEPTH_LEVELS, Overwrite},
    pictures::{self, SHEET, Sinks},
    session::Session,
    table::counted,
};
use clap::{ArgGroup, Args, Command, FromArgMatches, ValueEnum};
use serde_json::json;
use std::{
    num::NonZeroU32,
    path::{Path, PathBuf},
    time::Duration,
};
use zipsplat::{
    Error, Result,
    features::{FeatureRenderer, Lifted},
    stages::render::{Depth, RenderOptions, Renderer},
    types::{Camera, Scene, World, contact_sheet, read_world, write_atomic},
};

/// Render a scene along a camera path
///
/// Writes 000.png, 001.png and so on, and a contact sheet, contact.png. Removes surplus pictures of
/// an earlier run. The scene's world is the first photo's camera (x right, y down, z forward), or
/// that of known cameras.
#[derive(Args)]
#[command(
    group(ArgGroup::new("result").required(true).multiple(true).args(["output", "video"])),
    after_help = "Examples:
  zipsplat render scene.ply --wiggle -o out/
  zipsplat render scene.ply --orbit --frames 120 --size 1280x720 --background white --video out.mp4
  zipsplat render scene.ply --spline transforms.json --relative-to images/000.jpg --loop --video out.gif
  zipsplat render scene.ply --cameras transforms.json --relative-to images/000.jpg --depth --alpha -o out/
  zipsplat render scene.ply --dolly --dolly-zoom -o - | ffplay -f rawvideo -pixel_format rgb24 -video_size 252x252 -"
)]
pub struct Render {
    /// Scene: PLY, SPZ, SOG, .splat or glTF
    scene: PathBuf,
    #[command(flatten)]
    input: SceneInput,
    #[command(flatten)]
    pub path: CameraArgs,
    /// Color behind the scene: red, green and blue from 0 to 1, '#rrggbb', or a basic CSS color
    /// such as white
    #[arg(long, value_name = "COLOR", default_value = "0,0,0", value_parser = color::parse)]
    background: [f32; 3],
    /// Also write NNN.depth.png: 16-bit gray, 1000 levels per world unit, 0 without Gaussians
    #[arg(long, value_name = "KIND", num_args = 0..=1, require_equals = true, default_missing_value = "expected")]
    depth: Option<DepthKind>,
    /// Also write NNN.alpha.png: 8-bit gray
    #[arg(long)]
    alpha: bool,
    /// Also write NNN.normal.png: the Gaussians' shortest axes, facing the camera; world x, y, z
    /// from -1 to 1 as red, green, blue from 0 to 255
    #[arg(long)]
    normals: bool,
    /// Also write NNN.tokens.png: a color per token, which is N consecutive Gaussians
    #[arg(long, alias = "group", value_name = "N")]
    gaussians_per_token: Option<NonZeroU32>,
    /// Also write NNN.features.npy: features of `lift`, f32 [height, width, channels]
    #[arg(long, value_name = "FILE", requires = "output", conflicts_with = "point_size")]
    features: Option<PathBuf>,
    /// Draw each Gaussian as an opaque dot of this width in the scene's unit
    #[arg(long, alias = "points", value_name = "SIZE", value_parser = parse_length)]
    point_size: Option<f64>,
    /// Also print the first picture's time and memory by pass, and why effects are skipped
    #[arg(long)]
    explain: bool,
    /// Folder to write to, created if missing; -: raw rgb24 pictures in order, to standard output
    #[arg(long, short, value_name = "FOLDER|-")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Write all pictures to one file: .gif, .apng or .png (animated, lossless), .mp4 with ffmpeg
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Pictures per second of --video
    #[arg(long, value_name = "N", default_value = "30", value_parser = clap::value_parser!(u16).range(1..=i64::from(MAX_FPS)),
        requires = "video")]
    fps: u16,
    /// Program that encodes MP4
    #[arg(long, value_name = "PROGRAM", default_value = "ffmpeg", requires = "video")]
    ffmpeg: PathBuf,
}

/// Full width at half maximum, in standard deviations.
const WIDTH: f64 = 2.354_820_045;

#[derive(Clone, Copy, ValueEnum)]
enum DepthKind {
    /// Mean visible depth
    Expected,
    /// Depth times weight, summed over Gaussians
    Accumulated,
}

impl Render {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.check()?;
        let (mut scene, dropped) = self.input.read(session, &self.scene)?;
        if let Some(size) = self.point_size {
            scene.scales.fill([(size / WIDTH) as f32; 3]);
            scene.opacities.fill(1.0);
        }
        let world = read_world(&self.scene)?;
        let device = session.device()?;
        let mut renderer = Renderer::new(&device);
        let load = |session: &mut Session<'_>, renderer: &mut Renderer| {
            session.stage("load scene", |_| renderer.set_scene(&scene)).map(drop)
        };
        let features = self.features.as_ref().map(|path| lifted::open(path, &scene)).transpose()?;
        let (json, text) = self.draw(session, &mut renderer, &scene, dropped, world.as_ref(), load)?;
        if let (Some(Lifted { features, .. }), Some(folder)) = (&features, self.folder()) {
            let (cameras, _) = self.path.cameras(&scene, world.as_ref())?;
            let mut drawer = FeatureRenderer::new(&device);
            session.stage("features", |stage| {
                stage.each(&cameras.iter().enumerate().collect::<Vec<_>>(), |(i, camera)| {
                    let drawn = drawer.draw(&scene, features, &[**camera])?.remove(0);
                    let bytes = npy::encode(&[drawn.height, drawn.width, drawn.channels as u32], &drawn.values);
                    write_atomic(&folder.join(format!("{i:03}.features.npy")), |out| out.write_all(&bytes))
                })
            })?;
        }
        session.report(&json, text)
    }

    /// `load` uploads the scene once its cameras are checked.
    pub fn draw(
        &self,
        session: &mut Session<'_>,
        renderer: &mut Renderer,
        scene: &Scene,
        dropped: usize,
        world: Option<&World>,
        load: impl FnOnce(&mut Session<'_>, &mut Renderer) -> Result<()>,
    ) -> Result<(serde_json::Value, String)> {
        let mut sinks = self.sinks()?;
        let (cameras, notes) = self.path.cameras(scene, world)?;
        notes.iter().for_each(|note| session.note(note));
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("camera {i}"))?;
        }
        if sinks.folder.is_none() || sinks.animation.is_some() {
            animation::common_size(&cameras)?;
        }
        let request = self.request();
        if let Some(folder) = self.folder() {
            self.overwrite.check_replaced(pictures::files(folder, cameras.len(), &request))?;
        }
        load(session, renderer)?;
        if self.is_piped() {
            sinks.raw = Some(session.take_output());
        }
        let (drawn, took) =
            session.stage("render", |stage| pictures::draw(renderer, &cameras, &request, sinks, stage))?;
        if let Some(folder) = self.folder() {
            let columns = pictures::sheet_columns(cameras.len());
            session.stage("contact sheet", |_| {
                outputs::save_picture(&folder.join(SHEET), &contact_sheet(&drawn.small, columns)?)?;
                outputs::remove_stale(folder, cameras.len(), "png", outputs::is_own)
            })?;
        }
        let explanation = match cameras.first() {
            Some(camera) if self.explain => {
                Some(Explanation::of_kernels(&renderer.profile(camera, &request)?, renderer.skipped_passes(&request)))
            }
            _ => None,
        };
        let device = renderer.device().limits().name.clone();
        if drawn.empty {
            session.note(format!("no picture shows anything but the background{}", self.path.doubt()));
        }
        self.report(device, [scene.len(), dropped], &cameras, took, explanation)
    }

    pub fn check(&self) -> Result<()> {
        self.sinks()?;
        let check = |folder| self.overwrite.check_replaced(pictures::files(folder, 1, &self.request()));
        self.folder().map_or(Ok(()), check)
    }

    pub fn of_words(scene: &Path, folder: &Path, force: bool, words: &[String]) -> Result<Self> {
        let command = Self::augment_args(Command::new("--pictures").no_binary_name(true));
        let own = [scene.as_os_str(), "--output".as_ref(), folder.as_os_str()];
        let force = force.then_some("--overwrite".as_ref());
        let words = own.into_iter().chain(force).chain(words.iter().map(AsRef::as_ref));
        let found = command.try_get_matches_from(words).and_then(|matches| Self::from_arg_matches(&matches));
        if found.as_ref().is_ok_and(|found| found.point_size.is_some()) {
            let expected = "none: the Gaussians stay on the device as they are; render the scene's file";
            return Err(Error::argument("words behind --", "--point-size", expected));
        }
        found.map_err(|error| {
            let text = error.to_string();
            let text = text.lines().next().unwrap_or_default().trim_start_matches("error: ").to_owned();
            Error::argument("words behind --", text, "options of zipsplat render")
        })
    }

    fn request(&self) -> RenderOptions {
        let depth = |kind| match kind {
            DepthKind::Expected => Depth::Expected,
            DepthKind::Accumulated => Depth::Accumulated,
        };
        RenderOptions {
            rgb: true,
            alpha: self.alpha,
            depth: self.depth.map(depth),
            normals: self.normals,
            token_group: self.gaussians_per_token,
            background: self.background,
            antialiased: self.input.antialiasing.antialiased,
            near: None,
        }
    }

    fn is_piped(&self) -> bool {
        self.output.as_deref() == Some(Path::new("-"))
    }

    fn folder(&self) -> Option<&Path> {
        self.output.as_deref().filter(|_| !self.is_piped())
    }

    fn sinks(&self) -> Result<Sinks<'_>> {
        let folder = self.folder();
        folder.map_or(Ok(()), outputs::check_folder)?;
        if folder.is_none() && self.request().channels() > 3 {
            let what = "--depth, --alpha, --normals and --gaussians-per-token";
            return Err(Error::argument(what, "no folder", "-o FOLDER to write them to"));
        }
        self.video.as_ref().map_or(Ok(()), |file| self.overwrite.check_file(file))?;
        let animation = self.video.as_ref().map(|file| Animation::new(file, self.fps, &self.ffmpeg)).transpose()?;
        Ok(Sinks { folder, raw: None, animation })
    }

    fn report(
        &self,
        device: String,
        [gaussians, dropped]: [usize; 2],
        cameras: &[Camera],
        took: Duration,
        explanation: Option<Explanation>,
    ) -> Result<(serde_json::Value, String)> {
        let seconds = took.as_secs_f64();
        let [output, video] = [&self.output, &self.video].map(|path| path.as_ref().map(|path| path.to_string_lossy()));
        let mut json = json!({
            "output": output, "video": video, "device": device, "gaussians": gaussians, "dropped": dropped,
            "frames": cameras.len(), "seconds": seconds, "depth_levels_per_unit": self.depth.map(|_| DEPTH_LEVELS),
        });
        let names: Vec<_> = output.into_iter().chain(video).collect();
        let mut text = format!(
            "{}: {} of {} on {device}, {:.1} a second with writing\n",
            names.join(", "),
            counted(cameras.len(), "picture"),
            counted(gaussians, "Gaussian"),
            cameras.len() as f64 / seconds.max(1e-9)
        );
        if self.folder().is_none() {
            let (width, height) = animation::common_size(cameras)?;
            json["size"] = json!([width, height]);
            text += &format!("size: {width}x{height}\n");
        }
        if self.depth.is_some() {
            let most = f32::from(u16::MAX) / DEPTH_LEVELS;
            text += &format!("depth: {DEPTH_LEVELS} levels a world unit, up to {most} units\n");
        }
        if let Some(explanation) = explanation {
            text += &format!("\n{explanation}");
            json["explain"] = json!(explanation);
        }
        Ok((json, text))
    }
}
