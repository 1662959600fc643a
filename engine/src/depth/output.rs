use crate::{
    Error, Result,
    cameras::{CameraEstimate, FocalView, RayMap, camera_to_world, decoded_camera, share_focal_lengths},
    features::PixelValues,
    gpu::{Run, StageTimes, Tensor},
    stages::{
        ViewGrid,
        heads::{CameraTensors, DEPTH_OFFSET, GAUSSIAN_VALUES, HeadTensors, ViewTensors},
    },
    types::{Camera, Similarity, preprocess::PixelMap},
};
use glam::DVec3;

/// Source of estimated cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraSource {
    /// The camera decoder.
    Decoder,
    /// The rays of all pixels, principal point included. Inconsistent rays give no camera.
    Rays,
}

/// Outputs of all views.
#[derive(Clone, Debug)]
pub struct DepthPrediction {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Per view.
    pub views: Vec<DepthMap>,
    /// Patch side in pixels.
    pub patch_size: usize,
    /// Kept patches, ascending, unless all are kept.
    pub patches: Option<Vec<u32>>,
    /// Each view's [`DepthModel::patch_tokens`](super::DepthModel::patch_tokens), if kept.
    pub patch_tokens: Vec<PixelValues>,
    /// Time per stage.
    pub times: StageTimes,
    /// Arena and weight bytes.
    pub peak_bytes: u64,
}

impl DepthPrediction {
    /// Returns the decoded cameras, at depth size.
    ///
    /// # Errors
    /// [`Error::Argument`] for separate views or invalid cameras.
    pub fn cameras(&self) -> Result<Vec<Camera>> {
        let camera = |(i, view): (usize, &DepthMap)| {
            let encoding = view.encoding.as_ref().ok_or_else(by_themselves)?;
            let camera = decoded_camera(encoding, [self.width, self.height]);
            camera.validate(&format!("camera of view {i}"))?;
            Ok(camera)
        };
        self.views.iter().enumerate().map(camera).collect()
    }

    /// Scales depth to the world of known cameras.
    ///
    /// # Errors
    /// [`Error::Argument`] for coincident cameras or separate views.
    pub fn align_to_cameras(&mut self, cameras: &[Camera]) -> Result<()> {
        let estimated = self.cameras()?;
        let centers = cameras.iter().zip(&estimated).map(|(a, b)| [a.pose.translation, b.pose.translation]);
        let centers: Vec<[DVec3; 2]> = centers.collect();
        let expected = "at least two places, or the network has none";
        let aligned = Similarity::of_points(&centers, &vec![1.0; centers.len()]);
        let Similarity { scale, .. } =
            aligned.ok_or_else(|| Error::argument("places of the cameras", "one", expected))?;
        self.views.iter_mut().for_each(|view| view.scale(1.0 / scale));
        Ok(())
    }

    /// Scales metric depth, predicted for [`METRIC_FOCAL`], to meters.
    pub fn to_meters(&mut self, cameras: &[Camera]) {
        for (view, Camera { intrinsics: lens, .. }) in self.views.iter_mut().zip(cameras) {
            view.scale((lens.fx + lens.fy) / 2.0 / METRIC_FOCAL);
        }
    }

    /// Scales each view by the median depth ratio to visible points, in the cameras' world.
    ///
    /// # Errors
    /// The first view without visible points.
    pub fn scale_to(&mut self, cameras: &[Camera], points: &[[f32; 3]]) -> std::result::Result<(), usize> {
        let (width, height) = (self.width, self.height);
        for (i, (view, camera)) in self.views.iter_mut().zip(cameras).enumerate() {
            let (to_camera, lens) = (camera.pose.inverse(), camera.intrinsics);
            let ratio = |point: &[f32; 3]| {
                let at = to_camera.transform(point.map(f64::from).into());
                let place = [lens.fx * at.x / at.z + lens.cx, lens.fy * at.y / at.z + lens.cy];
                let inside = at.z > 0.0 && place[0] >= 0.0 && place[1] >= 0.0;
                let [x, y] = place.map(|coordinate| coordinate as u32);
                let seen = (inside && x < width && y < height).then_some((y * width + x) as usize)?;
                view.shows(seen).then(|| at.z / f64::from(view.depth[seen]))
            };
            let mut ratios: Vec<f64> = points.iter().filter_map(ratio).collect();
            ratios.sort_by(f64::total_cmp);
            view.scale(*ratios.get(ratios.len() / 2).ok_or(i)?);
        }
        Ok(())
    }

