use crate::ops::{im2col::im2col, linear::linear};

/// Convolves `[height, width, channels]` with `weight [outputs, channels, side, side]`,
/// zero-padded.
pub fn convolution(
    picture: &[f64],
    [width, channels]: [usize; 2],
    [side, step]: [usize; 2],
    weight: &[f32],
    bias: &[f32],
) -> Vec<f64> {
    let padding = side / 2;
    let size = [picture.len() / (width * channels), width].map(|length| (length + 2 * padding - side) / step + 1);
    let rows = im2col(picture, [width, channels], [side, step, padding, 1], size);
    let taps = side * side;
    let turned =
        |output: &[f32]| (0..output.len()).map(|i| output[i % channels * taps + i / channels]).collect::<Vec<_>>();
    let weight: Vec<f32> = weight.chunks(taps * channels).flat_map(turned).collect();
    linear(&rows, &weight, bias)
}
