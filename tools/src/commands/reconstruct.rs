//! `zipsplat reconstruct`: photos to a scene.

use super::render::Render;
use crate::{
    cameras::{Finding, Known, Place},
    explain::Explanation,
    options::{Quality, Size, Weights, parse_length, refuse},
    outputs::{self, Overwrite},
    photos::{self, PhotoArgs},
    refinement::{self, MOST_PIXELS, Moved, Refinable, Start, Steps, placed, save_cameras},
    session::Session,
    table::{bytes, counted, time},
    video::FrameFolder,
    views::{FitOption, Views},
};
use clap::{ArgGroup, Args, ValueEnum};
use indicatif::HumanCount;
use serde_json::json;
use std::{fmt::Write, path::PathBuf, time::Duration};
use zipsplat::{
    Error, Result,
    gpu::Device,
    reconstruct::{MAX_VIEWS, Request, SceneTokens, Shape},
    refine::{FrozenHead, Refine, Refined, Stopped},
    stages::render::Renderer,
    types::{
        Camera, PointCloud, Scene, SceneFormat, World, WriteOptions,
        poses::{Frame, Unit, read_cloud},
        spz_coarsening,
    },
    weights::Checkpoint,
};

/// Photos of one place to a scene of 3D Gaussians
///
/// The scene's world is the first photo's camera, x right, y down, z forward, or with --world cameras that of the cameras.
#[derive(Args)]
#[command(group(ArgGroup::new("moved").args(["refine_cameras", "grow"]).multiple(true).requires("refine")))]
#[command(after_help = format!("Examples:
  zipsplat reconstruct photos/ -o scene.ply
  zipsplat reconstruct photos/ --poses transforms.json --ratio 0.5 -o scene.ply
  zipsplat reconstruct photos/ --poses transforms.json --refine -o sharp.ply
  zipsplat reconstruct photos/ --poses find --refine -o sharp.ply
  zipsplat reconstruct clip.mp4 --views 24 --poses find --cameras-out cameras.json -o scene.ply
  zipsplat reconstruct a.jpg b.jpg --weights zipsplat --ratio auto -o scene.ply
  zipsplat reconstruct photos/ -o scene.ply --pictures out/ -- --orbit --size 504x504 --depth
  zipsplat reconstruct a.jpg b.jpg --weights seeded:vits -o noise.ply

seeded: weights are random numbers: to try the command, not to look at. At most {MAX_VIEWS} photos."))]
pub struct Reconstruct {
    #[command(flatten)]
    input: PhotoArgs,
    /// Scene to write: .ply, .spz, .splat, .glb or .gltf
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    #[command(flatten)]
    fit: FitOption,
    /// Take at most so many of the photos, evenly spread, the first and the last among them, and so many frames of a video
    /// [default: all, and 24 of a video]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MAX_VIEWS as i64))]
    views: Option<u32>,
    /// Cameras: transforms.json, or a COLMAP model's folder, where photos are matched by file name; or find, where COLMAP finds
    /// them
    #[arg(long, visible_alias = "cameras", value_name = "PATH|find")]
    poses: Option<PathBuf>,
    #[command(flatten)]
    finding: Finding,
    /// Write the cameras that were found: transforms.json, points and COLMAP's log beside it
    #[arg(long, value_name = "FILE", requires = "poses")]
    cameras_out: Option<PathBuf>,
    /// Length in the cameras' unit that the network takes for 1; the scene keeps the cameras' unit [default: the median
    /// distance from the first camera of the points in points.ply or points3D beside the cameras, else that of the point that
    /// the cameras look at, else the distance between cameras]
    #[arg(long, value_name = "LENGTH", requires = "poses", value_parser = parse_length)]
    unit: Option<f64>,
    /// World of the scene
    #[arg(long, value_enum, value_name = "WHICH", default_value = "first", requires = "poses")]
    world: WorldName,
    /// Also print the stages that ran, with time and bytes, and what was left out and why
    #[arg(long)]
    explain: bool,
    /// Make the scene sharp: move it in so many steps until it looks like the photos. :tokens moves the network's tokens, from which
    /// its head makes Gaussians, and not the Gaussians themselves. Of 9 photos or more one is held out, and the scene is that of
    /// the step that predicts it best. Ctrl-C in between writes the best so far
    #[arg(long, value_name = "STEPS[:tokens|gaussians]", requires = "poses", num_args = 0..=1, require_equals = true,
        )]
    refine: Option<Option<Steps>>,
    /// What --refine starts from; points are those that structure from motion left beside the cameras [default: with the
    /// model that is built in points, where there are enough, else the scene]
    #[arg(long, value_enum, value_name = "WHAT", requires = "refine")]
    start: Option<Start>,
    /// Most pixels of a photo along x and y in --refine: a larger one is compared at the largest size that fits
    #[arg(long, value_name = "WxH", default_value = MOST_PIXELS, requires = "refine")]
    refine_size: Size,
    /// Photos that --refine holds out, evenly spread [default: 1 of 9 or more, none with --refine-cameras]
    #[arg(long, value_name = "K", requires = "refine")]
    hold_out: Option<usize>,
    #[command(flatten)]
    moved: Moved,
    /// File for the cameras as --refine-cameras leaves them: a transforms.json in the world of the cameras given
    #[arg(long, value_name = "FILE", requires = "refine_cameras")]
    refined_cameras: Option<PathBuf>,
    /// Also draw the scene into a folder, as zipsplat render does, from the Gaussians that are on the device already
    #[arg(long, value_name = "FOLDER")]
    pictures: Option<PathBuf>,
    /// Options of zipsplat render for --pictures, behind -- [default: --wiggle]
    #[arg(last = true, value_name = "RENDER OPTIONS", requires = "pictures")]
    drawing: Vec<String>,
}

