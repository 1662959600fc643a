//! Refinement in commands: initialization, progress and report.

mod moved;

pub use moved::Moved;

use crate::{
    cameras::{Similarity, path_from},
    options::Size,
    session::Session,
    table::{Table, bytes, counted, significant, time},
};
use clap::{Arg, ArgGroup, Args, ValueEnum};
use glam::DQuat;
use serde_json::{Value, json};
use std::{
    ffi::OsString,
    fmt::{self, Display, Formatter},
    ops::ControlFlow,
    path::{Path, PathBuf},
    str::FromStr,
};
use zipsplat::{
    Error, Result,
    gpu::Arena,
    reconstruct::SceneTokens,
    refine::{
        FrozenHead, LearningRates, RefineOptions, RefineResult, Refining, StopReason, refine_scene, refine_tokens,
    },
    types::{
        Camera, Image, PointCloud, Pose, Scene,
        poses::{CaptureView, write_frames},
    },
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Initialization {
    /// A Gaussian at each point of the capture's point cloud
    Points,
    /// The scene's Gaussians
    Scene,
    /// Both together
    Both,
}

/// Minimum points to prefer over the built-in model's scene.
const ENOUGH: usize = 500;

impl Initialization {
    /// Points only for the built-in model, if there are enough.
    pub fn or_best(asked: Option<Self>, cloud: Option<&PointCloud>, embedded: bool) -> Self {
        let enough = embedded && cloud.is_some_and(|cloud| cloud.positions.len() >= ENOUGH);
        asked.unwrap_or(if enough { Self::Points } else { Self::Scene })
    }

    /// A scene, and points.
    pub fn needs(self) -> [bool; 2] {
        [self != Self::Points, self != Self::Scene]
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Points => "the capture's points",
            Self::Scene => "the scene",
            Self::Both => "the scene and the capture's points",
        }
    }

    /// Unneeded arguments may be `None`.
    pub fn scene(self, scene: Option<Scene>, cloud: Option<&PointCloud>, cameras: &[Camera]) -> Result<Scene> {
        let lacks = |found: &str, expected: &str| Error::argument("start of the refinement", found, expected);
        let of_scene = || scene.ok_or_else(|| lacks("no scene", "a scene, or --init points"));
        let of_points = || {
            let expected =
                "ply_file_path of transforms.json, points.ply beside it, or COLMAP's points3D; or --init scene";
            Scene::from_points(cloud.ok_or_else(|| lacks("no point cloud", expected))?, cameras)
        };
        match self {
            Self::Scene => of_scene(),
            Self::Points => of_points(),
            Self::Both => Ok(Scene::concat(of_scene()?, of_points()?)),
        }
    }
}

/// Requires cameras for `--refine`.
pub fn with_cameras(arg: Arg) -> Arg {
    if arg.get_id() == "refine" { arg.requires("cameras") } else { arg }
}

pub const TOKENS: &str = "the network's tokens";

pub const DEFAULT_STEPS: &str = "100";

/// Joins `--refine` with a following number of steps, so that `--refine`, `--refine=N` and
/// `--refine N` work for every command.
pub fn join_steps(args: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut joined: Vec<OsString> = Vec::new();
    for word in args {
        // Also a target without steps, for an error that names the option.
        let is_value = |text: &&str| text.parse::<Steps>().is_ok() || ["tokens", "gaussians"].contains(text);
        let steps = word.to_str().filter(is_value);
        let literal = joined.iter().any(|word| word == "--");
        match (joined.last_mut(), steps) {
            (Some(option), Some(steps)) if option == "--refine" && !literal => option.push(format!("={steps}")),
            _ => joined.push(word),
        }
    }
    joined
}

/// Along x and y.
pub const MOST_PIXELS: &str = "1600x1600";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Steps {
    pub count: usize,
    /// Refines tokens, through the network's head, instead of Gaussians.
    pub tokens: bool,
}

impl Default for Steps {
    fn default() -> Self {
        Self { count: RefineOptions::default().steps, tokens: false }
    }
}

impl Display for Steps {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.count, if self.tokens { ":tokens" } else { "" })
    }
}

