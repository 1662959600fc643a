use crate::{
    Error, Result,
    gpu::{Device, Limits, Recorder, Resident, Run, Tensor},
    ops::{Arithmetic, ParameterLayout},
    stages::lpips::{Lpips, LpipsNetwork, LpipsPictures},
    tune::KernelChoice,
    weights::Values,
};
use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::Arc,
};

/// LPIPS 0.1, with third-party weights.
pub struct Perceptual {
    device: Device,
    network: LpipsNetwork,
    has_gradients: bool,
    weights: LpipsWeights,
    /// Distance, gradient.
    prepared: [Option<Prepared>; 2],
}

pub(crate) struct LpipsWeights {
    pub lpips: Lpips,
    pub resident: Arc<Resident>,
}

impl LpipsWeights {
    pub fn layout(
        limits: &Limits,
        arithmetic: Arithmetic,
        network: LpipsNetwork,
        gradients: bool,
    ) -> (ParameterLayout, Lpips) {
        let mut parameters = ParameterLayout::new(limits, arithmetic);
        let lpips = Lpips::new(&mut parameters, network, gradients);
        (parameters, lpips)
    }

    pub fn open(device: &Device, network: LpipsNetwork, path: &Path, gradients: bool) -> Result<Self> {
        let arithmetic = KernelChoice::exact(device);
        let layout = |gradients: bool| Self::layout(device.limits(), arithmetic, network, gradients);
        let name = format!("LPIPS ({})", network.name());
        let tensors = Values::open(path, &name, layout(false).0.names_and_shapes())?;
        let (parameters, lpips) = layout(gradients);
        let resident = parameters.load(device, &tensors, |_| ControlFlow::Continue(()))?.resident;
        Ok(Self { lpips, resident })
    }
}

struct Prepared {
    size: [u32; 2],
    run: Run,
    pictures: [Tensor; 2],
    value: Tensor,
    gradient: Option<Tensor>,
}

impl Perceptual {
    /// Path of the weights in a cache folder; [`Error::Argument`] has the command to fetch them.
    pub fn file(network: LpipsNetwork, cache: Option<&Path>) -> Result<PathBuf> {
        let name = format!("lpips_{}.safetensors", network.name());
        let folder = cache.unwrap_or(Path::new(""));
        let path = folder.join(&name);
        let missing = || {
            let expected = format!("{name} there: `python3 tools/lpips.py` fetches it (64 MB)");
            Error::argument("weights of LPIPS", format!("nothing in {}", folder.display()), expected)
        };
        if path.is_file() { Ok(path) } else { Err(missing()) }
    }

    pub fn open(device: &Device, network: LpipsNetwork, path: &Path, gradients: bool) -> Result<Self> {
        let weights = LpipsWeights::open(device, network, path, gradients)?;
        let (device, has_gradients, prepared) = (device.clone(), gradients, [None, None]);
        Ok(Self { device, network, has_gradients, weights, prepared })
    }

    pub fn network(&self) -> LpipsNetwork {
        self.network
    }

    /// Returns the distance of unclamped images `[height][width][rgb]` in 0..1, of size `[width,
    /// height]`.
    pub fn distance(&mut self, pictures: [&[f32]; 2], size: [u32; 2]) -> Result<f64> {
        Ok(self.run(pictures, size, false)?.0)
    }

    /// Returns the distance of clamped images and its gradient for the first.
    ///
    /// # Panics
    /// If loaded without gradients.
    pub fn gradient(&mut self, pictures: [&[f32]; 2], size: [u32; 2]) -> Result<(f64, Vec<f32>)> {
        assert!(self.has_gradients, "weights that were loaded with gradients");
        self.run(pictures, size, true)
    }

    fn run(&mut self, [a, b]: [&[f32]; 2], size: [u32; 2], gradient: bool) -> Result<(f64, Vec<f32>)> {
        let least = self.network.least_side();
        let [width, height] = size;
        if width.min(height) < least {
            let expected = format!("at least {least}x{least} pixels");
            return Err(Error::argument("pictures for LPIPS", format!("{width}x{height}"), expected));
        }
        let values = 3 * width as usize * height as usize;
        for picture in [a, b] {
            if picture.len() != values {
                let expected = format!("{values} of {width}x{height} pixels");
                return Err(Error::argument("values of a picture", picture.len(), expected));
            }
        }
        let prepared = match self.prepared[usize::from(gradient)].take() {
            Some(prepared) if prepared.size == size => prepared,
            _ => self.prepare(size, gradient)?,
        };
        let Prepared { run, pictures, value, gradient, .. } = self.prepared[usize::from(gradient)].insert(prepared);
        run.write(pictures[0], a)?;
        run.write(pictures[1], b)?;
        run.execute()?;
        let gradient = gradient.map_or(Ok(Vec::new()), |gradient| run.read(gradient))?;
        Ok((f64::from(run.read::<f32>(*value)?[0]), gradient))
    }

    fn prepare(&self, size: [u32; 2], gradient: bool) -> Result<Prepared> {
        let [width, height] = size.map(|side| side as usize);
        let mut rec = Recorder::new(self.device.limits());
        let values = 3 * width * height;
        let pictures = ["a", "b"].map(|name| rec.input::<f32>(name, values));
        let gradient = gradient.then(|| {
            let gradient = rec.tensor::<f32>("d_a", values);
            rec.fill(gradient, 0);
            gradient
        });
        let of = LpipsPictures {
            pictures: pictures.map(|picture| (picture, 3)),
            size: [height, width],
            clipped: gradient.is_some(),
        };
        let value = self.weights.lpips.record(&mut rec, of, gradient.map(|gradient| (1.0, gradient))).value;
        [Some(value), gradient].into_iter().flatten().for_each(|tensor| rec.output(tensor));
        let residents = [self.weights.resident.clone()];
        let run = Run::with_resident(&self.device, rec.finish()?, residents)?;
        Ok(Prepared { size, run, pictures, value, gradient })
    }
}
