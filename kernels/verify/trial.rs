//! Plan on the tested device whose outputs reveal unwritten values.

use bytemuck::Pod;
use zipsplat::{
    Result,
    gpu::{Device, Limits, Recorder, Run, Tensor},
};

/// NaN as f32 and as f16 pairs; out of range as an index.
pub const UNWRITTEN: u32 = 0xffff_ffff;

pub struct Trial<'a> {
    device: &'a Device,
    pub rec: Recorder,
    inputs: Vec<(Tensor, Vec<u8>)>,
}

impl<'a> Trial<'a> {
    pub fn new(device: &'a Device) -> Self {
        Self::within(device, |_| ())
    }

    /// Creates a plan within changed limits.
    pub fn within(device: &'a Device, change: fn(&mut Limits)) -> Self {
        let mut limits = device.limits().clone();
        change(&mut limits);
        Self { device, rec: Recorder::new(&limits), inputs: Vec::new() }
    }

    pub fn input<T: Pod>(&mut self, values: &[T]) -> Tensor {
        let tensor = self.rec.input::<T>("input", values.len());
        self.inputs.push((tensor, bytemuck::cast_slice(values).to_vec()));
        tensor
    }

    /// Fills a tensor with NaN.
    pub fn blank(&mut self, tensor: Tensor) {
        self.rec.fill(tensor, UNWRITTEN);
    }

    pub fn output<T>(&mut self, len: usize) -> Tensor {
        let tensor = self.rec.tensor::<T>("output", len);
        self.blank(tensor);
        self.rec.output(tensor);
        tensor
    }

    pub fn run(self) -> Result<Run> {
        let mut run = Run::new(self.device, self.rec.finish()?)?;
        for (tensor, bytes) in &self.inputs {
            run.write(*tensor, bytes)?;
        }
        run.execute()?;
        Ok(run)
    }

    pub fn result<T: Pod>(self, output: Tensor) -> Result<Vec<T>> {
        self.run()?.read(output)
    }
}
