use crate::kernels::limits::Q8_GROUP;
use half::f16;
use rayon::prelude::*;
use std::ops::RangeInclusive;

const GROUP: usize = Q8_GROUP as usize;

/// Integers with a scale per [`Q8_GROUP`], exact in f32.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Q8 {
    pub integers: Vec<i8>,
    pub scales: Vec<f16>,
}

impl Q8 {
    /// Nonzero scales that keep values normal in f16.
    pub const SCALES: RangeInclusive<f32> = 1.0 / 16384.0..=511.0;

    pub const GROUP: usize = GROUP;

    pub fn scales_of(values: usize) -> usize {
        values / GROUP
    }

    /// Whether rows are whole groups.
    pub fn fits(width: usize) -> bool {
        width.is_multiple_of(GROUP)
    }

    /// Rounds whole groups; `None` if a scale exceeds [`Q8::SCALES`].
    pub fn round(values: &[f32]) -> Option<Self> {
        let scale = |group: &[f32]| match group.iter().fold(0f32, |most, x| most.max(x.abs())) {
            0.0 => f16::ZERO,
            largest => no_less((largest / 127.0).max(*Self::SCALES.start())),
        };
        let scales: Vec<f16> = values.par_chunks(GROUP).map(scale).collect();
        let integer = |(i, x): (usize, &f32)| match scales[i / GROUP].to_f32() {
            0.0 => 0,
            scale => (x / scale).round_ties_even() as i8,
        };
        let integers = values.par_iter().enumerate().with_min_len(GROUP).map(integer).collect();
        scales.iter().all(|scale| scale.to_f32() <= *Self::SCALES.end()).then_some(Self { integers, scales })
    }

    /// Dequantizes into `out` of the same length.
    pub fn values(&self, out: &mut [f32]) {
        assert_eq!(out.len(), self.integers.len(), "values of {} integers", self.integers.len());
        let groups = self.integers.par_chunks(GROUP).zip(&self.scales);
        out.par_chunks_mut(GROUP).zip(groups).for_each(|(out, (integers, scale))| {
            out.iter_mut().zip(integers).for_each(|(out, &integer)| *out = f32::from(integer) * scale.to_f32());
        });
    }
}

/// Least f16 not below nonnegative `x`.
fn no_less(x: f32) -> f16 {
    let nearest = f16::from_f32(x);
    if nearest.to_f32() < x { f16::from_bits(nearest.to_bits() + 1) } else { nearest }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_by_half_a_scale_at_most() {
        for size in [1e-7, 1e-4, 0.03, 1.0, 6e4] {
            let values: Vec<f32> = (0..64).map(|i| size * ((i * 37 % 64) as f32 / 31.5 - 1.0)).collect();
            let (rounded, mut found) = (Q8::round(&values).expect("small values"), vec![0.0; 64]);
            rounded.values(&mut found);
            for (i, (x, found)) in values.iter().zip(&found).enumerate() {
                let scale = rounded.scales[i / GROUP].to_f32();
                assert!((x - found).abs() <= 0.5001 * scale, "{x}: {found}");
                assert!(126.0 * scale <= size || scale == *Q8::SCALES.start(), "{size}: {scale}");
            }
        }
    }

    #[test]
    fn zeros_stay_and_what_f16_cannot_hold_is_refused() {
        let mut values = [0.0; 64];
        values[40] = -2.0;
        let rounded = Q8::round(&values).expect("small values");
        assert_eq!((rounded.scales[0].to_f32(), rounded.integers[40]), (0.0, -127));
        values[3] = 7e4;
        assert_eq!(Q8::round(&values), None);
    }
}
