/// Cuts an image `[height, width, channels]` into rows `[side, side, channels]`, one per output
/// pixel. `spread - 1` zeros separate pixels, `padding` surrounds them.
pub fn im2col(
    picture: &[f64],
    [width, channels]: [usize; 2],
    [side, step, padding, spread]: [usize; 4],
    [out_height, out_width]: [usize; 2],
) -> Vec<f64> {
    let height = picture.len() / (width * channels);
    let at = |y: usize, x: usize, c: usize| {
        let inside = |place: usize, length: usize| {
            let place = place.checked_sub(padding)?;
            (place.is_multiple_of(spread) && place / spread < length).then_some(place / spread)
        };
        Some(picture[(inside(y, height)? * width + inside(x, width)?) * channels + c])
    };
    let mut rows = Vec::new();
    for (y, x) in (0..out_height).flat_map(|y| (0..out_width).map(move |x| (y, x))) {
        for (down, across) in (0..side).flat_map(|down| (0..side).map(move |across| (down, across))) {
            rows.extend((0..channels).map(|c| at(y * step + down, x * step + across, c).unwrap_or(0.0)));
        }
    }
    rows
}
