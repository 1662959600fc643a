use super::{RefineCheckpoint, length::DETAIL};
use crate::stages::{depth_loss::DepthKind, loss::Loss, lpips::LpipsNetwork};
use std::time::Duration;

/// Length of a refinement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefineLength {
    /// Optimizer steps.
    Steps(usize),
    /// Duration. The measured time of a step decides the photos' size and the number of steps,
    /// which then follows the speed.
    Time(Duration),
}

impl Default for RefineLength {
    fn default() -> Self {
        Self::Time(Duration::from_secs(60))
    }
}

impl RefineLength {
    /// Steps to plan for; a time may become any number.
    pub(super) fn most_steps(self) -> usize {
        match self {
            Self::Steps(steps) => steps,
            Self::Time(_) => DETAIL[1],
        }
    }
}

/// Whether to learn a color transform per photo, for different exposure or white balance. The
/// scene's colors are the photos' mean; with equal exposures, held-out photos fit worse.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Exposure {
    /// If a factor per photo and color explains much of the error after the first steps.
    #[default]
    Auto,
    /// Never.
    Off,
    /// After the first steps.
    On,
}

/// Settings of a refinement.
#[derive(Clone, Debug, PartialEq)]
pub struct RefineOptions {
    /// Steps or duration; one minute by default.
    pub length: RefineLength,
    /// Photos per step, capped at the training photos.
    pub views_per_step: usize,
    /// Largest width and height of photos; larger ones are downscaled. `None`: full size.
    pub max_image_size: Option<[u32; 2]>,
    /// Limit in bytes of photos in host memory, 4 GiB by default; others are reopened.
    pub max_photo_bytes: u64,
    /// Number of held-out photos. `None`: 1 from 40 photos on, 0 if cameras are refined.
    pub holdout_views: Option<usize>,
    /// Pixel loss.
    pub loss: Loss,
    /// LPIPS term for photos large enough; it prevents batching.
    pub perceptual_loss: Option<PerceptualLoss>,
    /// Depth term for photos with [`Photos::depth`](super::Photos::depth).
    pub depth_loss: Option<DepthLoss>,
    /// Learning rates.
    pub learning_rates: LearningRates,
    /// Also refines training cameras, except the first.
    pub optimize_cameras: bool,
    /// Whether to learn the training photos' exposures.
    pub exposure: Exposure,
    /// Whether to draw and return an antialiased scene (Mip-Splatting), by default
    /// [`Scene::antialiased`](crate::types::Scene::antialiased).
    pub antialiased: Option<bool>,
    /// Number of Gaussians to grow to; no growth if at most the scene's number. `None`: from 50
    /// steps on and below a training PSNR of 25 dB, one per 32 pixels of the photos, at most 16
    /// times the scene's number; from 200 steps on more, up to twice as many at 800.
    pub max_gaussians: Option<usize>,
    /// Factor of the mean scale in the loss, over the scene scale. Ignored for tokens.
    pub scale_penalty: f32,
    /// Whether the first half of the steps uses downscaled photos.
    pub coarse_to_fine: bool,
    /// Batch limit for photos of one size. `None`: the whole step on a GPU, 1 on a CPU.
    pub batch_size: Option<usize>,
    /// Initial tile intersections per photo, grown on demand. `None`: by the number of Gaussians.
    pub intersection_capacity: Option<usize>,
    /// Scenes passed to `progress`, evenly spaced.
    pub snapshots: usize,
    /// Seed of the photo order and of growth.
    pub seed: u64,
    /// Whether to profile a step by kernel.
    pub profile: bool,
    /// File to continue from after an interruption.
    pub checkpoint: Option<RefineCheckpoint>,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            length: RefineLength::default(),
            views_per_step: 4,
            max_image_size: Some([1600; 2]),
            max_photo_bytes: 4 << 30,
            holdout_views: None,
            loss: Loss::L1Dssim,
            perceptual_loss: None,
            depth_loss: None,
            learning_rates: LearningRates::default(),
            optimize_cameras: false,
            exposure: Exposure::Auto,
            antialiased: None,
            max_gaussians: None,
            scale_penalty: 0.1,
            coarse_to_fine: true,
            batch_size: None,
            intersection_capacity: None,
            snapshots: 0,
            seed: 0,
            profile: false,
            checkpoint: None,
        }
    }
}

/// The LPIPS term of a loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PerceptualLoss {
    /// Factor of the distance.
    pub weight: f32,
    /// LPIPS network, with weights from [`Perceptual::file`](crate::perceptual::Perceptual::file).
    pub network: LpipsNetwork,
}

/// The depth term of a loss: mean difference of inverse depth, relative to the scene scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthLoss {
    /// Initial factor; it falls to a hundredth.
    pub weight: f32,
    /// Unit of the known depth.
    pub kind: DepthKind,
}

impl DepthLoss {
    /// Default weight of depth in the scene's unit.
    pub const METRIC_WEIGHT: f32 = 2.0;
    /// Default weight of relative depth.
    pub const RELATIVE_WEIGHT: f32 = 0.5;

    /// Returns the term of default weight.
    pub fn of(kind: DepthKind) -> Self {
        let weight = match kind {
            DepthKind::Metric => Self::METRIC_WEIGHT,
            DepthKind::Relative => Self::RELATIVE_WEIGHT,
        };
        Self { weight, kind }
    }
}

/// Initial rates of Adam for at most 100 steps, decaying to a tenth; for more, inversely
/// proportional to the steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRates {
    /// Centers, relative to the scene scale.
    pub means: f32,
    /// Log scales.
    pub scales: f32,
    /// Unit quaternions.
    pub quats: f32,
    /// Opacity logits.
    pub opacities: f32,
    /// Colors, the coefficients of degree 0.
    pub sh_coeffs: f32,
    /// Coefficients of higher degrees.
    pub sh_higher: f32,
    /// Tokens, if refined.
    pub tokens: f32,
    /// Camera rotations in radians, if refined.
    pub camera_rotation: f32,
    /// Camera translations, relative to the scene scale.
    pub camera_translation: f32,
    /// Color transforms, times the steps between uses of a photo.
    pub exposure: f32,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: 5e-3,
            scales: 0.1,
            quats: 0.03,
            opacities: 0.2,
            sh_coeffs: 0.03,
            sh_higher: 0.003,
            tokens: 2e-2,
            camera_rotation: 2e-3,
            camera_translation: 2e-3,
            exposure: 0.002,
        }
    }
}
