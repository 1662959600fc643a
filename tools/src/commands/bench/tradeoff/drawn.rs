use super::{point::Point, truth::Compared};
use crate::{
    capture::{Score, ViewSplit, draw},
    commands::bench::Spread,
    metrics::psnr,
    outputs::size_of,
    scratch::Scratch,
};
use std::time::{Duration, Instant};
use zipsplat::{
    Result,
    stages::render::Renderer,
    types::{Image, Scene, write_ply},
};

pub struct Drawn {
    pub pictures: Vec<Vec<f32>>,
    times: Vec<Duration>,
    score: Score,
}

impl Drawn {
    pub fn point(&self, point: Point, scene: &Scene) -> Result<Point> {
        Ok(Point {
            gaussians: scene.len(),
            render_ms: Spread::of(self.times.iter().copied()).median,
            file_bytes: file_bytes(scene)?,
            psnr: self.score.psnr,
            ssim: self.score.ssim,
            ..point
        })
    }

    pub fn picture(&self, capture: &ViewSplit) -> Result<Image> {
        let Image { width, height, .. } = capture.targets[0].image;
        Image::from_rgb_f32(width, height, &self.pictures[0])
    }
}

pub fn compare(renderer: &mut Renderer, capture: &ViewSplit) -> Result<Drawn> {
    // Also builds the plan.
    draw(renderer, &capture.targets[0].camera)?;
    let (mut pictures, mut times) = (Vec::new(), Vec::new());
    for view in &capture.targets {
        let start = Instant::now();
        pictures.push(draw(renderer, &view.camera)?);
        times.push(start.elapsed());
    }
    let score = Score::mean(&capture.scores(&pictures));
    Ok(Drawn { pictures, times, score })
}

fn file_bytes(scene: &Scene) -> Result<u64> {
    let folder = Scratch::new()?;
    let path = folder.path().join("scene.ply");
    write_ply(scene, &path)?;
    size_of(&path)
}

/// Keeps the same Gaussians on both sides.
pub fn psnr_to_f64(
    renderer: &mut Renderer,
    compared: &Compared,
    group: usize,
    keep: usize,
    capture: &ViewSplit,
) -> Result<f64> {
    let kept = compared.scene.most_visible(group, keep);
    let mut draw = |scene: &Scene| -> Result<Vec<f32>> {
        let mut scene = scene.clone();
        scene.keep(&kept);
        renderer.set_scene(&scene)?;
        Ok(capture.targets.iter().map(|view| draw(renderer, &view.camera)).collect::<Result<Vec<_>>>()?.concat())
    };
    Ok(psnr(&draw(&compared.scene)?, &draw(&compared.truth)?))
}
