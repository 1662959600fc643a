//! `zipsplat render`: a scene to pictures.

use crate::{
    animation::{self, Animation},
    cameras::CameraArgs,
    outputs::{self, DEPTH_LEVELS},
    session::{Session, Stage},
};
use clap::{ArgGroup, Args};
use indicatif::HumanCount;
use rayon::prelude::*;
use serde_json::json;
use std::{
    io::Write,
    path::{Path, PathBuf},
    time::Duration,
};
use zipsplat::{
    Error, Result,
    stages::render::{Depth, Frame, RenderRequest, Renderer},
    types::{Camera, Image, contact_sheet, read_ply, resample::resize_lanczos},
};

/// Longest side of a contact sheet: pictures are made smaller to fit.
const SHEET_SIDE: u32 = 4096;
/// Pictures that are drawn before they are written, all at once.
const BATCH: u64 = 8;
/// Pixels of them together, where they are large.
const BATCH_PIXELS: u64 = 1 << 24;

/// Pictures of a scene
///
/// Into a folder go 000.png, 001.png and on, in the cameras' order, and contact.png with all of them; other files in it stay
/// as they are. World: x right, y down, z forward.
#[derive(Args)]
#[command(
    group(ArgGroup::new("result").required(true).multiple(true).args(["output", "video"])),
    after_help = "Examples:
  zipsplat render scene.ply --wiggle -o out/
  zipsplat render scene.ply --orbit --frames 120 --size 1280x720 --background 1,1,1 --video out.mp4
  zipsplat render scene.ply --spline transforms.json --relative-to images/000.jpg --loop --video out.gif
  zipsplat render scene.ply --cameras transforms.json --relative-to images/000.jpg --depth --alpha -o out/
  zipsplat render scene.ply --dolly --dolly-zoom -o - | ffplay -f rawvideo -pixel_format rgb24 -video_size 252x252 -"
)]
pub struct Render {
    /// Scene: a 3D Gaussian Splatting PLY
    scene: PathBuf,
    #[command(flatten)]
    path: CameraArgs,
    /// Colour behind the scene, each 0 to 1
    #[arg(long, value_name = "R,G,B", default_value = "0,0,0", value_parser = parse_color)]
    background: [f32; 3],
    /// Make what is thinner than a pixel fainter, as Mip-Splatting does
    #[arg(long)]
    antialiased: bool,
    /// Also write NNN.depth.png: 16-bit grey, 1000 levels a world unit, 0 where nothing is
    #[arg(long)]
    depth: bool,
    /// Also write NNN.alpha.png: 8-bit grey
    #[arg(long)]
    alpha: bool,
    /// Folder to write to, made where it is missing; -: the pictures' bytes, rgb24, one picture after another, to standard
    /// output
    #[arg(long, short, value_name = "FOLDER|-")]
    output: Option<PathBuf>,
    /// Write all pictures to one file: .gif, .apng or .png (animated, lossless), or .mp4 where ffmpeg is installed. No
    /// animated WebP: the encoder at hand writes single pictures only
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Pictures a second of --video
    #[arg(long, value_name = "N", default_value = "30", value_parser = clap::value_parser!(u16).range(1..=240),
        requires = "video")]
    fps: u16,
    /// Program that makes MP4
    #[arg(long, value_name = "PROGRAM", default_value = "ffmpeg", requires = "video")]
    ffmpeg: PathBuf,
}

/// Where pictures go.
#[derive(Default)]
struct Sinks<'a> {
    folder: Option<&'a Path>,
    /// Bytes of the pictures.
    raw: Option<&'a mut dyn Write>,
    animation: Option<Animation>,
}

fn parse_color(text: &str) -> Result<[f32; 3], String> {
    let values: Option<Vec<f32>> = text.split(',').map(|value| value.trim().parse().ok()).collect();
    let inside = |color: &[f32; 3]| color.iter().all(|c| (0.0..=1.0).contains(c));
    let color = values.and_then(|values| values.try_into().ok()).filter(inside);
    color.ok_or_else(|| "expected red, green and blue from 0 to 1, such as 1,1,1".into())
}

