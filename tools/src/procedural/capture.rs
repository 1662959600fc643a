use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use glam::{DMat3, DVec3, Vec3A};
use rayon::prelude::*;
use zipsplat::depth::add_view;
use zipsplat::types::{Camera, Image, Intrinsics, Pose, Scene, median};
use zipsplat::{Error, Result};

use super::families::Family;
use super::path::{PathKind, View};
use super::photos::Photos;
use super::rng::Rng;
use super::survey::{self, Lens};
use super::tone::Development;
use super::wide::WideLens;
use super::world::{Hit, World};

/// The sky, and surfaces beyond the largest 255.
pub const OTHER: u8 = u8::MAX;
/// Paths tried per place.
const PATHS: usize = 20;
const PLACES: u64 = 1000;
/// Standard deviation of a view's brightness, 0..1.
const LEAST_CONTRAST: f32 = 0.05;
const BRIGHTNESS: RangeInclusive<f32> = 0.15..=0.85;
/// Of the longer side in degrees, skewed toward narrow.
const FIELD_OF_VIEW: [f32; 2] = [28.0, 92.0];

/// Pixels between points of wide photos.
const WIDE_POINT_STEP: u32 = 8;

pub type WidePhoto = (Image, Vec<(DVec3, [u8; 3])>);

/// Distinct row and column offsets.
const ROTATED_GRID: [(f32, f32); 4] = [(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)];
const BESIDE_CENTER: [(f32, f32); 2] = [(-0.33, 0.25), (0.33, -0.25)];

pub type GoOn<'a> = &'a (dyn Fn() -> Result<()> + Sync);

#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    pub views: usize,
    pub width: u32,
    pub height: u32,
    /// Four rays for every pixel, not only at edges.
    pub supersample: bool,
    /// Starts at a random view of the path and appends the skipped ones.
    pub random_first: bool,
}

/// Place and camera path, in meters.
pub struct Setup {
    pub seed: u64,
    pub family: Family,
    pub path: PathKind,
    pub world: World,
    lens: Lens,
    views: Vec<View>,
    overlap: Vec<f32>,
    development: Development,
    supersample: bool,
}

/// Photos of a scene, in the first camera's frame, scaled to a median point distance of 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    pub seed: u64,
    pub family: Family,
    pub path: PathKind,
    /// Meters per unit of length.
    pub meters: f64,
    pub cameras: Vec<Camera>,
    pub images: Vec<Image>,
    /// `[views][height][width]` z at pixel centers; 0 in the sky.
    pub depths: Vec<Vec<f32>>,
    /// `[views][height][width]` surface at pixel centers: its rank by visible pixels in all views,
    /// or 255 for sky and others.
    pub labels: Vec<Vec<u8>>,
    /// `[views][views]`: share of the first view's surfaces visible in the second.
    pub overlap: Vec<f32>,
}

impl Options {
    pub fn validate(&self) -> Result<()> {
        if !(1..=1024).contains(&self.views) {
            return Err(Error::argument("views", self.views, "1 to 1024"));
        }
        if !(1..=4096).contains(&self.width) || !(1..=4096).contains(&self.height) {
            return Err(Error::argument(
                "size",
                format!("{}x{}", self.width, self.height),
                "sides of 1 to 4096 pixels",
            ));
        }
        if self.width.max(self.height) > 8 * self.width.min(self.height) {
            let found = format!("{}x{}", self.width, self.height);
            return Err(Error::argument("size", found, "a side of at most 8 times the other"));
        }
        Ok(())
    }
}

impl Setup {
    pub fn new(seed: u64, options: &Options, photos: &Photos, go_on: GoOn<'_>) -> Result<Self> {
        options.validate()?;
        for place in 0..PLACES {
            go_on()?;
            if let Some(setup) = Self::try_place(seed, place, options, photos) {
                return Ok(setup);
            }
        }
        Err(Error::argument("seed", seed, format!("one that has a scene worth its photos among {PLACES} places")))
    }

