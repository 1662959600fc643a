//! `zipsplat eval`: reconstructs a capture from some of its photos and compares pictures of it with the others.

use crate::{
    cameras,
    metrics::{psnr, ssim},
    options::{Quality, Weights, parse_length},
    outputs, photos,
    session::Session,
    table::Table,
};
use clap::Args;
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    reconstruct::{Model, Request, Shape},
    stages::render::{RenderRequest, Renderer},
    types::{
        Camera, Image, WriteOptions, contact_sheet,
        poses::{Frame, read_poses},
        preprocess::View,
        write_atomic, write_scene,
    },
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
    /// Folder for scene.ply and comparison.png: photos, what was drawn in their place, and the nearest input photos
    #[arg(long, short, value_name = "FOLDER")]
    output: Option<PathBuf>,
}

/// A row of the table, dB but for SSIM.
#[derive(Serialize)]
struct Score {
    view: String,
    psnr: f64,
    ssim: f64,
    nearest_psnr: f64,
    mean_colour_psnr: f64,
}

/// A photo as the network would see it, and its camera.
struct Posed {
    name: String,
    image: Image,
    camera: Camera,
}

impl Eval {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.csv.as_deref().map_or(Ok(()), outputs::check_file)?;
        self.output.as_deref().map_or(Ok(()), outputs::check_folder)?;
        let checkpoint = self.weights.open()?;
        let size = self.quality.size_for(&checkpoint);
        let poses = read_poses(&self.folder)?;
        poses.notes.iter().for_each(|note| session.note(note));
        let (inputs, targets) = self.split(&poses.frames)?;
        let chosen = (self.quality.ratio, &self.quality.select);
        let shape = Shape::new(checkpoint.architecture(), inputs.len(), [size.0, size.1], chosen, true)?;
        let device = session.device()?;

        let all: Vec<&Frame> = inputs.iter().chain(&targets).copied().collect();
        let (mut posed, _) = session.stage("load photos", |stage| {
            let paths: Vec<PathBuf> = all.iter().filter_map(|frame| frame.photo.clone()).collect();
            posed(&all, photos::load(&paths, size, stage)?)
        })?;
        let unit = match (self.unit, &poses.points) {
            (Some(unit), _) => unit,
            (None, Some(points)) => {
                let cameras: Vec<Camera> = posed[..inputs.len()].iter().map(|view| view.camera).collect();
                cameras::unit(points, &cameras, &inputs[0].camera.pose)?
            }
            (None, None) => {
                let expected =
                    "points.ply or points3D beside the cameras, or --unit: how far away the scene is, in their unit";
                return Err(Error::argument("point cloud", "none", expected));
            }
        };
        posed.iter_mut().for_each(|view| view.camera.pose.translation /= unit);
        let targets = posed.split_off(inputs.len());
        let inputs = posed;

        let (model, _) =
            session.stage("load weights", |stage| Model::load(&device, &checkpoint, |done| stage.at(done)))?;
        let images: Vec<Image> = inputs.iter().map(|view| view.image.clone()).collect();
        let request = Request {
            ratio: self.quality.ratio,
            selection: self.quality.select.clone(),
            cameras: Some(inputs.iter().map(|view| view.camera).collect()),
        };
        let (result, took) = session.stage("reconstruct", |stage| {
            model.reconstruct(&images, &request, |progress| {
                stage.name(progress.scope);
                stage.at(progress.fraction)
            })
        })?;
        let mut renderer = Renderer::new(&device);
        renderer.load(&result.scene)?;
        let (drawn, _) = session.stage("compare", |stage| {
            let draw = |(i, view): (usize, &Posed)| {
                stage.reach(i as f64 / targets.len() as f64)?;
                let frame = renderer.render_loaded(&[view.camera], &RenderRequest::default())?.remove(0);
                Ok(frame.rgb.unwrap_or_default().iter().map(|value| value.clamp(0.0, 1.0)).collect())
            };
            targets.iter().enumerate().map(draw).collect::<Result<Vec<Vec<f32>>>>()
        })?;
        let nearest: Vec<&Posed> = targets.iter().map(|view| nearest(view, &inputs)).collect();
        let scored = targets.par_iter().zip(&drawn).zip(&nearest);
        let scores: Vec<Score> = scored.map(|((view, drawn), nearest)| score(view, drawn, nearest)).collect();

        if let Some(path) = &self.csv {
            write_csv(path, &scores)?;
        }
        if let Some(folder) = &self.output {
            outputs::make_folder(folder)?;
            write_scene(&folder.join("scene.ply"), &result.scene, &WriteOptions::default())?;
            comparison(&targets, &drawn, &nearest)?.save_png(folder.join("comparison.png"))?;
        }
        let mean = mean(&scores);
        let mut table = Table::new(1, &["view", "PSNR", "SSIM", "nearest photo", "mean colour"]);
        scores.iter().chain([&mean]).for_each(|score| table.row(cells(score)));
        let text = format!(
            "{table}{} of {size} from {} of its photos, {} Gaussians of {} tokens in {:.2} s; unit {unit:.4}",
            self.folder.display(),
            inputs.len(),
            result.scene.len(),
            result.tokens,
            took.as_secs_f64()
        );
        let json = serde_json::json!({
            "folder": self.folder, "weights": checkpoint.provenance(), "width": size.0, "height": size.1,
            "inputs": inputs.iter().map(|view| &view.name).collect::<Vec<_>>(), "unit": unit,
            "tokens": result.tokens, "all_tokens": shape.grid.tokens(), "gaussians": result.scene.len(),
            "mean": mean, "views": scores,
        });
        session.report(&json, text)
    }

    /// The frames to reconstruct from and those to compare with.
    fn split<'a>(&self, frames: &'a [Frame]) -> Result<(Vec<&'a Frame>, Vec<&'a Frame>)> {
        let found: Vec<&Frame> = frames.iter().filter(|frame| frame.photo.is_some()).collect();
        let views = self.views as usize;
        if found.len() <= views {
            let folder = self.folder.display();
            let expected = format!("more than --views {views}, to have some to compare with");
            return Err(Error::argument(format!("photos with cameras in {folder}"), found.len(), expected));
        }
        let centres: Vec<DVec3> = found.iter().map(|frame| frame.camera.pose.translation).collect();
        let chosen = farthest_points(&centres, views);
        let others: Vec<usize> = (0..found.len()).filter(|i| !chosen.contains(i)).collect();
        let count = self.targets.map_or(others.len(), |targets| others.len().min(targets as usize));
        let targets = (0..count).map(|i| found[others[i * others.len() / count]]).collect();
        Ok((chosen.into_iter().map(|i| found[i]).collect(), targets))
    }
}

