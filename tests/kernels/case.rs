//! One plan under test: inputs with their values, and outputs that show what was not written and what should not have been.

use bytemuck::Pod;
use zipsplat::gpu::{Element, Limits, Recorder, Run, Tensor};
use zipsplat::ops::{AttentionKernel, Lanes, LinearKernel, NearestKernel, Tiles, Units, Weights};
use zipsplat_tests::device::device;
pub use zipsplat_tests::random::{random, random_below};

/// Bytes behind an output that nothing may write.
const GUARD: usize = 256;

/// Every byte of an output before the plan runs: NaN as f32, and as an index far out of range.
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

    /// A plan for narrower limits than the device's.
    pub fn within(limits: &Limits) -> Case {
        Case { rec: Recorder::new(limits), inputs: Vec::new(), guarded: Vec::new() }
    }

    pub fn input<T: Pod>(&mut self, values: &[T]) -> Tensor {
        let tensor = self.rec.input::<T>("input", values.len());
        self.inputs.push((tensor, bytemuck::cast_slice(values).to_vec()));
        tensor
    }

    /// Values as a kernel takes them in this type.
    pub fn input_of(&mut self, element: Element, values: &[f32]) -> Tensor {
        self.input(&element.encode(values))
    }

    /// A tensor of `len` results of this type.
    pub fn output_of(&mut self, element: Element, len: usize) -> Tensor {
        self.output::<u8>(element.bytes() * len)
    }

    /// Runs the plan and reads one result of this type.
    pub fn result_of(self, element: Element, output: Tensor) -> Vec<f32> {
        element.decode(&self.result::<u8>(output))
    }

    /// A tensor of `len` results.
    pub fn output<T>(&mut self, len: usize) -> Tensor {
        let bytes = len * size_of::<T>();
        let whole = self.rec.tensor::<u8>("output", bytes + GUARD);
        self.rec.fill(whole, u32::from_ne_bytes([UNWRITTEN; 4]));
        self.rec.output(whole);
        self.guarded.push((whole, bytes));
        whole.slice::<T>(0, len)
    }

    /// Runs the plan to its end; results are read from what it returns.
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

    /// Runs the plan and reads one result.
    pub fn result<T: Pod>(self, output: Tensor) -> Vec<T> {
        self.run().read(output).unwrap()
    }
}

/// Number types that the device's kernels take.
pub fn elements() -> Vec<Element> {
    let half = device().limits().half_storage.then_some(Element::HALVES);
    [Element::F32].into_iter().chain(half.into_iter().flatten()).collect()
}

/// Kernels of linear layers that the device has, for weights in the type of the factors: on lanes by rule and with the first tile
/// in shared memory, and by dot products.
pub fn linear_kernels() -> Vec<LinearKernel> {
    let lanes = |element| [Lanes::of(element), Lanes { element, tiles: Tiles::always(1) }];
    let panels = elements().into_iter().flat_map(lanes).map(|lanes| LinearKernel::Panels(lanes, Weights::Factors));
    let units = Element::FACTORS.into_iter().filter_map(|factor| Units::of(factor, device().limits()));
    let dots = device().limits().dot_products.then_some(LinearKernel::Dots(Tiles::BY_RULE));
    panels.chain(units.map(|units| LinearKernel::Matrix(units, Weights::Factors))).chain(dots).collect()
}

/// The limits, and for a kernel with a twin that reads by address, where the device can, those of a device that cannot.
pub fn with_and_without_addresses(limits: &Limits, has_twin: bool) -> Vec<Limits> {
    let bound = (has_twin && limits.addresses).then(|| Limits { addresses: false, ..limits.clone() });
    [limits.clone()].into_iter().chain(bound).collect()
}

/// Those that have one for weights of 8 bits, and that.
pub fn q8_kernels() -> Vec<[LinearKernel; 2]> {
    linear_kernels().into_iter().filter_map(|kernel| Some([kernel, kernel.with_q8()?])).collect()
}

/// Kernels of attention that the device has, with tiles by rule.
pub fn attention_kernels() -> Vec<AttentionKernel> {
    let lanes = elements().into_iter().map(AttentionKernel::Lanes);
    let limits = device().limits();
    let units = Element::HALVES.into_iter().filter_map(|factor| Units::of(factor, limits));
    lanes.chain(units.map(AttentionKernel::Matrix)).collect()
}

/// Kernels that find nearest rows that the device has.
pub fn nearest_kernels() -> Vec<NearestKernel> {
    let matrix = Units::of(Element::F16, device().limits()).map(NearestKernel::Matrix);
    [NearestKernel::Lanes].into_iter().chain(matrix).collect()
}

/// Values as they are once they are stored in this type.
pub fn stored(element: Element, values: Vec<f32>) -> Vec<f32> {
    element.decode(&element.encode(&values))
}

/// f64 results of at most one rounding each as the f32 that a kernel gives exactly.
pub fn rounded(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&x| x as f32).collect()
}