    fn try_place(seed: u64, place: u64, options: &Options, photos: &Photos) -> Option<Self> {
        let mut rng = Rng::new(seed, 2 * place);
        // By seed only, so retries keep the distribution of families and paths.
        let family = Rng::new(seed, u64::MAX).pick(&Family::ALL);
        let (world, stage) = family.build(Rng::new(seed, 2 * place + 1), photos);
        let path = rng.pick(stage.paths);
        for attempt in 0..PATHS {
            let span = 1.0 - 0.8 * attempt as f32 / PATHS as f32;
            let [narrow, wide] = FIELD_OF_VIEW;
            let half_angle = (narrow + (wide - narrow) * rng.unit().powi(2)).to_radians() / 2.0;
            let focal = 0.5 * options.width.max(options.height) as f32 / half_angle.tan();
            let lens = Lens { width: options.width as usize, height: options.height as usize, focal };
            let reach = (27.5f32.to_radians().tan() / half_angle.tan()).clamp(0.7, 1.4);
            let mut views = stage.path(path, options.views, span, reach, &mut rng);
            if options.random_first {
                views.rotate_left(rng.count(0, options.views - 1));
            }
            let Some(overlap) = survey::overlap(&world, lens, &views) else { continue };
            let Some(development) = expose(&world, lens, &views, photos, &mut rng) else { continue };
            let supersample = options.supersample;
            return Some(Self { seed, family, path, world, lens, views, overlap, development, supersample });
        }
        None
    }

    /// OpenCV camera-to-world, in meters.
    pub fn poses(&self) -> Vec<Pose> {
        let pose = |view: &View| {
            let cols = [view.rotation.x_axis, view.rotation.y_axis, view.rotation.z_axis].map(|axis| axis.as_dvec3());
            Pose { rotation: DMat3::from_cols(cols[0], cols[1], cols[2]), translation: view.eye.as_dvec3() }
        };
        self.views.iter().map(pose).collect()
    }

    pub fn shoot(&self, photos: &Photos, go_on: GoOn<'_>) -> Result<Capture> {
        let Lens { width, height, focal } = self.lens;
        let frames = self.views.par_iter().map(|view| self.frame(*view, photos, go_on)).collect::<Result<Vec<_>>>()?;
        let poses = self.poses();
        let meters = self.median_distance(&frames);
        let intrinsics = Intrinsics {
            width: width as u32,
            height: height as u32,
            fx: f64::from(focal),
            fy: f64::from(focal),
            cx: 0.5 * width as f64,
            cy: 0.5 * height as f64,
        };
        let camera = |pose: &Pose| {
            let mut pose = pose.relative_to(&poses[0]);
            pose.translation /= meters;
            Camera { intrinsics, pose }
        };
        let cameras = poses.iter().map(camera).collect();
        let labels = labels(&frames);
        let (lights, depths): (Vec<_>, Vec<_>) = frames.into_iter().map(|frame| (frame.light, frame.depth)).unzip();
        let develop = |(i, light)| Image {
            width: width as u32,
            height: height as u32,
            rgb: self.development.develop(i, width, light),
            mask: None,
        };
        let scaled = |depth: Vec<f32>| depth.into_iter().map(|z| z / meters as f32).collect();
        Ok(Capture {
            seed: self.seed,
            family: self.family,
            path: self.path,
            meters,
            cameras,
            images: lights.into_par_iter().enumerate().map(develop).collect(),
            depths: depths.into_iter().map(scaled).collect(),
            labels,
            overlap: self.overlap.clone(),
        })
    }

