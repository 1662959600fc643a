use super::reconstruction::Reconstruction;
use crate::{
    cameras::Similarity,
    capture::{Choice, ViewSplit},
    known_depth,
    options::{SceneInput, parse_length},
    session::Session,
    views::Views,
};
use clap::{Args, ValueEnum};
use glam::DVec3;
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    depth::add_view,
    types::{
        Origin, Pose, Scene, SceneFormat,
        poses::{Capture, CaptureView},
        read_world,
    },
};

/// Camera error, relative to the cameras' spread, that needs a note.
const APART: f64 = 0.05;

#[derive(Args)]
pub struct ExternalScene {
    /// Evaluate this scene of the input photos, without reconstruction: PLY, SPZ, SOG, .splat or
    /// glTF; with --protocol a folder of NAME.ply and others
    #[arg(long, value_name = "FILE", conflicts_with_all = ["refine", "ratio", "max_gaussians_per_token", "pose_noise", "crop"])]
    scene: Option<PathBuf>,
    /// Evaluate a pixel-aligned scene, one Gaussian per input pixel, at exact depth, without
    /// reconstruction. FOLDER has depth as for --depth-loss; with --protocol, FOLDER/SCENE.
    /// --refine starts from it
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["scene", "ratio", "max_gaussians_per_token", "pose_noise", "crop", "pose_free"])]
    from_depth: Option<PathBuf>,
    /// World of --scene [default: aligned with --scene-cameras, else the file's, else
    /// first-camera]
    #[arg(long, alias = "world", value_enum, value_name = "WHOSE", requires = "scene")]
    scene_frame: Option<SceneFrame>,
    /// Cameras of the input photos in the scene's world, for --scene-frame aligned, as for
    /// --cameras; with --protocol a folder of NAME.json or COLMAP models NAME/
    #[arg(long, value_name = "PATH", requires = "scene")]
    scene_cameras: Option<PathBuf>,
    /// Length of the scene's unit in the cameras' unit; derived with --scene-frame aligned
    /// [default: 1]
    #[arg(long, value_name = "LENGTH", requires = "scene", value_parser = parse_length)]
    scene_unit: Option<f64>,
    /// Opacities of the scene's file: logits, as in 3DGS, or plain, from 0 to 1
    #[arg(long, value_enum, value_name = "HOW", default_value = "logit", requires = "scene")]
    opacities: Opacities,
    #[command(flatten)]
    pub input: SceneInput,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum SceneFrame {
    /// The first input's camera: pose-free systems, ZipSplat
    #[value(alias = "first")]
    FirstCamera,
    /// The cameras' origin with the axes of the first input's camera: DepthSplat
    Turned,
    /// The world of the cameras: 3DGS, brush
    #[value(alias = "cameras")]
    InputCameras,
    /// Any world, mapped by the similarity from --scene-cameras to the known cameras
    Aligned,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Opacities {
    Logit,
    Plain,
}

impl ExternalScene {
    pub fn given(&self) -> Option<&Path> {
        self.scene.as_deref().or(self.from_depth.as_deref())
    }

    pub fn key(&self) -> String {
        let Self { scene, from_depth, scene_frame, scene_cameras, scene_unit, opacities, input } = self;
        let antialiased = input.antialiasing.antialiased;
        format!(
            "{scene:?} {from_depth:?} {scene_frame:?} {scene_cameras:?} {scene_unit:?} {opacities:?} {antialiased:?}"
        )
    }

    pub fn make(
        &self,
        session: &mut Session<'_>,
        name: Option<&str>,
        choice: &Choice,
        capture: &ViewSplit,
    ) -> Result<Option<Reconstruction>> {
        match (&self.from_depth, self.file(name)?) {
            (Some(folder), _) => {
                let folder = name.map_or_else(|| folder.clone(), |name| folder.join(name));
                depth_scene(&folder, choice, capture).map(|scene| Some(Reconstruction::given(scene)))
            }
            (None, Some(file)) => self.read(session, &file, name, choice, capture).map(Some),
            (None, None) => Ok(None),
        }
    }

    pub fn file(&self, name: Option<&str>) -> Result<Option<PathBuf>> {
        let (Some(path), Some(name)) = (&self.scene, name) else { return Ok(self.scene.clone()) };
        let files = SceneFormat::ALL.iter().map(|format| path.join(format!("{name}{}", format.extension())));
        let found = files.into_iter().find(|file| file.is_file());
        let expected = format!("{name}.ply, or with the extension of another format");
        found.map(Some).ok_or_else(|| Error::argument("--scene", path.display(), expected))
    }

    /// Files and folders that decide the result.
    pub fn inputs(&self, name: &str) -> Result<Vec<PathBuf>> {
        let cameras = self.scene_cameras.as_ref().map(|path| self.cameras(path, Some(name))).transpose()?;
        let depth = self.from_depth.as_ref().map(|folder| folder.join(name));
        Ok(self.file(Some(name))?.into_iter().chain(cameras).chain(depth).collect())
    }

    fn read(
        &self,
        session: &mut Session<'_>,
        file: &Path,
        name: Option<&str>,
        choice: &Choice,
        capture: &ViewSplit,
    ) -> Result<Reconstruction> {
        let (mut scene, _) = self.input.read(session, file)?;
        match self.opacities {
            Opacities::Plain => take_plain(&mut scene, file)?,
            Opacities::Logit if are_plain(&scene) => session.note(format!(
                "{}: the logits of all opacities lie between 0 and 1: they may be plain opacities, which --opacities plain takes",
                file.display()
            )),
            Opacities::Logit => {}
        }
        let inputs = choice.input_frames();
        let first = inputs[0].camera.pose;
        let unit = self.scene_unit.unwrap_or(1.0);
        let placed = |pose: Pose| Similarity { scale: unit, pose };
        let to_cameras = match (self.scene_frame, &self.scene_cameras, read_world(file)?.map(|world| world.origin)) {
            (Some(SceneFrame::Aligned), Some(path), _) | (None, Some(path), _) => {
                let (found, apart) = aligned(&Capture::open(self.cameras(path, name)?)?, &inputs)?;
                if apart > APART {
                    let percent = 100.0 * apart;
                    session.note(format!(
                        "{}: its cameras are {percent:.0} % of their spread from those given",
                        path.display()
                    ));
                }
                found
            }
            (Some(SceneFrame::Aligned), None, _) => {
                return Err(Error::argument(
                    "--scene-cameras",
                    "nothing",
                    "the scene's cameras, for --scene-frame aligned",
                ));
            }
            (Some(_), Some(path), _) => {
                let expected = "no --scene-cameras, which are for --scene-frame aligned";
                return Err(Error::argument("--scene-frame", path.display(), expected));
            }
            (Some(SceneFrame::InputCameras), ..) | (None, None, Some(Origin::Cameras(_))) => placed(Pose::IDENTITY),
            (Some(SceneFrame::Turned), ..) => placed(Pose { translation: DVec3::ZERO, ..first }),
            (None, None, Some(Origin::Photo(photo))) => {
                placed(choice.frame(&photo).map_or(first, |frame| frame.camera.pose))
            }
            (Some(SceneFrame::FirstCamera) | None, None, _) => placed(first),
        };
        place(&mut scene, &to_cameras, &first, capture);
        Ok(Reconstruction::given(scene))
    }

    fn cameras(&self, path: &Path, name: Option<&str>) -> Result<PathBuf> {
        let Some(name) = name else { return Ok(path.to_owned()) };
        let places = [path.join(format!("{name}.json")), path.join(name)];
        let found = places.into_iter().find(|place| place.exists());
        found.ok_or_else(|| {
            let expected = format!("{name}.json, or a COLMAP model {name}/");
            Error::argument("--scene-cameras", path.display(), expected)
        })
    }
}

/// Returns a scene of a folder's depth at the network's size, in the capture's world and unit.
pub fn depth_scene(folder: &Path, choice: &Choice, capture: &ViewSplit) -> Result<Scene> {
    let mut scene = Scene { sh_degree: 0, ..Scene::default() };
    let Views { cameras, images, .. } = &capture.views;
    let depths = known_depth::read(folder, &choice.input_frames(), cameras, capture.scene_scale.length)?;
    for ((camera, image), depth) in cameras.iter().zip(images).zip(&depths) {
        add_view(&mut scene, camera, image, depth);
    }
    if scene.is_empty() {
        return Err(Error::argument("--from-depth", "no depth above 0", "depth of what the photos show"));
    }
    Ok(scene)
}

/// `first`: pose of the capture's first input.
pub fn place(scene: &mut Scene, to_cameras: &Similarity, first: &Pose, capture: &ViewSplit) {
    let pose = first.inverse().compose(&to_cameras.pose);
    let pose = Pose { translation: pose.translation / capture.scene_scale.length, ..pose };
    scene.place(to_cameras.scale / capture.scene_scale.length, &pose);
}

fn are_plain(scene: &Scene) -> bool {
    // Logistic function of 0 and 1.
    !scene.is_empty() && scene.opacities.iter().all(|opacity| (0.5..=0.731_06).contains(opacity))
}

fn take_plain(scene: &mut Scene, file: &Path) -> Result<()> {
    for (i, opacity) in scene.opacities.iter_mut().enumerate() {
        let plain = (f64::from(*opacity) / (1.0 - f64::from(*opacity))).ln();
        if !(-1e-3..=1.001).contains(&plain) {
            let reason = format!("Gaussian {i}: found {plain} as its opacity, expected 0 to 1; --opacities logit");
            return Err(Error::format(file, None, reason));
        }
        *opacity = plain.clamp(0.0, 1.0) as f32;
    }
    Ok(())
}

/// Also returns the residual over their spread.
pub fn aligned(external: &Capture, frames: &[&CaptureView]) -> Result<(Similarity, f64)> {
    let mut pairs = Vec::new();
    for frame in frames {
        let photo = frame.photo.as_deref().unwrap_or(Path::new(&frame.name));
        pairs.extend(external.frame_of(photo)?.map(|other| (other.camera, frame.camera)));
    }
    Similarity::of_cameras(&pairs).ok_or_else(|| {
        let found = format!("{} of the {} input photos, of which no length follows", pairs.len(), frames.len());
        let expected = "at least 2 input photos, by file name, taken at different places as in the capture";
        Error::argument("--scene-cameras", found, expected)
    })
}
