//! Loss of rendered depth: the mean difference of inverse depth.

/// Numbers of a pixel of frames: RGB, alpha, expected depth.
pub const CHANNELS: usize = 5;

/// Known target and inverse rendered depth, if the pixel has both.
fn pair(pixel: &[f64], target: f64) -> Option<[f64; 2]> {
    (target > 0.0 && pixel[3] >= 0.5 && pixel[4] > 0.0).then(|| [target, 1.0 / pixel[4]])
}

/// Returns slope and offset of the least squares line from targets to inverse depth, if it rises.
pub fn line(frames: &[f64], targets: &[f64]) -> Option<[f64; 2]> {
    let pairs: Vec<[f64; 2]> = frames.chunks(CHANNELS).zip(targets).filter_map(|(p, t)| pair(p, *t)).collect();
    let mean = |of: &dyn Fn(&[f64; 2]) -> f64| pairs.iter().map(of).sum::<f64>() / pairs.len() as f64;
    let [t, y] = [mean(&|pair| pair[0]), mean(&|pair| pair[1])];
    let spread = mean(&|pair| (pair[0] - t).powi(2));
    let slope = mean(&|pair| (pair[0] - t) * (pair[1] - y)) / spread;
    (spread > 1e-5 * mean(&|pair| pair[0].powi(2)) && slope > 0.0).then_some([slope, y - slope * t])
}

/// Returns the loss of `frames` `[pixels, 5]` and its gradient by depth `[pixels]`, for a line.
pub fn depth_loss(frames: &[f64], targets: &[f64], line: Option<[f64; 2]>) -> (f64, Vec<f64>) {
    let mut gradient = vec![0.0; targets.len()];
    let Some([slope, offset]) = line else { return (0.0, gradient) };
    let pairs: Vec<_> = frames.chunks(CHANNELS).zip(targets).map(|(p, t)| pair(p, *t)).collect();
    let (mut sum, count) = (0.0, pairs.iter().flatten().count() as f64);
    for (i, [t, y]) in pairs.iter().enumerate().filter_map(|(i, pair)| Some((i, (*pair)?))) {
        let off = y - (slope * t + offset);
        sum += off.abs() / count;
        gradient[i] = if off == 0.0 { 0.0 } else { -off.signum() * y * y / count };
    }
    (sum, gradient)
}
