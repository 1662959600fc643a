//! LPIPS where commands compare pictures.

use clap::{Args, ValueEnum};
use zipsplat::{Device, Result, perceptual::Perceptual, stages::lpips::LpipsNetwork};

/// The choice of the network.
#[derive(Args, Debug)]
pub struct LpipsOption {
    /// Network of LPIPS; its weights are not ours to ship: `python3 tools/lpips.py` fetches them [default: vgg where its weights
    /// are, else none]
    #[arg(long, value_enum, value_name = "NETWORK")]
    lpips: Option<Network>,
}

/// Networks that see pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Network {
    /// VGG16, as the paper
    Vgg,
    /// AlexNet, ten times as fast
    Alex,
    /// No LPIPS
    None,
}

impl LpipsOption {
    /// Loads the weights onto a device, with `gradients` or for the distance alone; `None` where they are not there and were not asked for.
    ///
    /// # Errors
    /// Those of [`Perceptual::open`]; of [`Perceptual::file`] where a network was asked for.
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

    /// Whether nothing was said.
    pub fn is_default(&self) -> bool {
        self.lpips.is_none()
    }
}

/// The distance of two pictures of one size, `[height][width][rgb]` in 0..1; `None` without a network and for pictures that are too
/// small for it.
///
/// # Errors
/// As [`Perceptual::distance`].
pub fn distance(lpips: Option<&mut Perceptual>, pictures: [&[f32]; 2], size: [u32; 2]) -> Result<Option<f64>> {
    match lpips {
        Some(lpips) if size[0].min(size[1]) >= lpips.network().least_side() => lpips.distance(pictures, size).map(Some),
        _ => Ok(None),
    }
}
