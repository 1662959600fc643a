//! Verification of kernels: device results against f64, with bounds from the number format.
//!
//! An area covers related kernels. Its cases have hard inputs, f64 results of `zipsplat_reference`,
//! bounds per element, and simulated faults, whose error must exceed twice the bound
//! (`tests/kernels/catalog.rs`). Bounds are never loosened to pass.
#![allow(missing_docs, reason = "read with the code: names and shapes document most items")]

mod bound;
mod case;
pub mod network;
pub mod noise;
mod tolerance;
mod trial;

mod backbone {
    pub mod camera_encoder;
}
mod cluster;
mod features;
mod gaussians {
    pub mod activate;
    pub mod activate_backward;
}
mod heads {
    pub mod convolution;
    pub mod modulate;
    pub mod pixel_shuffle;
    pub mod resize;
}
mod loss {
    pub mod depth;
    pub mod gradient;
    pub mod targets;
}
mod ops {
    pub mod attention;
    pub mod gelu;
    pub mod layer_norm;
    pub mod linear;
    pub mod sort;
    pub mod split_heads;
}
mod refine {
    pub mod adam;
    pub mod anisotropy;
    pub mod dropout;
    pub mod exposure;
}
mod render {
    pub mod backward;
    pub mod forward;
}

mod prelude {
    pub(crate) use crate::{
        Area, Catches, Mode, Tolerance, Worst,
        bound::*,
        case::{self, Values, halves, joined, shifted},
        noise::{Noise, camera},
        trial::Trial,
    };
    pub use zipsplat::{
        Result,
        gpu::{Device, Element, Limits},
        kernels::limits::GROUP_FOLD,
        ops::Rows,
    };
    pub use zipsplat_reference::widen;
}

pub use bound::Worst;
pub use cluster::nearest::{Chosen, Truth as NearestTruth};
pub use gaussians::activate::run as activate;
pub use ops::linear::{Problem as Layer, Residual};

use case::Catches;
pub use case::{CAUGHT, Case, Injected};
pub use render::forward::picture::{gaussians, reference_camera};
pub use tolerance::Tolerance;
pub use trial::Trial;

use serde::Serialize;
use zipsplat::{
    Error, Result,
    gpu::{Device, Element, Limits},
    ops::{LaneTile, Lanes, LinearKernel, Tiles, Units, Weights},
};

/// Arithmetic of matrix products.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mode {
    pub factor: Element,
    /// Matrix units; otherwise a result per lane.
    pub matrix: bool,
    /// Weight layout on the device.
    pub weights: Weights,
    /// Lanes tile the factors in shared memory.
    pub tiled: bool,
}

#[derive(Clone, Copy, Debug)]
struct Factors {
    unit: f64,
    /// Values below may be flushed.
    tiny: f64,
    /// Roundings per term of a sum: matrix units may truncate (Fasi, Higham, Mikaitis and Pranesh,
    /// Numerical behavior of NVIDIA tensor cores, 2021).
    roundings: usize,
}

impl Factors {
    /// Error bound of a sum of `n` products, relative to their magnitudes, without factor rounding.
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

    /// All modes, those of linear layers.
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
    /// Linear layers with 8-bit weights.
    const Q8: &[Mode] = &[
        Mode { weights: Weights::Q8, ..Mode::EXACT },
        Mode { weights: Weights::Q8, ..Mode::TILED },
        Mode { weights: Weights::Q8, ..Mode::F16 },
        Mode { weights: Weights::Q8, ..Mode::BF16 },
        Mode { weights: Weights::Q8, ..Mode::F16_MATRIX },
        Mode { weights: Weights::Q8, ..Mode::BF16_MATRIX },
    ];
    /// Attention.
    const FLOATS: &[Mode] = &[Mode::EXACT, Mode::F16, Mode::BF16, Mode::F16_MATRIX, Mode::BF16_MATRIX];
    /// Nearest-row search.
    const NEAREST: &[Mode] = &[Mode::EXACT, Mode::F16_MATRIX];
    /// Kernels in f32 with results of every type.
    const STORED: &[Mode] = &[Mode::EXACT, Mode::F16, Mode::BF16];
    /// Kernels that are always f32.
    const ONLY_EXACT: &[Mode] = &[Mode::EXACT];

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

    fn is_on(self, limits: &Limits) -> bool {
        let stored = self.factor == Element::F32 || limits.half_storage;
        let tiled = !self.tiled || LaneTile::candidates(limits, self.factor).len() > 1;
        let multiplied = self.matrix || self.factor != Element::I8 || limits.dot_products;
        stored && tiled && multiplied && (!self.matrix || limits.matrices.of(self.factor).is_some())
    }

