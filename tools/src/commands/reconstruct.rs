//! `zipsplat reconstruct`: photos to a scene.

use crate::{
    cameras,
    explain::Explanation,
    options::{Quality, Size, Weights, parse_length},
    outputs, photos,
    session::Session,
    table::{bytes, counted, time},
    views::{FitOption, Views},
};
use clap::Args;
use indicatif::HumanCount;
use serde_json::json;
use std::{fmt::Write, path::PathBuf, time::Duration};
use zipsplat::{
    Error, Result,
    reconstruct::{MAX_VIEWS, Request, Shape},
    types::{Camera, SceneFormat, poses::read_poses},
};

/// Photos of one place to a scene of 3D Gaussians
///
/// The scene's world is the first photo's camera: x right, y down, z forward.
#[derive(Args)]
#[command(after_help = format!("Examples:
  zipsplat reconstruct photos/ -o scene.ply
  zipsplat reconstruct photos/ --poses transforms.json --ratio 0.5 -o scene.ply
  zipsplat reconstruct a.jpg b.jpg --weights zipsplat.pt --variant vitg --ratio auto -o scene.ply
  zipsplat reconstruct a.jpg b.jpg --weights seeded:vits -o noise.ply

seeded: weights are random numbers: to try the command, not to look at. At most {MAX_VIEWS} photos."))]
pub struct Reconstruct {
    /// Photos (PNG, JPEG, WebP), or folders of them, taken in natural order of their names
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    /// Scene to write: .ply, .spz, .splat, .glb or .gltf
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    #[command(flatten)]
    fit: FitOption,
    /// Take at most so many of the photos, evenly spread, the first and the last among them [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MAX_VIEWS as i64))]
    views: Option<u32>,
    /// Known cameras: transforms.json, or a COLMAP model's folder; photos are matched by file name
    #[arg(long, visible_alias = "cameras", value_name = "PATH")]
    poses: Option<PathBuf>,
    /// Length in the cameras' unit that the network takes for 1; the scene keeps the cameras' unit [default: the median
    /// distance from the first camera of the points in points.ply or points3D beside the cameras, else 1]
    #[arg(long, value_name = "LENGTH", requires = "poses", value_parser = parse_length)]
    unit: Option<f64>,
    /// Also print the stages that ran, with time and bytes, and what was left out and why
    #[arg(long)]
    explain: bool,
}

impl Reconstruct {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let Quality { ratio, select, arithmetic, .. } = &self.quality;
        // Whatever can be refused is refused before anything that takes time.
        outputs::check_file(&self.output)?;
        if SceneFormat::of_extension(&self.output).is_none() {
            let expected = format!("a file that ends in {}", SceneFormat::EXTENSIONS);
            return Err(Error::argument("--output", self.output.display(), expected));
        }
        let checkpoint = self.weights.open()?;
        self.quality.check(checkpoint.architecture())?;
        let mut photos = photos::list(session, &self.photos)?;
        if let Some(views) = self.views {
            photos = photos::spread(photos, views as usize);
        }
        if photos.len() > MAX_VIEWS {
            let expected = format!("1 to {MAX_VIEWS}; --views N takes N of them, evenly spread");
            return Err(Error::argument("views", photos.len(), expected));
        }
        if self.weights.is_embedded() && self.poses.is_none() && photos.len() > 1 {
            session.note(
                "the model that is built in is a demonstration: several photos without --poses give colours and coarse shapes; \
                 one photo, or known cameras, gives more",
            );
        }
        let (size, fit) = (self.quality.size_for(&checkpoint), self.fit.fit);
        fit.check(size, self.poses.is_some())?;
        self.quality.doubt_size(&checkpoint).iter().for_each(|note| session.note(note));
        let Size(width, height) = size;
        let (views, chosen) = (fit.count(&photos)?, (*ratio, select));
        let shape = Shape::new(checkpoint.architecture(), views, [width, height], chosen, self.poses.is_some())?;
        let poses = self.poses.as_ref().map(read_poses).transpose()?;
        let frames = poses.as_ref().map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        poses.iter().flat_map(|poses| &poses.notes).for_each(|note| session.note(note));
        let device = session.device()?;
        let (precision, arithmetic) = arithmetic.choose(session, &device)?;

        let photo_cameras: Vec<Camera> = frames.iter().map(|frame| frame.camera).collect();
        let (views, load_photos) =
            session.stage("load photos", |stage| fit.load(&photos, &photo_cameras, size, stage))?;
        let Views { images, mut cameras, note } = views;
        note.iter().for_each(|note| session.note(note));
        let unit = match (self.unit, poses.as_ref().and_then(|poses| poses.points.as_deref())) {
            (None, Some(points)) => cameras::unit(points, &cameras, &photo_cameras[0].pose)?,
            (given, _) => given.unwrap_or(1.0),
        };
        cameras.iter_mut().for_each(|camera| camera.pose.translation /= unit);
        let (cameras, world) = fit.told(cameras);
        let (model, load_weights) = session.load_model(&device, &checkpoint, arithmetic)?;
        let cameras = Some(cameras).filter(|cameras| !cameras.is_empty());
        let request = Request { ratio: *ratio, selection: select.clone(), cameras };
        let (mut result, _) = session.reconstruct(&model, &images, &request)?;
        self.quality.prune(&mut result.scene, checkpoint.architecture());
        world.iter().for_each(|world| result.scene.place(1.0, world));
        result.scene.scale(unit as f32);
        let origin = frames.first().map(|frame| frame.name.as_str());
        let (_, write) = session.stage("write", |_| outputs::save_scene(&self.output, &result.scene, origin))?;

        let mut times: Vec<(&str, Duration)> = vec![("load photos", load_photos), ("load weights", load_weights)];
        times.extend(result.times.0.iter().map(|(stage, took)| (stage.as_str(), *took)));
        times.push(("write", write));
        let rate = (checkpoint.bytes() as f64 / load_weights.as_secs_f64().max(1e-9)) as u64;
        let tokens = shape.grid.tokens();
        let seconds: serde_json::Map<_, _> =
            times.iter().map(|(s, t)| (s.to_string(), json!(t.as_secs_f64()))).collect();
        let mut json = json!({
            "output": self.output, "device": device.limits().name, "weights": checkpoint.provenance(),
            "photos": photos.len(), "views": images.len(), "width": width, "height": height, "tokens": result.tokens, "all_tokens": tokens,
            "unit": unit, "gaussians": result.scene.len(), "gaussians_per_token": result.scene.len() / result.tokens,
            "peak_bytes": result.peak_bytes, "weights_bytes_per_second": rate, "precision": precision.name(),
            "seconds": seconds,
        });
        let mut text = format!(
            "{}: {} from {} of {size}\n{} of {}, {} each, {} precision; at most {} of {}\n",
            self.output.display(),
            counted(result.scene.len(), "Gaussian"),
            counted(images.len(), "view"),
            HumanCount(result.tokens as u64),
            counted(tokens, "token"),
            counted(result.scene.len() / result.tokens, "Gaussian"),
            precision.name(),
            bytes(result.peak_bytes),
            device.limits().name,
        );
        for (stage, took) in &times {
            let rate = if *stage == "load weights" { format!("  ({}/s)", bytes(rate)) } else { String::new() };
            // Writing to a string cannot fail.
            let _ = writeln!(text, "  {stage:<13}{:>10}{rate}", time(*took));
        }
        if self.explain {
            let explanation = Explanation::of_stages(&result.times, &result.outline, result.left_out);
            text += &format!("\n{explanation}");
            json["explain"] = json!(explanation);
        }
        session.report(&json, text)
    }
}
