//! One plan under test, with outputs that detect missing and stray writes.

use bytemuck::Pod;
use zipsplat::gpu::{Element, Limits, Recorder, Run, Tensor};
use zipsplat::ops::{Lanes, LinearKernel, NearestKernel, Tiles, Units, Weights};
use zipsplat_tests::device::device;
pub use zipsplat_tests::random::{random, random_below};

/// Guard bytes behind an output.
const GUARD: usize = 256;

/// Fill byte of outputs: NaN as f32, out of range as an index.
const UNWRITTEN: u8 = 0xff;

pub struct Case {
    pub rec: Recorder,
    inputs: Vec<(Tensor, Vec<u8>)>,
    guarded: Vec<(Tensor, usize)>,
}

impl Case {
    pub fn new() -> Case {
        Case::within(device().limits())
    }

    /// Creates a plan for narrower limits than the device's.
    pub fn within(limits: &Limits) -> Case {
        Case { rec: Recorder::new(limits), inputs: Vec::new(), guarded: Vec::new() }
    }

    pub fn input<T: Pod>(&mut self, values: &[T]) -> Tensor {
        let tensor = self.rec.input::<T>("input", values.len());
        self.inputs.push((tensor, bytemuck::cast_slice(values).to_vec()));
        tensor
    }

    /// Uploads values in this type.
    pub fn input_of(&mut self, element: Element, values: &[f32]) -> Tensor {
        self.input(&element.encode(values))
    }

    /// Allocates an output of `len` values of this type.
    pub fn output_of(&mut self, element: Element, len: usize) -> Tensor {
        self.output::<u8>(element.bytes() * len)
    }

    /// Runs the plan and reads one output of this type.
    pub fn result_of(self, element: Element, output: Tensor) -> Vec<f32> {
        element.decode(&self.result::<u8>(output))
    }

    /// Allocates an output of `len` values.
    pub fn output<T>(&mut self, len: usize) -> Tensor {
        let bytes = len * size_of::<T>();
        let whole = self.rec.tensor::<u8>("output", bytes + GUARD);
        self.rec.fill(whole, u32::from_ne_bytes([UNWRITTEN; 4]));
        self.rec.output(whole);
        self.guarded.push((whole, bytes));
        whole.slice::<T>(0, len)
    }

    /// Runs the plan and returns the results.
    pub fn run(self) -> Run {
        let mut run = Run::new(device(), self.rec.finish().unwrap()).unwrap();
        for (tensor, bytes) in &self.inputs {
            run.write(*tensor, bytes).unwrap();
        }
        run.execute().unwrap();
        for (whole, bytes) in self.guarded {
            let behind = &run.read::<u8>(whole).unwrap()[bytes..];
            assert!(behind.iter().all(|byte| *byte == UNWRITTEN), "written behind an output of {bytes} bytes");
        }
        run
    }

    /// Runs the plan and reads one output.
    pub fn result<T: Pod>(self, output: Tensor) -> Vec<T> {
        self.run().read(output).unwrap()
    }
}

/// Returns the device's element types.
pub fn elements() -> Vec<Element> {
    let half = device().limits().half_storage.then_some(Element::HALVES);
    [Element::F32].into_iter().chain(half.into_iter().flatten()).collect()
}

/// Returns the device's linear kernels with weights in the factors' type, on lanes both by rule and
/// with the first tile in shared memory.
pub fn linear_kernels() -> Vec<LinearKernel> {
    let lanes = |element| [Lanes::of(element), Lanes { element, tiles: Tiles::always(1) }];
    let panels = elements().into_iter().flat_map(lanes).map(|lanes| LinearKernel::Panels(lanes, Weights::Factors));
    let units = Element::FACTORS.into_iter().filter_map(|factor| Units::of(factor, device().limits()));
    let dots = device().limits().dot_products.then_some(LinearKernel::Dots(Tiles::BY_RULE));
    panels.chain(units.map(|units| LinearKernel::Matrix(units, Weights::Factors))).chain(dots).collect()
}

/// Returns the limits and, for a kernel with a variant that reads by address, limits without
/// addresses.
pub fn with_and_without_addresses(limits: &Limits, has_twin: bool) -> Vec<Limits> {
    let bound = (has_twin && limits.addresses).then(|| Limits { addresses: false, ..limits.clone() });
    [limits.clone()].into_iter().chain(bound).collect()
}

/// Returns the linear kernels that have a variant for 8-bit weights, with the variant.
pub fn q8_kernels() -> Vec<[LinearKernel; 2]> {
    linear_kernels().into_iter().filter_map(|kernel| Some([kernel, kernel.with_q8()?])).collect()
}

/// Returns the device's nearest-row kernels.
pub fn nearest_kernels() -> Vec<NearestKernel> {
    let matrix = Units::of(Element::F16, device().limits()).map(NearestKernel::Matrix);
    [NearestKernel::Lanes].into_iter().chain(matrix).collect()
}

/// Rounds values to this type and back.
pub fn stored(element: Element, values: Vec<f32>) -> Vec<f32> {
    element.decode(&element.encode(&values))
}

/// Rounds f64 results of at most one rounding to the f32 that a kernel computes exactly.
pub fn rounded(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&x| x as f32).collect()
}
