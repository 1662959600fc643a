//! LPIPS where commands compare pictures.

use crate::session::Session;
use clap::{Args, ValueEnum};
use zipsplat::{Result, perceptual::Perceptual, stages::lpips::LpipsNetwork};

/// The choice of the network.
#[derive(Args)]
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
    /// Loads the weights; `None` where they are not there and were not asked for, which is noted.
    ///
    /// # Errors
    /// Those of opening a device and of [`Perceptual::open`]; of [`Perceptual::file`] where a network was asked for.
    pub fn open(&self, session: &mut Session<'_>) -> Result<Option<Perceptual>> {
        let network = match self.lpips {
            Some(Network::None) => return Ok(None),
            Some(Network::Alex) => LpipsNetwork::Alex,
            Some(Network::Vgg) | None => LpipsNetwork::Vgg,
        };
        let path = match (Perceptual::file(network), self.lpips) {
            (Ok(path), _) => path,
            (Err(error), Some(_)) => return Err(error),
            (Err(_), None) => {
                session.note("no LPIPS: its weights are not here; `python3 tools/lpips.py` fetches them (64 MB)");
                return Ok(None);
            }
        };
        let device = session.device()?;
        Ok(Some(Perceptual::open(&device, network, &path)?))
    }
}
