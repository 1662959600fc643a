use super::checkpoint::State;
use crate::{
    Result,
    random::Random,
    stages::render::check_camera,
    types::{Camera, ColorTransform, Image, preprocess::PixelMap},
};
use std::sync::Arc;

pub(super) struct View {
    pub photo: usize,
    pub size: [u32; 2],
    pub image: Arc<Image>,
    /// Target of the depth loss by pixel, 0 if unknown.
    pub depth: Option<Arc<[f32]>>,
    pub camera: Camera,
    pub exposure: ColorTransform,
}

impl View {
    pub fn values(&self) -> Vec<f32> {
        self.image.kept(&self.image.rgb).iter().map(|value| f32::from(*value) / 255.0).collect()
    }

    pub fn psnr(&self, drawn: &[f32]) -> f64 {
        let drawn = self.image.kept(drawn);
        let square = |(drawn, value): (&f32, f32)| f64::from(drawn.clamp(0.0, 1.0) - value).powi(2);
        let squares: f64 = drawn.iter().zip(self.values()).map(square).sum();
        -10.0 * (squares / drawn.len() as f64).max(1e-10).log10()
    }
}

/// Drops fully masked photos.
pub(super) fn unmasked(mut views: Vec<View>) -> Vec<View> {
    views.retain(|view| view.image.mask.as_ref().is_none_or(|mask| mask.iter().any(|kept| *kept != 0)));
    views
}

pub(super) fn resized(i: usize, camera: &Camera, from: [u32; 2], size: [u32; 2]) -> Result<Camera> {
    check_camera(i, camera)?;
    PixelMap::resized(from, size).camera(camera, &format!("camera {i}"))
}

/// Size of a photo within `most`, divided by `factor`.
pub(super) fn fitted(size: [u32; 2], most: Option<[u32; 2]>, factor: u32) -> [u32; 2] {
    let fits =
        |[width, height]: [u32; 2]| (f64::from(width) / f64::from(size[0])).min(f64::from(height) / f64::from(size[1]));
    let scale = most.map_or(1.0, fits).min(1.0) / f64::from(factor);
    size.map(|side| ((f64::from(side) * scale).round() as u32).max(1))
}

/// Splits `count` photos into training ones and evenly spaced held-out ones.
pub(super) fn split(count: usize, held_out: usize) -> (Vec<usize>, Vec<usize>) {
    let holdout: Vec<usize> = (0..held_out).map(|i| (2 * i + 1) * count / (2 * held_out)).collect();
    ((0..count).filter(|i| !holdout.contains(i)).collect(), holdout)
}

/// Endless random numbers below `count`, each once per round.
pub(super) struct Order {
    count: usize,
    random: Random,
    left: Vec<usize>,
}

impl Order {
    pub fn new(count: usize, seed: u64) -> Self {
        Self { count, random: Random::new(seed), left: Vec::new() }
    }

    pub fn state(&mut self, state: &mut State<'_>) -> Result<()> {
        state.fixed("order.random", std::slice::from_mut(self.random.state()))?;
        state.mapped("order.left", &mut self.left, |i| *i as u64, |i| i as usize)
    }

    pub fn next(&mut self) -> usize {
        if self.left.is_empty() {
            self.left = (0..self.count).collect();
        }
        let chosen = self.random.below(self.left.len());
        self.left.swap_remove(chosen)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_photo_comes_once_a_round() {
        let rounds = |seed| {
            let mut order = Order::new(7, seed);
            [(); 3].map(|()| (0..7).map(|_| order.next()).collect::<Vec<usize>>())
        };
        for mut round in rounds(1) {
            round.sort_unstable();
            assert_eq!(round, (0..7).collect::<Vec<_>>());
        }
        assert_eq!(rounds(1), rounds(1));
        assert_ne!(rounds(1), rounds(2));
    }

    #[test]
    fn held_out_photos_are_spread() {
        assert_eq!(split(9, 1), (vec![0, 1, 2, 3, 5, 6, 7, 8], vec![4]));
        assert_eq!(split(4, 2), (vec![0, 2], vec![1, 3]));
        assert_eq!(split(2, 0), (vec![0, 1], vec![]));
    }

    #[test]
    fn photos_keep_their_shape() {
        assert_eq!(fitted([600, 400], None, 1), [600, 400]);
        assert_eq!(fitted([600, 400], Some([252, 252]), 1), [252, 168]);
        assert_eq!(fitted([600, 400], Some([1600, 1600]), 2), [300, 200]);
    }
}
