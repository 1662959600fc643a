//! Hard cases: whatever is asked for, no NaN, no hang, no panic, and nothing quietly wrong.
//!
//! What takes long is ignored; `tools/test.sh -p zipsplat-tests --test numerics -- --ignored` runs it.

mod cache;
mod catalogue;
mod faults;
mod hostile;
mod invalid;
mod memory;
mod metamorphic;
mod processes;
mod resources;
mod splatting;
mod views;

use std::{ops::ControlFlow, sync::OnceLock};
use zipsplat::{
    reconstruct::{Model, Request},
    types::{Image, Scene},
    weights::Checkpoint,
};
use zipsplat_tests::{architectures, device::device};

/// The smallest network, with generated weights.
fn micro() -> Checkpoint {
    Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").expect("a network")
}

/// [`micro`] on the tests' device.
fn model() -> &'static Model {
    static MODEL: OnceLock<Model> = OnceLock::new();
    MODEL.get_or_init(|| Model::load(device(), &micro(), |_| ControlFlow::Continue(())).expect("it fits"))
}

fn reconstruct(model: &Model, images: &[Image], request: &Request) -> Scene {
    model.reconstruct(images, request, |_| ControlFlow::Continue(())).expect("a scene").scene
}

/// splitmix64: the same numbers for the same seed.
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

/// A picture of noise.
fn noise(width: u32, height: u32, seed: u64) -> Image {
    let mut random = Random(seed);
    let rgb = (0..3 * width * height).map(|_| (random.bits() >> 56) as u8).collect();
    Image::new(width, height, rgb).expect("as many bytes as pixels")
}
