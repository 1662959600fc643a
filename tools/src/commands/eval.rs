//! `zipsplat eval`: reconstructs a capture from some of its photos and compares pictures of it with the others.

use crate::{
    align::{Aligned, align},
    capture::{Capture, Choice, Posed, Score, draw},
    options::{Quality, Weights, parse_length},
    outputs::{self, Overwrite},
    session::Session,
    table::Table,
};
use clap::Args;
use glam::DQuat;
use serde::Serialize;
use std::path::PathBuf;
use zipsplat::{
    Result,
    reconstruct::{Request, Shape},
    stages::render::Renderer,
    types::{Image, Pose, World, WriteOptions, contact_sheet},
};

/// Files of the folder.
const SCENE: &str = "scene.ply";
const COMPARISON: &str = "comparison.png";
/// Held-out photos in the picture.
const SHOWN: usize = 12;

/// How well photos that a reconstruction has not seen are predicted
///
/// Reconstructs a capture from some of its photos with their cameras, draws the scene as each of the other photos sees it,
/// and compares. The scene is given to the network in the unit it expects: the median distance of the capture's points
/// (ply_file_path of transforms.json, points.ply, or COLMAP's points3D) from the first camera; where there are none, the distance
/// of the point that the cameras look at, else the distance between cameras. Beside PSNR and SSIM stand two trivial
/// predictions: the input photo that was taken nearest, and that photo's mean colour.
///
/// With --pose-free the network is given the photos alone. Where its scene's cameras stand is then the network's own guess, so every
/// picture is drawn with the camera from which the scene looks most like the photo, searched for from the camera that the
/// capture has for it.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat eval capture/ --views 8
  zipsplat eval capture/ --views 8 --ratio 0.5 --csv capture.csv -o out/
  zipsplat eval capture/ --views 8 --targets 8 --pose-free")]
pub struct Eval {
    /// Folder with photos and their cameras: a transforms.json or a COLMAP model
    folder: PathBuf,
    /// Photos to reconstruct from, spread by farthest-point sampling of where they were taken
    #[arg(long, value_name = "N", default_value = "8", value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Compare with so many of the other photos, evenly spread [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    targets: Option<u32>,
    /// Reconstruct without the cameras, and align each picture with its photo
    #[arg(long)]
    pose_free: bool,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    /// Length in the cameras' unit that becomes the network's 1 [default: the median distance of the capture's points; without
    /// any, of what the cameras look at]
    #[arg(long, value_name = "LENGTH", value_parser = parse_length)]
    unit: Option<f64>,
    /// Table to write: view, psnr, ssim, nearest_psnr, mean_colour_psnr, a row for each photo compared
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Folder for scene.ply, in the unit of cameras that the network was given, and comparison.png: photos, what was drawn in
    /// their place, and the nearest input photos
    #[arg(long, short, value_name = "FOLDER")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

impl Eval {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.csv.as_deref().map_or(Ok(()), |file| self.overwrite.check_file(file))?;
        if let Some(folder) = &self.output {
            outputs::check_folder(folder)?;
            self.overwrite.check_replaced([SCENE, COMPARISON].map(|name| folder.join(name)))?;
        }
        let checkpoint = self.weights.open()?;
        checkpoint.notes().iter().for_each(|note| session.note(note));
        self.quality.check(checkpoint.architecture())?;
        let size = self.quality.size_for(&checkpoint);
        let choice = Choice::new(&self.folder, self.views as usize, self.targets.map(|targets| targets as usize))?;
        choice.notes().iter().for_each(|note| session.note(note));
        let chosen = (self.quality.ratio, &self.quality.select);
        let (views, posed) = (self.views as usize, !self.pose_free);
        let shape = Shape::new(checkpoint.architecture(), views, [size.0, size.1], chosen, posed)?;
        let device = session.device()?;
        let (precision, arithmetic) = self.quality.arithmetic.choose(session, &device)?;
        let (capture, _) = session.stage("load photos", |stage| choice.load(size, self.unit, stage))?;
        capture.notes().for_each(|note| session.note(note));

