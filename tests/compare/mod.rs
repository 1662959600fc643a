//! Comparison with truth. Deviations are relative to the rms of the truth. NaN, infinity and
//! different lengths fail.

mod images;

use std::fmt;

use crate::golden::Golden;

pub use images::{ImageTolerance, Picture, assert_images_close};
pub use zipsplat_verify::Tolerance;

pub trait Float: Copy + Into<f64> {}
impl<T: Copy + Into<f64>> Float for T {}

#[derive(Clone, Copy, Debug)]
pub struct Deviation {
    /// Maximum of |got - truth| over the rms of the truth.
    pub max: f64,
    /// Rms of got - truth over the rms of the truth.
    pub rms: f64,
    pub worst: (usize, f64, f64),
    /// Rms of the truth, or 1 for zeros.
    pub scale: f64,
}

impl Deviation {
    pub fn measure(got: &[impl Float], truth: &[impl Float]) -> Result<Deviation, String> {
        if got.len() != truth.len() {
            return Err(format!("{} values, truth has {}", got.len(), truth.len()));
        }
        let mut worst = (0, 0.0, 0.0);
        let (mut max, mut sum_err2, mut sum_truth2) = (-1.0, 0.0, 0.0);
        for (i, (&got, &truth)) in got.iter().zip(truth).enumerate() {
            let (got, truth): (f64, f64) = (got.into(), truth.into());
            if !got.is_finite() || !truth.is_finite() {
                return Err(format!("[{i}] is {got}, truth is {truth}"));
            }
            let err = (got - truth).abs();
            if err > max {
                (max, worst) = (err, (i, got, truth));
            }
            sum_err2 += err * err;
            sum_truth2 += truth * truth;
        }
        let count = got.len().max(1) as f64;
        let scale = if sum_truth2 > 0.0 { (sum_truth2 / count).sqrt() } else { 1.0 };
        Ok(Deviation { max: max.max(0.0) / scale, rms: (sum_err2 / count).sqrt() / scale, worst, scale })
    }

    fn within(&self, tolerance: Tolerance) -> bool {
        self.max <= tolerance.max && self.rms <= tolerance.rms
    }
}

impl fmt::Display for Deviation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let (i, got, truth) = self.worst;
        write!(
            f,
            "max {:.2e} rms {:.2e} of {:.3e}, worst [{i}] {got:e}, truth {truth:e}",
            self.max, self.rms, self.scale
        )
    }
}

#[track_caller]
pub fn assert_close(name: &str, got: &[impl Float], truth: &[impl Float], tolerance: Tolerance) -> Deviation {
    match Deviation::measure(got, truth) {
        Ok(deviation) if deviation.within(tolerance) => deviation,
        Ok(deviation) => panic!("{name}: {deviation}; allowed max {:.1e} rms {:.1e}", tolerance.max, tolerance.rms),
        Err(problem) => panic!("{name}: {problem}"),
    }
}

#[track_caller]
pub fn assert_same<G, T>(name: &str, got: &[G], truth: &[T])
where
    G: Copy + PartialEq<T> + fmt::Debug,
    T: Copy + fmt::Debug,
{
    assert_eq!(got.len(), truth.len(), "{name}: number of values");
    let differing: Vec<usize> = (0..got.len()).filter(|&i| got[i] != truth[i]).collect();
    if let Some(&i) = differing.first() {
        panic!("{name}: {} of {} differ, first [{i}] {:?}, truth {:?}", differing.len(), got.len(), got[i], truth[i]);
    }
}

/// Takes the full tensor; the golden has it, or its `@sub` and `@sum`.
#[track_caller]
pub fn assert_tap_within(golden: &Golden, key: &str, got: &[impl Float], tolerance: Tolerance) -> Deviation {
    let name = format!("{} {key}", golden.file());
    if golden.has(key) {
        return assert_close(&name, got, &golden.f32(key), tolerance);
    }
    let sub_key = format!("{key}@sub");
    let sub_shape = golden.shape(&sub_key);
    // Network taps are subsampled along axis 1 (tokens), a scene's along axis 0.
    let views = if key.starts_with("bb/") || key.starts_with("prep/") { sub_shape[0] } else { 1 };
    let width = sub_shape[sub_shape.len() - 1];
    let step = golden.i64("sub_step")[0] as usize;
    let tokens = got.len() / views / width;
    let kept: Vec<f64> = (got.chunks_exact(width).enumerate())
        .filter(|(row, _)| (row % tokens).is_multiple_of(step))
        .flat_map(|(_, row)| row.iter().map(|&x| x.into()))
        .collect();
    assert_sums(&name, got, &golden.f64(&format!("{key}@sum")), tolerance);
    assert_close(&name, &kept, &golden.f32(&sub_key), tolerance)
}

/// [sum, sum |x|, sum x^2], within the Cauchy-Schwarz bound of `tolerance.rms`.
#[track_caller]
fn assert_sums(name: &str, got: &[impl Float], truth: &[f64], tolerance: Tolerance) {
    let values = || got.iter().map(|&x| -> f64 { x.into() });
    let sums = [values().sum::<f64>(), values().map(f64::abs).sum(), values().map(|x| x * x).sum()];
    let moved = tolerance.rms + f64::from(f32::EPSILON);
    let linear = moved * (got.len() as f64 * truth[2]).sqrt();
    for ((what, allowed), (got, truth)) in
        [("sum", linear), ("sum of |x|", linear), ("sum of squares", 2.0 * moved * truth[2])]
            .into_iter()
            .zip(sums.iter().zip(truth))
    {
        assert!((got - truth).abs() <= allowed, "{name}: {what} is {got}, truth {truth}, allowed +-{allowed:.1e}");
    }
}

