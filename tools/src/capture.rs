use crate::{
    metrics::{self, mean_color, psnr, values},
    photos,
    refinement::placed,
    session::Stage,
    stamp::{digest, stamp},
    views::{Seeing, Views},
};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use std::{
    f64::consts::TAU,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    perceptual::Perceptual,
    stages::render::{RenderOptions, Renderer},
    types::{
        Camera, ColorTransform, Image, Masks, PointCloud, Pose, Scene, median,
        poses::{Capture, CaptureView, SceneScale, Source, read_cloud},
        resample::resize_lanczos,
    },
};

pub struct Choice {
    pub poses: Capture,
    inputs: Vec<usize>,
    targets: Vec<usize>,
    pub masks: Option<Masks>,
}

/// World: the first input's camera.
pub struct ViewSplit {
    pub views: Views,
    pub inputs: Vec<Posed>,
    pub targets: Vec<Posed>,
    /// Divisor of the cameras' lengths.
    pub scene_scale: SceneScale,
}

pub struct Posed {
    pub name: String,
    pub image: Image,
    pub camera: Camera,
}

/// Similarity to the prediction and to two baselines, in dB except SSIM.
#[derive(Clone, Serialize)]
pub struct Score {
    pub view: String,
    pub psnr: f64,
    pub ssim: f64,
    pub nearest_psnr: f64,
    pub mean_color_psnr: f64,
    pub lpips: Option<f64>,
    /// With the color transform that fits the photo best, if exposures were learned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color_corrected_psnr: Option<f64>,
}

impl Choice {
    /// Chooses `views` photos by farthest-point sampling of positions, and all others or `targets`
    /// evenly spread ones, with their frames. Skips frames without a photo.
    pub fn new(folder: &Path, views: usize, targets: Option<usize>) -> Result<Self> {
        Self::of(Capture::open(folder)?, folder, views, targets)
    }

    /// [`Choice::new`] on known frames; `folder` is for messages.
    pub fn of(poses: Capture, folder: &Path, views: usize, targets: Option<usize>) -> Result<Self> {
        let is_first = |i: &usize| poses.frames[*i].photo.is_some() && !poses.frames[*i].is_later_view();
        let found: Vec<usize> = (0..poses.frames.len()).filter(is_first).collect();
        let frames = |first: usize| first..first + poses.views_of(&poses.frames[first]).len();
        if found.len() <= views {
            let expected = format!("more than --views {views}, to have some to compare with");
            let why =
                if poses.sizeless.is_empty() { String::new() } else { format!(" ({})", poses.warnings.join("; ")) };
            let found = format!("{}{why}", found.len());
            return Err(Error::argument(format!("photos with cameras in {}", folder.display()), found, expected));
        }
        let centers: Vec<DVec3> = found.iter().map(|i| poses.frames[*i].camera.pose.translation).collect();
        let chosen = farthest_points(&centers, views);
        let others: Vec<usize> = (0..found.len()).filter(|i| !chosen.contains(i)).collect();
        let count = targets.map_or(others.len(), |targets| others.len().min(targets));
        let targets = (0..count).flat_map(|i| frames(found[others[i * others.len() / count]])).collect();
        let inputs = chosen.into_iter().flat_map(|i| frames(found[i])).collect();
        Ok(Self { inputs, targets, poses, masks: None })
    }

    pub fn given(poses: Capture, scene: &str, inputs: Vec<usize>, targets: Vec<usize>) -> Result<Self> {
        let frame = |i: usize| poses.frames.get(i).and_then(|frame| frame.photo.as_ref());
        if let Some(i) = inputs.iter().chain(&targets).find(|i| frame(**i).is_none()) {
            let found =
                poses.frames.get(*i).map_or("no such frame".to_owned(), |frame| format!("none at {}", frame.name));
            let expected = format!("one, of {} frames counted from 0", poses.frames.len());
            return Err(Error::argument(format!("photo of frame {i} of {scene}"), found, expected));
        }
        Ok(Self { poses, inputs, targets, masks: None })
    }

    /// Perturbs all inputs but the first: rotates by degrees, moves by percent of the unit, in
    /// pseudorandom directions.
    pub fn disturb(&mut self, degrees: f64, scene_scale: Option<f64>) -> Result<()> {
        if degrees == 0.0 {
            return Ok(());
        }
        let origin = self.poses.frames[self.inputs[0]].camera.pose;
        let camera = |i: &usize| self.poses.frames[*i].camera.relative_to(&origin);
        let views: Vec<Camera> = self.inputs.iter().map(camera).collect();
        let scene_scale = self.poses.scene_scale(scene_scale, &views, &origin)?.length;
        for (k, i) in self.inputs.iter().enumerate().skip(1) {
            let rotation = DMat3::from_axis_angle(spread(2 * k), degrees.to_radians());
            let movement = Pose { rotation, translation: degrees / 100.0 * scene_scale * spread(2 * k + 1) };
            let pose = &mut self.poses.frames[*i].camera.pose;
            *pose = pose.compose(&movement);
        }
        Ok(())
    }

