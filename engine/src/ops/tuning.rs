//! The fastest tile of each matrix kernel for results of each size, by measurement on the device at hand.

use super::{
    Arithmetic, Attention, AttentionKernel, AttentionTile, Epilogue, Heads, Linear, LinearKernel, LinearTile, Nearest,
    NearestKernel, NearestTile, Tiles, Units,
    cache::cache_file,
    pack_matrix,
    self_test::{attention_run, noise},
};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Recorder, Run},
    types::write_atomic,
};
use std::{
    fs,
    ops::ControlFlow,
    time::{Duration, Instant},
};

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
    /// ops/linear_matrix
    Linear,
    /// ops/attention_matrix
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
/// How long a GPU is kept busy before a measurement.
const WAKING: Duration = Duration::from_millis(100);
/// Rows of random numbers.
const DISTINCT: usize = 1024;

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

    /// Measures every tile of every matrix kernel that is not known to be unusable. `progress` gets what comes next and the share
    /// that is done, and may stop. Each time replaces what was known of its tile; the rest stays, also behind an error.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], after which the tile that was at work is unusable; [`Error::Cancelled`].
    pub fn measure(&mut self, device: &Device, mut progress: impl FnMut(&str, f64) -> ControlFlow<()>) -> Result<()> {
        let units = |factors: &'static [Element]| factors.iter().filter_map(|f| Units::of(*f, device.limits()));
        let linear = units(&Element::FACTORS).map(|units| (Tuned::Linear, units));
        let attention = units(&Element::HALVES).map(|units| (Tuned::Attention, units));
        let nearest = units(&[Element::F16]).map(|units| (Tuned::Nearest, units));
        let tiles: Vec<_> = linear
            .chain(attention)
            .chain(nearest)
            .flat_map(|(kernel, units)| {
                let candidates = kernel.candidates(units, device.limits()).into_iter().enumerate();
                candidates.map(move |(index, name)| Tile { kernel, units, index, name })
            })
            .collect();
        for (i, tile) in tiles.iter().enumerate() {
            let name = tile.full_name();
            if self.unusable.contains(&name) {
                continue;
            }
            if progress(&name, i as f64 / tiles.len() as f64).is_break() {
                return Err(Error::Cancelled);
            }
            let outcome = tile.times(device);
            if !matches!(outcome, Ok(_) | Err(Error::Memory { .. })) {
                self.unusable.push(name);
                let of_kernel = |m: &&mut Measured| (m.kernel, m.factor) == (tile.kernel, tile.units.factor);
                let measured = self.measured.iter_mut().filter(of_kernel);
                measured.for_each(|m| m.tiles.retain(|(name, _)| *name != tile.name));
            }
            match outcome {
                Err(Error::DeviceLost) => return Err(Error::DeviceLost),
                Ok(times) => times.into_iter().for_each(|(values, ms)| self.add(tile, values, ms)),
                // A driver may refuse what it offers.
                _ => {}
            }
        }
        Ok(())
    }

    fn add(&mut self, tile: &Tile, values: usize, ms: f64) {
        let Tile { kernel, units: Units { factor, .. }, .. } = *tile;
        let is_it = |m: &Measured| (m.kernel, m.factor, m.values) == (kernel, factor, values);
        let at = self.measured.iter().position(is_it).unwrap_or_else(|| {
            self.measured.push(Measured { kernel, factor, values, tiles: Vec::new() });
            self.measured.len() - 1
        });
        let tiles = &mut self.measured[at].tiles;
        match tiles.iter_mut().find(|(name, _)| *name == tile.name) {
            Some(known) => known.1 = ms,
            None => tiles.push((tile.name.clone(), ms)),
        }
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
                    if let Some(index) = best.and_then(|best| candidates.iter().position(|name| name == best)) {
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
    /// The names of its candidates.
    fn candidates(self, units: Units, limits: &Limits) -> Vec<String> {
        let channels = AttentionTile::TUNED_CHANNELS;
        match self {
            Tuned::Linear => names(&LinearTile::candidates(limits, units)),
            Tuned::Attention => names(&AttentionTile::candidates(limits, units, channels)),
            Tuned::Nearest => names(&NearestTile::candidates(limits, units)),
        }
    }

    /// `linear`, `attention` or `nearest`.
    pub fn name(self) -> &'static str {
        match self {
            Tuned::Linear => "linear",
            Tuned::Attention => "attention",
            Tuned::Nearest => "nearest",
        }
    }
}

/// A candidate of a kernel.
struct Tile {
    kernel: Tuned,
    units: Units,
    index: usize,
    name: String,
}

fn names(tiles: &[impl ToString]) -> Vec<String> {
    tiles.iter().map(ToString::to_string).collect()
}