impl Render {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let mut sinks = self.sinks()?;
        let (scene, _) = session.stage("read scene", |_| read_ply(&self.scene))?;
        let (cameras, notes) = self.path.cameras(&scene)?;
        notes.iter().for_each(|note| session.note(note));
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("camera {i}"))?;
        }
        if sinks.folder.is_none() || sinks.animation.is_some() {
            animation::common_size(&cameras)?;
        }
        let request = RenderRequest {
            alpha: self.alpha,
            depth: self.depth.then_some(Depth::Expected),
            background: self.background,
            antialiased: self.antialiased,
            ..RenderRequest::default()
        };
        let device = session.device()?;
        let mut renderer = Renderer::new(&device);
        session.stage("load scene", |_| renderer.load(&scene))?;
        if self.is_piped() {
            sinks.raw = Some(session.take_output());
        }
        let (small, took) = session.stage("render", |stage| draw(&mut renderer, &cameras, &request, sinks, stage))?;
        if let Some(folder) = self.folder() {
            let columns = sheet_columns(cameras.len());
            session.stage("contact sheet", |_| contact_sheet(&small, columns)?.save_png(folder.join("contact.png")))?;
        }
        self.report(session, device.limits().name.clone(), scene.len(), &cameras, took)
    }

    fn is_piped(&self) -> bool {
        self.output.as_deref() == Some(Path::new("-"))
    }

    fn folder(&self) -> Option<&Path> {
        self.output.as_deref().filter(|_| !self.is_piped())
    }

    /// All but standard output, checked before any work.
    fn sinks(&self) -> Result<Sinks<'_>> {
        let folder = self.folder();
        folder.map_or(Ok(()), outputs::check_folder)?;
        if folder.is_none() && (self.depth || self.alpha) {
            return Err(Error::argument("--depth and --alpha", "no folder", "-o FOLDER to write them to"));
        }
        let animation = self.video.as_ref().map(|file| Animation::new(file, self.fps, &self.ffmpeg)).transpose()?;
        Ok(Sinks { folder, raw: None, animation })
    }

    fn report(
        &self,
        session: &mut Session<'_>,
        device: String,
        gaussians: usize,
        cameras: &[Camera],
        took: Duration,
    ) -> Result<()> {
        let seconds = took.as_secs_f64();
        let mut json = json!({
            "output": self.output, "video": self.video, "device": device, "gaussians": gaussians,
            "frames": cameras.len(), "seconds": seconds, "depth_levels_per_unit": self.depth.then_some(DEPTH_LEVELS),
        });
        let names: Vec<String> =
            [&self.output, &self.video].into_iter().flatten().map(|path| path.display().to_string()).collect();
        let mut text = format!(
            "{}: {} pictures of {} Gaussians on {device}, {:.1} a second with writing\n",
            names.join(", "),
            cameras.len(),
            HumanCount(gaussians as u64),
            cameras.len() as f64 / seconds.max(1e-9)
        );
        if self.folder().is_none() {
            let (width, height) = animation::common_size(cameras)?;
            json["size"] = json!([width, height]);
            text += &format!("size: {width}x{height}\n");
        }
        if self.depth {
            let most = f32::from(u16::MAX) / DEPTH_LEVELS;
            text += &format!("depth: {DEPTH_LEVELS} levels a world unit, up to {most} units");
        }
        session.report(&json, text)
    }
}

/// Draws every picture, some at a time, and brings them where they go. Returns those of a folder as small as its contact
/// sheet needs them.
fn draw(
    renderer: &mut Renderer,
    cameras: &[Camera],
    request: &RenderRequest,
    mut sinks: Sinks<'_>,
    stage: &Stage<'_>,
) -> Result<Vec<Image>> {
    let mut small = Vec::new();
    let mut encoder = None;
    let mut done = 0;
    for batch in cameras.chunks(batch(cameras)) {
        let mut frames = Vec::new();
        for camera in batch {
            stage.reach((done + frames.len()) as f64 / cameras.len() as f64)?;
            frames.extend(renderer.render_loaded(std::slice::from_ref(camera), request)?);
        }
        let images: Vec<Result<Image>> = frames.par_iter().map(image).collect();
        let images = images.into_iter().collect::<Result<Vec<Image>>>()?;
        // No sink is made before there is something to put into it.
        if let Some(folder) = sinks.folder {
            outputs::make_folder(folder)?;
            let save = |(i, (frame, image))| save(folder, done + i, frame, image, cameras.len());
            let saved: Vec<Result<Image>> = frames.par_iter().zip(&images).enumerate().map(save).collect();
            for image in saved {
                small.push(image?);
            }
        }
        if let Some(animation) = &sinks.animation {
            if encoder.is_none() {
                encoder = Some(animation.begin((images[0].width, images[0].height), cameras.len())?);
            }
            encoder.iter_mut().try_for_each(|encoder| encoder.push(&images))?;
        }
        if let Some(raw) = &mut sinks.raw {
            let written = images.iter().try_for_each(|image| raw.write_all(&image.rgb)).and_then(|()| raw.flush());
            written.map_err(|error| Error::io("standard output", error))?;
        }
        done += batch.len();
    }
    encoder.map_or(Ok(()), |encoder| encoder.finish(stage))?;
    Ok(small)
}

/// How many pictures are drawn before they are written: up to [`BATCH`], fewer where they are large.
fn batch(cameras: &[Camera]) -> usize {
    let pixels = |camera: &Camera| u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height);
    let largest = cameras.iter().map(pixels).max().unwrap_or(0).max(1);
    (BATCH_PIXELS / largest).clamp(1, BATCH) as usize
}

fn image(frame: &Frame) -> Result<Image> {
    Image::from_rgb_f32(frame.width, frame.height, frame.rgb.as_deref().unwrap_or_default())
}

/// Writes a picture and returns it as small as the contact sheet needs it.
fn save(folder: &Path, number: usize, frame: &Frame, image: &Image, frames: usize) -> Result<Image> {
    let &Frame { width, height, .. } = frame;
    let path = |suffix: &str| folder.join(format!("{number:03}{suffix}.png"));
    image.save_png(path(""))?;
    if let Some(depth) = &frame.depth {
        outputs::save_depth(&path(".depth"), width, height, depth)?;
    }
    if let Some(alpha) = &frame.alpha {
        outputs::save_alpha(&path(".alpha"), width, height, alpha)?;
    }
    let cell = SHEET_SIDE / sheet_columns(frames) as u32;
    if width.max(height) <= cell {
        return Ok(image.clone());
    }
    let scale = f64::from(cell) / f64::from(width.max(height));
    let [width, height] = [width, height].map(|side| ((f64::from(side) * scale) as u32).max(1));
    resize_lanczos(image, width, height)
}

/// As many columns as rows.
fn sheet_columns(frames: usize) -> usize {
    (1..).find(|columns| columns * columns >= frames).unwrap_or(frames)
}
