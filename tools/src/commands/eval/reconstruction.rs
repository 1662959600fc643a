use std::time::Duration;
use zipsplat::{gpu::StageTimes, refine::RefineResult, types::Scene};

/// World: the first input's camera; unit: the network's.
pub struct Reconstruction {
    pub scene: Scene,
    pub network: Option<Network>,
    pub refined: Option<RefineResult>,
    pub started: &'static str,
}

pub struct Network {
    pub tokens: usize,
    pub all_tokens: usize,
    pub peak_bytes: u64,
    pub took: Duration,
    pub stages: StageTimes,
}

impl Reconstruction {
    pub fn given(scene: Scene) -> Self {
        Self { scene, network: None, refined: None, started: "" }
    }
}
