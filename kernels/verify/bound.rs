//! f32 error bounds from the unit roundoff and Vulkan's precision limits ("Precision and Operation
//! of SPIR-V Instructions"): additions and multiplications are correctly rounded. A device may
//! flush subnormals and fuse multiply-adds.

use crate::Tolerance;
use serde::Serialize;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// Unit roundoff.
pub const U: f64 = f32::EPSILON as f64 / 2.0;
pub const ULP: f64 = f32::EPSILON as f64;
pub const TINY: f64 = f32::MIN_POSITIVE as f64;
/// Vulkan's relative limit for divisions.
pub const DIVISION: f64 = 2.5 * ULP;
/// Vulkan's relative limit for sqrt, as 1 / inversesqrt.
pub const ROOT: f64 = 4.5 * ULP;

/// Returns the relative error bound of `n` roundings, `n u / (1 - n u)`, and of a sum of `n` terms
/// in any order, relative to their magnitudes (Higham, Accuracy and Stability of Numerical
/// Algorithms, lemma 3.1 and section 4.2).
pub fn gamma(n: usize) -> f64 {
    let nu = n as f64 * U;
    if nu < 1.0 { nu / (1.0 - nu) } else { f64::INFINITY }
}

/// Most additions per term when 4 to 128 lanes sum `n` terms.
pub fn by_lanes(n: usize) -> usize {
    n.min((n.div_ceil(4) + 4).max(n.div_ceil(128) + 128))
}

/// Rounds to f16's 11 bits; infinite beyond its range.
pub fn half(x: f64) -> f64 {
    let rounded = f64::from(f32::from_bits(((x as f32).to_bits() + 0x1000) & !0x1fff));
    if rounded.abs() > 65504.0 { rounded * f64::INFINITY } else { rounded }
}

/// Vulkan's relative limit for exp(x) and exp2(x).
pub fn exponential(x: f64) -> f64 {
    (3.0 + 2.0 * x.abs()) * ULP
}

/// Vulkan's absolute limit for log(x).
pub fn logarithm(x: f64) -> f64 {
    if (0.5..=2.0).contains(&x) { (-21f64).exp2() } else { 3.0 * ULP * x.ln().abs() }
}

/// Element with the largest error over its bound.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Worst {
    /// Distance from the truth, or number of differing elements; infinite for NaN.
    pub error: f64,
    pub bound: f64,
    /// Error over bound; above 1 is wrong.
    pub share: f64,
    /// Deviation of all elements, relative to the truth's rms.
    #[serde(skip)]
    pub deviation: Tolerance,
    /// Deviation over the allowance, at most 1 if as expected.
    #[serde(skip)]
    pub typical: f64,
}

impl Worst {
    pub const NONE: Self = Self::new(0.0, 0.0, 0.0);

    pub const UNKNOWN: Self = Self::new(f64::INFINITY, f64::INFINITY, f64::INFINITY);

    const fn new(error: f64, bound: f64, share: f64) -> Self {
        Self { error, bound, share, deviation: Tolerance { max: 0.0, rms: 0.0 }, typical: 0.0 }
    }

    /// Non-finite values are wrong.
    pub fn one(got: f64, truth: f64, bound: f64) -> Self {
        let error = if got.is_finite() { (got - truth).abs() } else { f64::INFINITY };
        let share = match error {
            0.0 => 0.0,
            _ if !(error.is_finite() && bound > 0.0) => f64::INFINITY,
            _ => error / bound,
        };
        Self::new(error, bound, share)
    }

    pub fn of(got: &[f32], truth: &[f64], bound: impl Fn(usize) -> f64) -> Self {
        assert_eq!(got.len(), truth.len(), "as many results as truths");
        let one = |i: usize| Self::one(got[i].into(), truth[i], bound(i));
        let worst = (0..got.len()).map(one).fold(Self::NONE, Self::or);
        Self { deviation: Tolerance::between(got, truth), ..worst }
    }

    /// Counts differing elements, with bound 0.
    pub fn differing<T: PartialEq>(got: &[T], truth: &[T]) -> Self {
        assert_eq!(got.len(), truth.len(), "as many results as truths");
        Self::one(got.iter().zip(truth).filter(|(a, b)| a != b).count() as f64, 0.0, 0.0)
    }

    pub fn or(self, other: Self) -> Self {
        let [mine, theirs] = [self, other].map(|w| (w.share, w.bound));
        let worse = if theirs > mine { other } else { self };
        let [a, b] = [self.deviation, other.deviation];
        let deviation = Tolerance { max: a.max.max(b.max), rms: a.rms.max(b.rms) };
        Self { deviation, typical: self.typical.max(other.typical), ..worse }
    }

