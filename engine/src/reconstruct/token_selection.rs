use super::Ratio;
use crate::{
    Error, Result,
    gpu::{Recorder, Run, Tensor},
    ops::{NearestKernel, Rows},
    stages::{
        ViewGrid,
        cluster::{self, ROUNDS, cluster_count, even_indices, random_indices},
    },
};
use std::{fmt, str::FromStr};

const MAX_ROUNDS: usize = 100;

/// Token selection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TokenSelection {
    /// Tokens nearest to k-means centroids, after these rounds.
    Kmeans(usize),
    /// Tokens with the fewest mutual nearest neighbors in earlier views.
    MutualNearest,
    /// Evenly spread.
    Stride,
    /// Random, reproducible by seed.
    Random(u64),
    /// Explicit indices.
    Given(Vec<u32>),
}

impl TokenSelection {
    /// The reference's rounds.
    pub const KMEANS: Self = Self::Kmeans(ROUNDS);

    /// Names that parse.
    pub const NAMES: &str = "kmeans[:ROUNDS], mutual, stride or random[:SEED]";

    /// Returns the tokens, or k-means' initial ones.
    pub fn indices(&self, all: usize, tokens: usize) -> Vec<u32> {
        match self {
            Self::Kmeans(_) | Self::MutualNearest | Self::Stride => even_indices(all, tokens),
            Self::Random(seed) => random_indices(all, tokens, *seed),
            Self::Given(indices) => indices.clone(),
        }
    }
}

impl fmt::Display for TokenSelection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Kmeans(ROUNDS) => write!(f, "kmeans"),
            Self::Kmeans(rounds) => write!(f, "kmeans:{rounds}"),
            Self::MutualNearest => write!(f, "mutual"),
            Self::Stride => write!(f, "stride"),
            Self::Random(seed) => write!(f, "random:{seed}"),
            Self::Given(indices) => write!(f, "{} indices", indices.len()),
        }
    }
}

impl FromStr for TokenSelection {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let (name, number) = text.split_once(':').map_or((text, None), |(name, number)| (name, Some(number)));
        match (name, number) {
            ("kmeans", None) => Ok(Self::KMEANS),
            ("kmeans", Some(rounds)) => rounds.parse().map(Self::Kmeans).map_err(|_| format!("{rounds} is no number")),
            ("mutual", None) => Ok(Self::MutualNearest),
            ("stride", None) => Ok(Self::Stride),
            ("random", None) => Ok(Self::Random(0)),
            ("random", Some(seed)) => seed.parse().map(Self::Random).map_err(|_| format!("{seed} is no seed")),
            _ => Err(format!("expected {}", Self::NAMES)),
        }
    }
}

/// Kept tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TokenSampling {
    /// All, without clustering.
    All,
    /// Nearest to k-means centroids.
    Kmeans(usize),
    /// Fewest mutual nearest neighbors in earlier views.
    MutualNearest,
    /// Indices from an input.
    Indices,
}

/// Tensors of a partial selection.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SelectedTokens {
    /// `[tokens]` u32 input.
    indices: Option<Tensor>,
    /// `[tokens]` u32, from features.
    chosen: Option<Tensor>,
}

impl TokenSampling {
    pub(crate) fn of(grid: ViewGrid, ratio: Ratio, selection: &TokenSelection) -> Result<(usize, Self)> {
        let all = grid.tokens();
        if let TokenSelection::Kmeans(rounds) = selection
            && !(1..=MAX_ROUNDS).contains(rounds)
        {
            return Err(Error::argument("rounds of k-means", rounds, format!("1 to {MAX_ROUNDS}")));
        }
        if let TokenSelection::Given(indices) = selection {
            if indices.is_empty() || indices.iter().any(|i| *i as usize >= all) {
                let found = format!("{} indices", indices.len());
                return Err(Error::argument("given tokens", found, format!("at least one, all below {all}")));
            }
            return Ok((indices.len(), Self::Indices));
        }
        let tokens = cluster_count(all, ratio.of(grid.views)?);
        let kept = match selection {
            _ if tokens == all => Self::All,
            TokenSelection::Kmeans(rounds) => Self::Kmeans(*rounds),
            TokenSelection::MutualNearest => Self::MutualNearest,
            TokenSelection::Stride | TokenSelection::Random(_) | TokenSelection::Given(_) => Self::Indices,
        };
        Ok((tokens, kept))
    }

    pub(crate) fn record(
        self,
        rec: &mut Recorder,
        kernel: NearestKernel,
        features: Rows,
        grid: ViewGrid,
        count: usize,
    ) -> SelectedTokens {
        let input = matches!(self, Self::Kmeans(_) | Self::Indices);
        let indices = input.then(|| rec.input::<u32>("indices", count));
        let chosen = rec.scope("cluster", |rec| match (self, indices) {
            (Self::Kmeans(rounds), Some(initial)) => {
                Some(cluster::record(rec, kernel, features, initial, count, rounds))
            }
            (Self::MutualNearest, _) => Some(cluster::mutual(rec, kernel, features, grid.views, count)),
            _ => None,
        });
        chosen.into_iter().for_each(|chosen| rec.output(chosen));
        SelectedTokens { indices, chosen }
    }
}

impl SelectedTokens {
    /// Tokens that later stages keep.
    pub fn tensor(&self) -> Option<Tensor> {
        self.chosen.or(self.indices)
    }

    pub fn write(&self, run: &mut Run, selection: &TokenSelection, all: usize, tokens: usize) -> Result<()> {
        self.indices.map_or(Ok(()), |tensor| run.write(tensor, &selection.indices(all, tokens)))
    }

    /// Returns the kept tokens, unless all are.
    pub fn read(&self, run: &Run, selection: &TokenSelection, all: usize, tokens: usize) -> Result<Option<Vec<u32>>> {
        match (self.chosen, self.indices) {
            (Some(chosen), _) => run.read(chosen).map(Some),
            (None, Some(_)) => Ok(Some(selection.indices(all, tokens))),
            (None, None) => Ok(None),
        }
    }
}
