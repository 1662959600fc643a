/// Packs RGBA to bytes: color truncated, alpha rounded half to even.
pub fn pack(frames: &[[f64; 4]], blue_first: bool) -> Vec<[u8; 4]> {
    let steps: Vec<f32> = (1..=255).map(|step| step as f32).collect();
    let scaled = |value: f64| (value * 255.0) as f32;
    let color = |value: f64| steps.partition_point(|step| *step <= scaled(value)) as u8;
    let order = if blue_first { [2, 1, 0] } else { [0, 1, 2] };
    let pixel = |pixel: &[f64; 4]| {
        let [first, second, third] = order.map(|channel| color(pixel[channel]));
        [first, second, third, scaled(pixel[3]).round_ties_even() as u8] // casts saturate
    };
    frames.iter().map(pixel).collect()
}