    pub(crate) fn against(self, allowed: Tolerance) -> Self {
        let over = |found: f64, allowed: f64| if found > 0.0 { found / allowed } else { 0.0 };
        let Tolerance { max, rms } = self.deviation;
        Self { typical: over(max, allowed.max).max(over(rms, allowed.rms)), ..self }
    }
}

/// Value and f32 error bound by running error analysis (Wilkinson, Error analysis revisited, 1986).
#[derive(Clone, Copy, Debug)]
pub struct Bounded {
    pub value: f64,
    pub error: f64,
}

impl Bounded {
    pub fn exact(value: impl Into<f64>) -> Self {
        Self { value: value.into(), error: 0.0 }
    }

    pub fn rounded(value: f64) -> Self {
        Self::new(value, 0.0, U)
    }

    /// The operands' error `carried` and the operation's relative limit `own`.
    fn new(value: f64, carried: f64, own: f64) -> Self {
        Self { value, error: carried + own * (value.abs() + carried) + TINY }
    }

    pub fn sqrt(self) -> Self {
        let value = self.value.max(0.0).sqrt();
        let lowest = (self.value - self.error).max(0.0).sqrt();
        let carried = self.error / (value + lowest).max(f64::MIN_POSITIVE);
        Self::new(value, carried.min((self.value.max(0.0) + self.error).sqrt()), ROOT)
    }

    pub fn exp2(self) -> Self {
        let value = self.value.exp2();
        let carried = value * (std::f64::consts::LN_2 * self.error).exp_m1();
        Self::new(value, carried, exponential(self.value.abs() + self.error))
    }

    pub fn exp(self) -> Self {
        let value = self.value.exp();
        Self::new(value, value * self.error.exp_m1(), exponential(self.value.abs() + self.error))
    }

    /// The error is at most the operands'.
    pub fn min(self, other: Self) -> Self {
        Self { value: self.value.min(other.value), error: self.error.max(other.error) }
    }

    pub fn max(self, other: Self) -> Self {
        Self { value: self.value.max(other.value), error: self.error.max(other.error) }
    }

    pub fn dot<const N: usize>(a: [Self; N], b: [Self; N]) -> Self {
        let products = a.into_iter().zip(b).map(|(a, b)| a * b);
        products.reduce(|sum, product| sum + product).unwrap_or(Self::exact(0.0))
    }
}

impl Add for Bounded {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self::new(self.value + other.value, self.error + other.error, U)
    }
}

impl Neg for Bounded {
    type Output = Self;
    fn neg(self) -> Self {
        Self { value: -self.value, ..self }
    }
}

impl Sub for Bounded {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + -other
    }
}

impl Mul for Bounded {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        let carried = self.value.abs() * other.error + other.value.abs() * self.error + self.error * other.error;
        Self::new(self.value * other.value, carried, U)
    }
}

impl Div for Bounded {
    type Output = Self;
    fn div(self, other: Self) -> Self {
        let (value, nearest) = (self.value / other.value, other.value.abs() - other.error);
        let carried = if nearest > 0.0 { (self.error + value.abs() * other.error) / nearest } else { f64::INFINITY };
        Self::new(value, carried, DIVISION)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_finite_or_not_equal_is_wrong() {
        assert_eq!(Worst::of(&[f32::NAN], &[0.0], |_| f64::INFINITY).share, f64::INFINITY);
        assert_eq!(Worst::of(&[1.0], &[1.0], |_| 0.0).share, 0.0);
        assert_eq!(Worst::of(&[1.0], &[1.1], |_| 0.0).share, f64::INFINITY);
        assert_eq!(Worst::of(&[1.0, 3.0], &[1.5, 2.0], |i| [1.0, 4.0][i]).share, 0.5);
        assert_eq!(Worst::of(&[1.0], &[1.5], |_| f64::NAN).share, f64::INFINITY);
        assert_eq!(Worst::differing(&[1, 2], &[1, 3]).error, 1.0);
    }

    #[test]
    fn formulas_in_f32_stay_within_their_running_bound() {
        let mut noise = crate::noise::Noise::new(3);
        for _ in 0..10_000 {
            let [a, b, c] = [0; 3].map(|_| noise.uniform(0.01, 3.0));
            let [x, y, z] = [a, b, c].map(Bounded::exact);
            let bounded = (((x - y) * z + y / z).max(x * y)).sqrt() * (x - z).exp2();
            let got = ((a - b) * c + b / c).max(a * b).sqrt() * (a - c).exp2();
            let worst = Worst::one(got.into(), bounded.value, bounded.error);
            assert!(worst.share <= 1.0 && bounded.error < 1e-3, "{a} {b} {c}: {worst:?}");
        }
    }
}
