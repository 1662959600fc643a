//! Hard cases: no NaN, hang, panic or silent error.
//!
//! Slow tests are ignored; `tools/test.sh -p zipsplat-tests --test numerics -- --ignored` runs
//! them.

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

use std::{ops::ControlFlow, sync::OnceLock};
use zipsplat::{
    gpu::Element,
    ops::Arithmetic,
    random::Random,
    reconstruct::{Model, ReconstructOptions},
    types::{Image, Scene},
    weights::Checkpoint,
};
use zipsplat_tests::{architectures, compare::Tolerance, device::device, networks::fast_arithmetics};

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
        reconstruct(&self.model, images, request)
    }
}

/// f32 first, then narrower factors, on matrix units and on lanes.
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

fn reconstruct(model: &Model, images: &[Image], request: &ReconstructOptions) -> Scene {
    model.reconstruct_views(images, request, |_| ControlFlow::Continue(())).expect("a scene").to_scene().unwrap()
}

/// Returns a random index below `bound`, 0 if `bound` is 0.
fn below(random: &mut Random, bound: usize) -> usize {
    (random.bits() >> 11) as usize % bound.max(1)
}

fn noise(width: u32, height: u32, seed: u64) -> Image {
    let mut random = Random::new(seed);
    let rgb = (0..3 * width * height).map(|_| (random.bits() >> 56) as u8).collect();
    Image::new(width, height, rgb).expect("as many bytes as pixels")
}
