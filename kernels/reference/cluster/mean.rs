/// Averages each cluster's `points [N, width]`; empty clusters are zero.
pub fn mean(points: &[f64], cluster_of_point: &[u32], clusters: usize, width: usize) -> Vec<f64> {
    let (mut sums, mut counts) = (vec![0.0; clusters * width], vec![0.0f64; clusters]);
    for (point, &cluster) in points.chunks(width).zip(cluster_of_point) {
        let sum = &mut sums[cluster as usize * width..][..width];
        sum.iter_mut().zip(point).for_each(|(sum, x)| *sum += x);
        counts[cluster as usize] += 1.0;
    }
    sums.iter().enumerate().map(|(i, sum)| sum / counts[i / width].max(1.0)).collect()
}
