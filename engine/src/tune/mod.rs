//! Choosing what a device computes with: fast kernels are tested against their exact twins, their tiles are timed, and both are
//! remembered. What follows is an [`Arithmetic`], with which stages are laid out and from which operations take their kernels.

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

/// An operation with several candidates to compute it: an exact one in f32, and fast ones on lanes and on matrix units.
trait Operation: Sync {
    /// Name in what is remembered and shown.
    fn name(&self) -> &'static str;

    /// Types of fast factors on lanes.
    fn lanes(&self) -> &'static [Element];

    /// Types of factors on matrix units.
    fn factors(&self) -> &'static [Element];

    /// Ways to cut the work for matrix units that are within a device's limits.
    fn tiles(&self, limits: &Limits, units: Units) -> Vec<Tile>;

    /// Ways to cut the work of lanes, that of the rule first, where there are several.
    fn lane_tiles(&self, _limits: &Limits, _factor: Element) -> Vec<LaneTile> {
        Vec::new()
    }

    /// Kernels that factors of a type need, on matrix units or on lanes: name, and type of the results.
    fn kernels(&self, on_units: bool, factor: Element) -> Vec<(String, Element)>;

    /// How far a candidate with results of this type is off its exact twin, see [`self_test::deviation`].
    fn deviation(&self, device: &Device, candidate: Candidate, output: Element) -> Result<Option<f64>>;

    /// A run to be timed, whose result has `rows` rows of [`COLUMNS`] values.
    fn timed(&self, device: &Device, candidate: Candidate, rows: usize) -> Result<Run>;

    /// The fields in which an arithmetic keeps the matrix units that were chosen.
    fn chosen<'a>(&self, arithmetic: &'a mut Arithmetic) -> Vec<&'a mut Option<Units>>;

    /// The fields in which an arithmetic keeps how the work of lanes is cut, with the type of the factors.
    fn chosen_on_lanes<'a>(&self, _arithmetic: &'a mut Arithmetic) -> Vec<(Element, &'a mut Tiles)> {
        Vec::new()
    }
}

/// All operations that have candidates.
const OPERATIONS: [&dyn Operation; 3] = [&linear::LinearLayers, &attention::Attentions, &nearest::NearestSearches];

/// One of the ways to compute an operation.
#[derive(Clone, Copy)]
enum Candidate {
    /// On lanes that always take the same tile, this one where there are several.
    Lanes(Lanes, Option<LaneTile>),
    /// On matrix units that always take this tile.
    Units(Units, Tile),
}

/// Columns of the results of timed runs: channels of all heads, or targets. Those of a middling network.
const COLUMNS: usize = 1024;
/// Terms of a sum, or keys, of timed runs.
const TERMS: usize = 1024;

impl Candidate {
    /// Type of the factors.
    fn factor(self) -> Element {
        match self {
            Candidate::Lanes(lanes, _) => lanes.element,
            Candidate::Units(units, _) => units.factor,
        }
    }

    /// Name of its tile.
    fn tile(self) -> String {
        match self {
            Candidate::Lanes(_, tile) => tile.map(|tile| tile.to_string()).unwrap_or_default(),
            Candidate::Units(_, tile) => tile.to_string(),
        }
    }
}

impl dyn Operation {
    /// The candidates on lanes: with factors of f32, and of types that the device keeps and has no matrix units for.
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

    /// Every type of factors that the device has matrix units for, with the candidates for it.
    fn on_units(&self, limits: &Limits) -> Vec<(Units, Vec<Candidate>)> {
        let units = self.factors().iter().filter_map(|factor| Units::of(*factor, limits));
        let always = |units, (index, tile)| Candidate::Units(Units { tiles: Tiles::always(index), ..units }, tile);
        let candidates = |units| self.tiles(limits, units).into_iter().enumerate().map(move |tile| always(units, tile));
        units.map(|units| (units, candidates(units).collect())).collect()
    }
}

/// True where lanes of the device take factors of a type, other than f32.
fn on_lanes(limits: &Limits, factor: Element) -> bool {
    if factor == Element::I8 { limits.dot_products } else { limits.half_storage }
}

/// Name of the kernel `base` with factors of a type.
fn kernel_name(base: &str, on_units: bool, factor: Element) -> String {
    format!("{base}{}_{}", if on_units { "_matrix" } else { "" }, factor.name())
}
