mod choice;
mod filter;
mod indices;
mod places;

pub use choice::Setting;
pub use filter::Filter;
pub use indices::Indices;
pub use places::Place;

use clap::ValueEnum;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Protocol {
    /// DL3DV: transforms.json and images_4; 6, 12 and 24 inputs of the first 50, 100 and 150 frames
    Dl3dv,
    /// RealEstate10K: camera files NAME.txt, frames in NAME/; 6 inputs, evenly spaced
    Re10k,
    /// Mip-NeRF 360: a COLMAP model and images_4; 32, 64 and 128 inputs
    Mipnerf360,
    /// ScanNet++: dslr/colmap and dslr/resized_images, undistorted; 32, 64 and 128 inputs
    Scannetpp,
}

impl Protocol {
    pub fn title(self) -> &'static str {
        match self {
            Self::Dl3dv => "DL3DV",
            Self::Re10k => "RealEstate10K",
            Self::Mipnerf360 => "Mip-NeRF 360",
            Self::Scannetpp => "ScanNet++",
        }
    }

    /// In the paper's tables 1 to 3.
    fn views(self) -> &'static [u32] {
        match self {
            Self::Dl3dv => &[6, 12, 24],
            Self::Re10k => &[6],
            Self::Mipnerf360 | Self::Scannetpp => &[32, 64, 128],
        }
    }

    /// `None` for all frames.
    fn gap(self, views: u32) -> Option<usize> {
        match (self, views) {
            (Self::Dl3dv, 6) => Some(50),
            (Self::Dl3dv, 12) => Some(100),
            (Self::Dl3dv, 24) => Some(150),
            _ => None,
        }
    }
}