impl Steps {
    /// Rejects initializations that tokens cannot use, and LPIPS without its weights.
    pub fn check(self, start: Option<Initialization>, moved: &Moved) -> Result<()> {
        moved.check()?;
        match (start, moved.max_gaussians) {
            (Some(Initialization::Points | Initialization::Both), _) if self.tokens => Err(Error::argument(
                "--init",
                "points, which have no tokens",
                "--init scene with --refine-target tokens",
            )),
            (_, Some(most)) if self.tokens => Err(Error::argument(
                "--max-gaussians",
                most,
                "none with --refine-target tokens, whose tokens have their Gaussians",
            )),
            _ => Ok(()),
        }
    }
}

impl FromStr for Steps {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (number, moved) = text.split_once(':').unwrap_or((text, "gaussians"));
        let tokens = match moved {
            "tokens" => Some(true),
            "gaussians" => Some(false),
            _ => None,
        };
        let steps = number.parse().ok().zip(tokens).map(|(count, tokens)| Self { count, tokens });
        steps.ok_or_else(|| "expected a number of steps, such as 100, 100:gaussians or 100:tokens".into())
    }
}

fn parse_steps(text: &str) -> Result<usize, String> {
    text.parse().map_err(|_| "expected a number of steps, such as 100".into())
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum RefineTarget {
    /// The Gaussians
    Gaussians,
    /// The network's tokens, through its frozen head
    Tokens,
}

#[derive(Args, Debug)]
#[command(group(ArgGroup::new("moved").args(["optimize_cameras", "max_gaussians", "lpips_weight"]).multiple(true).requires("refine")))]
pub struct RefineArgs {
    /// Refine the scene against the photos, for this number of steps. The best step by held-out
    /// photos is kept. Ctrl-C ends early with the best so far
    #[arg(long, value_name = "STEPS", num_args = 0..=1, require_equals = true, default_missing_value = DEFAULT_STEPS,
        value_parser = parse_steps)]
    refine: Option<usize>,
    /// Optimized quantity
    #[arg(long, value_enum, value_name = "WHAT", default_value = "gaussians", requires = "refine")]
    refine_target: RefineTarget,
    /// Initialization of --refine; points are those of structure from motion beside the cameras
    /// [default: for the built-in model points, if there are enough, else the scene]
    #[arg(long, value_enum, value_name = "WHAT", requires = "refine")]
    pub init: Option<Initialization>,
    /// Largest compared size in --refine; larger photos are scaled down to fit
    #[arg(long, value_name = "WxH", default_value = MOST_PIXELS, requires = "refine")]
    max_image_size: Size,
    /// Photos that --refine holds out, evenly spread; 0 trains on all [default: 1 of 40 or more,
    /// none with --optimize-cameras]
    #[arg(long, value_name = "K", requires = "refine")]
    holdout_views: Option<usize>,
    #[command(flatten)]
    moved: Moved,
}

impl RefineArgs {
    pub fn optimizes_cameras(&self) -> bool {
        self.moved.optimizes_cameras()
    }

    pub fn steps(&self) -> Option<Steps> {
        let tokens = self.refine_target == RefineTarget::Tokens;
        self.refine.map(|count| Steps { count, tokens })
    }

    /// Rejects initializations that tokens cannot use.
    pub fn check(&self) -> Result<()> {
        self.steps().map_or(Ok(()), |steps| steps.check(self.init, &self.moved))
    }

    /// Size of the largest photo, scaled down to the limit; the limit without photos.
    pub fn largest(&self, photos: &[PathBuf]) -> Result<[u32; 2]> {
        let Size(most_width, most_height) = self.max_image_size;
        let mut largest = [0; 2];
        for photo in photos {
            let (width, height) = Image::size_as_stored(photo)?;
            if u64::from(width) * u64::from(height) > u64::from(largest[0]) * u64::from(largest[1]) {
                largest = [width, height];
            }
        }
        Ok(if photos.is_empty() { [most_width, most_height] } else { largest })
    }