    /// Removes unflagged views.
    pub fn keep_views(&mut self, kept: &[bool]) {
        let all = kept.len();
        let place: Vec<usize> = (0..all).map(|view| kept[..view].iter().filter(|kept| **kept).count()).collect();
        let (mut of_views, mut of_tokens) = (kept.iter(), kept.iter());
        self.views.retain(|_| of_views.next() == Some(&true));
        self.patch_tokens.retain(|_| of_tokens.next() == Some(&true));
        let each = (self.width as usize / self.patch_size) * (self.height as usize / self.patch_size);
        if let Some(patches) = &mut self.patches {
            patches.retain(|patch| kept[*patch as usize / each]);
            patches.iter_mut().for_each(|patch| {
                let (view, inside) = (*patch as usize / each, *patch as usize % each);
                *patch = (place[view] * each + inside) as u32;
            });
        }
    }

    /// Estimates cameras from rays; each view may fail.
    ///
    /// # Errors
    /// [`Error::Argument`] without rays.
    pub fn cameras_of_rays(&self) -> Result<Vec<Result<CameraEstimate>>> {
        let camera = |view: &DepthMap| {
            let rays = view.rays.as_ref().ok_or_else(without_rays)?;
            Ok(rays.camera([self.width, self.height]))
        };
        self.views.iter().map(camera).collect()
    }

    /// Estimates cameras; each view may fail. Views of equal `lenses` share a focal length, the
    /// median weighted by confidence; `maps` are their photos'.
    ///
    /// # Errors
    /// Those of [`DepthPrediction::cameras`] or [`DepthPrediction::cameras_of_rays`].
    pub fn estimate_cameras(
        &self,
        source: CameraSource,
        maps: &[PixelMap],
        lenses: Option<&[usize]>,
    ) -> Result<Vec<Result<Camera>>> {
        let mut found: Vec<Result<Camera>> = match source {
            CameraSource::Decoder => self.cameras()?.into_iter().map(Ok).collect(),
            CameraSource::Rays => self.cameras_of_rays()?.into_iter().map(|found| Ok(found?.camera)).collect(),
        };
        if let Some(lenses) = lenses {
            let views = found.iter_mut().zip(maps).zip(lenses).zip(&self.views);
            let posed = views.filter_map(|(((camera, map), lens), view)| {
                let camera = camera.as_mut().ok()?;
                Some(FocalView { camera, map, lens: *lens, weight: view.mean_confidence() })
            });
            share_focal_lengths(posed.collect());
        }
        Ok(found)
    }
}

/// Focal length of metric depth in pixels.
pub const METRIC_FOCAL: f64 = 300.0;

pub(super) const SKY: f32 = 0.3;
const FEWEST: usize = 10;
const BEHIND: f64 = 0.99;

impl DepthMap {
    /// Scales depth and the depth offsets of Gaussians.
    pub fn scale(&mut self, factor: f64) {
        let offsets = self.gaussians.iter_mut().flat_map(|values| values[DEPTH_OFFSET..].iter_mut());
        let offsets = offsets.step_by(GAUSSIAN_VALUES);
        self.depth.iter_mut().chain(offsets).for_each(|value| *value = (f64::from(*value) * factor) as f32);
    }

    /// Depth with sky behind 99 % of the rest, given enough pixels of both.
    pub fn depth_behind_sky(&self) -> Vec<f32> {
        let mut depth = self.depth.clone();
        let Some(sky) = &self.sky else { return depth };
        let is_sky = |value: &f32| *value >= SKY;
        let mut rest: Vec<f32> =
            depth.iter().zip(sky).filter(|(_, sky)| !is_sky(sky)).map(|(depth, _)| *depth).collect();
        if rest.len() > FEWEST && depth.len() - rest.len() > FEWEST {
            rest.sort_by(f32::total_cmp);
            let place = BEHIND * (rest.len() - 1) as f64;
            let [low, high] = [place.floor(), place.ceil()].map(|at| f64::from(rest[at as usize]));
            let far = (low + (high - low) * place.fract()) as f32;
            depth.iter_mut().zip(sky).filter(|(_, sky)| is_sky(sky)).for_each(|(depth, _)| *depth = far);
        }
        depth
    }
}

fn by_themselves() -> Error {
    Error::argument("cameras of views", "a network that sees each view by itself", "one that sees all views at once")
}

fn without_rays() -> Error {
    Error::argument("rays of views", "none", "a network of Depth Anything 3 that sees all views at once")
}

