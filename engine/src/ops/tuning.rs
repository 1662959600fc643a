//! The fastest tile of each matrix kernel for results of each size, by measurement on the device at hand.

use super::{
    Arithmetic, Attention, AttentionKernel, AttentionTile, Epilogue, Heads, Linear, LinearKernel, LinearTile, Nearest,
    NearestKernel, NearestTile, SelfTest, Tiles, Units, cache::cache_file, pack_matrix,
};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Recorder, Run},
    types::write_atomic,
};
use std::{fs, ops::ControlFlow};

/// What was measured on a device.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Tuning {
    /// Of each kernel and size.
    pub measured: Vec<Measured>,
    /// Tiles that are not used, because what they compute is wrong or the driver refuses them: kernel, type of factors, name.
    pub unusable: Vec<String>,
}

/// The tiles of one kernel for one size of its result.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Measured {
    /// The kernel.
    pub kernel: Tuned,
    /// Type of its factors.
    pub factor: Element,
    /// Values of the result.
    pub values: usize,
    /// Every tile that computes rightly, by name, and its milliseconds.
    pub tiles: Vec<(String, f64)>,
}

/// A kernel whose tiles are measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Tuned {
    /// ops/linear_matrix and ops/linear_workgroup
    Linear,
    /// ops/attention_matrix and ops/attention_workgroup
    Attention,
    /// cluster/nearest_matrix
    Nearest,
}

/// Columns, channels of all heads, or targets, and terms of a sum, or keys: those of a middling network.
const COLUMNS: usize = 1024;
const TERMS: usize = 1024;
/// A size at which one run takes more milliseconds is the largest that is measured; those above take what is best there.
const LONGEST: f64 = 50.0;
const REPEATS: usize = 5;

impl Measured {
    /// Name of the fastest tile.
    pub fn best(&self) -> Option<&str> {
        self.tiles.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map(|(name, _)| name.as_str())
    }
}

impl Tuning {
    /// What was measured on this device before, with this driver and these kernels.
    pub fn known(device: &Device) -> Option<Self> {
        serde_json::from_slice(&fs::read(cache_file(device, "tuning")?).ok()?).ok()
    }

    /// Remembers it for all that follows on this device.
    ///
    /// # Errors
    /// Where there is no cache folder or it cannot be written.
    pub fn keep(&self, device: &Device) -> Result<()> {
        let file = cache_file(device, "tuning");
        let file = file.ok_or_else(|| Error::argument("cache folder", "none", "ZIPSPLAT_CACHE or HOME"))?;
        file.parent().map_or(Ok(()), fs::create_dir_all).map_err(|e| Error::io(&file, e))?;
        let bytes = serde_json::to_vec(self).unwrap_or_default();
        write_atomic(&file, |out| out.write_all(&bytes))
    }

    /// Measures every tile of every matrix kernel. `progress` gets what comes next and the share that is done, and may stop.
    ///
    /// # Errors
    /// A failure of the device; [`Error::Cancelled`].
    pub fn measure(device: &Device, mut progress: impl FnMut(&str, f64) -> ControlFlow<()>) -> Result<Self> {
        let units = |factors: &'static [Element]| factors.iter().filter_map(|f| Units::of(*f, device.limits()));
        let linear = units(&Element::FACTORS).map(|units| (Tuned::Linear, units));
        let attention = units(&Element::HALVES).map(|units| (Tuned::Attention, units));
        let nearest = units(&[Element::F16]).map(|units| (Tuned::Nearest, units));
        let jobs: Vec<_> = linear.chain(attention).chain(nearest).collect();
        let mut tuning = Self::default();
        for (job, (kernel, units)) in jobs.iter().enumerate() {
            let tiles = kernel.usable(device, *units, &mut tuning.unusable)?;
            for class in 0..Tiles::CLASSES {
                let done = (job as f64 + class as f64 / Tiles::CLASSES as f64) / jobs.len() as f64;
                let next = |tile: &str| progress(tile, done);
                let measured = match kernel.measure(device, *units, &tiles, Tiles::values(class), next) {
                    Err(Error::Memory { .. }) => break,
                    measured => measured?,
                };
                let slow = measured.tiles.iter().any(|(_, ms)| *ms > LONGEST);
                tuning.measured.push(measured);
                if slow {
                    break;
                }
            }
        }
        Ok(tuning)
    }

    /// An arithmetic with the tiles that were fastest. Names that are no candidate's are left out.
    pub fn applied(&self, arithmetic: Arithmetic, limits: &Limits) -> Arithmetic {
        let tuned = |kernel: Tuned| {
            move |units: Units| {
                let candidates = kernel.candidates(units, limits);
                let mut tiles = Tiles::default();
                for class in 0..Tiles::CLASSES {
                    let is_it =
                        |m: &&Measured| (m.kernel, m.factor, m.values) == (kernel, units.factor, Tiles::values(class));
                    let best = self.measured.iter().find(is_it).and_then(Measured::best);
                    if let Some(index) = best.and_then(|best| candidates.iter().position(|(name, _)| name == best)) {
                        tiles.set_from(class, index);
                    }
                }
                Units { tiles, ..units }
            }
        };
        Arithmetic {
            linear: arithmetic.linear.map(tuned(Tuned::Linear)),
            attention: arithmetic.attention.map(tuned(Tuned::Attention)),
            quantised: arithmetic.quantised.map(tuned(Tuned::Linear)),
            nearest: arithmetic.nearest.map(tuned(Tuned::Nearest)),
            ..arithmetic
        }
    }
}

