//! Hard cases: no NaN, hang, panic or silent error.
//!
//! `tools/test.sh -p zipsplat-tests --test numerics -- --ignored` runs the slow tests.

mod cache;
mod doctor;
mod faults;
mod hostile;
mod invalid;
mod memory;
mod metamorphic;
mod resources;
mod splatting;
mod views;

use std::sync::OnceLock;
use zipsplat_tests::prelude::*;

fn micro() -> Checkpoint {
    Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").expect("a network")
}

struct Mode {
    arithmetic: Arithmetic,
    model: Model,
}

impl Mode {
    fn tolerance(&self, field: &str) -> Tolerance {
        match self.arithmetic.element {
            Element::F32 => Tolerance::of_field(field),
            _ => Tolerance::gaussians_in(self.arithmetic),
        }
    }

    fn reconstruct(&self, images: &[Image], request: &ReconstructOptions) -> Scene {
        reconstruct(&self.model, images, request).to_scene().unwrap()
    }
}

/// f32 first, then narrower factors, on matrix units and lanes.
fn modes() -> &'static [Mode] {
    static MODES: OnceLock<Vec<Mode>> = OnceLock::new();
    MODES.get_or_init(|| {
        let load = |arithmetic| {
            let model = Model::from_checkpoint_with(device(), &micro(), arithmetic, |_| ControlFlow::Continue(()));
            Mode { arithmetic, model: model.expect("it fits") }
        };
        std::iter::once(Arithmetic::EXACT).chain(fast_arithmetics()).map(load).collect()
    })
}

fn model() -> &'static Model {
    &modes()[0].model
}

/// 0 if `bound` is 0.
fn below(random: &mut Random, bound: usize) -> usize {
    (random.bits() >> 11) as usize % bound.max(1)
}
