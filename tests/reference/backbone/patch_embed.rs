//! Pictures to patch tokens: a convolution whose stride is its size.

/// Views of one size, `values [views, 3, height, width]` in [0, 1].
pub struct Images {
    /// Channel-major values of all views.
    pub values: Vec<f64>,
    /// Number of views.
    pub views: usize,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
}

impl Images {
    /// From bytes `[views, 3, height, width]`; divided by 255 in f32, as the network's input is.
    pub fn from_u8(bytes: &[u8], shape: &[usize]) -> Images {
        let values = bytes.iter().map(|&byte| f64::from(f32::from(byte) / 255.0)).collect();
        Images { values, views: shape[0], height: shape[2], width: shape[3] }
    }

    /// Rows and columns of patches of a view.
    pub fn grid(&self, patch: usize) -> [usize; 2] {
        [self.height / patch, self.width / patch]
    }
}

/// `weight [outputs, 3, patch, patch]`; gives `[views, patches row-major, outputs]`.
pub fn patch_embed(images: &Images, weight: &[f32], bias: &[f32], patch: usize) -> Vec<f64> {
    let [rows, columns] = images.grid(patch);
    let pixel = |view: usize, channel: usize, y: usize, x: usize| {
        images.values[((view * 3 + channel) * images.height + y) * images.width + x]
    };
    let mut tokens = Vec::with_capacity(images.views * rows * columns * bias.len());
    for view in 0..images.views {
        for place in 0..rows * columns {
            let [top, left] = [place / columns * patch, place % columns * patch];
            for (output, &offset) in bias.iter().enumerate() {
                let mut sum = f64::from(offset);
                for (i, &w) in weight[output * 3 * patch * patch..][..3 * patch * patch].iter().enumerate() {
                    let [channel, y, x] = [i / (patch * patch), i / patch % patch, i % patch];
                    sum += f64::from(w) * pixel(view, channel, top + y, left + x);
                }
                tokens.push(sum);
            }
        }
    }
    tokens
}
