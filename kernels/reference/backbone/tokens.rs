//! The first tokens of every view.

use crate::ops::add::add;

/// Class token, then patches, of every view, with `positions [1 + patches, width]` added.
///
/// `patches [views, patches, width]`, `class [width]`; gives `[views, 1 + patches, width]`.
pub fn tokens(patches: &[f64], class: &[f64], positions: &[f64]) -> Vec<f64> {
    let views = patches.chunks(positions.len() - class.len());
    views.flat_map(|patches| add(&[class, patches].concat(), positions)).collect()
}
