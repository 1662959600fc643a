//! A plan on a device, with outputs that reveal missing and stray writes.

use bytemuck::Pod;
use zipsplat::{
    Error, Result,
    gpu::{Device, Element, Limits, Recorder, Run, Tensor},
};

/// NaN as f32 and as f16 pairs; out of range as an index.
pub const UNWRITTEN: u32 = 0xffff_ffff;

/// Guard bytes behind an output.
const GUARD: usize = 256;

pub struct Trial<'a> {
    device: &'a Device,
    pub rec: Recorder,
    inputs: Vec<(Tensor, Vec<u8>)>,
    /// Outputs with guards, and their bytes without.
    guarded: Vec<(Tensor, usize)>,
}

impl<'a> Trial<'a> {
    pub fn new(device: &'a Device) -> Self {
        Self::within(device, device.limits())
    }

    /// For narrower limits than the device's.
    pub fn within(device: &'a Device, limits: &Limits) -> Self {
        Self { device, rec: Recorder::new(limits), inputs: Vec::new(), guarded: Vec::new() }
    }

    pub(crate) fn changed(device: &'a Device, change: fn(&mut Limits)) -> Self {
        let mut limits = device.limits().clone();
        change(&mut limits);
        Self::within(device, &limits)
    }

    pub fn input<T: Pod>(&mut self, values: &[T]) -> Tensor {
        let tensor = self.rec.input::<T>("input", values.len());
        self.inputs.push((tensor, bytemuck::cast_slice(values).to_vec()));
        tensor
    }

    pub fn input_of(&mut self, element: Element, values: &[f32]) -> Tensor {
        self.input(&element.encode(values))
    }

    pub(crate) fn blank(&mut self, tensor: Tensor) {
        self.rec.fill(tensor, UNWRITTEN);
    }

    /// A guarded output of `len` values, filled with NaN.
    pub fn output<T>(&mut self, len: usize) -> Tensor {
        let bytes = len * size_of::<T>();
        let whole = self.rec.tensor::<u8>("output", bytes + GUARD);
        self.blank(whole);
        self.rec.output(whole);
        self.guarded.push((whole, bytes));
        whole.slice::<T>(0, len)
    }

    pub fn output_of(&mut self, element: Element, len: usize) -> Tensor {
        self.output::<u8>(element.bytes() * len)
    }

    /// # Errors
    /// The device's, and [`Error::Driver`] for a write behind an output.
    pub fn run(self) -> Result<Run> {
        let mut run = Run::new(self.device, self.rec.finish()?)?;
        for (tensor, bytes) in &self.inputs {
            run.write(*tensor, bytes)?;
        }
        run.execute()?;
        for (whole, bytes) in self.guarded {
            let behind = &run.read::<u8>(whole)?[bytes..];
            let written = behind.iter().filter(|byte| **byte != UNWRITTEN as u8).count();
            if written > 0 {
                return Err(Error::Driver { call: "a kernel", result: format!("{written} bytes behind its output") });
            }
        }
        Ok(run)
    }

    pub fn results<T: Pod, const N: usize>(mut self, outputs: [Tensor; N]) -> Result<[Vec<T>; N]> {
        outputs.iter().for_each(|output| self.rec.output(*output));
        let run = self.run()?;
        let mut values = outputs.iter().map(|output| run.read(*output)).collect::<Result<Vec<_>>>()?.into_iter();
        Ok([(); N].map(|()| values.next().unwrap_or_default()))
    }

    pub fn result<T: Pod>(self, output: Tensor) -> Result<Vec<T>> {
        let [values] = self.results([output])?;
        Ok(values)
    }

    pub fn result_of(self, element: Element, output: Tensor) -> Result<Vec<f32>> {
        Ok(element.decode(&self.result::<u8>(output)?))
    }
}
