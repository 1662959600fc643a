//! `zipsplat eval`: reconstructs a capture from some of its photos and compares pictures of it with the others.

use crate::{
    capture::{Capture, Choice, Posed, Score},
    options::{Quality, Weights, parse_length},
    outputs,
    session::Session,
    table::Table,
};
use clap::Args;
use rayon::prelude::*;
use std::path::PathBuf;
use zipsplat::{
    Result,
    reconstruct::{Request, Shape},
    stages::render::Renderer,
    types::{Image, contact_sheet},
};

/// Held-out photos in the picture.
const SHOWN: usize = 12;

/// How well photos that a reconstruction has not seen are predicted
///
/// Reconstructs a capture from some of its photos with their cameras, draws the scene as each of the other photos sees it,
/// and compares. The scene is given to the network in the unit it expects: the median distance of the capture's points
/// (ply_file_path of transforms.json, points.ply, or COLMAP's points3D) from the first camera. Beside PSNR and SSIM stand two trivial
/// predictions: the input photo that was taken nearest, and that photo's mean colour.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat eval capture/ --views 8
  zipsplat eval capture/ --views 8 --ratio 0.5 --csv capture.csv -o out/")]
pub struct Eval {
    /// Folder with photos and their cameras: a transforms.json or a COLMAP model
    folder: PathBuf,
    /// Photos to reconstruct from, spread by farthest-point sampling of where they were taken
    #[arg(long, value_name = "N", default_value = "8", value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Compare with so many of the other photos, evenly spread [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    targets: Option<u32>,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    /// Length in the cameras' unit that becomes the network's 1 [default: the median distance of the capture's points]
    #[arg(long, value_name = "LENGTH", value_parser = parse_length)]
    unit: Option<f64>,
    /// Table to write: view, psnr, ssim, nearest_psnr, mean_colour_psnr, a row for each photo compared
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Folder for scene.ply, in the cameras' unit, and comparison.png: photos, what was drawn in their place, and the nearest
    /// input photos
    #[arg(long, short, value_name = "FOLDER")]
    output: Option<PathBuf>,
}

impl Eval {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.csv.as_deref().map_or(Ok(()), outputs::check_file)?;
        self.output.as_deref().map_or(Ok(()), outputs::check_folder)?;
        let checkpoint = self.weights.open()?;
        self.quality.check(checkpoint.architecture())?;
        let size = self.quality.size_for(&checkpoint);
        let choice = Choice::new(&self.folder, self.views as usize, self.targets.map(|targets| targets as usize))?;
        choice.notes().iter().for_each(|note| session.note(note));
        let chosen = (self.quality.ratio, &self.quality.select);
        let shape = Shape::new(checkpoint.architecture(), self.views as usize, [size.0, size.1], chosen, true)?;
        let device = session.device()?;
        let (precision, arithmetic) = self.quality.arithmetic.choose(session, &device)?;
        let (capture, _) = session.stage("load photos", |stage| choice.load(size, self.unit, stage))?;
        capture.cropping.iter().for_each(|note| session.note(note));

        let (model, _) = session.load_model(&device, &checkpoint, arithmetic)?;
        let images = capture.images();
        let request = Request {
            ratio: self.quality.ratio,
            selection: self.quality.select.clone(),
            cameras: Some(capture.cameras()),
        };
        let (mut result, took) = session.reconstruct(&model, &images, &request)?;
        self.quality.prune(&mut result.scene, checkpoint.architecture());
        let mut renderer = Renderer::new(&device);
        renderer.load(&result.scene)?;
        let (drawn, _) = session.stage("compare", |stage| {
            let draw = |(i, view): (usize, &Posed)| {
                stage.reach(i as f64 / capture.targets.len() as f64)?;
                view.draw(&mut renderer)
            };
            capture.targets.iter().enumerate().map(draw).collect::<Result<Vec<Vec<f32>>>>()
        })?;
        let scores: Vec<Score> =
            capture.targets.par_iter().zip(&drawn).map(|(view, drawn)| capture.score(view, drawn)).collect();

        if let Some(path) = &self.csv {
            outputs::save_csv(path, &scores)?;
        }
        if let Some(folder) = &self.output {
            outputs::make_folder(folder)?;
            // Drawn and compared in the network's unit, kept in that of the cameras.
            result.scene.scale(capture.unit as f32);
            outputs::save_scene(&folder.join("scene.ply"), &result.scene, Some(&capture.inputs[0].name))?;
            comparison(&capture, &drawn)?.save_png(folder.join("comparison.png"))?;
        }
        let mean = Score::mean(&scores);
        let mut table = Table::new(1, &["view", "PSNR", "SSIM", "nearest photo", "mean colour"]);
        scores.iter().chain([&mean]).for_each(|score| table.row(cells(score)));
        let text = format!(
            "{table}{} of {size} from {} of its photos, {} Gaussians of {} tokens in {:.2} s; unit {:.4}",
            self.folder.display(),
            capture.inputs.len(),
            result.scene.len(),
            result.tokens,
            took.as_secs_f64(),
            capture.unit
        );
        let json = serde_json::json!({
            "folder": self.folder, "weights": checkpoint.provenance(), "precision": precision.name(), "width": size.0, "height": size.1,
            "inputs": capture.inputs.iter().map(|view| &view.name).collect::<Vec<_>>(), "unit": capture.unit,
            "tokens": result.tokens, "all_tokens": shape.grid.tokens(), "gaussians": result.scene.len(),
            "peak_bytes": result.peak_bytes,
            "mean": mean, "views": scores,
        });
        session.report(&json, text)
    }
}

fn cells(score: &Score) -> [String; 5] {
    let db = |value: f64| format!("{value:.2} dB");
    [
        score.view.clone(),
        db(score.psnr),
        format!("{:.3}", score.ssim),
        db(score.nearest_psnr),
        db(score.mean_colour_psnr),
    ]
}

/// For some of the photos, evenly spread, two in a row: the photo, what was drawn, the nearest input.
fn comparison(capture: &Capture, drawn: &[Vec<f32>]) -> Result<Image> {
    let targets = &capture.targets;
    let shown = targets.len().min(SHOWN);
    let mut images = Vec::new();
    for i in (0..shown).map(|i| i * targets.len() / shown) {
        let Image { width, height, .. } = targets[i].image;
        let drawn = Image::from_rgb_f32(width, height, &drawn[i])?;
        images.extend([targets[i].image.clone(), drawn, capture.nearest(&targets[i]).image.clone()]);
    }
    contact_sheet(&images, 6)
}
