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

trait Operation: Sync {
    fn name(&self) -> &'static str;

    fn lanes(&self) -> &'static [Element];

    fn factors(&self) -> &'static [Element];

    fn tiles(&self, limits: &Limits, units: Units) -> Vec<Tile>;

    /// Tiles on lanes, default first.
    fn lane_tiles(&self, _limits: &Limits, _factor: Element) -> Vec<LaneTile> {
        Vec::new()
    }

    fn kernels(&self, on_units: bool, factor: Element) -> Vec<(String, Element)>;

    fn deviation(&self, device: &Device, candidate: Candidate, output: Element) -> Result<Option<f64>>;

    fn timed(&self, device: &Device, candidate: Candidate, rows: usize) -> Result<Run>;

    fn chosen<'a>(&self, arithmetic: &'a mut Arithmetic) -> Vec<&'a mut Option<Units>>;

    fn chosen_on_lanes<'a>(&self, _arithmetic: &'a mut Arithmetic) -> Vec<(Element, &'a mut Tiles)> {
        Vec::new()
    }
}

const OPERATIONS: [&dyn Operation; 3] = [&linear::LinearLayers, &attention::Attentions, &nearest::NearestSearches];

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

impl dyn Operation {
    /// f32, and types without matrix units.
    fn on_lanes(&self, limits: &Limits) -> Vec<Candidate> {
        let narrow = self
            .lanes()
            .iter()
            .copied()
            .filter(|factor| on_lanes(limits, *factor) && limits.matrices.of(*factor).is_none());
        let of = |factor| {
            let always = move |(index, tile)| {
                Candidate::Lanes(Lanes { tiles: Tiles::always(index), ..Lanes::of(factor) }, Some(tile))
            };
            self.lane_tiles(limits, factor).into_iter().enumerate().map(always)
        };
        [Element::F32].into_iter().chain(narrow).flat_map(of).collect()
    }

    fn on_units(&self, limits: &Limits) -> Vec<(Units, Vec<Candidate>)> {
        let units = self.factors().iter().filter_map(|factor| Units::of(*factor, limits));
        let always = |units, (index, tile)| Candidate::Units(Units { tiles: Tiles::always(index), ..units }, tile);
        let candidates = |units| self.tiles(limits, units).into_iter().enumerate().map(move |tile| always(units, tile));
        units.map(|units| (units, candidates(units).collect())).collect()
    }
}

fn on_lanes(limits: &Limits, factor: Element) -> bool {
    if factor == Element::I8 { limits.dot_products } else { limits.half_storage }
}

fn kernel_name(base: &str, on_units: bool, factor: Element) -> String {
    format!("{base}{}_{}", if on_units { "_matrix" } else { "" }, factor.name())
}
