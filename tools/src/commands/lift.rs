use crate::{
    lifted::{self, PosedPhotos, ValueFiles},
    options::{SceneInput, Weights, refuse},
    outputs::{Overwrite, size_of},
    session::Session,
    table::{bytes, counted},
};
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use zipsplat::{
    Camera, Result, Scene,
    features::{FeatureRenderer, LiftMemory, PixelValues},
    types::read_world,
};

/// Lift values of photos' pixels to Gaussians: features, masks or labels
///
/// Without VALUES these are the patch tokens of the last layer of the built-in model or of
/// --weights, also Depth Anything 3's or VGGT's. Each channel has mean 0 and standard deviation 1.
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
    #[arg(long, alias = "group", value_name = "N", default_value_t = 1)]
    gaussians_per_token: usize,
    /// Print the memory plan of VALUES and stop; --device none plans for a typical GPU
    #[arg(long, requires = "values", conflicts_with = "output")]
    pub dry_run: bool,
    /// File to write: .safetensors
    #[arg(long, short, value_name = "FILE", required_unless_present = "dry_run")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    input: SceneInput,
}

impl Lift {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let output = self.output.as_deref().unwrap_or(Path::new(""));
        if !self.dry_run {
            self.overwrite.check_file(output)?;
        }
        let (scene, _) = self.input.read(session, &self.scene)?;
        let world = read_world(&self.scene)?;
        let labels = self.labels.map(usize::from);
        let (cameras, values): (_, Box<dyn Fn(usize) -> Result<PixelValues>>) = match &self.values {
            Some(folder) => {
                refuse("--weights", !self.weights.is_builtin(), "a folder of values", "a network's features")?;
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
        let first = values(0)?;
        let channels = first.channels;
        if self.dry_run {
            return self.plan(session, &scene, &cameras, &first);
        }
        let device = session.device()?;
        let (lifted, _) = session.stage("lift", |_| {
            FeatureRenderer::new(&device).lift(&scene, &cameras, self.gaussians_per_token, channels, values)
        })?;
        lifted::save(output, &lifted, &scene)?;
        let (rows, written) = (lifted.weights.len(), size_of(output)?);
        let seen = lifted.weights.iter().filter(|weight| **weight > 0.0).count();
        let photos = cameras.len();
        let json = json!({
            "output": output.to_string_lossy(), "rows": rows, "seen": seen, "channels": channels, "photos": photos,
            "bytes": written,
        });
        let text = format!(
            "{}: {} of {channels} channels from {}, {seen} seen, {}",
            output.display(),
            counted(rows, "feature"),
            counted(photos, "photo"),
            bytes(written)
        );
        session.report(&json, text)
    }

    fn plan(&self, session: &mut Session<'_>, scene: &Scene, cameras: &[Camera], first: &PixelValues) -> Result<()> {
        let device = session.planned_device()?;
        let limits = device.map_or_else(|| session.ordinary_limits(), |device| device.limits().clone());
        let (channels, cells) = (first.channels, [first.width, first.height]);
        let plan = LiftMemory::of(&limits, scene, cameras, self.gaussians_per_token, channels, cells)?;
        session.note_excess(plan.total(), &limits);
        let json = json!({
            "device": limits.name, "channels": channels, "photos": cameras.len(), "peak_bytes": plan.total(),
            "scene_bytes": plan.scene, "feature_bytes": plan.features, "arena_bytes": plan.arena, "parts": plan.parts,
        });
        let text = format!(
            "{channels} channels from {}: {}; Gaussians {}, features {}, arena {}; {} of the channels",
            counted(cameras.len(), "photo"),
            bytes(plan.total()),
            bytes(plan.scene),
            bytes(plan.features),
            bytes(plan.arena),
            counted(plan.parts, "part")
        );
        session.report(&json, text)
    }
}
