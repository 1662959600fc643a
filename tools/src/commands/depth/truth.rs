use crate::{cameras::Similarity, depth::PredictedViews, lifted::values_file, npy};
use glam::DQuat;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use zipsplat::{
    Camera, Error, Result,
    depth::DepthMap,
    types::{median, poses::Capture, preprocess::PixelMap},
};

pub struct Truth {
    poses: Capture,
    folder: PathBuf,
}

pub struct Errors {
    /// With both an estimated and a true camera.
    photos: usize,
    /// Degrees, distance over the cameras' extent, and relative focal length, after a similarity;
    /// absent for given or coinciding cameras.
    cameras: Option<[f64; 3]>,
    /// AbsRel and the share of pixels within a factor of 1.25, at one scale; absent without depth.
    depth: Option<[f64; 2]>,
}

impl Truth {
    pub fn open(folder: &Path) -> Result<Self> {
        Ok(Self { poses: Capture::open(folder)?, folder: folder.to_owned() })
    }

    /// Cameras count only if the network `found` them.
    pub fn errors(&self, predicted: &PredictedViews, found: bool) -> Result<Errors> {
        let (mut pairs, mut depths) = (Vec::new(), Vec::new());
        let frames = predicted.frames()?;
        for (i, photo) in predicted.photos.iter().enumerate() {
            let Some(frame) = self.poses.frame_of(photo)? else { continue };
            pairs.extend(frames.get(i).map(|ours| (ours.camera, frame.camera)));
            if let Some(file) = values_file(&self.folder.join("depth"), &frame.name, &["npy"]) {
                depths.push(ratios(&predicted.depths.views[i], &predicted.views[i].map, &npy::read(&file)?));
            }
        }
        if pairs.is_empty() && depths.is_empty() {
            let found = format!("none of {}", predicted.photos.len());
            return Err(Error::argument("photos with a truth", found, format!("some in {}", self.folder.display())));
        }
        Ok(Errors { photos: pairs.len(), cameras: cameras(&pairs).filter(|_| found), depth: depth(depths) })
    }
}

impl Errors {
    pub fn summary(&self) -> String {
        let mut parts = Vec::new();
        if let Some([degrees, away, focal]) = self.cameras {
            let (away, focal) = (100.0 * away, 100.0 * focal);
            parts
                .push(format!("cameras {degrees:.2} degrees, {away:.2} % of their extent, focal length {focal:+.1} %"));
        }
        if let Some([relative, within]) = self.depth {
            let (relative, within) = (100.0 * relative, 100.0 * within);
            parts.push(format!("depth {relative:.1} % (AbsRel), {within:.1} % of pixels within 1.25"));
        }
        match parts[..] {
            [] => format!("off by: nothing to tell of {} photos", self.photos),
            _ => format!("off by (medians of {} photos): {}", self.photos, parts.join("; ")),
        }
    }

    pub fn as_json(&self) -> Value {
        let [degrees, away, focal] = self.cameras.map_or([None; 3], |errors| errors.map(Some));
        let [abs_rel, within] = self.depth.map_or([None; 2], |errors| errors.map(Some));
        json!({
            "photos": self.photos, "rotation_error_deg": degrees, "translation_error": away, "focal": focal, "abs_rel": abs_rel, "delta_1_25": within,
        })
    }
}

/// Medians for [`Errors::cameras`].
fn cameras(pairs: &[(Camera, Camera)]) -> Option<[f64; 3]> {
    let (similarity, _) = Similarity::of_cameras(pairs)?;
    let centers = pairs.iter().map(|(_, truth)| truth.pose.translation);
    let (low, high) = (centers.clone().reduce(|a, b| a.min(b))?, centers.reduce(|a, b| a.max(b))?);
    let error = |(found, truth): &(Camera, Camera)| {
        let moved = similarity.apply(found).pose;
        let turn = DQuat::from_mat3(&moved.relative_to(&truth.pose).rotation).to_scaled_axis().length();
        let away = moved.translation.distance(truth.pose.translation) / low.distance(high);
        [turn.to_degrees(), away, found.intrinsics.fx / truth.intrinsics.fx - 1.0]
    };
    let errors: Vec<[f64; 3]> = pairs.iter().map(error).collect();
    let [degrees, away, focal] = [0, 1, 2].map(|k| median(errors.iter().map(|error| error[k])));
    Some([degrees?, away?, focal?])
}