    fn on_lanes(self, factor: Element) -> LinearKernel {
        let tiles = if self.tiled { Tiles::always(1) } else { Tiles::BY_RULE };
        match factor {
            Element::I8 => LinearKernel::Dots(tiles),
            _ => LinearKernel::Panels(Lanes { tiles, ..Lanes::of(factor) }, self.weights),
        }
    }

    fn units(self, device: &Device) -> Option<Units> {
        Units::of(self.factor, device.limits()).filter(|_| self.matrix)
    }

    /// Bound of a value stored in this type, where f16 may round either way.
    fn stored(self, value: f64, bound: f64) -> f64 {
        let Factors { unit, tiny, .. } = self.factors();
        let unit = if self.factor == Element::F16 { 2.0 * unit } else { unit };
        bound + unit * (value.abs() + bound) + tiny
    }

    fn factors(self) -> Factors {
        let roundings = if self.matrix { 2 } else { 1 };
        let exact = Factors { unit: 0.0, tiny: 0.0, roundings };
        // A device may flush subnormals.
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

pub struct Area {
    pub kernel: &'static str,
    /// Unit of sizes.
    pub size: &'static str,
    pub reason: &'static str,
    pub modes: &'static [Mode],
    pub cases: Vec<Case>,
}

#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    pub kernel: &'static str,
    pub case: String,
    pub mode: Mode,
    pub size: usize,
    pub holds: bool,
    /// Worst element; non-finite errors are null in JSON.
    #[serde(flatten)]
    pub worst: Worst,
    pub failed: Option<String>,
    pub catches: Vec<String>,
}

impl Area {
    fn new(kernel: &'static str, size: &'static str, modes: &'static [Mode], reason: &'static str) -> Self {
        Self { kernel, size, reason, modes, cases: Vec::new() }
    }

    fn add<P: case::Problem>(
        &mut self,
        name: impl Into<String>,
        size: usize,
        faults: impl Into<Catches<P::Fault>>,
        make: impl Fn() -> P + 'static,
    ) {
        self.sweep(name, size, faults, move || vec![make()]);
    }

    fn sweep<P: case::Problem>(
        &mut self,
        name: impl Into<String>,
        size: usize,
        faults: impl Into<Catches<P::Fault>>,
        make: impl Fn() -> Vec<P> + 'static,
    ) {
        self.cases.push(Case::sweep(name, size, faults, make));
    }

    pub fn supported_modes(&self, limits: &Limits) -> impl Iterator<Item = Mode> {
        self.modes.iter().copied().filter(|mode| mode.is_on(limits))
    }

    /// Returns the cases in every supported mode.
    pub fn on(&self, limits: &Limits) -> impl Iterator<Item = (&Case, Mode)> {
        self.supported_modes(limits).flat_map(|mode| self.cases.iter().map(move |case| (case, mode)))
    }

    /// Computes a case on a device. A driver error becomes a failed finding.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], after which the device is unusable.
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

/// Returns areas with many shapes, which only tests run.
pub fn shapes() -> Vec<Area> {
    vec![
        ops::linear::shapes(),
        ops::linear::q8_shapes(),
        ops::layer_norm::shapes(),
        heads::pixel_shuffle::shapes(),
        heads::resize::shapes(),
        ops::attention::shapes(),
        cluster::nearest_shapes(),
        gaussians::activate::shapes(),
        ops::sort::shapes(),
        ops::gelu::shapes(),
    ]
}

/// Returns the areas of `zipsplat doctor`.
pub fn catalog() -> Vec<Area> {
    vec![
        ops::linear::area(),
        ops::linear::q8_area(),
        ops::layer_norm::area(),
        heads::convolution::area(),
        heads::modulate::area(),
        heads::pixel_shuffle::area(),
        heads::resize::area(),
        ops::split_heads::area(),
        ops::attention::area(),
        backbone::camera_encoder::area(),
        cluster::nearest_area(),
        cluster::kmeans(),
        gaussians::activate::area(),
        ops::sort::area(),
        render::forward::area(),
        loss::targets::area(),
        loss::gradient::area(),
        loss::depth::area(),
        render::backward::rasterize::area(),
        render::backward::color(),
        render::backward::project(),
        render::backward::cameras(),
        features::area(),
        gaussians::activate_backward::area(),
        ops::gelu::area(),
        refine::adam::area(),
        refine::anisotropy::area(),
        refine::dropout::area(),
        refine::exposure::area(),
    ]
}