/// Steps of positions that show: over how far away the scene is.
const COARSE: f64 = 1e-3;

/// The weights and settings that the scene was made with.
struct From<'a> {
    device: &'a Device,
    checkpoint: &'a Checkpoint,
    /// The tokens, where these are moved.
    tokens: Option<SceneTokens>,
}

/// The outcome of --refine.
struct Made {
    refined: Refined,
    /// The start, in words.
    started: &'static str,
    /// The cameras that it was given.
    cameras: Vec<Camera>,
    request: Refine,
}

/// The world that a scene is in.
#[derive(Clone, Copy, ValueEnum)]
enum WorldName {
    /// The first photo's camera: x right, y down, z forward
    First,
    /// That of the cameras, so that they fit the scene in any program as they are
    Cameras,
}

impl WorldName {
    /// The world of a scene whose first photo has this frame.
    fn of(self, first: &Frame) -> World {
        match self {
            Self::First => World::Photo(first.name.clone()),
            Self::Cameras => World::Cameras(first.camera.pose),
        }
    }
}

impl Reconstruct {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let Quality { ratio, select, arithmetic, .. } = &self.quality;
        // Whatever can be refused is refused before anything that takes time.
        self.overwrite.check_file(&self.output)?;
        if SceneFormat::of_extension(&self.output).is_none() {
            let expected = format!("a file that ends in {}", SceneFormat::EXTENSIONS);
            return Err(Error::argument("--output", self.output.display(), expected));
        }
        let find = self.poses.as_deref().is_some_and(Known::to_find);
        if let Some(place) = &self.cameras_out {
            refuse("--cameras-out", !find, "cameras that are known", "--poses find")?;
            Place(place).check(self.overwrite)?;
        }
        self.refined_cameras.as_ref().map_or(Ok(()), |path| self.overwrite.check_file(path))?;
        let drawing = self.drawing()?;
        self.refine().map_or(Ok(()), |steps| steps.check(self.start, &self.moved))?;
        let checkpoint = self.weights.open()?;
        checkpoint.notes().iter().for_each(|note| session.note(note));
        self.quality.check(checkpoint.architecture())?;
        let (mut photos, mut frame_folder) = {
            let named_in =
                self.cameras_out.as_deref().or(self.refined_cameras.as_deref()).map(|file| (file, self.overwrite));
            self.input.list(session, self.views, named_in)?
        };
        if let (true, Some(views)) = (find, self.views) {
            photos = photos::spread(photos, views as usize);
        }
        let of_photos = |path: &PathBuf| Known::of(session, path, &photos, &self.finding);
        let known = self.poses.as_ref().map(of_photos).transpose()?;
        let (poses, found) = known.map(|known| (known.poses, known.found)).unzip();
        if let (Some(place), Some(poses), Some(found)) =
            (&self.cameras_out, &poses, found.as_ref().and_then(Option::as_ref))
        {
            Place(place).save(poses, found)?;
            frame_folder.iter_mut().for_each(FrameFolder::keep);
        }
        if let Some(poses) = &poses {
            poses.notes.iter().for_each(|note| session.note(note));
            photos = photos::posed(session, photos, poses)?;
        }
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
                 one photo, or cameras (--poses find finds them), gives more, and the paper's weights (`zipsplat weights get zipsplat`) most",
            );
        }
        let (size, fit) = (self.quality.size_for(&checkpoint), self.fit.fit);
        fit.check(size, self.poses.is_some())?;
        self.quality.doubt_size(&checkpoint).iter().for_each(|note| session.note(note));
        let Size(width, height) = size;
        let (views, chosen) = (fit.count(&photos)?, (*ratio, select));
        let shape = Shape::new(checkpoint.architecture(), views, [width, height], chosen, self.poses.is_some())?;
        let frames = poses.as_ref().map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        let device = session.device()?;
        let (precision, arithmetic) = arithmetic.choose(session, &device)?;

        let (views, load_photos) = session.stage("load photos", |stage| fit.load(&photos, &frames, size, stage))?;
        let Views { images, cameras, note } = views;
        note.iter().for_each(|note| session.note(note));
        let unit = match (&poses, frames.first()) {
            (Some(poses), Some(first)) => Some(poses.unit(self.unit, &cameras, &first.camera.pose)?),
            _ => None,
        };
        unit.iter().filter_map(Unit::doubt).for_each(|note| session.note(note));
        let length = unit.as_ref().map_or(1.0, |unit| unit.length);
        let (cameras, turned) = fit.told(cameras);
        let (model, load_weights) = session.load_model(&device, &checkpoint, arithmetic)?;
        let cameras = Some(cameras).filter(|cameras| !cameras.is_empty());
        let request = Request { ratio: *ratio, selection: select.clone(), cameras, unit: length };
        let of_tokens = self.refine().is_some_and(|steps| steps.tokens);
        let (result, tokens, _) = session.reconstruct_with_tokens(&model, &images, &request, of_tokens)?;
        let mut scene = result.scene()?;
        self.quality.prune(&mut scene, checkpoint.architecture());
        turned.iter().for_each(|first| scene.place(1.0, first));
        let refined = match (self.refine(), frames.first()) {
            (Some(steps), Some(first)) => {
                let from = From { device: &device, checkpoint: &checkpoint, tokens };
                let cloud = poses.as_ref().and_then(|poses| poses.points.as_ref()).map(read_cloud).transpose()?;
                let cloud = cloud.map(|cloud| placed(cloud, &first.camera.pose.inverse(), 1.0));
                Some(self.refine_scene(session, steps, from, (scene.clone(), cloud.as_ref()), (&photos, &frames))?)
            }
            _ => None,
        };
        if let Some(Made { refined, .. }) = &refined {
            scene = refined.scene.clone();
        }
        let world = frames.first().map(|first| self.world.of(first));
        if let Some(World::Cameras(first)) = &world {
            scene.place(1.0, first);
            // Positions are f32.
            let step = first.translation.length() * f64::from(f32::EPSILON);
            if step > COARSE * length {
                let world = "the world of the cameras begins far from them";
                session
                    .note(format!("{world}: positions there have steps of {step:.2e}, of a scene {length:.2e} away"));
            }
        }
        if SceneFormat::of_extension(&self.output) == Some(SceneFormat::Spz) {
            spz_coarsening(&scene).into_iter().for_each(|note| session.note(note));
        }
        let save = || outputs::save_scene(&self.output, &scene, &WriteOptions::default(), world.as_ref());
        if let Some(Made { refined: Refined { stopped: Some(Stopped::Cancelled), best_step, .. }, .. }) = &refined {
            save()?.into_iter().for_each(|note| session.note(note));
            session.note(format!("{}: the best so far, after step {best_step}", self.output.display()));
            return Err(Error::Cancelled);
        }
        let (note, write) = session.stage("write", |_| save())?;
        note.into_iter().for_each(|note| session.note(note));
        if let (Some(path), Some(Made { refined, .. }), Some(first)) = (&self.refined_cameras, &refined, frames.first())
        {
            save_cameras(path, refined, &first.camera.pose, &photos, &frames)?;
            frame_folder.iter_mut().for_each(FrameFolder::keep);
        }
        let drawn = drawing.map(|drawing| {
            let mut renderer = Renderer::new(&device);
            // What the host thinned or moved it has to bring back.
            let own = refined.is_none()
                && scene.len() == result.gaussians.len()
                && turned.is_none()
                && !matches!(world, Some(World::Cameras(_)));
            let load = |_: &mut Session<'_>, renderer: &mut Renderer| match own {
                true => renderer.show(&result.gaussians),
                false => renderer.load(&scene),
            };
            drawing.draw(session, &mut renderer, (&scene, 0), world.as_ref(), load)
        });
        let drawn = drawn.transpose()?;
        let peak_bytes = result.peak_bytes.max(device.allocated_bytes());

        let mut times: Vec<(&str, Duration)> = vec![("load photos", load_photos), ("load weights", load_weights)];
        times.extend(result.times.0.iter().map(|(stage, took)| (stage.as_str(), *took)));
        times.extend(refined.iter().map(|made| ("refine", made.refined.took)));
        times.push(("write", write));
        let rate = (checkpoint.bytes() as f64 / load_weights.as_secs_f64().max(1e-9)) as u64;
        let tokens = shape.grid.tokens();
        let seconds: serde_json::Map<_, _> =
            times.iter().map(|(s, t)| (s.to_string(), json!(t.as_secs_f64()))).collect();
        let mut json = json!({
            "output": self.output, "device": device.limits().name, "weights": checkpoint.provenance(),
            "photos": photos.len(), "views": images.len(), "width": width, "height": height, "tokens": result.tokens,
            "all_tokens": tokens, "unit": length, "unit_from": unit.as_ref().map(|unit| &unit.source),
            "gaussians": scene.len(), "gaussians_per_token": result.gaussians.len() / result.tokens,
            "peak_bytes": peak_bytes, "weights_bytes_per_second": rate, "precision": precision.name(),
            "seconds": seconds,
        });
        let mut text = format!(
            "{}: {} from {} of {size}\n{} of {}, {} each, {} precision; at most {} of {}\n",
            self.output.display(),
            counted(scene.len(), "Gaussian"),
            counted(images.len(), "view"),
            HumanCount(result.tokens as u64),
            counted(tokens, "token"),
            counted(result.gaussians.len() / result.tokens, "Gaussian"),
            precision.name(),
            bytes(peak_bytes),
            device.limits().name,
        );
        if let Some(unit) = &unit {
            text += &format!("{unit}\n");
        }
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
        if let Some(Made { refined, started, cameras, request }) = &refined {
            text += &format!("{}\n", refinement::summary(refined, started, cameras));
            if self.explain {
                text += &format!("\n{}", refinement::explain(refined, request, started, &photos));
            }
            json["refined"] = refinement::as_json(refined, started, cameras);
        }
        if let Some((pictures, told)) = drawn {
            json["pictures"] = pictures;
            text += &told;
        }
        session.report(&json, text)
    }

    /// The steps of --refine; on its own it takes the default's.
    fn refine(&self) -> Option<Steps> {
        self.refine.map(Option::unwrap_or_default)
    }

    /// Makes the scene look like the photos, in the world of the first one's camera.
    fn refine_scene(
        &self,
        session: &mut Session<'_>,
        steps: Steps,
        from: From<'_>,
        (scene, cloud): (Scene, Option<&PointCloud>),
        (photos, frames): (&[PathBuf], &[&Frame]),
    ) -> Result<Made> {
        let world = frames[0].camera.pose;
        let camera = |frame: &&Frame| Camera { pose: frame.camera.pose.relative_to(&world), ..frame.camera };
        let cameras: Vec<Camera> = frames.iter().map(camera).collect();
        let (photos, _) =
            session.stage("load photos", |stage| photos::read(photos, frames, stage, |_, photo| Ok(photo)))?;
        let size = Some([self.refine_size.0, self.refine_size.1]);
        let request = Refine { steps: steps.count, size, hold_out: self.hold_out, ..Refine::default() };
        let request = self.moved.request(request);
        let mut started = refinement::TOKENS;
        let refined = if let Some(tokens) = &from.tokens {
            let head = FrozenHead::load(from.device, from.checkpoint)?;
            refinement::refine(session, Refinable::Tokens(&head, tokens), &photos, &cameras, &request)?
        } else {
            let start = Start::or_best(self.start, cloud, self.weights.is_embedded());
            started = start.name();
            let start = start.scene(Some(scene), cloud, &cameras)?;
            refinement::refine(session, Refinable::Scene(from.device, &start), &photos, &cameras, &request)?
        };
        refinement::doubt(&refined).iter().for_each(|note| session.note(note));
        match refined.stopped {
            Some(Stopped::Cancelled) if refined.best_step == 0 => Err(Error::Cancelled),
            _ => Ok(Made { refined, started, cameras, request }),
        }
    }

    /// The drawing of --pictures, checked before anything that takes time.
    fn drawing(&self) -> Result<Option<Render>> {
        let Some(folder) = &self.pictures else { return Ok(None) };
        let default = ["--wiggle".to_owned()];
        let words = if self.drawing.is_empty() { &default[..] } else { &self.drawing };
        let drawing = Render::of_words(&self.output, folder, self.overwrite.is_given(), words)?;
        drawing.check()?;
        Ok(Some(drawing))
    }
}