/// Depth of a view.
#[derive(Clone, Debug, Default)]
pub struct DepthMap {
    /// `[height, width]` along the camera axis, in arbitrary units.
    pub depth: Vec<f32>,
    /// `[height, width]`, at least 1.
    pub confidence: Option<Vec<f32>>,
    /// Rays of joint views.
    pub rays: Option<RayMap>,
    /// `[height, width]` for separate views: sky above 0.3.
    pub sky: Option<Vec<f32>>,
    /// Decoded camera of joint views: see [`decoded_camera`](crate::cameras::decoded_camera).
    pub encoding: Option<[f32; 9]>,
    /// `[height, width, GAUSSIAN_VALUES]`, see [`pixel_gaussians`](super::pixel_gaussians).
    pub gaussians: Option<Vec<f32>>,
    /// `[height, width, 4]`, with a point head: point in the reference view's world, confidence.
    pub points: Option<Vec<[f32; 4]>>,
}

pub(super) fn read(
    run: &Run,
    heads: &HeadTensors,
    grid: ViewGrid,
    times: StageTimes,
    peak_bytes: u64,
) -> Result<DepthPrediction> {
    let encodings = encodings(run, heads)?;
    let view = |(i, view): (usize, &ViewTensors)| -> Result<DepthMap> {
        let logits: Vec<f32> = run.read(view.depth)?;
        let channels = if view.sky.is_some() { 1 } else { 2 };
        let exp = |channel: usize, least: f64| -> Vec<f32> {
            logits.iter().skip(channel).step_by(channels).map(|x| (least + f64::from(*x).exp()) as f32).collect()
        };
        let sky =
            |tensor: Tensor| -> Result<Vec<f32>> { Ok(run.read::<f32>(tensor)?.iter().map(|x| x.max(0.0)).collect()) };
        Ok(DepthMap {
            depth: exp(0, 0.0),
            confidence: (channels > 1).then(|| exp(1, 1.0)),
            rays: view.rays.map(|tensor| rays(&run.read(tensor)?, grid)).transpose()?,
            sky: view.sky.map(sky).transpose()?,
            encoding: encodings.get(i).copied(),
            points: heads.points.get(i).map(|view| Ok(points(&run.read(*view)?))).transpose()?,
            gaussians: heads.gaussians.get(i).map(|view| run.read(view.values)).transpose()?,
        })
    };
    let [width, height] = [grid.columns, grid.rows].map(|count| (count * grid.patch_size) as u32);
    let views = heads.views.iter().enumerate().map(view).collect::<Result<_>>()?;
    let (patch_size, patches, patch_tokens) = (grid.patch_size, None, Vec::new());
    Ok(DepthPrediction { width, height, views, patch_size, patches, patch_tokens, times, peak_bytes })
}

fn points(values: &[[f32; 4]]) -> Vec<[f32; 4]> {
    let length = |y: f32| f64::from(y).abs().exp_m1().copysign(f64::from(y)) as f32;
    let point = |v: &[f32; 4]| [length(v[0]), length(v[1]), length(v[2]), (1.0 + f64::from(v[3]).exp()) as f32];
    values.iter().map(point).collect()
}

fn rays(values: &[f32], grid: ViewGrid) -> Result<RayMap> {
    let [width, height] = [grid.columns, grid.rows].map(|count| 8 * count as u32);
    let (rays, _) = values.as_chunks::<7>();
    Ok(RayMap {
        width,
        height,
        directions: rays.iter().map(|ray| [ray[0], ray[1], ray[2]]).collect(),
        origins: rays.iter().map(|ray| [ray[3], ray[4], ray[5]]).collect(),
        confidence: rays.iter().map(|ray| (1.0 + f64::from(ray[6]).exp()) as f32).collect(),
    })
}

fn encodings(run: &Run, heads: &HeadTensors) -> Result<Vec<[f32; 9]>> {
    let (translations, quaternions, fovs) = match heads.cameras {
        None => return Ok(Vec::new()),
        Some(CameraTensors::Decoded { translations, quaternions, fovs }) => (translations, quaternions, fovs),
        Some(CameraTensors::Iterated { encodings, .. }) => {
            return Ok(run.read::<[f32; 9]>(encodings)?.iter().map(camera_to_world).collect());
        }
    };
    let translations: Vec<[f32; 3]> = run.read(translations)?;
    let quaternions: Vec<[f32; 4]> = run.read(quaternions)?;
    let fovs: Vec<[f32; 2]> = run.read(fovs)?;
    let joined = translations.iter().zip(&quaternions).zip(&fovs);
    Ok(joined
        .map(|((t, q), fov)| [t[0], t[1], t[2], q[0], q[1], q[2], q[3], fov[0].max(0.0), fov[1].max(0.0)])
        .collect())
}
