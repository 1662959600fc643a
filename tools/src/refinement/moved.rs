//! Optional parts of a refinement.

use clap::Args;
use zipsplat::{
    Result,
    perceptual::Perceptual,
    refine::{PerceptualLoss, RefineOptions},
    stages::lpips::LpipsNetwork,
};

#[derive(Args, Debug)]
pub struct Moved {
    /// Also refine the photos' cameras, except the first photo's and held-out ones
    #[arg(long)]
    optimize_cameras: bool,
    /// Let the scene grow to at most N Gaussians: invisible ones are relocated, and missing ones
    /// added; 0: none [default: from 300 steps, one per 32 pixels, up to four times as many]
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub(super) max_gaussians: Option<usize>,
    /// Weight of LPIPS (VGG) in the loss, 0.05 in the paper's training: steps take many times as
    /// long. `python3 tools/lpips.py` downloads its weights, which we cannot ship [default: 0]
    #[arg(long, value_name = "WEIGHT", value_parser = parse_weight)]
    lpips_weight: Option<f32>,
}

fn parse_count(text: &str) -> Result<usize, String> {
    text.parse().map_err(|_| "expected a number of Gaussians, such as 20000".into())
}

fn parse_weight(text: &str) -> Result<f32, String> {
    let weight = text.parse().ok().filter(|weight: &f32| weight.is_finite() && *weight >= 0.0);
    weight.ok_or_else(|| "expected a number from 0 on, such as 0.05".into())
}

impl Moved {
    pub fn optimizes_cameras(&self) -> bool {
        self.optimize_cameras
    }

    pub fn check(&self) -> Result<()> {
        self.lpips_weight.map_or(Ok(()), |_| Perceptual::file(LpipsNetwork::Vgg).map(drop))
    }

    pub fn request(&self, request: RefineOptions) -> RefineOptions {
        let perceptual_loss = self.lpips_weight.filter(|weight| *weight > 0.0);
        let perceptual_loss = perceptual_loss.map(|weight| PerceptualLoss { weight, network: LpipsNetwork::Vgg });
        RefineOptions {
            optimize_cameras: self.optimize_cameras,
            max_gaussians: self.max_gaussians,
            perceptual_loss,
            ..request
        }
    }
}