    pub fn request(&self, steps: usize) -> RefineOptions {
        let size = Some([self.max_image_size.0, self.max_image_size.1]);
        self.moved.request(RefineOptions {
            steps,
            max_image_size: size,
            holdout_views: self.holdout_views,
            ..RefineOptions::default()
        })
    }
}

/// `to_world` maps the scene to the cameras' world.
pub fn save_cameras(
    path: &Path,
    refined: &RefineResult,
    to_world: &Similarity,
    photos: &[PathBuf],
    frames: &[&CaptureView],
) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let moved = |((camera, photo), frame): ((&Camera, &PathBuf), &&CaptureView)| {
        let camera = Camera { intrinsics: frame.camera.intrinsics, ..to_world.apply(camera) };
        Ok(CaptureView { name: path_from(folder, photo)?, camera, ..CaptureView::clone(frame) })
    };
    let moved = refined.cameras.iter().zip(photos).zip(frames).map(moved).collect::<Result<Vec<CaptureView>>>()?;
    write_frames(path, &moved, None)
}

/// Median rotation in degrees, and shift, of the moved cameras.
pub fn camera_movement(given: &[Camera], refined: &RefineResult) -> Option<[f64; 2]> {
    let pairs = given.iter().zip(&refined.cameras).filter(|(given, refined)| given != refined);
    let movements: Vec<Pose> = pairs.map(|(given, refined)| refined.pose.relative_to(&given.pose)).collect();
    let median = |of: fn(&Pose) -> f64| {
        let mut values: Vec<f64> = movements.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let degrees = median(|pose| DQuat::from_mat3(&pose.rotation).to_scaled_axis().length().to_degrees());
    Some([degrees?, median(|pose| pose.translation.length())?])
}

pub enum Refinable<'a> {
    Scene(&'a Scene),
    Tokens(&'a FrozenHead, &'a SceneTokens),
}

/// Maps a point x to `pose(x) / unit`.
pub fn placed(mut cloud: PointCloud, pose: &Pose, unit: f64) -> PointCloud {
    for at in &mut cloud.positions {
        *at = (pose.transform(at.map(f64::from).into()) / unit).as_vec3().to_array();
    }
    cloud
}

/// Cancellation returns the best so far.
pub fn refine(
    session: &Session<'_>,
    arena: &Arena,
    from: Refinable<'_>,
    photos: &[Image],
    cameras: &[Camera],
    request: &RefineOptions,
) -> Result<RefineResult> {
    let mut refined = None;
    let staged = session.stage("refine", |stage| {
        let progress = |at: Refining<'_>| -> ControlFlow<()> {
            stage.name(&progress_message(&at));
            stage.at(at.step as f64 / at.steps as f64)
        };
        refined = Some(match from {
            Refinable::Scene(scene) => refine_scene(arena, scene, photos, cameras, request, progress)?,
            Refinable::Tokens(head, tokens) => refine_tokens(arena, head, tokens, photos, cameras, request, progress)?,
        });
        Ok(())
    });
    match (staged, refined) {
        (Ok(_) | Err(Error::Cancelled), Some(refined)) => Ok(refined),
        (staged, _) => Err(staged.err().unwrap_or(Error::Cancelled)),
    }
}

fn progress_message(at: &Refining<'_>) -> String {
    let loss = at.loss.map(|loss| format!(", loss {loss:.4}")).unwrap_or_default();
    let psnr = at.psnr.map(|psnr| format!(", {psnr:.2} dB")).unwrap_or_default();
    format!("refine{loss}{psnr}")
}

pub fn summary(refined: &RefineResult, start: &str, given: &[Camera]) -> String {
    let (steps, step, [after, before]) = (refined.losses.len(), refined.best_step, refined.training_psnr);
    let training = counted(given.len() - refined.holdout_views.len(), "training photo");
    let psnr = refined.psnr().map(|[after, before]| format!("; held-out {before:.2} to {after:.2} dB"));
    let cameras = camera_movement(given, refined).map(|[degrees, distance]| {
        format!("; cameras turned by {degrees:.2} degrees and moved by {} (medians)", significant(distance))
    });
    format!(
        "refined from {start} in {}: kept is step {step} of {steps}; {training} {before:.2} to {after:.2} dB{}{}",
        time(refined.took),
        psnr.unwrap_or_default(),
        cameras.unwrap_or_default()
    )
}

