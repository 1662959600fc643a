use std::time::Duration;

/// Time per stage, measured on the host.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct StageTimes(pub Vec<(String, Duration)>);

impl StageTimes {
    /// Returns the total time.
    pub fn total(&self) -> Duration {
        self.0.iter().map(|s| s.1).sum()
    }

    /// Adds to the time of a stage.
    pub fn add(&mut self, stage: &str, took: Duration) {
        match self.0.iter_mut().find(|s| s.0 == stage) {
            Some(known) => known.1 += took,
            None => self.0.push((stage.to_owned(), took)),
        }
    }
}
