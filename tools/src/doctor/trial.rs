//! A plan on the device under test: inputs with their values, and outputs that show what was not written.

use bytemuck::Pod;
use zipsplat::{
    Result,
    gpu::{Device, Recorder, Run, Tensor},
};

/// Not a number, as f32 and as pairs of f16; far out of range as an index.
pub const UNWRITTEN: u32 = 0xffff_ffff;

/// Something to compute.
pub struct Trial<'a> {
    device: &'a Device,
    /// Where it is recorded.
    pub rec: Recorder,
    inputs: Vec<(Tensor, Vec<u8>)>,
}

impl<'a> Trial<'a> {
    /// Nothing yet.
    pub fn new(device: &'a Device) -> Self {
        Self { device, rec: Recorder::new(device.limits()), inputs: Vec::new() }
    }

    /// A tensor with these values.
    pub fn input<T: Pod>(&mut self, values: &[T]) -> Tensor {
        let tensor = self.rec.input::<T>("input", values.len());
        self.inputs.push((tensor, bytemuck::cast_slice(values).to_vec()));
        tensor
    }

    /// Makes every value of a tensor NaN, before anything is written there.
    pub fn blank(&mut self, tensor: Tensor) {
        self.rec.fill(tensor, UNWRITTEN);
    }

    /// A tensor for `len` results.
    pub fn output<T>(&mut self, len: usize) -> Tensor {
        let tensor = self.rec.tensor::<T>("output", len);
        self.blank(tensor);
        self.rec.output(tensor);
        tensor
    }

    /// Runs the plan.
    pub fn run(self) -> Result<Run> {
        let mut run = Run::new(self.device, self.rec.finish()?)?;
        for (tensor, bytes) in &self.inputs {
            run.write(*tensor, bytes)?;
        }
        run.execute()?;
        Ok(run)
    }

    /// Runs the plan and reads one result.
    pub fn result<T: Pod>(self, output: Tensor) -> Result<Vec<T>> {
        self.run()?.read(output)
    }
}
