use zipsplat::ops::{Lanes, LinearKernel, NearestKernel, Tiles, Units, Weights};
pub use zipsplat_tests::prelude::*;
use zipsplat_verify::Trial;

pub fn plan() -> Trial<'static> {
    Trial::new(device())
}

pub fn plan_within(limits: &Limits) -> Trial<'static> {
    Trial::within(device(), limits)
}

pub fn elements() -> Vec<Element> {
    let half = device().limits().half_storage.then_some(Element::HALVES);
    [Element::F32].into_iter().chain(half.into_iter().flatten()).collect()
}

/// Linear kernels with weights in the factors' type, on lanes both by rule and with the first tile
/// in shared memory.
pub fn linear_kernels() -> Vec<LinearKernel> {
    let lanes = |element| [Lanes::of(element), Lanes { element, tiles: Tiles::always(1) }];
    let panels = elements().into_iter().flat_map(lanes).map(|lanes| LinearKernel::Panels(lanes, Weights::Factors));
    let units = Element::FACTORS.into_iter().filter_map(|factor| Units::of(factor, device().limits()));
    let dots = device().limits().dot_products.then_some(LinearKernel::Dots(Tiles::BY_RULE));
    panels.chain(units.map(|units| LinearKernel::Matrix(units, Weights::Factors))).chain(dots).collect()
}

/// Adds limits without addresses for a variant that reads by address.
pub fn with_and_without_addresses(limits: &Limits, has_twin: bool) -> Vec<Limits> {
    let bound = (has_twin && limits.addresses).then(|| Limits { addresses: false, ..limits.clone() });
    [limits.clone()].into_iter().chain(bound).collect()
}

/// Linear kernels with their variant for 8-bit weights.
pub fn q8_kernels() -> Vec<[LinearKernel; 2]> {
    linear_kernels().into_iter().filter_map(|kernel| Some([kernel, kernel.with_q8()?])).collect()
}

pub fn nearest_kernels() -> Vec<NearestKernel> {
    let matrix = Units::of(Element::F16, device().limits()).map(NearestKernel::Matrix);
    [NearestKernel::Lanes].into_iter().chain(matrix).collect()
}

pub fn stored(element: Element, values: Vec<f32>) -> Vec<f32> {
    element.decode(&element.encode(&values))
}

/// Rounds f64 results of one rounding to f32, as a kernel.
pub fn rounded(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&x| x as f32).collect()
}
