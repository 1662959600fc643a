//! Exposure of a photo: an affine map of a frame's colors.

/// Maps a frame `[pixels, 3]` by `transform` `[3, 4]`. Values beyond the white or black of a
/// saturated target become that.
pub fn exposed(frame: &[f64], targets: &[f64], transform: &[f64]) -> Vec<f64> {
    let all = mapped(frame, transform).into_iter().zip(targets);
    all.map(|(value, target)| if is_hidden(value, *target) { *target } else { value }).collect()
}

/// Returns the gradients by the frame and by the transform, from that by the exposed frame.
pub fn exposure_backward(frame: &[f64], targets: &[f64], transform: &[f64], gradient: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut d_frame, mut d_transform) = (vec![0.0; frame.len()], vec![0.0; 12]);
    for (i, value) in mapped(frame, transform).into_iter().enumerate() {
        if is_hidden(value, targets[i]) {
            continue;
        }
        let (pixel, row) = (i / 3 * 3, i % 3 * 4);
        for k in 0..3 {
            d_frame[pixel + k] += gradient[i] * transform[row + k];
            d_transform[row + k] += gradient[i] * frame[pixel + k];
        }
        d_transform[row + 3] += gradient[i];
    }
    (d_frame, d_transform)
}

fn mapped(frame: &[f64], transform: &[f64]) -> Vec<f64> {
    let value = |color: &[f64], row: &[f64]| row[0] * color[0] + row[1] * color[1] + row[2] * color[2] + row[3];
    frame.chunks(3).flat_map(|color| transform.chunks(4).map(move |row| value(color, row))).collect()
}

fn is_hidden(value: f64, target: f64) -> bool {
    target >= 1.0 && value > 1.0 || target <= 0.0 && value < 0.0
}
