//! Pictures of 8 bits a channel.

/// `[pixels]` red, green, blue, alpha as bytes, red or blue first: how many of 1/255, 2/255, … 1 a value reaches. The
/// product with 255 is rounded to f32, as whoever writes pictures to files does.
pub fn pack(frames: &[[f64; 4]], blue_first: bool) -> Vec<[u8; 4]> {
    let steps: Vec<f32> = (1..=255).map(|step| step as f32).collect();
    let byte = |value: f64| steps.partition_point(|step| *step <= (value * 255.0) as f32) as u8;
    let order = if blue_first { [2, 1, 0, 3] } else { [0, 1, 2, 3] };
    frames.iter().map(|pixel| order.map(|channel| byte(pixel[channel]))).collect()
}