        let (model, _) = session.load_model(&device, &checkpoint, arithmetic)?;
        let images = capture.images();
        let request = Request {
            ratio: self.quality.ratio,
            selection: self.quality.select.clone(),
            cameras: posed.then(|| capture.cameras()),
        };
        let (mut result, took) = session.reconstruct(&model, &images, &request)?;
        self.quality.prune(&mut result.scene, checkpoint.architecture());
        let mut renderer = Renderer::new(&device);
        renderer.load(&result.scene)?;
        let targets = &capture.targets;
        let (drawn, alignment) = if self.pose_free {
            let (found, _) = session.stage("align", |stage| {
                let found = |view: &Posed| align(&mut renderer, &view.image, &view.camera, &|| stage.check());
                stage.each(targets, found)
            })?;
            let alignment = Alignment::new(&capture, &found);
            (found.into_iter().map(|found| found.drawn).collect(), Some(alignment))
        } else {
            let picture = |view: &Posed| draw(&mut renderer, &view.camera);
            (session.stage("compare", |stage| stage.each(targets, picture))?.0, None)
        };
        let scores = capture.scores(&drawn);

        if let Some(path) = &self.csv {
            outputs::save_csv(path, &scores)?;
        }
        if let Some(folder) = &self.output {
            outputs::make_folder(folder)?;
            // Drawn and compared in the network's unit, kept in that of the cameras that it was given.
            if posed {
                result.scene.scale(capture.unit.length as f32);
            }
            let world = posed.then(|| World::Photo(capture.inputs[0].name.clone()));
            let options = WriteOptions::default();
            outputs::save_scene(&folder.join(SCENE), &result.scene, &options, world.as_ref())?;
            outputs::save_picture(&folder.join(COMPARISON), &comparison(&capture, &drawn)?)?;
        }
        let mean = Score::mean(&scores);
        let mut table = Table::new(1, &["view", "PSNR", "SSIM", "nearest photo", "mean colour"]);
        scores.iter().chain([&mean]).for_each(|score| table.row(cells(score)));
        let text = format!(
            "{table}{} of {size} from {} of its photos, {} Gaussians of {} tokens in {:.2} s; {}",
            self.folder.display(),
            capture.inputs.len(),
            result.scene.len(),
            result.tokens,
            took.as_secs_f64(),
            capture.unit
        ) + &alignment.as_ref().map_or_else(String::new, Alignment::told);
        let json = serde_json::json!({
            "folder": self.folder, "weights": checkpoint.provenance(), "precision": precision.name(), "width": size.0, "height": size.1,
            "inputs": capture.inputs.iter().map(|view| &view.name).collect::<Vec<_>>(), "unit": capture.unit.length, "unit_from": capture.unit.source,
            "tokens": result.tokens, "all_tokens": shape.grid.tokens(), "gaussians": result.scene.len(),
            "peak_bytes": result.peak_bytes,
            "mean": mean, "aligned": alignment, "views": scores,
        });
        session.report(&json, text)
    }
}

/// How far pictures' cameras were aligned, and what they scored before.
#[derive(Serialize)]
struct Alignment {
    /// Median angle between the camera found and the one given.
    degrees: f64,
    /// Median distance between them, in the unit of the cameras.
    distance: f64,
    /// The mean score with the cameras given.
    before: Score,
}

impl Alignment {
    fn new(capture: &Capture, found: &[Aligned]) -> Self {
        let median = |value: fn(&Pose) -> f64| {
            let pairs = found.iter().zip(&capture.targets);
            let movements = pairs.map(|(found, given)| found.camera.pose.relative_to(&given.camera.pose));
            let mut values: Vec<f64> = movements.map(|pose| value(&pose)).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let before: Vec<Vec<f32>> = found.iter().map(|found| found.before.clone()).collect();
        Self {
            degrees: median(|pose| DQuat::from_mat3(&pose.rotation).to_axis_angle().1.to_degrees()),
            distance: capture.unit.length * median(|pose| pose.translation.length()),
            before: Score::mean(&capture.scores(&before)),
        }
    }

    fn told(&self) -> String {
        let Self { degrees, distance, before } = self;
        format!("\naligned by {degrees:.2} degrees and {distance:.4} (medians); before {:.2} dB", before.psnr)
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
