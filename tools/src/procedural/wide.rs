use std::f64::consts::{FRAC_PI_2, PI};

use clap::ValueEnum;
use glam::{DVec3, Vec3A};
use zipsplat::Result;
use zipsplat::types::{Camera, Distortion, Intrinsics, Lens, LensView, Pose, poses::CaptureView};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum WideModel {
    /// 360-degree photos, twice as wide as high
    Equirectangular,
    /// Image circle of 180 degrees in the shorter side
    OpencvFisheye,
}

const FISHEYE: [f64; 4] = [-0.02, 0.005, -0.001, 0.0002];
const HALVINGS: usize = 40;

pub struct WideLens(pub Lens);

impl WideLens {
    pub fn new(model: WideModel, width: u32, height: u32) -> Result<Self> {
        if model == WideModel::Equirectangular {
            return Lens::equirectangular(width, height, "procedural photos").map(Self);
        }
        let distortion = Distortion::Fisheye(FISHEYE);
        let radius = distortion.project(DVec3::X)[0];
        let focal = f64::from(width.min(height)) / 2.0 / radius;
        let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        Ok(Self(Lens { intrinsics: Intrinsics { width, height, fx: focal, fy: focal, cx, cy }, distortion, view: 0 }))
    }

    /// Unit ray of a position in pixels, `None` outside the image circle.
    pub fn ray(&self, x: f64, y: f64) -> Option<Vec3A> {
        let Lens { intrinsics: i, distortion, .. } = &self.0;
        let [x, y] = [(x - i.cx) / i.fx, (y - i.cy) / i.fy];
        if *distortion == Distortion::Equirectangular {
            let ray = DVec3::new(y.cos() * x.sin(), y.sin(), y.cos() * x.cos());
            return Some(ray.as_vec3a());
        }
        let radius = x.hypot(y);
        let of_angle = |angle: f64| distortion.project(DVec3::new(angle.sin(), 0.0, angle.cos()))[0];
        let (mut low, mut high) = (0.0, PI);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            *if of_angle(middle) > radius { &mut high } else { &mut low } = middle;
        }
        let azimuth = y.atan2(x);
        let ray = DVec3::new(low.sin() * azimuth.cos(), low.sin() * azimuth.sin(), low.cos());
        (low <= FRAC_PI_2).then(|| ray.as_vec3a())
    }

    pub fn frames(&self, cameras: &[Camera], names: &[String]) -> Result<Vec<CaptureView>> {
        let views = self.0.views("procedural photo")?;
        let photos = cameras.iter().zip(names);
        let frames = photos.flat_map(|(camera, name)| {
            views.iter().enumerate().map(move |(view, LensView { intrinsics, rotation })| {
                let pose = Pose { rotation: camera.pose.rotation * *rotation, ..camera.pose };
                let camera = Camera { intrinsics: *intrinsics, pose };
                CaptureView { name: name.clone(), photo: None, camera, lens: Some(Lens { view, ..self.0 }) }
            })
        });
        Ok(frames.collect())
    }
}
