/// Views of equal size.
pub struct Images {
    /// `[views, 3, height, width]` in 0..1.
    pub values: Vec<f64>,
    pub views: usize,
    pub height: usize,
    pub width: usize,
}

impl Images {
    /// Converts bytes `[views, 3, height, width]`, divided by 255 in f32 like the network's input.
    pub fn from_u8(bytes: &[u8], shape: &[usize]) -> Images {
        let values = bytes.iter().map(|&byte| f64::from(f32::from(byte) / 255.0)).collect();
        Images { values, views: shape[0], height: shape[2], width: shape[3] }
    }

    /// Normalizes channels by ImageNet's means and deviations.
    pub fn normalized(&self) -> Images {
        let (means, deviations) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
        let [means, deviations] = [means, deviations].map(|values: [f32; 3]| values.map(f64::from));
        let channel = |i: usize| i / (self.height * self.width) % 3;
        let value = |(i, x): (usize, &f64)| (x - means[channel(i)]) / deviations[channel(i)];
        Images { values: self.values.iter().enumerate().map(value).collect(), ..*self }
    }

    pub fn grid(&self, patch: usize) -> [usize; 2] {
        [self.height / patch, self.width / patch]
    }
}

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
