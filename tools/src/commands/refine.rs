use crate::{
    cameras::{Finding, KnownCameras, Similarity, WorldPhoto, to_scene},
    explain::Explanation,
    options::SceneInput,
    outputs::{self, Overwrite},
    panorama,
    photos::{self, PhotoFiles},
    refinement::{
        self, DEFAULT_LENGTH, Initialization, Refinable, RefineSettings, RefineTask, parse_steps, save_cameras,
    },
    session::Session,
    table::counted,
};
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    gpu::Arena,
    refine::{RefineOptions, RefineResult},
    types::{
        Camera, SaveOptions, Scene, World,
        poses::{Capture, CaptureView, read_cloud},
        read_world,
    },
};

/// Refine a scene's Gaussians against photos with known cameras
///
/// The scene's world is that of the cameras, or the camera of a photo that the scene's file or
/// --relative-to names. From 40 photos on one is held out, and the best step by that photo is
/// written. Ctrl-C stops early and writes the best step so far. FILE.checkpoint beside the scene
/// keeps the state, every minute and at Ctrl-C; the same command resumes. No such file is
/// kept with --cameras colmap, whose cameras differ in each run, or if the output replaces the
/// scene.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat refine scene.ply photos/ --cameras transforms.json -o better.ply
  zipsplat refine photos/ --cameras transforms.json --init points --steps 500 -o scene.ply
  zipsplat refine photos/ --cameras colmap --init points -o scene.ply
  zipsplat refine scene.spz photos/ --cameras colmap/ --init both --max-image-size 504x504 -o better.ply
  zipsplat refine scene.ply photos/ --cameras rough.json --optimize-cameras --cameras-out exact.json -o better.ply")]
pub struct Refine {
    /// Scene (PLY, SPZ, SOG, .splat or glTF; none with --init points), then photos (PNG, JPEG,
    /// WebP) or folders of them
    #[arg(required = true, value_name = "SCENE, PHOTOS")]
    files: Vec<PathBuf>,
    /// Scene to write: .ply, .spz, .sog, .splat, .glb or .gltf
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    input: SceneInput,
    /// Cameras: transforms.json, or a COLMAP model's folder, matched by file name; with --init
    /// points also colmap, or da3 or vggt (by --depth-weights)
    #[arg(long, value_name = "PATH|colmap|da3|vggt")]
    cameras: PathBuf,
    #[command(flatten)]
    finding: Finding,
    #[command(flatten)]
    world_photo: WorldPhoto,
    /// Optimization steps, or a time, such as 60s
    #[arg(long, value_name = "N|TIME", default_value = DEFAULT_LENGTH, value_parser = parse_steps)]
    steps: RefineTask,
    /// Photos per step
    #[arg(long, alias = "batch", value_name = "N", default_value_t = RefineOptions::default().views_per_step)]
    views_per_step: usize,
    #[command(flatten)]
    settings: RefineSettings,
    /// File for the refined cameras: a transforms.json in the world of the known cameras
    #[arg(long, alias = "refined-cameras", value_name = "FILE", requires = "optimize_cameras")]
    cameras_out: Option<PathBuf>,
    /// Also print the settings, and each pass of a step with its time and memory
    #[arg(long)]
    explain: bool,
}

struct Started {
    scene: Scene,
    cameras: Vec<Camera>,
    world: Option<World>,
    to_scene: Similarity,
}

