use super::rounded::OWN;
use crate::table::counted;
use serde::Serialize;

#[derive(Clone, Debug, Default, Serialize)]
pub struct Point {
    pub views: usize,
    pub precision: String,
    pub weights: String,
    pub weight_bytes: u64,
    pub ratio: f64,
    /// As on the command line, including `auto`.
    #[serde(skip)]
    pub asked_ratio: String,
    /// `all` without any.
    pub token_selection: String,
    pub kv_pool: String,
    pub max_gaussians_per_token: usize,
    /// `0` for none.
    pub refine: String,
    /// Empty without refinement.
    pub init: String,
    pub tokens: usize,
    pub gaussians: usize,
    /// Photos to Gaussians, median.
    pub forward_ms: f64,
    pub refine_ms: f64,
    pub total_ms: f64,
    /// One picture, median.
    pub render_ms: f64,
    pub peak_bytes: u64,
    pub file_bytes: u64,
    pub psnr: f64,
    pub ssim: f64,
    /// Against `fp32` with equal settings; absent for `fp32`.
    pub psnr_to_fp32: Option<f64>,
    /// Against the f64 Gaussians of the same tokens; absent after refinement. f64 comparisons are
    /// absent if they would take too long.
    pub psnr_to_f64: Option<f64>,
    /// Relative rms deviations from f64 by stage, before pruning and refinement.
    pub error_backbone: Option<f64>,
    pub error_fuse: Option<f64>,
    pub error_means: Option<f64>,
    pub error_scales: Option<f64>,
    pub error_quats: Option<f64>,
    pub error_opacities: Option<f64>,
    pub error_sh_coeffs: Option<f64>,
    /// Mean over tokens; absent without k-means.
    pub views_per_cluster: Option<f64>,
    pub command: String,
}

impl Point {
    pub fn of_points(views: usize, precision: &str) -> Self {
        let words = |word: &str| word.to_owned();
        Self {
            views,
            precision: words(precision),
            weights: words(OWN),
            asked_ratio: words("points"),
            token_selection: words("none"),
            kv_pool: words("1"),
            ..Self::default()
        }
    }

    pub fn is_of_points(&self) -> bool {
        self.init == "points"
    }

    pub fn refinement(&self) -> String {
        match self.init.as_str() {
            "points" => format!("{} from points", self.refine),
            "both" => format!("{} with points", self.refine),
            _ => self.refine.clone(),
        }
    }

    pub fn origin(&self) -> String {
        let source = match self.init.as_str() {
            "points" => "points",
            "both" => "network and points",
            _ => "network",
        };
        if self.is_refined() { format!("{source}, refined") } else { source.into() }
    }

    pub fn is_refined(&self) -> bool {
        self.refine != "0"
    }

    pub fn arithmetic(&self) -> String {
        arithmetic(&self.precision, &self.weights)
    }

    pub fn settings(&self) -> String {
        let photos = counted(self.views, "photo");
        if self.is_of_points() {
            return format!("{photos}, {} steps of refinement from the capture's points", self.refine);
        }
        let chosen = match self.token_selection.as_str() {
            "all" => "every token".into(),
            select => format!("{:.0} % of the tokens by {select}", 100.0 * self.ratio),
        };
        let pooled = if self.kv_pool == "1" { String::new() } else { format!(", --kv-pool {}", self.kv_pool) };
        let refined = match self.refine.split_once(':') {
            _ if !self.is_refined() => String::new(),
            Some((steps, moved)) => format!(", {steps} steps of refinement of {moved}"),
            None if self.init == "both" => format!(", {} steps of refinement with the capture's points", self.refine),
            None => format!(", {} steps of refinement", self.refine),
        };
        format!(
            "{photos}, {}, {chosen}{pooled}, {} of a token's Gaussians{refined}",
            self.arithmetic(),
            self.max_gaussians_per_token
        )
    }
}

pub fn arithmetic(precision: &str, weights: &str) -> String {
    if weights == OWN { precision.into() } else { format!("{precision}, {weights} weights") }
}

