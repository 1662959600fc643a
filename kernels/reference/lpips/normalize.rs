const SHIFT: [f64; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f64; 3] = [0.458, 0.448, 0.450];

/// Normalizes an image `[pixels, 3]` in 0..1.
pub fn normalize(picture: &[f64], clipped: bool) -> Vec<f64> {
    let value = |(i, &x): (usize, &f64)| {
        let x = if clipped { x.clamp(0.0, 1.0) } else { x };
        (2.0 * x - 1.0 - f64::from(SHIFT[i % 3] as f32)) / f64::from(SCALE[i % 3] as f32)
    };
    picture.iter().enumerate().map(value).collect()
}

pub fn normalize_backward(picture: &[f64], d: &[f64], clipped: bool) -> Vec<f64> {
    let value = |(i, &x): (usize, &f64)| {
        let inside = !clipped || (x > 0.0 && x < 1.0);
        if inside { 2.0 / f64::from(SCALE[i % 3] as f32) * d[i] } else { 0.0 }
    };
    picture.iter().enumerate().map(value).collect()
}
