//! LPIPS in commands that compare pictures.

use clap::{Args, ValueEnum};
use zipsplat::{Device, Result, perceptual::Perceptual, stages::lpips::LpipsNetwork};

#[derive(Args, Debug)]
pub struct LpipsOption {
    /// LPIPS network; `python3 tools/lpips.py` downloads its weights, which we cannot ship
    /// [default: vgg if its weights are available, else none]
    #[arg(long, value_enum, value_name = "NETWORK")]
    lpips: Option<Network>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Network {
    /// VGG16, as in the paper
    Vgg,
    /// AlexNet, ten times as fast
    Alex,
    /// No LPIPS
    None,
}

impl LpipsOption {
    /// Loads the weights, with `gradients` or for the distance alone; `None` if they are missing
    /// and were not requested.
    pub fn open(&self, device: &Device, gradients: bool) -> Result<Option<Perceptual>> {
        let network = match self.lpips {
            Some(Network::None) => return Ok(None),
            Some(Network::Alex) => LpipsNetwork::Alex,
            Some(Network::Vgg) | None => LpipsNetwork::Vgg,
        };
        match (Perceptual::file(network), self.lpips) {
            (Ok(path), _) => Perceptual::open(device, network, &path, gradients).map(Some),
            (Err(error), Some(_)) => Err(error),
            (Err(_), None) => Ok(None),
        }
    }

    pub fn is_default(&self) -> bool {
        self.lpips.is_none()
    }
}

/// Returns the distance of two pictures of equal size, `[height][width][rgb]` in 0..1; `None`
/// without a network, or for pictures that are too small.
pub fn distance(lpips: Option<&mut Perceptual>, pictures: [&[f32]; 2], size: [u32; 2]) -> Result<Option<f64>> {
    match lpips {
        Some(lpips) if size[0].min(size[1]) >= lpips.network().least_side() => lpips.distance(pictures, size).map(Some),
        _ => Ok(None),
    }
}