impl Tuned {
    /// Its candidates: their names, and whether they are used only after they were measured.
    fn candidates(self, units: Units, limits: &Limits) -> Vec<(String, bool)> {
        match self {
            Tuned::Linear => {
                let tiles = LinearTile::candidates(limits, units);
                tiles.iter().map(|tile| (tile.to_string(), tile.is_experimental())).collect()
            }
            Tuned::Attention => {
                let tiles = AttentionTile::candidates(limits, units, AttentionTile::TUNED_CHANNELS);
                tiles.iter().map(|tile| (tile.to_string(), tile.is_experimental())).collect()
            }
            Tuned::Nearest => {
                NearestTile::candidates(limits, units).iter().map(|tile| (tile.to_string(), false)).collect()
            }
        }
    }

    /// Its candidates by index and name, without those that compute wrongly: the self-test has passed on all others.
    fn usable(self, device: &Device, units: Units, unusable: &mut Vec<String>) -> Result<Vec<(usize, String)>> {
        let mut usable = Vec::new();
        for (index, (name, is_experimental)) in self.candidates(units, device.limits()).into_iter().enumerate() {
            let passes = || match SelfTest::passes_with(device, self, units, index) {
                Err(Error::DeviceLost) => Err(Error::DeviceLost),
                // A driver may refuse what it offers: then it is only this tile that cannot be used.
                result => Ok(result.unwrap_or(false)),
            };
            if !is_experimental || passes()? {
                usable.push((index, name));
            } else {
                unusable.push(self.full_name(units, &name));
            }
        }
        Ok(usable)
    }

    /// Measures tiles for results of `values`.
    fn measure(
        self,
        device: &Device,
        units: Units,
        tiles: &[(usize, String)],
        values: usize,
        mut next: impl FnMut(&str) -> ControlFlow<()>,
    ) -> Result<Measured> {
        let mut times = Vec::new();
        for (index, name) in tiles {
            if next(&self.full_name(units, name)).is_break() {
                return Err(Error::Cancelled);
            }
            let units = Units { tiles: Tiles::always(*index), ..units };
            let run = match self {
                Tuned::Linear => linear_run(device, units, values / COLUMNS),
                Tuned::Attention => attention_run(device, units, values / COLUMNS),
                Tuned::Nearest => nearest_run(device, units, values / COLUMNS),
            };
            times.push((name.clone(), median(run?)?));
        }
        Ok(Measured { kernel: self, factor: units.factor, values, tiles: times })
    }

    /// `linear`, `attention` or `nearest`.
    pub fn name(self) -> &'static str {
        match self {
            Tuned::Linear => "linear",
            Tuned::Attention => "attention",
            Tuned::Nearest => "nearest",
        }
    }

    fn full_name(self, units: Units, tile: &str) -> String {
        format!("{} {} {tile}", self.name(), units.factor.name())
    }
}

fn linear_run(device: &Device, units: Units, rows: usize) -> Result<Run> {
    let kernel = LinearKernel::Matrix(units);
    let element = kernel.element();
    let mut rec = Recorder::new(device.limits());
    let packed = pack_matrix(kernel, &vec![1.0; COLUMNS * TERMS], TERMS, COLUMNS);
    let (weight, bias) = (rec.constant::<u8>("weight", packed.len()), rec.constant::<f32>("bias", COLUMNS));
    let input = rec.constant::<u8>("input", rows * TERMS * element.bytes());
    let layer = Linear { weight, bias, inner: TERMS, columns: COLUMNS, kernel };
    let out = layer.apply(&mut rec, "out", input, rows, Epilogue { output: element, ..Epilogue::default() });
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    run.write(weight, &packed)?;
    run.write(bias, &vec![1f32; COLUMNS])?;
    run.write(input, &element.encode(&vec![1.0; rows * TERMS]))?;
    Ok(run)
}

fn attention_run(device: &Device, units: Units, queries: usize) -> Result<Run> {
    let heads = Heads::new(COLUMNS / AttentionTile::TUNED_CHANNELS, COLUMNS);
    let attention = Attention { heads, sequences: 1, queries, keys: TERMS, kernel: AttentionKernel::Matrix(units) };
    let mut rec = Recorder::new(device.limits());
    let tensors = attention.tensors(&mut rec);
    tensors.iter().for_each(|tensor| rec.fill(*tensor, 0));
    let out = attention.record(&mut rec, tensors);
    rec.output(out);
    Run::new(device, rec.finish()?)
}

fn nearest_run(device: &Device, units: Units, points: usize) -> Result<Run> {
    let mut rec = Recorder::new(device.limits());
    let rows = [points, COLUMNS].map(|count| (rec.tensor::<f32>("rows", count * TERMS), count));
    rows.iter().for_each(|(tensor, _)| rec.fill(*tensor, 0));
    let nearest = Nearest::among(&mut rec, NearestKernel::Matrix(units), rows[1], TERMS);
    let [points, targets] = rows.map(|rows| nearest.rows(&mut rec, rows));
    let out = nearest.record(&mut rec, points, targets);
    rec.output(out);
    Run::new(device, rec.finish()?)
}

/// Median milliseconds of matrix kernels on the device, warmed up.
fn median(mut run: Run) -> Result<f64> {
    let mut once = || -> Result<f64> {
        let profile = run.profile()?;
        let kernels =
            profile.rows.iter().filter(|row| row.kernel.contains("_matrix") || row.kernel.contains("_workgroup"));
        Ok(kernels.map(|row| 1e3 * row.time.as_secs_f64()).sum())
    };
    once()?;
    let mut times = (0..REPEATS).map(|_| once()).collect::<Result<Vec<_>>>()?;
    times.sort_by(f64::total_cmp);
    Ok(times[REPEATS / 2])
}
