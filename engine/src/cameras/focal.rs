use crate::types::{Camera, Intrinsics, preprocess::PixelMap};
use std::collections::BTreeSet;

/// A view whose lens has one focal length.
pub(crate) struct FocalView<'a> {
    pub camera: &'a mut Camera,
    /// From the photo to the view.
    pub map: &'a PixelMap,
    /// Number of the lens.
    pub lens: usize,
    pub weight: f64,
}

/// Sets one focal length per lens, the weighted median of the cameras' geometric means.
pub(crate) fn share_focal_lengths(mut views: Vec<FocalView<'_>>) {
    for shared in views.iter().map(|view| view.lens).collect::<BTreeSet<_>>() {
        let of_photo = |view: &FocalView<'_>| {
            let (Intrinsics { fx, fy, .. }, [sx, sy]) = (view.camera.intrinsics, view.map.scale);
            ((fx / sx * fy / sy).sqrt(), view.weight)
        };
        let mut focals: Vec<_> = views.iter().filter(|view| view.lens == shared).map(of_photo).collect();
        let Some(focal) = weighted_median(&mut focals) else { continue };
        for FocalView { camera, map, .. } in views.iter_mut().filter(|view| view.lens == shared) {
            [camera.intrinsics.fx, camera.intrinsics.fy] = map.scale.map(|scale| focal * scale);
        }
    }
}

/// Lower weighted median, `None` without weight.
pub fn weighted_median(values: &mut [(f64, f64)]) -> Option<f64> {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all: f64 = values.iter().map(|(_, weight)| weight).sum();
    let mut below = 0.0;
    let reaches = |(_, weight): &&(f64, f64)| {
        below += weight;
        2.0 * below >= all
    };
    values.iter().find(reaches).filter(|_| all > 0.0).map(|(value, _)| *value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Intrinsics, Pose};

    #[test]
    fn one_wrong_focal_length_of_three_does_not_count() {
        let camera = |fx: f64, fy: f64| {
            let intrinsics = Intrinsics { width: 40, height: 30, fx, fy, cx: 21.0, cy: 14.0 };
            Camera { intrinsics, pose: Pose::IDENTITY }
        };
        let map = |scale: [f64; 2]| PixelMap { from: [40, 30], to: [40, 30], scale, offset: [0.0; 2] };
        let maps = [map([1.0; 2]), map([0.5, 1.0]), map([1.0, 0.25]), map([1.0; 2])];
        let mut cameras = [camera(32.0, 50.0), camera(200.0, 400.0), camera(38.0, 9.5), camera(7.0, 8.0)];
        let views = cameras.iter_mut().zip(&maps).zip([(4, 1.0), (4, 1.1), (4, 1.2), (9, 0.0)]);
        share_focal_lengths(
            views.map(|((camera, map), (lens, weight))| FocalView { camera, map, lens, weight }).collect(),
        );
        assert_eq!(cameras, [camera(40.0, 40.0), camera(20.0, 40.0), camera(40.0, 10.0), camera(7.0, 8.0)]);
        let mut values = [(3.0, 1.0), (1.0, 1.0), (2.0, 5.0)];
        assert_eq!(weighted_median(&mut values), Some(2.0));
        assert_eq!(weighted_median(&mut [(7.0, 2.0), (5.0, 2.0)]), Some(5.0));
        assert_eq!(weighted_median(&mut []), None);
    }
}
