/// Reshapes `[height, width, side * side, channels]` to `[height * side, width * side, channels]`
/// and adds `bias`.
pub fn pixel_shuffle(values: &[f64], [width, side]: [usize; 2], bias: &[f32]) -> Vec<f64> {
    let (channels, out_width) = (bias.len(), width * side);
    let mut out = vec![f64::NAN; values.len()];
    for (i, value) in values.chunks(channels).enumerate() {
        let (pixel, tap) = (i / (side * side), i % (side * side));
        let (y, x) = (pixel / width * side + tap / side, pixel % width * side + tap % side);
        let target = &mut out[(y * out_width + x) * channels..][..channels];
        target.iter_mut().zip(value).zip(bias).for_each(|((out, x), &bias)| *out = x + f64::from(bias));
    }
    out
}

/// Applies `weight [inputs, outputs, side, side]` with stride `side`.
pub fn transposed_convolution(picture: &[f64], [width, side]: [usize; 2], [weight, bias]: [&[f32]; 2]) -> Vec<f64> {
    let (outputs, taps) = (bias.len(), side * side);
    let inputs = weight.len() / (outputs * taps);
    let value = |pixel: &[f64], tap: usize, output: usize| {
        let products =
            pixel.iter().enumerate().map(|(k, x)| x * f64::from(weight[(k * outputs + output) * taps + tap]));
        products.sum::<f64>()
    };
    let spread = picture
        .chunks(inputs)
        .flat_map(|pixel| (0..taps).flat_map(move |tap| (0..outputs).map(move |output| value(pixel, tap, output))));
    pixel_shuffle(&spread.collect::<Vec<_>>(), [width, side], bias)
}
