use super::{DepthMap, DepthPrediction, pixels::pixel_point};
use crate::types::{Camera, Image};

/// Clamped to quantiles so that some but not all pixels pass.
const CONFIDENT: f32 = 1.05;
const SHARES: [f64; 2] = [0.4, 0.9];

impl DepthPrediction {
    /// Returns at most `most` colored world points of confident pixels, from any point head.
    pub fn points(&self, cameras: &[Camera], images: &[Image], most: usize) -> Vec<([f32; 3], [u8; 3])> {
        let least = self.least_confidence();
        let mut kept = Vec::new();
        for (view, depths) in self.views.iter().enumerate() {
            let confident = |i: usize| depths.confidence_at(i).is_none_or(|confidence| confidence >= least);
            let usable = |i: &usize| confident(*i) && depths.shows(*i) && !images[view].ignores(*i);
            kept.extend((0..depths.depth.len()).filter(usable).map(|i| (view, i)));
        }
        let step = kept.len().div_ceil(most.max(1)).max(1);
        let point = |&(view, i): &(usize, usize)| {
            let depth = f64::from(self.views[view].depth[i]);
            let of_depth = || pixel_point(&cameras[view], i, self.width as usize, depth);
            let at = self.views[view].points.as_ref().map_or_else(of_depth, |points| [0, 1, 2].map(|c| points[i][c]));
            (at, std::array::from_fn(|c| images[view].rgb[3 * i + c]))
        };
        kept.iter().step_by(step).map(point).collect()
    }

    pub(super) fn least_confidence(&self) -> f32 {
        let of_view = |view: &DepthMap| (0..view.depth.len()).filter_map(|i| view.confidence_at(i)).collect::<Vec<_>>();
        let mut all: Vec<f32> = self.views.iter().flat_map(of_view).filter(|confidence| !confidence.is_nan()).collect();
        if all.is_empty() {
            return CONFIDENT;
        }
        all.sort_by(f32::total_cmp);
        let [low, high] = SHARES.map(|fraction| all[(fraction * (all.len() - 1) as f64) as usize]);
        CONFIDENT.clamp(low, high)
    }
}

impl DepthMap {
    fn confidence_at(&self, pixel: usize) -> Option<f32> {
        let of_depth = self.confidence.as_ref().map(|confidence| confidence[pixel]);
        self.points.as_ref().map_or(of_depth, |points| Some(points[pixel][3]))
    }
}
