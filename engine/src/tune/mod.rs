//! Kernel selection for a device: self-tests against exact references, and tile timings, both
//! cached. The result is an [`Arithmetic`].

mod attention;
mod cache;
mod chosen;
mod linear;
mod nearest;
mod noise;
mod self_test;
mod tuning;

pub use cache::cache_folder;
pub use chosen::Chosen;
pub use self_test::SelfTest;
pub use tuning::{Measured, Tuning};

use crate::{
    Result,
    gpu::{Device, Element, Limits, Run},
    ops::{Arithmetic, LaneTile, Lanes, Tile, Tiles, Units},
};

/// An operation with several implementations: exact f32, and fast ones on lanes and matrix units.
trait Operation: Sync {
    /// Name in the cache and in messages.
    fn name(&self) -> &'static str;

    /// Fast factor types on lanes.
    fn lanes(&self) -> &'static [Element];

    /// Factor types on matrix units.
    fn factors(&self) -> &'static [Element];

    /// Tiles for matrix units within the device's limits.
    fn tiles(&self, limits: &Limits, units: Units) -> Vec<Tile>;

    /// Tiles for lanes, the default first; empty if there is no choice.
    fn lane_tiles(&self, _limits: &Limits, _factor: Element) -> Vec<LaneTile> {
        Vec::new()
    }

    /// Name and result type of the kernels for a factor type.
    fn kernels(&self, on_units: bool, factor: Element) -> Vec<(String, Element)>;

    /// Deviation of a candidate from the exact reference, see [`self_test::deviation`].
    fn deviation(&self, device: &Device, candidate: Candidate, output: Element) -> Result<Option<f64>>;

    /// A run for timing, with a result of `rows` rows of [`COLUMNS`] values.
    fn timed(&self, device: &Device, candidate: Candidate, rows: usize) -> Result<Run>;

    /// The arithmetic's matrix unit fields for this operation.
    fn chosen<'a>(&self, arithmetic: &'a mut Arithmetic) -> Vec<&'a mut Option<Units>>;

    /// The arithmetic's lane tile fields for this operation, with their factor types.
    fn chosen_on_lanes<'a>(&self, _arithmetic: &'a mut Arithmetic) -> Vec<(Element, &'a mut Tiles)> {
        Vec::new()
    }
}

const OPERATIONS: [&dyn Operation; 3] = [&linear::LinearLayers, &attention::Attentions, &nearest::NearestSearches];

/// One implementation of an operation.
#[derive(Clone, Copy)]
enum Candidate {
    /// Lanes with a fixed tile, if there is a choice.
    Lanes(Lanes, Option<LaneTile>),
    /// Matrix units with a fixed tile.
    Units(Units, Tile),
}

/// Result columns in timed runs: channels of all heads, or targets.
const COLUMNS: usize = 1024;
/// Terms of a sum, or keys, in timed runs.
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
    /// Candidates on lanes: f32, and factor types that the device stores without matrix units for
    /// them.
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

    /// Matrix units of the device, with their candidates.
    fn on_units(&self, limits: &Limits) -> Vec<(Units, Vec<Candidate>)> {
        let units = self.factors().iter().filter_map(|factor| Units::of(*factor, limits));
        let always = |units, (index, tile)| Candidate::Units(Units { tiles: Tiles::always(index), ..units }, tile);
        let candidates = |units| self.tiles(limits, units).into_iter().enumerate().map(move |tile| always(units, tile));
        units.map(|units| (units, candidates(units).collect())).collect()
    }
}

/// Whether the device's lanes support a factor type other than f32.
fn on_lanes(limits: &Limits, factor: Element) -> bool {
    if factor == Element::I8 { limits.dot_products } else { limits.half_storage }
}

fn kernel_name(base: &str, on_units: bool, factor: Element) -> String {
    format!("{base}{}_{}", if on_units { "_matrix" } else { "" }, factor.name())
}
