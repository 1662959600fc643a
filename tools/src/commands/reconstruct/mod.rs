mod captured;
mod each;
mod finished;
mod forward;
mod pixels;
mod placed;
mod plan;
mod refined;
mod world;

use super::render::Render;
use crate::{
    blocks::BlockArgs,
    cameras::{EstimatedCameras, Finding, KnownCameras, Place},
    options::{Antialiasing, Network, Quality, Size, Weights, parse_length, refuse},
    outputs::Overwrite,
    photos::{PhotoArgs, Photographed},
    refinement::{self, Initialization, RefineArgs, has_stable_cameras, placed},
    session::Session,
    views::CropOption,
};
use clap::{Arg, ArgGroup, Args};
use each::Batch;
use finished::Finished;
use forward::Forward;
use refined::{From, RefineInputs};
use std::{
    path::{Path, PathBuf},
    time::Duration,
};
use world::WorldName;
use zipsplat::{
    Error, Result,
    gpu::Device,
    reconstruct::MAX_VIEWS,
    types::{
        PointCloud, Pose,
        poses::{Capture, CaptureView, read_cloud},
    },
};

const CAPTURE: &str = "capture";
const NETWORK: &str = "Network";
const CAMERAS: &str = "Cameras";
const MANY: &str = "Many captures";
const REFINEMENT: &str = "Refinement";

/// Reconstruct a scene of 3D Gaussians from photos of a place
///
/// The network computes a token per patch of 14 x 14 pixels; each selected token becomes several
/// Gaussians. The scene's world is the first photo's camera (x right, y down, z forward), see
/// --world.
///
/// With weights of Depth Anything 3 or VGGT, each confident pixel becomes a Gaussian at its depth,
/// and the network also estimates the cameras. --input-size is then the longer side, and
/// --max-gaussians-per-token limits the pixels of a patch.
#[derive(Args)]
#[command(group(ArgGroup::new("posed").args(["cameras", "refine"]).multiple(true)), mut_args(adapted), after_help = format!("Examples:
  zipsplat reconstruct photos/ -o scene.ply
  zipsplat reconstruct photos/ --refine -o sharp.ply
  zipsplat reconstruct photos/ --cameras transforms.json --refine -o sharp.ply
  zipsplat reconstruct photos/ --cameras transforms.json --ratio 0.5 -o scene.ply
  zipsplat reconstruct clip.mp4 --views 24 --cameras colmap --cameras-out cameras.json -o scene.ply
  zipsplat reconstruct a.jpg b.jpg --weights zipsplat --ratio auto -o scene.ply
  zipsplat reconstruct photos/ --weights da3-base.safetensors --ratio 0.25 -o scene.ply
  zipsplat reconstruct photos/ -o scene.ply --pictures out/ -- --orbit --size 504x504 --depth
  zipsplat reconstruct captures/ --each --ratio auto --format spz -o scenes/
  zipsplat reconstruct --dry-run --weights seeded:vitg --views 24 --ratio auto

