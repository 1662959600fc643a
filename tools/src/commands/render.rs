//! `zipsplat render`: a scene to pictures.

use crate::{
    cameras::{self, CameraPath},
    options::Size,
    outputs::{self, DEPTH_LEVELS},
    session::{Session, Stage},
};
use clap::{ArgGroup, Args};
use indicatif::HumanCount;
use rayon::prelude::*;
use serde_json::json;
use std::path::PathBuf;
use zipsplat::{
    Result,
    stages::render::{Depth, Frame, RenderRequest, Renderer},
    types::{Camera, Image, Scene, contact_sheet, read_scene, resample::resize_lanczos},
};

/// Longest side of a contact sheet: pictures are made smaller to fit.
const SHEET_SIDE: u32 = 4096;
/// Pictures that are drawn before they are written, all at once.
const BATCH: usize = 8;

/// Pictures of a scene
///
/// Writes 000.png, 001.png and on, in the cameras' order, and contact.png with all of them. Other files in the folder
/// stay as they are. World: x right, y down, z forward.
#[derive(Args)]
#[command(
    group(ArgGroup::new("path").required(true).args(["cameras", "orbit", "wiggle"])),
    after_help = "Examples:
  zipsplat render scene.ply --wiggle -o out/
  zipsplat render scene.ply --orbit --frames 120 --size 1280x720 --background 1,1,1 -o out/
  zipsplat render scene.ply --cameras transforms.json --relative-to images/000.jpg --depth --alpha -o out/"
)]
pub struct Render {
    /// Scene: PLY, SPZ, .splat or glTF
    scene: PathBuf,
    /// Cameras to draw: transforms.json, or a COLMAP model's folder
    #[arg(long, value_name = "PATH")]
    cameras: Option<PathBuf>,
    /// Photo whose camera is the scene's world: the first that was given to reconstruct [default: the file's own world]
    #[arg(long, value_name = "PHOTO", requires = "cameras")]
    relative_to: Option<PathBuf>,
    /// Once around the scene
    #[arg(long)]
    orbit: bool,
    /// A small figure of eight in front of the scene
    #[arg(long)]
    wiggle: bool,
    /// Pictures of --orbit or --wiggle
    #[arg(long, value_name = "N", default_value = "60", value_parser = clap::value_parser!(u32).range(1..=100_000),
        conflicts_with = "cameras")]
    frames: u32,
    /// Size of the pictures [default: the cameras' own, else 252x252]
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// Horizontal field of view of --orbit and --wiggle, in degrees
    #[arg(long, value_name = "DEG", default_value = "60", conflicts_with = "cameras")]
    fov: f64,
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
    /// Folder to write to, made where it is missing
    #[arg(long, short, value_name = "FOLDER")]
    output: PathBuf,
}

fn parse_color(text: &str) -> Result<[f32; 3], String> {
    let values: Option<Vec<f32>> = text.split(',').map(|value| value.trim().parse().ok()).collect();
    let inside = |color: &[f32; 3]| color.iter().all(|c| (0.0..=1.0).contains(c));
    let color = values.and_then(|values| values.try_into().ok()).filter(inside);
    color.ok_or_else(|| "expected red, green and blue from 0 to 1, such as 1,1,1".into())
}

impl Render {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        outputs::check_folder(&self.output)?;
        let (scene, _) = session.stage("read scene", |_| read_scene(&self.scene))?;
        let cameras = self.cameras(session, &scene)?;
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("camera {i}"))?;
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
        let (small, took) = session.stage("render", |stage| self.draw(&mut renderer, &cameras, &request, stage))?;
        let columns = sheet_columns(cameras.len());
        session
            .stage("contact sheet", |_| contact_sheet(&small, columns)?.save_png(self.output.join("contact.png")))?;

        let seconds = took.as_secs_f64();
        let json = json!({
            "output": self.output, "device": device.limits().name, "gaussians": scene.len(), "frames": cameras.len(),
            "seconds": seconds, "depth_levels_per_unit": self.depth.then_some(DEPTH_LEVELS),
        });
        let mut text = format!(
            "{}: {} pictures of {} Gaussians on {}, {:.1} a second with writing\n",
            self.output.display(),
            cameras.len(),
            HumanCount(scene.len() as u64),
            device.limits().name,
            cameras.len() as f64 / seconds.max(1e-9)
        );
        if self.depth {
            let most = f32::from(u16::MAX) / DEPTH_LEVELS;
            text += &format!("depth: {DEPTH_LEVELS} levels a world unit, up to {most} units");
        }
        session.report(&json, text)
    }

    fn cameras(&self, session: &mut Session<'_>, scene: &Scene) -> Result<Vec<Camera>> {
        if let Some(path) = &self.cameras {
            let (cameras, notes) = cameras::of_file(path, self.relative_to.as_deref(), self.size)?;
            notes.iter().for_each(|note| session.note(note));
            return Ok(cameras);
        }
        let path = if self.orbit { CameraPath::Orbit } else { CameraPath::Wiggle };
        cameras::along(path, scene, self.frames as usize, self.size.unwrap_or(Size(252, 252)), self.fov)
    }

    /// Draws and writes every picture. Returns them as small as the contact sheet needs them.
    fn draw(
        &self,
        renderer: &mut Renderer,
        cameras: &[Camera],
        request: &RenderRequest,
        stage: &Stage<'_>,
    ) -> Result<Vec<Image>> {
        let mut small = Vec::new();
        for batch in cameras.chunks(BATCH) {
            let mut frames = Vec::new();
            for camera in batch {
                stage.reach((small.len() + frames.len()) as f64 / cameras.len() as f64)?;
                frames.extend(renderer.render_loaded(std::slice::from_ref(camera), request)?);
            }
            // Not before there is something to put into it.
            outputs::make_folder(&self.output)?;
            let first = small.len();
            let saved: Vec<Result<Image>> =
                frames.par_iter().enumerate().map(|(i, frame)| self.save(first + i, frame, cameras.len())).collect();
            for image in saved {
                small.push(image?);
            }
        }
        Ok(small)
    }

    fn save(&self, number: usize, frame: &Frame, frames: usize) -> Result<Image> {
        let &Frame { width, height, .. } = frame;
        let path = |suffix: &str| self.output.join(format!("{number:03}{suffix}.png"));
        let rgb = frame.rgb.as_deref().unwrap_or_default();
        let image = Image::from_rgb_f32(width, height, rgb)?;
        image.save_png(path(""))?;
        if let Some(depth) = &frame.depth {
            outputs::save_depth(&path(".depth"), width, height, depth)?;
        }
        if let Some(alpha) = &frame.alpha {
            outputs::save_alpha(&path(".alpha"), width, height, alpha)?;
        }
        let cell = SHEET_SIDE / sheet_columns(frames) as u32;
        if width.max(height) <= cell {
            return Ok(image);
        }
        let scale = f64::from(cell) / f64::from(width.max(height));
        let [width, height] = [width, height].map(|side| ((f64::from(side) * scale) as u32).max(1));
        resize_lanczos(&image, width, height)
    }
}

/// As many columns as rows.
fn sheet_columns(frames: usize) -> usize {
    (1..).find(|columns| columns * columns >= frames).unwrap_or(frames)
}