    pub fn inputs(&self) -> Vec<PathBuf> {
        self.inputs.iter().filter_map(|i| self.poses.frames[*i].photo.clone()).collect()
    }

    pub fn frames(&self) -> impl Iterator<Item = &CaptureView> {
        self.inputs.iter().chain(&self.targets).map(|i| &self.poses.frames[*i])
    }

    pub fn input_frames(&self) -> Vec<&CaptureView> {
        self.inputs.iter().map(|i| &self.poses.frames[*i]).collect()
    }

    pub fn frame(&self, name: &str) -> Option<&CaptureView> {
        self.poses.frames.iter().find(|frame| frame.name == name)
    }

    pub fn digest(&self) -> Result<String> {
        let mut parts = vec![self.inputs.len().to_string()];
        for frame in self.frames() {
            parts.push(format!("{frame:?}"));
            parts.extend(frame.photo.as_deref().map(stamp).transpose()?);
        }
        parts.extend(self.poses.points.as_deref().map(stamp).transpose()?);
        Ok(digest(&parts))
    }

    /// Maps to the first input's world and a unit.
    pub fn points(&self, scene_scale: &SceneScale) -> Result<Option<PointCloud>> {
        let to_world = self.poses.frames[self.inputs[0]].camera.pose.inverse();
        let cloud = self.poses.points.as_ref().map(read_cloud).transpose()?;
        Ok(cloud.map(|cloud| placed(cloud, &to_world, scene_scale.length)))
    }

    /// `scene_scale` is the unit's length in the cameras' unit; default [`SceneScale::of`].
    pub fn load(&self, seeing: Seeing, scene_scale: Option<f64>, stage: &Stage<'_>) -> Result<ViewSplit> {
        let frames: Vec<&CaptureView> = self.frames().collect();
        let paths: Vec<PathBuf> = frames.iter().filter_map(|frame| frame.photo.clone()).collect();
        let (world, count) = (frames[0].camera.pose, self.inputs.len());
        let masks = self.masks.as_ref();
        masks.map_or(Ok(()), |masks| masks.check(&paths))?;
        let read = photos::read(&paths, &frames, masks, stage, |i, photo| {
            let label = format!("camera {i}");
            let (photo, camera) = seeing.source(photo, frames[i].camera, &label)?;
            let compared = posed(&frames[i].name, &photo, &camera, seeing, &world, &label)?;
            let is_input = i < count;
            let seen = is_input.then(|| seeing.crop.views(&photo, Some(&camera), seeing.size, &label));
            let seen = seen.transpose()?.unwrap_or_default();
            Ok((compared, [photo.width, photo.height], seen))
        })?;
        let (mut inputs, mut sizes, mut seen) = (Vec::new(), Vec::new(), Vec::new());
        for (compared, size, of_input) in read {
            inputs.push(compared);
            sizes.push(size);
            seen.extend(of_input);
        }
        let mut views = Views::new(seeing.crop, seen.into_iter(), &world, &sizes[..count], seeing.size);
        let scene_scale = self.poses.scene_scale(scene_scale, &views.cameras, &world)?;
        let cameras = views.cameras.iter_mut().chain(inputs.iter_mut().map(|photo| &mut photo.camera));
        cameras.for_each(|camera| camera.pose.translation /= scene_scale.length);
        let targets = inputs.split_off(count);
        Ok(ViewSplit { views, inputs, targets, scene_scale })
    }
}

pub fn scale_warning(scale: &SceneScale) -> Option<String> {
    scale.doubt().map(|doubt| format!("{doubt} (--scene-scale LENGTH)"))
}

impl ViewSplit {
    /// Changes the unit to the Gaussians' median distance from the first camera.
    pub fn rescale_to(&mut self, scene: &Scene, origin: String) -> Result<()> {
        let distances = scene.means.iter().map(|mean| DVec3::from(mean.map(f64::from)).length());
        let length = median(distances).filter(|length| *length > 0.0);
        let length =
            length.ok_or_else(|| Error::argument("--scene-scale", "no depth above 0", "depth of the photos"))?;
        let photos = self.inputs.iter_mut().chain(&mut self.targets).map(|photo| &mut photo.camera);
        photos.chain(&mut self.views.cameras).for_each(|camera| camera.pose.translation /= length);
        self.scene_scale = SceneScale { length: self.scene_scale.length * length, source: Source::Depth(origin) };
        Ok(())
    }

