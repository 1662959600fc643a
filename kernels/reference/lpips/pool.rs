/// Takes the maximum of `side` x `side` windows at every `step` of `[height, width, channels]`.
pub fn pool(picture: &[f64], [width, channels]: [usize; 2], side: usize, step: usize) -> Vec<f64> {
    places(picture, [width, channels], side, step).into_iter().map(|place| picture[place]).collect()
}

/// Propagates gradients of [`pool`] to the first of equal values.
pub fn pool_backward(picture: &[f64], shape: [usize; 2], side: usize, step: usize, d: &[f64]) -> Vec<f64> {
    let mut gradient = vec![0.0; picture.len()];
    places(picture, shape, side, step).into_iter().zip(d).for_each(|(place, d)| gradient[place] += d);
    gradient
}

fn places(picture: &[f64], [width, channels]: [usize; 2], side: usize, step: usize) -> Vec<usize> {
    let height = picture.len() / (width * channels);
    let corners = |length: usize| (0..=length - side).step_by(step);
    let mut found = Vec::new();
    for (y, x) in corners(height).flat_map(|y| corners(width).map(move |x| (y, x))) {
        for c in 0..channels {
            let window = (0..side * side).map(|tap| ((y + tap / side) * width + x + tap % side) * channels + c);
            found.extend(window.reduce(|best, place| if picture[place] > picture[best] { place } else { best }));
        }
    }
    found
}
