use crate::{
    gpu::{Recorder, Tensor},
    kernels::refine as kernels,
    ops::row_chunks,
};

/// Records a step of each Gaussian's largest of three `scales` down to `ratio` times the middle
/// one, by at most `rate` in its logarithm.
///
/// The host writes [`Adam::schedule`](super::Adam::schedule) to `schedule`, whose rate scales
/// `rate`.
pub fn record_anisotropy_limit(
    rec: &mut Recorder,
    scales: Tensor,
    schedule: Tensor,
    ratio: f32,
    rate: f32,
    len: usize,
) {
    for part in row_chunks(rec, len, &[size_of::<[f32; 3]>()]) {
        let scales = scales.slice::<[f32; 3]>(part.start, part.len());
        rec.dispatch(kernels::Anisotropy { scales, schedule, count: part.len() as u32, ratio, rate }, part.len());
    }
}
