//! The numerical catalogue: what kernels compute on a device, beside the same in f64, under bounds that follow from the
//! number format.
//!
//! An area is a kernel or a few that mean something together. It says why its bound holds, and has cases: inputs chosen to
//! be hard, their truth from `zipsplat_reference`, the bound of every element, and the faults that the case is there to
//! catch. A bound that does not hold is a wrong kernel, a wrong driver or a wrong bound; none is loosened to pass. A fault
//! that stays within twice the bound is a case that proves nothing: `tests/numerics/catalogue.rs` injects each of them.

mod adam;
mod attention;
mod bound;
mod cameras;
mod case;
mod cluster;
mod convolution;
mod head;
mod head_backward;
mod linear;
mod loss;
mod norm;
mod pixel_shuffle;
mod positions;
pub mod report;
mod resize;
mod sort;
mod splatting;
mod splatting_backward;
mod trial;

pub use bound::Worst;
use case::Catches;
pub use case::{CAUGHT, Case, Injected};

use serde::Serialize;
use zipsplat::{
    Error, Result,
    gpu::{Device, Element, Limits},
    ops::{LaneTile, Lanes, LinearKernel, Tiles, Units, Weights},
};

/// Arithmetic of matrix products: the only thing that precision modes differ in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mode {
    /// Type of the factors.
    pub factor: Element,
    /// Whether matrix units multiply them; else a lane gives a result.
    pub matrix: bool,
    /// How weights lie on the device.
    pub weights: Weights,
    /// Whether factors pass through shared memory on lanes.
    pub tiled: bool,
}

/// How a mode holds the factors of matrix products.
#[derive(Clone, Copy, Debug)]
struct Factors {
    /// The most that rounding moves one, relatively.
    unit: f64,
    /// One below it may be flushed.
    tiny: f64,
    /// Units of rounding that a term of a sum may cost: matrix units may truncate (Fasi, Higham, Mikaitis and Pranesh,
    /// Numerical behavior of NVIDIA tensor cores, 2021).
    roundings: usize,
}

impl Factors {
    /// The most by which a sum of `n` products moves relative to their magnitudes, rounding of the factors apart.
    fn sum(&self, n: usize) -> f64 {
        bound::gamma(self.roundings * n)
    }
}

impl Mode {
    /// f32 throughout.
    pub const EXACT: Mode = Mode { factor: Element::F32, matrix: false, weights: Weights::Factors, tiled: false };
    const TILED: Mode = Mode { tiled: true, ..Mode::EXACT };
    const F16: Mode = Mode { factor: Element::F16, ..Mode::EXACT };
    const BF16: Mode = Mode { factor: Element::Bf16, ..Mode::EXACT };
    const F16_MATRIX: Mode = Mode { matrix: true, ..Mode::F16 };
    const BF16_MATRIX: Mode = Mode { matrix: true, ..Mode::BF16 };
    const I8: Mode = Mode { factor: Element::I8, ..Mode::EXACT };
    const I8_MATRIX: Mode = Mode { factor: Element::I8, ..Mode::F16_MATRIX };

    /// Every mode: those of linear layers.
    pub const ALL: &[Mode] = &[
        Mode::EXACT,
        Mode::TILED,
        Mode::F16,
        Mode::BF16,
        Mode::I8,
        Mode::F16_MATRIX,
        Mode::BF16_MATRIX,
        Mode::I8_MATRIX,
    ];
    /// The modes of linear layers whose weights have 8 bits.
    const Q8: &[Mode] = &[
        Mode { weights: Weights::Q8, ..Mode::EXACT },
        Mode { weights: Weights::Q8, ..Mode::TILED },
        Mode { weights: Weights::Q8, ..Mode::F16 },
        Mode { weights: Weights::Q8, ..Mode::BF16 },
        Mode { weights: Weights::Q8, ..Mode::F16_MATRIX },
        Mode { weights: Weights::Q8, ..Mode::BF16_MATRIX },
    ];
    /// The modes of attention.
    const FLOATS: &[Mode] = &[Mode::EXACT, Mode::F16, Mode::BF16, Mode::F16_MATRIX, Mode::BF16_MATRIX];
    /// The modes of finding nearest rows.
    const NEAREST: &[Mode] = &[Mode::EXACT, Mode::F16_MATRIX];
    /// The mode of what is f32 in every mode: norms, softmax, geometry.
    const ONLY_EXACT: &[Mode] = &[Mode::EXACT];

