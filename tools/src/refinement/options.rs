use super::{Initialization, exposure::Exposure};
use crate::{
    cameras::COLMAP,
    known_depth::KnownDepth,
    options::{Antialiasing, Size},
    session::Session,
};
use clap::{Arg, ArgGroup, Args, ValueEnum, builder::ArgPredicate};
use std::{
    ffi::OsString,
    fmt::{self, Display, Formatter},
    path::PathBuf,
    str::FromStr,
    time::Duration,
};
use zipsplat::{
    Error, Result,
    gpu::cache_dir,
    perceptual::Perceptual,
    refine::{DepthKind, DepthLoss, PerceptualLoss, RefineLength, RefineOptions},
    stages::lpips::LpipsNetwork,
    types::{Camera, Image, poses::CaptureView},
};

/// Joins `--refine` with a following value: `--refine=N` and `--refine N` work.
pub fn join_steps(args: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut joined: Vec<OsString> = Vec::new();
    for word in args {
        // Also without steps, for an error that names the option.
        let is_value = |text: &&str| text.parse::<RefineTask>().is_ok() || ["tokens", "gaussians"].contains(text);
        let steps = word.to_str().filter(is_value);
        let literal = joined.iter().any(|word| word == "--");
        match (joined.last_mut(), steps) {
            (Some(option), Some(steps)) if option == "--refine" && !literal => option.push(format!("={steps}")),
            _ => joined.push(word),
        }
    }
    joined
}

fn default_size() -> Size {
    let [width, height] = RefineOptions::default().max_image_size.unwrap_or([u32::MAX; 2]);
    Size(width, height)
}

/// Default of `--refine` and `refine`, [`RefineLength::default`].
pub const DEFAULT_LENGTH: &str = "60s";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RefineTask {
    pub length: RefineLength,
    /// Refines tokens, through the network's head, instead of Gaussians.
    pub tokens: bool,
}

impl Display for RefineTask {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.length {
            RefineLength::Time(time) => write!(f, "{}s", time.as_secs_f64())?,
            RefineLength::Steps(steps) => write!(f, "{steps}")?,
        }
        f.write_str(if self.tokens { ":tokens" } else { "" })
    }
}

impl FromStr for RefineTask {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (length, target) = text.split_once(':').unwrap_or((text, "gaussians"));
        let seconds = |text: &str| Duration::try_from_secs_f64(text.parse().ok()?).ok().map(RefineLength::Time);
        let length = match length.strip_suffix('s') {
            Some(text) => seconds(text),
            None => length.parse().ok().map(RefineLength::Steps),
        };
        let tokens = ["gaussians", "tokens"].iter().position(|name| *name == target);
        let task = length.zip(tokens).map(|(length, tokens)| Self { length, tokens: tokens == 1 });
        task.ok_or_else(|| "expected steps or a time, such as 100 or 60s, and optionally :gaussians or :tokens".into())
    }
}

pub fn parse_steps(text: &str) -> Result<RefineTask, String> {
    let steps = text.parse().ok().filter(|_| !text.contains(':'));
    steps.ok_or_else(|| "expected a number of steps, such as 100, or a time, such as 60s".into())
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum RefineTarget {
    /// Parameters of the Gaussians
    Gaussians,
    /// The network's scene tokens, through its frozen decoder
    Tokens,
}

#[derive(Args, Debug)]
pub struct RefineSettings {
    /// Initialization [default: scene; for the built-in model points, if the capture has enough]
    #[arg(long, alias = "start", value_enum, value_name = "INIT")]
    pub init: Option<Initialization>,
    /// Largest photo size; larger photos are scaled down to fit
    #[arg(long, alias = "refine-size", value_name = "WxH", default_value_t = default_size())]
    max_image_size: Size,
    /// Photos held out to select the best step, evenly spaced; 0: none [default: 1 from 40 photos
    /// on, 0 with --optimize-cameras]
    #[arg(long, alias = "hold-out", value_name = "K")]
    holdout_views: Option<usize>,
    /// Also optimize the photos' cameras, except those of the first photo and of held-out photos
    #[arg(long, alias = "refine-cameras")]
    pub optimize_cameras: bool,
    /// Learn a color transform per photo, for photos of different exposure or white balance. The
    /// scene's colors are the photos' mean
    #[arg(long, value_enum, value_name = "WHEN", default_value = "auto")]
    pub(super) exposure: Exposure,
    /// Grow the scene to at most N Gaussians (3DGS-MCMC) by relocating invisible Gaussians and
    /// adding new ones; 0: no growth, no stereo [default: from 50 steps on and below a training
    /// PSNR of 25 dB, a Gaussian per 32 pixels of the photos, at most 16 times the initial number;
    /// from 200 steps on more, up to twice as many at 800]
    #[arg(long, alias = "grow", value_name = "N", value_parser = parse_count)]
    pub max_gaussians: Option<usize>,
    /// Weight of LPIPS (VGG) in the loss, 0.05 in the paper's training; steps take many times as
    /// long. `python3 tools/lpips.py` downloads the weights of LPIPS [default: 0]
    #[arg(long, value_name = "WEIGHT", value_parser = parse_weight)]
    lpips_weight: Option<f32>,
    /// Also fit known depth: of a folder with NAME.npy (f32 [height, width]), NAME.exr or
    /// NAME.png (16-bit, 1000 levels per unit), z in the cameras' unit and 0 if unknown, or with
    /// depths.safetensors of `depth`; of a transforms.json with depth_file_path; or of a depth
    /// network, as for `depth --weights`. Networks' inverse depth is fitted to each photo by a
    /// scale and a shift
    #[arg(long, value_name = "FOLDER|FILE|NETWORK")]
    depth_loss: Option<PathBuf>,
    /// Initial weight of depth in the loss; it falls to a hundredth [default: 2; 0.5 for networks]
    #[arg(long, value_name = "WEIGHT", requires = "depth_loss", value_parser = parse_weight)]
    depth_weight: Option<f32>,
    /// Random seed of photo order and growth
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    seed: u64,
}

const SETTINGS: [&str; 9] = [
    "init",
    "max_image_size",
    "holdout_views",
    "optimize_cameras",
    "exposure",
    "max_gaussians",
    "lpips_weight",
    "depth_loss",
    "seed",
];

#[derive(Args, Debug)]
#[command(group(ArgGroup::new("settings").args(SETTINGS).multiple(true).requires("refine")))]
pub struct RefineArgs {
    /// Refine the scene against the photos for a number of steps or a time, such as 60s, as
    /// `refine` does. Ctrl-C stops early and keeps the best step so far
    #[arg(long, value_name = "STEPS|TIME", num_args = 0..=1, require_equals = true, default_missing_value = DEFAULT_LENGTH,
        value_parser = parse_steps)]
    refine: Option<RefineTask>,
    /// Optimized variables
    #[arg(long, value_enum, value_name = "TARGET", default_value = "gaussians", requires = "refine")]
    refine_target: RefineTarget,
    #[command(flatten)]
    pub settings: RefineSettings,
}

