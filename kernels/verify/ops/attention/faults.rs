use super::{Keys, Problem};
use crate::bound::half;

#[derive(Clone, Copy, Debug)]
pub enum Fault {
    /// Ignores keys from this index on.
    KeysFrom(usize),
    Key(usize),
    LastKey,
    HalfOfKeys,
    NeighborValue,
    NeighborHead,
    NoScale,
    /// exp of f32 scores without the maximum.
    NoMaximum,
    SumsNotScaled,
    TotalNotScaled,
    NoTotal,
    HalfSum,
    HalfWeights,
    HalfScores,
    NoCounts,
    NeighborCount,
    Padding,
}

impl Fault {
    /// Returns true if 16-bit rounding hides it.
    pub fn is_fine(self) -> bool {
        matches!(self, Fault::LastKey | Fault::HalfSum | Fault::HalfWeights | Fault::HalfScores)
    }
}

impl Problem {
    pub fn wrong(&self, scores: &[f64], head: usize, keys: &Keys, fault: Fault) -> Vec<f64> {
        let round: fn(f64) -> f64 = if matches!(fault, Fault::HalfSum) { half } else { |x| x };
        let counted = |(key, score): (usize, &f64)| match fault {
            Fault::NoCounts => score - keys.count(key).ln(),
            Fault::NeighborCount => score + (keys.count((key + 1) % scores.len()) / keys.count(key)).ln(),
            _ => *score,
        };
        let scores: Vec<f64> = scores.iter().enumerate().map(counted).collect();
        let highest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut so_far = f64::NEG_INFINITY;
        let (mut total, mut sums) = (0.0, vec![0.0; self.dim]);
        for (key, &score) in scores.iter().enumerate().filter(|(key, _)| self.counts(*key, scores.len(), fault)) {
            so_far = so_far.max(score);
            let weight = (score - highest).exp();
            let (weight, counted) = match fault {
                Fault::NoScale => [((score - highest) * (self.dim as f64).sqrt()).exp(); 2].into(),
                Fault::NoMaximum => [f64::from((score as f32).exp()); 2].into(),
                Fault::SumsNotScaled => [(score - so_far).exp(); 2].into(),
                Fault::TotalNotScaled => (weight, (score - so_far).exp()),
                Fault::HalfWeights => (half(weight), weight),
                Fault::HalfScores => [(half(score) - half(highest)).exp(); 2].into(),
                _ => (weight, weight),
            };
            // A dominating key makes most weights negligible.
            if weight < 1e-40 && counted < 1e-40 {
                continue;
            }
            total = round(total + counted);
            for (sum, v) in sums.iter_mut().zip(self.value(key, head, &keys.v, fault)) {
                *sum = round(*sum + weight * v);
            }
        }
        let total = match fault {
            Fault::NoTotal => 1.0,
            Fault::Padding => f64::NAN,
            _ => total,
        };
        sums.iter().map(|sum| sum / total).collect()
    }

    fn counts(&self, key: usize, all: usize, fault: Fault) -> bool {
        match fault {
            Fault::KeysFrom(end) => key < end,
            Fault::Key(lost) => key != lost,
            Fault::LastKey => key + 1 < all,
            Fault::HalfOfKeys => key.is_multiple_of(2),
            _ => true,
        }
    }

    fn value<'a>(&self, key: usize, head: usize, v: &'a [f64], fault: Fault) -> &'a [f64] {
        let (key, head) = match fault {
            Fault::NeighborValue => ((key + 1) % (v.len() / self.width()), head),
            Fault::NeighborHead => (key, (head + 1) % self.heads),
            _ => (key, head),
        };
        &v[key * self.width() + head * self.dim..][..self.dim]
    }
}
