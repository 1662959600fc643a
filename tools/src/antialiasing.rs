use crate::options::refuse;
use clap::Args;
use zipsplat::Result;

#[derive(Args, Clone, Copy)]
pub struct Antialiasing {
    /// Whether the scene is antialiased: pictures fade Gaussians thinner than a pixel, as in
    /// Mip-Splatting [default: as its file states]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    antialiased: Option<bool>,
}

impl Antialiasing {
    /// `None` for the scene's own.
    pub fn given(self) -> Option<bool> {
        self.antialiased
    }

    pub fn refuse(self, found: &str, expected: &str) -> Result<()> {
        refuse("--antialiased", self.antialiased.is_some(), found, expected)
    }
}