Photos beyond {MAX_VIEWS} are reconstructed in overlapping blocks."))]
pub struct Reconstruct {
    #[command(flatten)]
    input: PhotoArgs,
    /// Scene to write: .ply, .spz, .sog, .splat, .glb or .gltf; with --each a folder
    #[arg(long, short, value_name = "FILE", required_unless_present = "dry_run")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten, next_help_heading = NETWORK)]
    weights: Weights,
    #[command(flatten, next_help_heading = NETWORK)]
    quality: Quality,
    #[command(flatten, next_help_heading = NETWORK)]
    blocks: BlockArgs,
    #[command(flatten, next_help_heading = NETWORK)]
    crop: CropOption,
    /// Largest number of photos or video frames, evenly spaced [default: all photos, 24 frames of a
    /// video]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views: Option<u32>,
    /// Cameras: transforms.json or a COLMAP model's folder, matched by file name; colmap: estimated
    /// by COLMAP; da3, vggt: by Depth Anything 3, VGGT [default with --refine: colmap]
    #[arg(long, help_heading = CAMERAS, value_name = "PATH|colmap|da3|vggt")]
    cameras: Option<PathBuf>,
    #[command(flatten, next_help_heading = CAMERAS)]
    finding: Finding,
    /// Write the cameras, estimated or optimized, as transforms.json. --cameras colmap, da3 and
    /// vggt also write points and a log to its folder. Without --cameras, estimates them from the
    /// scene, in its world
    #[arg(long, alias = "refined-cameras", help_heading = CAMERAS, value_name = "FILE")]
    cameras_out: Option<PathBuf>,
    /// Length of the network's unit in the cameras' unit; the scene keeps the cameras' unit
    /// [default: the median distance of the capture's points (points.ply or points3D) from the
    /// first camera, else of the point that the cameras look at, else the distance between cameras]
    #[arg(long, alias = "unit", help_heading = CAMERAS, value_name = "LENGTH", requires = "posed", value_parser = parse_length)]
    scene_scale: Option<f64>,
    /// World of the scene
    #[arg(long, help_heading = CAMERAS, value_enum, value_name = "WHICH", default_value = "first-camera", requires = "posed")]
    world: WorldName,
    /// Reconstruct each capture in PHOTOS: folders with photos, directly or in images/, folders of
    /// captures, or text files with a capture per line. The output is a folder. Run the command
    /// again to resume. Failures are rows of failures.csv and give exit code 1
    #[arg(long, help_heading = MANY, conflicts_with_all = ["refine", "cameras_out", "scene_scale", "world", "explain",
        "pictures", "depth_weights", "recursive", "camera_model"])]
    each: bool,
    /// Format of the scenes of --each: ply, spz, sog, splat, glb or gltf
    #[arg(long, help_heading = MANY, value_name = "NAME", default_value = "ply", requires = "each")]
    format: String,
    /// Largest number of captures reconstructed in this run
    #[arg(long, help_heading = MANY, value_name = "N", requires = "each")]
    limit: Option<usize>,
    /// Print the memory plan and stop. --device none plans for a typical GPU; --views replaces
    /// photos; --explain lists every tensor
    #[arg(long, help_heading = None::<&'static str>, conflicts_with = "each")]
    pub dry_run: bool,
    /// Also print each stage's time and memory, and why stages are skipped
    #[arg(long, help_heading = None::<&'static str>)]
    explain: bool,
    #[command(flatten, next_help_heading = REFINEMENT)]
    refine: RefineArgs,
    #[command(flatten, next_help_heading = REFINEMENT)]
    antialiasing: Antialiasing,
    /// Also render the scene into this folder
    #[arg(long, help_heading = None::<&'static str>, value_name = "FOLDER")]
    pictures: Option<PathBuf>,
    /// Options of zipsplat render for --pictures, after -- [default: --spline through the cameras
    /// of a file, else --wiggle]
    #[arg(last = true, help_heading = None::<&'static str>, value_name = "RENDER OPTIONS", requires = "pictures")]
    drawing: Vec<String>,
}

fn adapted(arg: Arg) -> Arg {
    let arg = refinement::with_cameras(arg);
    let arg = if arg.get_id() == "antialiased" { arg.requires("refine") } else { arg };
    if arg.get_id() == "photos" { arg.required(false).required_unless_present("dry_run") } else { arg }
}

#[derive(Clone, Copy)]
pub struct Posed<'a> {
    pub photos: &'a [PathBuf],
    pub poses: Option<&'a Capture>,
    pub frames: &'a [&'a CaptureView],
}

impl Posed<'_> {
    pub fn first(&self) -> Option<Pose> {
        self.frames.first().map(|frame| frame.camera.pose)
    }
}