/// True over predicted depth of known pixels, nearest sampled.
fn ratios(view: &DepthMap, map: &PixelMap, ([width, height], truth): &([u32; 2], Vec<f32>)) -> Vec<f64> {
    let ([columns, _], [from_width, from_height]) = (map.to, map.from);
    let at = |i: usize, axis: usize, from: u32, to: u32| {
        let of_photo = (i as f64 + 0.5 - map.offset[axis]) / map.scale[axis];
        (of_photo * f64::from(to) / f64::from(from)).floor().clamp(0.0, f64::from(to - 1)) as usize
    };
    let ratio = |(i, depth): (usize, &f32)| {
        let (x, y) = (i % columns as usize, i / columns as usize);
        let place = at(y, 1, from_height, *height) * *width as usize + at(x, 0, from_width, *width);
        let ratio = f64::from(truth[place]) / f64::from(*depth);
        (ratio.is_finite() && ratio > 0.0).then_some(ratio)
    };
    view.depth.iter().enumerate().filter_map(ratio).collect()
}

/// Medians of AbsRel and of the share within a factor of 1.25, scaled by the median of photo
/// medians.
fn depth(photos: Vec<Vec<f64>>) -> Option<[f64; 2]> {
    let photos: Vec<Vec<f64>> = photos.into_iter().filter(|ratios| !ratios.is_empty()).collect();
    let scale = median(photos.iter().filter_map(|ratios| median(ratios.iter().copied())))?;
    let mean = |ratios: &[f64], of: &dyn Fn(f64) -> f64| {
        ratios.iter().map(|ratio| of(ratio / scale)).sum::<f64>() / ratios.len() as f64
    };
    let relative = |ratio: f64| (1.0 / ratio - 1.0).abs();
    let within = |ratio: f64| f64::from(u8::from(ratio.max(1.0 / ratio) < 1.25));
    let of_photos = |of: &dyn Fn(f64) -> f64| median(photos.iter().map(|ratios| mean(ratios, of)));
    Some([of_photos(&relative)?, of_photos(&within)?])
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};
    use zipsplat::types::{Intrinsics, Pose};

    #[test]
    fn errors_of_cameras_are_those_behind_a_similarity() {
        let intrinsics = Intrinsics { width: 8, height: 8, fx: 10.0, fy: 10.0, cx: 4.0, cy: 4.0 };
        let world = Similarity {
            scale: 0.2,
            pose: Pose { rotation: DMat3::from_rotation_z(1.0), translation: DVec3::new(3.0, 1.0, -2.0) },
        };
        let truth = |k: usize| {
            let translation = DVec3::new([0.0, 4.0, 0.0, 4.0][k], [0.0, 0.0, 3.0, 3.0][k], 0.0);
            Camera { intrinsics, pose: Pose { rotation: DMat3::from_rotation_y(0.3 * k as f64), translation } }
        };
        let exact: Vec<(Camera, Camera)> = (0..4).map(|k| (world.apply(&truth(k)), truth(k))).collect();
        assert!(cameras(&exact).expect("places").iter().all(|error| error.abs() < 1e-6));
        let mut off = exact.clone();
        for (k, (found, _)) in off.iter_mut().enumerate() {
            found.intrinsics.fx *= 1.1;
            found.pose.rotation *= DMat3::from_rotation_x([1f64, -1.0, 1.0, -1.0][k].to_radians());
        }
        let [degrees, away, focal] = cameras(&off).expect("places");
        assert!((degrees - 1.0).abs() < 0.05 && away < 0.02 && (focal - 0.1).abs() < 1e-9, "{degrees} {away} {focal}");
    }

    #[test]
    fn errors_of_depth_are_shares_of_it() {
        let exact = vec![vec![2.0; 9], vec![2.0; 5]];
        assert_eq!(depth(exact), Some([0.0, 1.0]));
        let [relative, within] =
            depth(vec![vec![1.0; 4], vec![1.0, 1.0, 1.0, 1.0 / 1.4], vec![1.0 / 1.1; 4]]).expect("depth");
        assert!((relative - 0.1).abs() < 1e-9 && within == 1.0, "{relative} {within}");
        assert_eq!(depth(vec![Vec::new()]), None);
    }

    #[test]
    fn pixels_are_found_in_the_truth() {
        // The right half of 4 x 2 pixels becomes 4 x 4, with true depth of 8 x 4.
        let map = PixelMap { from: [4, 2], to: [4, 4], scale: [2.0, 2.0], offset: [-4.0, 0.0] };
        let truth: Vec<f32> = (0..32).map(|i| i as f32).collect();
        let view = DepthMap { depth: vec![1.0; 16], ..DepthMap::default() };
        let expected: Vec<f64> = (0..16).map(|i| f64::from(i / 4 * 8 + 4 + i % 4)).collect();
        assert_eq!(ratios(&view, &map, &([8, 4], truth)), expected);
    }
}