    /// Takes photos of a wide lens along the path, black outside its image circle, with points of
    /// the first photo's world in meters and their pixels.
    pub fn shoot_wide(&self, lens: &WideLens, photos: &Photos, go_on: GoOn<'_>) -> Result<Vec<WidePhoto>> {
        let Intrinsics { width, height, fx, .. } = lens.0.intrinsics;
        let trace = |view: &View, x: u32, y: u32, (dx, dy): (f32, f32)| {
            let ray = lens.ray(f64::from(x) + 0.5 + f64::from(dx), f64::from(y) + 0.5 + f64::from(dy))?;
            Some((ray, self.world.trace(view.eye, view.rotation * ray, 0.5 / fx as f32, photos)))
        };
        let light = |view: &View, x: u32, y: u32| {
            let sample = |offset: &(f32, f32)| trace(view, x, y, *offset).map_or(Vec3A::ZERO, |(_, hit)| hit.light);
            ROTATED_GRID.iter().map(sample).sum::<Vec3A>() / 4.0
        };
        let poses = self.poses();
        let photo = |(i, view): (usize, &View)| {
            let row = |y: u32| go_on().map(|()| (0..width).map(|x| light(view, x, y)).collect());
            let rows = (0..height).into_par_iter().map(row).collect::<Result<Vec<Vec<Vec3A>>>>()?;
            let mut rgb = self.development.develop(i, width as usize, rows.concat());
            let pose = poses[i].relative_to(&poses[0]);
            let mut points = Vec::new();
            for (at, pixel) in rgb.chunks_exact_mut(3).enumerate() {
                let [x, y] = [at as u32 % width, at as u32 / width];
                if lens.ray(f64::from(x) + 0.5, f64::from(y) + 0.5).is_none() {
                    pixel.fill(0);
                } else if [x, y].iter().all(|at| at % WIDE_POINT_STEP == 0)
                    && let Some((ray, hit)) = trace(view, x, y, (0.0, 0.0))
                    && let Some(distance) = hit.distance
                {
                    points.push((pose.transform((ray * distance).as_dvec3()), [pixel[0], pixel[1], pixel[2]]));
                }
            }
            Ok((Image::new(width, height, rgb)?, points))
        };
        self.views.iter().enumerate().map(photo).collect()
    }

