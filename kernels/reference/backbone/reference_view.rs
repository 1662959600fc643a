/// Returns for each view of `tokens [views, width]`: mean similarity to others, length, variance of
/// normalized channels, and summed distance from the middles of their ranges.
pub fn scores(tokens: &[f64], width: usize) -> Vec<[f64; 4]> {
    let unit = |token: &[f64]| {
        let length = token.iter().map(|x| x * x).sum::<f64>().sqrt();
        (token.iter().map(|x| x / length).collect::<Vec<_>>(), length)
    };
    let units: Vec<(Vec<f64>, f64)> = tokens.chunks(width).map(unit).collect();
    let measures = |(token, length): &(Vec<f64>, f64)| {
        let like = |(other, _): &(Vec<f64>, f64)| token.iter().zip(other).map(|(a, b)| a * b).sum::<f64>();
        let mean = token.iter().sum::<f64>() / width as f64;
        let variance = token.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (width - 1) as f64;
        [(units.iter().map(like).sum::<f64>() - 1.0) / (units.len() - 1) as f64, *length, variance]
    };
    let measures: Vec<[f64; 3]> = units.iter().map(measures).collect();
    let range = |m: usize| {
        let values = || measures.iter().map(|view| view[m]);
        (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max))
    };
    let ranges = [0, 1, 2].map(range);
    let score = |view: &[f64; 3]| {
        let away = |m: usize| ((view[m] - ranges[m].0) / (ranges[m].1 - ranges[m].0 + 1e-8) - 0.5).abs();
        [view[0], view[1], view[2], away(0) + away(1) + away(2)]
    };
    measures.iter().map(score).collect()
}