impl Tile {
    fn full_name(&self) -> String {
        format!("{} {} {}", self.kernel.name(), self.units.factor.name(), self.name)
    }

    /// Values of the result and milliseconds, for growing results until one takes long or does not fit.
    fn times(&self, device: &Device) -> Result<Vec<(usize, f64)>> {
        let units = Units { tiles: Tiles::always(self.index), ..self.units };
        let mut times = Vec::new();
        for values in (0..Tiles::CLASSES).map(Tiles::values) {
            let run = match self.kernel {
                Tuned::Linear => linear_run(device, units, values / COLUMNS),
                Tuned::Attention => attention_of_noise(device, units, values / COLUMNS),
                Tuned::Nearest => nearest_run(device, units, values / COLUMNS),
            };
            let ms = match run.and_then(|run| median(device, run)) {
                Err(Error::Memory { .. }) if !times.is_empty() => break,
                ms => ms?,
            };
            times.push((values, ms));
            if ms > LONGEST {
                break;
            }
        }
        Ok(times)
    }
}

fn linear_run(device: &Device, units: Units, rows: usize) -> Result<Run> {
    let kernel = LinearKernel::Matrix(units);
    let element = kernel.element();
    let mut rec = Recorder::new(device.limits());
    let packed = pack_matrix(kernel, &noise(1, COLUMNS, TERMS, units.factor), TERMS, COLUMNS);
    let (weight, bias) = (rec.constant::<u8>("weight", packed.len()), rec.constant::<f32>("bias", COLUMNS));
    let values = repeated(element.encode(&noise(3, rows.min(DISTINCT), TERMS, units.factor)), rows);
    let input = rec.constant::<u8>("input", values.len());
    let layer = Linear { weight, bias, inner: TERMS, columns: COLUMNS, kernel };
    let out = layer.apply(&mut rec, "out", input, rows, Epilogue { output: element, ..Epilogue::default() });
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    run.write(weight, &packed)?;
    run.write(bias, &noise(2, 1, COLUMNS, Element::F32))?;
    run.write(input, &values)?;
    Ok(run)
}

fn attention_of_noise(device: &Device, units: Units, queries: usize) -> Result<Run> {
    let heads = Heads::new(COLUMNS / AttentionTile::TUNED_CHANNELS, COLUMNS);
    let kernel = AttentionKernel::Matrix(units);
    let attention = Attention { heads, sequences: 1, queries, keys: TERMS, kernel };
    let parts = [(1, queries), (2, TERMS), (3, TERMS)];
    let parts = parts.map(|(seed, rows)| repeated(noise(seed, rows.min(DISTINCT), COLUMNS, kernel.element()), rows));
    attention_run(device, attention, &parts, 1.0).map(|(run, _)| run)
}

fn nearest_run(device: &Device, units: Units, points: usize) -> Result<Run> {
    let mut rec = Recorder::new(device.limits());
    let rows = [points, COLUMNS].map(|count| (rec.constant::<f32>("rows", count * TERMS), count));
    let nearest = Nearest::among(&mut rec, NearestKernel::Matrix(units), rows[1], TERMS);
    let [points, targets] = rows.map(|rows| nearest.rows(&mut rec, rows));
    let out = nearest.record(&mut rec, points, targets);
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    for (i, (input, count)) in rows.into_iter().enumerate() {
        run.write(input, &repeated(noise(i as u64, count.min(DISTINCT), TERMS, Element::F32), count))?;
    }
    Ok(run)
}

/// The values of up to [`DISTINCT`] rows over and over, as `rows` rows: random numbers take the host longer than tiles take a GPU.
fn repeated<T: Copy>(values: Vec<T>, rows: usize) -> Vec<T> {
    let len = values.len() / rows.min(DISTINCT) * rows;
    values.iter().copied().cycle().take(len).collect()
}

/// Median milliseconds of matrix kernels on the device, once it is warm: a GPU whose clock fell while the host prepared the next
/// tile would be measured at a fifth of its speed.
fn median(device: &Device, mut run: Run) -> Result<f64> {
    let mut once = || -> Result<f64> {
        let profile = run.profile()?;
        let kernels = profile.rows.iter().filter(|row| row.kernel.contains("_matrix"));
        Ok(kernels.map(|row| 1e3 * row.time.as_secs_f64()).sum())
    };
    let started = Instant::now();
    once()?;
    while !device.limits().cpu && started.elapsed() < WAKING {
        once()?;
    }
    let mut times = (0..REPEATS).map(|_| once()).collect::<Result<Vec<_>>>()?;
    times.sort_by(f64::total_cmp);
    Ok(times[REPEATS / 2])
}
