use super::codec::{MAX_FRACTIONAL_BITS, POSITION_BITS, fractional_bits};
use crate::Scene;

/// Returns a note if few distant Gaussians coarsen all positions of an SPZ.
pub fn spz_coarsening(scene: &Scene) -> Option<String> {
    let bits = fractional_bits(scene).ok().filter(|bits| *bits < MAX_FRACTIONAL_BITS)?;
    let reach = |mean: &[f32; 3]| mean.iter().fold(0f32, |reach, value| reach.max(value.abs()));
    let near = (1u32 << (POSITION_BITS - MAX_FRACTIONAL_BITS)) as f32;
    let far = scene.means.iter().filter(|mean| reach(mean) >= near).count();
    let farthest = scene.means.iter().map(reach).fold(0.0, f32::max);
    let step = |bits: u32| 0.5f64.powi(bits as i32);
    Some(format!(
        "positions in the SPZ are multiples of {:.2e}, not of {:.2e}: {far} of {} Gaussians lie beyond {near} units, the \
         farthest {farthest:.0} away",
        step(bits),
        step(MAX_FRACTIONAL_BITS),
        scene.len()
    ))
}