    pub fn notes(&self) -> impl Iterator<Item = String> {
        self.views.note.clone().into_iter().chain(scale_warning(&self.scene_scale))
    }

    pub fn training_views(&self) -> (Vec<Image>, Vec<Camera>) {
        self.inputs.iter().map(|input| (input.image.clone(), input.camera)).unzip()
    }

    pub fn nearest(&self, view: &Posed) -> &Posed {
        let distance = |other: &&Posed| other.camera.pose.translation.distance(view.camera.pose.translation);
        let nearest = self.inputs.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
        nearest.expect("a capture has an input")
    }

    /// `drawn` are predictions of the targets, `[height][width][rgb]` in 0..1.
    pub fn scores(&self, drawn: &[Vec<f32>]) -> Vec<Score> {
        self.targets.par_iter().zip(drawn).map(|(view, drawn)| self.score(view, drawn)).collect()
    }

    pub fn score_lpips(&self, scores: &mut [Score], drawn: &[Vec<f32>], lpips: &mut Perceptual) -> Result<()> {
        for ((score, drawn), view) in scores.iter_mut().zip(drawn).zip(&self.targets) {
            score.lpips = metrics::masked_lpips(Some(lpips), &view.image, drawn)?;
        }
        Ok(())
    }

    pub fn score_colors(&self, scores: &mut [Score], drawn: &[Vec<f32>]) {
        for ((score, drawn), view) in scores.iter_mut().zip(drawn).zip(&self.targets) {
            let truth = values(&view.image);
            let [drawn, truth] = [drawn, &truth].map(|values| view.image.kept(values));
            let mut corrected = ColorTransform::fit(&drawn, &truth).apply(&drawn);
            corrected.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
            score.color_corrected_psnr = Some(psnr(&corrected, &truth));
        }
    }

    fn score(&self, view: &Posed, drawn: &[f32]) -> Score {
        let near = resize_lanczos(&self.nearest(view).image, view.image.width, view.image.height);
        let (truth, near) = (values(&view.image), values(&near.expect("neither is empty")));
        let ssim = metrics::masked_ssim(&view.image, drawn, &truth);
        let [drawn, truth, near] = [drawn, &truth, &near].map(|values| view.image.kept(values));
        Score {
            view: view.name.clone(),
            psnr: psnr(&drawn, &truth),
            ssim,
            nearest_psnr: psnr(&near, &truth),
            mean_color_psnr: psnr(&mean_color(&near), &truth),
            lpips: None,
            color_corrected_psnr: None,
        }
    }
}

/// `[height][width][rgb]` in 0..1.
pub fn draw(renderer: &mut Renderer, camera: &Camera) -> Result<Vec<f32>> {
    let frame = renderer.render(&[*camera], &RenderOptions::default())?.remove(0);
    Ok(frame.rgb.unwrap_or_default().into_iter().map(|value| value.clamp(0.0, 1.0)).collect())
}

impl Score {
    pub fn mean(scores: &[Self]) -> Self {
        let mean = |value: fn(&Self) -> f64| scores.iter().map(value).sum::<f64>() / scores.len() as f64;
        let mean_of_all = |value: fn(&Self) -> Option<f64>| {
            scores.iter().map(value).sum::<Option<f64>>().map(|sum| sum / scores.len() as f64)
        };
        Self {
            view: "mean".into(),
            psnr: mean(|score| score.psnr),
            ssim: mean(|score| score.ssim),
            nearest_psnr: mean(|score| score.nearest_psnr),
            mean_color_psnr: mean(|score| score.mean_color_psnr),
            lpips: mean_of_all(|score| score.lpips),
            color_corrected_psnr: mean_of_all(|score| score.color_corrected_psnr),
        }
    }
}

/// Starts with the first point, and sorts the result.
pub fn farthest_points(points: &[DVec3], count: usize) -> Vec<usize> {
    let mut chosen = vec![0];
    let mut distances: Vec<f64> = points.iter().map(|point| point.distance(points[0])).collect();
    while chosen.len() < count {
        // Ties go to the first free point.
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

/// Consecutive directions spread evenly.
pub fn spread(k: usize) -> DVec3 {
    // R2 sequence (Roberts 2018).
    let [u, v] = [0.754_877_666_246_693, 0.569_840_290_998_053].map(|step| (0.5 + step * k as f64).fract());
    let z: f64 = 2.0 * u - 1.0;
    let (sin, cos) = (TAU * v).sin_cos();
    DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
}

fn posed(name: &str, photo: &Image, camera: &Camera, seeing: Seeing, world: &Pose, label: &str) -> Result<Posed> {
    let view = seeing.compare(photo)?;
    let camera = view.map.camera(camera, label)?.relative_to(world);
    Ok(Posed { name: name.to_owned(), image: view.image, camera })
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
