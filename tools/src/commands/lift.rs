use crate::{
    lifted::{self, PosedPhotos, ValueFiles},
    options::{SceneInput, Weights},
    outputs::{Overwrite, size_of},
    session::Session,
    table::{bytes, counted},
};
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use zipsplat::{
    Result,
    features::{FeatureRenderer, PixelValues},
    types::read_world,
};

/// Lift values of photos' pixels to Gaussians: features, masks or labels
///
/// Without VALUES these are the patch tokens of a network's last layer, of the built-in model or
/// --weights, with mean 0 and standard deviation 1 per channel.
///
/// A Gaussian gets the mean of all pixels' values, weighted by its blending weights. Writes
/// safetensors: features [rows, channels], weights [rows] in pixels, and the scene's hash.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat lift scene.ply --cameras transforms.json -o features.safetensors
  zipsplat lift scene.ply features/ --cameras transforms.json -o features.safetensors
  zipsplat lift scene.ply labels/ --labels 21 --cameras transforms.json -o labels.safetensors")]
pub struct Lift {
    /// Scene (PLY, SPZ, SOG, .splat or glTF)
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Folder with NAME.npy, f32 [height, width, channels] of any size, or NAME.png, a mask, for
    /// photos NAME; a NaN does not count
    #[arg(value_name = "VALUES")]
    values: Option<PathBuf>,
    #[command(flatten)]
    weights: Weights,
    /// Largest number of photos that the network sees, evenly spaced
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u8).range(1..=192),
        conflicts_with = "values")]
    views: u8,
    #[command(flatten)]
    photos: PosedPhotos,
    /// PNG pictures hold labels from 0 to N - 1, a channel each; other values do not count
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..), requires = "values")]
    labels: Option<u8>,
    /// Consecutive Gaussians per feature: 1, or those of a token
    #[arg(long, value_name = "N", default_value_t = 1)]
    gaussians_per_token: usize,
    /// File to write: .safetensors
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    input: SceneInput,
}

impl Lift {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.overwrite.check_file(&self.output)?;
        let (scene, _) = self.input.read(session, &self.scene)?;
        let world = read_world(&self.scene)?;
        let labels = self.labels.map(usize::from);
        let (cameras, values): (_, Box<dyn Fn(usize) -> Result<PixelValues>>) = match &self.values {
            Some(folder) => {
                let files = ValueFiles::find(session, folder, &self.photos, world.as_ref())?;
                (files.cameras(), Box::new(move |i| files.read(i, labels)))
            }
            None => {
                let views = usize::from(self.views);
                let (cameras, values) =
                    lifted::of_network(session, &self.weights, views, &self.photos, world.as_ref())?;
                (cameras, Box::new(move |i| Ok(values[i].clone())))
            }
        };
        let channels = values(0)?.channels;
        let device = session.device()?;
        let (lifted, _) = session.stage("lift", |_| {
            FeatureRenderer::new(&device).lift(&scene, &cameras, self.gaussians_per_token, channels, values)
        })?;
        lifted::save(&self.output, &lifted, &scene)?;
        let (rows, written) = (lifted.weights.len(), size_of(&self.output)?);
        let seen = lifted.weights.iter().filter(|weight| **weight > 0.0).count();
        let photos = cameras.len();
        let json = json!({
            "output": self.output, "rows": rows, "seen": seen, "channels": channels, "photos": photos,
            "bytes": written,
        });
        let text = format!(
            "{}: {} of {channels} channels from {}, {seen} seen, {}",
            self.output.display(),
            counted(rows, "feature"),
            counted(photos, "photo"),
            bytes(written)
        );
        session.report(&json, text)
    }
}
