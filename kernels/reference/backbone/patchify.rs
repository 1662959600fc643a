//! Patches.

use super::patch_embed::Images;

/// Cuts images into `[views, patches, 3 patch^2]`, channel-major.
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
