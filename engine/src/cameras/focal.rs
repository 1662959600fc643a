use crate::types::{Camera, Intrinsics, preprocess::PixelMap};
use std::collections::BTreeSet;

/// Sets one focal length per lens, the weighted median of the cameras' geometric means.
///
/// `maps` relate views to photos; `lenses` indexes each photo's lens.
pub fn share_focal_lengths(cameras: &mut [Camera], maps: &[PixelMap], lenses: &[usize], weights: &[f64]) {
    for lens in lenses.iter().collect::<BTreeSet<_>>() {
        let of_lens: Vec<usize> = (0..cameras.len()).filter(|&i| lenses[i] == *lens).collect();
        let of_photo = |&i: &usize| {
            let (Intrinsics { fx, fy, .. }, [sx, sy]) = (cameras[i].intrinsics, maps[i].scale);
            ((fx / sx * fy / sy).sqrt(), weights[i])
        };
        let mut focals: Vec<(f64, f64)> = of_lens.iter().map(of_photo).collect();
        let Some(focal) = weighted_median(&mut focals) else { continue };
        for i in of_lens {
            let [sx, sy] = maps[i].scale;
            (cameras[i].intrinsics.fx, cameras[i].intrinsics.fy) = (focal * sx, focal * sy);
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
        share_focal_lengths(&mut cameras, &maps, &[4, 4, 4, 9], &[1.0, 1.1, 1.2, 0.0]);
        assert_eq!(cameras, [camera(40.0, 40.0), camera(20.0, 40.0), camera(40.0, 10.0), camera(7.0, 8.0)]);
        let mut values = [(3.0, 1.0), (1.0, 1.0), (2.0, 5.0)];
        assert_eq!(weighted_median(&mut values), Some(2.0));
        assert_eq!(weighted_median(&mut [(7.0, 2.0), (5.0, 2.0)]), Some(5.0));
        assert_eq!(weighted_median(&mut []), None);
    }
}
