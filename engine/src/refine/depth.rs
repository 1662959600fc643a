use crate::{Error, Result, stages::depth_loss::DepthKind};
use std::sync::Arc;

/// Returns the targets of photo `i`: inverse depth, or 0 if unknown, at a size and outside its
/// mask. Samples the nearest depth: means across edges are at no surface. Relative inverse depth
/// becomes 1 plus its ratio to the mean, for the fit's sums.
///
/// [`Error::Argument`] for depth of another size, negative or not finite.
pub(super) fn targets(
    i: usize,
    depth: &[f32],
    from: [u32; 2],
    to: [u32; 2],
    mask: Option<&[u8]>,
    kind: DepthKind,
) -> Result<Arc<[f32]>> {
    let [[from_width, from_height], [width, height]] = [from, to].map(|size| size.map(|side| side as usize));
    if depth.len() != from_width * from_height {
        let expected = format!("{from_width} x {from_height}, one for each pixel");
        return Err(Error::argument(format!("depth of photo {i}"), format!("{} values", depth.len()), expected));
    }
    if let Some(wrong) = depth.iter().find(|depth| !(depth.is_finite() && **depth >= 0.0)) {
        return Err(Error::argument(format!("depth of photo {i}"), wrong, "distances, or 0 if unknown"));
    }
    let place = |at: usize, size: usize, from: usize| (2 * at + 1) * from / (2 * size);
    let target = |pixel: usize| {
        let [x, y] = [place(pixel % width, width, from_width), place(pixel / width, height, from_height)];
        let is_hidden = mask.is_some_and(|mask| mask[pixel] == 0);
        let inverse = 1.0 / depth[y * from_width + x];
        if is_hidden || !inverse.is_finite() { 0.0 } else { inverse }
    };
    let mut targets: Vec<f32> = (0..width * height).map(target).collect();
    if kind == DepthKind::Relative {
        let (mut sum, mut count) = (0.0, 0);
        targets.iter().filter(|target| **target > 0.0).for_each(|target| {
            sum += f64::from(*target);
            count += 1;
        });
        let known = targets.iter_mut().filter(|target| **target > 0.0);
        known.for_each(|target| *target = (1.0 + f64::from(*target) * f64::from(count) / sum) as f32);
    }
    Ok(targets.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_depth_of_visible_pixels_counts() {
        let depth: Vec<f32> = (0..8).map(|i| if i == 6 { 0.0 } else { (1 << i) as f32 }).collect();
        let found = |to, mask, kind| targets(3, &depth, [4, 2], to, mask, kind).expect("targets").to_vec();
        let whole = [1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125, 0.0, 0.0078125];
        assert_eq!(found([4, 2], None, DepthKind::Metric), whole);
        assert_eq!(found([2, 1], None, DepthKind::Metric), [0.03125, 0.0078125]);
        let mask = [0, 1, 1, 0];
        assert_eq!(found([2, 2], Some(&mask), DepthKind::Metric), [0.0, 0.125, 0.03125, 0.0]);
        let relative = found([2, 2], Some(&mask), DepthKind::Relative);
        assert_eq!(relative, [0.0, 2.6, 1.4, 0.0]);
    }

    #[test]
    fn unusable_depth_is_named() {
        let refused = |depth: &[f32]| {
            let error = targets(3, depth, [2, 1], [2, 1], None, DepthKind::Metric).expect_err("an error");
            error.to_string()
        };
        assert!(refused(&[1.0]).contains("depth of photo 3") && refused(&[1.0]).contains("2 x 1"));
        for wrong in [f32::NAN, f32::INFINITY, -1.0] {
            assert!(refused(&[1.0, wrong]).contains(&wrong.to_string()), "{wrong}");
        }
    }
}
