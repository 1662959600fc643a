//! How different two pictures look to people: LPIPS.

use crate::{
    Error, Result,
    gpu::{Device, Recorder, Run, Tensor},
    ops::{Arithmetic, ParameterLayout, Parameters},
    stages::lpips::{Lpips, LpipsNetwork, LpipsPictures},
    tune::cache_folder,
    weights::Tensors,
};
use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
};

/// LPIPS 0.1 of pairs of pictures, with weights that are not this project's: `tools/lpips.py` fetches them.
pub struct Perceptual {
    device: Device,
    network: LpipsNetwork,
    lpips: Lpips,
    parameters: Parameters,
    /// The plan of the latest size.
    prepared: Option<Prepared>,
}

struct Prepared {
    size: [u32; 2],
    run: Run,
    pictures: [Tensor; 2],
    value: Tensor,
}

impl Perceptual {
    /// The file in the user's cache that holds a network's weights once they are fetched.
    ///
    /// # Errors
    /// [`Error::Argument`] where there is none, with the command that makes it.
    pub fn file(network: LpipsNetwork) -> Result<PathBuf> {
        let name = format!("lpips_{}.safetensors", network.name());
        let folder = cache_folder().unwrap_or_default();
        let path = folder.join(&name);
        let missing = || {
            let expected = format!("{name} there: `python3 tools/lpips.py` fetches it (64 MB)");
            Error::argument("weights of LPIPS", format!("nothing in {}", folder.display()), expected)
        };
        if path.is_file() { Ok(path) } else { Err(missing()) }
    }

    /// Loads a network's weights from a file: `convolutions.I.weight` `[outputs, side, side, inputs]`, `convolutions.I.bias`,
    /// `taps.I.weight`.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Format`] and [`Error::Weights`] for the file; [`Error::Memory`] where the device has too little.
    pub fn open(device: &Device, network: LpipsNetwork, path: &Path) -> Result<Self> {
        let layout = || {
            let mut parameters = ParameterLayout::new(device.limits(), Arithmetic::EXACT);
            let lpips = Lpips::new(&mut parameters, network, false);
            (parameters, lpips)
        };
        let tensors = Tensors::open(path, &format!("LPIPS ({})", network.name()), &layout().0.names_and_shapes())?;
        let (parameters, lpips) = layout();
        let read = |name: &str, out: &mut [f32]| {
            tensors.read(name, out);
            Ok(())
        };
        let parameters = parameters.load(device, read, |_| ControlFlow::Continue(()))?;
        Ok(Self { device: device.clone(), network, lpips, parameters, prepared: None })
    }

    /// The network that sees the pictures.
    pub fn network(&self) -> LpipsNetwork {
        self.network
    }

    /// The distance of two pictures of one size `[width, height]`, `[height][width][rgb]` in 0..1; 0 where they are equal.
    ///
    /// # Errors
    /// [`Error::Argument`] for pictures of too few pixels or of other lengths; [`Error::Memory`] where the device has too little.
    pub fn distance(&mut self, [a, b]: [&[f32]; 2], size: [u32; 2]) -> Result<f64> {
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
        let prepared = match self.prepared.take() {
            Some(prepared) if prepared.size == size => self.prepared.insert(prepared),
            _ => {
                let prepared = self.prepare(size)?;
                self.prepared.insert(prepared)
            }
        };
        let run = &mut prepared.run;
        run.write(prepared.pictures[0], a)?;
        run.write(prepared.pictures[1], b)?;
        run.execute()?;
        Ok(f64::from(run.read::<f32>(prepared.value)?[0]))
    }

    fn prepare(&self, size: [u32; 2]) -> Result<Prepared> {
        let [width, height] = size.map(|side| side as usize);
        let mut rec = Recorder::new(self.device.limits());
        let pictures = ["a", "b"].map(|name| rec.input::<f32>(name, 3 * width * height));
        let request =
            LpipsPictures { pictures: pictures.map(|picture| (picture, 3)), size: [height, width], clipped: false };
        let value = self.lpips.record(&mut rec, request, None).value;
        rec.output(value);
        let residents = [self.parameters.resident.clone()];
        let run = Run::with_resident(&self.device, rec.finish()?, residents)?;
        Ok(Prepared { size, run, pictures, value })
    }
}