/// Returns the Pareto front, by time.
pub fn front(points: &[Point]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|a, b| {
        let (a, b) = (&points[*a], &points[*b]);
        a.total_ms.total_cmp(&b.total_ms).then(b.psnr.total_cmp(&a.psnr))
    });
    let mut best = f64::NEG_INFINITY;
    order.retain(|i| {
        let better = points[*i].psnr > best;
        best = best.max(points[*i].psnr);
        better
    });
    order
}

/// Up to three points of the front: `best` by PSNR; `fast`, the fastest with half of its gain in
/// dB; `balanced`, farthest above their line in dB over log time.
pub fn recommended(points: &[Point]) -> Vec<(&'static str, usize)> {
    let front = front(points);
    let (Some(first), Some(best)) = (front.first(), front.last()) else { return Vec::new() };
    let half = 0.5 * (points[*first].psnr + points[*best].psnr);
    let Some(fast) = front.iter().find(|i| points[**i].psnr >= half) else { return Vec::new() };
    let place = |i: usize| (points[i].total_ms.ln(), points[i].psnr);
    let ((x0, y0), (x1, y1)) = (place(*fast), place(*best));
    let above = |i: usize| {
        let (x, y) = place(i);
        (y - y0) * (x1 - x0) - (x - x0) * (y1 - y0)
    };
    let between = front.iter().filter(|i| **i != *fast && **i != *best && points[**i].psnr > points[*fast].psnr);
    let balanced = between.copied().max_by(|a, b| above(*a).total_cmp(&above(*b)));
    let mut found = vec![("fast", *fast)];
    found.extend(balanced.map(|i| ("balanced", i)));
    found.extend((best != fast).then_some(("best", *best)));
    found
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn point(forward_ms: f64, psnr: f64) -> Point {
        Point {
            views: 4,
            precision: "fp32".into(),
            weights: OWN.into(),
            token_selection: "kmeans".into(),
            kv_pool: "1".into(),
            refine: "0".into(),
            forward_ms,
            total_ms: forward_ms,
            psnr,
            psnr_to_f64: Some(90.0),
            command: "zipsplat eval \"a b\" <&>".into(),
            ..Point::default()
        }
    }

    #[test]
    fn the_front_has_what_nothing_beats() {
        let points: Vec<Point> = [(3.0, 20.0), (1.0, 10.0), (2.0, 9.0), (2.5, 15.0), (4.0, 20.0), (1.0, 8.0)]
            .map(|(ms, psnr)| point(ms, psnr))
            .into();
        assert_eq!(front(&points), [1, 3, 0]);
        assert!(front(&[]).is_empty());
    }

    #[test]
    fn three_points_of_the_front_are_recommended() {
        // Half of 10 to 20 dB is reached at 17.
        let all = [(1.0, 10.0), (2.0, 14.0), (3.0, 13.0), (4.0, 17.0), (8.0, 19.5), (64.0, 20.0)];
        let points: Vec<Point> = all.map(|(ms, psnr)| point(ms, psnr)).into();
        assert_eq!(recommended(&points), [("fast", 3), ("balanced", 4), ("best", 5)]);
        assert_eq!(recommended(&points[..1]), [("fast", 0)]);
        assert_eq!(recommended(&points[..2]), [("fast", 1)]);
        assert!(recommended(&[]).is_empty());
    }

    #[test]
    fn the_table_has_a_row_a_point() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        crate::outputs::save_csv(file.path(), &[point(1.0, 2.0), point(3.0, 4.0)]).expect("written");
        let table = std::fs::read_to_string(file.path()).expect("a table");
        let lines: Vec<&str> = table.lines().collect();
        assert_eq!(lines.len(), 3);
        let columns = lines[0].split(',').count();
        assert!(lines[1..].iter().all(|line| line.split(',').count() == columns), "{table}");
        assert!(lines[1].ends_with("\"zipsplat eval \"\"a b\"\" <&>\""), "{table}");
    }
}
