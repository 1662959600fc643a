//! The outputs of a depth network.

use crate::{
    Error, Result,
    cameras::{FoundCamera, RayMap, decoded_camera, scale_between},
    gpu::{Run, StageTimes, Tensor},
    stages::{
        ViewGrid,
        heads::{HeadTensors, ViewTensors},
    },
    types::Camera,
};

/// Depth of all views, and what was found beside it.
#[derive(Clone, Debug)]
pub struct Depths {
    /// Pixels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// One a view.
    pub views: Vec<DepthView>,
    /// Side of a patch in pixels.
    pub patch: usize,
    /// The patches that stand for all, counted along rows, then down, then over views, in rising order; none where all do.
    pub patches: Option<Vec<u32>>,
    /// Time of each stage.
    pub times: StageTimes,
    /// Bytes of the arena and the weights.
    pub peak_bytes: u64,
}

impl Depths {
    /// The cameras of the views as the camera decoder has them, of the size of the depths, in a world about the reference view's.
    ///
    /// # Errors
    /// [`Error::Argument`] where views were seen by themselves, or a camera is none.
    pub fn cameras(&self) -> Result<Vec<Camera>> {
        let camera = |(i, view): (usize, &DepthView)| {
            let encoding = view.encoding.as_ref().ok_or_else(by_themselves)?;
            let camera = decoded_camera(encoding, [self.width, self.height]);
            camera.validate(&format!("camera of view {i}"))?;
            Ok(camera)
        };
        self.views.iter().enumerate().map(camera).collect()
    }

    /// Brings depth to the world of the cameras that were given, by where the camera decoder has these.
    ///
    /// # Errors
    /// [`Error::Argument`] where the cameras are at one place, or views were seen by themselves.
    pub fn bring_to(&mut self, cameras: &[Camera]) -> Result<()> {
        let centres = |cameras: &[Camera]| cameras.iter().map(|camera| camera.pose.translation).collect::<Vec<_>>();
        let scale = scale_between(&centres(cameras), &centres(&self.cameras()?));
        let expected = "at least two places, or the network has none";
        let scale = scale.ok_or_else(|| Error::argument("places of the cameras", "one", expected))?;
        let depths = self.views.iter_mut().flat_map(|view| &mut view.depth);
        depths.for_each(|depth| *depth = (f64::from(*depth) / scale) as f32);
        Ok(())
    }

    /// Brings the depth of each view to metres, where a network with a metric head sees each view by itself: what it says is the depth of
    /// a camera of [`METRIC_FOCAL`] pixels. `cameras` are those of the views.
    pub fn to_metres(&mut self, cameras: &[Camera]) {
        for (view, Camera { intrinsics: lens, .. }) in self.views.iter_mut().zip(cameras) {
            let factor = (lens.fx + lens.fy) / 2.0 / METRIC_FOCAL;
            view.depth.iter_mut().for_each(|depth| *depth = (f64::from(*depth) * factor) as f32);
        }
    }

    /// Brings the depth of each view to the unit of points that it shows: by the median of how many times farther they are than its
    /// pixels say. `cameras` are those of the views, in the world of the points. For networks that see each view by itself, whose depth
    /// is of one unit in no two views.
    ///
    /// # Errors
    /// The first view that shows no point.
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
            let scale = *ratios.get(ratios.len() / 2).ok_or(i)?;
            view.depth.iter_mut().for_each(|depth| *depth = (f64::from(*depth) * scale) as f32);
        }
        Ok(())
    }

    /// Leaves only the views that are `kept`, one flag each.
    pub fn keep_views(&mut self, kept: &[bool]) {
        let all = kept.len();
        let place: Vec<usize> = (0..all).map(|view| kept[..view].iter().filter(|kept| **kept).count()).collect();
        let mut flags = kept.iter();
        self.views.retain(|_| flags.next() == Some(&true));
        let each = (self.width as usize / self.patch) * (self.height as usize / self.patch);
        if let Some(patches) = &mut self.patches {
            patches.retain(|patch| kept[*patch as usize / each]);
            patches.iter_mut().for_each(|patch| {
                let (view, inside) = (*patch as usize / each, *patch as usize % each);
                *patch = (place[view] * each + inside) as u32;
            });
        }
    }

    /// The cameras of the views as their rays have them, in the same world; each view's own error where its rays have none.
    ///
    /// # Errors
    /// [`Error::Argument`] where views were seen by themselves.
    pub fn cameras_of_rays(&self) -> Result<Vec<Result<FoundCamera>>> {
        let camera = |view: &DepthView| {
            let rays = view.rays.as_ref().ok_or_else(by_themselves)?;
            Ok(rays.camera([self.width, self.height]))
        };
        self.views.iter().map(camera).collect()
    }
}

