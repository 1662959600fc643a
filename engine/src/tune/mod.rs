//! Kernel selection by cached self-tests and timings, as an [`Arithmetic`].

mod attention;
mod cache;
mod kernel_choice;
mod linear;
mod nearest;
mod noise;
mod self_test;
mod tuning;

pub use kernel_choice::KernelChoice;
pub use self_test::SelfTest;
pub use tuning::{Measured, Tuning};

use crate::{
    Result,
    gpu::{Device, Element, Limits, Run},
    ops::{Arithmetic, LaneTile, Lanes, Tile, Tiles, Units},
};

struct Operation {
    name: &'static str,
    lanes: &'static [Element],
    factors: &'static [Element],
    tiles: fn(&Limits, Units) -> Vec<Tile>,
    /// Tiles on lanes, default first.
    lane_tiles: fn(&Limits, Element) -> Vec<LaneTile>,
    /// Kernels on matrix units or lanes, with their output types.
    kernels: fn(bool, Element) -> Vec<(String, Element)>,
    deviation: fn(&Device, Candidate, Element) -> Result<Option<f64>>,
    /// Takes the number of rows.
    timed: fn(&Device, Candidate, usize) -> Result<Run>,
    chosen: fn(&mut Arithmetic) -> Vec<&mut Option<Units>>,
    chosen_on_lanes: fn(&mut Arithmetic) -> Vec<(Element, &mut Tiles)>,
}

static OPERATIONS: [Operation; 3] = [linear::LINEAR, attention::ATTENTION, nearest::NEAREST];

#[derive(Clone, Copy)]
enum Candidate {
    Lanes(Lanes, Option<LaneTile>),
    Units(Units, Tile),
}

/// Channels of all heads, or targets, in timed runs.
const COLUMNS: usize = 1024;
const TERMS: usize = 1024;

impl Candidate {
    fn factor(self) -> Element {
        match self {
            Candidate::Lanes(lanes, _) => lanes.element,
            Candidate::Units(units, _) => units.factor,
        }
    }

    fn tile(self) -> String {
        match self {
            Candidate::Lanes(_, tile) => tile.map(|tile| tile.to_string()).unwrap_or_default(),
            Candidate::Units(_, tile) => tile.to_string(),
        }
    }
}

impl Operation {
    /// f32, and types without matrix units.
    fn on_lanes(&self, limits: &Limits) -> Vec<Candidate> {
        let is_narrow = |factor: &Element| on_lanes(limits, *factor) && limits.matrices.of(*factor).is_none();
        let narrow = self.lanes.iter().copied().filter(is_narrow);
        let of = |factor| {
            let always = move |(index, tile)| {
                Candidate::Lanes(Lanes { tiles: Tiles::always(index), ..Lanes::of(factor) }, Some(tile))
            };
            (self.lane_tiles)(limits, factor).into_iter().enumerate().map(always)
        };
        [Element::F32].into_iter().chain(narrow).flat_map(of).collect()
    }

    fn on_units(&self, limits: &Limits) -> Vec<(Units, Vec<Candidate>)> {
        let units = self.factors.iter().filter_map(|factor| Units::of(*factor, limits));
        let always = |units, (index, tile)| Candidate::Units(Units { tiles: Tiles::always(index), ..units }, tile);
        let candidates =
            |units| (self.tiles)(limits, units).into_iter().enumerate().map(move |tile| always(units, tile));
        units.map(|units| (units, candidates(units).collect())).collect()
    }
}

fn on_lanes(limits: &Limits, factor: Element) -> bool {
    if factor == Element::I8 { limits.dot_products } else { limits.half_storage }
}

fn kernel_name(base: &str, on_units: bool, factor: Element) -> String {
    format!("{base}{}_{}", if on_units { "_matrix" } else { "" }, factor.name())
}