impl Reconstruct {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        match (self.dry_run, self.each) {
            (true, _) => plan::show(session, self),
            (_, true) => Batch::of(self)?.run(session),
            _ => self.reconstruct(session),
        }
    }

    fn output(&self) -> &Path {
        self.output.as_deref().unwrap_or(Path::new("scene.ply"))
    }

    fn reconstruct(&self, session: &mut Session<'_>) -> Result<()> {
        self.overwrite.check_scene(self.output())?;
        self.refine.check()?;
        let drawing = self.drawing()?;
        let network = self.weights.open_network()?;
        self.check_network(session, &network)?;
        let Photographed { photos, known, mut folder } = self.captured(session, &network)?;
        let (poses, found) = known.map(|known| (known.poses, known.found)).unzip();
        let mut found = found.flatten();
        let frames = poses.as_ref().map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        let posed = Posed { photos: &photos, poses: poses.as_ref(), frames: &frames };
        let cloud = self.cloud(posed)?;
        let steps = self.refine.steps();
        let init = steps.map(|steps| self.initialization(steps, cloud.as_ref()));
        let (forward, device) = self.forward(session, &network, init, posed, &mut found)?;
        let inputs = RefineInputs {
            device: &device,
            network: &network,
            forward: forward.as_ref(),
            // Converted photos are new files.
            is_repeatable: self.cameras.as_deref().is_none_or(has_stable_cameras) && folder.is_none(),
        };
        let refine = |(steps, init)| self.refine_scene(session, steps, init, inputs, cloud.as_ref(), posed);
        let refined = steps.zip(init).map(refine).transpose()?;
        let made = refined.as_ref().map(|made| &made.refined.scene).or(forward.as_ref().map(|forward| &forward.scene));
        let Some(scene) = made.cloned() else { unreachable!("a scene is reconstructed or refined") };
        let separate = found.iter().filter(|_| !self.finds_by_itself(&network));
        let separate = separate.flat_map(|found| found.times.iter().map(|(step, took)| ((*step).to_owned(), *took)));
        let mut times: Vec<(String, Duration)> = separate.collect();
        times.extend(forward.iter().flat_map(|forward| forward.times.clone()));
        times.extend(refined.iter().filter_map(|made| Some(("stereo".to_owned(), made.stereo_time?))));
        times.extend(refined.iter().map(|made| ("refine".to_owned(), made.refined.took)));
        let mut made = Finished { posed, found, forward, refined, device, scene, times };
        self.save(session, &mut made, &mut folder)?;
        let drawn = drawing.map(|drawing| self.draw(session, &mut made, &drawing)).transpose()?;
        self.report(session, made, drawn)
    }

    /// World: the first camera.
    fn cloud(&self, posed: Posed<'_>) -> Result<Option<PointCloud>> {
        match (self.refine.steps(), posed.poses, posed.first()) {
            (Some(_), Some(Capture { points: Some(points), .. }), Some(first)) => {
                Ok(Some(placed(read_cloud(points)?, &first.inverse(), 1.0)))
            }
            _ => Ok(None),
        }
    }

    fn forward(
        &self,
        session: &mut Session<'_>,
        network: &Network,
        init: Option<From>,
        posed: Posed<'_>,
        found: &mut Option<EstimatedCameras>,
    ) -> Result<(Option<Forward>, Device)> {
        Ok(match (init, network) {
            (Some(From::Scene(Initialization::Points)), _) => (None, session.device()?),
            (_, Network::Tokens(checkpoint)) => {
                let size = self.check_views(session, checkpoint, posed)?;
                let device = session.device()?;
                (Some(Forward::of_tokens(self, session, &device, checkpoint, posed, size)?), device)
            }
            (_, Network::Pixels(checkpoint)) => {
                let predicted = found.as_mut().and_then(|found| found.predicted.take());
                (Some(Forward::of_pixels(self, session, checkpoint, predicted, posed)?), session.device()?)
            }
        })
    }

    fn check_network(&self, session: &mut Session<'_>, network: &Network) -> Result<()> {
        match network {
            Network::Tokens(checkpoint) => {
                session.notes(checkpoint.notes());
                self.quality.check(checkpoint.architecture())?;
            }
            Network::Pixels(checkpoint) => self.check_pixels(checkpoint)?,
        }
        let Some(place) = &self.cameras_out else { return Ok(()) };
        let finds = self.finds(network);
        let known = self.cameras.is_some() && !finds && !self.refine.settings.optimize_cameras;
        refuse(
            "--cameras-out",
            known,
            "cameras that are known",
            "--cameras colmap, --optimize-cameras, or no --cameras",
        )?;
        if finds { Place(place).check(self.overwrite) } else { Place(place).check_alone(self.overwrite) }
    }

    fn picture_size(&self) -> Result<Option<Size>> {
        let Some(drawing) = self.drawing()? else { return Ok(None) };
        let lacks = || Error::argument("--pictures with --dry-run", "no size", "-- --size WxH");
        drawing.path.size.ok_or_else(lacks).map(Some)
    }

    fn drawing(&self) -> Result<Option<Render>> {
        let Some(folder) = &self.pictures else { return Ok(None) };
        let known = self.cameras.as_ref().filter(|poses| !KnownCameras::to_find(poses));
        let cameras = self.cameras_out.as_ref().or(known);
        let default = match cameras.and_then(|file| file.to_str()).filter(|_| self.cameras.is_some()) {
            Some(file) => vec!["--spline".to_owned(), file.to_owned()],
            None => vec!["--wiggle".to_owned()],
        };
        let words = if self.drawing.is_empty() { &default[..] } else { &self.drawing };
        let drawing = Render::of_words(self.output(), folder, self.overwrite.is_given(), words)?;
        drawing.check()?;
        Ok(Some(drawing))
    }
}
