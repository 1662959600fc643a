use crate::{
    gpu::{Recorder, Tensor},
    kernels::refine as kernels,
    ops::row_chunks,
};

/// Records opacities `[len]`: 0 for a random `fraction`, by the bits `key` `[1]`, the others scaled
/// to the same mean, against overfitting.
pub fn record_dropout(rec: &mut Recorder, opacities: Tensor, key: Tensor, fraction: f64, len: usize) -> Tensor {
    let shown = rec.tensor::<f32>("shown", len);
    let least = (fraction * f64::from(u32::MAX)) as u32;
    let factor = (1.0 / (1.0 - fraction)) as f32;
    for part in row_chunks(rec, len, &[size_of::<f32>()]) {
        let [opacities, shown] = [opacities, shown].map(|tensor| tensor.slice::<f32>(part.start, part.len()));
        let [count, first] = [part.len(), part.start].map(|number| number as u32);
        rec.dispatch(kernels::Dropout { opacities, key, shown, count, first, least, factor }, part.len());
    }
    shown
}
