use crate::{
    Result,
    random::Random,
    stages::render::check_camera,
    types::{Camera, Image, preprocess::PixelMap, resample::resize_lanczos},
};

pub(super) struct View {
    pub photo: usize,
    pub size: [u32; 2],
    /// `[height][width][rgb]`.
    pub rgb: Vec<u8>,
    pub camera: Camera,
}

impl View {
    /// Downscales photo `i` to fit `most`, then divides its sides by `shrink`.
    pub fn new(i: usize, photo: &Image, camera: &Camera, most: Option<[u32; 2]>, shrink: u32) -> Result<Self> {
        photo.validate()?;
        check_camera(i, camera)?;
        let [width, height] = size(photo, most, shrink);
        let map = PixelMap::resized(photo, width, height);
        let camera = Camera { intrinsics: map.apply(&camera.intrinsics, &format!("camera {i}"))?, ..*camera };
        let rgb = resize_lanczos(photo, width, height)?.rgb;
        Ok(Self { photo: i, size: [width, height], rgb, camera })
    }

    pub fn values(&self) -> impl Iterator<Item = f32> {
        self.rgb.iter().map(|value| f32::from(*value) / 255.0)
    }
}

pub(super) fn size(photo: &Image, most: Option<[u32; 2]>, shrink: u32) -> [u32; 2] {
    let sides = [photo.width, photo.height];
    let fits = |[width, height]: [u32; 2]| {
        (f64::from(width) / f64::from(photo.width)).min(f64::from(height) / f64::from(photo.height))
    };
    let scale = most.map_or(1.0, fits).min(1.0) / f64::from(shrink);
    sides.map(|side| ((f64::from(side) * scale).round() as u32).max(1))
}

/// Splits `count` photos into evenly spaced held-out ones and training ones, returned as training,
/// held out.
pub(super) fn split(count: usize, held_out: usize) -> (Vec<usize>, Vec<usize>) {
    let holdout: Vec<usize> = (0..held_out).map(|i| (2 * i + 1) * count / (2 * held_out)).collect();
    ((0..count).filter(|i| !holdout.contains(i)).collect(), holdout)
}

/// Endless random order of numbers below `count`, each once per round.
pub(super) struct Order {
    count: usize,
    random: Random,
    left: Vec<usize>,
}

impl Order {
    pub fn new(count: usize, seed: u64) -> Self {
        Self { count, random: Random::new(seed), left: Vec::new() }
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
        let photo = Image { width: 600, height: 400, rgb: Vec::new() };
        assert_eq!(size(&photo, None, 1), [600, 400]);
        assert_eq!(size(&photo, Some([252, 252]), 1), [252, 168]);
        assert_eq!(size(&photo, Some([1600, 1600]), 2), [300, 200]);
    }
}