/// Refinement needs cameras: COLMAP is the default.
pub fn with_cameras(arg: Arg) -> Arg {
    if arg.get_id() == "cameras" { arg.default_value_if("refine", ArgPredicate::IsPresent, COLMAP) } else { arg }
}

fn parse_count(text: &str) -> Result<usize, String> {
    text.parse().map_err(|_| "expected a number of Gaussians, such as 20000".into())
}

fn parse_weight(text: &str) -> Result<f32, String> {
    let weight = text.parse().ok().filter(|weight: &f32| weight.is_finite() && *weight >= 0.0);
    weight.ok_or_else(|| "expected a number from 0 on, such as 0.05".into())
}

impl RefineSettings {
    pub fn check(&self) -> Result<()> {
        let found = |_| Perceptual::file(LpipsNetwork::Vgg, cache_dir().as_deref()).map(drop);
        self.lpips_weight.map_or(Ok(()), found)
    }

    /// Size of the largest photo; the limit without photos.
    pub fn largest(&self, photos: &[PathBuf]) -> Result<[u32; 2]> {
        let sizes = photos.iter().map(Image::size_as_stored).collect::<Result<Vec<_>>>()?;
        let largest = sizes.into_iter().max_by_key(|(width, height)| u64::from(*width) * u64::from(*height));
        let Size(width, height) = self.max_image_size;
        Ok(largest.map_or([width, height], |(width, height)| [width, height]))
    }

    pub fn known_depth(
        &self,
        session: &mut Session<'_>,
        photos: &[PathBuf],
        frames: &[&CaptureView],
        cameras: &[Camera],
        unit: f64,
    ) -> Result<Option<KnownDepth>> {
        let source = self.depth_loss.as_deref();
        source.map(|source| KnownDepth::open(session, source, photos, frames, cameras, unit)).transpose()
    }

    /// Settings of a plan: the kind of depth does not matter.
    pub fn planned(&self, task: RefineTask, antialiasing: Antialiasing) -> RefineOptions {
        self.request(task, antialiasing, self.depth_loss.as_ref().map(|_| DepthKind::Metric), &[])
    }

    /// EXIF exposures of `photos` can enable learned exposures.
    pub fn request(
        &self,
        RefineTask { length, .. }: RefineTask,
        antialiasing: Antialiasing,
        depth: Option<DepthKind>,
        photos: &[PathBuf],
    ) -> RefineOptions {
        let depth_loss = depth.map(DepthLoss::of);
        let perceptual_loss = self.lpips_weight.filter(|weight| *weight > 0.0);
        RefineOptions {
            length,
            max_image_size: Some([self.max_image_size.0, self.max_image_size.1]),
            holdout_views: self.holdout_views,
            optimize_cameras: self.optimize_cameras,
            exposure: self.exposure.of_photos(photos),
            antialiased: antialiasing.antialiased,
            max_gaussians: self.max_gaussians,
            perceptual_loss: perceptual_loss.map(|weight| PerceptualLoss { weight, network: LpipsNetwork::Vgg }),
            depth_loss: depth_loss
                .map(|loss| DepthLoss { weight: self.depth_weight.unwrap_or(loss.weight), ..loss })
                .filter(|loss| loss.weight > 0.0),
            seed: self.seed,
            ..RefineOptions::default()
        }
    }
}

impl RefineArgs {
    pub fn steps(&self) -> Option<RefineTask> {
        let tokens = self.refine_target == RefineTarget::Tokens;
        self.refine.map(|steps| RefineTask { tokens, ..steps })
    }

    pub fn check(&self) -> Result<()> {
        self.settings.check()?;
        self.check_target()
    }

    pub fn check_target(&self) -> Result<()> {
        let Some(steps) = self.steps() else { return Ok(()) };
        match (self.settings.init, self.settings.max_gaussians) {
            (Some(Initialization::Points | Initialization::Both), _) if steps.tokens => {
                let expected = "--init scene with --refine-target tokens";
                Err(Error::argument("--init", "points, which have no tokens", expected))
            }
            (_, Some(most)) if steps.tokens => {
                let expected = "none with --refine-target tokens, whose tokens have their Gaussians";
                Err(Error::argument("--max-gaussians", most, expected))
            }
            _ => Ok(()),
        }
    }
}