pub fn as_json(refined: &RefineResult, start: &str, given: &[Camera]) -> Value {
    let cameras = camera_movement(given, refined);
    json!({
        "init": start,
        "camera_movement": cameras.map(|[degrees, distance]| json!({ "rotation_deg": degrees, "translation": distance })),
        "training_psnr": { "initial": refined.training_psnr[1], "best": refined.training_psnr[0] },
        "holdout_psnr": refined.psnr().map(|[best, initial]| json!({ "initial": initial, "best": best })),
        "steps": refined.losses.len(), "best_step": refined.best_step, "losses": refined.losses,
        "holdout_psnr_by_step": refined.holdout_psnr, "holdout_views": refined.holdout_views, "sizes": refined.sizes, "stop_reason": ended(refined),
        "seconds": refined.took.as_secs_f64(), "peak_bytes": refined.peak_bytes,
    })
}

pub fn explain(refined: &RefineResult, request: &RefineOptions, start: &str, photos: &[PathBuf]) -> Table {
    let name = |i: &usize| photos[*i].file_name().unwrap_or_default().to_string_lossy().into_owned();
    let held: Vec<String> = refined.holdout_views.iter().map(name).collect();
    let size = |(step, [width, height]): &(usize, [u32; 2])| format!("{width}x{height} from step {}", step + 1);
    let sizes: Vec<String> = refined.sizes.iter().map(size).collect();
    let LearningRates {
        means,
        scales,
        quats,
        opacities,
        sh_coeffs,
        sh_higher,
        tokens,
        camera_rotation,
        camera_translation,
    } = request.learning_rates;
    let mut rates = match start {
        TOKENS => format!("tokens {tokens}"),
        _ => format!(
            "means {means} of the scene's distance, ln scales {scales}, quats {quats}, logit opacities {opacities}, \
             colors {sh_coeffs}, higher harmonics {sh_higher}"
        ),
    };
    if request.optimize_cameras {
        rates +=
            &format!(", camera rotations {camera_rotation}, translations {camera_translation} of the scene's distance");
    }
    let (steps, each) = (refined.losses.len(), request.views_per_step.min(photos.len() - refined.holdout_views.len()));
    let or_none = |list: String| if list.is_empty() { "none".into() } else { list };
    let mut table = Table::new(2, &["refined", ""]);
    for (what, value) in [
        ("init", start.to_owned()),
        (
            "steps",
            format!(
                "{steps} of {}, of {} each; kept is step {}",
                request.steps,
                counted(each, "photo"),
                refined.best_step
            ),
        ),
        ("rates", format!("{rates}; less for more than 100 steps; they fall to a tenth")),
        ("held-out photos", or_none(held.join(", "))),
        ("largest photo", or_none(sizes.join(", "))),
        ("memory", bytes(refined.peak_bytes)),
        ("stop reason", ended(refined)),
    ] {
        table.row([what.into(), value]);
    }
    table
}

fn ended(refined: &RefineResult) -> String {
    match &refined.stop_reason {
        None => "after all steps".into(),
        Some(StopReason::Cancelled) => "cancelled".into(),
        Some(StopReason::Diverged(why)) => why.clone(),
    }
}

/// Photos below which a refinement without held-out ones overfits.
const FEW: usize = 6;

pub fn doubt(refined: &RefineResult) -> Option<String> {
    let training = refined.cameras.len() - refined.holdout_views.len();
    match &refined.stop_reason {
        None if refined.holdout_views.is_empty() && training < FEW && refined.best_step > 0 => Some(format!(
            "only {} to refine against, and none held out: other views may look worse than before; more photos help, and \
             --holdout-views 1 measures it",
            counted(training, "photo")
        )),
        Some(StopReason::Diverged(why)) => {
            Some(format!("the refinement ended early: {why}; kept is what was after step {}", refined.best_step))
        }
        _ => None,
    }
}
