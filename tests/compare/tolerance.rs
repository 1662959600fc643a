//! The table of tolerances.

use zipsplat::{gpu::Element, ops::Arithmetic};

/// The most that an array may deviate from truth; both are relative to the rms of the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// Largest deviation of one element.
    pub max: f64,
    /// Rms of all deviations.
    pub rms: f64,
}

/// Half a unit in the last place of 1: the most that one f32 rounding moves a value, relatively.
const F32_ROUNDING: f64 = f32::EPSILON as f64 / 2.0;

/// Taps of the network (digits and the compression prefix removed) and fields of Gaussians, in f32.
///
/// Each limit is about three times the worst deviation of the PyTorch implementation's own f32 run from its f64 run,
/// over all models and inputs. Few mistakes hide below: a wrong LayerNorm epsilon moves Gaussians by 3e-6 to 1e-5 (rms),
/// and moves the model `tiny_eps`, made to show it, by up to a hundred times that.
const F32: &[(&str, Tolerance)] = &[
    // |x| <= 1 times 588 weights; the position embedding's interpolation adds 1e-5 where weights are computed in f32.
    ("bb/tokens", Tolerance { max: 3e-5, rms: 4e-6 }),
    ("bb/block", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("bb/alt_in", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("bb/feat", Tolerance { max: 3e-5, rms: 3e-6 }),
    // A sequence of few views: less to accumulate.
    ("bb/cam_token", Tolerance { max: 1e-5, rms: 2e-6 }),
    ("prep/layer", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("color/tokens", Tolerance { max: 1e-5, rms: 1e-6 }),
    ("centroids", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("scene_init", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("ca_delta", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("scene_ca", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("scene_sa", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("color_feats", Tolerance { max: 1e-5, rms: 2e-6 }),
    ("raw", Tolerance { max: 3e-5, rms: 5e-6 }),
    // expm1 amplifies the deviation of a large raw coordinate by up to e^5.
    ("means", Tolerance { max: 1e-4, rms: 5e-6 }),
    ("scales", Tolerance { max: 3e-5, rms: 3e-6 }),
    // Division by the length amplifies where the raw quaternion is short.
    ("quats", Tolerance { max: 1e-4, rms: 5e-6 }),
    // The sigmoid's slope is at most 1/4.
    ("opacities", Tolerance { max: 1e-5, rms: 2e-6 }),
    ("sh_coeffs", Tolerance { max: 3e-5, rms: 5e-6 }),
];

impl Tolerance {
    /// Equal but for the rounding to f32 with which truth is stored: for references in f64. An element's rounding is
    /// relative to that element, which may be a dozen times the rms.
    pub const STORED: Tolerance = Tolerance { max: 1e-6, rms: 1e-7 };

    /// Taps of a network whose matrix products take rounded factors (f32 accumulation and residual stream), where its weights
    /// are f16 numbers. A rounding moves a factor by at most the unit roundoff, at random, so a product's rms by as much or
    /// less. What a block adds to the stream has passed about four such roundings in a row, sqrt(4) = 2 of them at random;
    /// the stream, being a sum of blocks, deviates no more, relatively. Single elements: 8 times that over millions, as in
    /// sums.
    pub fn tap_in(arithmetic: Arithmetic) -> Tolerance {
        let u = factor_rounding(arithmetic);
        Tolerance { max: 16.0 * u, rms: 2.0 * u }
    }

    /// Gaussians of such a network: the reference under autocast deviates by 8e-4 rms in f16 and by 7e-3 in bf16, so by about
    /// 2 unit roundoffs, and this is twice that. exp amplifies single elements as far as the range of their clamps.
    pub fn gaussians_in(arithmetic: Arithmetic) -> Tolerance {
        let u = factor_rounding(arithmetic);
        Tolerance { max: (200.0 * u).min(2.0), rms: 4.0 * u }
    }

    /// The tolerance of a golden's key such as `bb/block3` or `r0.5/ca1_delta`, in f32.
    ///
    /// # Panics
    /// When the table has no such tap.
    pub fn of_tap(key: &str) -> Tolerance {
        let tap = match key.split_once('/') {
            Some((prefix, tap)) if prefix.starts_with('r') && prefix.ends_with(|c: char| c.is_ascii_digit()) => tap,
            _ => key,
        };
        Tolerance::of_field(&tap.replace(|c: char| c.is_ascii_digit(), ""))
    }

    /// The tolerance of a field of activated Gaussians (`means`, `scales`, `quats`, `opacities`, `sh_coeffs`), in f32.
    ///
    /// # Panics
    /// When the table has no such field.
    pub fn of_field(field: &str) -> Tolerance {
        let entry = F32.iter().find(|(name, _)| *name == field);
        entry.unwrap_or_else(|| panic!("no tolerance for {field:?}")).1
    }

    /// The tolerance of a kernel that computes each element with a few f32 operations, `exp` and division among them,
    /// which Vulkan allows 3 ulp and more.
    pub const ELEMENTWISE: Tolerance = Tolerance { max: 2e-6, rms: 5e-7 };

    /// The tolerance of one exp of |x| <= 20 and a few operations more: Vulkan allows 3 + 2 |x| ulp for it.
    pub const EXPONENTIAL: Tolerance = Tolerance { max: 1e-5, rms: 1e-5 };

    /// The tolerance of a mean of f32 `terms` of one sign, relative to itself: partial sums grow by one rounding a
    /// doubling where lanes add side by side, and Vulkan's division is allowed 2.5 ulp.
    pub fn mean_of(terms: usize) -> Tolerance {
        let max = F32_ROUNDING * (5.0 + (terms.max(1) as f64).log2());
        Tolerance { max, rms: max / 2.0 }
    }

    /// The sum of this and another source of deviation together.
    pub fn and(self, other: Tolerance) -> Tolerance {
        Tolerance { max: self.max + other.max, rms: self.rms + other.rms }
    }

    /// The tolerance where the truth's rms is `factor` times smaller than that of what is summed.
    pub fn times(self, factor: f64) -> Tolerance {
        Tolerance { max: self.max * factor, rms: self.rms * factor }
    }

    /// The tolerance of f32 sums of `terms` products of comparable size: roundings walk at random, so that the sum
    /// moves by about sqrt(terms) of them; a factor of 8 covers the tail over millions of elements.
    pub fn sum_of(terms: usize) -> Tolerance {
        let walk = F32_ROUNDING * (terms.max(4) as f64).sqrt();
        Tolerance { max: 8.0 * walk, rms: 2.0 * walk }
    }

    /// The tolerance of sums that a GPU's matrix units make in so many steps: they may cut off rather than round, so that a
    /// sum that has grown as a random walk drifts by a third of an ulp a step.
    pub fn sum_cut_off(steps: usize) -> Tolerance {
        let drift = F32_ROUNDING * 2.0 / 3.0 * steps as f64;
        Tolerance { max: 4.0 * drift, rms: drift }
    }

    /// The tolerance of a result stored in this type.
    pub fn stored_in(self, element: Element) -> Tolerance {
        // Half a unit in the last place, relative to an element, which may be eight times the rms.
        let u = element.roundoff();
        if element == Element::F32 { self } else { self.and(Tolerance { max: 8.0 * u, rms: u }) }
    }

    /// The tolerance of the same sums where both factors are rounded to a type before they are multiplied: every term moves
    /// by up to 2 unit roundoffs, at random, so the sum by as much relative to its rms.
    pub fn sum_of_rounded(element: Element, terms: usize) -> Tolerance {
        let u = element.roundoff();
        Tolerance::sum_of(terms).and(Tolerance { max: 8.0 * u, rms: 2.0 * u })
    }
}

/// By how much the rounding of both factors moves a product at most, relative to its rms. In floats each moves it by less than
/// the unit roundoff, at random, so both by no more. The 8-bit integers of a row are spread evenly over its range, of which
/// its rms is about a quarter: half of 1/127 is then 4 times as much of it, at random 1/sqrt(3) of that, for both sqrt(2).
pub(super) fn factor_rounding(arithmetic: Arithmetic) -> f64 {
    match arithmetic.has_integers() {
        true => 4.0 * Element::I8.roundoff() * (2f64 / 3.0).sqrt(),
        false => arithmetic.element.roundoff(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn taps_are_found_by_their_golden_keys() {
        assert_eq!(Tolerance::of_tap("r0.5/ca1_delta"), Tolerance::of_field("ca_delta"));
        assert_eq!(Tolerance::of_tap("bb/block11"), Tolerance::of_field("bb/block"));
        assert_eq!(Tolerance::of_tap("r1/raw"), Tolerance::of_field("raw"));
        assert!(std::panic::catch_unwind(|| Tolerance::of_tap("bb/nothing")).is_err());
    }
}