/// The first point, then always the one that is farthest from all before; in ascending order.
fn farthest_points(points: &[DVec3], count: usize) -> Vec<usize> {
    let mut chosen = vec![0];
    let mut distances: Vec<f64> = points.iter().map(|point| point.distance(points[0])).collect();
    while chosen.len() < count {
        // Of equal ones the first that is left.
        let free = (0..points.len()).filter(|i| !chosen.contains(i));
        let next = free.reduce(|best, i| if distances[i] > distances[best] { i } else { best });
        let Some(next) = next else { break };
        chosen.push(next);
        for (distance, point) in distances.iter_mut().zip(points) {
            *distance = distance.min(point.distance(points[next]));
        }
    }
    chosen.sort_unstable();
    chosen
}

/// Frames and their views, in the world of the first camera.
fn posed(frames: &[&Frame], views: Vec<View>) -> Result<Vec<Posed>> {
    let cameras: Vec<Camera> = frames.iter().map(|frame| frame.camera).collect();
    let cameras = cameras::of_views(&cameras, &views)?;
    let posed = |((frame, view), camera): ((&&Frame, View), Camera)| Posed {
        name: frame.name.clone(),
        image: view.image,
        camera,
    };
    Ok(frames.iter().zip(views).zip(cameras).map(posed).collect())
}

fn nearest<'a>(view: &Posed, inputs: &'a [Posed]) -> &'a Posed {
    let distance = |other: &&Posed| other.camera.pose.translation.distance(view.camera.pose.translation);
    inputs.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("there is at least one input")
}

fn score(view: &Posed, drawn: &[f32], nearest: &Posed) -> Score {
    let (truth, near) = (floats(&view.image), floats(&nearest.image));
    let mut mean = [0.0; 3];
    near.iter().enumerate().for_each(|(i, value)| mean[i % 3] += f64::from(*value));
    let mean: Vec<f32> = (0..near.len()).map(|i| (mean[i % 3] * 3.0 / near.len() as f64) as f32).collect();
    Score {
        view: view.name.clone(),
        psnr: psnr(drawn, &truth),
        ssim: ssim(drawn, &truth, view.image.width as usize, view.image.height as usize),
        nearest_psnr: psnr(&near, &truth),
        mean_colour_psnr: psnr(&mean, &truth),
    }
}

fn floats(image: &Image) -> Vec<f32> {
    image.rgb.iter().map(|value| f32::from(*value) / 255.0).collect()
}

fn mean(scores: &[Score]) -> Score {
    let mean = |value: fn(&Score) -> f64| scores.iter().map(value).sum::<f64>() / scores.len() as f64;
    Score {
        view: "mean".into(),
        psnr: mean(|score| score.psnr),
        ssim: mean(|score| score.ssim),
        nearest_psnr: mean(|score| score.nearest_psnr),
        mean_colour_psnr: mean(|score| score.mean_colour_psnr),
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

fn write_csv(path: &Path, scores: &[Score]) -> Result<()> {
    write_atomic(path, |out| {
        writeln!(out, "view,psnr,ssim,nearest_psnr,mean_colour_psnr")?;
        for Score { view, psnr, ssim, nearest_psnr, mean_colour_psnr } in scores {
            // A name with commas or quotes is quoted, as RFC 4180 says.
            let view = if view.contains([',', '"', '\n']) {
                format!("\"{}\"", view.replace('"', "\"\""))
            } else {
                view.clone()
            };
            writeln!(out, "{view},{psnr:.4},{ssim:.5},{nearest_psnr:.4},{mean_colour_psnr:.4}")?;
        }
        Ok(())
    })
}

/// For some of the photos, evenly spread, two in a row: the photo, what was drawn, the nearest input.
fn comparison(targets: &[Posed], drawn: &[Vec<f32>], nearest: &[&Posed]) -> Result<Image> {
    let shown = targets.len().min(SHOWN);
    let mut images = Vec::new();
    for i in (0..shown).map(|i| i * targets.len() / shown) {
        let Image { width, height, .. } = targets[i].image;
        let drawn = Image::from_rgb_f32(width, height, &drawn[i])?;
        images.extend([targets[i].image.clone(), drawn, nearest[i].image.clone()]);
    }
    contact_sheet(&images, 6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn farthest_points_spread() {
        let points = [0.0, 1.0, 2.0, 3.0, 10.0, 6.0].map(|x| DVec3::new(x, 0.0, 0.0));
        assert_eq!(farthest_points(&points, 1), [0]);
        assert_eq!(farthest_points(&points, 3), [0, 4, 5]);
        assert_eq!(farthest_points(&points, 4), [0, 3, 4, 5]);
        assert_eq!(farthest_points(&[DVec3::ONE; 3], 3), [0, 1, 2]);
    }
}
