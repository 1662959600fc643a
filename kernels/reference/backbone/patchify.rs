//! Pictures cut into patches.

use super::patch_embed::Images;

/// `[views, patches row-major, 3 patch^2]`, channel-major, by sending every pixel to its patch.
pub fn patchify(images: &Images, patch: usize) -> Vec<f64> {
    let [rows, columns] = images.grid(patch);
    let mut patches = vec![f64::NAN; images.values.len()];
    for (i, &value) in images.values.iter().enumerate() {
        let (plane, y, x) = (i / images.width / images.height, i / images.width % images.height, i % images.width);
        let place = (plane / 3 * rows + y / patch) * columns + x / patch;
        patches[((place * 3 + plane % 3) * patch + y % patch) * patch + x % patch] = value;
    }
    patches
}
