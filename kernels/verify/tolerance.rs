use zipsplat::{gpu::Element, ops::Arithmetic};

/// Limits on an array's deviation, relative to the truth's rms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// Largest deviation of one element.
    pub max: f64,
    pub rms: f64,
}

/// Half an ulp of 1.
const F32_ROUNDING: f64 = f32::EPSILON as f64 / 2.0;

/// Network taps (without digits and compression prefix) and fields of Gaussians, in f32: about
/// three times PyTorch's worst deviation.
const F32: &[(&str, Tolerance)] = &[
    // |x| <= 1 times 588 weights; interpolating the position embedding in f32 adds 1e-5.
    ("bb/tokens", Tolerance { max: 3e-5, rms: 4e-6 }),
    ("bb/block", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("bb/alt_in", Tolerance { max: 3e-5, rms: 3e-6 }),
    ("bb/feat", Tolerance { max: 3e-5, rms: 3e-6 }),
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
    // expm1 amplifies a large raw coordinate by up to e^5.
    ("means", Tolerance { max: 1e-4, rms: 5e-6 }),
    ("scales", Tolerance { max: 3e-5, rms: 3e-6 }),
    // Normalizing a short raw quaternion amplifies.
    ("quats", Tolerance { max: 1e-4, rms: 5e-6 }),
    // The sigmoid's slope is at most 1/4.
    ("opacities", Tolerance { max: 1e-5, rms: 2e-6 }),
    ("sh_coeffs", Tolerance { max: 3e-5, rms: 5e-6 }),
];

impl Tolerance {
    pub const ANY: Tolerance = Tolerance { max: f64::INFINITY, rms: f64::INFINITY };

    pub const fn rms(rms: f64) -> Tolerance {
        Tolerance { max: f64::INFINITY, rms }
    }

    pub(crate) fn between(got: &[f32], truth: &[f64]) -> Tolerance {
        let squares = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
        let errors = || got.iter().zip(truth).map(|(got, truth)| (f64::from(*got) - truth).abs());
        let length = squares(&mut truth.iter().copied());
        let count = (truth.len().max(1) as f64).sqrt();
        let length = if length > 0.0 { length } else { count };
        Tolerance { max: errors().fold(0.0, f64::max) * count / length, rms: squares(&mut errors()) / length }
    }

    /// f64 references against truth stored in f32, where an element may be a dozen times the rms.
    pub const STORED: Tolerance = Tolerance { max: 1e-6, rms: 1e-7 };

    /// Taps with rounded factors and f16 weights. A block has about four roundings in a row, at
    /// random sqrt(4) = 2; the maximum over millions of elements is 8 times that.
    pub fn tap_in(arithmetic: Arithmetic) -> Tolerance {
        let u = Self::factor_rounding(arithmetic);
        Tolerance { max: 16.0 * u, rms: 2.0 * u }
    }

    /// Returns the tolerance of such Gaussians: twice the reference's under autocast.
    pub fn gaussians_in(arithmetic: Arithmetic) -> Tolerance {
        let u = Self::factor_rounding(arithmetic);
        Tolerance { max: (200.0 * u).min(2.0), rms: 4.0 * u }
    }

    /// f32 tolerance of a key such as `bb/block3` or `r0.5/ca1_delta`.
    pub fn of_tap(key: &str) -> Tolerance {
        let tap = match key.split_once('/') {
            Some((prefix, tap)) if prefix.starts_with('r') && prefix.ends_with(|c: char| c.is_ascii_digit()) => tap,
            _ => key,
        };
        Tolerance::of_field(&tap.replace(|c: char| c.is_ascii_digit(), ""))
    }

    /// f32 tolerance of an activated field.
    pub fn of_field(field: &str) -> Tolerance {
        let entry = F32.iter().find(|(name, _)| *name == field);
        entry.unwrap_or_else(|| panic!("no tolerance for {field:?}")).1
    }

    /// A few f32 operations, with `exp` and division: Vulkan allows 3 ulp and more.
    pub const ELEMENTWISE: Tolerance = Tolerance { max: 2e-6, rms: 5e-7 };

    /// One exp of |x| <= 20: Vulkan allows 3 + 2 |x| ulp.
    pub const EXPONENTIAL: Tolerance = Tolerance { max: 1e-5, rms: 1e-5 };

    /// A mean of f32 `terms` of one sign: a rounding per doubling, 2.5 ulp for the division.
    pub fn mean_of(terms: usize) -> Tolerance {
        let max = F32_ROUNDING * (5.0 + (terms.max(1) as f64).log2());
        Tolerance { max, rms: max / 2.0 }
    }

    /// Adds an independent source of deviation.
    pub fn and(self, other: Tolerance) -> Tolerance {
        Tolerance { max: self.max + other.max, rms: self.rms + other.rms }
    }

    /// Scales for an rms `factor` times smaller than the summands'.
    pub fn times(self, factor: f64) -> Tolerance {
        Tolerance { max: self.max * factor, rms: self.rms * factor }
    }

    /// Sums of comparable f32 products: sqrt(terms) roundings, times 8 for the tail.
    pub fn sum_of(terms: usize) -> Tolerance {
        let walk = F32_ROUNDING * (terms.max(4) as f64).sqrt();
        Tolerance { max: 8.0 * walk, rms: 2.0 * walk }
    }

    /// Sums of matrix units in `steps`: truncation drifts by a third of an ulp per step.
    pub fn sum_cut_off(steps: usize) -> Tolerance {
        let drift = F32_ROUNDING * 2.0 / 3.0 * steps as f64;
        Tolerance { max: 4.0 * drift, rms: drift }
    }

    /// Adds the rounding to this type.
    pub fn stored_in(self, element: Element) -> Tolerance {
        let u = element.roundoff();
        if element == Element::F32 { self } else { self.and(Tolerance { max: 8.0 * u, rms: u }) }
    }

    /// Sums of rounded factors: each term moves by up to 2 unit roundoffs at random.
    pub fn sum_of_rounded(element: Element, terms: usize) -> Tolerance {
        let u = element.roundoff();
        Tolerance::sum_of(terms).and(Tolerance { max: 8.0 * u, rms: 2.0 * u })
    }

    /// Bounds a product's deviation from the rounding of both factors, relative to its rms.
    ///
    /// A row of 8-bit integers is uniform with an rms of about a quarter of its range: half of
    /// 1/127 is 4 times as much, 1/sqrt(3) at random, times sqrt(2) for both.
    pub fn factor_rounding(arithmetic: Arithmetic) -> f64 {
        if arithmetic.has_integers() {
            4.0 * Element::I8.roundoff() * (2f64 / 3.0).sqrt()
        } else {
            arithmetic.element.roundoff()
        }
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
