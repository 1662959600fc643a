use super::{Features, Lifted};
use crate::{Error, Result, types::Scene};
use std::iter::zip;

const NEIGHBORS: usize = 8;

impl Lifted {
    /// Returns the features of a scene's Gaussians after edits or reordering: `sources` are their
    /// former indices. Token features become those of the Gaussians.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn of(&self, sources: &[usize]) -> Self {
        let Features { values, channels, group } = &self.features;
        let rows = sources.iter().map(|i| i / group);
        let values = rows.clone().flat_map(|row| &values[row * channels..][..*channels]).copied().collect();
        let features = Features { values, channels: *channels, group: 1 };
        Self { features, weights: rows.map(|row| self.weights[row]).collect() }
    }

    /// Appends the features of a scene's following Gaussians.
    ///
    /// # Errors
    /// [`Error::Argument`] for another number of channels.
    pub fn append(&mut self, other: &Self) -> Result<()> {
        let (own, others) = (self.features.channels, other.features.channels);
        if others != own {
            return Err(Error::argument("features to append", others, format!("{own} channels")));
        }
        // Different groups become one row per Gaussian.
        if other.features.group != self.features.group {
            *self = self.of(&(0..self.weights.len() * self.features.group).collect::<Vec<_>>());
            return self.append(&other.of(&(0..other.weights.len() * other.features.group).collect::<Vec<_>>()));
        }
        self.features.values.extend(&other.features.values);
        self.weights.extend(&other.weights);
        Ok(())
    }

    /// Returns the Gaussians with at least `least` in a channel and a weight of at least `pixels`.
    pub fn at_least(&self, channel: usize, least: f32, pixels: f32) -> Vec<usize> {
        let Features { values, channels, group } = &self.features;
        let rows = zip(values.chunks_exact(*channels), &self.weights).enumerate();
        let rows = rows.filter(|(_, (row, weight))| row[channel] >= least && **weight >= pixels);
        rows.flat_map(|(row, _)| row * group..(row + 1) * group).collect()
    }

    /// Returns the Gaussians of at least this cosine similarity with the seeds' mean that such
    /// nearest neighbors connect with a seed.
    ///
    /// # Errors
    /// [`Error::Argument`] if the features are another scene's, or no seed has any or is in it.
    pub fn select(&self, scene: &Scene, seeds: &[usize], least: f32) -> Result<Vec<usize>> {
        self.features.validate(scene)?;
        let Features { values, channels, group } = &self.features;
        if let Some(seed) = seeds.iter().find(|seed| **seed >= scene.len()) {
            return Err(Error::argument("seed", seed, format!("one of {} Gaussians", scene.len())));
        }
        let row = |i: usize| &values[i / group * channels..][..*channels];
        let dot = |a: &[f32], b: &[f32]| zip(a, b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
        let mut mean = vec![0.0; *channels];
        for (i, length) in seeds.iter().map(|i| (*i, dot(row(*i), row(*i)).sqrt())).filter(|(_, length)| *length > 0.0)
        {
            zip(&mut mean, row(i)).for_each(|(sum, value)| *sum += value / length as f32);
        }
        let length = dot(&mean, &mean).sqrt();
        if length == 0.0 {
            return Err(Error::argument(
                "seeds",
                format!("{} without features", seeds.len()),
                "Gaussians that pixels show",
            ));
        }
        let similar = |i: usize| dot(row(i), &mean) >= f64::from(least) * length * dot(row(i), row(i)).sqrt();
        let members: Vec<bool> = (0..scene.len()).map(|i| self.weights[i / group] > 0.0 && similar(i)).collect();
        Ok(scene.connected(&members, seeds, NEIGHBORS))
    }
}
