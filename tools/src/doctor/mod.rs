//! The numerical catalogue: what kernels compute on a device, beside the same in f64, under bounds that follow from the
//! number format.
//!
//! An area is a kernel or a few that mean something together. It says why its bound holds, and has cases: inputs chosen to
//! be hard, their truth from `zipsplat_reference`, and the bound of every element. A bound that does not hold is a wrong
//! kernel, a wrong driver or a wrong bound; none is loosened to pass.

mod attention;
mod bound;
mod cameras;
mod cluster;
mod head;
mod linear;
mod norm;
mod picture;
mod positions;
pub mod report;
mod sort;
mod splatting;
mod trial;

pub use bound::Worst;

use half::f16;
use serde::Serialize;
use zipsplat::{
    Result,
    gpu::{Device, Limits},
};

/// Arithmetic of matrix products: the only thing that precision modes differ in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// f32 throughout.
    Exact,
    /// f16 factors and f32 sums, one lane a result.
    Fast,
    /// f16 factors and f32 sums, on matrix units.
    Matrix,
}

/// How a mode holds the factors of matrix products.
#[derive(Clone, Copy, Debug)]
struct Factors {
    /// The most that rounding moves one, relatively.
    unit: f64,
    /// The most that it moves one near zero.
    tiny: f64,
    /// Factors saturate here.
    largest: f64,
    /// Units of rounding that a step of a sum may cost: matrix units may truncate (Fasi, Higham, Mikaitis and Pranesh,
    /// Numerical behavior of NVIDIA tensor cores, 2021).
    step: usize,
}

impl Factors {
    /// The most by which a sum of `n` products moves relative to their magnitudes, rounding of the factors apart.
    fn sum(&self, n: usize) -> f64 {
        bound::gamma(self.step * n)
    }
}

impl Mode {
    /// Every mode.
    pub const ALL: &[Mode] = &[Mode::Exact, Mode::Fast, Mode::Matrix];
    /// Of what is f32 in every mode: norms, softmax, clustering, geometry.
    const EXACT: &[Mode] = &[Mode::Exact];

    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Mode::Exact => "exact",
            Mode::Fast => "fast",
            Mode::Matrix => "matrix",
        }
    }

    /// Whether a device has it.
    pub fn is_on(self, limits: &Limits) -> bool {
        match self {
            Mode::Exact => true,
            Mode::Fast => limits.half_storage,
            Mode::Matrix => limits.half_storage && limits.matrices.is_some(),
        }
    }

    fn factors(self) -> Factors {
        // Of 11 bits; a device may flush what is subnormal.
        let half = Factors { unit: (-11f64).exp2(), tiny: (-14f64).exp2(), largest: 65504.0, step: 1 };
        match self {
            Mode::Exact => Factors { unit: 0.0, tiny: 0.0, largest: f64::INFINITY, step: 1 },
            Mode::Fast => half,
            Mode::Matrix => Factors { step: 2, ..half },
        }
    }
}

/// Cases of one kernel.
pub struct Area {
    /// The kernel's name, as in a profile, or that of several.
    pub kernel: &'static str,
    /// What the size of a case counts.
    pub size: &'static str,
    /// Why the bound holds.
    pub reason: &'static str,
    /// The modes that there are of it.
    pub modes: &'static [Mode],
    /// What is computed.
    pub cases: Vec<Case>,
}

/// Computes a case on a device and compares.
type Check = dyn Fn(&Device, Mode) -> Result<Worst>;

/// One hard input.
pub struct Case {
    /// What is hard about it.
    pub name: String,
    /// How large it is, for the report.
    pub size: usize,
    check: Box<Check>,
}

impl Case {
    fn new(name: impl Into<String>, size: usize, check: impl Fn(&Device, Mode) -> Result<Worst> + 'static) -> Self {
        Self { name: name.into(), size, check: Box::new(check) }
    }
}

/// One case in one mode.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// Kernel.
    pub kernel: &'static str,
    /// What is hard about it.
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
}

impl Area {
    /// Its cases in every mode that a device has.
    pub fn on(&self, limits: &Limits) -> impl Iterator<Item = (&Case, Mode)> {
        let modes = self.modes.iter().copied().filter(|mode| mode.is_on(limits));
        modes.flat_map(|mode| self.cases.iter().map(move |case| (case, mode)))
    }

    /// Computes one of its cases on a device.
    ///
    /// # Errors
    /// Where the device has too little memory or fails.
    pub fn examine(&self, case: &Case, device: &Device, mode: Mode) -> Result<Finding> {
        let worst = (case.check)(device, mode)?;
        let (kernel, name) = (self.kernel, case.name.clone());
        Ok(Finding { kernel, case: name, mode, size: case.size, holds: worst.share <= 1.0, worst })
    }
}

/// As a device in f16 holds it.
fn halves(values: &[f32]) -> Vec<u16> {
    values.iter().map(|v| f16::from_f32(v.clamp(-65504.0, 65504.0)).to_bits()).collect()
}

/// Everything, in the order of the data.
pub fn catalogue() -> Vec<Area> {
    vec![
        linear::area(),
        norm::area(),
        positions::area(),
        attention::area(),
        cameras::area(),
        cluster::nearest(),
        cluster::kmeans(),
        head::area(),
        sort::area(),
        splatting::area(),
    ]
}