/// The focal length in pixels with which a metric head's depth is in metres.
pub const METRIC_FOCAL: f64 = 300.0;

/// Sky is what is above this.
pub(super) const SKY: f32 = 0.3;
/// Pixels that sky and the rest must have, before the depth of sky follows from the rest.
const FEWEST: usize = 10;
/// The share of the rest that sky is behind.
const BEHIND: f64 = 0.99;

impl DepthView {
    /// Depth, of which that of sky is behind 99 % of the rest. As [`DepthView::depth`] where the network does not tell sky, or there is
    /// hardly any, or hardly anything else.
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

/// A view's depth.
#[derive(Clone, Debug)]
pub struct DepthView {
    /// `[height, width]` along the camera's axis, in any unit, one for all views that were seen at once.
    pub depth: Vec<f32>,
    /// `[height, width]` from 1 on, where the network tells.
    pub confidence: Option<Vec<f32>>,
    /// The rays of pixels, where views were seen at once.
    pub rays: Option<RayMap>,
    /// `[height, width]` from 0 on, where views were seen by themselves: above 0.3 it is sky.
    pub sky: Option<Vec<f32>>,
    /// The camera decoder's values, where views were seen at once: centre (3), camera-to-world quaternion xyzw (4) of any length, vertical
    /// and horizontal field of view in radians.
    pub encoding: Option<[f32; 9]>,
    /// `[height, width, GAUSSIAN_VALUES]`, where the network has a head for Gaussians: see [`pixel_gaussians`](super::pixel_gaussians).
    pub gaussians: Option<Vec<f32>>,
}

/// Reads the outputs of a run.
pub(super) fn read(
    run: &Run,
    heads: &HeadTensors,
    grid: ViewGrid,
    times: StageTimes,
    peak_bytes: u64,
) -> Result<Depths> {
    let encodings = encodings(run, heads)?;
    let view = |(i, view): (usize, &ViewTensors)| -> Result<DepthView> {
        let logits: Vec<f32> = run.read(view.depth)?;
        let channels = if view.sky.is_some() { 1 } else { 2 };
        let exp = |channel: usize, least: f64| -> Vec<f32> {
            logits.iter().skip(channel).step_by(channels).map(|x| (least + f64::from(*x).exp()) as f32).collect()
        };
        let sky =
            |tensor: Tensor| -> Result<Vec<f32>> { Ok(run.read::<f32>(tensor)?.iter().map(|x| x.max(0.0)).collect()) };
        Ok(DepthView {
            depth: exp(0, 0.0),
            confidence: (channels > 1).then(|| exp(1, 1.0)),
            rays: view.rays.map(|tensor| rays(&run.read(tensor)?, grid)).transpose()?,
            sky: view.sky.map(sky).transpose()?,
            encoding: encodings.get(i).copied(),
            gaussians: heads.gaussians.get(i).map(|view| run.read(view.values)).transpose()?,
        })
    };
    let [width, height] = [grid.columns, grid.rows].map(|count| (count * grid.patch) as u32);
    let views = heads.views.iter().enumerate().map(view).collect::<Result<_>>()?;
    Ok(Depths { width, height, views, patch: grid.patch, patches: None, times, peak_bytes })
}

/// Rays from the head's values, seven each.
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
    let Some(cameras) = heads.cameras else { return Ok(Vec::new()) };
    let translations: Vec<[f32; 3]> = run.read(cameras.translations)?;
    let quaternions: Vec<[f32; 4]> = run.read(cameras.quaternions)?;
    let fovs: Vec<[f32; 2]> = run.read(cameras.fovs)?;
    let joined = translations.iter().zip(&quaternions).zip(&fovs);
    Ok(joined
        .map(|((t, q), fov)| [t[0], t[1], t[2], q[0], q[1], q[2], q[3], fov[0].max(0.0), fov[1].max(0.0)])
        .collect())
}
