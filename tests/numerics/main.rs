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
    reconstruct::{Model, Request},
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

    fn reconstruct(&self, images: &[Image], request: &Request) -> Scene {
        reconstruct(&self.model, images, request)
    }
}

/// [`micro`] on the tests' device in every arithmetic: f32 first, then narrower factors, on matrix
/// units and on lanes.
fn modes() -> &'static [Mode] {
    static MODES: OnceLock<Vec<Mode>> = OnceLock::new();
    MODES.get_or_init(|| {
        let load = |arithmetic| {
            let model = Model::load_with(device(), &micro(), arithmetic, |_| ControlFlow::Continue(()));
            Mode { arithmetic, model: model.expect("it fits") }
        };
        std::iter::once(Arithmetic::EXACT).chain(fast_arithmetics()).map(load).collect()
    })
}

fn model() -> &'static Model {
    &modes()[0].model
}

fn reconstruct(model: &Model, images: &[Image], request: &Request) -> Scene {
    model.reconstruct(images, request, |_| ControlFlow::Continue(())).expect("a scene").scene().unwrap()
}

/// splitmix64, reproducible from its seed.
struct Random(u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.bits() >> 11) as usize % bound.max(1)
    }
}

fn noise(width: u32, height: u32, seed: u64) -> Image {
    let mut random = Random(seed);
    let rgb = (0..3 * width * height).map(|_| (random.bits() >> 56) as u8).collect();
    Image::new(width, height, rgb).expect("as many bytes as pixels")
}
