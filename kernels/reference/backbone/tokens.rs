//! First tokens.

use crate::ops::add::add;

/// Adds `positions [1 + patches, width]` to class token and `patches [views, patches, width]`.
pub fn tokens(patches: &[f64], class: &[f64], positions: &[f64]) -> Vec<f64> {
    let views = patches.chunks(positions.len() - class.len());
    views.flat_map(|patches| add(&[class, patches].concat(), positions)).collect()
}
