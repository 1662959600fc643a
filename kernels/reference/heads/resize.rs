/// Resizes `[height, width, channels]` bilinearly with aligned corners.
pub fn resize(picture: &[f64], [width, channels]: [usize; 2], [out_height, out_width]: [usize; 2]) -> Vec<f64> {
    let height = picture.len() / (width * channels);
    // A hat of width 1 around each source pixel.
    let weights = |inputs: usize, outputs: usize, at: usize| {
        let place = if outputs > 1 { (at * (inputs - 1)) as f64 / (outputs - 1) as f64 } else { 0.0 };
        (0..inputs).map(|i| (1.0 - (place - i as f64).abs()).max(0.0)).collect::<Vec<_>>()
    };
    let mut out = Vec::new();
    for y in 0..out_height {
        let ys = weights(height, out_height, y);
        for x in 0..out_width {
            let xs = weights(width, out_width, x);
            out.extend((0..channels).map(|c| {
                let line = |(i, wy): (usize, &f64)| {
                    let pixels = xs.iter().enumerate();
                    wy * pixels.map(|(j, wx)| wx * picture[(i * width + j) * channels + c]).sum::<f64>()
                };
                ys.iter().enumerate().map(line).sum::<f64>()
            }));
        }
    }
    out
}

/// Returns the position embedding `[height, width, channels]` of an image with this aspect ratio:
/// sines and cosines of x, then y.
pub fn positions(aspect: f64, [height, width, channels]: [usize; 3]) -> Vec<f64> {
    let diagonal = (aspect * aspect + 1.0).sqrt();
    let quarter = channels / 4;
    let place = |at: usize, count: usize, half: f64| {
        let last = half * (count as f64 - 1.0) / count as f64;
        if count > 1 { -last + 2.0 * last * at as f64 / (count as f64 - 1.0) } else { 0.0 }
    };
    let mut out = Vec::new();
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        for place in [place(x, width, aspect / diagonal), place(y, height, 1.0 / diagonal)] {
            let angle = |k: usize| place * 100f64.powf(-(k as f64) / quarter as f64);
            out.extend((0..quarter).map(|k| 0.1 * angle(k).sin()));
            out.extend((0..quarter).map(|k| 0.1 * angle(k).cos()));
        }
    }
    out
}