    /// As in the report.
    pub fn name(self) -> &'static str {
        match (self.factor, self.matrix) {
            (Element::F32, _) if self.tiled => "exact tiles",
            (Element::F32, _) => "exact",
            (Element::F16, false) => "f16",
            (Element::Bf16, false) => "bf16",
            (Element::F16, true) => "f16 matrix",
            (Element::Bf16, true) => "bf16 matrix",
            (Element::I8, false) => "i8",
            (Element::I8, true) => "i8 matrix",
        }
    }

    /// Whether a device has it.
    pub fn is_on(self, limits: &Limits) -> bool {
        let stored = self.factor == Element::F32 || limits.half_storage;
        let tiled = !self.tiled || LaneTile::candidates(limits, self.factor).len() > 1;
        let multiplied = self.matrix || self.factor != Element::I8 || limits.dot_products;
        stored && tiled && multiplied && (!self.matrix || limits.matrices.of(self.factor).is_some())
    }

    /// The kernel of a linear layer on lanes, with factors of a type.
    fn on_lanes(self, factor: Element) -> LinearKernel {
        let tiles = if self.tiled { Tiles::always(1) } else { Tiles::BY_RULE };
        match factor {
            Element::I8 => LinearKernel::Dots(tiles),
            _ => LinearKernel::Panels(Lanes { tiles, ..Lanes::of(factor) }, self.weights),
        }
    }

    /// The matrix units that it takes.
    fn units(self, device: &Device) -> Option<Units> {
        Units::of(self.factor, device.limits()).filter(|_| self.matrix)
    }

    fn factors(self) -> Factors {
        let roundings = if self.matrix { 2 } else { 1 };
        let exact = Factors { unit: 0.0, tiny: 0.0, roundings };
        // A device may flush what is subnormal.
        let half = Factors { unit: (-11f64).exp2(), tiny: (-14f64).exp2(), roundings };
        match self.factor {
            Element::F32 => exact,
            Element::F16 | Element::I8 => half,
            Element::Bf16 => Factors { unit: (-8f64).exp2(), tiny: bound::TINY, roundings },
        }
    }
}

impl Serialize for Mode {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// Cases of one kernel.
pub struct Area {
    /// The kernel's name, as in a profile, or that of several.
    pub kernel: &'static str,
    /// The unit in which the size of a case is counted.
    pub size: &'static str,
    /// Why the bound holds.
    pub reason: &'static str,
    /// The modes that there are of it.
    pub modes: &'static [Mode],
    /// The cases that are computed.
    pub cases: Vec<Case>,
}

/// One case in one mode.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// Kernel.
    pub kernel: &'static str,
    /// The difficulty of the case.
    pub case: String,
    /// Arithmetic.
    pub mode: Mode,
    /// How large it is.
    pub size: usize,
    /// Whether every element is within its bound.
    pub holds: bool,
    /// The worst element; errors that are not finite are null in JSON.
    #[serde(flatten)]
    pub worst: Worst,
    /// The reason why it could not be computed, where there is one.
    pub failed: Option<String>,
    /// The faults that the case is there to catch.
    pub catches: Vec<String>,
}

impl Area {
    /// The cases in every mode that a device has.
    pub fn on(&self, limits: &Limits) -> impl Iterator<Item = (&Case, Mode)> {
        let modes = self.modes.iter().copied().filter(|mode| mode.is_on(limits));
        modes.flat_map(|mode| self.cases.iter().map(move |case| (case, mode)))
    }

    /// Computes one of its cases on a device. What a driver refuses to do does not hold.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], after which nothing can be computed.
    pub fn examine(&self, case: &Case, device: &Device, mode: Mode) -> Result<Finding> {
        let (worst, failed) = match case.check(device, mode) {
            Err(Error::DeviceLost) => return Err(Error::DeviceLost),
            Err(error) => (Worst::UNKNOWN, Some(error.to_string())),
            Ok(worst) => (worst, None),
        };
        let (kernel, name) = (self.kernel, case.name.clone());
        let (size, catches) = (case.size, case.catches.clone());
        Ok(Finding { kernel, case: name, mode, size, holds: worst.share <= 1.0, worst, failed, catches })
    }
}

/// Everything, in the order of the data.
pub fn catalogue() -> Vec<Area> {
    vec![
        linear::area(),
        linear::q8_area(),
        norm::area(),
        convolution::area(),
        pixel_shuffle::area(),
        resize::area(),
        positions::area(),
        attention::area(),
        cameras::area(),
        cluster::nearest(),
        cluster::kmeans(),
        head::area(),
        sort::area(),
        splatting::area(),
        loss::area(),
        splatting_backward::rasterise(),
        splatting_backward::color(),
        splatting_backward::project(),
        splatting_backward::cameras(),
        head_backward::activations(),
        head_backward::gelu(),
        adam::area(),
    ]
}
