//! Scene scale: the network's unit of length in the world of known cameras.

use super::{super::Camera, super::Pose, read_cloud};
use crate::{Result, median};
use glam::{DMat3, DVec3};
use nalgebra::Matrix3;
use serde::Serialize;
use std::{
    fmt,
    path::{Path, PathBuf},
};

/// Minimum mean squared sine of the angles between optical axes and their mean direction. Below it,
/// the axes' nearest point may be anywhere.
const CONVERGING: f64 = 0.05;
const FARTHER: f64 = 2.0;

/// The network's unit of length in the cameras' unit. In training, the median depth from the first
/// view is about 1.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneScale {
    /// Divisor of camera positions.
    pub length: f64,
    /// Source of the length.
    pub source: Source,
}

/// Source of a scene scale.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// Given by the user.
    Given,
    /// Median distance of cloud points visible to the selected cameras.
    Points(PathBuf),
    /// Median distance of pixels, by depth of this origin.
    Depth(String),
    /// Distance of the point nearest to all optical axes.
    Axes,
    /// Root mean square of distances between cameras, if axes do not converge.
    Spread,
    /// Unknown: no cameras, or all at one position.
    Nothing,
}

impl SceneScale {
    /// Determines the scene scale: `given`, else from `points` visible to `views`, else from all
    /// `cameras`. The frame of `views` is the first view's camera; `origin` is its pose in the
    /// world of `cameras`.
    pub fn of(
        given: Option<f64>,
        cameras: &[Pose],
        points: Option<&Path>,
        views: &[Camera],
        origin: &Pose,
    ) -> Result<Self> {
        if let Some(length) = given {
            return Ok(Self { length, source: Source::Given });
        }
        if let Some(path) = points
            && let Some(length) = of_points(path, views, origin)?
        {
            return Ok(Self { length, source: Source::Points(path.to_owned()) });
        }
        let (length, source) = match (of_spread(cameras), of_axes(cameras, origin)) {
            (None, _) => (1.0, Source::Nothing),
            (Some(_), Some(length)) => (length, Source::Axes),
            (Some(spread), None) => (spread, Source::Spread),
        };
        Ok(Self { length, source })
    }

    /// Returns a warning unless the scale was given or measured.
    pub fn doubt(&self) -> Option<String> {
        match self.source {
            Source::Given | Source::Points(_) | Source::Depth(_) => None,
            _ => Some(format!("no point cloud: {self}; a given scene scale is more certain")),
        }
    }
}

impl fmt::Display for SceneScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "scene scale {:.4}", self.length)?;
        match &self.source {
            Source::Given => write!(f, ", as given"),
            Source::Points(path) => write!(f, ", the median distance of the points of {}", path.display()),
            Source::Depth(origin) => write!(f, ", the median distance of the pixels by {origin}"),
            Source::Axes => write!(f, ", the distance of the point that all cameras look at"),
            Source::Spread => write!(f, ", the distance between cameras, as they do not look at one point"),
            Source::Nothing => write!(f, ", as all cameras stand at one place"),
        }
    }
}

impl Source {
    /// Returns a one-word name.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Given => "given",
            Self::Points(_) => "points",
            Self::Depth(_) => "depth",
            Self::Axes => "axes",
            Self::Spread => "spread",
            Self::Nothing => "nothing",
        }
    }
}

impl Serialize for Source {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// Returns the median distance from the first of `cameras` of the points visible to any.
fn of_points(path: &Path, cameras: &[Camera], origin: &Pose) -> Result<Option<f64>> {
    let to_world = origin.inverse();
    let distances: Vec<f64> = (read_cloud(path)?.positions.into_iter())
        .map(|point| to_world.transform(DVec3::from(point.map(f64::from))))
        .filter(|point| cameras.iter().any(|camera| camera.project(*point).is_some()))
        .map(DVec3::length)
        .collect();
    Ok(median(distances).filter(|length| *length > 0.0))
}

/// Returns the first camera's distance to the point nearest all optical axes (least squares), if
/// these converge in front of most cameras.
fn of_axes(cameras: &[Pose], first: &Pose) -> Option<f64> {
    let (mut sum, mut moment) = (DMat3::ZERO, DVec3::ZERO);
    for pose in cameras {
        let axis = pose.rotation.z_axis;
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        sum += across;
        moment += across * pose.translation;
    }
    let eigenvalues = Matrix3::from_column_slice(&sum.to_cols_array()).symmetric_eigenvalues();
    if eigenvalues.min() < CONVERGING * cameras.len() as f64 {
        return None;
    }
    let point = sum.inverse() * moment;
    let depth = median(cameras.iter().map(|pose| (point - pose.translation).dot(pose.rotation.z_axis)))?;
    let distance = median(cameras.iter().map(|pose| point.distance(pose.translation)))?;
    let own = point.distance(first.translation).clamp(distance / FARTHER, distance * FARTHER);
    (depth > 0.0 && own > 0.0).then_some(own)
}

fn of_spread(cameras: &[Pose]) -> Option<f64> {
    let count = cameras.len() as f64;
    let center = cameras.iter().map(|pose| pose.translation).sum::<DVec3>() / count;
    let squares: f64 = cameras.iter().map(|pose| pose.translation.distance_squared(center)).sum();
    let spread = (2.0 * squares / (count - 1.0)).sqrt();
    // Cameras rotating on a tripod differ by rounding.
    (spread.is_finite() && spread > 1e-9 * center.length()).then_some(spread)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Orbit;

    fn found(cameras: Vec<Pose>) -> (f64, Source) {
        let SceneScale { length, source } = SceneScale::of(None, &cameras, None, &[], &cameras[0]).expect("no cloud");
        (length, source)
    }

    #[test]
    fn cameras_that_look_at_a_point_are_measured_by_it() {
        let orbit = Orbit { center: DVec3::new(30.0, -10.0, 200.0), radius: 40.0 };
        let (length, source) = found(orbit.sweep(7, 13.0, 200.0, -25.0));
        assert!((length - 40.0).abs() < 1e-9 && source == Source::Axes, "{length} {source:?}");
        let mut cameras = orbit.sweep(7, 13.0, 200.0, -25.0);
        cameras[0].translation = orbit.center - 20.5 * cameras[0].rotation.z_axis;
        assert!((found(cameras.clone()).0 - 20.5).abs() < 1e-9);
        cameras[0].translation = orbit.center - 0.5 * cameras[0].rotation.z_axis;
        assert!((found(cameras).0 - 20.0).abs() < 1e-9);
    }

    #[test]
    fn cameras_that_do_not_are_measured_by_their_distances() {
        let at = |x: f64, turn: f64| Pose {
            rotation: DMat3::from_rotation_y(turn),
            translation: DVec3::new(500.0 + x, 0.0, 0.0),
        };
        // Parallel and diverging axes have no common point in front.
        for turn in [0.0, 0.4] {
            let (length, source) = found(vec![at(-3.0, -turn), at(0.0, 0.0), at(3.0, turn)]);
            assert!((length - 18f64.sqrt()).abs() < 1e-9 && source == Source::Spread, "{length} {source:?}");
        }
        assert_eq!(found(vec![at(1.0, 0.0), at(1.0, 0.9), at(1.0, -0.4)]), (1.0, Source::Nothing));
        assert_eq!(found(vec![at(1.0, 0.0)]), (1.0, Source::Nothing));
    }
}
