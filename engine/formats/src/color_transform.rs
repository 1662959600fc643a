use glam::{DMat4, DVec4};

/// Affine map of RGB colors: matrix and offset, by row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColorTransform(pub [[f32; 4]; 3]);

/// Weight of the identity in a fit, relative to the pixels' own.
const PRIOR: f64 = 1e-6;

impl ColorTransform {
    /// Changes no color.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    /// Returns the transformed `[pixels][rgb]`.
    pub fn apply(&self, colors: &[f32]) -> Vec<f32> {
        let value = |color: &[f32], [r, g, b, offset]: [f32; 4]| r * color[0] + g * color[1] + b * color[2] + offset;
        colors.chunks_exact(3).flat_map(|color| self.0.map(|row| value(color, row))).collect()
    }

    /// Returns the least-squares fit of `colors` to `targets`, both `[pixels][rgb]`.
    pub fn fit(colors: &[f32], targets: &[f32]) -> Self {
        let (mut moments, mut differences) = (DMat4::ZERO, [DVec4::ZERO; 3]);
        for (color, target) in colors.chunks_exact(3).zip(targets.chunks_exact(3)) {
            let [r, g, b] = [0, 1, 2].map(|k| f64::from(color[k]));
            let input = DVec4::new(r, g, b, 1.0);
            moments += DMat4::from_cols(r * input, g * input, b * input, input);
            for (k, difference) in differences.iter_mut().enumerate() {
                *difference += f64::from(target[k] - color[k]) * input;
            }
        }
        let pixels = (colors.len() / 3).max(1) as f64;
        let inverse = (moments + PRIOR * pixels * DMat4::IDENTITY).inverse();
        let row = |k: usize| {
            let change = (inverse * differences[k]).to_array();
            std::array::from_fn(|i| (f64::from(Self::IDENTITY.0[k][i]) + change[i]) as f32)
        };
        Self([row(0), row(1), row(2)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_recovers_the_transform() {
        let truth = ColorTransform([[1.3, 0.1, 0.0, -0.05], [0.0, 0.7, 0.05, 0.02], [0.1, 0.0, 0.9, 0.1]]);
        let colors: Vec<f32> = (0..300).map(|i| 0.5 + 0.5 * ((i * i) as f32 * 0.7).sin()).collect();
        let found = ColorTransform::fit(&colors, &truth.apply(&colors));
        for (found, truth) in found.0.as_flattened().iter().zip(truth.0.as_flattened()) {
            assert!((found - truth).abs() < 1e-3, "{found}, expected {truth}");
        }
        // One color leaves most of the map to the identity.
        let gray = ColorTransform::fit(&[0.5; 30], &[0.6; 30]);
        assert!(gray.apply(&[0.5; 3]).iter().all(|value| (value - 0.6).abs() < 1e-4), "{gray:?}");
        assert_eq!(ColorTransform::fit(&[], &[]), ColorTransform::IDENTITY);
    }
}
