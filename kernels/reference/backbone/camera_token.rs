//! Camera tokens among the tokens of their views.

/// Overwrites the first token of every view of `x [views, tokens, width]` by that view's row of `cameras [views, width]`.
pub fn insert_camera_tokens(x: &mut [f64], tokens: usize, cameras: &[f64], width: usize) {
    for (view, camera) in x.chunks_mut(tokens * width).zip(cameras.chunks(width)) {
        view[..width].copy_from_slice(camera);
    }
}

/// One row a view of the learned camera tokens `[2, width]`: the reference view's, and that of all others.
pub fn learned_camera_tokens(learned: &[f64], width: usize, views: usize, reference: usize) -> Vec<f64> {
    let (of_reference, of_others) = learned.split_at(width);
    (0..views).flat_map(|view| if view == reference { of_reference } else { of_others }).copied().collect()
}
