//! What a refinement may do beside moving the Gaussians that there are.

use clap::Args;
use zipsplat::{
    Result,
    perceptual::Perceptual,
    refine::{Look, Refine},
    stages::lpips::LpipsNetwork,
};

/// The choice of what moves beside the Gaussians that there are.
#[derive(Args, Debug)]
pub struct Moved {
    /// Move the photos' cameras, too, where they are not exact. The first photo's camera stays, and so do those of held-out photos
    #[arg(long, alias = "optimize-cameras")]
    refine_cameras: bool,
    /// Let the scene grow to at most N Gaussians: those that nobody sees, and those that are missing, are put where others are
    #[arg(long, alias = "max-gaussians", value_name = "N", value_parser = parse_count)]
    pub(super) grow: Option<usize>,
    /// Add so much of LPIPS (VGG) to the loss, 0.05 in the paper's training: a step takes many times as long. Its weights are not ours to
    /// ship: `python3 tools/lpips.py` fetches them [default: 0]
    #[arg(long, value_name = "WEIGHT", value_parser = parse_weight)]
    lpips_weight: Option<f32>,
}

fn parse_count(text: &str) -> Result<usize, String> {
    let count = text.parse().ok().filter(|count| *count > 0);
    count.ok_or_else(|| "expected a number of Gaussians, such as 20000".into())
}

fn parse_weight(text: &str) -> Result<f32, String> {
    let weight = text.parse().ok().filter(|weight: &f32| weight.is_finite() && *weight >= 0.0);
    weight.ok_or_else(|| "expected a number from 0 on, such as 0.05".into())
}

impl Moved {
    /// Refuses a share of LPIPS without its weights, before anything is computed.
    ///
    /// # Errors
    /// As [`Perceptual::file`].
    pub fn check(&self) -> Result<()> {
        self.lpips_weight.map_or(Ok(()), |_| Perceptual::file(LpipsNetwork::Vgg).map(drop))
    }

    /// The request with that in it.
    pub fn request(&self, request: Refine) -> Refine {
        let look = self.lpips_weight.filter(|weight| *weight > 0.0);
        let look = look.map(|weight| Look { weight, network: LpipsNetwork::Vgg });
        Refine { cameras: self.refine_cameras, grow: self.grow, look, ..request }
    }
}