    /// From the first camera, in meters.
    fn median_distance(&self, frames: &[Frame]) -> f64 {
        let Lens { width, .. } = self.lens;
        let first = self.views[0].eye;
        let points = self.views.iter().zip(frames).flat_map(|(view, frame)| {
            let surfaces = frame.depth.iter().enumerate().filter(|(_, z)| **z > 0.0);
            surfaces.map(move |(i, z)| {
                let ray = self.lens.ray((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
                f64::from((view.eye + view.rotation * ray * *z).distance(first))
            })
        });
        median(points).expect("photos of surfaces")
    }

    fn frame(&self, view: View, photos: &Photos, go_on: GoOn<'_>) -> Result<Frame> {
        let Lens { width, height, .. } = self.lens;
        let trace = |x: f32, y: f32, pixel: f32| self.trace(view, x, y, pixel, photos);
        let centers = |y: usize| (0..width).map(move |x| (x as f32 + 0.5, y as f32 + 0.5));
        let row = |y: usize| go_on().map(|()| centers(y).map(|(x, y)| trace(x, y, 1.0)).collect());
        let rows = (0..height).into_par_iter().map(row).collect::<Result<Vec<Vec<(Hit, f32)>>>>()?;
        let region = |x: usize, y: usize| rows[y][x].0.region;
        let is_edge = |x: usize, y: usize| {
            let here = region(x, y);
            let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
            let (above, below) = (y.saturating_sub(1), (y + 1).min(height - 1));
            [region(left, y), region(right, y), region(x, above), region(x, below)].iter().any(|other| *other != here)
        };
        let around = |x: usize, y: usize, offsets: &[(f32, f32)]| {
            let light = |(dx, dy): &(f32, f32)| trace(x as f32 + 0.5 + dx, y as f32 + 0.5 + dy, 0.5).0.light;
            offsets.iter().map(light).sum::<Vec3A>()
        };
        let pixel = |x: usize, y: usize| match rows[y][x].0.light {
            _ if self.supersample => around(x, y, &ROTATED_GRID) / 4.0,
            center if is_edge(x, y) => (center + around(x, y, &BESIDE_CENTER)) / 3.0,
            center => center,
        };
        let row = |y: usize| go_on().map(|()| (0..width).map(|x| pixel(x, y)).collect());
        let light = (0..height).into_par_iter().map(row).collect::<Result<Vec<Vec<Vec3A>>>>()?.concat();
        let depth = rows.iter().flatten().map(|(_, depth)| *depth).collect();
        let surface = rows.iter().flatten().map(|(hit, _)| hit.distance.map(|_| hit.region >> 4)).collect();
        Ok(Frame { light, depth, surface })
    }

    /// Returns color and z; `pixel` is the filter width in pixels.
    fn trace(&self, view: View, x: f32, y: f32, pixel: f32, photos: &Photos) -> (Hit, f32) {
        let ray = self.lens.ray(x, y);
        let length = ray.length();
        let hit = self.world.trace(view.eye, view.rotation * (ray / length), pixel / self.lens.focal, photos);
        let depth = hit.distance.map_or(0.0, |t| t / length);
        (hit, depth)
    }
}

struct Frame {
    light: Vec<Vec3A>,
    depth: Vec<f32>,
    /// `None` in the sky.
    surface: Vec<Option<u32>>,
}

fn labels(frames: &[Frame]) -> Vec<Vec<u8>> {
    let mut pixels: BTreeMap<u32, usize> = BTreeMap::new();
    let surfaces = frames.iter().flat_map(|frame| &frame.surface);
    surfaces.flatten().for_each(|surface| *pixels.entry(*surface).or_default() += 1);
    let mut order: Vec<u32> = pixels.keys().copied().collect();
    order.sort_by_key(|surface| Reverse(pixels[surface]));
    let ranks: BTreeMap<u32, u8> = order.into_iter().zip(0..OTHER).collect();
    let label = |surface: &Option<u32>| surface.and_then(|surface| ranks.get(&surface).copied()).unwrap_or(OTHER);
    frames.iter().map(|frame| frame.surface.iter().map(label).collect()).collect()
}

/// Shared exposure from few rays; `None` for dull, dark or overexposed views.
fn expose(world: &World, lens: Lens, views: &[View], photos: &Photos, rng: &mut Rng) -> Option<Development> {
    let pixel = lens.width as f32 / survey::GRID as f32 / lens.focal / 4.0;
    let trace = |view: &View| {
        lens.grid(*view).map(|direction| world.trace(view.eye, direction, pixel, photos).light).collect::<Vec<_>>()
    };
    let lights: Vec<Vec<Vec3A>> = views.iter().map(trace).collect();
    let all = lights.iter().flatten();
    let luminance =
        all.map(|light| light.element_sum() / 3.0).sum::<f32>() / (views.len() * survey::GRID.pow(2)) as f32;
    let development = Development::new(rng, luminance);
    let worth = |lights: &Vec<Vec3A>| {
        let brightness: Vec<f32> = lights.iter().map(|light| development.brightness(*light)).collect();
        let count = brightness.len() as f32;
        let mean = brightness.iter().sum::<f32>() / count;
        let variance = brightness.iter().map(|b| (b - mean).powi(2)).sum::<f32>() / count;
        variance.sqrt() >= LEAST_CONTRAST && BRIGHTNESS.contains(&mean)
    };
    lights.iter().all(worth).then_some(development)
}

impl Capture {
    /// `None` in the sky.
    pub fn point(&self, view: usize, x: u32, y: u32) -> Option<DVec3> {
        let Camera { intrinsics: i, pose } = &self.cameras[view];
        let z = f64::from(self.depths[view][(y * i.width + x) as usize]);
        let ray = DVec3::new((f64::from(x) + 0.5 - i.cx) / i.fx, (f64::from(y) + 0.5 - i.cy) / i.fy, 1.0);
        (z > 0.0).then(|| pose.transform(ray * z))
    }

    /// Returns one isotropic Gaussian per surface pixel, in the capture's world: a reference
    /// reconstruction.
    pub fn splats(&self) -> Scene {
        let mut scene = Scene { sh_degree: 0, ..Scene::default() };
        for ((camera, image), depth) in self.cameras.iter().zip(&self.images).zip(&self.depths) {
            add_view(&mut scene, camera, image, depth);
        }
        scene
    }
}