const GAUSSIAN_FIELDS: [(&str, usize, usize); 4] =
    [("means", 0, 3), ("scales", 3, 6), ("quats", 6, 10), ("opacities", 10, 11)];

/// `[n, width]`, each field relative to its own rms.
#[track_caller]
pub fn assert_gaussians_close(name: &str, got: &[impl Float], truth: &[impl Float], width: usize) {
    assert_gaussians_within(name, got, truth, width, Tolerance::of_field);
}

#[track_caller]
pub fn assert_gaussians_within(
    name: &str,
    got: &[impl Float],
    truth: &[impl Float],
    width: usize,
    tolerance: impl Fn(&str) -> Tolerance,
) {
    for (field, start, end) in GAUSSIAN_FIELDS.into_iter().chain([("sh_coeffs", 11, width)]) {
        let got = columns(got, width, start, end);
        let truth = columns(truth, width, start, end);
        assert_close(&format!("{name} {field}"), &got, &truth, tolerance(field));
    }
}

pub fn columns(rows: &[impl Float], width: usize, start: usize, end: usize) -> Vec<f64> {
    rows.chunks(width).flat_map(|row| row[start..end].iter().map(|&x| x.into())).collect()
}

/// Relative difference of a tie; f32 rounding is 1e-6.
const TIE: f64 = 1e-4;

/// Each centroid's nearest token, or the second nearest in a tie.
///
/// `top2 [K, 2]` and `gap [K]` (relative) are `nearest_top2` and `nearest_gap`.
#[track_caller]
pub fn assert_nearest(name: &str, got: &[u32], top2: &[i64], gap: &[f32]) {
    assert_eq!((got.len() * 2, got.len()), (top2.len(), gap.len()), "{name}: number of clusters");
    for (k, &index) in got.iter().enumerate() {
        let [first, second] = [top2[2 * k], top2[2 * k + 1]];
        let index = i64::from(index);
        let tie = f64::from(gap[k]) < TIE && index == second;
        assert!(
            index == first || tie,
            "{name}: cluster {k} has {index}, nearest are {first}, {second}, gap {:e}",
            gap[k]
        );
    }
}

/// Representatives are as near to `centroids [K, width]` as any of `tokens [N, width]`.
#[track_caller]
pub fn assert_as_near(name: &str, got: &[u32], centroids: &[impl Float], tokens: &[impl Float], width: usize) {
    assert_eq!(got.len() * width, centroids.len(), "{name}: number of clusters");
    let (centroids, tokens) = (columns(centroids, width, 0, width), columns(tokens, width, 0, width));
    for (k, (&index, centroid)) in got.iter().zip(centroids.chunks(width)).enumerate() {
        let distance = |token: &[f64]| token.iter().zip(centroid).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        let distances: Vec<f64> = tokens.chunks(width).map(distance).collect();
        let nearest = distances.iter().copied().fold(f64::INFINITY, f64::min);
        let picked = distances[index as usize];
        assert!(picked - nearest <= TIE * picked, "{name}: cluster {k} has {index} at {picked:e}, nearest {nearest:e}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_but_finite_values_passes() {
        let loose = Tolerance { max: f64::INFINITY, rms: f64::INFINITY };
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(Deviation::measure(&[1.0, bad], &[1.0, 1.0]).is_err());
            assert!(Deviation::measure(&[1.0, 1.0], &[1.0, bad]).is_err());
            assert!(std::panic::catch_unwind(|| assert_close("x", &[bad], &[1.0], loose)).is_err());
        }
        assert!(Deviation::measure(&[1.0], &[1.0, 1.0]).is_err());
    }

    #[test]
    fn deviation_is_relative_to_the_rms() {
        let deviation = Deviation::measure(&[3.0, 4.0, 0.1], &[3.0, 4.0, 0.0]).unwrap();
        let rms = (25.0f64 / 3.0).sqrt();
        assert!((deviation.max - 0.1 / rms).abs() < 1e-12);
        assert!((deviation.rms - 0.1 / 5.0).abs() < 1e-12);
        assert_eq!(deviation.worst, (2, 0.1, 0.0));
        assert_eq!(Deviation::measure(&[0.5], &[0.0]).unwrap().max, 0.5);
        assert_eq!(Deviation::measure(&[0.0f32; 0], &[0.0f64; 0]).unwrap().max, 0.0);
    }

    #[test]
    fn a_wrong_gaussian_field_is_named() {
        let truth: Vec<f32> = (0..28).map(|i| i as f32 + 1.0).collect();
        let mut got = truth.clone();
        got[14 + 7] += 0.1;
        let caught = std::panic::catch_unwind(|| assert_gaussians_close("g", &got, &truth, 14)).unwrap_err();
        assert!(caught.downcast_ref::<String>().unwrap().starts_with("g quats: max"));
    }

    #[test]
    fn the_second_nearest_token_passes_only_in_a_tie() {
        let top2 = [4, 9, 2, 3];
        assert_nearest("k", &[9, 2], &top2, &[1e-6, 0.5]);
        assert!(std::panic::catch_unwind(|| assert_nearest("k", &[9, 3], &top2, &[1e-6, 0.5])).is_err());
        let tokens = [0.0, 2.0, 2.0, 5.0];
        assert_as_near("k", &[2, 0], &[1.0, 0.1], &tokens, 1);
        assert!(std::panic::catch_unwind(|| assert_as_near("k", &[3, 0], &[1.0, 0.1], &tokens, 1)).is_err());
    }
}