impl Refine {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.overwrite.check_scene(&self.output)?;
        self.settings.check()?;
        self.cameras_out.as_ref().map_or(Ok(()), |path| self.overwrite.check_file(path))?;
        let (scene, files) = self.files();
        if KnownCameras::to_find(&self.cameras) && self.init() != Initialization::Points {
            let expected = "--init points: estimated cameras are in another world than the scene";
            return Err(Error::argument(format!("--cameras {}", self.cameras.display()), "with a scene", expected));
        }
        let photos = photos::list(session, files, false)?;
        if KnownCameras::to_find(&self.cameras) {
            panorama::refuse(&photos)?;
        }
        let mut known = KnownCameras::of(session, &self.cameras, &photos, &self.finding)?;
        let photos = photos::kept(session, photos, Some(&mut known), None)?;
        let KnownCameras { poses, found } = known;
        let masks = self.finding.masks();
        masks.as_ref().map_or(Ok(()), |masks| masks.check(&photos))?;
        let frames = poses.frames_of(&photos)?;
        let files = PhotoFiles::new(&photos, &frames, masks.clone())?;
        let started = self.start(session, scene, &poses, &frames, &files)?;
        drop(found);
        let device = session.device()?;
        let unit = 1.0 / started.to_scene.scale;
        let known = self.settings.known_depth(session, &photos, &frames, &started.cameras, unit)?;
        let checkpoint = || refinement::checkpoint(&self.output, &photos, masks.as_ref(), known.as_ref());
        // A rerun would refine the result.
        let is_in_place = scene.is_some_and(|scene| scene.canonicalize().ok() == self.output.canonicalize().ok());
        let is_repeatable = refinement::has_stable_cameras(&self.cameras) && !is_in_place;
        let checkpoint = is_repeatable.then(checkpoint).transpose()?;
        let kind = known.as_ref().map(|known| known.kind);
        let request = RefineOptions {
            views_per_step: self.views_per_step,
            profile: self.explain,
            checkpoint,
            ..self.settings.request(self.steps, self.input.antialiasing, kind, &photos)
        };
        let (arena, from) = (Arena::new(&device), Refinable::Scene(&started.scene));
        let refined = refinement::refine(session, &arena, from, files, known.as_ref(), &started.cameras, &request)?;
        let options = SaveOptions::default();
        let notes = outputs::save_scene(&self.output, &refined.scene, &options, started.world.as_ref())?;
        session.notes(notes);
        if let Some(path) = &self.cameras_out {
            let points = poses.points.as_deref().filter(|_| !KnownCameras::to_find(&self.cameras));
            save_cameras(path, &refined, &started.to_scene.inverse(), &photos, &frames, points)?;
        }
        refinement::conclude(session, &self.output, &request, &refined)?;
        self.report(session, device.limits().name.clone(), &photos, &started.cameras, refined, &request)
    }

    fn init(&self) -> Initialization {
        self.settings.init.unwrap_or(Initialization::Scene)
    }

    fn files(&self) -> (Option<&PathBuf>, &[PathBuf]) {
        match self.files.split_first() {
            Some((scene, photos)) if self.init().needs()[0] => (Some(scene), photos),
            _ => (None, &self.files),
        }
    }

    fn start(
        &self,
        session: &mut Session<'_>,
        path: Option<&PathBuf>,
        poses: &Capture,
        frames: &[&CaptureView],
        photos: &PhotoFiles<'_>,
    ) -> Result<Started> {
        if frames.is_empty() {
            return Err(Error::argument("photos", "none", "one or more behind the scene"));
        }
        let (mut scene, mut scene_world) = (None, World::of_cameras(frames));
        if let Some(path) = path {
            scene = Some(self.input.read(session, path)?.0);
            scene_world = read_world(path)?;
        }
        let (to_scene, note) =
            to_scene(self.world_photo.relative_to.as_deref(), poses, scene_world.as_ref(), &self.cameras)?;
        note.iter().for_each(|note| session.note(note));
        let world = match (scene_world, &self.world_photo.relative_to) {
            (_, Some(photo)) => World::of_first(&poses.frames_of(&[photo])?),
            (scene_world, None) => scene_world.or_else(|| World::of_cameras(frames)),
        };
        let camera = |frame: &&CaptureView| to_scene.apply(&frame.camera);
        let cameras: Vec<Camera> = frames.iter().map(camera).collect();
        let cloud = match &poses.points {
            Some(path) if self.init().needs()[1] => Some(to_scene.cloud(read_cloud(path)?)),
            _ => None,
        };
        let (scene, _) = refinement::initial(
            session,
            self.init(),
            scene,
            cloud.as_ref(),
            photos,
            &cameras,
            self.settings.max_gaussians,
        )?;
        Ok(Started { scene, cameras, world, to_scene })
    }

    fn report(
        &self,
        session: &mut Session<'_>,
        device: String,
        photos: &[PathBuf],
        cameras: &[Camera],
        refined: RefineResult,
        request: &RefineOptions,
    ) -> Result<()> {
        let start = self.init().name();
        let count = refined.scene.len();
        let mut json = json!({
            "output": self.output.to_string_lossy(), "device": device, "photos": photos.len(), "gaussians": count,
            "refined": refinement::as_json(&refined, start, cameras),
        });
        let mut text = format!(
            "{}: {} against {} on {device}\n{}\n",
            self.output.display(),
            counted(count, "Gaussian"),
            counted(photos.len() - refined.holdout_views.len(), "photo"),
            refinement::summary(&refined, start, cameras),
        );
        if let Some(profile) = &refined.profile {
            let explanation = Explanation::of_kernels(profile, Vec::new());
            text +=
                &format!("\n{explanation}\n{}", refinement::explain(&refined, request, &self.settings, start, photos));
            json["explain"] = json!(explanation);
        }
        session.report(&json, text)
    }
}
